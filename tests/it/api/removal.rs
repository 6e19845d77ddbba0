//! `JobService`: deletion, retention, etags, batches.

use std::time::Duration;

use scpsfm::domain::Limits;
use scpsfm::engine;
use scpsfm::rpc::proto::job_service_client::JobServiceClient;
use scpsfm::rpc::proto::{self, JobState, create_job_request};
use scpsfm::rpc::server::Options;
use tonic::transport::Channel;
use tonic::{Code, Status};
use tonic_types::StatusExt;

use crate::support::live::{created, reaches};
use crate::support::server::{TestServer, one_worker, soon};
use crate::support::solvers::{held, quick};
use crate::support::wire::create_tracks;

type Jobs = JobServiceClient<Channel>;

async fn delete(jobs: &mut Jobs, name: &str, etag: &str) -> Result<(), Status> {
    let request = proto::DeleteJobRequest { name: name.into(), etag: etag.into() };
    jobs.delete_job(request).await.map(|answer| answer.into_inner())
}

async fn get(jobs: &mut Jobs, name: &str) -> Result<proto::Job, Status> {
    jobs.get_job(proto::GetJobRequest { name: name.into() }).await.map(|answer| answer.into_inner())
}

fn reason(status: &Status) -> String {
    status.get_details_error_info().expect("an ErrorInfo").reason
}

async fn listed(jobs: &mut Jobs) -> usize {
    let request = proto::ListJobsRequest { parent: "tenants/default".into(), ..Default::default() };
    jobs.list_jobs(request).await.expect("a page").into_inner().jobs.len()
}

#[tokio::test]
async fn only_an_ended_job_is_deleted_and_only_as_it_was_seen() {
    let (solver, hold) = held();
    let server = TestServer::start(solver).await;
    let mut jobs = server.jobs().await;
    let name = created(&mut jobs, create_tracks()).await;
    let queued = created(&mut jobs, create_tracks()).await;
    reaches(&mut jobs, &name, &[JobState::Running]).await;
    for unfinished in [&name, &queued] {
        let status = delete(&mut jobs, unfinished, "").await.expect_err("has not ended");
        assert_eq!((status.code(), reason(&status).as_str()), (Code::FailedPrecondition, "JOB_NOT_ENDED"));
    }
    let seen = get(&mut jobs, &name).await.expect("a job");
    assert_eq!(seen.expire_time, None, "it has not ended");
    hold.let_go();
    reaches(&mut jobs, &name, &[JobState::Succeeded]).await;
    let status = delete(&mut jobs, &name, &seen.etag).await.expect_err("has changed");
    assert_eq!((status.code(), reason(&status).as_str()), (Code::Aborted, "ETAG_MISMATCH"));
    let cancel = proto::CancelJobRequest { name: name.clone(), etag: seen.etag };
    assert_eq!(jobs.cancel_job(cancel).await.expect_err("has changed").code(), Code::Aborted);
    let ended = get(&mut jobs, &name).await.expect("a job");
    let seconds = |time: Option<prost_types::Timestamp>| time.expect("a time").seconds;
    assert_eq!(seconds(ended.expire_time) - seconds(ended.end_time), 30 * 24 * 60 * 60);
    delete(&mut jobs, &name, &ended.etag).await.expect("is as it was seen");
    for status in [get(&mut jobs, &name).await.map(drop), delete(&mut jobs, &name, "").await] {
        assert_eq!(status.expect_err("is gone").code(), Code::NotFound);
    }
    let read = proto::ReadJobResultRequest { name, offset: 0 };
    assert_eq!(jobs.read_job_result(read).await.expect_err("is gone").code(), Code::NotFound);
}

#[tokio::test]
async fn what_was_kept_long_enough_goes_by_itself() {
    let engine = engine::Options { retention: Some(Duration::ZERO), ..one_worker() };
    let server = TestServer::start_with(quick(), Options::default(), engine).await;
    let mut jobs = server.jobs().await;
    created(&mut jobs, create_tracks()).await;
    let gone = async {
        while listed(&mut jobs).await > 0 {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    soon(gone).await;
    let capabilities = server.calibration().await.get_capabilities(proto::GetCapabilitiesRequest {}).await;
    let capabilities = capabilities.expect("capabilities").into_inner();
    assert_eq!(capabilities.retention, Some(prost_types::Duration::default()));
    assert_eq!(capabilities.max_batch_requests, 1000);
    let queue = capabilities.queue_limits.expect("limits");
    assert_eq!((queue.max_jobs, queue.max_tenant_jobs, queue.max_tenant_bytes), (256, None, None));
}

#[tokio::test]
async fn a_batch_is_all_or_none_and_names_what_is_wrong() {
    let (solver, _hold) = held();
    let limits = Limits { max_views: 3, ..Limits::default() };
    let server = TestServer::start_with(solver, Options { limits, ..Options::default() }, one_worker()).await;
    let mut jobs = server.jobs().await;
    let named = |id: &str| proto::CreateJobRequest { job_id: id.into(), request_id: id.into(), ..create_tracks() };
    let batch = |requests: Vec<_>| proto::BatchCreateJobsRequest { parent: "tenants/default".into(), requests };
    let field = |status: &Status| status.get_details_bad_request().expect("fields").field_violations[0].field.clone();

    let mut bad = named("b");
    let Some(create_job_request::Source::TrackSet(tracks)) = &mut bad.source else { panic!("not a track set") };
    tracks.xs[5] = f64::NAN;
    let status = jobs.batch_create_jobs(batch(vec![named("a"), bad])).await.expect_err("a NaN");
    assert_eq!((status.code(), field(&status).as_str()), (Code::InvalidArgument, "requests[1].track_set.xs[5]"));
    assert!(status.message().starts_with("requests[1]: "), "{}", status.message());
    let foreign = proto::CreateJobRequest { parent: "tenants/other".into(), ..named("b") };
    let status = jobs.batch_create_jobs(batch(vec![foreign])).await.expect_err("another parent");
    assert_eq!(field(&status), "requests[0].parent");
    for wrong in [vec![], vec![proto::CreateJobRequest::default(); 1001]] {
        let status = jobs.batch_create_jobs(batch(wrong)).await.expect_err("too few, too many");
        assert_eq!((status.code(), field(&status).as_str()), (Code::InvalidArgument, "requests"));
    }
    assert_eq!(listed(&mut jobs).await, 0, "nothing was stored");

    let inherits = proto::CreateJobRequest { parent: String::new(), ..named("b") };
    for _ in 0..2 {
        let answer = jobs.batch_create_jobs(batch(vec![named("a"), inherits.clone()])).await.expect("stored");
        let names: Vec<_> = answer.into_inner().jobs.into_iter().map(|job| job.name).collect();
        assert_eq!(names, ["tenants/default/jobs/a", "tenants/default/jobs/b"]);
    }
    let taken = proto::CreateJobRequest { request_id: "r".into(), ..named("a") };
    let status = jobs.batch_create_jobs(batch(vec![named("c"), taken])).await.expect_err("a taken id");
    assert_eq!(status.code(), Code::AlreadyExists);
    assert_eq!(listed(&mut jobs).await, 2);
}
