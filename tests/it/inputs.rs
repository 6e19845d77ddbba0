//! Uploaded inputs, listed and deleted: over the API, from the shell, between tenants.

use std::process::Stdio;

use scpsfm::rpc::proto::create_job_request::Source;
use scpsfm::rpc::proto::input_service_client::InputServiceClient;
use scpsfm::rpc::proto::job_service_client::JobServiceClient;
use scpsfm::rpc::proto::{self, JobState};
use tonic::transport::Channel;
use tonic::{Code, Status};
use tonic_types::StatusExt;

use crate::support::keys::{Keyed, NORTH, SOUTH, keyed};
use crate::support::live::{created, reaches};
use crate::support::program::{Serving, run};
use crate::support::server::{TestServer, one_worker, soon};
use crate::support::solvers::held;
use crate::support::uploads::{DEFAULT, encoded, id, reason, whole};
use crate::support::wire::{create, raw};

fn list(parent: &str, page_size: i32, page_token: &str) -> proto::ListInputsRequest {
    proto::ListInputsRequest { parent: parent.into(), page_size, page_token: page_token.into() }
}

fn deletion(name: &str) -> proto::DeleteInputRequest {
    proto::DeleteInputRequest { name: name.into() }
}

fn fields(status: &Status) -> Vec<String> {
    assert_eq!(status.code(), Code::InvalidArgument, "{status}");
    let request = status.get_details_bad_request().expect("a BadRequest");
    request.field_violations.into_iter().map(|violation| violation.field).collect()
}

#[tokio::test]
async fn a_deleted_input_leaves_the_list_and_the_jobs_that_have_it_go_on() {
    let (solver, hold) = held();
    let server = TestServer::start_with(solver, Default::default(), one_worker()).await;
    let mut inputs = InputServiceClient::new(server.channel().await);
    let mut stored = Vec::new();
    for number in 0..3 {
        let bytes = encoded(&raw(3, 40 + number as usize));
        let messages = tokio_stream::iter(whole(DEFAULT, &id(number), &bytes, 1_000));
        stored.insert(0, soon(inputs.upload_input(messages)).await.expect("an input").into_inner());
    }
    // Page by page, the newest first, each as its upload told.
    let first = inputs.list_inputs(list(DEFAULT, 2, "")).await.expect("a page").into_inner();
    assert_eq!(first.inputs, stored[..2]);
    let second = inputs.list_inputs(list(DEFAULT, 2, &first.next_page_token)).await.expect("a page").into_inner();
    assert_eq!((second.inputs.as_slice(), second.next_page_token.as_str()), (&stored[2..], ""));
    assert_eq!(fields(&inputs.list_inputs(list(DEFAULT, -1, "")).await.expect_err("negative")), ["page_size"]);
    assert_eq!(fields(&inputs.list_inputs(list(DEFAULT, 0, "made-up")).await.expect_err("no token")), ["page_token"]);

    // One job runs with it, one waits.
    let mut jobs = server.jobs().await;
    let named = || create(Source::Input(stored[0].name.clone()));
    let running = created(&mut jobs, named()).await;
    reaches(&mut jobs, &running, &[JobState::Running]).await;
    let waiting = created(&mut jobs, named()).await;
    let inline = created(&mut jobs, create(Source::TrackSet(scpsfm::rpc::convert::input::to_wire(raw(3, 40))))).await;
    inputs.delete_input(deletion(&stored[0].name)).await.expect("deleted");
    // Each tells what it was created with, also now.
    let listed = proto::ListJobsRequest { parent: DEFAULT.into(), ..Default::default() };
    let listed = jobs.list_jobs(listed).await.expect("a page").into_inner().jobs;
    let told: Vec<_> = listed.iter().map(|job| (job.name.as_str(), job.input.as_str())).collect();
    let uploaded = stored[0].name.as_str();
    assert_eq!(told, [(inline.as_str(), ""), (waiting.as_str(), uploaded), (running.as_str(), uploaded)]);
    let got = jobs.get_job(proto::GetJobRequest { name: waiting.clone() }).await.expect("a job").into_inner();
    assert_eq!(got.input, uploaded);
    let gone = inputs.delete_input(deletion(&stored[0].name)).await.expect_err("gone");
    assert_eq!((gone.code(), reason(&gone).as_str()), (Code::NotFound, "INPUT_NOT_FOUND"));
    assert_eq!(fields(&inputs.delete_input(deletion("inputs/a")).await.expect_err("malformed")), ["name"]);
    let refused = jobs.create_job(named()).await.expect_err("its name is gone");
    assert_eq!((refused.code(), reason(&refused).as_str()), (Code::NotFound, "INPUT_NOT_FOUND"));
    let left = inputs.list_inputs(list(DEFAULT, 0, "")).await.expect("a page").into_inner();
    assert_eq!(left.inputs, stored[1..]);
    hold.let_go();
    for job in [running, waiting, inline] {
        let ends = [JobState::Succeeded, JobState::Failed];
        assert_eq!(reaches(&mut jobs, &job, &ends).await, JobState::Succeeded, "{job}");
    }
    // The same bytes under the same id are a new input.
    let messages = tokio_stream::iter(whole(DEFAULT, &id(2), &encoded(&raw(3, 42)), 1_000));
    let again = soon(inputs.upload_input(messages)).await.expect("an input").into_inner();
    assert_eq!((&again.name, &again.sha256), (&stored[0].name, &stored[0].sha256));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn of_another_tenants_inputs_nothing_is_seen_or_deleted() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let keys = format!("north:{NORTH},south:{SOUTH}");
    let server = Serving::start_with(directory.path(), &[("SCPSFM_AUTH__KEYS", &keys)], Stdio::null());
    let channel = Channel::from_shared(server.grpc.clone()).expect("a URL").connect().await.expect("a connection");
    let mut north: InputServiceClient<Keyed> = InputServiceClient::new(keyed(&channel, NORTH));
    let mut south: InputServiceClient<Keyed> = InputServiceClient::new(keyed(&channel, SOUTH));
    let bytes = encoded(&raw(3, 40));
    let mut names = Vec::new();
    for number in [1, 2] {
        let messages = tokio_stream::iter(whole("tenants/north", &id(number), &bytes, 1_000));
        names.push(north.upload_input(messages).await.expect("an input").into_inner().name);
    }
    let page = north.list_inputs(list("tenants/north", 1, "")).await.expect("a page").into_inner();
    assert_eq!(page.inputs[0].name, names[1]);

    let own = south.list_inputs(list("tenants/south", 0, "")).await.expect("a page").into_inner();
    assert_eq!(own, proto::ListInputsResponse::default());
    let theirs = south.list_inputs(list("tenants/north", 0, "")).await.expect_err("out of reach");
    assert_eq!((theirs.code(), reason(&theirs).as_str()), (Code::NotFound, "TENANT_NOT_FOUND"));
    let foreign = south.list_inputs(list("tenants/south", 0, &page.next_page_token)).await;
    assert_eq!(fields(&foreign.expect_err("another's token")), ["page_token"]);
    // One that exists, and one that never did: the same answer but for the name.
    let mut told = Vec::new();
    for name in [names[0].clone(), format!("tenants/north/inputs/{}", id(9))] {
        let status = south.delete_input(deletion(&name)).await.expect_err("out of reach");
        assert_eq!((status.code(), reason(&status).as_str()), (Code::NotFound, "INPUT_NOT_FOUND"));
        told.push(format!("{} {:?}", status.message(), status.get_error_details()).replace(&name, "NAME"));
    }
    assert_eq!(told[0], told[1]);
    let mine = format!("tenants/south/inputs/{}", id(1));
    assert_eq!(south.delete_input(deletion(&mine)).await.expect_err("none of theirs").code(), Code::NotFound);
    let all = north.list_inputs(list("tenants/north", 0, "")).await.expect("a page").into_inner();
    assert_eq!(all.inputs.len(), 2);
    let job = proto::CreateJobRequest { parent: "tenants/north".into(), ..create(Source::Input(names[0].clone())) };
    JobServiceClient::new(keyed(&channel, NORTH)).create_job(job).await.expect("its input is there");
}

#[test]
fn commands_list_and_delete_inputs() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let server = Serving::start(&directory.path().join("data"));
    let to = ["--server", server.grpc.as_str()];
    let mut names = Vec::new();
    for tracks in [3, 4] {
        let path = directory.path().join(format!("{tracks}.csv"));
        let rows: String = (0..2 * tracks).map(|k| format!("{},{},{k},{}\n", k % 2, k / 2, 3 * k)).collect();
        std::fs::write(&path, format!("view,track,x,y\n{rows}")).expect("written");
        let uploaded = run(["upload", path.to_str().expect("a path"), "--quiet"].iter().chain(&to));
        assert_eq!(uploaded.code, Some(0), "{uploaded:?}");
        names.insert(0, uploaded.stdout.trim().to_owned());
    }
    let listed = run(["inputs", "--page-size", "1"].iter().chain(&to));
    assert_eq!(listed.code, Some(0), "{listed:?}");
    assert!(listed.stdout.starts_with(&names[0]) && listed.stdout.contains("2 views, 4 tracks"), "{listed:?}");
    let token = listed.stderr.trim().strip_prefix("more: --page-token ").expect("a token");
    let next = run(["inputs", "--page-token", token, "--json"].iter().chain(&to));
    let line: serde_json::Value = serde_json::from_str(&next.stdout).expect("one line of JSON");
    assert_eq!((line["name"].as_str(), line["tracks"].as_u64()), (Some(names[1].as_str()), Some(3)));

    let all = run(["inputs", "--all", "--page-size", "1"].iter().chain(&to));
    let listed: Vec<&str> = all.stdout.lines().filter_map(|line| line.split_whitespace().next()).collect();
    assert!(listed == names && all.stderr.is_empty(), "{all:?}");

    // A job says which of them it was created with.
    let job = run(["submit", "--input", &names[0], "--method", "geometry"].iter().chain(&to)).stdout;
    let got = run(["get", job.trim()].iter().chain(&to));
    assert!(got.stdout.contains(&format!("\n  input: {}\n", names[0])), "{got:?}");
    let lines = run(["list", "--json"].iter().chain(&to)).stdout;
    let line: serde_json::Value = serde_json::from_str(&lines).expect("one line of JSON");
    assert_eq!((line["name"].as_str(), line["input"].as_str()), (Some(job.trim()), Some(names[0].as_str())));

    // Flags that say how to read a file say nothing of one that is there.
    let sized = run(["submit", "--input", &names[0], "--width", "10", "--height", "10"].iter().chain(&to));
    assert_eq!(sized.code, Some(2), "{sized:?}");
    assert!(sized.stderr.contains("--width 10 --height 10") && sized.stderr.contains("scpsfm upload"), "{sized:?}");

    let known = ["--focal-px", "800", "--focal-sigma", "0.05"];
    let known = run(["submit", "--input", &names[0]].iter().chain(&known).chain(&to));
    assert_eq!(known.code, Some(2), "{known:?}");
    assert!(known.stderr.contains("--focal-px 800 --focal-sigma 0.05"), "{known:?}");

    let last = names[1].rsplit('/').next().expect("an id");
    let deleted = run(["delete", "--input", last, "--input", &names[0]].iter().chain(&to));
    assert_eq!((deleted.code, deleted.stdout.as_str()), (Some(0), format!("{}\n{}\n", names[1], names[0]).as_str()));
    assert_eq!(run(["inputs"].iter().chain(&to)).stdout, "");
    assert_eq!(run(["delete", "--input", last].iter().chain(&to)).code, Some(65), "gone");
    assert_eq!(run(["delete"].iter().chain(&to)).code, Some(2), "nothing to delete");
}
