//! Many clients at once, each with jobs of its own.

use std::time::Duration;

use scpsfm::rpc::proto::{self, JobState};
use tokio::task::JoinSet;

use crate::support::live::{connected, created, reaches, tiny};
use crate::support::program::Serving;
use crate::support::scrape::Page;
use crate::support::server::soon;

const CLIENTS: u64 = 20;
const JOBS_EACH: u64 = 5;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_hundred_jobs_of_twenty_clients_all_end_and_the_queue_is_empty() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let two_workers = ["--workers", "2"];
    let server = Serving::start_more(&directory.path().join("data"), &two_workers, &[], std::process::Stdio::null());
    let mut clients = JoinSet::new();
    for client in 0..CLIENTS {
        let mut jobs = connected(&server).await;
        clients.spawn(async move {
            let mut names = Vec::new();
            for job in 0..JOBS_EACH {
                names.push(created(&mut jobs, tiny(client * JOBS_EACH + job)).await);
            }
            for name in &names {
                let end = reaches(&mut jobs, name, &[JobState::Succeeded, JobState::Failed]).await;
                assert_eq!(end, JobState::Succeeded, "{name}");
            }
            names
        });
    }
    let mut names: Vec<String> = clients.join_all().await.into_iter().flatten().collect();
    names.sort();
    names.dedup();
    assert_eq!(names.len() as u64, CLIENTS * JOBS_EACH);

    let mut jobs = connected(&server).await;
    let request = proto::ListJobsRequest {
        parent: "tenants/default".into(),
        page_size: 1000,
        filter: "state = SUCCEEDED".into(),
        ..Default::default()
    };
    let listed = jobs.list_jobs(request).await.expect("a page").into_inner();
    assert_eq!(listed.jobs.len(), names.len());
    // The queue is counted a few times a second.
    let emptied = async {
        while Page::parse(&server.page("/metrics")).value("scpsfm_queue_depth") != 0.0 {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    soon(emptied).await;
    let page = Page::parse(&server.page("/metrics"));
    assert_eq!(page.value("scpsfm_workers"), 2.0);
}
