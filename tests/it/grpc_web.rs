//! gRPC-Web, from outside: a real server, frames made by hand, HTTP/1.1.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::process::Stdio;

use prost::Message;
use scpsfm::rpc::proto::{self, job_event::Body};

use crate::support::program::Serving;
use crate::support::wire::create_tracks;

/// A page that may call.
const APP: &str = "https://app.example";
/// Set in the first byte of the frame that holds the trailers.
const TRAILERS: u8 = 0x80;

struct Answer {
    head: String,
    /// Messages, as they came.
    messages: Vec<Vec<u8>>,
    /// Headers and trailers, lowercase, without spaces.
    status: String,
}

/// Head, in lowercase, and body of an answer of HTTP/1.1.
fn exchange(server: &Serving, verb: &str, path: &str, headers: &[(&str, &str)], body: &[u8]) -> (String, Vec<u8>) {
    let address = server.http.strip_prefix("http://").expect("an address");
    let mut connection = TcpStream::connect(address).expect("the port answers");
    let mut head =
        format!("{verb} {path} HTTP/1.1\r\nhost: {address}\r\nconnection: close\r\ncontent-length: {}\r\n", body.len());
    for (name, value) in headers {
        head.push_str(&format!("{name}: {value}\r\n"));
    }
    connection.write_all(format!("{head}\r\n").as_bytes()).expect("sent");
    connection.write_all(body).expect("sent");
    let mut answer = Vec::new();
    connection.read_to_end(&mut answer).expect("an answer");
    let end = answer.windows(4).position(|four| four == b"\r\n\r\n").expect("a head");
    let head = String::from_utf8(answer[..end].to_vec()).expect("text").to_ascii_lowercase();
    let body = &answer[end + 4..];
    if head.contains("transfer-encoding: chunked") { (head, unchunked(body)) } else { (head, body.to_vec()) }
}

fn unchunked(mut body: &[u8]) -> Vec<u8> {
    let mut whole = Vec::new();
    loop {
        let end = body.windows(2).position(|two| two == b"\r\n").expect("a chunk's length");
        let length = std::str::from_utf8(&body[..end]).expect("text");
        let length = usize::from_str_radix(length, 16).expect("a number");
        if length == 0 {
            return whole;
        }
        whole.extend_from_slice(&body[end + 2..end + 2 + length]);
        body = &body[end + 2 + length + 2..];
    }
}

fn call(server: &Serving, method: &str, message: &impl Message, headers: &[(&str, &str)]) -> Answer {
    let message = message.encode_to_vec();
    let mut frame = vec![0];
    frame.extend((message.len() as u32).to_be_bytes());
    frame.extend(message);
    let kind = [("content-type", "application/grpc-web+proto"), ("x-grpc-web", "1")];
    let headers: Vec<_> = kind.iter().chain(headers).copied().collect();
    let (head, body) = exchange(server, "POST", &format!("/scpsfm.v1.{method}"), &headers, &frame);
    let mut answer = Answer { status: head.replace(' ', ""), head, messages: Vec::new() };
    let mut rest = body.as_slice();
    while !rest.is_empty() {
        let length = u32::from_be_bytes(rest[1..5].try_into().expect("four bytes")) as usize;
        let content = &rest[5..5 + length];
        if rest[0] == TRAILERS {
            let trailers = String::from_utf8(content.to_vec()).expect("text").to_ascii_lowercase();
            answer.status.push_str(&format!("\r\n{}", trailers.replace(' ', "")));
        } else {
            answer.messages.push(content.to_vec());
        }
        rest = &rest[5 + length..];
    }
    answer
}

impl Answer {
    fn has_status(&self, code: u8) -> bool {
        self.status.lines().any(|line| line == format!("grpc-status:{code}"))
    }
}

#[test]
fn a_job_is_created_and_watched_and_an_error_is_told() {
    let data = tempfile::tempdir().expect("a temporary directory");
    let server = Serving::start(data.path());
    let created = call(&server, "JobService/CreateJob", &create_tracks(), &[]);
    assert!(created.has_status(0), "{}", created.status);
    assert!(created.head.contains("content-type: application/grpc-web"), "{}", created.head);
    let [job] = created.messages.as_slice() else { panic!("{} messages", created.messages.len()) };
    let job = proto::Job::decode(job.as_slice()).expect("a job");

    let watch = proto::WatchJobRequest { name: job.name.clone(), after_sequence: 0 };
    let watched = call(&server, "JobService/WatchJob", &watch, &[]);
    assert!(watched.has_status(0), "{}", watched.status);
    let events = watched.messages.iter().map(|event| proto::JobEvent::decode(event.as_slice()).expect("an event"));
    let events: Vec<proto::JobEvent> = events.filter(|event| event.sequence > 0).collect();
    let numbers: Vec<u64> = events.iter().map(|event| event.sequence).collect();
    assert_eq!(numbers, (1..=numbers.len() as u64).collect::<Vec<_>>());
    let last = events.last().and_then(|event| event.body.as_ref());
    let succeeded = proto::JobState::Succeeded as i32;
    assert!(matches!(last, Some(Body::StateChange(change)) if change.state == succeeded), "{last:?}");

    let unknown = proto::GetJobRequest { name: "tenants/default/jobs/none".into() };
    let refused = call(&server, "JobService/GetJob", &unknown, &[]);
    assert!(refused.has_status(5) && refused.messages.is_empty(), "{}", refused.status);
    assert!(refused.status.contains("grpc-status-details-bin:"), "{}", refused.status);
}

#[test]
fn a_key_is_asked_for() {
    let data = tempfile::tempdir().expect("a temporary directory");
    let key = "north-0123456789abcdef0123456789abcdef";
    let keys = format!("north:{key}");
    let server = Serving::start_with(data.path(), &[("SCPSFM_AUTH__KEYS", &keys)], Stdio::null());
    let list = proto::ListJobsRequest { parent: "tenants/-".into(), ..Default::default() };
    assert!(call(&server, "JobService/ListJobs", &list, &[]).has_status(16));
    let bearer = format!("Bearer {key}");
    let listed = call(&server, "JobService/ListJobs", &list, &[("authorization", &bearer)]);
    assert!(listed.has_status(0), "{}", listed.status);
}

#[test]
fn pages_of_named_origins_may_call_and_no_others() {
    let data = tempfile::tempdir().expect("a temporary directory");
    let named = format!("https://other.example, {APP}");
    let server = Serving::start_with(data.path(), &[("SCPSFM_HTTP__ALLOWED_ORIGINS", &named)], Stdio::null());
    let path = "/scpsfm.v1.JobService/ListJobs";
    let preflight = |origin| exchange(&server, "OPTIONS", path, &[("origin", origin)], &[]).0;
    let permission = preflight(APP);
    assert!(permission.starts_with("http/1.1 204"), "{permission}");
    for line in [
        "access-control-allow-origin: https://app.example",
        "access-control-allow-methods: delete, get, post",
        "vary: origin",
    ] {
        assert!(permission.lines().any(|told| told == line), "{line} is not in {permission}");
    }
    assert!(permission.contains("authorization, content-type"), "{permission}");
    let list = proto::ListJobsRequest { parent: "tenants/-".into(), ..Default::default() };
    let listed = call(&server, "JobService/ListJobs", &list, &[("origin", APP)]);
    assert!(listed.has_status(0) && listed.head.contains("access-control-allow-origin: https://app.example"));
    let exposed = "access-control-expose-headers: accept-ranges, content-range, etag, grpc-message, grpc-status";
    assert!(listed.head.contains(exposed), "{}", listed.head);
    let kind = [("content-type", "application/grpc-web")];
    let (read, _) = exchange(&server, "GET", path, &kind, &[]);
    assert!(read.starts_with("http/1.1 405") && read.lines().any(|told| told == "allow: post"), "{read}");
    // JSON likewise.
    let (json, _) = exchange(&server, "GET", "/v1/capabilities", &[("origin", APP)], &[]);
    assert!(json.starts_with("http/1.1 200") && json.contains("access-control-allow-origin: https://app.example"));
    for head in [
        preflight("https://evil.example"),
        exchange(&server, "GET", "/v1/capabilities", &[("origin", "https://evil.example")], &[]).0,
    ] {
        assert!(head.starts_with("http/1.1 403") && !head.contains("access-control"), "{head}");
    }
}
