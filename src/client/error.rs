//! What can go wrong with a call, in sentences and for programs.

use std::error::Error as _;
use std::io;
use std::time::Duration;

use tonic::{Code, Status};
use tonic_types::StatusExt;

use super::handshake;
use super::options::Setting;
use crate::domain::{InvalidInput, Violation};

/// Why a call came to nothing: a sentence for people, the rest for programs.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{message}")]
#[non_exhaustive]
pub struct Error {
    pub kind: ErrorKind,
    /// The sentence; a field of [`Options`](super::Options) stands in backquotes.
    pub message: String,
    /// The API's reason, such as `QUEUE_FULL`, where the server gave one.
    pub reason: Option<String>,
    /// What the server found fault with, by the API's fields.
    pub violations: Vec<Violation>,
    /// What of the connection is wrong or would help.
    pub setting: Option<Setting>,
    /// Whether jobs may have been stored all the same, the answer lost.
    pub may_be_stored: bool,
}

/// What a caller can do about an error.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum ErrorKind {
    /// No server answers, it is going down, or its queue is full: another try may help.
    Unavailable,
    /// The server found fault with the input or with what was asked.
    Invalid,
    /// What was asked makes no sense for any server.
    Usage,
    /// The server will not do it: no such job, no result yet, an id that is taken, more than it ever has room for.
    Refused,
    /// One of the two does not trust the other: a certificate, or a key, which may also lack a scope.
    NotLetIn,
    /// The job was cancelled.
    Cancelled,
    /// The job or the server failed.
    Failed,
}

impl ErrorKind {
    /// An error of this kind.
    pub(crate) fn error(self, message: impl Into<String>) -> Error {
        Error {
            kind: self,
            message: message.into(),
            reason: None,
            violations: Vec::new(),
            setting: None,
            may_be_stored: false,
        }
    }
}

impl Error {
    /// The error of a job that was cancelled.
    pub(super) fn cancelled() -> Self {
        ErrorKind::Cancelled.error("the job was cancelled")
    }

    pub(super) fn failed(message: impl Into<String>) -> Self {
        ErrorKind::Failed.error(message)
    }

    /// What of the connection the message names.
    pub(super) fn about(self, setting: Setting) -> Self {
        Self { setting: Some(setting), ..self }
    }

    /// From the status of a call to `server`, which has `answered` one before, or not.
    pub(super) fn from_status(server: &str, status: &Status, answered: bool) -> Self {
        let error = handshake::error(server, status).unwrap_or_else(|| of_status(server, status, answered));
        Self { reason: reason(status), ..error }
    }

    /// Says what the trouble began with, where that is not what it ended with: a server that goes down says so once,
    /// and afterwards the system says no more than that nobody is there.
    pub(super) fn begun_with(mut self, first: &Error) -> Self {
        if self.kind == ErrorKind::Unavailable && self.message != first.message {
            self.message = format!("{}; before that: {first}", self.message);
        }
        self
    }

    /// Says that jobs may have been stored, whose answer was lost.
    pub(super) fn or_stored(mut self) -> Self {
        if self.kind == ErrorKind::Unavailable {
            self.message.push_str("\nit may have been stored, the answer lost");
            self.may_be_stored = true;
        }
        self
    }
}

/// From a status that is none of a TLS handshake.
fn of_status(server: &str, status: &Status, answered: bool) -> Error {
    use ErrorKind::{Failed, Invalid, NotLetIn, Refused, Unavailable};

    if status.source().is_some() && status.get_details_error_info().is_none() {
        let cause = root_cause(status);
        // What has worked speaks what it is asked in.
        let hint = if answered { "" } else { handshake::plain_hint(server, &cause) };
        return Unavailable.error(format!("the connection to {server} broke: {cause}{hint}"));
    }
    let message = status.message();
    // A page that is not found, as on the port of the metrics. Other pages are those of proxies.
    if !answered && status.code() == Code::Unimplemented && message.contains(NO_GRPC_STATUS) {
        return Unavailable.error(format!(
            "what answers at {server} speaks no gRPC: is this another port, such as that of the metrics? ({message})"
        ));
    }
    if was_cut(status) {
        return Unavailable.error(format!("the connection to {server} broke: {message}"));
    }
    match status.code() {
        Code::Unavailable => Unavailable.error(format!("{server}: {message}")),
        Code::ResourceExhausted => {
            // Of a rate the message itself tells the time.
            let delay = retry_delay(status).filter(|_| reason(status).as_deref() != Some("RATE_LIMITED"));
            let hint = delay.map(|delay| format!("; try again in {} s", tenths(delay))).unwrap_or_default();
            Unavailable.error(format!("{server}: {message}{hint}"))
        }
        // Sound, and more than this server ever takes: neither the usage nor a line of the input is wrong.
        Code::InvalidArgument if is_too_large(status) => Refused.error(format!("{server}: {message}")),
        Code::InvalidArgument => Error { violations: violations(status), ..Invalid.error(message) },
        Code::NotFound | Code::AlreadyExists | Code::FailedPrecondition | Code::Aborted | Code::OutOfRange => {
            Refused.error(message)
        }
        Code::PermissionDenied => NotLetIn.error(format!("{server}: {message}")),
        Code::Unauthenticated => {
            NotLetIn.error(format!("{server}: {message}; a key goes into `api_key`")).about(Setting::ApiKey)
        }
        Code::Cancelled => Error::cancelled(),
        code => Failed.error(format!("{server}: {message} ({code:?})")),
    }
}

/// The reason that a status carries for programs.
pub(super) fn reason(status: &Status) -> Option<String> {
    Some(status.get_details_error_info()?.reason)
}

fn retry_delay(status: &Status) -> Option<Duration> {
    status.get_details_retry_info()?.retry_delay
}

/// Seconds as they are told, rounded up.
fn tenths(delay: Duration) -> f64 {
    (delay.as_secs_f64() * 10.0).ceil() / 10.0
}

/// After what time a call may pass that was refused because of a rate, or because other calls had the server's memory;
/// nothing was stored of it but chunks of an upload.
pub(super) fn retry_after(status: &Status) -> Option<Duration> {
    retry_delay(status).filter(|_| matches!(reason(status).as_deref(), Some("RATE_LIMITED" | "MEMORY")))
}

/// Whether what was sent is more by itself than the server has room for.
fn is_too_large(status: &Status) -> bool {
    matches!(reason(status).as_deref(), Some("BATCH_TOO_LARGE" | "UPLOAD_TOO_LARGE" | "JOB_TOO_LARGE"))
}

/// Whether the same call may fare better soon: the connection broke, or the server is going down.
pub(super) fn is_transient(status: &Status) -> bool {
    handshake::error("", status).is_none() && broke_or_ends(status)
}

fn broke_or_ends(status: &Status) -> bool {
    let broke = status.source().is_some() && status.get_details_error_info().is_none();
    status.code() == Code::Unavailable || broke || was_cut(status)
}

/// What tonic says, under UNIMPLEMENTED, of a page that is not found.
const NO_GRPC_STATUS: &str = "grpc-status header missing";

/// Whether an answer ended without its status, as a balancer ends it whose server has died. That reads as UNKNOWN,
/// which our server never says.
fn was_cut(status: &Status) -> bool {
    status.code() == Code::Unknown && status.get_details_error_info().is_none()
}

/// Whether a call may have been carried out, and only its answer was lost: not where the server refused it, or nobody
/// took the connection.
pub(super) fn may_be_done(status: &Status) -> bool {
    if let Some(reason) = reason(status) {
        // The store broke off, maybe within the commit. Anything else is a refusal.
        return reason == "STORE_UNAVAILABLE";
    }
    let mut cause: Option<&dyn std::error::Error> = status.source();
    let mut reached = broke_or_ends(status);
    while let Some(here) = cause {
        reached &=
            here.downcast_ref::<io::Error>().is_none_or(|error| error.kind() != io::ErrorKind::ConnectionRefused);
        cause = here.source();
    }
    reached
}

/// No connection to begin with.
pub(super) fn not_connected(server: &str, error: &tonic::transport::Error) -> Error {
    handshake::error(server, error).unwrap_or_else(|| {
        let cause = root_cause(error);
        let hint = handshake::plain_hint(server, &cause);
        ErrorKind::Unavailable.error(format!("no server answers at {server}: {cause}{hint}")).about(Setting::Server)
    })
}

/// The innermost error: what the layers above wrap says nothing to a user.
pub(super) fn root_cause(error: &dyn std::error::Error) -> String {
    let mut cause = error;
    while let Some(inner) = cause.source() {
        cause = inner;
    }
    cause.to_string()
}

/// The violations that a status carries, index and all.
fn violations(status: &Status) -> Vec<Violation> {
    let fields = status.get_details_bad_request().map(|request| request.field_violations).unwrap_or_default();
    fields.into_iter().map(|found| violation(&found.field, found.description)).collect()
}

/// Reads `track_set.xs[17]` or `track_set.views[2].name` back into its parts. The request of a batch that a field is in
/// stays a part of the field: `requests[3].track_set.xs`.
fn violation(path: &str, description: String) -> Violation {
    if let Some((request, rest)) = path.split_once("].").filter(|(request, _)| request.starts_with("requests[")) {
        let found = violation(rest, description);
        return Violation { field: format!("{request}].{}", found.field), ..found };
    }
    let parts = || {
        let (field, rest) = path.split_once('[')?;
        let (index, part) = rest.split_once(']')?;
        Some((field, index.parse().ok()?, part.strip_prefix('.')))
    };
    match parts() {
        Some((field, index, Some(part))) => Violation::at(field, index, description).within(part),
        Some((field, index, None)) => Violation::at(field, index, description),
        None => Violation::of(path, description),
    }
}

/// An answer that cannot be read.
impl From<Violation> for Error {
    fn from(violation: Violation) -> Self {
        Error::failed(format!("the server's answer cannot be read: {violation}"))
    }
}

/// An answer that cannot be read.
impl From<InvalidInput> for Error {
    fn from(error: InvalidInput) -> Self {
        Error::failed(format!("the server's answer cannot be read: {error}"))
    }
}

#[cfg(test)]
mod tests {
    use tonic_types::ErrorDetails;

    use super::*;
    use crate::engine::{self, StoreError};
    use crate::rpc::status;
    use crate::telemetry::metrics::RateBound;

    #[test]
    fn violations_come_back_with_field_and_index() {
        let sent = Violation::at("track_set.xs", 17, "NaN is not a finite number");
        let status = status::invalid(sent.clone());
        let error = Error::from_status("http://a", &status, true);
        assert_eq!((error.kind, error.reason.as_deref()), (ErrorKind::Invalid, Some("INVALID_ARGUMENT")));
        assert_eq!(error.violations, [sent]);
        assert_eq!(error.message, "track_set.xs[17]: NaN is not a finite number");
        let of_view = Violation::at("track_set.views", 2, "is odd").within("size.width_px");
        assert_eq!(violation(&of_view.path(), "is odd".into()), of_view);
        let whole = violation("job.settings.alpha", "is wrong".into());
        assert_eq!(whole, Violation::of("job.settings.alpha", "is wrong"));
    }

    #[test]
    fn a_call_whose_answer_was_lost_may_have_been_carried_out() {
        let broken = |kind: io::ErrorKind| Status::from_error(Box::new(io::Error::new(kind, "trouble")));
        assert!(may_be_done(&broken(io::ErrorKind::ConnectionReset)));
        assert!(may_be_done(&Status::unknown("stream was terminated without a final status")));
        assert!(may_be_done(&Status::unavailable("a proxy's page")));
        assert!(may_be_done(&engine::Error::from(StoreError::Unavailable("within a commit".into())).into()));
        assert!(!may_be_done(&broken(io::ErrorKind::ConnectionRefused)), "nobody was there");
        assert!(!may_be_done(&engine::Error::Draining.into()), "it was refused");
    }

    #[test]
    fn what_a_trouble_began_with_is_told_where_it_says_more() {
        let unavailable = |words: &str| ErrorKind::Unavailable.error(words);
        let last = unavailable("refused").begun_with(&unavailable("draining"));
        assert_eq!(last.to_string(), "refused; before that: draining");
        assert_eq!(unavailable("refused").begun_with(&unavailable("refused")).to_string(), "refused");
        assert_eq!(Error::cancelled().begun_with(&unavailable("draining")), Error::cancelled());
    }

    #[test]
    fn when_to_try_again_is_told_once_and_rounded() {
        let told = |status: &Status| Error::from_status("http://a", status, true).to_string();
        let wait = Duration::from_nanos(146_655_954);
        let limited = status::rate_limited(RateBound::Calls, wait);
        assert_eq!(retry_after(&limited), Some(wait));
        let words = told(&limited);
        assert!(words.ends_with("; come back in 0.147 s") && !words.contains("try again"), "{words}");
        let details = ErrorDetails::with_retry_info(Some(Duration::from_millis(1_234)));
        let full = Status::with_error_details(Code::ResourceExhausted, "full", details);
        assert_eq!((told(&full).as_str(), retry_after(&full)), ("http://a: full; try again in 1.3 s", None));
        let memory = status::memory_full(1);
        assert_eq!(retry_after(&memory), Some(Duration::from_secs(2)));
    }

    #[test]
    fn an_answer_that_a_balancer_cut_short_is_a_broken_connection() {
        let cut = Status::unknown("stream was terminated without a final status");
        assert!(is_transient(&cut));
        let error = Error::from_status("http://a", &cut, true);
        assert_eq!(error.kind, ErrorKind::Unavailable, "{error}");
        let defect = status::internal(&"a defect");
        assert!(!is_transient(&defect));
        assert_eq!(Error::from_status("http://a", &defect, true).kind, ErrorKind::Failed);
    }

    #[test]
    fn tls_is_asked_for_only_where_no_call_was_ever_answered() {
        let broke = || Status::from_error(Box::new(std::io::Error::other("stream closed because of a broken pipe")));
        for (answered, asked) in [(false, true), (true, false)] {
            let error = Error::from_status("http://a", &broke(), answered).to_string();
            assert!(error.contains("broken pipe"), "{error}");
            assert_eq!(error.contains("https://"), asked, "{error}");
        }
    }
}
