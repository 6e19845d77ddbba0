//! `JobService`: retries and priorities.

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

use scpsfm::domain::job::{JobEvent, JobName, JobState as DomainState};
use scpsfm::engine::Solver;
use scpsfm::rpc::proto::job_service_client::JobServiceClient;
use scpsfm::rpc::proto::{self, JobState};
use scpsfm::solver::Error;
use tonic::transport::Channel;
use tonic::{Code, Status};
use tonic_types::StatusExt;

use crate::support::live::{created, reaches};
use crate::support::server::{TestServer, soon};
use crate::support::solvers::{held, solution};
use crate::support::wire::{all, create_tracks, state_of};

/// Fails the first time, and answers from then on.
fn fails_once() -> Solver {
    let calls = AtomicU32::new(0);
    Arc::new(move |input, settings, _observer, _stop| match calls.fetch_add(1, Ordering::SeqCst) {
        0 => Err(Error::Internal("told to fail".into())),
        _ => Ok(solution(input, settings)),
    })
}

async fn retry(jobs: &mut JobServiceClient<Channel>, name: &str, etag: &str) -> Result<proto::Job, Status> {
    let request = proto::RetryJobRequest { name: name.into(), etag: etag.into() };
    jobs.retry_job(request).await.map(tonic::Response::into_inner)
}

fn reason(status: &Status) -> String {
    status.get_details_error_info().expect("an ErrorInfo").reason
}

/// Every event of a job that has ended.
async fn events(jobs: &mut JobServiceClient<Channel>, name: &str, after: u64) -> Vec<proto::JobEvent> {
    let request = proto::WatchJobRequest { name: name.into(), after_sequence: after };
    let watch = jobs.watch_job(request).await.expect("a watch").into_inner();
    let (events, end) = soon(all(watch)).await;
    end.expect("no error");
    events
}

#[tokio::test]
async fn a_job_that_failed_is_solved_at_the_second_try() {
    let server = TestServer::start(fails_once()).await;
    let mut jobs = server.jobs().await;
    let name = created(&mut jobs, create_tracks()).await;
    reaches(&mut jobs, &name, &[JobState::Failed]).await;
    let failed = jobs.get_job(proto::GetJobRequest { name: name.clone() }).await.expect("a job").into_inner();
    assert!(failed.error.is_some() && failed.end_time.is_some());
    let first = events(&mut jobs, &name, 0).await;
    assert_eq!(first.last().and_then(state_of), Some(JobState::Failed), "it ends with the job's end");

    let status = retry(&mut jobs, &name, "another").await.expect_err("another etag");
    assert_eq!((status.code(), reason(&status).as_str()), (Code::Aborted, "ETAG_MISMATCH"));
    let retried = retry(&mut jobs, &name, &failed.etag).await.expect("has failed");
    assert_eq!((retried.state(), retried.error, retried.end_time), (JobState::Queued, None, None));
    assert_eq!(retried.last_sequence, failed.last_sequence + 1);
    reaches(&mut jobs, &name, &[JobState::Succeeded]).await;

    let whole = events(&mut jobs, &name, 0).await;
    let numbers: Vec<u64> = whole.iter().map(|event| event.sequence).filter(|&number| number > 0).collect();
    assert_eq!(numbers, (1..=numbers.len() as u64).collect::<Vec<_>>());
    let states: Vec<_> = whole.iter().filter_map(state_of).collect();
    let run = [JobState::Queued, JobState::Running];
    assert_eq!(states, [run.as_slice(), &[JobState::Failed], &run, &[JobState::Succeeded]].concat());
    let rest = events(&mut jobs, &name, failed.last_sequence).await;
    assert_eq!(rest.first().and_then(state_of), Some(JobState::Queued), "new events follow the earlier end");
    jobs.get_job_result(proto::GetJobResultRequest { name: name.clone() }).await.expect("a result");

    // The client goes over the earlier end, too.
    let parsed = JobName::parse(&name).expect("a name");
    let mut ends = Vec::new();
    let mut on_event = |event: &JobEvent| {
        if let scpsfm::domain::job::EventBody::State { state, .. } = event.body {
            ends.extend(Some(state).filter(|state| state.is_terminal()));
        }
    };
    let last = soon(server.client().await.watch(&parsed, 0, &mut on_event)).await.expect("watched").expect("an event");
    scpsfm::client::ended(&last).expect("it succeeded");
    assert_eq!(ends, [DomainState::Failed, DomainState::Succeeded]);

    let status = retry(&mut jobs, &name, "").await.expect_err("has succeeded");
    assert_eq!((status.code(), reason(&status).as_str()), (Code::FailedPrecondition, "JOB_SUCCEEDED"));
    let status = retry(&mut jobs, "tenants/default/jobs/none", "").await.expect_err("is not there");
    assert_eq!(status.code(), Code::NotFound);
}

#[tokio::test]
async fn a_cancelled_job_is_retried_and_one_that_waits_or_runs_stays() {
    let (solver, hold) = held();
    let server = TestServer::start(solver).await;
    let mut jobs = server.jobs().await;
    let running = created(&mut jobs, create_tracks()).await;
    reaches(&mut jobs, &running, &[JobState::Running]).await;
    assert_eq!(retry(&mut jobs, &running, "").await.expect("answered").state(), JobState::Running);
    let waiting = created(&mut jobs, create_tracks()).await;
    let before = jobs.get_job(proto::GetJobRequest { name: waiting.clone() }).await.expect("a job").into_inner();
    assert_eq!(retry(&mut jobs, &waiting, "").await.expect("answered"), before);
    jobs.cancel_job(proto::CancelJobRequest { name: waiting.clone(), ..Default::default() }).await.expect("ends");
    let retried = retry(&mut jobs, &waiting, "").await.expect("was cancelled");
    assert_eq!((retried.state(), retried.last_sequence), (JobState::Queued, 3));
    assert_eq!(retry(&mut jobs, &waiting, "").await.expect("answered"), retried, "safe to repeat");
    hold.let_go();
    reaches(&mut jobs, &waiting, &[JobState::Succeeded]).await;
}

#[tokio::test]
async fn the_priority_of_a_waiting_job_can_be_changed() {
    let (solver, hold) = held();
    let server = TestServer::start(solver).await;
    let mut jobs = server.jobs().await;
    let running = created(&mut jobs, create_tracks()).await;
    reaches(&mut jobs, &running, &[JobState::Running]).await;
    let waiting = created(&mut jobs, create_tracks()).await;
    let mut set = async |name: &str, priority: Option<i32>, etag: &str| {
        let request = proto::SetJobPriorityRequest { name: name.into(), priority, etag: etag.into() };
        jobs.set_job_priority(request).await.map(tonic::Response::into_inner)
    };
    let first = set(&waiting, Some(7), "").await.expect("it waits");
    assert_eq!((first.priority, first.state()), (7, JobState::Queued));
    let second = set(&waiting, Some(-7), &first.etag).await.expect("as it was seen");
    assert_ne!(second.etag, first.etag);
    let status = set(&waiting, Some(1), &first.etag).await.expect_err("has changed");
    assert_eq!(reason(&status), "ETAG_MISMATCH");
    for refused in [Some(1_001), None] {
        let status = set(&waiting, refused, "").await.expect_err("out of range, or not set");
        let violations = status.get_details_bad_request().expect("fields").field_violations;
        assert_eq!((status.code(), violations[0].field.as_str()), (Code::InvalidArgument, "priority"), "{refused:?}");
    }
    assert_eq!(set(&waiting, Some(0), "").await.expect("0 is a priority").priority, 0);
    let status = set(&running, Some(1), "").await.expect_err("it runs");
    assert_eq!((status.code(), reason(&status).as_str()), (Code::FailedPrecondition, "JOB_NOT_QUEUED"));
    hold.let_go();
}
