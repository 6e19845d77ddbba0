//! Keys and tenants: who has none learns nothing, and who has one learns nothing of others.

use std::time::Duration;

use prost::Message as _;
use scpsfm::rpc::keys::Sources;
use scpsfm::rpc::proto::calibration_service_client::CalibrationServiceClient;
use scpsfm::rpc::proto::input_service_client::InputServiceClient;
use scpsfm::rpc::proto::job_service_client::JobServiceClient;
use scpsfm::rpc::proto::{self, FILE_DESCRIPTOR_SET, JobState, solve_request::Message, upload_input_request};
use scpsfm::rpc::server::Options;
use tonic::codegen::http::uri::PathAndQuery;
use tonic::transport::Channel;
use tonic::{Code, Request, Status};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_client::HealthClient;
use tonic_reflection::pb::v1;
use tonic_types::StatusExt;

use crate::support::certificates::written;
use crate::support::keys::{Keyed, NORTH, SOUTH, keyed};
use crate::support::server::{TestServer, one_worker, soon};
use crate::support::solvers::{held, quick};
use crate::support::uploads::{id, part, request, start};
use crate::support::wire::{all, create_tracks, solve_request, state_of};

fn two_tenants() -> Options {
    let fixed = format!("north:{NORTH}, south:{SOUTH}").parse().expect("two keys");
    Options { keys: Sources { file: None, fixed: Some(fixed) }, ..Options::default() }
}

/// Every method of the API, as `/package.Service/Method`.
pub fn methods() -> Vec<String> {
    let files = prost_types::FileDescriptorSet::decode(FILE_DESCRIPTOR_SET).expect("decodes");
    let paths = files.file.iter().flat_map(|file| {
        file.service.iter().flat_map(move |service| {
            let path = move |method: &str| format!("/{}.{}/{method}", file.package(), service.name());
            service.method.iter().map(move |method| path(method.name()))
        })
    });
    paths.collect()
}

/// Calls a method with one empty message.
pub async fn call(channel: &Channel, path: &str, authorization: Option<&str>) -> Result<(), Status> {
    let mut grpc = tonic::client::Grpc::new(channel.clone());
    grpc.ready().await.expect("a connection");
    let mut request = Request::new(());
    if let Some(value) = authorization {
        request.metadata_mut().insert("authorization", value.parse().expect("a header"));
    }
    let path: PathAndQuery = path.parse().expect("a path");
    grpc.unary(request, path, tonic_prost::ProstCodec::<(), ()>::default()).await.map(drop)
}

pub fn reason(status: &Status) -> String {
    status.get_details_error_info().map(|info| info.reason).unwrap_or_default()
}

#[tokio::test]
async fn without_a_key_of_this_server_nothing_but_health_answers() {
    let server = TestServer::start_with(quick(), two_tenants(), one_worker()).await;
    let channel = server.channel().await;
    let mut paths = methods();
    assert_eq!(paths.len(), 21);
    paths.push("/grpc.reflection.v1.ServerReflection/ServerReflectionInfo".into());
    paths.push("/scpsfm.v1.JobService/Invented".into());
    let cases = [
        (None, "API_KEY_MISSING"),
        (Some("Bearer"), "API_KEY_MISSING"),
        (Some("Basic north"), "API_KEY_MISSING"),
        (Some("Bearer 0123456789abcdef0123456789abcdef"), "API_KEY_UNKNOWN"),
    ];
    for path in &paths {
        for (authorization, expected) in cases {
            let status = call(&channel, path, authorization).await.expect_err(path);
            assert_eq!((status.code(), reason(&status).as_str()), (Code::Unauthenticated, expected), "{path}");
        }
        let known = call(&channel, path, Some(&format!("Bearer {NORTH}"))).await;
        assert!(known.is_ok() || known.is_err_and(|status| status.code() != Code::Unauthenticated), "{path}");
    }
    HealthClient::new(channel).check(HealthCheckRequest::default()).await.expect("health is open");
}

#[tokio::test]
async fn reflection_can_be_switched_off() {
    let options = Options { reflection: false, ..Options::default() };
    let server = TestServer::start_with(quick(), options, one_worker()).await;
    let mut client = v1::server_reflection_client::ServerReflectionClient::new(server.channel().await);
    let request = v1::ServerReflectionRequest { host: String::new(), message_request: None };
    let status = client.server_reflection_info(tokio_stream::once(request)).await.expect_err("off");
    assert_eq!(status.code(), Code::Unimplemented);
}

/// The clients of one tenant.
struct Tenant {
    jobs: JobServiceClient<Keyed>,
    calibration: CalibrationServiceClient<Keyed>,
    inputs: InputServiceClient<Keyed>,
}

impl Tenant {
    async fn of(server: &TestServer, key: &'static str) -> Self {
        let channel = keyed(&server.channel().await, key);
        Self {
            jobs: JobServiceClient::new(channel.clone()),
            calibration: CalibrationServiceClient::new(channel.clone()),
            inputs: InputServiceClient::new(channel),
        }
    }

    async fn create(&mut self, request: proto::CreateJobRequest) -> Result<proto::Job, Status> {
        Ok(self.jobs.create_job(request).await?.into_inner())
    }

    async fn solve(&mut self, request: proto::CreateJobRequest) -> Result<proto::JobEvent, Status> {
        let messages = tokio_stream::once(solve_request(Message::Config(request)));
        let mut events = self.calibration.solve(messages).await?.into_inner();
        Ok(events.message().await?.expect("a first event"))
    }

    async fn list(&mut self, parent: &str, page_token: &str) -> Result<proto::ListJobsResponse, Status> {
        let request = proto::ListJobsRequest {
            parent: parent.into(),
            page_size: 1,
            page_token: page_token.into(),
            ..Default::default()
        };
        Ok(self.jobs.list_jobs(request).await?.into_inner())
    }

    /// What every call says that names this job, by method; the parent is the job's.
    async fn every_call_on(&mut self, name: &str, job: &proto::CreateJobRequest) -> Vec<(&'static str, Status)> {
        let parent = name.split("/jobs/").next().expect("a parent");
        let create = proto::CreateJobRequest { parent: parent.into(), ..job.clone() };
        let name = || name.to_owned();
        let batch = proto::BatchCreateJobsRequest { parent: parent.into(), requests: vec![create.clone()] };
        let upload = proto::GetUploadStatusRequest { parent: parent.into(), ..Default::default() };
        let inputs = proto::ListInputsRequest { parent: parent.into(), ..Default::default() };
        let delete_input = proto::DeleteInputRequest { name: format!("{parent}/inputs/{}", id(1)) };
        let begin = request(upload_input_request::Message::Start(start(parent, &id(1), 100)));
        let answers = [
            ("GetJob", self.jobs.get_job(proto::GetJobRequest { name: name() }).await.map(drop)),
            (
                "CancelJob",
                self.jobs.cancel_job(proto::CancelJobRequest { name: name(), ..Default::default() }).await.map(drop),
            ),
            (
                "DeleteJob",
                self.jobs.delete_job(proto::DeleteJobRequest { name: name(), ..Default::default() }).await.map(drop),
            ),
            (
                "RetryJob",
                self.jobs.retry_job(proto::RetryJobRequest { name: name(), ..Default::default() }).await.map(drop),
            ),
            (
                "SetJobPriority",
                self.jobs
                    .set_job_priority(proto::SetJobPriorityRequest { name: name(), ..Default::default() })
                    .await
                    .map(drop),
            ),
            (
                "WatchJob",
                self.jobs.watch_job(proto::WatchJobRequest { name: name(), after_sequence: 0 }).await.map(drop),
            ),
            ("GetJobResult", self.jobs.get_job_result(proto::GetJobResultRequest { name: name() }).await.map(drop)),
            (
                "ReadJobResult",
                self.jobs.read_job_result(proto::ReadJobResultRequest { name: name(), offset: 0 }).await.map(drop),
            ),
            ("ListJobs", self.list(parent, "").await.map(drop)),
            ("CreateJob", self.create(create.clone()).await.map(drop)),
            ("Solve", self.solve(create).await.map(drop)),
            ("BatchCreateJobs", self.jobs.batch_create_jobs(batch).await.map(drop)),
            ("GetUploadStatus", self.inputs.get_upload_status(upload).await.map(drop)),
            ("ListInputs", self.inputs.list_inputs(inputs).await.map(drop)),
            ("DeleteInput", self.inputs.delete_input(delete_input).await.map(drop)),
            ("UploadInput", self.inputs.upload_input(tokio_stream::once(begin)).await.map(drop)),
        ];
        answers.map(|(method, answer)| (method, answer.expect_err(method))).into()
    }
}

/// Everything that a status tells, with the name that was asked for left out.
fn told(status: &Status, name: &str) -> String {
    let parent = name.split("/jobs/").next().expect("a parent");
    let all = format!("{:?} {} {:?}", status.code(), status.message(), status.get_error_details());
    all.replace(name, "NAME").replace(parent, "PARENT")
}

#[tokio::test]
async fn of_another_tenants_job_nothing_can_be_learned_or_done() {
    let (solver, hold) = held();
    let server = TestServer::start_with(solver, two_tenants(), one_worker()).await;
    let (mut north, mut south) = (Tenant::of(&server, NORTH).await, Tenant::of(&server, SOUTH).await);
    let request = |parent: &str| proto::CreateJobRequest {
        parent: parent.into(),
        job_id: "mine".into(),
        request_id: "r-1".into(),
        ..create_tracks()
    };
    let theirs = south.create(request("tenants/south")).await.expect("a job").name;
    let watch = proto::WatchJobRequest { name: theirs.clone(), after_sequence: 0 };
    let mut watch = south.jobs.watch_job(watch).await.expect("a watch").into_inner();
    while state_of(&soon(watch.message()).await.expect("an event").expect("no end")) != Some(JobState::Running) {}

    // While it runs, and when its result stands: the same as of a job, and of a tenant, that never was.
    for ended in [false, true] {
        if ended {
            hold.let_go();
            let (events, _) = soon(all(watch)).await;
            // Nobody has cancelled it.
            assert_eq!(events.last().and_then(state_of), Some(JobState::Succeeded));
            watch = south
                .jobs
                .watch_job(proto::WatchJobRequest { name: theirs.clone(), after_sequence: 0 })
                .await
                .expect("a watch")
                .into_inner();
        }
        let of_theirs = north.every_call_on(&theirs, &request("")).await;
        for nothing in ["tenants/south/jobs/none", "tenants/nobody/jobs/mine"] {
            let of_nothing = north.every_call_on(nothing, &request("")).await;
            for ((method, found), (_, expected)) in of_theirs.iter().zip(&of_nothing) {
                assert_eq!(told(found, &theirs), told(expected, nothing), "{method} on {nothing}");
            }
        }
        for (method, status) in &of_theirs {
            assert_eq!(status.code(), Code::NotFound, "{method}");
        }
        // Every method was tried; GetCapabilities and the four of AdminService name nothing.
        assert_eq!(of_theirs.len() + 5, methods().len());
    }
    let job = south.jobs.get_job(proto::GetJobRequest { name: theirs }).await.expect("theirs").into_inner();
    assert_eq!(job.state(), JobState::Succeeded);
}

#[tokio::test]
async fn ids_and_page_tokens_are_each_tenants_own() {
    let server = TestServer::start_with(quick(), two_tenants(), one_worker()).await;
    let (mut north, mut south) = (Tenant::of(&server, NORTH).await, Tenant::of(&server, SOUTH).await);
    let request = |tenant: &str, id: &str| proto::CreateJobRequest {
        parent: format!("tenants/{tenant}"),
        job_id: id.into(),
        request_id: format!("r-{id}"),
        ..create_tracks()
    };
    for id in ["a", "b"] {
        south.create(request("south", id)).await.expect("a job");
    }
    // The same ids, and the same request id by another call: jobs of their own.
    assert_eq!(north.create(request("north", "a")).await.expect("a job").name, "tenants/north/jobs/a");
    assert_eq!(north.solve(request("north", "b")).await.expect("a job").job, "tenants/north/jobs/b");

    let theirs = south.list("tenants/south", "").await.expect("a page").next_page_token;
    assert!(!theirs.is_empty());
    let foreign = north.list("tenants/north", &theirs).await.expect_err("another's token");
    let garbage = north.list("tenants/north", "0123456789abcdef-1-1").await.expect_err("no token");
    assert_eq!(told(&foreign, "-"), told(&garbage, "-"));
    let mut listed = Vec::new();
    let mut token = String::new();
    loop {
        let page = north.list("tenants/north", &token).await.expect("a page");
        listed.extend(page.jobs.into_iter().map(|job| job.name));
        token = page.next_page_token;
        if token.is_empty() {
            break;
        }
    }
    assert_eq!(listed, ["tenants/north/jobs/b", "tenants/north/jobs/a"]);

    // What others have made shows nowhere in a token: it holds the query, a time and an id of the tenant's own.
    let token = north.list("tenants/north", "").await.expect("a page").next_page_token;
    let (_, rest) = token.split_once('-').expect("a query");
    let (micros, id) = rest.split_once('-').expect("a time");
    let job = proto::GetJobRequest { name: listed[0].clone() };
    let created = north.jobs.get_job(job).await.expect("a job").into_inner().create_time.expect("a time");
    let micros = i64::from_str_radix(micros, 16).expect("a number");
    assert_eq!((micros / 1_000_000, id), (created.seconds, "b"));
}

/// A server whose keys are in a file that is looked at all the time.
async fn with_a_file_of_keys(solver: scpsfm::engine::Solver, file: std::path::PathBuf) -> TestServer {
    let keys = Sources { file: Some(file), fixed: None };
    let options = Options { keys, look_every: Duration::from_millis(10), ..Options::default() };
    TestServer::start_with(solver, options, one_worker()).await
}

async fn until_let_in(tenant: &mut Tenant, parent: &str) {
    soon(async {
        while tenant.list(parent, "").await.is_err() {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    })
    .await;
}

#[tokio::test]
async fn a_file_of_keys_is_read_again_and_open_streams_go_on() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let write = |text: &str| written(directory.path(), "keys.txt", text);
    let file = write(&format!("north:{NORTH}\n"));
    let (solver, hold) = held();
    let server = with_a_file_of_keys(solver, file).await;
    let (mut north, mut south) = (Tenant::of(&server, NORTH).await, Tenant::of(&server, SOUTH).await);
    let request = proto::CreateJobRequest { parent: "tenants/north".into(), ..create_tracks() };
    let name = north.create(request).await.expect("a job").name;
    let watch = north.jobs.watch_job(proto::WatchJobRequest { name, after_sequence: 0 }).await;
    let watch = watch.expect("a watch").into_inner();
    assert_eq!(south.list("tenants/south", "").await.expect_err("no key yet").code(), Code::Unauthenticated);

    // What is no list of keys changes nothing; after it, a new key is let in, and who was in is not disturbed.
    write("north");
    write(&format!("south:{SOUTH}\nnorth:{NORTH}\n"));
    until_let_in(&mut south, "tenants/south").await;
    north.list("tenants/north", "").await.expect("still let in");
    hold.let_go();
    let (events, end) = soon(all(watch)).await;
    end.expect("a stream that was open goes on");
    assert_eq!(events.last().and_then(state_of), Some(JobState::Succeeded));
}

#[tokio::test]
async fn a_withdrawn_key_ends_its_streams_both_ways_and_nobody_elses() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let write = |text: &str| written(directory.path(), "keys.txt", text);
    let file = write(&format!("south:{SOUTH}\nnorth:{NORTH}\n"));
    let (solver, hold) = held();
    let server = with_a_file_of_keys(solver, file).await;
    let (mut north, mut south) = (Tenant::of(&server, NORTH).await, Tenant::of(&server, SOUTH).await);
    let mut watches = Vec::new();
    for (tenant, parent) in [(&mut north, "tenants/north"), (&mut south, "tenants/south")] {
        let name = tenant.create(proto::CreateJobRequest { parent: parent.into(), ..create_tracks() }).await;
        let request = proto::WatchJobRequest { name: name.expect("a job").name, after_sequence: 0 };
        watches.push(tenant.jobs.watch_job(request).await.expect("a watch").into_inner());
    }
    // And one that sends: an upload of which half has come.
    let (sender, messages) = tokio::sync::mpsc::channel(8);
    let mut sending = north.inputs.clone();
    let messages = tokio_stream::wrappers::ReceiverStream::new(messages);
    let upload = tokio::spawn(async move { sending.upload_input(messages).await });
    let bytes = vec![1; 1_000];
    for message in part("tenants/north", &id(1), &bytes, 0..500, 100) {
        sender.send(message).await.expect("taken");
    }
    soon(async {
        while sender.capacity() < 8 {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    })
    .await;
    // What has left this side arrives meanwhile, or the part of it that does is kept.
    tokio::time::sleep(Duration::from_millis(50)).await;

    write(&format!("south:{SOUTH}\n"));
    let withdrawn = |status: Status| {
        assert_eq!((status.code(), reason(&status).as_str()), (Code::Unauthenticated, "API_KEY_WITHDRAWN"), "{status}");
    };
    let theirs = watches.remove(0);
    withdrawn(soon(all(theirs)).await.1.expect_err("cut off"));
    withdrawn(soon(upload).await.expect("no panic").expect_err("cut off"));
    assert_eq!(north.list("tenants/north", "").await.expect_err("withdrawn").code(), Code::Unauthenticated);
    south.list("tenants/south", "").await.expect("let in");

    // A key that moves to another tenant was withdrawn from the first.
    write(&format!("north:{SOUTH}\n"));
    let (_, end) = soon(all(watches.remove(0))).await;
    withdrawn(end.expect_err("another tenant's now"));
    hold.let_go();
    // The upload was told of its end on the way in too: what had come is kept, and no more is taken.
    until_let_in(&mut south, "tenants/north").await;
    let asked = proto::GetUploadStatusRequest { parent: "tenants/north".into(), upload_id: id(1) };
    soon(async {
        loop {
            let status = south.inputs.get_upload_status(asked.clone()).await.expect("begun").into_inner();
            if status.committed_bytes > 0 {
                break assert_eq!(status.committed_bytes % 100, 0);
            }
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    })
    .await;
}

/// When something was, to be compared.
fn moment(time: Option<&prost_types::Timestamp>) -> Option<(i64, i32)> {
    time.map(|time| (time.seconds, time.nanos))
}

#[tokio::test]
async fn a_tenant_with_a_long_queue_hardly_delays_the_single_job_of_another() {
    const MANY: usize = 300;
    let (solver, hold) = held();
    let mut engine = one_worker();
    engine.queue.max_jobs = 2 * MANY as u64;
    let server = TestServer::start_with(solver, two_tenants(), engine).await;
    let (mut north, mut south) = (Tenant::of(&server, NORTH).await, Tenant::of(&server, SOUTH).await);
    // Whatever priority it gives its own.
    let urgent = proto::Job { priority: 9, ..Default::default() };
    let request = proto::CreateJobRequest { job: Some(urgent), ..create_tracks() };
    let request = proto::CreateJobRequest { parent: "tenants/north".into(), ..request };
    let batch = proto::BatchCreateJobsRequest { parent: "tenants/north".into(), requests: vec![request; MANY] };
    let created = north.jobs.batch_create_jobs(batch).await.expect("jobs").into_inner().jobs;
    let get = |job: &proto::Job| proto::GetJobRequest { name: job.name.clone() };
    soon(async {
        while north.jobs.get_job(get(&created[0])).await.expect("a job").into_inner().state() != JobState::Running {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    })
    .await;
    let request = proto::CreateJobRequest { parent: "tenants/south".into(), ..create_tracks() };
    let single = south.create(request).await.expect("a job");
    hold.let_go();
    let watch = proto::WatchJobRequest { name: single.name.clone(), after_sequence: 0 };
    let watch = south.jobs.watch_job(watch).await.expect("a watch").into_inner();
    let (events, _) = soon(all(watch)).await;
    assert_eq!(events.last().and_then(state_of), Some(JobState::Succeeded));
    let single = south.jobs.get_job(get(&single)).await.expect("a job").into_inner();
    let (came, began) = (moment(single.create_time.as_ref()), moment(single.start_time.as_ref()));

    let list = proto::ListJobsRequest { parent: "tenants/north".into(), page_size: 1000, ..Default::default() };
    let jobs = north.jobs.list_jobs(list).await.expect("a page").into_inner().jobs;
    assert_eq!(jobs.len(), MANY);
    let begins = jobs.iter().filter_map(|job| moment(job.start_time.as_ref())).map(Some);
    let before: Vec<_> = begins.filter(|&begin| begin > came && begin < began).collect();
    assert!(before.len() <= 2, "{} of its jobs were begun while the other tenant's waited", before.len());
}
