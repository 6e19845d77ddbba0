//! What can go wrong with a call, in sentences.

use std::error::Error as _;
use std::io;
use std::time::Duration;

use tonic::{Code, Status};
use tonic_types::StatusExt;

use super::handshake;
use crate::cli::exit::{Exit, Failure};
use crate::domain::job::DEFAULT_TENANT;
use crate::domain::{InvalidInput, Violation};
use crate::formats::LabelledInput;

/// Why a call came to nothing.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Error {
    /// No server answers, it is going down, or its queue is full: another try may help.
    #[error("{0}")]
    Unavailable(String),
    /// The server found fault with the input or with what was asked; the fields are those of the API.
    #[error("{1}")]
    Invalid(Vec<Violation>, String),
    /// What was asked makes no sense for any server.
    #[error("{0}")]
    Usage(String),
    /// The server will not do it: no such job, no result yet, an id that is taken, more than it ever has room for.
    #[error("{0}")]
    Refused(String),
    /// One of the two does not trust the other: a certificate, or a key, which may also lack a scope.
    #[error("{0}")]
    NotLetIn(String),
    #[error("the job was cancelled")]
    Cancelled,
    /// The job or the server failed.
    #[error("{0}")]
    Failed(String),
}

/// First parts of the fields that come from a file of tracks. All others come from flags.
const INPUT_FIELDS: [&str; 4] = ["track_set", "measurement_matrix", "match_set", "input"];

impl Error {
    /// The violations that are the input's; empty for any other error.
    fn of_input(&self) -> &[Violation] {
        match self {
            Error::Invalid(violations, _) if violations.iter().any(is_of_input) => violations,
            _ => &[],
        }
    }

    /// Tells what is wrong with the input by file and line: the server speaks of fields and indices, the user has
    /// lines.
    pub fn at_lines(self, input: &LabelledInput) -> Failure {
        match self.of_input() {
            [] => self.into(),
            violations => input.explain_all(violations, 0).into(),
        }
    }

    /// The same where each of several inputs is a request of one call.
    pub fn at_lines_of(self, inputs: &[LabelledInput]) -> Failure {
        let Error::Invalid(violations, message) = &self else { return self.into() };
        let first = violations.first().and_then(|found| within_request(&found.field));
        let Some((index, input)) = first.and_then(|(index, _)| Some((index, inputs.get(index)?))) else {
            return self.into();
        };
        // The server tells of the first request that it refuses.
        let own = violations.iter().filter_map(|found| match within_request(&found.field) {
            Some((of, field)) if of == index => Some(Violation { field: field.to_owned(), ..found.clone() }),
            _ => None,
        });
        Error::Invalid(own.collect(), message.clone()).at_lines(input)
    }

    /// From the status of a call to `server`, which has `answered` one before, or not.
    pub(super) fn from_status(server: &str, status: &Status, answered: bool) -> Self {
        if let Some(words) = handshake::words(server, status) {
            return Error::NotLetIn(words);
        }
        if status.source().is_some() && status.get_details_error_info().is_none() {
            let cause = root_cause(status);
            // What has worked speaks what it is asked in.
            let hint = if answered { "" } else { handshake::plain_hint(server, &cause) };
            return Error::Unavailable(format!("the connection to {server} broke: {cause}{hint}"));
        }
        let message = status.message().to_owned();
        // A page that is not found, as on the port of the metrics. Other pages are those of proxies.
        if !answered && status.code() == Code::Unimplemented && message.contains(NO_GRPC_STATUS) {
            return Error::Unavailable(format!(
                "what answers at {server} speaks no gRPC: is this another port, such as that of the metrics? ({message})"
            ));
        }
        if was_cut(status) {
            return Error::Unavailable(format!("the connection to {server} broke: {message}"));
        }
        match status.code() {
            Code::Unavailable => Error::Unavailable(format!("{server}: {message}")),
            Code::ResourceExhausted => {
                // Of a rate the message itself tells the time.
                let delay = retry_delay(status).filter(|_| rate_limit_wait(status).is_none());
                let hint = delay.map(|delay| format!("; try again in {} s", tenths(delay))).unwrap_or_default();
                Error::Unavailable(format!("{server}: {message}{hint}"))
            }
            // Sound, and more than this server ever takes: neither the usage nor a line of the input is wrong.
            Code::InvalidArgument if is_too_large(status) => Error::Refused(format!("{server}: {message}")),
            Code::InvalidArgument => Error::Invalid(violations(status), message),
            // What the transport says of a message above the server's limit.
            Code::OutOfRange => {
                Error::Refused(format!("{message}; `solve --server` and `upload` send a large input in parts"))
            }
            Code::NotFound | Code::AlreadyExists | Code::FailedPrecondition | Code::Aborted => Error::Refused(message),
            Code::PermissionDenied => Error::NotLetIn(format!("{server}: {message}")),
            Code::Unauthenticated => {
                Error::NotLetIn(format!("{server}: {message}; here: --api-key-file, or the variable SCPSFM_API_KEY"))
            }
            Code::Cancelled => Error::Cancelled,
            code => Error::Failed(format!("{server}: {message} ({code:?})")),
        }
    }

    /// Says what the trouble began with, where that is not what it ended with: a server that goes down says so once,
    /// and afterwards the system says no more than that nobody is there.
    pub(super) fn begun_with(self, first: &Error) -> Self {
        match self {
            Error::Unavailable(last) if *first != Error::Unavailable(last.clone()) => {
                Error::Unavailable(format!("{last}; before that: {first}"))
            }
            same => same,
        }
    }

    /// Says that jobs may have been stored, whose answer was lost.
    pub(super) fn or_stored(self) -> Self {
        match self {
            Error::Unavailable(words) => Error::Unavailable(format!(
                "{words}\nit may have been stored, the answer lost: look with `scpsfm list` before it is sent again. A \
                 command that had --request-id can be repeated as it is, and stores once"
            )),
            same => same,
        }
    }

    /// Says how to name a tenant, where the server knows no such one, or nothing of this name of the default one's, and
    /// the caller named none.
    pub(super) fn or_no_tenant(self, status: &Status) -> Self {
        let Error::Refused(message) = self else { return self };
        let hint = match reason(status).as_deref() {
            Some("TENANT_NOT_FOUND") => "; --tenant or SCPSFM_TENANT says whose jobs these are",
            Some("JOB_NOT_FOUND" | "INPUT_NOT_FOUND") if message.contains(&format!("tenants/{DEFAULT_TENANT}/")) => {
                "; --tenant or SCPSFM_TENANT names another tenant"
            }
            _ => "",
        };
        Error::Refused(format!("{message}{hint}"))
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

/// After what time a call passes that was refused because of a rate; nothing of it was carried out.
pub(super) fn rate_limit_wait(status: &Status) -> Option<Duration> {
    retry_delay(status).filter(|_| reason(status).as_deref() == Some("RATE_LIMITED"))
}

/// Whether what was sent is more by itself than the server has room for.
fn is_too_large(status: &Status) -> bool {
    matches!(reason(status).as_deref(), Some("BATCH_TOO_LARGE" | "UPLOAD_TOO_LARGE" | "JOB_TOO_LARGE"))
}

/// Whether the same call may fare better soon: the connection broke, or the server is going down.
pub(super) fn is_transient(status: &Status) -> bool {
    handshake::words("", status).is_none() && broke_or_ends(status)
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
    if let Some(words) = handshake::words(server, error) {
        return Error::NotLetIn(words);
    }
    let cause = root_cause(error);
    let hint = handshake::plain_hint(server, &cause);
    Error::Unavailable(format!(
        "no server answers at {server}: {cause}{hint}; start one with `scpsfm serve`, or say --server"
    ))
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

/// Number and field of `requests[3].track_set.xs`.
fn within_request(field: &str) -> Option<(usize, &str)> {
    let (index, field) = field.strip_prefix("requests[")?.split_once("].")?;
    Some((index.parse().ok()?, field))
}

/// Whether the fault is the input's. Every other field is one that a flag set.
fn is_of_input(violation: &Violation) -> bool {
    let first = violation.field.split('.').next().unwrap_or_default();
    INPUT_FIELDS.contains(&first)
}

/// Reads `track_set.xs[17]` or `track_set.views[2].name` back into its parts.
fn violation(path: &str, description: String) -> Violation {
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
        Error::Failed(format!("the server's answer cannot be read: {violation}"))
    }
}

/// An answer that cannot be read.
impl From<InvalidInput> for Error {
    fn from(error: InvalidInput) -> Self {
        Error::Failed(format!("the server's answer cannot be read: {error}"))
    }
}

impl From<Error> for Failure {
    fn from(error: Error) -> Self {
        let exit = match &error {
            Error::Unavailable(_) => Exit::Unavailable,
            Error::Invalid(violations, _) if violations.iter().any(|violation| !is_of_input(violation)) => Exit::Usage,
            Error::Usage(_) => Exit::Usage,
            Error::Invalid(..) | Error::Refused(_) => Exit::BadInput,
            Error::NotLetIn(_) => Exit::NotLetIn,
            Error::Cancelled => Exit::Interrupted,
            Error::Failed(_) => Exit::Internal,
        };
        Failure { exit, message: error.to_string() }
    }
}

#[cfg(test)]
mod tests {
    use tonic_types::ErrorDetails;

    use super::*;
    use crate::domain::job::JobName;
    use crate::rpc::status;
    use crate::telemetry::metrics::RateBound;

    #[test]
    fn violations_come_back_with_field_and_index() {
        let sent = Violation::at("track_set.xs", 17, "NaN is not a finite number");
        let status = status::invalid(&sent.clone().into());
        let Error::Invalid(violations, message) = Error::from_status("http://a", &status, true) else {
            panic!("not invalid: {status}");
        };
        assert_eq!(violations, [sent]);
        assert_eq!(message, "track_set.xs[17]: NaN is not a finite number");
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
        assert!(may_be_done(&status::from_engine(crate::engine::Error::Unavailable("within a commit".into()))));
        assert!(!may_be_done(&broken(io::ErrorKind::ConnectionRefused)), "nobody was there");
        assert!(!may_be_done(&status::from_engine(crate::engine::Error::Draining)), "it was refused");
    }

    #[test]
    fn what_a_trouble_began_with_is_told_where_it_says_more() {
        let unavailable = |words: &str| Error::Unavailable(words.into());
        let last = unavailable("refused").begun_with(&unavailable("draining"));
        assert_eq!(last.to_string(), "refused; before that: draining");
        assert_eq!(unavailable("refused").begun_with(&unavailable("refused")).to_string(), "refused");
        assert_eq!(Error::Cancelled.begun_with(&unavailable("draining")), Error::Cancelled);
    }

    #[test]
    fn when_to_try_again_is_told_once_and_rounded() {
        let told = |status: &Status| Error::from_status("http://a", status, true).to_string();
        let wait = Duration::from_nanos(146_655_954);
        let limited = status::rate_limited(RateBound::Calls, wait);
        assert_eq!(rate_limit_wait(&limited), Some(wait));
        let words = told(&limited);
        assert!(words.ends_with("; come back in 0.147 s") && !words.contains("try again"), "{words}");
        let details = ErrorDetails::with_retry_info(Some(Duration::from_millis(1_234)));
        let full = Status::with_error_details(Code::ResourceExhausted, "full", details);
        assert_eq!((told(&full).as_str(), rate_limit_wait(&full)), ("http://a: full; try again in 1.3 s", None));
        let memory = status::memory_full(1);
        assert!(rate_limit_wait(&memory).is_none() && retry_delay(&memory).is_some());
    }

    #[test]
    fn an_answer_that_a_balancer_cut_short_is_a_broken_connection() {
        let cut = Status::unknown("stream was terminated without a final status");
        assert!(is_transient(&cut));
        let error = Error::from_status("http://a", &cut, true);
        assert_eq!(Failure::from(error.clone()).exit, Exit::Unavailable, "{error}");
        let defect = status::internal(&"a defect");
        assert!(!is_transient(&defect));
        assert_eq!(Failure::from(Error::from_status("http://a", &defect, true)).exit, Exit::Internal);
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

    #[test]
    fn how_to_name_a_tenant_is_said_where_there_is_none() {
        let words = |status: Status| Error::from_status("http://a", &status, true).or_no_tenant(&status).to_string();
        assert!(words(status::tenant_not_found("default")).contains("; --tenant or SCPSFM_TENANT "));
        for (name, said) in [("tenants/default/jobs/a", true), ("tenants/acme/jobs/a", false)] {
            let job = JobName::parse(name).expect("a name");
            assert_eq!(words(status::job_not_found(&job)).contains("--tenant"), said, "{name}");
        }
    }

    #[test]
    fn fields_that_flags_set_are_wrong_usage_and_the_inputs_are_bad_input() {
        let exit = |field: &str| {
            let status = status::invalid(&Violation::of(field, "is wrong").into());
            Failure::from(Error::from_status("http://a", &status, true)).exit
        };
        for flag in [
            "job.settings.alpha",
            "job.settings.backend",
            "job.labels",
            "job.time_limit",
            "job_id",
            "filter",
            "after_sequence",
        ] {
            assert_eq!(exit(flag), Exit::Usage, "{flag}");
        }
        for input in ["track_set.xs", "track_set.views", "measurement_matrix.values", "match_set.xs", "input"] {
            assert_eq!(exit(input), Exit::BadInput, "{input}");
        }
        let unnamed = Error::Invalid(Vec::new(), "a malformed message".into());
        assert_eq!(Failure::from(unnamed).exit, Exit::BadInput);
    }
}
