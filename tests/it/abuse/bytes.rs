//! Damaged messages over gRPC, to every method of a running server.

use std::collections::BTreeMap;
use std::fs::File;
use std::time::Duration;

use prost::Message;
use prost::bytes::{Buf, BufMut};
use scpsfm::rpc::proto::{self, JobState};
use tonic::codec::{Codec, DecodeBuf, Decoder, EncodeBuf, Encoder};
use tonic::transport::Channel;
use tonic::{Code, Request, Status};

use crate::support::live::{connected, created, reaches};
use crate::support::memory::peak_mb;
use crate::support::mutation;
use crate::support::program::Serving;
use crate::support::server::soon;
use crate::support::uploads::{DEFAULT, chunk, encoded, finish, id, request, start, whole};
use crate::support::wire::{create_tracks, raw, solve_request, track_set};

/// What the server may take for all of it, in megabytes: a few messages and jobs above what it takes idle.
const MOST_MB: u64 = 300;

/// Messages as the bytes that they are.
#[derive(Debug, Clone, Copy, Default)]
pub struct Raw;

impl Codec for Raw {
    type Encode = Vec<u8>;
    type Decode = Vec<u8>;
    type Encoder = Raw;
    type Decoder = Raw;

    fn encoder(&mut self) -> Raw {
        Raw
    }

    fn decoder(&mut self) -> Raw {
        Raw
    }
}

impl Encoder for Raw {
    type Item = Vec<u8>;
    type Error = Status;

    fn encode(&mut self, item: Vec<u8>, buf: &mut EncodeBuf<'_>) -> Result<(), Status> {
        buf.put_slice(&item);
        Ok(())
    }
}

impl Decoder for Raw {
    type Item = Vec<u8>;
    type Error = Status;

    fn decode(&mut self, buf: &mut DecodeBuf<'_>) -> Result<Option<Vec<u8>>, Status> {
        let mut bytes = vec![0; buf.remaining()];
        buf.copy_to_slice(&mut bytes);
        Ok(Some(bytes))
    }
}

/// A method, good messages for it, and how many are sent in a row at most.
type Method = (&'static str, Vec<Vec<u8>>, u64);

fn methods(job: &str) -> Vec<Method> {
    use proto::solve_request::Message::{Config, TrackSetChunk};
    let name = || job.to_owned();
    let parent = || DEFAULT.to_owned();
    let with_id = proto::CreateJobRequest { request_id: "r".into(), ..create_tracks() };
    let batch = proto::BatchCreateJobsRequest { parent: parent(), requests: vec![create_tracks(), with_id.clone()] };
    let list = proto::ListJobsRequest { parent: parent(), filter: "state = QUEUED".into(), ..Default::default() };
    let points = proto::TrackSetChunk { xs: track_set().xs, ys: track_set().ys, ..Default::default() };
    let bytes = encoded(&raw(3, 4));
    let mut upload: Vec<Vec<u8>> = whole(DEFAULT, &id(1), &bytes, 50).iter().map(Message::encode_to_vec).collect();
    upload.push(request(proto::upload_input_request::Message::Start(start(DEFAULT, &id(2), 9))).encode_to_vec());
    upload.push(request(proto::upload_input_request::Message::Chunk(chunk(0, &[1; 9]))).encode_to_vec());
    upload.push(request(proto::upload_input_request::Message::Finish(finish(&[1; 9]))).encode_to_vec());
    vec![
        ("CalibrationService/GetCapabilities", vec![Vec::new()], 1),
        (
            "CalibrationService/Solve",
            [Config(create_tracks()), TrackSetChunk(points)].map(|it| solve_request(it).encode_to_vec()).to_vec(),
            3,
        ),
        ("JobService/CreateJob", vec![create_tracks().encode_to_vec(), with_id.encode_to_vec()], 1),
        ("JobService/BatchCreateJobs", vec![batch.encode_to_vec()], 1),
        ("JobService/GetJob", vec![proto::GetJobRequest { name: name() }.encode_to_vec()], 1),
        ("JobService/ListJobs", vec![list.encode_to_vec()], 1),
        ("JobService/WatchJob", vec![proto::WatchJobRequest { name: name(), after_sequence: 0 }.encode_to_vec()], 1),
        ("JobService/CancelJob", vec![proto::CancelJobRequest { name: name(), etag: "a".into() }.encode_to_vec()], 1),
        ("JobService/DeleteJob", vec![proto::DeleteJobRequest { name: name(), etag: "a".into() }.encode_to_vec()], 1),
        ("JobService/ReadJobResult", vec![proto::ReadJobResultRequest { name: name(), offset: 0 }.encode_to_vec()], 1),
        ("InputService/UploadInput", upload, 5),
        (
            "InputService/GetUploadStatus",
            vec![proto::GetUploadStatusRequest { parent: parent(), upload_id: id(1) }.encode_to_vec()],
            1,
        ),
    ]
}

/// Sends messages to a method and reads no further than the first answer: a watch may last.
async fn send(channel: &Channel, method: &str, messages: Vec<Vec<u8>>) -> Result<(), Status> {
    let mut grpc = tonic::client::Grpc::new(channel.clone());
    grpc.ready().await.expect("a connection");
    let path = format!("/scpsfm.v1.{method}").parse().expect("a path");
    let answer = grpc.streaming(Request::new(tokio_stream::iter(messages)), path, Raw).await?;
    answer.into_inner().message().await.map(drop)
}

/// What a caller's bytes may be answered: neither a defect of the server's nor a broken connection.
fn is_answer(status: &Status) -> bool {
    use Code::{
        Aborted, AlreadyExists, DataLoss, FailedPrecondition, InvalidArgument, NotFound, OutOfRange, ResourceExhausted,
    };
    let codes = [
        Aborted,
        AlreadyExists,
        DataLoss,
        FailedPrecondition,
        InvalidArgument,
        NotFound,
        OutOfRange,
        ResourceExhausted,
    ];
    codes.contains(&status.code())
}

/// Sends so many cases; afterwards the server serves a good client as before.
async fn survives(cases: u64) {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let log = directory.path().join("log");
    let stderr = File::create(&log).expect("a file");
    let mut server = Serving::start_with(&directory.path().join("data"), &[], stderr);
    let mut jobs = connected(&server).await;
    let job = created(&mut jobs, create_tracks()).await;
    let methods = methods(&job);
    let channel = Channel::from_shared(server.grpc.clone()).expect("a URL").connect().await.expect("a connection");
    let (mut answered, mut refused) = (0_u64, BTreeMap::new());
    for number in 0..cases {
        let (method, seeds, most) = &methods[(number % methods.len() as u64) as usize];
        // Of a stream, the messages before the last are good ones, in their order.
        let good = (number / methods.len() as u64 % most) as usize;
        let mut messages: Vec<Vec<u8>> = seeds.iter().take(good.min(seeds.len())).cloned().collect();
        messages.push(mutation::case(seeds, number));
        match soon(send(&channel, method, messages)).await {
            Ok(()) => answered += 1,
            Err(status) => {
                *refused.entry(format!("{:?}", status.code())).or_insert(0_u64) += 1;
                assert!(is_answer(&status), "case {number} to {method}: {status:?}");
            }
        }
    }
    println!("{cases} cases: {answered} were answered, refused {refused:?}");
    assert!(answered > cases / 100 && refused.len() > 2, "else they try one of the two only");

    let job = soon(async {
        loop {
            // The queue may be full of what was accepted.
            match jobs.create_job(create_tracks()).await {
                Ok(job) => return job.into_inner().name,
                Err(status) => assert_eq!(status.code(), Code::ResourceExhausted, "{status:?}"),
            }
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    })
    .await;
    assert_eq!(reaches(&mut jobs, &job, &[JobState::Succeeded, JobState::Failed]).await, JobState::Succeeded);
    assert!(server.running.0.try_wait().expect("it can be asked").is_none(), "the server has ended");
    let peak = peak_mb(server.running.0.id());
    println!("the server took {peak} MB at most");
    assert!(peak < MOST_MB, "{peak} MB");
    let log = std::fs::read_to_string(log).expect("the log");
    assert!(!log.contains("panicked") && !log.contains("internal error"), "{log}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn hundreds_of_damaged_messages_are_answered_and_the_server_goes_on() {
    survives(600).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "takes minutes: cargo test --test it abuse::bytes -- --ignored"]
async fn ten_thousand_damaged_messages_are_answered_and_the_server_goes_on() {
    survives(10_000).await;
}
