//! `JobService`: creation, watching, cancelling, listing, results.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use std::time::Duration;

use prost::Message as _;
use scpsfm::domain::job::JobName;
use scpsfm::domain::{Input, Limits, Solution, SolveSettings};
use scpsfm::engine::{self, Engine, QueueBounds};
use scpsfm::rpc::convert;
use scpsfm::rpc::proto::calibration_service_client::CalibrationServiceClient;
use scpsfm::rpc::proto::job_service_client::JobServiceClient;
use scpsfm::rpc::proto::{self, JobState, create_job_request, solve_request::Message};
use scpsfm::rpc::server::{Options, Server};
use scpsfm::store::sqlite::Sqlite;
use sha2::{Digest, Sha256};
use tonic::Code;
use tonic::transport::Channel;
use tonic_prost::ProstCodec;
use tonic_types::StatusExt;

use crate::support::server::{TestServer, one_worker, soon};
use crate::support::solvers::{held, quick, solution};
use crate::support::wire::{all, create, create_tracks, raw, solve_request, state_of, track_set};

async fn created(jobs: &mut JobServiceClient<Channel>, request: proto::CreateJobRequest) -> proto::Job {
    jobs.create_job(request).await.expect("a job").into_inner()
}

async fn events(jobs: &mut JobServiceClient<Channel>, name: &str, after_sequence: u64) -> Vec<proto::JobEvent> {
    let request = proto::WatchJobRequest { name: name.into(), after_sequence };
    let (events, end) = soon(async { all(jobs.watch_job(request).await.expect("a watch").into_inner()).await }).await;
    end.expect("the watch ends with the job");
    events
}

/// Waits until a job runs.
async fn running(jobs: &mut JobServiceClient<Channel>, name: &str) {
    let request = proto::WatchJobRequest { name: name.into(), after_sequence: 0 };
    let mut watch = jobs.watch_job(request).await.expect("a watch").into_inner();
    while let Some(event) = soon(watch.message()).await.expect("an event") {
        if state_of(&event) == Some(JobState::Running) {
            return;
        }
    }
    panic!("{name} ended without running");
}

#[tokio::test]
async fn a_job_runs_to_its_result() {
    let server = TestServer::start(quick()).await;
    let mut jobs = server.jobs().await;
    let mut request = create_tracks();
    request.job = Some(proto::Job {
        settings: Some(proto::SolveSettings { seed: 7, ..Default::default() }),
        labels: BTreeMap::from([("site".into(), "north".into())]),
        ..Default::default()
    });
    let job = created(&mut jobs, request).await;
    assert!(job.name.starts_with("tenants/default/jobs/"), "{}", job.name);
    assert_eq!((job.view_count, job.track_count, job.observation_count), (3, 4, 12));
    assert_eq!(job.settings.expect("settings").alpha, Some(SolveSettings::DEFAULT_ALPHA), "defaults are written out");
    let events = events(&mut jobs, &job.name, 0).await;
    let states: Vec<_> = events.iter().filter_map(state_of).collect();
    assert_eq!(states, [JobState::Queued, JobState::Running, JobState::Succeeded]);
    let done = jobs.get_job(proto::GetJobRequest { name: job.name.clone() }).await.expect("a job").into_inner();
    assert_eq!(done.state(), JobState::Succeeded);
    assert_eq!(done.labels["site"], "north");
    assert_eq!(done.attempt_count, 1);
    assert_eq!(done.summary.expect("a summary").inlier_track_count, 2);
    let request = proto::ReadJobResultRequest { name: job.name.clone(), offset: 0 };
    let (chunks, end) = all(jobs.read_job_result(request).await.expect("a result").into_inner()).await;
    end.expect("whole");
    let result = proto::JobResult::decode(chunks[0].data.as_ref()).expect("a JobResult");
    assert_eq!(result.job, job.name);
    let input = Input::new(raw(3, 4), &Limits::default(), "").expect("valid");
    let expected = solution(&input, &SolveSettings { seed: 7, ..SolveSettings::default() });
    assert_eq!(convert::result::from_wire(result), Ok(expected));
}

#[tokio::test]
async fn a_watch_replays_exactly_what_came_after() {
    let server = TestServer::start(quick()).await;
    let mut jobs = server.jobs().await;
    let name = created(&mut jobs, create_tracks()).await.name;
    let sequenced = |events: Vec<proto::JobEvent>| -> Vec<u64> {
        events.iter().map(|event| event.sequence).filter(|&sequence| sequence > 0).collect()
    };
    let whole = sequenced(events(&mut jobs, &name, 0).await);
    assert_eq!(whole, (1..=whole.len() as u64).collect::<Vec<_>>());
    for after in 1..=whole.len() {
        assert_eq!(sequenced(events(&mut jobs, &name, after as u64).await), whole[after..], "after {after}");
    }
}

#[tokio::test]
async fn dropping_a_watch_leaves_the_job_alone() {
    let (solver, hold) = held();
    let options = Options { solve_grace: Duration::from_millis(1), ..Options::default() };
    let server = TestServer::start_with(solver, options, one_worker()).await;
    let channel = server.channel().await;
    let mut jobs = JobServiceClient::new(channel.clone());
    let name = created(&mut jobs, create_tracks()).await.name;
    running(&mut jobs, &name).await;
    // A Solve that is dropped on the same connection after the watch: once its job is cancelled, the grace period of
    // whatever was dropped before is over too.
    let request = solve_request(Message::Config(create_tracks()));
    let mut solve = CalibrationServiceClient::new(channel);
    let mut stream = solve.solve(tokio_stream::iter([request])).await.expect("a solve").into_inner();
    let solved = soon(stream.message()).await.expect("an event").expect("the first event").job;
    drop(stream);
    let states: Vec<_> = events(&mut jobs, &solved, 0).await.iter().filter_map(state_of).collect();
    assert_eq!(states.last(), Some(&JobState::Cancelled));
    let job = jobs.get_job(proto::GetJobRequest { name: name.clone() }).await.expect("a job").into_inner();
    assert_eq!((job.state(), job.cancel_requested), (JobState::Running, false));
    hold.let_go();
    let states: Vec<_> = events(&mut jobs, &name, 0).await.iter().filter_map(state_of).collect();
    assert_eq!(states.last(), Some(&JobState::Succeeded));
}

#[tokio::test]
async fn cancel_reaches_running_queued_and_ended_jobs() {
    let (solver, hold) = held();
    let server = TestServer::start(solver).await;
    let mut jobs = server.jobs().await;
    let first = created(&mut jobs, create_tracks()).await.name;
    let second = created(&mut jobs, create_tracks()).await.name;
    running(&mut jobs, &first).await;
    let cancel = |name: &str| proto::CancelJobRequest { name: name.into(), ..Default::default() };
    let queued = jobs.cancel_job(cancel(&second)).await.expect("a cancel").into_inner();
    assert_eq!(queued.state(), JobState::Cancelled);
    let read = proto::ReadJobResultRequest { name: first.clone(), offset: 0 };
    let status = jobs.read_job_result(read).await.expect_err("no result yet");
    assert_eq!(status.code(), Code::FailedPrecondition);
    assert_eq!(status.get_details_error_info().expect("an ErrorInfo").reason, "RESULT_NOT_READY");
    jobs.cancel_job(cancel(&first)).await.expect("a cancel");
    let states: Vec<_> = events(&mut jobs, &first, 0).await.iter().filter_map(state_of).collect();
    assert_eq!(states.last(), Some(&JobState::Cancelled));
    hold.let_go();
    let again = jobs.cancel_job(cancel(&first)).await.expect("idempotent").into_inner();
    assert_eq!(again.state(), JobState::Cancelled);
}

#[tokio::test]
async fn a_full_queue_says_at_once_when_to_come_back_and_which_bound_was_hit() {
    let room = one_worker().queue;
    // The second job waits alone, which always fits; the third finds 12 observations waiting.
    for (queue, bound) in [
        (QueueBounds { max_jobs: 1, ..room.clone() }, "jobs"),
        (QueueBounds { max_bytes: 1, ..room.clone() }, "bytes"),
        (QueueBounds { max_observations: 23, ..room.clone() }, "observations"),
        (QueueBounds { max_tenant_jobs: 1, ..room.clone() }, "tenant_jobs"),
        (QueueBounds { max_tenant_bytes: 1, ..room }, "tenant_bytes"),
    ] {
        fills_up(queue, bound).await;
    }
}

#[tokio::test]
async fn a_batch_that_never_fits_is_not_told_to_come_back() {
    let room = one_worker().queue;
    // Three jobs of 12 observations each.
    for (queue, bound, key, asked) in [
        (QueueBounds { max_jobs: 2, ..room.clone() }, "jobs", "engine.queue_capacity is 2", Some("3")),
        (QueueBounds { max_bytes: 40, ..room.clone() }, "bytes", "engine.queue_bytes is 40", None),
        (
            QueueBounds { max_observations: 35, ..room.clone() },
            "observations",
            "engine.queue_observations is 35",
            Some("36"),
        ),
        (
            QueueBounds { max_tenant_jobs: 2, ..room.clone() },
            "tenant_jobs",
            "engine.tenant_queue_capacity is 2",
            Some("3"),
        ),
        (QueueBounds { max_tenant_bytes: 40, ..room }, "tenant_bytes", "engine.tenant_queue_bytes is 40", None),
    ] {
        let engine = engine::Options { queue, ..one_worker() };
        let server = TestServer::start_with(quick(), Options::default(), engine).await;
        let mut jobs = server.jobs().await;
        let request = |count: usize| proto::BatchCreateJobsRequest {
            parent: "tenants/default".into(),
            requests: vec![create_tracks(); count],
        };
        let status = jobs.batch_create_jobs(request(3)).await.expect_err("never fits");
        assert_eq!(status.code(), Code::InvalidArgument, "{status}");
        assert!(status.get_details_retry_info().is_none(), "{status:?}");
        assert!(status.message().contains(key), "{status}");
        let info = status.get_details_error_info().expect("an ErrorInfo");
        assert_eq!((info.reason.as_str(), info.metadata["bound"].as_str()), ("BATCH_TOO_LARGE", bound));
        if let Some(asked) = asked {
            assert_eq!(info.metadata["asked"], asked);
        }
        let list = proto::ListJobsRequest { parent: "tenants/default".into(), ..Default::default() };
        assert!(jobs.list_jobs(list).await.expect("a page").into_inner().jobs.is_empty(), "nothing was stored");
        jobs.batch_create_jobs(request(1)).await.expect("one alone always fits");
    }
}

#[tokio::test]
async fn a_job_of_a_batch_that_takes_too_much_memory_is_named() {
    // What the first request takes, and not the second, which has more tracks.
    let engine = engine::Options { max_solver_bytes: scpsfm::solver::estimated_bytes(3, 4, 12), ..one_worker() };
    let server = TestServer::start_with(quick(), Options::default(), engine).await;
    let mut jobs = server.jobs().await;
    let larger = || create(create_job_request::Source::TrackSet(convert::input::to_wire(raw(3, 50))));
    let field = |status: &tonic::Status| {
        assert_eq!(status.code(), Code::InvalidArgument, "{status}");
        assert_eq!(status.get_details_error_info().expect("an ErrorInfo").reason, "JOB_TOO_LARGE");
        status.get_details_bad_request().expect("a BadRequest").field_violations[0].field.clone()
    };
    let batch =
        proto::BatchCreateJobsRequest { parent: "tenants/default".into(), requests: vec![create_tracks(), larger()] };
    let status = jobs.batch_create_jobs(batch).await.expect_err("never fits");
    assert_eq!(field(&status), "requests[1].job");
    assert!(status.message().starts_with("requests[1]: job: "), "{status}");
    assert_eq!(field(&jobs.create_job(larger()).await.expect_err("never fits")), "job");
    let list = proto::ListJobsRequest { parent: "tenants/default".into(), ..Default::default() };
    assert!(jobs.list_jobs(list).await.expect("a page").into_inner().jobs.is_empty(), "nothing was stored");
}

/// Fills a queue of these bounds until it refuses, by `bound`.
async fn fills_up(queue: QueueBounds, bound: &str) {
    let (solver, hold) = held();
    let engine = engine::Options { queue, ..one_worker() };
    let server = TestServer::start_with(solver, Options::default(), engine).await;
    let mut jobs = server.jobs().await;
    let first = created(&mut jobs, create_tracks()).await.name;
    running(&mut jobs, &first).await;
    let second = created(&mut jobs, create_tracks()).await.name;
    let status = jobs.create_job(create_tracks()).await.expect_err("a full queue");
    assert_eq!(status.code(), Code::ResourceExhausted, "{status}");
    let retry = status.get_details_retry_info().expect("a RetryInfo");
    assert_eq!(retry.retry_delay, Some(Duration::from_secs(3)));
    let info = status.get_details_error_info().expect("an ErrorInfo");
    assert_eq!(info.reason, "QUEUE_FULL");
    assert_eq!(info.metadata, HashMap::from([("bound".to_owned(), bound.to_owned())]));
    hold.let_go();
    for name in [first, second] {
        let states: Vec<_> = events(&mut jobs, &name, 0).await.iter().filter_map(state_of).collect();
        assert_eq!(states.last(), Some(&JobState::Succeeded));
    }
}

#[tokio::test]
async fn a_request_id_stands_for_one_job() {
    let server = TestServer::start(quick()).await;
    let mut jobs = server.jobs().await;
    let request = proto::CreateJobRequest { request_id: "r-1".into(), ..create_tracks() };
    let first = created(&mut jobs, request.clone()).await;
    let again = created(&mut jobs, request.clone()).await;
    assert_eq!(first.name, again.name);
    let other = create_job_request::Source::TrackSet(convert::input::to_wire(raw(3, 5)));
    let other = proto::CreateJobRequest { request_id: "r-1".into(), ..create(other) };
    let status = jobs.create_job(other).await.expect_err("another body");
    assert_eq!(status.code(), Code::AlreadyExists);
    let named = proto::CreateJobRequest { job_id: "mine".into(), ..create_tracks() };
    assert_eq!(created(&mut jobs, named.clone()).await.name, "tenants/default/jobs/mine");
    assert_eq!(jobs.create_job(named).await.expect_err("taken").code(), Code::AlreadyExists);
}

#[tokio::test]
async fn lists_are_filtered_ordered_and_paged() {
    let server = TestServer::start(quick()).await;
    let mut jobs = server.jobs().await;
    let mut names = Vec::new();
    for k in 0..5 {
        let labels = [("parity", (k % 2).to_string()), ("quoted", format!(r#""{k}" \"#))];
        let labels = labels.map(|(key, value)| (key.to_owned(), value)).into();
        let job = Some(proto::Job { labels, ..Default::default() });
        let name = created(&mut jobs, proto::CreateJobRequest { job, ..create_tracks() }).await.name;
        events(&mut jobs, &name, 0).await;
        names.push(name);
    }
    let mut list = async |filter: &str, order_by: &str, page_size| {
        let mut found = Vec::new();
        let mut page_token = String::new();
        loop {
            let request = proto::ListJobsRequest {
                parent: "tenants/default".into(),
                page_size,
                page_token,
                filter: filter.into(),
                order_by: order_by.into(),
            };
            let page = jobs.list_jobs(request).await.expect("a page").into_inner();
            assert!(page_size == 0 || page.jobs.len() <= page_size as usize);
            found.extend(page.jobs.into_iter().map(|job| job.name));
            page_token = page.next_page_token;
            if page_token.is_empty() {
                return found;
            }
        }
    };
    let newest_first: Vec<_> = names.iter().rev().cloned().collect();
    let twice = "state = SUCCEEDED OR state = SUCCEEDED";
    assert_eq!(list(twice, "", 2).await, newest_first, "a repeated state repeats no job and keeps its pages");
    assert_eq!(list("", "", 0).await, newest_first);
    assert_eq!(list("", "create_time", 2).await, names);
    assert_eq!(list("labels.parity = 1", "create_time", 1).await, [names[1].clone(), names[3].clone()]);
    assert_eq!(list("state = SUCCEEDED AND labels.parity = \"0\"", "", 0).await.len(), 3);
    assert_eq!(list("state = QUEUED OR state = RUNNING", "", 0).await, [""; 0]);
    assert_eq!(list(r#"labels.quoted = "\"2\" \\""#, "", 0).await, names[2..3]);
}

#[tokio::test]
async fn a_large_result_comes_in_chunks_from_any_offset() {
    let server = TestServer::start(quick()).await;
    let mut jobs = server.jobs().await;
    let input = create_job_request::Source::TrackSet(convert::input::to_wire(raw(2, 40_000)));
    let name = created(&mut jobs, create(input)).await.name;
    events(&mut jobs, &name, 0).await;
    let mut read = async |offset| {
        let request = proto::ReadJobResultRequest { name: name.clone(), offset };
        let (chunks, end) = all(jobs.read_job_result(request).await.expect("a result").into_inner()).await;
        end.expect("whole");
        assert_eq!(chunks[0].offset, offset);
        let total = chunks[0].size_bytes;
        let bytes: Vec<u8> = chunks.iter().flat_map(|chunk| chunk.data.clone()).collect();
        assert_eq!(bytes.len() as i64, total - offset);
        (bytes, chunks.len())
    };
    let (whole, count) = read(0).await;
    assert!(count > 2, "{count} chunks of {} bytes", whole.len());
    let (rest, _) = read(300_000).await;
    assert_eq!(rest, whole[300_000..]);
    let result = proto::JobResult::decode(whole.as_slice()).expect("a JobResult");
    let whole_at_once = jobs.get_job_result(proto::GetJobResultRequest { name }).await.expect("a result").into_inner();
    assert_eq!(whole_at_once, result);
    assert_eq!(result.tracks.expect("tracks").weights.len(), 40_000);
}

#[tokio::test]
async fn a_result_that_fits_no_message_is_refused_by_the_unary_call_alone() {
    let options = Options { max_message_bytes: 100_000, ..Options::default() };
    let server = TestServer::start_with(quick(), options, one_worker()).await;
    let mut jobs = server.jobs().await;
    // Tracks without observations: a small input with a large result.
    let tracks = proto::TrackSet { track_count: 50_000, ..track_set() };
    let name = created(&mut jobs, create(create_job_request::Source::TrackSet(tracks))).await.name;
    events(&mut jobs, &name, 0).await;
    let request = proto::GetJobResultRequest { name: name.clone() };
    let refused = jobs.get_job_result(request).await.expect_err("too large");
    assert_eq!(refused.code(), Code::FailedPrecondition);
    let info = refused.get_details_error_info().expect("an ErrorInfo");
    assert_eq!((info.reason.as_str(), info.metadata["max"].as_str()), ("RESULT_TOO_LARGE", "100000"));
    let request = proto::ReadJobResultRequest { name, offset: 0 };
    let (chunks, end) = all(jobs.read_job_result(request).await.expect("a result").into_inner()).await;
    end.expect("whole");
    let bytes: Vec<u8> = chunks.iter().flat_map(|chunk| chunk.data.clone()).collect();
    assert_eq!(info.metadata["bytes"], bytes.len().to_string());
    assert!(
        chunks.iter().all(|chunk| chunk.sha256[..] == Sha256::digest(&bytes)[..]),
        "each has the digest of the whole"
    );
}

#[tokio::test]
async fn a_result_is_the_same_bytes_after_a_restart_and_damage_is_found() {
    let server = TestServer::start(quick()).await;
    let name = created(&mut server.jobs().await, create_tracks()).await.name;
    events(&mut server.jobs().await, &name, 0).await;
    let read = async |server: &TestServer| {
        let request = proto::ReadJobResultRequest { name: name.clone(), offset: 0 };
        let (chunks, end) = all(server.jobs().await.read_job_result(request).await?.into_inner()).await;
        end.map(|()| chunks)
    };
    let first = read(&server).await.expect("a result");
    // With a solver that would make another result: what was stored is what is read.
    let server = server.restart(Arc::new(scpsfm::solver::solve)).await;
    assert_eq!(read(&server).await.expect("a result"), first);
    let database = rusqlite::Connection::open(server.directory().join("scpsfm.db")).expect("the database");
    let damaged = database
        .execute("UPDATE result_chunks SET data = CAST(substr(data, 1, length(data) - 1) || x'ff' AS BLOB)", []);
    assert_eq!(damaged.expect("damaged"), 1);
    assert_eq!(read(&server).await.expect_err("not what was stored").code(), Code::Internal);
}

/// A field that this version of `JobResult` does not have.
#[derive(Clone, PartialEq, prost::Message)]
struct Later {
    #[prost(uint32, tag = "1000")]
    later: u32,
}

#[tokio::test]
async fn what_a_later_version_put_into_a_result_is_sent_by_this_one() {
    fn encode(name: &JobName, solution: &Solution) -> Vec<u8> {
        [convert::result::encode(name, solution), Later { later: 7 }.encode_to_vec()].concat()
    }
    let directory = tempfile::tempdir().expect("a temporary directory");
    let store = Arc::new(Sqlite::open(directory.path()).expect("a store"));
    let engine = Engine::start(one_worker(), store, quick(), encode).await.expect("an engine");
    let server = Server::bind(Options::default(), engine).await.expect("a server");
    let channel = Channel::from_shared(format!("http://{}", server.address())).expect("a URL").connect().await;
    let channel = channel.expect("a connection");
    let mut jobs = JobServiceClient::new(channel.clone());
    let name = created(&mut jobs, create_tracks()).await.name;
    events(&mut jobs, &name, 0).await;
    let mut grpc = tonic::client::Grpc::new(channel);
    grpc.ready().await.expect("a connection");
    let request = tonic::Request::new(proto::GetJobResultRequest { name: name.clone() });
    let path = "/scpsfm.v1.JobService/GetJobResult".parse().expect("a path");
    let result: Later = grpc.unary(request, path, ProstCodec::default()).await.expect("a result").into_inner();
    assert_eq!(result.later, 7);
    let known = jobs.get_job_result(proto::GetJobResultRequest { name: name.clone() }).await.expect("a result");
    assert_eq!(known.into_inner().job, name);
}

#[tokio::test]
async fn a_dash_or_nothing_stands_for_the_callers_tenant() {
    let server = TestServer::start(quick()).await;
    let mut jobs = server.jobs().await;
    let mut names = Vec::new();
    for parent in ["", "tenants/-", "tenants/default"] {
        let job = created(&mut jobs, proto::CreateJobRequest { parent: parent.into(), ..create_tracks() }).await;
        assert!(job.name.starts_with("tenants/default/jobs/"), "{}", job.name);
        names.push(job.name);
        let listed = jobs.list_jobs(proto::ListJobsRequest { parent: parent.into(), ..Default::default() }).await;
        assert_eq!(listed.expect("a page").into_inner().jobs.len(), names.len());
    }
    let dashed = names[0].replace("tenants/default/", "tenants/-/");
    let got = jobs.get_job(proto::GetJobRequest { name: dashed }).await.expect("a job").into_inner();
    assert_eq!(got.name, names[0]);
    let requests = vec![create_tracks(), proto::CreateJobRequest { parent: String::new(), ..create_tracks() }];
    let batch = proto::BatchCreateJobsRequest { parent: "tenants/-".into(), requests };
    let batch = jobs.batch_create_jobs(batch).await.expect("created").into_inner();
    assert!(batch.jobs.iter().all(|job| job.name.starts_with("tenants/default/")), "{batch:?}");
}

#[tokio::test]
async fn the_names_of_images_come_back() {
    let server = TestServer::start(Arc::new(scpsfm::solver::solve)).await;
    let mut jobs = server.jobs().await;
    let mut tracks = track_set();
    tracks.views[0].name = "north/IMG_1.jpg".into();
    tracks.views[2].name = "<b>é".into();
    let name = created(&mut jobs, create(create_job_request::Source::TrackSet(tracks))).await.name;
    events(&mut jobs, &name, 0).await;
    let result = jobs.get_job_result(proto::GetJobResultRequest { name }).await.expect("a result").into_inner();
    let names: Vec<&str> = result.views.iter().map(|view| view.name.as_str()).collect();
    assert_eq!(names, ["north/IMG_1.jpg", "", "<b>é"]);
}
