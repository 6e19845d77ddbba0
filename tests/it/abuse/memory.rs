//! Callers that hold the server's memory: inputs that never end, results that nobody reads.

use std::process::Stdio;
use std::sync::Arc;
use std::time::Duration;

use futures_util::future::join_all;
use prost::Message as _;
use scpsfm::rpc::convert;
use scpsfm::rpc::convert::input_message::InputMessage;
use scpsfm::rpc::proto::calibration_service_client::CalibrationServiceClient;
use scpsfm::rpc::proto::job_service_client::JobServiceClient;
use scpsfm::rpc::proto::{self, JobState, create_job_request::Source, solve_request::Message};
use scpsfm::rpc::server::Options;
use tokio::sync::mpsc;
use tokio_stream::StreamExt;
use tokio_stream::wrappers::ReceiverStream;
use tonic::client::Grpc;
use tonic::codec::CompressionEncoding;
use tonic::codegen::http::uri::PathAndQuery;
use tonic::transport::Channel;
use tonic::{Code, Request, Status};
use tonic_types::StatusExt;

use super::bytes::Raw;
use crate::support::live::{connected, created, lasting, reaches, small};
use crate::support::memory::peak_mb;
use crate::support::program::Serving;
use crate::support::scrape::Page;
use crate::support::server::{TestServer, one_worker, soon};
use crate::support::solvers::quick;
use crate::support::uploads::reason;
use crate::support::wire::{all, create, create_raw, raw, solve_request};

/// Bytes that calls may hold: room for a few of the inputs below.
const BUDGET: u64 = 16 << 20;

/// Callers that each send most of an input and then nothing.
const STREAMS: usize = 20;

/// What each of them is charged at least, once its chunk of 40,000 observations was taken; less is charged before.
const CHUNK_BYTES: f64 = 2e6;

fn is_refusal(status: &Status) -> bool {
    let refused = status.code() == Code::ResourceExhausted && reason(status) == "MEMORY";
    assert!(!refused || status.get_details_retry_info().is_some_and(|info| info.retry_delay.is_some()), "{status:?}");
    refused
}

fn scraped(server: &Serving) -> Page {
    tokio::task::block_in_place(|| Page::parse(&server.page("/metrics")))
}

/// Begins a Solve, sends the head and a chunk of a megabyte, and keeps the stream open until it is dropped.
async fn withholding(url: String, refused: mpsc::Sender<Status>) {
    let mut client = CalibrationServiceClient::connect(url).await.expect("a connection");
    let whole = convert::input::to_wire(raw(2, 20_000));
    let head = Message::Config(create(Source::TrackSet(whole.head())));
    let chunks = (0..).map_while(|number| whole.chunk(number)).map(Message::TrackSetChunk);
    let (sender, messages) = mpsc::channel(8);
    for message in std::iter::once(head).chain(chunks) {
        sender.send(solve_request(message)).await.expect("room");
    }
    let status = client.solve(ReceiverStream::new(messages)).await.map(drop).expect_err("the input is not complete");
    refused.send(status).await.expect("the test goes on");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn inputs_that_never_end_hold_no_more_than_the_budget_and_harm_nobody() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let budget = BUDGET.to_string();
    let bounds =
        [("SCPSFM_SERVER__MAX_INFLIGHT_BYTES", budget.as_str()), ("SCPSFM_SERVER__MAX_MESSAGE_BYTES", "2000000")];
    let server = Serving::start_with(&directory.path().join("data"), &bounds, Stdio::null());
    let mut jobs = connected(&server).await;
    assert_eq!(scraped(&server).value("scpsfm_inflight_capacity_bytes"), BUDGET as f64);
    let running = created(&mut jobs, lasting(10_000)).await;
    reaches(&mut jobs, &running, &[JobState::Running]).await;

    let (refused, mut refusals) = mpsc::channel(STREAMS);
    let (mut streams, mut told) = (Vec::new(), 0);
    let held = || scraped(&server).value("scpsfm_inflight_bytes");
    for _ in 0..STREAMS {
        let before = held();
        streams.push(tokio::spawn(withholding(server.grpc.clone(), refused.clone())));
        // It is told to come back, at once, or holds its chunk.
        soon(async {
            loop {
                if let Ok(status) = refusals.try_recv() {
                    assert!(is_refusal(&status), "{status:?}");
                    told += 1;
                    break;
                }
                let now = held();
                assert!(now <= BUDGET as f64, "{now}");
                if now >= before + CHUNK_BYTES {
                    break;
                }
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
        })
        .await;
    }
    assert!(0 < told && told < STREAMS, "{told} of {STREAMS}");
    let held = scraped(&server);
    assert!(held.value("scpsfm_inflight_bytes") > BUDGET as f64 / 2.0, "those that fit hold most of it");
    let counted = "scpsfm_admission_refusals_total{reason=\"MEMORY\",bound=\"NONE\"}";
    assert_eq!(held.value(counted), told as f64);

    // A small job fits beside them; one that does not is refused, and taken once they are gone.
    created(&mut jobs, small(1)).await;
    let large = || create_raw(&raw(2, 20_000));
    assert!(is_refusal(&jobs.create_job(large()).await.expect_err("no room")));
    streams.iter().for_each(|stream| stream.abort());
    soon(async {
        while scraped(&server).value("scpsfm_inflight_bytes") > 0.0 {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    })
    .await;
    created(&mut jobs, large()).await;
    let job = jobs.get_job(proto::GetJobRequest { name: running }).await.expect("a job").into_inner();
    assert!(job.attempt_count == 1 && matches!(job.state(), JobState::Running | JobState::Succeeded), "{job:?}");
}

/// Views of which nothing is known have two bytes each in a message, fewer where it is compressed, and 64 decoded.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn messages_that_decode_to_many_times_their_bytes_are_refused_before_they_are_decoded() {
    const CALLS: usize = 8;
    let directory = tempfile::tempdir().expect("a temporary directory");
    let budget = BUDGET.to_string();
    let bounds =
        [("SCPSFM_SERVER__MAX_INFLIGHT_BYTES", budget.as_str()), ("SCPSFM_SERVER__MAX_MESSAGE_BYTES", "10000000")];
    let server = Serving::start_with(&directory.path().join("data"), &bounds, Stdio::null());
    let views = vec![proto::View::default(); 4_000_000];
    let message = create(Source::TrackSet(proto::TrackSet { views, ..proto::TrackSet::default() })).encode_to_vec();
    let call = async |is_compressed: bool| {
        let channel = Channel::from_shared(server.grpc.clone()).expect("a URL").connect().await;
        let grpc = Grpc::new(channel.expect("a connection"));
        let mut grpc = if is_compressed { grpc.send_compressed(CompressionEncoding::Gzip) } else { grpc };
        grpc.ready().await.expect("a connection");
        let path = PathAndQuery::from_static("/scpsfm.v1.JobService/CreateJob");
        grpc.unary(Request::new(message.clone()), path, Raw).await.map(drop).expect_err("too large")
    };
    for is_compressed in [false, true] {
        assert_eq!(reason(&call(is_compressed).await), "MESSAGE_TOO_LARGE");
        let calls = join_all((0..CALLS).map(|_| call(is_compressed)));
        for status in calls.await {
            assert!(reason(&status) == "MESSAGE_TOO_LARGE" || is_refusal(&status), "{status:?}");
        }
    }
    let peak = peak_mb(server.running.0.id());
    assert!(peak < (BUDGET >> 20) + 200, "{peak} MB");
}

#[tokio::test]
async fn results_that_nobody_reads_hold_no_more_than_the_budget() {
    const READERS: usize = 40;
    let input = raw(2, 100_000);
    let options = Options { max_inflight_bytes: 64 << 20, ..Options::default() };
    let server = TestServer::start_with(quick(), options, one_worker()).await;
    let mut jobs = server.jobs().await;
    let name = jobs.create_job(create_raw(&input)).await.expect("a job").into_inner().name;
    let watch = jobs.watch_job(proto::WatchJobRequest { name: name.clone(), after_sequence: 0 }).await;
    soon(all(watch.expect("a watch").into_inner())).await.1.expect("an end");
    let request = || proto::ReadJobResultRequest { name: name.clone(), offset: 0 };
    let (mut held, mut refused) = (Vec::new(), 0);
    for _ in 0..READERS {
        // Each over a connection of its own that takes little unread: one that is full would keep the others waiting.
        let endpoint = Channel::from_shared(server.url()).expect("a URL").initial_stream_window_size(65_535);
        let mut reader = JobServiceClient::new(endpoint.connect().await.expect("a connection"));
        match reader.read_job_result(request()).await {
            Ok(stream) => held.push(stream.into_inner()),
            Err(status) => {
                assert!(is_refusal(&status), "{status:?}");
                refused += 1;
            }
        }
    }
    assert!(refused > 0 && !held.is_empty(), "{refused} refused, {} held", held.len());
    // Small calls go on; and once somebody has read, the next one is served.
    jobs.get_job(proto::GetJobRequest { name: name.clone() }).await.expect("a job");
    drop(held);
    soon(async {
        loop {
            match jobs.read_job_result(request()).await {
                Ok(stream) => break soon(all(stream.into_inner())).await.1.expect("the whole"),
                Err(status) => assert!(is_refusal(&status), "{status:?}"),
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "a gigabyte: cargo test --test it memory -- --ignored"]
async fn a_hundred_inputs_of_millions_stay_within_the_budget_and_two_hundred_megabytes() {
    const BUDGET_MB: u64 = 1024;
    let directory = tempfile::tempdir().expect("a temporary directory");
    let server = Serving::start(&directory.path().join("data"));
    let mut jobs = connected(&server).await;
    let running = created(&mut jobs, lasting(10_000)).await;
    reaches(&mut jobs, &running, &[JobState::Running]).await;
    let whole = Arc::new(convert::input::to_wire(raw(4, 900_000)));
    let streams = (0..100).map(|_| {
        let (url, whole) = (server.grpc.clone(), Arc::clone(&whole));
        tokio::spawn(async move {
            let mut client = CalibrationServiceClient::connect(url).await.expect("a connection");
            let head = Message::Config(create(Source::TrackSet(whole.head())));
            let chunks = (0..).map_while(move |number| whole.chunk(number)).map(Message::TrackSetChunk);
            let messages = tokio_stream::iter(std::iter::once(head).chain(chunks).map(solve_request));
            // A minute without a message ends the input: the last one never comes.
            client.solve(messages.chain(tokio_stream::pending())).await.map(drop).expect_err("never complete")
        })
    });
    let streams: Vec<_> = streams.collect();
    let (mut refused, mut stalled) = (0, 0);
    for stream in streams {
        let status = stream.await.expect("no panic");
        let refusal = is_refusal(&status);
        assert!(refusal || reason(&status) == "INPUT_STALLED", "{status:?}");
        *if refusal { &mut refused } else { &mut stalled } += 1;
        // Whoever comes meanwhile is served, as far as nobody needs what is left.
        assert!(jobs.get_job(proto::GetJobRequest { name: running.clone() }).await.is_ok());
    }
    let peak = peak_mb(server.running.0.id());
    println!("{refused} refused, {stalled} held their input; at most {peak} MB in memory");
    assert!(stalled > 0 && peak <= BUDGET_MB + 200, "{peak} MB");
    let job = jobs.get_job(proto::GetJobRequest { name: running }).await.expect("a job").into_inner();
    assert!(job.attempt_count == 1 && matches!(job.state(), JobState::Running | JobState::Succeeded), "{job:?}");
}
