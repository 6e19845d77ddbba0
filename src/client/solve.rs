//! One job from its input to its result, over one connection after another.

use std::time::Duration;

use tokio::time::timeout;
use tokio_util::sync::CancellationToken;
use tonic::Request;

use super::backoff::Backoff;
use super::jobs::{EventFollower, JobOptions, create_request, ended};
use super::{Client, Error, InputData};
use crate::domain::job::JobEvent;
use crate::domain::{Solution, SolveSettings};
use crate::rpc::proto;

/// How long a solve that is stopped waits until the server takes its cancel. The server cancels the job by itself soon
/// after the stream is gone.
const CANCEL_WAIT: Duration = Duration::from_secs(3);

impl Client {
    /// Creates a job, follows it to its end and reads its result. When `stop` is cancelled, so is the job.
    ///
    /// # Errors
    /// See [`Error`]; a job that ended without a result is an error here.
    pub async fn solve(
        &mut self,
        input: impl Into<InputData>,
        settings: &SolveSettings,
        on_event: &mut (dyn FnMut(&JobEvent) + Send),
        stop: CancellationToken,
    ) -> Result<Solution, Error> {
        let input = input.into();
        let mut name = None;
        let mut on_named_event = |event: &JobEvent| {
            name.get_or_insert_with(|| event.job.clone());
            on_event(event);
        };
        let mut solving = self.clone();
        let last = tokio::select! {
            last = solving.follow_solve(&input, settings, &mut on_named_event) => last?,
            () = stop.cancelled() => {
                if let Some(name) = &name
                    && let Ok(cancelled) = timeout(CANCEL_WAIT, self.cancel(name)).await
                {
                    cancelled?;
                }
                return Err(Error::cancelled());
            }
        };
        ended(&last)?;
        self.read_result(&last.job).await
    }

    /// A broken call is made again under the same request id: it takes up the job within the server's grace period, and
    /// tells its events anew, of which only new ones are passed on.
    async fn follow_solve(
        &mut self,
        input: &InputData,
        settings: &SolveSettings,
        on_event: &mut (dyn FnMut(&JobEvent) + Send),
    ) -> Result<JobEvent, Error> {
        let request = create_request(self.parent(), settings, JobOptions::default());
        let config = proto::CreateJobRequest { source: Some(input.head()), ..request };
        let mut follower = EventFollower { last_sequence: 0, on_event };
        let mut backoff = Backoff::default();
        loop {
            use proto::solve_request::Message;
            let messages = std::iter::once(Message::Config(config.clone())).chain(input.chunks());
            let messages = messages.map(|message| proto::SolveRequest { message: Some(message) });
            let outcome = match self.calibration.solve(Request::new(tokio_stream::iter(messages))).await {
                Ok(events) => follower.follow(events.into_inner(), &mut backoff).await?,
                Err(status) => Err(status),
            };
            match outcome {
                Ok(Some(last)) => return Ok(last),
                Ok(None) => return Err(Error::failed("the server ended a solve without its last event")),
                Err(status) => self.pause(&mut backoff, status).await?,
            }
        }
    }
}
