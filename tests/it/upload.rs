//! Uploads to the real program: over its death, from the shell, over connections that break, between tenants.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::process::Stdio;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use scpsfm::domain::RawInput;
use scpsfm::rpc::proto::input_service_client::InputServiceClient;
use scpsfm::rpc::proto::{self, upload_input_request::Message};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Code;
use tonic::transport::Channel;

use crate::support::postgres;
use crate::support::program::{Serving, run};
use crate::support::scrape::Page;
use crate::support::server::soon;
use crate::support::uploads::{DEFAULT, encoded, finish, id, part, reason, request, sha256};
use crate::support::wire::raw;

type Inputs = InputServiceClient<Channel>;

async fn connected(server: &Serving) -> Inputs {
    InputServiceClient::connect(server.grpc.clone()).await.expect("a connection")
}

async fn status_of(inputs: &mut Inputs, number: u32) -> proto::UploadStatus {
    let request = proto::GetUploadStatusRequest { parent: DEFAULT.into(), upload_id: id(number) };
    inputs.get_upload_status(request).await.expect("is there").into_inner()
}

/// Sends half of the bytes, waits until some of them are stored, and leaves the stream open.
async fn half_sent(inputs: &mut Inputs, number: u32, bytes: &[u8]) -> mpsc::Sender<proto::UploadInputRequest> {
    let (sender, messages) = mpsc::channel(64);
    let mut sending = inputs.clone();
    tokio::spawn(async move { sending.upload_input(ReceiverStream::new(messages)).await });
    for message in part(DEFAULT, &id(number), bytes, 0..bytes.len() / 2, 100_000) {
        sender.send(message).await.expect("taken");
    }
    soon(async {
        loop {
            let request = proto::GetUploadStatusRequest { parent: DEFAULT.into(), upload_id: id(number) };
            let status = inputs.get_upload_status(request).await;
            if status.is_ok_and(|status| status.into_inner().committed_bytes > 0) {
                break;
            }
            tokio::time::sleep(std::time::Duration::from_millis(10)).await;
        }
    })
    .await;
    sender
}

/// Sends what is missing.
async fn goes_on(inputs: &mut Inputs, number: u32, bytes: &[u8]) -> proto::Input {
    let status = status_of(inputs, number).await;
    let from = usize::try_from(status.committed_bytes).expect("an offset");
    assert!((1..bytes.len()).contains(&from), "{from} of {}", bytes.len());
    let mut rest = part(DEFAULT, &id(number), bytes, from..bytes.len(), 100_000);
    rest.push(request(Message::Finish(finish(bytes))));
    soon(inputs.upload_input(tokio_stream::iter(rest))).await.expect("an input").into_inner()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn half_an_upload_outlives_the_server_that_was_killed() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let bytes = encoded(&raw(2, 100_000));
    let server = Serving::start(directory.path());
    let open = half_sent(&mut connected(&server).await, 1, &bytes).await;
    // SIGKILL, as by a power cut.
    drop(server);
    drop(open);
    let server = Serving::start(directory.path());
    let input = goes_on(&mut connected(&server).await, 1, &bytes).await;
    assert_eq!((input.sha256, input.observation_count), (sha256(&bytes), 200_000));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_upload_goes_on_through_another_server_of_the_database() {
    let Some(cluster) = postgres::shared("an upload over two servers") else { return };
    let url = cluster.database().await;
    let bytes = encoded(&raw(2, 100_000));
    let start = || Serving::on_database(&url, &[], Stdio::null());
    let (first, second) = (start(), start());
    let open = half_sent(&mut connected(&first).await, 1, &bytes).await;
    let mut elsewhere = connected(&second).await;
    let input = goes_on(&mut elsewhere, 1, &bytes).await;
    assert_eq!(input.sha256, sha256(&bytes));
    // The stream that is still open on the first server has lost the upload.
    drop(open);
    assert_eq!(status_of(&mut connected(&first).await, 1).await.input, Some(input));
}

/// Lets connections through to a server and cuts the first so many of them after so many bytes.
struct Cutter {
    address: String,
    connections: Arc<AtomicUsize>,
}

impl Cutter {
    fn start(server: &str, cuts: usize, after_bytes: usize) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
        let address = format!("http://{}", listener.local_addr().expect("an address"));
        let to = server.trim_start_matches("http://").to_owned();
        let connections = Arc::new(AtomicUsize::new(0));
        let count = Arc::clone(&connections);
        std::thread::spawn(move || {
            for caller in listener.incoming().flatten() {
                let number = count.fetch_add(1, Ordering::SeqCst);
                let server = TcpStream::connect(&to).expect("the server listens");
                let limit = if number < cuts { after_bytes } else { usize::MAX };
                let (back, to_caller) = (server.try_clone().expect("a socket"), caller.try_clone().expect("a socket"));
                std::thread::spawn(move || pass(back, to_caller, usize::MAX));
                std::thread::spawn(move || pass(caller, server, limit));
            }
        });
        Self { address, connections }
    }
}

fn pass(mut from: TcpStream, mut to: TcpStream, limit: usize) {
    let (mut buffer, mut passed) = ([0; 16 * 1024], 0);
    while let Ok(count) = from.read(&mut buffer) {
        if count == 0 || to.write_all(&buffer[..count]).is_err() {
            break;
        }
        passed += count;
        if passed > limit {
            break;
        }
    }
    let _ = (from.shutdown(std::net::Shutdown::Both), to.shutdown(std::net::Shutdown::Both));
}

fn written(at: &Path, raw: &RawInput) -> String {
    let mut table = String::from("view,track,x,y\n");
    for k in 0..raw.view.len() {
        table.push_str(&format!("{},{},{},{}\n", raw.view[k], raw.track[k], raw.x[k], raw.y[k]));
    }
    std::fs::write(at, table).expect("written");
    at.to_str().expect("a path of ours").to_owned()
}

fn uploaded_bytes(server: &Serving) -> f64 {
    Page::parse(&server.page("/metrics")).value("scpsfm_uploaded_bytes_total")
}

#[test]
fn a_command_uploads_over_cut_connections_and_sends_nothing_twice() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let server = Serving::start(&directory.path().join("data"));
    let tracks = raw(2, 150_000);
    let bytes = encoded(&tracks).len();
    let file = written(&directory.path().join("observations.csv"), &tracks);
    // Each of the cut connections carries some chunks.
    let cutter = Cutter::start(&server.grpc, 2, bytes / 3);
    let upload = |to: &str| {
        let run = run(["upload", &file, "--width", "1000", "--height", "1000", "--server", to]);
        assert_eq!(run.code, Some(0), "{run:?}");
        run
    };
    let run_over_cuts = upload(&cutter.address);
    let name = run_over_cuts.stdout.trim().to_owned();
    assert!(name.starts_with("tenants/default/inputs/") && run_over_cuts.stdout.lines().count() == 1, "{name}");
    assert!(run_over_cuts.stderr.contains("waiting up to"), "{}", run_over_cuts.stderr);
    assert!(cutter.connections.load(Ordering::SeqCst) >= 3);
    let stored = uploaded_bytes(&server);
    // Its views have sizes, 8 bytes more each and their lengths'.
    assert!((bytes as f64..bytes as f64 + 100.0).contains(&stored), "{stored} of {bytes}");
    assert_eq!(upload(&server.grpc).stdout.trim(), name, "the same bytes are the same input");
    assert_eq!(uploaded_bytes(&server), stored);

    let submit = |arguments: &[&str]| run(["submit", "--server", &server.grpc].iter().chain(arguments));
    let last = name.rsplit('/').next().expect("an id");
    for given in [name.as_str(), last] {
        let job = submit(&["--input", given, "--method", "geometry"]);
        assert_eq!(job.code, Some(0), "{job:?}");
        let got = run(["get", job.stdout.trim(), "--server", &server.grpc]);
        assert!(got.stdout.contains("2 views, 150000 tracks"), "{got:?}");
    }
    let nothing = submit(&["--input", &id(9)]);
    assert_eq!(nothing.code, Some(65), "{nothing:?}");
    assert!(nothing.stderr.contains("there is no input"), "{nothing:?}");
    for wrong in [&["--input", "a/b"][..], &["--input", last, &file], &[]] {
        assert_eq!(submit(wrong).code, Some(2), "{wrong:?}");
    }
    let bad = directory.path().join("bad.csv");
    std::fs::write(&bad, "view,track,x,y\n0,0,1,1\n1,0,2e9,1\n").expect("written");
    let refused = run(["upload", bad.to_str().expect("a path"), "--server", &server.grpc]);
    assert_eq!(refused.code, Some(65), "{refused:?}");
    assert!(refused.stderr.contains("line 3"), "{refused:?}");
}

/// Most memory that a process ever had, in MB, as Linux tells.
fn peak_mb(server: &Serving) -> u64 {
    let path = format!("/proc/{}/status", server.running.0.id());
    let status = std::fs::read_to_string(path).expect("a process of ours");
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).expect("a peak");
    let kilobytes: u64 = line.trim().trim_end_matches(" kB").parse().expect("a number");
    kilobytes / 1024
}

/// An input with an unknown field of that length before what counts: valid, and long.
fn padded(padding: usize) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(padding + 10_000);
    prost::encoding::encode_key(15, prost::encoding::WireType::LengthDelimited, &mut bytes);
    prost::encoding::encode_varint(padding as u64, &mut bytes);
    bytes.resize(bytes.len() + padding, 0xa5);
    bytes.extend(encoded(&raw(3, 40)));
    bytes
}

async fn upload_of_a_length_takes_little_memory(padding: usize) {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let server = Serving::start(directory.path());
    let mut inputs = connected(&server).await;
    let before = peak_mb(&server);
    let bytes = padded(padding);
    let begun = std::time::Instant::now();
    let mut messages = part(DEFAULT, &id(1), &bytes, 0..bytes.len(), 1 << 20);
    messages.push(request(Message::Finish(finish(&bytes))));
    let input = inputs.upload_input(tokio_stream::iter(messages)).await.expect("an input").into_inner();
    assert_eq!((input.observation_count, input.size_bytes), (120, bytes.len() as i64));
    let grown = peak_mb(&server) - before;
    eprintln!("{} MB in {:.1} s, {grown} MB more memory", bytes.len() >> 20, begun.elapsed().as_secs_f64());
    assert!(grown < 64, "{grown} MB");
    // What the upload took is given back in time.
    let database = directory.path().join("scpsfm.db");
    let patience = std::time::Instant::now();
    while database.metadata().expect("the database").len() > 32 << 20 {
        assert!(patience.elapsed().as_secs() < 300, "the database does not shrink");
        tokio::time::sleep(std::time::Duration::from_millis(100)).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_long_upload_takes_little_memory_and_gives_its_space_back() {
    upload_of_a_length_takes_little_memory(160 << 20).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "3 GB of memory and disk for a minute or two"]
async fn the_longest_upload_takes_little_memory_and_gives_its_space_back() {
    upload_of_a_length_takes_little_memory((1 << 30) - 100_000).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn of_another_tenants_upload_nothing_is_learned() {
    use crate::support::keys::{NORTH, SOUTH, keyed};
    let directory = tempfile::tempdir().expect("a temporary directory");
    let keys = format!("north:{NORTH},south:{SOUTH}");
    let server = Serving::start_with(directory.path(), &[("SCPSFM_AUTH__KEYS", &keys)], Stdio::null());
    let channel = Channel::from_shared(server.grpc.clone()).expect("a URL").connect().await.expect("a connection");
    let mut north = InputServiceClient::new(keyed(&channel, NORTH));
    let mut south = InputServiceClient::new(keyed(&channel, SOUTH));
    let bytes = encoded(&raw(3, 40));
    let half = part("tenants/north", &id(1), &bytes, 0..500, 100);
    assert_eq!(
        north.upload_input(tokio_stream::iter(half.clone())).await.expect_err("half").code(),
        Code::InvalidArgument
    );
    let ask = |parent: &str, number| proto::GetUploadStatusRequest { parent: parent.into(), upload_id: id(number) };
    // By its own parent the id is another's, by theirs the tenant is out of reach: whether the upload exists or not.
    for number in [1, 2] {
        let own = south.get_upload_status(ask("tenants/south", number)).await.expect_err("none");
        assert_eq!((own.code(), reason(&own).as_str()), (Code::NotFound, "UPLOAD_NOT_FOUND"));
        let theirs = south.get_upload_status(ask("tenants/north", number)).await.expect_err("out of reach");
        assert_eq!((theirs.code(), reason(&theirs).as_str()), (Code::NotFound, "TENANT_NOT_FOUND"));
    }
    let intruding = south.upload_input(tokio_stream::iter(half)).await.expect_err("out of reach");
    assert_eq!((intruding.code(), reason(&intruding).as_str()), (Code::NotFound, "TENANT_NOT_FOUND"));
    // The same id is each tenant's own.
    let mut own = part("tenants/south", &id(1), &bytes, 0..bytes.len(), 1_000);
    own.push(request(Message::Finish(finish(&bytes))));
    let input = south.upload_input(tokio_stream::iter(own)).await.expect("an input").into_inner();
    assert_eq!(input.name, format!("tenants/south/inputs/{}", id(1)));
    let status = north.get_upload_status(ask("tenants/north", 1)).await.expect("still half").into_inner();
    assert_eq!((status.committed_bytes, status.input), (500, None));
}
