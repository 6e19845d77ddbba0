//! What bad input gets: a status that names field and index, before anything is stored.

use scpsfm::domain::Limits;
use scpsfm::rpc::proto::{self, create_job_request::Source, job::Deadline, solve_request::Message};
use scpsfm::rpc::server::Options;
use tonic::codec::CompressionEncoding::Gzip;
use tonic::{Code, Status};
use tonic_types::StatusExt;

use crate::support::server::{TestServer, one_worker};
use crate::support::solvers::quick;
use crate::support::wire::{all, create, create_tracks, match_set, matrix, solve_request, track_set};

/// The fields that an `INVALID_ARGUMENT` names.
fn fields(status: &Status) -> Vec<String> {
    assert_eq!(status.code(), Code::InvalidArgument, "{status}");
    let info = status.get_details_error_info().expect("an ErrorInfo");
    assert_eq!((info.reason.as_str(), info.domain.as_str()), ("INVALID_ARGUMENT", "scpsfm"));
    let request = status.get_details_bad_request().expect("a BadRequest");
    request.field_violations.into_iter().map(|violation| violation.field).collect()
}

/// The reason that a status gives for programs.
fn reason(status: &Status) -> String {
    let info = status.get_details_error_info().expect("an ErrorInfo");
    assert_eq!(info.domain, "scpsfm");
    info.reason
}

fn tracks(change: impl FnOnce(&mut proto::TrackSet)) -> proto::CreateJobRequest {
    let mut set = track_set();
    change(&mut set);
    create(Source::TrackSet(set))
}

fn matrices(change: impl FnOnce(&mut proto::MeasurementMatrix)) -> proto::CreateJobRequest {
    let mut matrix = matrix();
    change(&mut matrix);
    create(Source::MeasurementMatrix(matrix))
}

fn matches(change: impl FnOnce(&mut proto::MatchSet)) -> proto::CreateJobRequest {
    let mut set = match_set();
    change(&mut set);
    create(Source::MatchSet(set))
}

fn described(change: impl FnOnce(&mut proto::Job)) -> proto::CreateJobRequest {
    let mut job = proto::Job::default();
    change(&mut job);
    proto::CreateJobRequest { job: Some(job), ..create_tracks() }
}

fn set_up(change: impl FnOnce(&mut proto::SolveSettings)) -> proto::CreateJobRequest {
    let mut settings = proto::SolveSettings::default();
    change(&mut settings);
    described(|job| job.settings = Some(settings))
}

fn deadline_time(seconds: i64, nanos: i32) -> Option<Deadline> {
    Some(Deadline::DeadlineTime(prost_types::Timestamp { seconds, nanos }))
}

fn time_limit(seconds: i64, nanos: i32) -> Option<Deadline> {
    Some(Deadline::TimeLimit(prost_types::Duration { seconds, nanos }))
}

/// Limits below every input of these tests but the smallest.
const TIGHT: Limits = Limits { max_views: 4, max_tracks: 5, max_observations: 12 };

#[tokio::test]
async fn every_kind_is_refused_by_field_and_index_and_nothing_is_stored() {
    let options = Options { limits: TIGHT, ..Options::default() };
    let server = TestServer::start_with(quick(), options, one_worker()).await;
    let mut jobs = server.jobs().await;
    let cases = [
        (tracks(|set| set.xs[7] = f64::NAN), "track_set.xs[7]"),
        (tracks(|set| set.ys[3] = f64::INFINITY), "track_set.ys[3]"),
        (tracks(|set| set.xs[0] = 1e9), "track_set.xs[0]"),
        (tracks(|set| set.track_indices[5] = 4), "track_set.track_indices[5]"),
        (tracks(|set| set.view_indices[11] = 3), "track_set.view_indices[11]"),
        (tracks(|set| set.track_indices[1] = 0), "track_set.track_indices[1]"),
        (tracks(|set| set.xs.truncate(5)), "track_set.view_indices"),
        (tracks(|set| set.sigmas_px = vec![0.0; 12]), "track_set.sigmas_px[0]"),
        (tracks(|set| set.depths = vec![1.0; 3]), "track_set.depths"),
        (tracks(|set| set.views.clear()), "track_set.views"),
        (tracks(|set| set.views.truncate(1)), "track_set.views"),
        (
            tracks(|set| set.views[2].size = Some(proto::ImageSize { width_px: 10, height_px: 0 })),
            "track_set.views[2].size.height_px",
        ),
        (tracks(|set| set.track_count = 0), "track_set.track_count"),
        (tracks(|set| set.track_count = u32::MAX), "track_set.track_count"),
        (tracks(|set| set.views = vec![proto::View::default(); 5]), "track_set.views"),
        (tracks(|set| set.views[1].name = "a\nb".into()), "track_set.views[1].name"),
        (tracks(|set| set.views[2].name = "x".repeat(4097)), "track_set.views[2].name"),
        (tracks(|set| set.views.iter_mut().for_each(|view| view.name = "a".into())), "track_set.views[1].name"),
        (tracks(|set| set.xs = vec![0.0; 13]), "track_set.xs"),
        (create(Source::TrackSet(proto::TrackSet::default())), "track_set.views"),
        (matrices(|matrix| matrix.values[4] = f64::NAN), "measurement_matrix.values[4]"),
        (matrices(|matrix| matrix.values.truncate(17)), "measurement_matrix.values"),
        (matrices(|matrix| matrix.visibility = vec![1; 5]), "measurement_matrix.visibility"),
        (matrices(|matrix| matrix.view_count = u32::MAX), "measurement_matrix.view_count"),
        (matrices(|matrix| (matrix.view_count, matrix.track_count) = (4, 4)), "measurement_matrix.track_count"),
        (matches(|set| set.xs[4] = f64::NAN), "match_set.xs[4]"),
        (matches(|set| set.ys[6] = -1e9), "match_set.ys[6]"),
        (matches(|set| set.xs = vec![0.0; 13]), "match_set.xs"),
        (matches(|set| set.keypoint_counts[0] = 2), "match_set.xs"),
        (matches(|set| set.keypoint_counts = vec![1; 5]), "match_set.keypoint_counts"),
        (matches(|set| set.first_view_indices[1] = 3), "match_set.first_view_indices[1]"),
        (matches(|set| set.second_view_indices[0] = 0), "match_set.second_view_indices[0]"),
        (
            matches(|set| (set.first_view_indices[1], set.second_view_indices[1]) = (1, 0)),
            "match_set.first_view_indices[1]",
        ),
        (matches(|set| set.match_counts[0] = 3), "match_set.first_keypoint_indices"),
        (matches(|set| set.second_keypoint_indices[2] = 2), "match_set.second_keypoint_indices[2]"),
        (matches(|set| set.second_keypoint_indices = vec![0; 13]), "match_set.second_keypoint_indices"),
        (
            matches(|set| (set.first_keypoint_indices[1], set.second_keypoint_indices[1]) = (0, 1)),
            "match_set.first_keypoint_indices[1]",
        ),
        (matches(|set| set.views[2].name = "a\nb".into()), "match_set.views[2].name"),
        (create(Source::MatchSet(proto::MatchSet::default())), "match_set.first_keypoint_indices"),
        (set_up(|settings| settings.method = 42), "job.settings.method"),
        (set_up(|settings| settings.alpha = Some(f64::NAN)), "job.settings.alpha"),
        (set_up(|settings| settings.iterations = Some(0)), "job.settings.iterations"),
        (set_up(|settings| settings.noise_px = Some(f64::INFINITY)), "job.settings.noise_px"),
        (set_up(|settings| settings.noise_px = Some(1e20)), "job.settings.noise_px"),
        (described(|job| job.priority = i32::MAX), "job.priority"),
        (described(|job| job.deadline = deadline_time(1_800_000_000, 1_000_000_000)), "job.deadline_time"),
        (described(|job| job.deadline = deadline_time(i64::MAX, 0)), "job.deadline_time"),
        (described(|job| job.deadline = time_limit(-1, 2_000_000_000)), "job.time_limit"),
        (described(|job| job.deadline = time_limit(i64::MAX, 0)), "job.time_limit"),
        (proto::CreateJobRequest { source: None, ..create_tracks() }, "source"),
        (proto::CreateJobRequest { parent: "default".into(), ..create_tracks() }, "parent"),
        (proto::CreateJobRequest { job_id: "-".into(), ..create_tracks() }, "job_id"),
    ];
    for (request, field) in cases {
        let status = jobs.create_job(request).await.expect_err(field);
        let named = fields(&status);
        assert!(named.iter().any(|name| name == field), "{field} is not among {named:?}");
        let path_and_text = format!("{}: ", named[0]);
        assert!(status.message().starts_with(&path_and_text), "{}", status.message());
    }
    let listed = proto::ListJobsRequest { parent: "tenants/default".into(), ..Default::default() };
    assert_eq!(jobs.list_jobs(listed).await.expect("a list").into_inner().jobs, []);
    jobs.create_job(create_tracks()).await.expect("a good one still goes");
}

#[tokio::test]
async fn a_stream_is_checked_as_it_arrives() {
    let options = Options { limits: TIGHT, ..Options::default() };
    let server = TestServer::start_with(quick(), options, one_worker()).await;
    let mut calibration = server.calibration().await;
    let config = || Message::Config(create_tracks());
    let chunk = |y| Message::TrackSetChunk(proto::TrackSetChunk { ys: y, ..Default::default() });
    let mut refused = async |messages: Vec<Message>| {
        let requests: Vec<_> = messages.into_iter().map(solve_request).collect();
        let answer = calibration.solve(tokio_stream::iter(requests)).await;
        fields(&answer.expect_err("a bad stream was taken"))
    };
    assert_eq!(refused(vec![]).await, ["config"]);
    assert_eq!(refused(vec![chunk(vec![])]).await, ["config"]);
    assert_eq!(refused(vec![config(), config()]).await, ["config"]);
    assert_eq!(refused(vec![config(), chunk(vec![0.0])]).await, ["track_set.ys"]);
    let matrix_chunk = Message::MeasurementMatrixChunk(proto::MeasurementMatrixChunk::default());
    assert_eq!(refused(vec![config(), matrix_chunk]).await, ["measurement_matrix_chunk"]);
    let matches_chunk = |xs| Message::MatchSetChunk(proto::MatchSetChunk { xs, ..Default::default() });
    assert_eq!(refused(vec![config(), matches_chunk(vec![])]).await, ["match_set_chunk"]);
    let matches = || Message::Config(create(Source::MatchSet(match_set())));
    assert_eq!(refused(vec![matches(), chunk(vec![])]).await, ["track_set_chunk"]);
    assert_eq!(refused(vec![matches(), matches_chunk(vec![0.0; 6])]).await, ["match_set.xs"]);
}

#[tokio::test]
async fn an_endless_stream_is_cut_off() {
    let options = Options { limits: TIGHT, ..Options::default() };
    let server = TestServer::start_with(quick(), options, one_worker()).await;
    let chunk = proto::TrackSetChunk { xs: vec![0.0; 10_000], ..Default::default() };
    let endless = std::iter::once(Message::Config(create_tracks()))
        .chain(std::iter::repeat(Message::TrackSetChunk(chunk)))
        .map(solve_request);
    let answer = server.calibration().await.solve(tokio_stream::iter(endless)).await;
    assert_eq!(fields(&answer.expect_err("an endless stream")), ["track_set.xs"]);
}

#[tokio::test]
async fn a_message_above_the_limit_is_refused_and_the_server_goes_on() {
    let options = Options { max_message_bytes: 2_000, ..Options::default() };
    let server = TestServer::start_with(quick(), options, one_worker()).await;
    let mut jobs = server.jobs().await;
    let large = || tracks(|set| set.xs = vec![0.5; 1_000]);
    let plain = jobs.create_job(large()).await.expect_err("8,000 bytes of 2,000");
    // A few dozen bytes on the wire.
    let packed = jobs.clone().send_compressed(Gzip).create_job(large()).await.expect_err("8,000 bytes of 2,000");
    let messages = tokio_stream::iter([solve_request(Message::Config(large()))]);
    let streamed = server.calibration().await.solve(messages).await.expect_err("8,000 bytes of 2,000");
    for status in [plain, packed, streamed] {
        assert_eq!(status.code(), Code::OutOfRange, "{status}");
        assert_eq!(reason(&status), "MESSAGE_TOO_LARGE");
        assert!(status.message().contains("2000 bytes"), "{status}");
    }
    jobs.create_job(create_tracks()).await.expect("a small one still goes");
}

#[tokio::test]
async fn a_message_that_cannot_be_decoded_is_the_callers_fault_and_says_so() {
    let server = TestServer::start(quick()).await;
    let mut grpc = tonic::client::Grpc::new(server.channel().await);
    // Field 1 of these bytes: no UTF-8, as the name of GetJobRequest and the parent of CreateJobRequest have to be, and
    // a truncated message where SolveRequest has its config.
    let bad = vec![0xff, 0xfe];
    for method in ["JobService/GetJob", "JobService/CreateJob", "CalibrationService/Solve"] {
        grpc.ready().await.expect("a connection");
        let path = format!("/scpsfm.v1.{method}").parse().expect("a path");
        let codec = tonic_prost::ProstCodec::<Vec<u8>, proto::Job>::default();
        let sent = tonic::Request::new(tokio_stream::iter([bad.clone()]));
        let status = grpc.streaming(sent, path, codec).await.map(drop).expect_err(method);
        assert_eq!(status.code(), Code::InvalidArgument, "{method}: {status}");
        assert_eq!(reason(&status), "MALFORMED_MESSAGE", "{method}");
    }
}

#[tokio::test]
async fn unknown_and_foreign_names_are_told_apart_from_malformed_ones() {
    let server = TestServer::start(quick()).await;
    let mut jobs = server.jobs().await;
    let get = |name: &str| proto::GetJobRequest { name: name.into() };
    for name in ["tenants/default/jobs/none", "tenants/other/jobs/none"] {
        let status = jobs.get_job(get(name)).await.expect_err(name);
        assert_eq!(status.code(), Code::NotFound);
        assert_eq!(status.get_details_error_info().expect("an ErrorInfo").reason, "JOB_NOT_FOUND");
    }
    assert_eq!(fields(&jobs.get_job(get("none")).await.expect_err("malformed")), ["name"]);
    let foreign = proto::CreateJobRequest { parent: "tenants/other".into(), ..create_tracks() };
    let status = jobs.create_job(foreign).await.expect_err("another tenant");
    assert_eq!((status.code(), reason(&status).as_str()), (Code::NotFound, "TENANT_NOT_FOUND"));
    let watch = proto::WatchJobRequest { name: "tenants/default/jobs/none".into(), after_sequence: 0 };
    assert_eq!(jobs.watch_job(watch).await.expect_err("none").code(), Code::NotFound);
}

#[tokio::test]
async fn bad_watches_and_reads_are_refused() {
    let server = TestServer::start(quick()).await;
    let mut jobs = server.jobs().await;
    let name = jobs.create_job(create_tracks()).await.expect("a job").into_inner().name;
    let watch = |after_sequence| proto::WatchJobRequest { name: name.clone(), after_sequence };
    let (_, end) = all(jobs.watch_job(watch(0)).await.expect("a watch").into_inner()).await;
    end.expect("watched to the end");
    assert_eq!(fields(&jobs.watch_job(watch(1_000)).await.expect_err("beyond")), ["after_sequence"]);
    for offset in [-1, i64::MAX] {
        let read = proto::ReadJobResultRequest { name: name.clone(), offset };
        assert_eq!(fields(&jobs.read_job_result(read).await.expect_err("outside")), ["offset"]);
    }
    let list = |change: &dyn Fn(&mut proto::ListJobsRequest)| {
        let mut request = proto::ListJobsRequest { parent: "tenants/default".into(), ..Default::default() };
        change(&mut request);
        request
    };
    let cases = [
        (list(&|list| list.page_size = -1), "page_size"),
        (list(&|list| list.filter = "colour = red".into()), "filter"),
        (list(&|list| list.order_by = "name".into()), "order_by"),
        (list(&|list| list.page_token = "made up".into()), "page_token"),
    ];
    for (request, field) in cases {
        assert_eq!(fields(&jobs.list_jobs(request).await.expect_err(field)), [field]);
    }
    jobs.create_job(create_tracks()).await.expect("a second job");
    let first = jobs.list_jobs(list(&|list| list.page_size = 1)).await.expect("a page").into_inner();
    let token = first.next_page_token;
    let second = jobs.list_jobs(list(&|list| list.page_token = token.clone())).await.expect("the next page");
    assert_eq!(second.into_inner().jobs.len(), 1, "the page size may change");
    let cases = [
        list(&|list| (list.page_token, list.order_by) = (token.clone(), "create_time".into())),
        list(&|list| (list.page_token, list.filter) = (token.clone(), "state = SUCCEEDED".into())),
        list(&|list| list.page_token = format!("{token}0-0")),
        list(&|list| list.page_token = token[..token.len() / 2].into()),
        list(&|list| list.page_token = "f".repeat(100_000)),
    ];
    for request in cases {
        let status = jobs.list_jobs(request).await.expect_err("a token of another query, or of none");
        assert_eq!(fields(&status), ["page_token"]);
    }
}
