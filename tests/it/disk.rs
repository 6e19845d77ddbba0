//! A disk that is full, and a database that was cut off.

use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use scpsfm::rpc::proto::input_service_client::InputServiceClient;
use scpsfm::rpc::proto::job_service_client::JobServiceClient;
use scpsfm::rpc::proto::{self, JobState};
use scpsfm::synthetic::SceneOptions;
use tonic::transport::Channel;
use tonic::{Code, Status};

use crate::support::live::{connected, created, is_served, reaches, scene_request};
use crate::support::program::{Serving, run};
use crate::support::scrape::Page;
use crate::support::server::soon;
use crate::support::uploads::{DEFAULT, encoded, id, part, reason, whole};
use crate::support::wire::{all, create_raw, create_tracks, raw};

/// Size of the disk: a few of the inputs below, each in the store and in its log.
const DISK: &str = "size=96m";

/// A file system of its own, as small as we like; unmounted when dropped.
struct SmallDisk {
    folder: tempfile::TempDir,
}

impl SmallDisk {
    /// Without the right to mount, the test is skipped, loudly.
    fn mount(what: &str) -> Option<Self> {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let mounted = cfg!(target_os = "linux")
            && Command::new("mount")
                .args(["-t", "tmpfs", "-o", DISK, "tmpfs"])
                .arg(folder.path())
                .stderr(Stdio::null())
                .status()
                .is_ok_and(|status| status.success());
        if mounted {
            return Some(Self { folder });
        }
        let missing = "a small file system cannot be mounted here (it takes root)";
        assert!(std::env::var_os("SCPSFM_REQUIRE_MOUNT").is_none(), "{missing}");
        // Past the capture of a passing test's output.
        writeln!(std::io::stderr(), "SKIPPED {what}: {missing}").expect("stderr");
        None
    }

    fn path(&self) -> &Path {
        self.folder.path()
    }

    /// Takes all the room but this much, by a file that is returned.
    fn fill(&self, left_bytes: usize) -> PathBuf {
        let path = self.path().join("filler");
        let mut file = File::create(&path).expect("a file");
        while file.write_all(&[1; 65_536]).is_ok() {}
        let length = file.metadata().expect("its length").len();
        file.set_len(length.saturating_sub(left_bytes as u64)).expect("shorter");
        path
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg(self.folder.path()).status();
    }
}

/// Asserts that a call was refused for want of room, with words for whoever runs the server.
fn is_full(status: &Status) {
    assert_eq!((status.code(), reason(status).as_str()), (Code::ResourceExhausted, "STORE_FULL"), "{status:?}");
    assert!(status.message().contains("space"), "{status:?}");
}

/// Creates jobs of 32 kB, then small ones, until there is no room for one more, and returns their names. The store
/// finds room of its own where it can, which small ones alone would take more of than a queue holds.
async fn created_until_full(jobs: &mut JobServiceClient<Channel>) -> Vec<String> {
    let mut names = Vec::new();
    for request in [create_raw(&raw(20, 100)), create_tracks()] {
        let refused = loop {
            match jobs.create_job(request.clone()).await {
                Ok(job) => names.push(job.into_inner().name),
                Err(status) => break status,
            }
            assert!(names.len() < 10_000, "the disk never fills up");
        };
        is_full(&refused);
    }
    names
}

/// Creates a job, which is refused for want of room until the store has its reserve back.
async fn created_once_there_is_room(jobs: &mut JobServiceClient<Channel>) -> String {
    let created = async {
        loop {
            match jobs.create_job(create_tracks()).await {
                Ok(job) => break job.into_inner().name,
                Err(status) => is_full(&status),
            }
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    };
    soon(created).await
}

/// The end of an input's upload, or why there is none.
async fn upload(server: &Serving, messages: Vec<proto::UploadInputRequest>) -> Result<proto::Input, Status> {
    let mut inputs = InputServiceClient::connect(server.grpc.clone()).await.expect("a connection");
    inputs.upload_input(tokio_stream::iter(messages)).await.map(tonic::Response::into_inner)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_full_disk_is_told_and_loses_nothing_and_room_is_all_it_takes() {
    let Some(disk) = SmallDisk::mount("a full disk") else { return };
    let data_dir = disk.path().join("data");
    let server = Serving::start(&data_dir);
    let mut jobs = connected(&server).await;
    let first = created(&mut jobs, create_tracks()).await;
    assert_eq!(reaches(&mut jobs, &first, &[JobState::Succeeded]).await, JobState::Succeeded);
    let bytes = encoded(&raw(20, 20_000));
    assert!(bytes.len() > 4 << 20, "larger than what is left");
    let sent = upload(&server, part(DEFAULT, &id(1), &bytes, 0..1 << 20, 1 << 20)).await;
    assert_eq!(sent.expect_err("its finish is missing").code(), Code::InvalidArgument);

    let filler = disk.fill(1 << 20);
    is_full(&upload(&server, whole(DEFAULT, &id(2), &bytes, 1 << 20)).await.expect_err("no room"));
    // Small jobs fit until they do not.
    disk.fill(0);
    let acknowledged = created_until_full(&mut jobs).await;
    println!("{} jobs fitted into what was left", acknowledged.len());
    // What is there can be read.
    is_served(&server.grpc).await;
    jobs.get_job(proto::GetJobRequest { name: first.clone() }).await.expect("the first job");

    std::fs::remove_file(filler).expect("room again");
    for name in &acknowledged {
        assert_eq!(reaches(&mut jobs, name, &[JobState::Succeeded, JobState::Failed]).await, JobState::Succeeded);
    }
    let next = created_once_there_is_room(&mut jobs).await;
    assert_eq!(reaches(&mut jobs, &next, &[JobState::Succeeded]).await, JobState::Succeeded);
    let input = upload(&server, whole(DEFAULT, &id(3), &bytes, 1 << 20)).await.expect("an input");
    assert_eq!(input.size_bytes, bytes.len() as i64);

    // Killed, and back: everything that was acknowledged is there, the first upload's bytes too.
    drop(server);
    let server = Serving::start(&data_dir);
    let mut jobs = connected(&server).await;
    for name in acknowledged.iter().chain([&first, &next]) {
        let job = jobs.get_job(proto::GetJobRequest { name: name.clone() }).await.expect("acknowledged").into_inner();
        assert_eq!(job.state(), JobState::Succeeded, "{name}");
    }
    let mut inputs = InputServiceClient::connect(server.grpc.clone()).await.expect("a connection");
    let status = proto::GetUploadStatusRequest { parent: DEFAULT.into(), upload_id: id(1) };
    let status = inputs.get_upload_status(status).await.expect("the upload of the beginning").into_inner();
    assert_eq!(status.committed_bytes, 1 << 20);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn on_a_full_disk_a_server_starts_and_room_is_made_through_it() {
    let Some(disk) = SmallDisk::mount("making room on a full disk") else { return };
    let data_dir = disk.path().join("data");
    let reserve = data_dir.join("scpsfm.reserve");
    let server = Serving::start(&data_dir);
    let mut jobs = connected(&server).await;
    let ended = created(&mut jobs, create_tracks()).await;
    assert_eq!(reaches(&mut jobs, &ended, &[JobState::Succeeded]).await, JobState::Succeeded);
    // Nothing to be found, so that the one worker is busy for as long as this takes.
    let hopeless = SceneOptions { views: 10, tracks: 3_000, outliers: 1.0, ..SceneOptions::default() };
    let busy = created(&mut jobs, scene_request(&hopeless)).await;
    assert!(reserve.exists());
    // At once, so that the log is longer than the disk has room to write back.
    let request = proto::BatchCreateJobsRequest {
        parent: DEFAULT.into(),
        requests: (0..60).map(|_| create_raw(&raw(20, 2_000))).collect(),
    };
    let batch = jobs.batch_create_jobs(request).await.expect("room for them").into_inner();
    let mut waiting: Vec<String> = batch.jobs.into_iter().map(|job| job.name).collect();

    // The index of the log, which is made anew at a start: without a byte left.
    drop(server);
    std::fs::remove_file(data_dir.join("scpsfm.db-shm")).expect("an index");
    disk.fill(0);
    let server = Serving::start(&data_dir);
    let mut jobs = connected(&server).await;
    waiting.extend(created_until_full(&mut jobs).await);
    soon(page_says(&server, "/readyz", "full")).await;
    assert_eq!(told_full(&server), 1.0);
    for name in waiting.iter().chain([&busy]) {
        let request = proto::CancelJobRequest { name: name.clone(), etag: String::new() };
        jobs.cancel_job(request).await.expect("to cancel takes no room");
        assert_eq!(reaches(&mut jobs, name, &[JobState::Cancelled, JobState::Succeeded]).await, JobState::Cancelled);
    }
    for (place, name) in waiting.iter().chain([&busy, &ended]).enumerate() {
        if place == waiting.len() / 2 {
            // What gives space back comes round a few times, and must not take the room of those that are deleted next.
            tokio::time::sleep(Duration::from_secs(4)).await;
        }
        let request = proto::DeleteJobRequest { name: name.clone(), etag: String::new() };
        jobs.delete_job(request).await.expect("to delete takes no room");
    }
    // What was in the way is gone, and once there is a reserve again, new jobs come in by themselves.
    let next = created_once_there_is_room(&mut jobs).await;
    assert!(reserve.exists());
    assert_eq!(reaches(&mut jobs, &next, &[JobState::Succeeded]).await, JobState::Succeeded);
    soon(page_says(&server, "/readyz", "ready\n")).await;
    assert_eq!(told_full(&server), 0.0);
}

/// Bytes beside the reserve: fewer than a result, and enough for a reserve to be made anew once it is given up.
const BESIDE: usize = 4_500_000;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_result_that_needs_the_reserve_has_it() {
    let Some(disk) = SmallDisk::mount("a result on a nearly full disk") else { return };
    let data_dir = disk.path().join("data");
    let handing_back = [("SCPSFM_ENGINE__DRAIN_SECONDS", "0")];
    let mut server = Serving::start_with(&data_dir, &handing_back, Stdio::null());
    let mut jobs = connected(&server).await;
    let large = SceneOptions { views: 20, tracks: 20_000, outliers: 0.3, ..SceneOptions::default() };
    let mut request = scene_request(&large);
    // Seconds, in which the server is sent away.
    let method = proto::Method::Paper as i32;
    let settings = proto::SolveSettings { method, iterations: Some(60), ..Default::default() };
    request.job = Some(proto::Job { settings: Some(settings), ..Default::default() });
    let name = created(&mut jobs, request).await;
    assert_eq!(reaches(&mut jobs, &name, &[JobState::Running]).await, JobState::Running);
    server.running.signal(rustix::process::Signal::TERM);
    assert!(tokio::task::block_in_place(|| server.running.wait()).success(), "a clean end, which writes the log back");
    assert!(!data_dir.join("scpsfm.db-wal").exists(), "the log is written back");
    assert!(data_dir.join("scpsfm.reserve").exists());

    disk.fill(BESIDE);
    let server = Serving::start(&data_dir);
    let mut jobs = connected(&server).await;
    let states = [JobState::Succeeded, JobState::Failed];
    assert_eq!(reaches(&mut jobs, &name, &states).await, JobState::Succeeded);
    let job = jobs.get_job(proto::GetJobRequest { name: name.clone() }).await.expect("the job").into_inner();
    assert_eq!(job.attempt_count, 2, "the one that was given back, and the one that solved it");
    let request = proto::ReadJobResultRequest { name, offset: 0 };
    let (chunks, _) = all(jobs.read_job_result(request).await.expect("a result").into_inner()).await;
    assert!(chunks[0].size_bytes > BESIDE as i64, "{} bytes", chunks[0].size_bytes);
}

/// Waits until a page, which is there all the time, holds these words.
async fn page_says(server: &Serving, path: &str, words: &str) {
    while !tokio::task::block_in_place(|| server.page(path)).contains(words) {
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
}

/// What the metrics say of the disk.
fn told_full(server: &Serving) -> f64 {
    tokio::task::block_in_place(|| Page::parse(&server.page("/metrics"))).value("scpsfm_store_full")
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_database_that_was_cut_off_is_told_at_the_start_and_left_as_it_is() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let data_dir = directory.path().join("data");
    let mut server = Serving::start(&data_dir);
    let mut jobs = connected(&server).await;
    let name = created(&mut jobs, create_tracks()).await;
    reaches(&mut jobs, &name, &[JobState::Succeeded]).await;
    server.running.signal(rustix::process::Signal::TERM);
    assert!(tokio::task::block_in_place(|| server.running.wait()).success(), "a clean end");
    // As long as it is there, it mends what is missing.
    assert!(!data_dir.join("scpsfm.db-wal").exists(), "the log is written back");

    let database = data_dir.join("scpsfm.db");
    let whole = std::fs::read(&database).expect("the database");
    let start = || {
        let listen = ["--listen", "127.0.0.1:0", "--metrics-listen", "127.0.0.1:0", "--data-dir"];
        let path = data_dir.to_str().expect("UTF-8");
        tokio::task::block_in_place(|| run(["serve"].iter().chain(&listen).copied().chain([path])))
    };
    // In the header, after it, within a page, in the middle.
    for length in [50, 100, 5_000, whole.len() / 2] {
        std::fs::write(&database, &whole[..length]).expect("written");
        let refused = start();
        assert_eq!(refused.code, Some(1), "{length} bytes: {}", refused.stderr);
        assert!(refused.stderr.contains("corrupt") && refused.stderr.contains("data"), "{}", refused.stderr);
        assert!(!refused.stderr.contains("panicked"), "{}", refused.stderr);
        assert_eq!(std::fs::read(&database).expect("still there"), whole[..length], "{length} bytes");
    }
    std::fs::write(&database, &whole).expect("written");
    let server = Serving::start(&data_dir);
    let mut jobs = connected(&server).await;
    jobs.get_job(proto::GetJobRequest { name }).await.expect("the job");
}
