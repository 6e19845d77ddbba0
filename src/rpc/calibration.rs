//! `CalibrationService`.

use std::pin::Pin;

use tokio_stream::{Stream, StreamExt};
use tonic::{Request, Response, Status, Streaming};
use tracing::Instrument;

use super::caller::Caller;
use super::convert::enums::Twin;
use super::convert::{count_to_wire, job, settings, size_to_wire};
use super::disconnect::DisconnectTracker;
use super::inflight::Permit;
use super::inputs::MAX_CHUNK_BYTES;
use super::jobs::MAX_BATCH;
use super::server::Options;
use super::submission::{self, Submission};
use super::{proto, status};
use crate::domain::job::EventBody;
use crate::domain::{Backend, Limits, Method, SolveSettings};
use crate::engine::{self, Engine, QueueBounds, UploadOptions};
use crate::{solver, telemetry};

/// The service.
#[derive(Clone)]
pub struct Calibration {
    engine: Engine,
    limits: Limits,
    max_message_bytes: usize,
    max_connections: usize,
    disconnects: DisconnectTracker,
}

impl Calibration {
    /// Of a server with these options.
    pub fn new(engine: Engine, options: &Options) -> Self {
        let &Options { max_message_bytes, max_connections, solve_grace, .. } = options;
        let disconnects = DisconnectTracker::new(engine.clone(), solve_grace);
        Self { engine, limits: options.limits.clone(), max_message_bytes, max_connections, disconnects }
    }

    /// Reads the whole of a stream.
    async fn receive(
        &self,
        caller: &Caller,
        permit: &Permit,
        mut messages: Streaming<proto::SolveRequest>,
    ) -> Result<Submission, Status> {
        let Some(proto::SolveRequest { message: Some(proto::solve_request::Message::Config(config)) }) =
            submission::next(&mut messages, permit).await?
        else {
            return Err(status::violation("config", "is not the first message"));
        };
        let mut submission = Submission::open(caller, config, &self.limits, permit)?;
        while let Some(message) = submission::next(&mut messages, permit).await? {
            submission.append(message)?;
        }
        Ok(submission)
    }
}

fn upload_limits(options: &UploadOptions) -> proto::UploadLimits {
    proto::UploadLimits {
        max_upload_bytes: size_to_wire(options.bounds.max_bytes),
        max_chunk_bytes: size_to_wire(MAX_CHUNK_BYTES as u64),
        max_tenant_uploads: count_to_wire(options.bounds.max_tenant_uploads),
        max_tenant_bytes: size_to_wire(options.bounds.max_tenant_bytes),
        abandoned_after: options.abandoned_after.and_then(|kept| kept.try_into().ok()),
    }
}

fn queue_limits(bounds: &QueueBounds) -> proto::QueueLimits {
    let given = |bound: u64| (bound < u64::MAX).then_some(bound);
    proto::QueueLimits {
        max_jobs: count_to_wire(bounds.max_jobs),
        max_bytes: size_to_wire(bounds.max_bytes),
        max_observations: bounds.max_observations,
        max_tenant_jobs: given(bounds.max_tenant_jobs).map(count_to_wire),
        max_tenant_bytes: given(bounds.max_tenant_bytes).map(size_to_wire),
    }
}

#[tonic::async_trait]
impl proto::calibration_service_server::CalibrationService for Calibration {
    type SolveStream = Pin<Box<dyn Stream<Item = Result<proto::JobEvent, Status>> + Send>>;

    async fn solve(
        &self,
        request: Request<Streaming<proto::SolveRequest>>,
    ) -> Result<Response<Self::SolveStream>, Status> {
        let caller = Caller::of(&request)?;
        caller.count_jobs(1)?;
        let span = telemetry::tracing::submit_span("Solve", caller.trace_parent());
        let accepted = async {
            let permit = Permit::of(&request)?;
            let submission = self.receive(&caller, &permit, request.into_inner()).await?;
            let trace_parent = telemetry::tracing::traceparent_to_store(&span, caller.trace_parent());
            let new = submission.close(trace_parent).await?;
            let new = engine::NewJob { cancel_on_disconnect: true, ..new };
            let disconnects = self.disconnects.clone();
            // If this call is dropped while the job is being stored, it attaches all the same, and detaches when what
            // it attached by is dropped.
            let attach = move |job| disconnects.attached(job);
            let call = submission::store_one(&caller, "Solve", &self.engine, new, permit, attach).await?;
            telemetry::tracing::record_job(&span, call.job());
            Ok::<_, Status>(call)
        };
        let mut call = accepted.instrument(span.clone()).await?;
        let watch = call.watch().await?;
        let watching = telemetry::metrics::watcher();
        let events = watch.into_stream().map(move |event| {
            let _ = &watching;
            match &event {
                Ok(event) if matches!(event.body, EventBody::State { state, .. } if state.is_terminal()) => {
                    call.job_ended();
                }
                Err(_) => call.failed(),
                _ => {}
            }
            event.map(job::event_to_wire).map_err(Status::from)
        });
        Ok(Response::new(Box::pin(events)))
    }

    async fn get_capabilities(
        &self,
        _request: Request<proto::GetCapabilitiesRequest>,
    ) -> Result<Response<proto::Capabilities>, Status> {
        let options = self.engine.options();
        let count = |limit: usize| count_to_wire(limit as u64);
        Ok(Response::new(proto::Capabilities {
            server_version: env!("CARGO_PKG_VERSION").to_owned(),
            input_limits: Some(proto::InputLimits {
                max_views: count(self.limits.max_views),
                max_tracks: count(self.limits.max_tracks),
                max_observations: count(self.limits.max_observations),
                max_message_bytes: size_to_wire(self.max_message_bytes as u64),
            }),
            methods: Method::ALL.map(Twin::to_wire).to_vec(),
            backends: [Backend::Flex, Backend::Ndarray].map(Twin::to_wire).to_vec(),
            default_settings: Some(settings::to_wire(&SolveSettings::default())),
            retention: options.retention.and_then(|kept| kept.try_into().ok()),
            max_batch_requests: count(MAX_BATCH),
            queue_limits: Some(queue_limits(&options.queue)),
            upload_limits: Some(upload_limits(&options.uploads)),
            trained_network_sha256: solver::trained_network_sha256().0.to_vec(),
            max_connections: count(self.max_connections),
        }))
    }
}
