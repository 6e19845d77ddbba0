//! TLS and mTLS: whom each side trusts, certificates that change, handshakes that stall.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use scpsfm::client::{self, Client, Error, ErrorKind, Setting};
use scpsfm::rpc::proto::job_service_client::JobServiceClient;
use scpsfm::rpc::proto::{self, JobState};
use scpsfm::rpc::server::Options;
use scpsfm::rpc::tls::{self, Files};
use tempfile::TempDir;
use tokio::io::AsyncReadExt;
use tokio::net::TcpStream;
use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::ServerName;
use tokio_rustls::rustls::{ClientConfig, RootCertStore};
use tonic::transport::{Certificate, ClientTlsConfig, Endpoint};

use crate::support::certificates::{Authority, Identity, written};
use crate::support::server::{TestServer, one_worker, soon};
use crate::support::solvers::{held, quick};
use crate::support::wire::{all, create_tracks, state_of};

/// Names that the server's certificate is for.
const HERE: [&str; 2] = ["localhost", "127.0.0.1"];

fn options(identity: &Identity, client_ca: Option<&Path>) -> Options {
    let files = Files {
        certificate: identity.certificate.clone(),
        key: identity.key.clone(),
        client_ca: client_ca.map(Path::to_owned),
    };
    Options { tls: Some(files), look_every: Duration::from_millis(10), ..Options::default() }
}

fn url(server: &TestServer) -> String {
    format!("https://{}", server.server.address())
}

/// A client that trusts this authority.
fn trusting(authority: &Path) -> client::Options {
    client::Options { tls_ca: Some(authority.to_owned()), ..client::Options::default() }
}

/// Connects and makes a call: some refusals come only with the answer to the first.
async fn greet(url: &str, access: &client::Options) -> Result<(), Error> {
    let mut client = soon(Client::connect(url, access)).await?;
    soon(client.list("", 1, "")).await.map(drop)
}

#[tokio::test]
async fn the_server_must_be_who_it_says_and_errors_say_what_to_do() {
    let directory = TempDir::new().expect("a temporary directory");
    let at = directory.path();
    let authority = Authority::new("ours");
    let (ours, other) = (authority.write(at, "ours.pem"), Authority::new("other").write(at, "other.pem"));
    let here = authority.issue(at, "here", &HERE);
    let server = TestServer::start_with(quick(), options(&here, None), one_worker()).await;
    greet(&url(&server), &trusting(&ours)).await.expect("trusted");

    let refused = async |url: &str, access: &client::Options, part: &str| {
        let error = greet(url, access).await.expect_err(part);
        assert!(error.kind == ErrorKind::NotLetIn && error.message.contains(part), "{error:?}");
    };
    refused(&url(&server), &trusting(&other), "`tls_ca`").await;
    let elsewhere = authority.issue(at, "elsewhere", &["far.example"]);
    let misnamed = TestServer::start_with(quick(), options(&elsewhere, None), one_worker()).await;
    refused(&url(&misnamed), &trusting(&ours), "another name").await;
    let unencrypted = format!("http://{}", server.server.address());
    let error = greet(&unencrypted, &client::Options::default()).await.expect_err("TLS there");
    // In which words depends on which side closes first.
    assert_eq!(error.kind, ErrorKind::Unavailable, "{error:?}");
    let own = Authority::new("own").own(at, "own");
    let itself = TestServer::start_with(quick(), options(&own, None), one_worker()).await;
    refused(&url(&itself), &trusting(&own.certificate), "CA:FALSE").await;
    let plain = TestServer::start(quick()).await;
    refused(&url(&plain), &trusting(&ours), "http://").await;
    let error = Client::connect(&plain.url(), &trusting(&ours)).await.expect_err("no TLS there");
    assert!(error.kind == ErrorKind::Usage && error.message.contains("https://"), "{error:?}");
    let error = Client::connect(&url(&server), &trusting(&here.key)).await.expect_err("a key is no certificate");
    assert_eq!((error.kind, error.setting), (ErrorKind::Usage, Some(Setting::TlsCa)), "{error:?}");
}

#[tokio::test]
async fn with_a_client_authority_only_its_clients_are_let_in() {
    let directory = TempDir::new().expect("a temporary directory");
    let at = directory.path();
    let (authority, others) = (Authority::new("ours"), Authority::new("other"));
    let ours = authority.write(at, "ours.pem");
    let here = authority.issue(at, "here", &HERE);
    let server = TestServer::start_with(quick(), options(&here, Some(&ours)), one_worker()).await;
    let showing = |identity: &Identity| client::Options {
        tls_cert: Some(identity.certificate.clone()),
        tls_key: Some(identity.key.clone()),
        ..trusting(&ours)
    };
    let client = authority.issue(at, "client", &["client"]);
    greet(&url(&server), &showing(&client)).await.expect("let in");
    let error = greet(&url(&server), &trusting(&ours)).await.expect_err("no certificate");
    assert!(error.kind == ErrorKind::NotLetIn && error.message.contains("asks for a client's"), "{error:?}");
    let stranger = others.issue(at, "stranger", &["client"]);
    let error = greet(&url(&server), &showing(&stranger)).await.expect_err("a stranger");
    assert!(error.kind == ErrorKind::NotLetIn && error.message.contains("does not trust"), "{error:?}");
}

/// The certificate that the server shows now, and the protocol that it agrees to.
async fn shown(server: &TestServer, authority: &Path) -> (Vec<u8>, Option<Vec<u8>>) {
    let mut roots = RootCertStore::empty();
    roots.add_parsable_certificates(tls::certificates(authority).expect("certificates"));
    let builder = ClientConfig::builder_with_provider(Arc::new(ring::default_provider()));
    let builder = builder.with_safe_default_protocol_versions().expect("versions");
    let mut config = builder.with_root_certificates(roots).with_no_client_auth();
    config.alpn_protocols = vec![b"http/1.1".to_vec(), b"h2".to_vec()];
    let connection = TcpStream::connect(server.server.address()).await.expect("a connection");
    let name = ServerName::try_from("localhost").expect("a name");
    let connector = tokio_rustls::TlsConnector::from(Arc::new(config));
    let connection = connector.connect(name, connection).await.expect("a handshake");
    let (_, session) = connection.get_ref();
    let certificate = session.peer_certificates().expect("certificates")[0].to_vec();
    (certificate, session.alpn_protocol().map(<[u8]>::to_vec))
}

#[tokio::test]
async fn new_connections_get_the_new_certificate_and_open_streams_go_on() {
    let directory = TempDir::new().expect("a temporary directory");
    let at = directory.path();
    let authority = Authority::new("ours");
    let ours = authority.write(at, "ours.pem");
    let first = authority.issue(at, "server", &HERE);
    let (solver, hold) = held();
    let server = TestServer::start_with(solver, options(&first, None), one_worker()).await;
    assert_eq!(shown(&server, &ours).await, (first.der.clone(), Some(b"h2".to_vec())));
    let trusted = Certificate::from_pem(std::fs::read(&ours).expect("read"));
    let endpoint = Endpoint::from_shared(url(&server)).expect("a URL");
    let endpoint = endpoint.tls_config(ClientTlsConfig::new().ca_certificate(trusted)).expect("TLS");
    let mut jobs = JobServiceClient::new(endpoint.connect().await.expect("a connection"));
    let name = jobs.create_job(create_tracks()).await.expect("a job").into_inner().name;
    let watch = proto::WatchJobRequest { name: name.clone(), after_sequence: 0 };
    let mut watch = jobs.watch_job(watch).await.expect("a watch").into_inner();
    while state_of(&soon(watch.message()).await.expect("an event").expect("no end")) != Some(JobState::Running) {}

    // The same files, one after the other: in between the two do not belong together.
    let second = authority.issue(at, "server", &HERE);
    assert_ne!(first.der, second.der);
    soon(async {
        while shown(&server, &ours).await.0 != second.der {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    })
    .await;
    // Neither a key of another certificate nor no certificate at all is ever shown.
    let third = authority.issue(at, "other", &HERE);
    std::fs::copy(&third.key, &second.key).expect("copied");
    tokio::time::sleep(Duration::from_millis(100)).await;
    assert_eq!(shown(&server, &ours).await.0, second.der);
    written(at, "server.pem", "none");
    tokio::time::sleep(Duration::from_millis(100)).await;
    assert_eq!(shown(&server, &ours).await.0, second.der);

    hold.let_go();
    let (events, end) = soon(all(watch)).await;
    end.expect("the watch ends with the job");
    assert_eq!(events.last().and_then(state_of), Some(JobState::Succeeded));
    jobs.get_job(proto::GetJobRequest { name }).await.expect("the old connection still serves");
}

#[tokio::test]
async fn handshakes_that_stall_hold_up_nobody_and_are_ended() {
    let directory = TempDir::new().expect("a temporary directory");
    let at = directory.path();
    let authority = Authority::new("ours");
    let ours = authority.write(at, "ours.pem");
    let here = authority.issue(at, "here", &HERE);
    let patient = TestServer::start_with(quick(), options(&here, None), one_worker()).await;
    let mut stalled = Vec::new();
    for _ in 0..50 {
        stalled.push(TcpStream::connect(patient.server.address()).await.expect("a connection"));
    }
    greet(&url(&patient), &trusting(&ours)).await.expect("not held up");

    let hasty = Options { handshake_timeout: Duration::from_millis(50), ..options(&here, None) };
    let hasty = TestServer::start_with(quick(), hasty, one_worker()).await;
    let mut connection = TcpStream::connect(hasty.server.address()).await.expect("a connection");
    let read = soon(connection.read(&mut [0; 1])).await;
    assert!(!matches!(read, Ok(1..)), "{read:?} instead of an end");
}

#[tokio::test]
async fn files_that_cannot_be_used_are_named_before_the_server_starts() {
    let directory = TempDir::new().expect("a temporary directory");
    let at = directory.path();
    let authority = Authority::new("ours");
    let (here, other) = (authority.issue(at, "here", &HERE), authority.issue(at, "other", &HERE));
    let cases = [
        (Identity { certificate: at.join("none.pem"), ..at_key(&here) }, "none.pem"),
        (Identity { certificate: here.key.clone(), ..at_key(&here) }, "holds no certificate"),
        (Identity { certificate: here.certificate.clone(), ..at_key(&other) }, "do not belong together"),
        (Identity { certificate: here.certificate.clone(), key: here.certificate.clone(), der: vec![] }, "private key"),
    ];
    let secret = std::fs::read_to_string(&here.key).expect("read");
    let secret = secret.lines().nth(1).expect("a line of the key");
    for (identity, part) in cases {
        let error = options(&identity, None).check_access().expect_err(part).to_string();
        assert!(error.contains(part) && !error.contains(secret), "{error}");
    }
}

/// The key alone.
fn at_key(identity: &Identity) -> Identity {
    Identity { certificate: identity.certificate.clone(), key: identity.key.clone(), der: vec![] }
}
