//! The administration of the real program, by its own commands.

use std::process::Stdio;

use rustix::process::Signal;
use scpsfm::rpc::proto::{self, JobState};
use serde_json::Value;

use crate::support::live::{connected, created, lasting, reaches, small};
use crate::support::program::{Run, Serving, run};
use crate::support::scrape::Page;
use crate::support::server::soon;

#[test]
fn commands_on_the_whole_server_take_no_tenant() {
    for action in ["queue", "pause", "resume", "drain"] {
        let refused = run(["admin", action, "--tenant", "north", "--server", "http://127.0.0.1:1"]);
        assert_eq!(refused.code, Some(2), "{refused:?}");
        assert!(refused.stderr.contains("--tenant north: ") && refused.stderr.contains("all tenants"), "{refused:?}");
        let help = run(["admin", action, "--help"]).stdout;
        assert!(help.contains("--api-key-file") && !help.contains("--tenant"), "{help}");
    }
}

fn admin(server: &Serving, action: &str) -> Run {
    let done = run(["admin", action, "--json", "--server", &server.grpc]);
    assert_eq!(done.code, Some(0), "{done:?}");
    done
}

fn queue(server: &Serving) -> Value {
    serde_json::from_str(&admin(server, "queue").stdout).expect("JSON")
}

/// Waits until the gauge of a paused queue has this value.
async fn until_paused_is(server: &Serving, value: f64) {
    soon(async {
        while Page::parse(&server.page("/metrics")).value("scpsfm_queue_paused") != value {
            tokio::time::sleep(std::time::Duration::from_millis(20)).await;
        }
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_paused_queue_begins_nothing_over_a_restart_until_it_is_resumed() {
    let data = tempfile::tempdir().expect("a temporary directory");
    let mut server = Serving::start(data.path());
    admin(&server, "pause");
    let told = run(["admin", "queue", "--server", &server.grpc]).stdout;
    assert!(told.starts_with("paused since "), "{told}");
    let name = created(&mut connected(&server).await, small(1)).await;
    until_paused_is(&server, 1.0).await;
    server.running.signal(Signal::TERM);
    assert!(tokio::task::block_in_place(|| server.running.wait()).success());

    let server = Serving::start(data.path());
    // The sweeper has looked at the queue by then, and so have the slots.
    until_paused_is(&server, 1.0).await;
    let mut jobs = connected(&server).await;
    let job = jobs.get_job(proto::GetJobRequest { name: name.clone() }).await.expect("a job").into_inner();
    assert_eq!((job.state(), job.last_sequence, job.attempt_count), (JobState::Queued, 1, 0));
    let report = queue(&server);
    assert_eq!((&report["paused"], &report["jobs"]["QUEUED"]), (&true.into(), &1.into()), "{report}");
    assert_eq!(report["oldest_job"], name.as_str());
    assert_eq!(report["tenants"][0]["tenant"], "tenants/default");

    admin(&server, "resume");
    reaches(&mut jobs, &name, &[JobState::Succeeded]).await;
    assert_eq!(queue(&server)["paused"], false);
    until_paused_is(&server, 0.0).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_drained_server_gives_its_jobs_back_and_ends_with_0() {
    let data = tempfile::tempdir().expect("a temporary directory");
    let at_once = [("SCPSFM_ENGINE__DRAIN_SECONDS", "0")];
    let mut server = Serving::start_with(data.path(), &at_once, Stdio::null());
    let mut jobs = connected(&server).await;
    let name = created(&mut jobs, lasting(10_000)).await;
    reaches(&mut jobs, &name, &[JobState::Running]).await;
    let drained: Value = serde_json::from_str(&admin(&server, "drain").stdout).expect("JSON");
    let expected = format!("-{}", server.running.0.id());
    assert!(drained["server"].as_str().is_some_and(|server| server.ends_with(&expected)), "{drained}");
    assert_eq!(tokio::task::block_in_place(|| server.running.wait()).code(), Some(0));

    let server = Serving::start(data.path());
    let mut jobs = connected(&server).await;
    let request = proto::WatchJobRequest { name: name.clone(), after_sequence: 0 };
    let mut watch = jobs.watch_job(request).await.expect("a watch").into_inner();
    let mut states = Vec::new();
    while states.len() < 4 {
        let event = soon(watch.message()).await.expect("an event").expect("it goes on");
        states.extend(crate::support::wire::state_of(&event));
    }
    let expected = [JobState::Queued, JobState::Running, JobState::Queued, JobState::Running];
    assert_eq!(states, expected, "it was given back, and begun again");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn commands_retry_jobs_and_change_their_order() {
    let data = tempfile::tempdir().expect("a temporary directory");
    let server = Serving::start(data.path());
    admin(&server, "pause");
    let mut jobs = connected(&server).await;
    let name = created(&mut jobs, small(1)).await;
    let command = |words: &[&str]| run(words.iter().copied().chain(["--server", &server.grpc]));
    let changed = command(&["priority", &name, "-5", "--json"]);
    assert_eq!(changed.code, Some(0), "{changed:?}");
    assert_eq!(serde_json::from_str::<Value>(&changed.stdout).expect("JSON")["priority"], -5);
    for told in [command(&["priority", &name, "7"]), command(&["get", &name]), command(&["list"])] {
        assert!(told.stdout.trim_end().ends_with("  priority 7"), "{told:?}");
    }
    assert_eq!(command(&["priority", &name, "1001"]).code, Some(2));
    for states in [&["--state", "RUNNING,queued"][..], &["--state", "DEADLINE_EXCEEDED", "--state", "queued"]] {
        let listed = command(&[&["list"], states].concat());
        assert!(listed.stdout.contains(&name), "{states:?}: {listed:?}");
    }
    let others = command(&["list", "--state", "running,deadline-exceeded"]);
    assert_eq!((others.code, others.stdout.as_str()), (Some(0), ""));
    assert_eq!(command(&["cancel", &name]).code, Some(0));
    let refused = command(&["priority", &name, "1"]);
    assert_eq!(refused.code, Some(65), "{refused:?}");
    let retried = command(&["retry", &name]);
    assert!(retried.code == Some(0) && retried.stdout.contains("QUEUED"), "{retried:?}");
    admin(&server, "resume");
    reaches(&mut jobs, &name, &[JobState::Succeeded]).await;
    assert_eq!(command(&["retry", &name]).code, Some(65));
}
