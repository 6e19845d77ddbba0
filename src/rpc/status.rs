//! The one place where errors become statuses (AIP-193): a code, a reason that programs can match, and what to do. The
//! table of them is in docs/api.md, "Errors".
//!
//! Only what may fare better later has a `RetryInfo`. What is too large whatever the state of the server is
//! `INVALID_ARGUMENT`, as `google.rpc.Code` has it: `FAILED_PRECONDITION` would be for a state that the caller can
//! mend, and `RESOURCE_EXHAUSTED` is what polite clients repeat.

use std::collections::HashMap;
use std::time::Duration;

use tonic::{Code, Status};
use tonic_types::{ErrorDetails, FieldViolation, StatusExt};

use super::keys::Scope;
use crate::domain::job::JobName;
use crate::domain::{InputName, InvalidInput, Oversize, Sha256Digest, Violation};
use crate::engine::{self, Bound, StoreError, TakenId};
use crate::telemetry::metrics::RateBound;

/// Domain of every `ErrorInfo`.
pub const DOMAIN: &str = "scpsfm";

/// Violations that the message spells out; all that were kept are in the details. Both travel in one HTTP/2 header
/// block, of which common clients take 8 KiB.
const SENTENCES_IN_MESSAGE: usize = 3;

/// Pause that a caller of a draining server is told: about what a replacement needs to come up.
const DRAINING_RETRY: Duration = Duration::from_secs(5);

/// Pause that a caller is told while the store is away: a database that restarts takes a few seconds.
const STORE_RETRY: Duration = Duration::from_secs(2);

/// Pause that a caller is told while others hold the memory for calls: most inputs and results are through in less.
const MEMORY_RETRY: Duration = Duration::from_secs(2);

/// Pause that a caller is told while the disk is full: somebody has to make room.
const SPACE_RETRY: Duration = Duration::from_secs(60);

/// Pause that a caller is told while the queue is full: about the time of one job.
const QUEUE_RETRY: Duration = Duration::from_secs(3);

/// Pause that a caller is told who has uploaded as much as it may: another upload takes about as long.
const UPLOADS_RETRY: Duration = Duration::from_secs(60);

fn status(code: Code, reason: &str, message: impl Into<String>, details: ErrorDetails) -> Status {
    status_with(code, reason, HashMap::new(), message, details)
}

/// The same with metadata of the `ErrorInfo`, for programs.
fn status_with(
    code: Code,
    reason: &str,
    metadata: HashMap<String, String>,
    message: impl Into<String>,
    mut details: ErrorDetails,
) -> Status {
    details.set_error_info(reason, DOMAIN, metadata);
    Status::with_error_details(code, message, details)
}

/// A refusal that has its reason, and no details.
pub fn refused(code: Code, reason: &str, message: impl Into<String>) -> Status {
    status(code, reason, message, ErrorDetails::new())
}

/// A request that breaks a rule of a field.
pub fn violation(field: &str, description: impl Into<String>) -> Status {
    invalid(Violation::of(field, description))
}

/// A request that breaks rules.
pub fn invalid(error: impl Into<InvalidInput>) -> Status {
    let error = error.into();
    let violations = error.violations();
    let listed = violations.len().min(SENTENCES_IN_MESSAGE);
    let mut message = violations[..listed].iter().map(Violation::to_string).collect::<Vec<_>>().join("; ");
    let unlisted = violations.len() - listed + error.unlisted();
    if unlisted > 0 {
        message.push_str(&format!("; and {unlisted} more"));
    }
    let fields = violations.iter().map(|violation| FieldViolation::new(violation.path(), &violation.description));
    let details = ErrorDetails::with_bad_request(fields.collect::<Vec<_>>());
    status(Code::InvalidArgument, "INVALID_ARGUMENT", message, details)
}

/// What is more by itself than a bound of the server allows; `field` is where it comes from.
fn too_large(reason: &str, field: &str, oversize: &Oversize) -> Status {
    let Oversize { quota, asked, max } = oversize;
    let metadata = HashMap::from([
        ("bound".to_owned(), quota.name().to_owned()),
        ("key".to_owned(), quota.key().to_owned()),
        ("asked".to_owned(), asked.to_string()),
        ("max".to_owned(), max.to_string()),
    ]);
    let message = oversize.to_string();
    let details = ErrorDetails::with_bad_request(vec![FieldViolation::new(field, &message)]);
    status_with(Code::InvalidArgument, reason, metadata, format!("{field}: {message}"), details)
}

/// The refusal of one request of a batch: message and fields name it, as `requests[3].track_set.xs[17]`.
pub fn of_request(index: usize, found: &Status) -> Status {
    let prefix = format!("requests[{index}]");
    let mut details = found.get_error_details();
    if let Some(request) = details.bad_request().cloned() {
        let within = |old: FieldViolation| FieldViolation { field: format!("{prefix}.{}", old.field), ..old };
        details.set_bad_request(request.field_violations.into_iter().map(within).collect::<Vec<_>>());
    }
    Status::with_error_details(found.code(), format!("{prefix}: {}", found.message()), details)
}

/// No such job, or another tenant's: a caller cannot tell them apart.
pub fn job_not_found(name: &JobName) -> Status {
    let mut details = ErrorDetails::new();
    details.set_resource_info("scpsfm.v1.Job", name.to_string(), "", "there is no such job");
    status(Code::NotFound, "JOB_NOT_FOUND", format!("there is no job {name}"), details)
}

/// A result that does not fit one message.
pub fn result_too_large(name: &JobName, bytes: u64, largest: u64) -> Status {
    let message = format!(
        "the result of {name} has {bytes} bytes, a message at most {largest}: read it by JobService.ReadJobResult, over \
         HTTP with the header accept: application/x-protobuf"
    );
    let metadata = HashMap::from([("bytes".to_owned(), bytes.to_string()), ("max".to_owned(), largest.to_string())]);
    status_with(Code::FailedPrecondition, "RESULT_TOO_LARGE", metadata, message, ErrorDetails::new())
}

/// A parent that is not the caller's tenant: a caller cannot tell whether there is such a tenant.
pub fn tenant_not_found(tenant: &str) -> Status {
    let name = format!("tenants/{tenant}");
    let mut details = ErrorDetails::new();
    details.set_resource_info("scpsfm.v1.Tenant", &name, "", "there is no such tenant, or the key is not of it");
    let message = format!("there is no tenant {name}, or the caller's key is not of it");
    status(Code::NotFound, "TENANT_NOT_FOUND", message, details)
}

/// A call without a key, or without one that could be read.
pub fn no_key() -> Status {
    let message = "this server asks for an API key: send it as `authorization: Bearer KEY`";
    refused(Code::Unauthenticated, "API_KEY_MISSING", message)
}

/// A key that is none here. Says nothing of the key.
pub fn unknown_key() -> Status {
    let message = "the API key is not known here: it is mistyped, or was withdrawn";
    refused(Code::Unauthenticated, "API_KEY_UNKNOWN", message)
}

/// A key that was withdrawn while a call lasted.
pub fn withdrawn_key() -> Status {
    let message = "the API key was withdrawn while the call lasted";
    refused(Code::Unauthenticated, "API_KEY_WITHDRAWN", message)
}

/// A call that the scope of its key does not allow.
pub fn scope_missing(needed: Scope) -> Status {
    let message = format!("the API key does not allow this call: it needs the scope {}", needed.name());
    let metadata = HashMap::from([("scope".to_owned(), needed.name().to_owned())]);
    status_with(Code::PermissionDenied, "SCOPE", metadata, message, ErrorDetails::new())
}

/// No such uploaded input, or another tenant's: a caller cannot tell them apart.
pub fn input_not_found(name: &InputName) -> Status {
    let mut details = ErrorDetails::new();
    details.set_resource_info("scpsfm.v1.Input", name.to_string(), "", "there is no such input");
    status(Code::NotFound, "INPUT_NOT_FOUND", format!("there is no input {name}"), details)
}

/// A chunk of an upload that is not what its sender computed the sum of.
pub fn chunk_corrupted(offset: u64, told: u32, found: u32) -> Status {
    let message = format!(
        "chunk.crc32c: the chunk at offset {offset} was damaged on its way: its CRC-32C is {found:08x}, not {told:08x}"
    );
    let metadata = HashMap::from([("offset".to_owned(), offset.to_string())]);
    status_with(Code::DataLoss, "CHUNK_CORRUPTED", metadata, message, ErrorDetails::new())
}

/// An upload whose bytes are others than those that were meant.
pub fn hash_mismatch(told: [u8; 32], found: [u8; 32]) -> Status {
    let (told, found) = (Sha256Digest(told), Sha256Digest(found));
    let message = format!("finish.sha256: the bytes have the SHA-256 {found}, not {told}; the upload is given up");
    refused(Code::DataLoss, "HASH_MISMATCH", message)
}

/// The calls under way hold as many bytes as they may, this one's included.
pub fn memory_full(max_bytes: u64) -> Status {
    let message = format!("the calls under way hold the {max_bytes} bytes that they may hold together; come back soon");
    status(Code::ResourceExhausted, "MEMORY", message, ErrorDetails::with_retry_info(Some(MEMORY_RETRY)))
}

/// Too many calls of a key, or jobs of a tenant, for their rate; `wait`: after which this one would pass.
pub fn rate_limited(bound: RateBound, wait: Duration) -> Status {
    let (name, key) = (bound.name(), bound.key());
    let message = format!("more {name} than {key} allows; come back in {:.3} s", wait.as_secs_f64());
    let metadata = HashMap::from([("bound".to_owned(), name.to_owned()), ("key".to_owned(), key.to_owned())]);
    status_with(Code::ResourceExhausted, "RATE_LIMITED", metadata, message, ErrorDetails::with_retry_info(Some(wait)))
}

/// The messages of a `Solve` or of an upload stopped coming.
pub fn input_stalled(timeout: Duration) -> Status {
    let message = format!("no message arrived for {} s and the input is not complete", timeout.as_secs());
    refused(Code::DeadlineExceeded, "INPUT_STALLED", message)
}

/// What the transport says of a message that it did not take, with a reason; `None` for any other status.
///
/// tonic has one code for a message that is too large as it comes and another for one that unpacks to too much, which
/// is the same to a caller; and it calls internal what the caller's bytes are to blame for.
pub fn from_transport(found: &Status) -> Option<Status> {
    let (code, reason) = match found.code() {
        Code::OutOfRange | Code::ResourceExhausted => (Code::OutOfRange, "MESSAGE_TOO_LARGE"),
        Code::Internal => (Code::InvalidArgument, "MALFORMED_MESSAGE"),
        _ => return None,
    };
    Some(refused(code, reason, found.message()))
}

/// A defect of ours. The caller gets no inside view; the log has it.
pub fn internal(error: &dyn std::fmt::Display) -> Status {
    tracing::error!(%error, "internal error");
    refused(Code::Internal, "INTERNAL", "internal error; the server's log has the cause")
}

impl From<engine::Error> for Status {
    /// What the engine refuses.
    fn from(error: engine::Error) -> Self {
        match error {
            engine::Error::Store(error) => of_store(error),
            engine::Error::JobTooLarge { oversize, .. } => too_large("JOB_TOO_LARGE", "job", &oversize),
            engine::Error::InvalidArgument(error) => invalid(error),
            engine::Error::NotReady(_) => refused(Code::FailedPrecondition, "RESULT_NOT_READY", error.to_string()),
            engine::Error::Draining => {
                let details = ErrorDetails::with_retry_info(Some(DRAINING_RETRY));
                status(Code::Unavailable, "DRAINING", "the server is draining; try another or come back", details)
            }
            engine::Error::Internal(error) => internal(&error),
        }
    }
}

/// The same of a batch: the refusal of one request names it.
pub fn of_batch(error: engine::Error) -> Status {
    match error {
        engine::Error::JobTooLarge { index, .. } => of_request(index, &error.into()),
        _ => error.into(),
    }
}

/// What the store refuses.
fn of_store(error: StoreError) -> Status {
    let told = |code, reason| refused(code, reason, error.to_string());
    match &error {
        StoreError::NotFound(name) => job_not_found(name),
        StoreError::InputNotFound(name) => input_not_found(name),
        StoreError::UploadNotFound(name) => {
            let message = format!("there is no upload {}: it was never begun, or was given up", name.input);
            refused(Code::NotFound, "UPLOAD_NOT_FOUND", message)
        }
        StoreError::UploadTakenOver(_) => told(Code::Aborted, "UPLOAD_TAKEN_OVER"),
        StoreError::UploadsFull(bound) => full("UPLOADS_FULL", bound, UPLOADS_RETRY),
        StoreError::QueueFull(bound) => full("QUEUE_FULL", bound, QUEUE_RETRY),
        StoreError::UploadTooLarge(oversize) => too_large("UPLOAD_TOO_LARGE", "start.size_bytes", oversize),
        StoreError::BatchTooLarge(oversize) => too_large("BATCH_TOO_LARGE", "requests", oversize),
        StoreError::AlreadyExists(TakenId::Job(_)) => told(Code::AlreadyExists, "JOB_ID_TAKEN"),
        StoreError::AlreadyExists(TakenId::Request(_)) => told(Code::AlreadyExists, "REQUEST_ID_REUSED"),
        StoreError::AlreadyExists(TakenId::Upload(..)) => told(Code::AlreadyExists, "UPLOAD_ID_REUSED"),
        StoreError::NotEnded(..) => told(Code::FailedPrecondition, "JOB_NOT_ENDED"),
        StoreError::Succeeded(_) => told(Code::FailedPrecondition, "JOB_SUCCEEDED"),
        StoreError::NotQueued(..) => told(Code::FailedPrecondition, "JOB_NOT_QUEUED"),
        StoreError::EtagMismatch(_) => told(Code::Aborted, "ETAG_MISMATCH"),
        StoreError::PageToken => violation("page_token", error.to_string()),
        StoreError::Unavailable(cause) => {
            // The cause names hosts and users: it is for the log.
            tracing::warn!(%cause, "the store is out of reach");
            let details = ErrorDetails::with_retry_info(Some(STORE_RETRY));
            status(Code::Unavailable, "STORE_UNAVAILABLE", "the store is out of reach; come back soon", details)
        }
        StoreError::NoSpace(cause) => {
            // The cause may name paths: it is for the log.
            tracing::error!(%cause, "no space is left for the store");
            let details = ErrorDetails::with_retry_info(Some(SPACE_RETRY));
            let message = "no space is left for the store: nothing was stored; whoever runs the server must make room";
            status(Code::ResourceExhausted, "STORE_FULL", message, details)
        }
        StoreError::Fenced(_) | StoreError::InUse(_) | StoreError::Corrupt(_) => internal(&error),
    }
}

/// A bound that refuses more for now.
fn full(reason: &str, bound: &Bound, retry: Duration) -> Status {
    let metadata = HashMap::from([("bound".to_owned(), bound.quota.name().to_owned())]);
    let details = ErrorDetails::with_retry_info(Some(retry));
    status_with(Code::ResourceExhausted, reason, metadata, bound.to_string(), details)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::Quota;
    use crate::domain::error::Violations;

    #[test]
    fn violations_are_all_in_the_details_and_some_in_the_message() {
        let mut found = Violations::default();
        for k in 0..30 {
            found.push(Violation::at("track_set.xs", k, "NaN is not a finite number"));
        }
        let status = invalid(found.into_result().expect_err("30 violations"));
        assert_eq!(status.code(), Code::InvalidArgument);
        assert!(status.message().starts_with("track_set.xs[0]: NaN is not a finite number; "), "{}", status.message());
        assert!(status.message().ends_with("; and 27 more like this"), "{}", status.message());
        let request = status.get_details_bad_request().expect("a BadRequest");
        assert_eq!(request.field_violations.len(), Violations::MAX_ALIKE);
        assert_eq!(request.field_violations[2].field, "track_set.xs[2]");
        let info = status.get_details_error_info().expect("an ErrorInfo");
        assert_eq!((info.reason.as_str(), info.domain.as_str()), ("INVALID_ARGUMENT", DOMAIN));
    }

    #[test]
    fn a_full_queue_says_when_to_come_back() {
        let bound = Bound { quota: Quota::Jobs, taken: 256, asked: 1, max: 256 };
        let status = Status::from(engine::Error::from(StoreError::QueueFull(bound)));
        assert_eq!(status.code(), Code::ResourceExhausted);
        let retry = status.get_details_retry_info().expect("a RetryInfo");
        assert_eq!(retry.retry_delay, Some(Duration::from_secs(3)));
        let info = status.get_details_error_info().expect("an ErrorInfo");
        assert_eq!((info.reason.as_str(), info.metadata["bound"].as_str()), ("QUEUE_FULL", "jobs"));
    }

    #[test]
    fn what_never_fits_is_no_matter_of_time() {
        let oversize = |quota| Oversize { quota, asked: 9, max: 8 };
        let of_batch =
            Quota::OF_QUEUE.map(|quota| (quota, StoreError::BatchTooLarge(oversize(quota)).into(), "requests"));
        let of_upload = [Quota::UploadBytes, Quota::TenantUploadBytes]
            .map(|quota| (quota, StoreError::UploadTooLarge(oversize(quota)).into(), "start.size_bytes"));
        let too_large = engine::Error::JobTooLarge { index: 0, oversize: oversize(Quota::SolverBytes) };
        let of_job = (Quota::SolverBytes, too_large, "job");
        for (quota, error, field) in of_batch.into_iter().chain(of_upload).chain([of_job]) {
            let status = Status::from(error);
            assert_eq!(status.code(), Code::InvalidArgument);
            assert!(status.get_details_retry_info().is_none(), "{status:?}");
            let (name, key) = (quota.name(), quota.key());
            assert!(status.message().contains(&format!("{key} is 8")), "{status}");
            let metadata = status.get_details_error_info().expect("an ErrorInfo").metadata;
            assert_eq!((metadata["bound"].as_str(), metadata["key"].as_str()), (name, key));
            assert_eq!((metadata["asked"].as_str(), metadata["max"].as_str()), ("9", "8"));
            let request = status.get_details_bad_request().expect("a BadRequest");
            assert_eq!(request.field_violations[0].field, field);
        }
    }

    #[test]
    fn a_store_that_is_away_is_worth_another_try_and_its_address_stays_inside() {
        let status = of_store(StoreError::Unavailable("no route to db.internal".into()));
        assert_eq!(status.code(), Code::Unavailable);
        assert!(!status.message().contains("db.internal"), "{}", status.message());
        assert!(status.get_details_retry_info().is_some_and(|retry| retry.retry_delay.is_some()));
        assert_eq!(status.get_details_error_info().expect("an ErrorInfo").reason, "STORE_UNAVAILABLE");
    }

    #[test]
    fn a_full_disk_is_told_and_its_path_stays_inside() {
        let status = of_store(StoreError::NoSpace("/srv/secret is full".into()));
        assert_eq!(status.code(), Code::ResourceExhausted);
        assert!(!status.message().contains("secret"), "{}", status.message());
        assert!(status.get_details_retry_info().is_some_and(|retry| retry.retry_delay.is_some()));
        assert_eq!(status.get_details_error_info().expect("an ErrorInfo").reason, "STORE_FULL");
    }

    #[test]
    fn a_page_token_of_another_query_names_its_field() {
        let status = of_store(StoreError::PageToken);
        assert_eq!(status.code(), Code::InvalidArgument);
        let request = status.get_details_bad_request().expect("a BadRequest");
        assert_eq!(request.field_violations[0].field, "page_token");
    }

    #[test]
    fn an_internal_error_keeps_its_cause_to_itself() {
        let status = internal(&"password is hunter2");
        assert!(!status.message().contains("hunter2"));
    }
}
