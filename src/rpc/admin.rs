//! `AdminService`. Who may call it is decided before, by the scope of the key.

use tonic::{Request, Response, Status};

use super::caller::Caller;
use super::convert::count_to_wire;
use super::convert::enums::Twin;
use super::proto;
use crate::engine::{Engine, QueueReport, TenantQueue};

/// Tenants that GetQueue lists, as the API says: those with most jobs.
const MAX_TENANTS: u32 = 20;

/// The service.
#[derive(Clone)]
pub struct Admin {
    engine: Engine,
}

impl Admin {
    pub fn new(engine: Engine) -> Self {
        Self { engine }
    }

    async fn queue(&self) -> Result<Response<proto::Queue>, Status> {
        let report = self.engine.queue(MAX_TENANTS).await?;
        Ok(Response::new(to_wire(report)))
    }
}

#[tonic::async_trait]
impl proto::admin_service_server::AdminService for Admin {
    async fn get_queue(&self, _request: Request<proto::GetQueueRequest>) -> Result<Response<proto::Queue>, Status> {
        self.queue().await
    }

    async fn pause_queue(&self, request: Request<proto::PauseQueueRequest>) -> Result<Response<proto::Queue>, Status> {
        let (caller, engine) = (Caller::of(&request)?, self.engine.clone());
        let work = async move { engine.set_paused(true).await };
        caller.audited("PauseQueue", "queue", work).await?;
        self.queue().await
    }

    async fn resume_queue(
        &self,
        request: Request<proto::ResumeQueueRequest>,
    ) -> Result<Response<proto::Queue>, Status> {
        let (caller, engine) = (Caller::of(&request)?, self.engine.clone());
        let work = async move { engine.set_paused(false).await };
        caller.audited("ResumeQueue", "queue", work).await?;
        self.queue().await
    }

    async fn drain_server(
        &self,
        request: Request<proto::DrainServerRequest>,
    ) -> Result<Response<proto::DrainServerResponse>, Status> {
        let server = self.engine.options().worker_name.clone();
        Caller::of(&request)?.audit("DrainServer", &server, &Ok(()));
        self.engine.ask_for_drain();
        Ok(Response::new(proto::DrainServerResponse { server }))
    }
}

fn to_wire(report: QueueReport) -> proto::Queue {
    let (oldest_job, oldest_queue_time) = report.oldest.unzip();
    let tenant = |of: TenantQueue| proto::TenantQueue {
        tenant: format!("tenants/{}", of.tenant),
        queued_job_count: count_to_wire(of.queued),
        running_job_count: count_to_wire(of.running),
    };
    proto::Queue {
        paused: report.pause_time.is_some(),
        pause_time: report.pause_time.map(Into::into),
        job_counts: report
            .jobs
            .iter()
            .map(|&(state, jobs)| proto::JobCount { state: state.to_wire(), count: count_to_wire(jobs) })
            .collect(),
        oldest_job: oldest_job.map(|name| name.to_string()).unwrap_or_default(),
        oldest_queue_time: oldest_queue_time.map(Into::into),
        tenants: report.tenants.into_iter().map(tenant).collect(),
    }
}
