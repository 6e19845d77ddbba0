//! What `CreateJob` and `Solve` share: from a request to a job that the engine may store. Nothing is stored before
//! everything is checked, and its memory is charged to the call's permit.

use std::time::Duration;

use tonic::{Status, Streaming};
use tracing::Instrument;

use super::caller::Caller;
use super::convert::create;
use super::convert::input::{Draft, OBSERVATION_BYTES, field_of};
use super::inflight::{Permit, WORKING_COPIES};
use super::{proto, status};
use crate::domain::job::Job;
use crate::domain::{FEW_OBSERVATIONS, InputName, InvalidInput, Limits, Violation};
use crate::engine::{self, Engine, JobDescription, JobInput, NewJob};
use crate::telemetry::metrics::{Refusal, refused};
use proto::create_job_request::Source as Inline;
use proto::input_data::Data;
use proto::solve_request::Message;

/// How long a stream may be silent before its input is complete. A dead connection is found by keep-alive long before;
/// this is for a caller that lives and forgets.
const MESSAGE_TIMEOUT: Duration = Duration::from_secs(60);

/// A job whose input may still be on its way.
pub struct Submission {
    tenant: String,
    description: JobDescription,
    input: Source,
    permit: Permit,
    /// What the permit is charged for the input.
    charged_bytes: u64,
}

/// Where the input comes from.
enum Source {
    Draft(Draft),
    Uploaded(InputName),
}

impl Submission {
    /// Checks everything that a request holds but the input's numbers.
    ///
    /// # Errors
    /// `INVALID_ARGUMENT`, `NOT_FOUND` for another tenant, or for an uploaded input of another tenant;
    /// `RESOURCE_EXHAUSTED` for want of memory.
    pub fn open(
        caller: &Caller,
        request: proto::CreateJobRequest,
        limits: &Limits,
        permit: &Permit,
    ) -> Result<Self, Status> {
        let tenant = caller.parent(&request.parent)?;
        let description = create::from_wire(request.job_id, request.request_id, request.job).map_err(invalid)?;
        let draft = |data| Draft::begin(data, limits).map(Source::Draft).map_err(invalid);
        let input = match request.source {
            Some(Inline::Input(name)) => Source::Uploaded(caller.input(&name, "input")?),
            Some(Inline::TrackSet(set)) => draft(Some(Data::TrackSet(set)))?,
            Some(Inline::MeasurementMatrix(matrix)) => draft(Some(Data::MeasurementMatrix(matrix)))?,
            Some(Inline::MatchSet(set)) => draft(Some(Data::MatchSet(set)))?,
            None => draft(None)?,
        };
        let permit = permit.clone();
        let mut submission = Self { tenant, description, input, permit, charged_bytes: 0 };
        submission.check_size()?;
        submission.charge(1)?;
        Ok(submission)
    }

    /// Adds one more message of a `Solve`.
    ///
    /// # Errors
    /// `INVALID_ARGUMENT` for a chunk of the wrong kind, a second config, or more than the limits allow;
    /// `RESOURCE_EXHAUSTED` for want of memory.
    pub fn append(&mut self, message: proto::SolveRequest) -> Result<(), Status> {
        match (message.message, &mut self.input) {
            (Some(Message::Config(_)), _) => Err(Violation::of("config", "comes once, in the first message").into()),
            (None, _) => Err(Violation::of("message", "is not set").into()),
            (Some(chunk), Source::Draft(draft)) => draft.append(chunk),
            (Some(chunk), Source::Uploaded(_)) => {
                Err(Violation::of(field_of(&chunk), "the config names an uploaded input").into())
            }
        }
        .map_err(invalid)?;
        self.check_size()?;
        self.charge(1)
    }

    /// Checks the input and hands over the job.
    ///
    /// # Errors
    /// `INVALID_ARGUMENT` with every violation found; `RESOURCE_EXHAUSTED` for want of memory.
    pub async fn close(mut self, trace_parent: Option<String>) -> Result<NewJob, Status> {
        self.charge(WORKING_COPIES)?;
        let Self { tenant, description, input, permit, .. } = self;
        let input = match input {
            Source::Uploaded(name) => JobInput::Uploaded(name),
            Source::Draft(draft) => {
                let is_small = draft.bytes() <= u64::from(FEW_OBSERVATIONS) * OBSERVATION_BYTES;
                let finish = move || {
                    // Held here as well: what computes goes on when the call is dropped.
                    let _permit = permit;
                    draft.finish()
                };
                let checked = if is_small {
                    // A batch has a thousand of these: others have their turn now and then.
                    tokio::task::consume_budget().await;
                    finish()
                } else {
                    // Sorting millions of observations takes a second: not on a thread that serves others.
                    super::blocking(finish).await?
                };
                JobInput::Inline(checked.map_err(invalid)?)
            }
        };
        Ok(NewJob { tenant, description, input, trace_parent, cancel_on_disconnect: false })
    }

    /// Charges that many copies of the input.
    fn charge(&mut self, copies: u64) -> Result<(), Status> {
        let Source::Draft(draft) = &self.input else { return Ok(()) };
        let bytes = copies * draft.bytes();
        self.permit.hold_more(bytes.saturating_sub(self.charged_bytes))?;
        self.charged_bytes = self.charged_bytes.max(bytes);
        Ok(())
    }

    fn check_size(&self) -> Result<(), Status> {
        let Source::Draft(draft) = &self.input else { return Ok(()) };
        draft.check_size().map_err(|error| {
            refused(Refusal::TooLarge);
            status::invalid(error)
        })
    }
}

/// Has jobs stored, and writes it into the audit log. In a task of its own, which holds what they take until they are,
/// or are refused: a call that is dropped meanwhile ends neither.
///
/// * `refusal`: what a refusal of the engine is to the caller
/// * `then`: what becomes of the stored jobs, also of those whose call was dropped
///
/// # Errors
/// As [`Engine::submit_batch`].
pub async fn store<T: Send + 'static>(
    caller: &Caller,
    method: &'static str,
    engine: &Engine,
    news: Vec<NewJob>,
    permit: Permit,
    refusal: fn(engine::Error) -> Status,
    then: impl FnOnce(Vec<Job>) -> T + Send + 'static,
) -> Result<T, Status> {
    let (caller, engine) = (caller.clone(), engine.clone());
    let storing = async move {
        let _permit = permit;
        let stored = engine.submit_batch(news).await.map_err(refusal);
        caller.audit_jobs(method, stored.as_deref());
        stored.map(then)
    };
    tokio::spawn(storing.in_current_span()).await.map_err(|error| status::internal(&error))?
}

/// The same of one job.
///
/// # Errors
/// As [`store`].
pub async fn store_one<T: Send + 'static>(
    caller: &Caller,
    method: &'static str,
    engine: &Engine,
    new: NewJob,
    permit: Permit,
    then: impl FnOnce(Job) -> T + Send + 'static,
) -> Result<T, Status> {
    let first = |jobs: Vec<Job>| jobs.into_iter().next().map(then);
    let stored = store(caller, method, engine, vec![new], permit, Status::from, first).await?;
    stored.ok_or_else(|| status::internal(&"one job was to be stored, none was"))
}

/// The next message of a stream that brings an input; the permit then counts a new message.
///
/// # Errors
/// `DEADLINE_EXCEEDED` where none comes.
pub async fn next<T>(messages: &mut Streaming<T>, permit: &Permit) -> Result<Option<T>, Status> {
    let Ok(message) = tokio::time::timeout(MESSAGE_TIMEOUT, messages.message()).await else {
        return Err(status::input_stalled(MESSAGE_TIMEOUT));
    };
    let message = message?;
    permit.next_message();
    Ok(message)
}

fn invalid(error: InvalidInput) -> Status {
    refused(Refusal::Invalid);
    status::invalid(error)
}
