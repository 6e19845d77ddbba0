//! Several jobs in one call, all or none.

use prost::Message;

use super::backoff::Backoff;
use super::jobs::{BESIDE_BYTES, JobOptions, create_request};
use super::{Client, Error, JobInput};
use crate::domain::job::Job;
use crate::domain::{SolveSettings, Violation};
use crate::rpc::{convert, proto};

impl Client {
    /// Creates a job of each input, in their order, all of them or none. Inputs that no longer fit into the message are
    /// uploaded first, as by [`create`](Self::create).
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
        let inputs: Vec<JobInput> = inputs.into_iter().collect();
        let mut requests = Vec::new();
        for number in 1..=inputs.len() {
            let request_id = options.request_id.as_ref().map(|id| format!("{id}-{number}"));
            requests.push(create_request(self.parent(), settings, JobOptions { request_id, ..options.clone() }));
        }
        let beside = requests.iter().map(|request| request.encoded_len() + BESIDE_BYTES).sum();
        let mut room = self.room_for_inputs(beside, inputs.iter().map(JobInput::encoded_len).sum()).await?;
        for (index, (input, request)) in inputs.into_iter().zip(&mut requests).enumerate() {
            let source = self.source(input, &mut room).await;
            request.source = Some(source.map_err(|error| of_request(error, index))?);
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

/// The error of an upload, which names its request as those of the call itself do.
fn of_request(mut error: Error, index: usize) -> Error {
    error.message.insert_str(0, &format!("requests[{index}]: "));
    for Violation { field, .. } in &mut error.violations {
        *field = format!("requests[{index}].{field}");
    }
    error
}
