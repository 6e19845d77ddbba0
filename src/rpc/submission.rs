//! What `CreateJob` and `Solve` share: from a request to a job that the engine may store. Nothing is stored before
//! everything is checked.

use tonic::Status;

use super::caller::Caller;
use super::convert::create::{self, Description};
use super::convert::input::Draft;
use super::{proto, status};
use crate::domain::{InvalidInput, Limits};
use crate::engine::NewJob;
use crate::telemetry::metrics::{Refusal, refused};
use proto::create_job_request::Input as Inline;

/// A job whose input may still be on its way.
pub struct Submission {
    tenant: String,
    description: Description,
    draft: Draft,
}

impl Submission {
    /// Checks everything that a request holds but the input's numbers.
    ///
    /// # Errors
    /// `INVALID_ARGUMENT`, `NOT_FOUND` for another tenant, or `UNIMPLEMENTED` for an uploaded input.
    pub fn open(caller: &Caller, request: proto::CreateJobRequest, limits: &Limits) -> Result<Self, Status> {
        let tenant = caller.parent(&request.parent)?;
        if let Some(Inline::InputName(_)) = request.input {
            return Err(status::not_implemented("a job with an uploaded input (input_name)"));
        }
        let description =
            create::from_wire(request.job_id, request.request_id, request.job).map_err(|error| invalid(&error))?;
        let draft = Draft::begin(request.input, limits).map_err(|error| invalid(&error))?;
        let submission = Self { tenant, description, draft };
        submission.check_size()?;
        Ok(submission)
    }

    /// Adds one more message of a `Solve`.
    ///
    /// # Errors
    /// `INVALID_ARGUMENT` for a chunk of the wrong kind, a second config, or more than the limits allow.
    pub fn append(&mut self, message: proto::SolveRequest) -> Result<(), Status> {
        use proto::solve_request::Message;
        match message.message {
            Some(Message::TrackSetChunk(chunk)) => self.draft.append_track_set(chunk),
            Some(Message::MeasurementMatrixChunk(chunk)) => self.draft.append_matrix(chunk),
            Some(Message::Config(_)) => Err(super::violation("config", "comes once, in the first message")),
            None => Err(super::violation("message", "is not set")),
        }
        .map_err(|error| invalid(&error))?;
        self.check_size()
    }

    /// Checks the input and hands over the job.
    ///
    /// # Errors
    /// `INVALID_ARGUMENT` with every violation found.
    pub async fn close(self, trace_parent: Option<String>) -> Result<NewJob, Status> {
        let Self { tenant, description, draft } = self;
        // Sorting millions of observations takes a second: not on a thread that serves others.
        let input = super::blocking(move || draft.finish()).await?.map_err(|error| invalid(&error))?;
        let mut job = NewJob::new(tenant, input, description.settings);
        job.job_id = description.job_id;
        job.request_id = description.request_id;
        job.labels = description.labels;
        job.priority = description.priority;
        job.deadline = description.deadline;
        job.trace_parent = trace_parent;
        Ok(job)
    }

    fn check_size(&self) -> Result<(), Status> {
        self.draft.check_size().map_err(|error| {
            refused(Refusal::TooLarge);
            status::invalid(&error)
        })
    }
}

fn invalid(error: &InvalidInput) -> Status {
    refused(Refusal::Invalid);
    status::invalid(error)
}
