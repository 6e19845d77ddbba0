//! Several jobs in one call, all or none.

use super::backoff::Backoff;
use super::jobs::{JobOptions, MAX_INLINE_BYTES, create_request};
use super::{Client, Error, JobInput};
use crate::domain::job::Job;
use crate::domain::{SolveSettings, Violation};
use crate::rpc::{convert, proto};

impl Client {
    /// Creates a job of each input, in their order, all of them or none. What together is too large for a call is
    /// [uploaded](Self::upload) first.
    ///
    /// A request id that is given stands, with the number of the job after it, for each of them.
    ///
    /// # Errors
    /// See [`Error`]; its fields begin with the number of the request that is refused, as `requests[3].track_set.xs`.
    pub async fn create_batch(
        &mut self,
        inputs: impl IntoIterator<Item = JobInput>,
        settings: &SolveSettings,
        options: &JobOptions,
    ) -> Result<Vec<Job>, Error> {
        let (mut requests, mut room) = (Vec::new(), MAX_INLINE_BYTES);
        for (index, input) in inputs.into_iter().enumerate() {
            let source = self.source(input, &mut room).await.map_err(|error| of_request(error, index))?;
            let request_id = options.request_id.as_ref().map(|id| format!("{id}-{}", index + 1));
            let options = JobOptions { request_id, ..options.clone() };
            requests.push(create_request(self.parent(), source, settings, options));
        }
        let request = proto::BatchCreateJobsRequest { parent: self.parent(), requests };
        let mut backoff = Backoff::default();
        loop {
            // Each request has an id: what was stored by a call whose answer was lost is answered again.
            match backoff.within(self.jobs.batch_create_jobs(request.clone())).await {
                Ok(created) => {
                    let jobs = created.into_inner().jobs.into_iter().map(convert::job::from_wire);
                    return Ok(jobs.collect::<Result<_, _>>()?);
                }
                Err(status) => self.pause_to_store(&mut backoff, status).await?,
            }
        }
    }
}

/// The error of an upload, whose fields name its request as those of the call itself do.
fn of_request(mut error: Error, index: usize) -> Error {
    for Violation { field, .. } in &mut error.violations {
        *field = format!("requests[{index}].{field}");
    }
    error
}
