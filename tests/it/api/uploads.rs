//! `InputService`: what is taken, what is refused and kept, and what becomes of it.

use std::time::Duration;

use scpsfm::domain::Limits;
use scpsfm::engine::{self, UploadBounds, UploadOptions};
use scpsfm::rpc::inputs::MAX_CHUNK_BYTES;
use scpsfm::rpc::proto::create_job_request::Source;
use scpsfm::rpc::proto::input_service_client::InputServiceClient;
use scpsfm::rpc::proto::{self, JobState, upload_input_request::Message};
use scpsfm::rpc::server::Options;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::transport::Channel;
use tonic::{Code, Status};
use tonic_types::StatusExt;

use crate::support::live::{created, reaches};
use crate::support::server::{TestServer, one_worker, soon};
use crate::support::solvers::quick;
use crate::support::uploads::{DEFAULT, chunk, encoded, finish, id, part, reason, request, sha256, start, whole};
use crate::support::wire::{all, create, create_tracks, matrix, raw, solve_request, state_of};

type Inputs = InputServiceClient<Channel>;

async fn inputs(server: &TestServer) -> Inputs {
    InputServiceClient::new(server.channel().await)
}

async fn send(inputs: &mut Inputs, messages: Vec<proto::UploadInputRequest>) -> Result<proto::Input, Status> {
    Ok(soon(inputs.upload_input(tokio_stream::iter(messages))).await?.into_inner())
}

async fn status_of(inputs: &mut Inputs, id: &str) -> Result<proto::UploadStatus, Status> {
    let request = proto::GetUploadStatusRequest { parent: DEFAULT.into(), upload_id: id.into() };
    Ok(inputs.get_upload_status(request).await?.into_inner())
}

async fn committed(inputs: &mut Inputs, id: &str) -> i64 {
    status_of(inputs, id).await.expect("is there").committed_bytes
}

fn fields(status: &Status) -> Vec<String> {
    assert_eq!(status.code(), Code::InvalidArgument, "{status}");
    let request = status.get_details_bad_request().expect("a BadRequest");
    request.field_violations.into_iter().map(|violation| violation.field).collect()
}

fn named(input: &proto::Input) -> proto::CreateJobRequest {
    create(Source::Input(input.name.clone()))
}

#[tokio::test]
async fn an_upload_becomes_an_input_that_jobs_share() {
    let server = TestServer::start(quick()).await;
    let mut inputs = inputs(&server).await;
    let bytes = encoded(&raw(2, 60_000));
    assert!(bytes.len() > 2 * MAX_CHUNK_BYTES, "{}", bytes.len());
    let input = send(&mut inputs, whole(DEFAULT, &id(1), &bytes, 300_000)).await.expect("an input");
    assert_eq!(input.name, format!("tenants/default/inputs/{}", id(1)));
    assert_eq!((input.view_count, input.track_count, input.observation_count), (2, 60_000, 120_000));
    assert_eq!((input.size_bytes, &input.sha256), (bytes.len() as i64, &sha256(&bytes)));
    let status = status_of(&mut inputs, &id(1)).await.expect("is there");
    assert_eq!(status.input.as_ref(), Some(&input));
    assert_eq!((status.committed_bytes, status.size_bytes), (input.size_bytes, input.size_bytes));
    // Begun again, it is answered at once, before its bytes come; however its id is written.
    let again = vec![request(Message::Start(start(DEFAULT, &id(1).to_uppercase(), bytes.len())))];
    assert_eq!(send(&mut inputs, again).await.expect("the same"), input);

    let mut jobs = server.jobs().await;
    let first = created(&mut jobs, named(&input)).await;
    let repeated = proto::CreateJobRequest { request_id: "r".into(), ..named(&input) };
    let second = created(&mut jobs, repeated.clone()).await;
    assert_eq!(created(&mut jobs, repeated).await, second);
    let inline = create(Source::TrackSet(scpsfm::rpc::convert::input::to_wire(raw(2, 60_000))));
    let third = created(&mut jobs, inline.clone()).await;
    let mut other_body = inline;
    other_body.request_id = "r".into();
    assert_eq!(jobs.create_job(other_body).await.expect_err("another body").code(), Code::AlreadyExists);
    let mut results = Vec::new();
    for name in [first, second, third] {
        assert_eq!(reaches(&mut jobs, &name, &[JobState::Succeeded]).await, JobState::Succeeded);
        let job = jobs.get_job(proto::GetJobRequest { name: name.clone() }).await.expect("the job").into_inner();
        assert_eq!((job.view_count, job.track_count, job.observation_count), (2, 60_000, 120_000));
        let read = proto::ReadJobResultRequest { name: name.clone(), offset: 0 };
        let (chunks, _) = all(jobs.read_job_result(read).await.expect("a result").into_inner()).await;
        let bytes: Vec<u8> = chunks.into_iter().flat_map(|chunk| chunk.data).collect();
        let mut result: proto::JobResult = prost::Message::decode(bytes.as_slice()).expect("decodes");
        result.job = String::new();
        results.push(result);
        jobs.delete_job(proto::DeleteJobRequest { name, ..Default::default() }).await.expect("deletes");
    }
    assert!(results.windows(2).all(|two| two[0] == two[1]), "one input, one answer, however it came");
    assert!(status_of(&mut inputs, &id(1)).await.expect("is there").input.is_some(), "it outlives its jobs");
}

#[tokio::test]
async fn a_solve_takes_an_uploaded_input_too_and_no_chunks_beside_it() {
    use proto::solve_request::Message::{Config, TrackSetChunk};
    let server = TestServer::start(quick()).await;
    let data = proto::input_data::Data::MeasurementMatrix(matrix());
    let bytes = prost::Message::encode_to_vec(&proto::InputData { data: Some(data) });
    let input = send(&mut inputs(&server).await, whole(DEFAULT, &id(1), &bytes, 10)).await.expect("an input");
    assert_eq!((input.view_count, input.track_count, input.observation_count), (2, 3, 6));
    let mut calibration = server.calibration().await;
    let solve = tokio_stream::once(solve_request(Config(named(&input))));
    let (events, end) = soon(all(calibration.solve(solve).await.expect("a solve").into_inner())).await;
    end.expect("ends with the job");
    assert_eq!(events.last().and_then(state_of), Some(JobState::Succeeded));
    let both = [Config(named(&input)), TrackSetChunk(proto::TrackSetChunk::default())].map(solve_request);
    let status = calibration.solve(tokio_stream::iter(both)).await.expect_err("two inputs");
    assert_eq!(fields(&status), ["track_set_chunk"]);

    let mut jobs = server.jobs().await;
    let absent = |name: &str| create(Source::Input(name.into()));
    let status = jobs.create_job(absent(&format!("tenants/default/inputs/{}", id(2)))).await.expect_err("none");
    assert_eq!((status.code(), reason(&status).as_str()), (Code::NotFound, "INPUT_NOT_FOUND"));
    let theirs = jobs.create_job(absent(&format!("tenants/other/inputs/{}", id(1)))).await.expect_err("another's");
    assert_eq!((theirs.code(), reason(&theirs).as_str()), (Code::NotFound, "INPUT_NOT_FOUND"));
    assert_eq!(fields(&jobs.create_job(absent("inputs/a")).await.expect_err("malformed")), ["input"]);
}

/// A stream that broke a rule at the third chunk: what came before is kept, and the upload goes on from there.
#[tokio::test]
async fn what_breaks_a_rule_is_named_and_what_came_before_is_kept() {
    let server = TestServer::start(quick()).await;
    let mut inputs = inputs(&server).await;
    let bytes = encoded(&raw(3, 40));
    let good = |number| part(DEFAULT, &id(number), &bytes, 0..200, 100);
    let third = chunk(200, &bytes[200..300]);
    let cases: [(Message, &str); 9] = [
        (Message::Chunk(proto::UploadChunk { offset: 201, ..third.clone() }), "chunk.offset"),
        (Message::Chunk(proto::UploadChunk { offset: 199, ..third.clone() }), "chunk.offset"),
        (Message::Chunk(proto::UploadChunk { offset: -1, ..third.clone() }), "chunk.offset"),
        (Message::Chunk(chunk(200, &[])), "chunk.data"),
        (Message::Chunk(chunk(200, &vec![0; MAX_CHUNK_BYTES + 1])), "chunk.data"),
        (Message::Chunk(chunk(200, &vec![0; bytes.len() - 199])), "chunk.data"),
        (Message::Start(start(DEFAULT, &id(1), bytes.len())), "start"),
        (Message::Finish(finish(&bytes)), "finish"),
        (Message::Finish(proto::UploadFinish { sha256: vec![1; 31] }), "finish.sha256"),
    ];
    let count = cases.len() as u32;
    for (number, (wrong, field)) in (0..).zip(cases) {
        let mut messages = good(number);
        messages.push(request(wrong));
        let status = send(&mut inputs, messages).await.expect_err(field);
        assert_eq!(fields(&status), [field], "{status}");
        assert_eq!(committed(&mut inputs, &id(number)).await, 200, "{field}");
    }
    // A message of nothing, and the end of the stream.
    let mut messages = good(count);
    messages.push(proto::UploadInputRequest { message: None });
    assert_eq!(fields(&send(&mut inputs, messages).await.expect_err("nothing")), ["message"]);
    let status = send(&mut inputs, good(count)).await.expect_err("an overlap");
    assert_eq!(fields(&status), ["chunk.offset"]);
    assert!(status.message().contains("200 is next"), "{status}");
    let more = part(DEFAULT, &id(count), &bytes, 200..300, 100);
    let status = send(&mut inputs, more).await.expect_err("half way");
    assert_eq!(fields(&status), ["finish"]);
    assert!(status.message().contains(&format!("300 of {} bytes, which are kept", bytes.len())), "{status}");

    let mut damaged = good(count + 1);
    damaged.push(request(Message::Chunk(proto::UploadChunk { crc32c: third.crc32c ^ 1, ..third })));
    let status = send(&mut inputs, damaged).await.expect_err("damaged");
    assert_eq!((status.code(), reason(&status).as_str()), (Code::DataLoss, "CHUNK_CORRUPTED"));
    assert!(status.message().starts_with("chunk.crc32c: the chunk at offset 200 "), "{status}");
    assert_eq!(status.get_details_error_info().expect("an ErrorInfo").metadata["offset"], "200");
    assert_eq!(committed(&mut inputs, &id(count + 1)).await, 200);
    let mut rest = part(DEFAULT, &id(count + 1), &bytes, 200..bytes.len(), 64);
    rest.push(request(Message::Finish(finish(&bytes))));
    send(&mut inputs, rest).await.expect("goes on from there");
}

#[tokio::test]
async fn wrong_beginnings_are_refused_and_leave_nothing() {
    let server = TestServer::start(quick()).await;
    let mut inputs = inputs(&server).await;
    let right = start(DEFAULT, &id(1), 100);
    let cases = [
        (proto::UploadStart { parent: "default".into(), ..right.clone() }, "parent"),
        (proto::UploadStart { upload_id: "mine".into(), ..right.clone() }, "start.upload_id"),
        (proto::UploadStart { upload_id: String::new(), ..right.clone() }, "start.upload_id"),
        (proto::UploadStart { size_bytes: 0, ..right.clone() }, "start.size_bytes"),
        (proto::UploadStart { size_bytes: -1, ..right.clone() }, "start.size_bytes"),
        (proto::UploadStart { size_bytes: (1 << 30) + 1, ..right.clone() }, "start.size_bytes"),
        (proto::UploadStart { size_bytes: i64::MAX, ..right.clone() }, "start.size_bytes"),
        (proto::UploadStart { sha256: vec![0; 33], ..right.clone() }, "start.sha256"),
    ];
    for (wrong, field) in cases {
        let status = send(&mut inputs, vec![request(Message::Start(wrong))]).await.expect_err(field);
        assert_eq!(fields(&status), [field]);
    }
    let headless = vec![request(Message::Chunk(chunk(0, b"a")))];
    assert_eq!(fields(&send(&mut inputs, headless).await.expect_err("no start")), ["start"]);
    assert_eq!(fields(&send(&mut inputs, Vec::new()).await.expect_err("nothing")), ["start"]);
    let foreign = proto::UploadStart { parent: "tenants/other".into(), ..right };
    let status = send(&mut inputs, vec![request(Message::Start(foreign))]).await.expect_err("another tenant");
    assert_eq!((status.code(), reason(&status).as_str()), (Code::NotFound, "TENANT_NOT_FOUND"));
    let status = status_of(&mut inputs, &id(1)).await.expect_err("never begun");
    assert_eq!((status.code(), reason(&status).as_str()), (Code::NotFound, "UPLOAD_NOT_FOUND"));
    assert_eq!(fields(&status_of(&mut inputs, "a").await.expect_err("no id")), ["upload_id"]);
}

#[tokio::test]
async fn bytes_that_are_no_valid_input_become_none_and_free_their_id() {
    let limits = Limits { max_observations: 1_000, ..Limits::default() };
    let server = TestServer::start_with(quick(), Options { limits, ..Options::default() }, one_worker()).await;
    let mut inputs = inputs(&server).await;
    let bytes = encoded(&raw(3, 40));
    let mut nan = raw(3, 40);
    nan.x[17] = f64::NAN;
    let invalid = [
        (encoded(&nan), "track_set.xs[17]"),
        (encoded(&raw(3, 400)), "track_set.view_indices"),
        (vec![0xff; 5_000], "data"),
        (b"view,track,x,y\n".to_vec(), "data"),
        (bytes[..bytes.len() - 1].to_vec(), "data"),
    ];
    for (wrong, field) in invalid {
        let status = send(&mut inputs, whole(DEFAULT, &id(1), &wrong, 1_000)).await.expect_err(field);
        assert_eq!(fields(&status), [field]);
        assert_eq!(status_of(&mut inputs, &id(1)).await.expect_err("given up").code(), Code::NotFound);
    }
    let mut messages = part(DEFAULT, &id(1), &bytes, 0..bytes.len(), 1_000);
    messages.push(request(Message::Finish(finish(b"other bytes"))));
    let status = send(&mut inputs, messages).await.expect_err("another hash");
    assert_eq!((status.code(), reason(&status).as_str()), (Code::DataLoss, "HASH_MISMATCH"));
    assert_eq!(status_of(&mut inputs, &id(1)).await.expect_err("given up").code(), Code::NotFound);
    send(&mut inputs, whole(DEFAULT, &id(1), &bytes, 1_000)).await.expect("the id is free");
}

#[tokio::test]
async fn an_upload_id_stands_for_one_length_and_hash() {
    let server = TestServer::start(quick()).await;
    let mut inputs = inputs(&server).await;
    let bytes = encoded(&raw(3, 40));
    let declared = |size: usize, hash: &[u8]| {
        let start = proto::UploadStart { sha256: hash.to_vec(), ..start(DEFAULT, &id(1), size) };
        vec![request(Message::Start(start))]
    };
    let right = sha256(&bytes);
    // Begun and left: no more than its start is known.
    assert_eq!(fields(&send(&mut inputs, declared(bytes.len(), &right)).await.expect_err("half way")), ["finish"]);
    for finished in [false, true] {
        if finished {
            let mut messages = declared(bytes.len(), &right);
            messages.push(request(Message::Chunk(chunk(0, &bytes))));
            messages.push(request(Message::Finish(proto::UploadFinish { sha256: vec![1; 32] })));
            assert_eq!(fields(&send(&mut inputs, messages).await.expect_err("another")), ["finish.sha256"]);
            let mut messages = declared(bytes.len(), &[]);
            messages.push(request(Message::Finish(finish(&bytes))));
            send(&mut inputs, messages).await.expect("an input");
        }
        for other in [declared(bytes.len() + 1, &right), declared(bytes.len(), &[1; 32])] {
            let status = send(&mut inputs, other).await.expect_err("other bytes");
            assert_eq!((status.code(), reason(&status).as_str()), (Code::AlreadyExists, "UPLOAD_ID_REUSED"));
        }
    }
    assert!(send(&mut inputs, declared(bytes.len(), &right)).await.is_ok());
}

#[tokio::test]
async fn of_two_streams_of_one_upload_the_later_one_goes_on() {
    let server = TestServer::start(quick()).await;
    let mut inputs = inputs(&server).await;
    let bytes = encoded(&raw(2, 60_000));
    let half = MAX_CHUNK_BYTES;
    let (sender, messages) = mpsc::channel(8);
    let mut slow = inputs.clone();
    let first = tokio::spawn(async move { slow.upload_input(ReceiverStream::new(messages)).await });
    for message in part(DEFAULT, &id(1), &bytes, 0..half, half) {
        sender.send(message).await.expect("taken");
    }
    soon(async {
        while status_of(&mut inputs, &id(1)).await.map_or(0, |status| status.committed_bytes) == 0 {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    })
    .await;
    let mut rest = part(DEFAULT, &id(1), &bytes, half..bytes.len(), half);
    let last = rest.pop().expect("a chunk");
    let (second_sender, messages) = mpsc::channel(8);
    let mut other = inputs.clone();
    let second = tokio::spawn(async move { other.upload_input(ReceiverStream::new(messages)).await });
    for message in rest {
        second_sender.send(message).await.expect("taken");
    }
    // Once the second has begun, the first cannot write: nothing of it is mixed in.
    soon(async {
        while committed(&mut inputs, &id(1)).await == half as i64 {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    })
    .await;
    sender.send(request(Message::Chunk(chunk(half, &bytes[half..2 * half])))).await.expect("taken");
    let status = soon(first).await.expect("no panic").expect_err("taken over");
    assert_eq!((status.code(), reason(&status).as_str()), (Code::Aborted, "UPLOAD_TAKEN_OVER"));
    second_sender.send(last).await.expect("taken");
    second_sender.send(request(Message::Finish(finish(&bytes)))).await.expect("taken");
    let input = soon(second).await.expect("no panic").expect("an input").into_inner();
    assert_eq!(input.sha256, sha256(&bytes));
}

#[tokio::test]
async fn a_callers_disappearance_keeps_what_had_come() {
    let server = TestServer::start(quick()).await;
    let mut inputs = inputs(&server).await;
    let bytes = encoded(&raw(3, 400));
    let (sender, messages) = mpsc::channel(8);
    let mut vanishing = InputServiceClient::new(server.channel().await);
    let call = tokio::spawn(async move { vanishing.upload_input(ReceiverStream::new(messages)).await });
    for message in part(DEFAULT, &id(1), &bytes, 0..5_000, 1_000) {
        sender.send(message).await.expect("taken");
    }
    // All that was sent has left this side once the channel is empty; it is small, and stored when the stream ends.
    soon(async {
        while sender.capacity() < 8 {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        while status_of(&mut inputs, &id(1)).await.is_err() {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    })
    .await;
    tokio::time::sleep(Duration::from_millis(50)).await;
    call.abort();
    soon(async {
        while committed(&mut inputs, &id(1)).await == 0 {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    })
    .await;
    let from = committed(&mut inputs, &id(1)).await as usize;
    assert_eq!(from % 1_000, 0);
    let mut rest = part(DEFAULT, &id(1), &bytes, from..bytes.len(), 1_000);
    rest.push(request(Message::Finish(finish(&bytes))));
    assert_eq!(send(&mut inputs, rest).await.expect("an input").sha256, sha256(&bytes));
}

fn bounded(options: UploadOptions) -> engine::Options {
    engine::Options { uploads: options, ..one_worker() }
}

#[tokio::test]
async fn bounds_are_advertised_and_hold() {
    let uploads = UploadOptions {
        bounds: UploadBounds { max_bytes: 10_000, max_tenant_uploads: 2, max_tenant_bytes: 15_000 },
        abandoned_after: Some(Duration::from_secs(3_600)),
    };
    let server = TestServer::start_with(quick(), Options::default(), bounded(uploads)).await;
    let answer = server.calibration().await.get_capabilities(proto::GetCapabilitiesRequest {}).await;
    let limits = answer.expect("capabilities").into_inner().upload_limits.expect("limits");
    assert_eq!((limits.max_upload_bytes, limits.max_chunk_bytes), (10_000, MAX_CHUNK_BYTES as i64));
    assert_eq!((limits.max_tenant_uploads, limits.max_tenant_bytes), (2, 15_000));
    assert_eq!(limits.abandoned_after.expect("a time").seconds, 3_600);

    let mut inputs = inputs(&server).await;
    let begin = |number, size| vec![request(Message::Start(start(DEFAULT, &id(number), size)))];
    let long = send(&mut inputs, begin(1, 10_001)).await.expect_err("long");
    assert_eq!(never_fits(&long), ("upload_bytes".to_owned(), "10001".to_owned()));
    assert!(long.message().contains("upload.max_bytes is 10000"), "{long}");
    assert_eq!(fields(&send(&mut inputs, begin(1, 10_000)).await.expect_err("begun")), ["finish"]);
    let full = async |inputs: &mut Inputs, number, size| {
        let status = send(inputs, begin(number, size)).await.expect_err("full");
        assert_eq!((status.code(), reason(&status).as_str()), (Code::ResourceExhausted, "UPLOADS_FULL"));
        assert!(status.get_details_retry_info().is_some());
        status.get_details_error_info().expect("an ErrorInfo").metadata["bound"].clone()
    };
    assert_eq!(full(&mut inputs, 2, 5_001).await, "tenant_upload_bytes");
    assert_eq!(fields(&send(&mut inputs, begin(2, 5_000)).await.expect_err("begun")), ["finish"]);
    assert_eq!(full(&mut inputs, 3, 1).await, "tenant_uploads");
}

/// Bound and length of an upload that is refused for good.
fn never_fits(status: &Status) -> (String, String) {
    assert_eq!(fields(status), ["start.size_bytes"]);
    assert!(status.get_details_retry_info().is_none(), "{status:?}");
    let info = status.get_details_error_info().expect("an ErrorInfo");
    assert_eq!(info.reason, "UPLOAD_TOO_LARGE");
    (info.metadata["bound"].clone(), info.metadata["asked"].clone())
}

#[tokio::test]
async fn an_upload_above_all_that_a_tenant_may_have_is_refused_for_good() {
    let bounds = UploadBounds { max_tenant_uploads: 1, max_tenant_bytes: 4_000, ..UploadOptions::default().bounds };
    let uploads = UploadOptions { bounds, ..UploadOptions::default() };
    let server = TestServer::start_with(quick(), Options::default(), bounded(uploads)).await;
    let mut inputs = inputs(&server).await;
    let begin = |number, size| vec![request(Message::Start(start(DEFAULT, &id(number), size)))];
    // With room for one more upload, and without.
    for _ in 0..2 {
        let status = send(&mut inputs, begin(2, 4_001)).await.expect_err("never");
        assert_eq!(never_fits(&status), ("tenant_upload_bytes".to_owned(), "4001".to_owned()));
        assert!(status.message().contains("upload.tenant_bytes is 4000"), "{status}");
        assert_eq!(fields(&send(&mut inputs, begin(1, 4_000)).await.expect_err("begun")), ["finish"]);
    }
}

#[tokio::test]
async fn the_bound_and_the_list_count_the_same_bytes() {
    let bytes = encoded(&raw(3, 40));
    let room = 2 * bytes.len() as u64;
    let bounds = UploadBounds { max_tenant_uploads: 4, max_tenant_bytes: room, ..UploadOptions::default().bounds };
    let uploads = UploadOptions { bounds, ..UploadOptions::default() };
    let server = TestServer::start_with(quick(), Options::default(), bounded(uploads)).await;
    let mut inputs = inputs(&server).await;
    for number in [1, 2] {
        send(&mut inputs, whole(DEFAULT, &id(number), &bytes, 1_000)).await.expect("two fit, to the byte");
    }
    let list = proto::ListInputsRequest { parent: DEFAULT.into(), ..Default::default() };
    let listed = inputs.list_inputs(list).await.expect("a page").into_inner().inputs;
    let listed: i64 = listed.iter().map(|input| input.size_bytes).sum();
    assert_eq!(listed, room as i64);
    let one_more = vec![request(Message::Start(start(DEFAULT, &id(3), 1)))];
    let status = send(&mut inputs, one_more).await.expect_err("full");
    assert_eq!(reason(&status), "UPLOADS_FULL");
    assert!(status.message().contains(&format!("take {listed} of at most {room} bytes")), "{status}");
}

#[tokio::test]
async fn an_upload_that_nobody_goes_on_with_expires() {
    let uploads = UploadOptions { abandoned_after: Some(Duration::from_millis(10)), ..UploadOptions::default() };
    let server = TestServer::start_with(quick(), Options::default(), bounded(uploads)).await;
    let mut inputs = inputs(&server).await;
    let bytes = encoded(&raw(3, 40));
    let begun = send(&mut inputs, part(DEFAULT, &id(1), &bytes, 0..200, 100)).await;
    assert_eq!(fields(&begun.expect_err("half way")), ["finish"]);
    soon(async {
        while status_of(&mut inputs, &id(1)).await.is_ok() {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    })
    .await;
    // Anew, unless a sweep comes between.
    let anew = soon(async {
        loop {
            if let Ok(input) = send(&mut inputs, whole(DEFAULT, &id(1), &bytes, 5_000)).await {
                return input;
            }
        }
    });
    assert_eq!(anew.await.sha256, sha256(&bytes));
}

#[tokio::test]
async fn a_draining_server_takes_no_upload() {
    let server = TestServer::start(quick()).await;
    let mut inputs = inputs(&server).await;
    server.jobs().await.create_job(create_tracks()).await.expect("a job");
    soon(server.engine.drain(Duration::ZERO)).await;
    let begin = vec![request(Message::Start(start(DEFAULT, &id(1), 100)))];
    let status = send(&mut inputs, begin).await.expect_err("draining");
    assert_eq!((status.code(), reason(&status).as_str()), (Code::Unavailable, "DRAINING"));
}
