//! Webhooks, from outside: a real server, and receivers on the loopback interface.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{IpAddr, Ipv4Addr, SocketAddr, TcpListener, TcpStream};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, AtomicU16, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use hmac::{Hmac, Mac};
use rustix::process::Signal;
use scpsfm::rpc::proto::JobState;
use scpsfm::rpc::tls::Files;
use serde_json::{Value, json};
use sha2::Sha256;
use tokio_rustls::rustls::{ServerConfig, ServerConnection, StreamOwned};

use crate::support::certificates::Authority;
use crate::support::http::{Answer, get, path_of, post, request, tracks};
use crate::support::live;
use crate::support::program::{Running, Serving, run};
use crate::support::python::python;
use crate::support::scrape::Page;
use crate::support::server::PATIENCE;

/// 32 bytes.
const SECRET: &str = "whsec_c2VjcmV0LXNlY3JldC1zZWNyZXQtc2VjcmV0LXNlYzE=";

/// Iterations that keep a worker busy for half a minute or more if they are let.
const ENDLESS: u32 = 10_000;

const ANY_PORT: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 0);

/// How often something is looked for that is to come.
const POLL: Duration = Duration::from_millis(20);

/// A request that a receiver got.
#[derive(Debug, Clone)]
struct Received {
    /// Request line and headers, names in lower case.
    head: Vec<String>,
    body: Vec<u8>,
}

impl Received {
    fn header(&self, name: &str) -> &str {
        let found = self.head.iter().find_map(|line| line.strip_prefix(name)?.strip_prefix(": "));
        found.unwrap_or_else(|| panic!("no {name} in {:?}", self.head))
    }

    fn json(&self) -> Value {
        serde_json::from_slice(&self.body).expect("JSON")
    }

    /// Asserts that the signature is that of the secret over id, time and body.
    fn assert_signed(&self) {
        let secret = STANDARD.decode(SECRET.trim_start_matches("whsec_")).expect("base64");
        let mut mac = Hmac::<Sha256>::new_from_slice(&secret).expect("any length");
        mac.update(format!("{}.{}.", self.header("webhook-id"), self.header("webhook-timestamp")).as_bytes());
        mac.update(&self.body);
        let expected = format!("v1,{}", STANDARD.encode(mac.finalize().into_bytes()));
        assert_eq!(self.header("webhook-signature"), expected);
    }
}

/// A connection, encrypted or not.
trait Stream: Read + Write {}

impl<T: Read + Write> Stream for T {}

/// An HTTP server that answers every request with one status, and keeps what it got. It is down once dropped.
struct Receiver {
    address: SocketAddr,
    status: Arc<AtomicU16>,
    received: Arc<Mutex<Vec<Received>>>,
    stopped: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Receiver {
    fn start(status: u16) -> Self {
        Self::start_on(ANY_PORT, status, None)
    }

    /// On this address, which another one may have had before.
    fn start_on(address: SocketAddr, status: u16, tls: Option<Arc<ServerConfig>>) -> Self {
        let listener = until("the address is free", || TcpListener::bind(address).ok());
        let address = listener.local_addr().expect("an address");
        let status = Arc::new(AtomicU16::new(status));
        let received: Arc<Mutex<Vec<Received>>> = Arc::default();
        let stopped = Arc::new(AtomicBool::new(false));
        let thread = std::thread::spawn({
            let (status, received, stopped) = (status.clone(), received.clone(), stopped.clone());
            move || {
                for connection in listener.incoming() {
                    if stopped.load(Ordering::SeqCst) {
                        return;
                    }
                    let Ok(connection) = connection else { continue };
                    connection.set_read_timeout(Some(PATIENCE)).expect("a timeout");
                    let mut connection: Box<dyn Stream> = match tls.clone().map(ServerConnection::new) {
                        None => Box::new(connection),
                        Some(session) => Box::new(StreamOwned::new(session.expect("a session"), connection)),
                    };
                    // A sender that is killed, or does not trust the certificate, leaves half a request or none.
                    let Some(request) = read(&mut connection) else { continue };
                    let status = status.load(Ordering::SeqCst);
                    received.lock().expect("no panic").push(request);
                    let answer = format!(
                        "HTTP/1.1 {status} Told\r\nlocation: http://{address}/elsewhere\r\ncontent-length: 0\r\n\r\n"
                    );
                    let _ = connection.write_all(answer.as_bytes()).and_then(|()| connection.flush());
                }
            }
        });
        Self { address, status, received, stopped, thread: Some(thread) }
    }

    fn url(&self) -> String {
        format!("http://{}/jobs?token=a%20b", self.address)
    }

    fn answer_with(&self, status: u16) {
        self.status.store(status, Ordering::SeqCst);
    }

    fn received(&self) -> MutexGuard<'_, Vec<Received>> {
        self.received.lock().expect("no panic")
    }

    /// What it got, once that is something.
    fn first(&self) -> Received {
        until("a request arrives", || self.received().first().cloned())
    }
}

impl Drop for Receiver {
    fn drop(&mut self) {
        self.stopped.store(true, Ordering::SeqCst);
        // Wakes it.
        let _ = TcpStream::connect(self.address);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// A whole request; `None` where the connection ends before it does.
fn read(connection: &mut impl Read) -> Option<Received> {
    let mut reader = BufReader::new(connection);
    let mut head = Vec::new();
    loop {
        let mut line = String::new();
        if reader.read_line(&mut line).ok()? == 0 {
            return None;
        }
        match line.trim_end() {
            "" => break,
            line => head.push(line.to_owned()),
        }
    }
    let length = head.iter().find_map(|line| line.strip_prefix("content-length: ")?.parse().ok())?;
    let mut body = vec![0; length];
    reader.read_exact(&mut body).ok()?;
    Some(Received { head, body })
}

/// Asks until there is an answer; the bound is for a hang.
fn until<T>(what: &str, mut ask: impl FnMut() -> Option<T>) -> T {
    let begun = Instant::now();
    loop {
        if let Some(answer) = ask() {
            return answer;
        }
        assert!(begun.elapsed() < 2 * PATIENCE, "this does not happen: {what}");
        std::thread::sleep(POLL);
    }
}

/// A server with webhooks, to private addresses too where `private`.
fn serving(data: &tempfile::TempDir, private: bool) -> Serving {
    let mut variables = vec![("SCPSFM_WEBHOOKS__SECRET", SECRET)];
    if private {
        variables.push(("SCPSFM_WEBHOOKS__ALLOW_PRIVATE_ADDRESSES", "true"));
    }
    Serving::start_with(data.path(), &variables, Stdio::null())
}

fn data() -> tempfile::TempDir {
    tempfile::tempdir().expect("a temporary directory")
}

fn create(server: &Serving, url: &str) -> Answer {
    post(server, "/v1/tenants/-/jobs", &json!({"trackSet": tracks(), "job": {"webhook": {"url": url}}}))
}

/// The path of a new job with this webhook.
fn created(server: &Serving, url: &str) -> String {
    let answer = create(server, url);
    assert_eq!(answer.code, 200, "{}", answer.text());
    let webhook = &answer.json()["webhook"];
    assert_eq!((&webhook["url"], &webhook["state"]), (&json!(url), &json!("WEBHOOK_STATE_PENDING")), "{webhook}");
    path_of(&answer.json())
}

/// A job's webhook, once it is as `wanted`.
fn webhook_until(server: &Serving, path: &str, wanted: impl Fn(&Value) -> bool) -> Value {
    let mut last = Value::Null;
    let begun = Instant::now();
    loop {
        let webhook = get(server, path).json()["webhook"].clone();
        if wanted(&webhook) {
            return webhook;
        }
        last = if webhook.is_null() { last } else { webhook };
        assert!(begun.elapsed() < 2 * PATIENCE, "the webhook stays {last}");
        std::thread::sleep(POLL);
    }
}

fn is_in(state: &str) -> impl Fn(&Value) -> bool {
    let state = json!(format!("WEBHOOK_STATE_{state}"));
    move |webhook| webhook["state"] == state
}

fn has_error(text: &str) -> impl Fn(&Value) -> bool {
    move |webhook| webhook["lastError"].as_str().is_some_and(|error| error.contains(text))
}

fn attempts(server: &Serving, outcome: &str) -> f64 {
    let page = Page::parse(&server.page("/metrics"));
    page.value(&format!("scpsfm_webhook_attempts_total{{outcome=\"{outcome}\"}}"))
}

#[test]
fn a_receiver_that_is_back_after_an_outage_gets_the_job_although_the_server_was_killed() {
    let data = data();
    let receiver = Receiver::start(500);
    let (address, url) = (receiver.address, receiver.url());
    let mut server = serving(&data, true);
    let path = created(&server, &url);
    let first = receiver.first();
    first.assert_signed();
    webhook_until(&server, &path, has_error("500"));
    server.running.signal(Signal::KILL);
    server.running.wait();
    drop(receiver);
    let server = serving(&data, true);
    let failed = webhook_until(&server, &path, has_error("cannot connect"));
    assert!(failed["attemptCount"].as_u64() >= Some(2), "{failed}");
    let receiver = Receiver::start_on(address, 204, None);
    let delivered = webhook_until(&server, &path, is_in("DELIVERED"));
    assert!(delivered["lastError"].is_null() && delivered["attemptCount"].as_u64() >= Some(3), "{delivered}");
    let last = receiver.first();
    last.assert_signed();
    assert_eq!(last.head[0], "POST /jobs?token=a%20b HTTP/1.1");
    assert_eq!(last.header("content-type"), "application/json");
    assert_eq!(last.header("host"), address.to_string());
    assert_eq!(last.header("webhook-id"), first.header("webhook-id"), "one message, whatever its attempts");
    // What arrives is what a look at the job shows, but for the delivery itself.
    let without_webhook = |mut job: Value| {
        job.as_object_mut().expect("an object").remove("webhook").expect("a webhook");
        job
    };
    let job = get(&server, &path).json();
    assert_eq!(job["state"], "JOB_STATE_SUCCEEDED");
    assert_eq!(without_webhook(last.json()), without_webhook(job));
    // Metrics follow the commit.
    until("the metrics tell it", || (attempts(&server, "DELIVERED") == 1.0).then_some(()));
    until("none is pending", || {
        let page = Page::parse(&server.page("/metrics"));
        (page.value("scpsfm_webhooks_pending") == 0.0).then_some(())
    });
    assert_eq!(receiver.received().len(), 1);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_that_is_cancelled_in_the_queue_is_told_too() {
    let data = data();
    let receiver = Receiver::start(200);
    let server = serving(&data, true);
    let mut jobs = live::connected(&server).await;
    let busy = live::created(&mut jobs, live::lasting(ENDLESS)).await;
    live::reaches(&mut jobs, &busy, &[JobState::Running]).await;
    let path = created(&server, &receiver.url());
    let cancelled = request(&server, "POST", &format!("{path}:cancel"), &[], &[]);
    assert_eq!(cancelled.json()["state"], "JOB_STATE_CANCELLED");
    webhook_until(&server, &path, is_in("DELIVERED"));
    assert_eq!(receiver.first().json()["state"], "JOB_STATE_CANCELLED");
}

#[test]
fn addresses_that_are_not_public_are_refused_whether_named_or_resolved() {
    let data = data();
    let receiver = Receiver::start(200);
    let server = serving(&data, false);
    let port = receiver.address.port();
    for host in ["127.0.0.1", "127.1", "2130706433", "[::1]", "[::ffff:127.0.0.1]", "10.0.0.1", "169.254.169.254"] {
        let refused = create(&server, &format!("http://{host}:{port}/"));
        let expected = (400, ("INVALID_ARGUMENT".to_owned(), "job.webhook.url".to_owned()));
        assert_eq!((refused.code, refused.refusal()), expected, "{host}");
        assert!(refused.text().contains("webhooks.allow_private_addresses"), "{}", refused.text());
    }
    // A name is only resolved when it is sent to, each time anew.
    let path = created(&server, &format!("http://localhost:{port}/"));
    let webhook = webhook_until(&server, &path, has_error("no public address"));
    assert_eq!(webhook["state"], "WEBHOOK_STATE_PENDING", "names may change their addresses: {webhook}");
    assert!(receiver.received().is_empty());
}

#[test]
fn redirects_are_not_followed_and_a_receiver_that_is_gone_is_given_up() {
    let data = data();
    let receiver = Receiver::start(307);
    let server = serving(&data, true);
    let path = created(&server, &receiver.url());
    webhook_until(&server, &path, has_error("redirects are not followed"));
    receiver.answer_with(410);
    let given_up = webhook_until(&server, &path, is_in("GIVEN_UP"));
    assert!(has_error("410")(&given_up), "{given_up}");
    until("the metrics tell it", || (attempts(&server, "GIVEN_UP") == 1.0).then_some(()));
    assert!(attempts(&server, "FAILED") >= 1.0);
    let received = receiver.received();
    assert!(received.iter().all(|request| request.head[0].starts_with("POST /jobs?")), "{received:?}");
    let ids: std::collections::BTreeSet<_> = received.iter().map(|request| request.header("webhook-id")).collect();
    assert_eq!(ids.len(), 1);
}

#[test]
fn receivers_over_https_have_a_certificate_of_an_authority_that_the_system_trusts() {
    let data = data();
    let authority = Authority::new("of the receiver");
    let identity = authority.issue(data.path(), "receiver", &["localhost"]);
    let files = Files { certificate: identity.certificate, key: identity.key, client_ca: None };
    let receiver = Receiver::start_on(ANY_PORT, 200, Some(Arc::new(files.load().expect("a configuration"))));
    let port = receiver.address.port();
    let authority = authority.write(data.path(), "authority.pem");
    let variables = |trusted: bool| {
        let mut variables =
            vec![("SCPSFM_WEBHOOKS__SECRET", SECRET), ("SCPSFM_WEBHOOKS__ALLOW_PRIVATE_ADDRESSES", "true")];
        // What the system trusts, instead of its own list.
        variables.extend(trusted.then(|| ("SSL_CERT_FILE", authority.to_str().expect("a text"))));
        variables
    };
    let server = Serving::start_with(&data.path().join("wary"), &variables(false), Stdio::null());
    let path = created(&server, &format!("https://localhost:{port}/"));
    webhook_until(&server, &path, has_error("TLS"));
    let server = Serving::start_with(&data.path().join("trusting"), &variables(true), Stdio::null());
    let path = created(&server, &format!("https://127.0.0.1:{port}/"));
    webhook_until(&server, &path, has_error("TLS"));
    assert!(receiver.received().is_empty(), "nothing is sent to whom the certificate does not name");
    let path = created(&server, &format!("https://localhost:{port}/"));
    webhook_until(&server, &path, is_in("DELIVERED"));
    receiver.first().assert_signed();
}

#[test]
fn a_webhook_that_cannot_be_is_refused_by_its_field() {
    let data = data();
    let url = "https://hooks.example/a";
    let off = Serving::start(data.path());
    let refused = create(&off, url);
    assert_eq!((refused.code, refused.refusal().1.as_str()), (400, "job.webhook"));
    assert!(refused.text().contains("webhooks.secret"), "{}", refused.text());
    drop(off);
    let others = format!("north:{SECRET}");
    let server = Serving::start_with(data.path(), &[("SCPSFM_WEBHOOKS__SECRET", &others)], Stdio::null());
    assert_eq!(create(&server, url).refusal().1, "job.webhook", "the secret is another tenant's");
    for wrong in ["", "ftp://a/", "https://user:word@a/", "https://a/#b", "a"] {
        let refused = create(&server, wrong);
        assert_eq!((refused.code, refused.refusal().1.as_str()), (400, "job.webhook.url"), "{wrong}");
    }
    let second = json!({"trackSet": tracks(), "job": {"webhook": {"url": "ftp://a/"}}});
    let batch = json!({"requests": [{"trackSet": tracks()}, second]});
    let refused = post(&server, "/v1/tenants/-/jobs:batchCreate", &batch);
    assert_eq!(refused.refusal().1, "requests[1].job.webhook.url");
    assert_eq!(get(&server, "/v1/tenants/-/jobs").json(), json!({}), "nothing was stored");
}

#[test]
fn the_command_line_names_a_webhook_and_shows_it() {
    let data = data();
    let receiver = Receiver::start(410);
    let server = serving(&data, true);
    let table = data.path().join("tracks.csv");
    let rows =
        (0..3).flat_map(|view| (0..4).map(move |track| format!("{view},{track},{},{}\n", 10 * track + view, track)));
    std::fs::write(&table, format!("view,track,x,y\n{}", rows.collect::<String>())).expect("written");
    let table = table.to_str().expect("a text");
    let submit = |url: &str| {
        run(["submit", table, "--width", "640", "--height", "480", "--webhook", url, "--server", &server.grpc])
    };
    let wrong = submit("ftp://a/");
    assert_eq!(wrong.code, Some(2), "{wrong:?}");
    assert!(wrong.stderr.contains("--webhook") && wrong.stderr.contains("https"), "{wrong:?}");
    let submitted = submit(&receiver.url());
    assert_eq!(submitted.code, Some(0), "{submitted:?}");
    let name = submitted.stdout.trim();
    webhook_until(&server, &format!("/v1/{name}"), is_in("GIVEN_UP"));
    let shown = run(["get", name, "--server", &server.grpc]);
    let line = shown.stdout.lines().find(|line| line.trim_start().starts_with("webhook: ")).expect("a line");
    assert!(line.contains(&receiver.url()) && line.contains("GIVEN_UP") && line.contains("410"), "{line}");
    let shown = run(["get", name, "--json", "--server", &server.grpc]);
    let job: Value = serde_json::from_str(&shown.stdout).expect("JSON");
    assert_eq!((&job["webhook"]["state"], &job["webhook"]["attempt_count"]), (&json!("GIVEN_UP"), &json!(1)));
}

#[test]
fn the_receiver_of_the_docs_takes_what_is_signed_and_nothing_else() {
    let Some(python) = python("docs/examples/webhook_receiver.py", "http.server") else { return };
    let mut command = Command::new(python);
    command.args(["docs/examples/webhook_receiver.py", "127.0.0.1:0"]).env("WEBHOOK_SECRET", SECRET);
    let mut child = command.stdin(Stdio::null()).stdout(Stdio::piped()).spawn().expect("it starts");
    let mut lines = BufReader::new(child.stdout.take().expect("piped")).lines().map(|line| line.expect("a line"));
    let _running = Running(child);
    let listening = lines.next().expect("where it listens");
    let url = listening.strip_prefix("listening on ").expect("an address");
    let forged = |headers: &str| {
        let mut connection = TcpStream::connect(url.strip_prefix("http://").expect("an address")).expect("it answers");
        let request = format!("POST / HTTP/1.0\r\ncontent-length: 2\r\n{headers}\r\n{{}}");
        connection.write_all(request.as_bytes()).expect("sent");
        let mut answer = String::new();
        connection.read_to_string(&mut answer).expect("an answer");
        answer.split(' ').nth(1).map(str::to_owned)
    };
    for headers in ["", "webhook-id: a\r\nwebhook-timestamp: 9999999999\r\nwebhook-signature: v1,AAAA\r\n"] {
        assert_eq!(forged(headers).as_deref(), Some("401"), "{headers:?}");
    }
    let data = data();
    let server = serving(&data, true);
    let path = created(&server, url);
    webhook_until(&server, &path, is_in("DELIVERED"));
    let told = lines.next().expect("a job");
    assert_eq!(told, format!("{} JOB_STATE_SUCCEEDED", path.trim_start_matches("/v1/")));
}
