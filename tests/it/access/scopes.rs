//! Scopes: what a key of each allows, and what an administrator reaches.

use scpsfm::rpc::keys::Sources;
use scpsfm::rpc::proto::admin_service_client::AdminServiceClient;
use scpsfm::rpc::proto::job_service_client::JobServiceClient;
use scpsfm::rpc::proto::{self, JobState};
use scpsfm::rpc::server::Options;
use tonic::Code;
use tonic_types::StatusExt;

use super::tenants::{call, methods, reason};
use crate::support::keys::{NORTH, SOUTH, keyed};
use crate::support::server::{TestServer, one_worker};
use crate::support::solvers::{held, quick};
use crate::support::wire::create_tracks;

const READER: &str = "reader0123456789abcdef0123456789abcdef";
const OPERATOR: &str = "operator0123456789abcdef0123456789abcdef";

fn scopes() -> Options {
    let keys = format!("north:read-only:{READER}, north:{NORTH}, south:ordinary:{SOUTH}, ops:admin:{OPERATOR}");
    let fixed = keys.parse().expect("four keys");
    Options { keys: Sources { file: None, fixed: Some(fixed) }, ..Options::default() }
}

/// The scope that a method needs, by its name.
fn needed(path: &str) -> &'static str {
    let (service, method) = path.rsplit_once('/').expect("a path");
    if service.ends_with("AdminService") {
        "admin"
    } else if ["Get", "List", "Watch", "Read"].iter().any(|verb| method.starts_with(verb)) {
        "read-only"
    } else {
        "ordinary"
    }
}

#[tokio::test]
async fn every_method_is_refused_to_keys_of_a_lesser_scope_and_to_no_other() {
    let server = TestServer::start_with(quick(), scopes(), one_worker()).await;
    let channel = server.channel().await;
    let keys = [("read-only", READER), ("ordinary", NORTH), ("admin", OPERATOR)];
    let rank = |scope: &str| keys.iter().position(|(known, _)| *known == scope).expect("a scope");
    let (mut refused, mut allowed) = (0, 0);
    for path in methods() {
        for (scope, key) in keys {
            let answer = call(&channel, &path, Some(&format!("Bearer {key}"))).await;
            let denied = answer.err().filter(|status| status.code() == Code::PermissionDenied);
            assert_eq!(denied.is_some(), rank(scope) < rank(needed(&path)), "{path} with {scope}: {denied:?}");
            let Some(status) = denied else {
                allowed += 1;
                continue;
            };
            refused += 1;
            assert_eq!(reason(&status), "SCOPE");
            let metadata = status.get_details_error_info().expect("an ErrorInfo").metadata;
            assert_eq!(metadata["scope"], needed(&path), "{path}");
            assert!(!status.message().contains(key), "{status}");
        }
    }
    // Nine methods of 21 change something, and four are the administration's.
    assert_eq!((refused, allowed), (9 + 2 * 4, 3 * 21 - 9 - 2 * 4));
}

#[tokio::test]
async fn without_keys_everyone_may_do_everything() {
    let server = TestServer::start(quick()).await;
    let channel = server.channel().await;
    for path in methods() {
        let answer = call(&channel, &path, None).await;
        assert!(answer.is_ok() || answer.is_err_and(|status| status.code() != Code::PermissionDenied), "{path}");
    }
}

#[tokio::test]
async fn an_administrator_reaches_the_jobs_of_every_tenant() {
    let (solver, _hold) = held();
    let server = TestServer::start_with(solver, scopes(), one_worker()).await;
    let channel = server.channel().await;
    let mut north = JobServiceClient::new(keyed(&channel, NORTH));
    let mut south = JobServiceClient::new(keyed(&channel, SOUTH));
    let mut operator = JobServiceClient::new(keyed(&channel, OPERATOR));
    let request = proto::CreateJobRequest { parent: String::new(), ..create_tracks() };
    let batch = proto::BatchCreateJobsRequest { parent: "tenants/north".into(), requests: vec![request.clone(); 2] };
    let created = operator.batch_create_jobs(batch).await.expect("jobs of another tenant").into_inner().jobs;
    let name = created[1].name.clone();
    assert!(created.iter().all(|job| job.name.starts_with("tenants/north/jobs/")), "{created:?}");
    let own = operator.create_job(request).await.expect("a job").into_inner().name;
    assert!(own.starts_with("tenants/ops/jobs/"), "{own}");

    let cancel = proto::CancelJobRequest { name: name.clone(), etag: String::new() };
    assert_eq!(south.cancel_job(cancel.clone()).await.expect_err("another's").code(), Code::NotFound);
    north.cancel_job(cancel).await.expect("its own");
    let retry = proto::RetryJobRequest { name: name.clone(), etag: String::new() };
    assert_eq!(south.retry_job(retry.clone()).await.expect_err("another's").code(), Code::NotFound);
    assert_eq!(operator.retry_job(retry).await.expect("every tenant's").into_inner().state(), JobState::Queued);
    let priority = proto::SetJobPriorityRequest { name: name.clone(), priority: Some(5), etag: String::new() };
    assert_eq!(south.set_job_priority(priority.clone()).await.expect_err("another's").code(), Code::NotFound);
    assert_eq!(operator.set_job_priority(priority).await.expect("every tenant's").into_inner().priority, 5);
    assert_eq!(north.get_job(proto::GetJobRequest { name }).await.expect("its own").into_inner().priority, 5);

    let queue = AdminServiceClient::new(keyed(&channel, OPERATOR)).get_queue(proto::GetQueueRequest {}).await;
    let queue = queue.expect("the queue").into_inner();
    let mut tenants: Vec<_> = queue.tenants.iter().map(|of| of.tenant.as_str()).collect();
    tenants.sort_unstable();
    assert_eq!(tenants, ["tenants/north", "tenants/ops"]);
    let jobs: u32 = queue.tenants.iter().map(|of| of.queued_job_count + of.running_job_count).sum();
    assert_eq!(jobs, 3);
    let counted: u32 = queue.job_counts.iter().map(|of| of.count).sum();
    assert_eq!((queue.job_counts.len(), counted, queue.paused), (6, 3, false));
}
