//! Several jobs in one call, all or none.

use super::backoff::Backoff;
use super::jobs::{JobOptions, create_request};
use super::{Client, Error};
use crate::domain::job::Job;
use crate::domain::{InputName, RawInput, SolveSettings};
use crate::rpc::convert;
use crate::rpc::proto::{self, create_job_request::Source as JobInput};

impl Client {
    /// Creates a job of each input, then of each that was uploaded; in that order, all of them or none.
    ///
    /// A request id that is given stands, with the number of the job after it, for each of them.
    ///
    /// # Errors
    /// See [`Error`]; its fields begin with the number of the request that is refused, as `requests[3].track_set.xs`.
    pub async fn create_batch(
        &mut self,
        inputs: impl Iterator<Item = &RawInput>,
        uploaded: &[InputName],
        settings: &SolveSettings,
        options: &JobOptions,
    ) -> Result<Vec<Job>, Error> {
        let inline = inputs.map(|input| JobInput::TrackSet(convert::input::to_wire(input.clone())));
        let named = uploaded.iter().map(|name| JobInput::Input(name.to_string()));
        let requests = (1..).zip(inline.chain(named)).map(|(number, input)| {
            let request_id = options.request_id.as_ref().map(|id| format!("{id}-{number}"));
            create_request(self.parent(), input, settings, JobOptions { request_id, ..options.clone() })
        });
        let request = proto::BatchCreateJobsRequest { parent: self.parent(), requests: requests.collect() };
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
