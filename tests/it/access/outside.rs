//! The real program: what it refuses to listen on, how its commands are let in, and that nothing secret is ever told.

use std::fs::File;
use std::path::Path;
use std::process::Stdio;
use std::time::Duration;

use scpsfm::rpc::proto::job_service_client::JobServiceClient;
use scpsfm::rpc::proto::{self, JobState};
use sha2::{Digest, Sha256};
use tempfile::TempDir;
use tonic::Code;
use tonic::transport::{Certificate, ClientTlsConfig, Endpoint};

use crate::support::certificates::{Authority, written};
use crate::support::keys::{NORTH, SOUTH, keyed};
use crate::support::program::{Run, Serving, program, run};
use crate::support::scrape::Page;
use crate::support::server::soon;
use crate::support::wire::create_tracks;

/// A key that no server knows.
const UNKNOWN: &str = "unknown0123456789abcdef0123456789abcdef";

#[test]
fn an_open_address_is_refused_and_the_error_says_what_to_do() {
    let directory = TempDir::new().expect("a temporary directory");
    let keys = written(directory.path(), "keys.txt", &format!("north:{NORTH}\n"));
    let keys = keys.to_str().expect("a path of ours");
    let cases: [(&[&str], &[&str]); 3] = [
        (&["--listen", "0.0.0.0:0"], &["--tls-certificate", "--keys-file", "127.0.0.1", "--insecure"]),
        (&["--listen", "[::]:0", "--plaintext-keys"], &["--tls-certificate", "--insecure"]),
        (&["--listen", "0.0.0.0:0", "--keys-file", keys, "--insecure"], &["--tls-certificate", "--plaintext-keys"]),
    ];
    for (flags, parts) in cases {
        let run = run(["serve", "--metrics-listen", "127.0.0.1:0"].iter().chain(flags));
        assert_eq!(run.code, Some(64), "{run:?}");
        for part in parts {
            assert!(run.stderr.contains(part), "{part} is not in {}", run.stderr);
        }
        assert_eq!(run.stdout, "");
    }
}

/// Asks a server as that tenant until it answers so.
async fn until_answered(server: &Serving, key: &'static str, parent: &str, expected: Code) {
    let channel = Endpoint::from_shared(server.grpc.clone()).expect("a URL").connect().await.expect("a connection");
    let mut jobs = JobServiceClient::new(keyed(&channel, key));
    let asking = async {
        let list = || proto::ListJobsRequest { parent: parent.into(), ..Default::default() };
        while jobs.list_jobs(list()).await.map_or_else(|status| status.code(), |_| Code::Ok) != expected {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    soon(asking).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_file_without_keys_locks_everyone_out_and_one_that_cannot_be_read_changes_nothing() {
    let directory = TempDir::new().expect("a temporary directory");
    let at = directory.path();
    let write = |content: &str| written(at, "keys.txt", content);
    let keys = write("# none yet\n");
    let (data, flags) = (at.join("data"), ["--keys-file", text(&keys)]);
    let serve = ["serve", "--listen", "127.0.0.1:0", "--metrics-listen", "127.0.0.1:0", "--data-dir", text(&data)];
    let refused = run(serve.into_iter().chain(flags));
    assert!(refused.code == Some(64) && refused.stderr.contains("there is no key in it"), "{refused:?}");

    write(&format!("north:{NORTH}\n"));
    let log = at.join("log");
    let server = Serving::start_more(&data, &flags, &[], File::create(&log).expect("a log"));
    let page = || tokio::task::block_in_place(|| Page::parse(&server.page("/metrics")));
    let until_page = async |series: &str, expected: f64| {
        let asking = async {
            while page().value(series) != expected {
                tokio::time::sleep(Duration::from_millis(20)).await;
            }
        };
        soon(asking).await;
    };
    let (locked_out, failed) = ("scpsfm_locked_out", "scpsfm_reload_failed{files=\"KEYS\"}");
    until_answered(&server, NORTH, "tenants/north", Code::Ok).await;
    assert_eq!((page().value(locked_out), page().value(failed)), (0.0, 0.0));

    for without in ["", "# the last one is gone\n"] {
        write(without);
        until_answered(&server, NORTH, "tenants/north", Code::Unauthenticated).await;
        assert_eq!((page().value(locked_out), page().value(failed)), (1.0, 0.0));
        write(&format!("south:{SOUTH}\nnorth:{NORTH}\n"));
        until_answered(&server, SOUTH, "tenants/south", Code::Ok).await;
        assert_eq!(page().value(locked_out), 0.0);
    }
    let logged = std::fs::read_to_string(&log).expect("a log");
    let errors = logged.lines().filter(|line| line.contains("ERROR") && line.contains("the last API key is gone"));
    assert_eq!(errors.count(), 2, "{logged}");

    std::fs::remove_file(&keys).expect("removed");
    until_page(failed, 1.0).await;
    until_answered(&server, NORTH, "tenants/north", Code::Ok).await;
    assert_eq!(page().value(locked_out), 0.0);
    let logged = std::fs::read_to_string(&log).expect("a log");
    assert!(logged.lines().any(|line| line.contains("ERROR") && line.contains("cannot be used")), "{logged}");
    write(&format!("north:{NORTH}\n"));
    until_page(failed, 0.0).await;
    until_answered(&server, SOUTH, "tenants/south", Code::Unauthenticated).await;
}

/// Runs a command with these variables.
fn run_with<'a>(arguments: impl IntoIterator<Item = &'a str>, variables: &[(&str, &str)]) -> Run {
    let mut command = program(arguments);
    let output = command.envs(variables.iter().copied()).stdin(Stdio::null()).output().expect("the program runs");
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).expect("UTF-8");
    Run { code: output.status.code(), stdout: text(output.stdout), stderr: text(output.stderr) }
}

fn text(path: &Path) -> &str {
    path.to_str().expect("a path of ours")
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn commands_are_let_in_and_no_secret_is_told() {
    let directory = TempDir::new().expect("a temporary directory");
    let at = directory.path();
    let authority = Authority::new("ours");
    let ours = authority.write(at, "ours.pem");
    let (here, client) = (authority.issue(at, "here", &["127.0.0.1"]), authority.issue(at, "client", &["client"]));
    let keys = written(at, "keys.txt", &format!("north:{NORTH}\n"));
    let log = at.join("log");
    let flags =
        [["--tls-certificate", text(&here.certificate)], ["--tls-key", text(&here.key)], ["--keys-file", text(&keys)]];
    let in_environment = format!("south:{SOUTH}");
    // Everything that any library logs.
    let variables = [("SCPSFM_AUTH__KEYS", in_environment.as_str()), ("SCPSFM_LOG__FILTER", "trace")];
    let server = Serving::start_more(
        &at.join("data"),
        &flags.concat(),
        &variables,
        Stdio::from(File::create(&log).expect("a log")),
    );
    assert!(server.grpc.starts_with("https://127.0.0.1:"), "{}", server.grpc);

    let mut told = Vec::new();
    let mut expect = |run: Run, code: i32, part: &str| {
        assert_eq!(run.code, Some(code), "{run:?}");
        assert!(run.stdout.contains(part) || run.stderr.contains(part), "{part:?} is not in {run:?}");
        told.extend([run.stdout, run.stderr]);
    };
    let to_server = ["--server", &server.grpc, "--tls-ca", text(&ours)];
    let with = |command: &[&'static str]| command.iter().copied().chain(to_server).collect::<Vec<_>>();
    let table = "view,track,x,y\n0,0,1,1\n0,1,5,2\n1,0,2,1\n1,1,6,2\n";
    let input = written(at, "observations.csv", table);
    let mut submit = with(&["submit", "--method", "geometry", "--job-id", "a"]);
    submit.push(text(&input));
    let key_file = written(at, "key", &format!("{NORTH}\n"));
    submit.extend(["--api-key-file", text(&key_file)]);
    expect(run_with(submit, &[]), 0, "tenants/north/jobs/a");
    let north = [("SCPSFM_API_KEY", NORTH), ("SCPSFM_TENANT", "north")];
    expect(run_with(with(&["watch", "a", "--json"]), &north), 3, "SUCCEEDED");
    expect(run_with(with(&["list"]), &north), 0, "tenants/north/jobs/a");
    let south = [("SCPSFM_API_KEY", SOUTH), ("SCPSFM_TENANT", "south")];
    expect(run_with(with(&["get", "a"]), &south), 65, "there is no job tenants/south/jobs/a");
    expect(run_with(with(&["get", "tenants/north/jobs/a"]), &south), 65, "there is no job");
    // The key names the tenant, unless another one is given.
    expect(run_with(with(&["get", "a"]), &[("SCPSFM_API_KEY", NORTH)]), 0, "tenants/north/jobs/a");
    expect(run_with(with(&["get", "tenants/-/jobs/a"]), &[("SCPSFM_API_KEY", NORTH)]), 0, "tenants/north/jobs/a");
    expect(run_with(with(&["get", "a"]), &[("SCPSFM_API_KEY", SOUTH)]), 65, "there is no job tenants/south/jobs/a");
    // Named twice, by the key's tenant and in full, it goes once; what is printed names the tenant.
    let mut again = with(&["submit", "--method", "geometry", "--job-id", "b"]);
    again.push(text(&input));
    expect(run_with(again, &north), 0, "tenants/north/jobs/b");
    let key = [("SCPSFM_API_KEY", NORTH)];
    let mut watch = with(&["watch", "b"]);
    watch.extend(["--tenant", "north", "--api-key-file", text(&key_file)]);
    let (ca, file) = (text(&ours), text(&key_file));
    let there = format!("--server {} --tenant north --api-key-file {file} --tls-ca {ca}", server.grpc);
    expect(run_with(watch, &[]), 3, &format!("next: scpsfm result tenants/north/jobs/b {there} --out DIR"));
    expect(run_with(with(&["watch", "b"]), &key), 3, "next: scpsfm result tenants/north/jobs/b --server");
    let mut other_name = with(&["get", "tenants/south/jobs/a"]);
    other_name.extend(["--tenant", "north"]);
    expect(run_with(other_name, &key), 2, "--tenant north: tenants/south/jobs/a is of the tenant south");
    let deleted = run_with(with(&["delete", "b", "tenants/north/jobs/b", "tenants/-/jobs/b"]), &key);
    assert_eq!(deleted.stdout, "tenants/north/jobs/b\n", "{deleted:?}");
    let none = run_with(with(&["delete", "b"]), &[("SCPSFM_API_KEY", SOUTH)]);
    expect(none, 65, "there is no job tenants/south/jobs/b");
    let mut upload = with(&["upload"]);
    upload.push(text(&input));
    let uploaded = run_with(upload, &key);
    let name = uploaded.stdout.trim();
    let id = name.strip_prefix("tenants/north/inputs/").expect("a name of this tenant");
    let mut delete = with(&["delete"]);
    delete.extend(["--input", id, "--input", name]);
    let deleted = run_with(delete, &key);
    assert_eq!(deleted.stdout, uploaded.stdout, "{deleted:?}");
    let other = [("SCPSFM_API_KEY", SOUTH), ("SCPSFM_TENANT", "north")];
    expect(run_with(with(&["list"]), &other), 65, "no tenant tenants/north, or the caller's key is not of it");
    expect(run_with(with(&["list"]), &[]), 77, "--api-key-file");
    expect(run_with(with(&["list"]), &[("SCPSFM_API_KEY", UNKNOWN)]), 77, "not known");
    expect(run_with(with(&["list"]), &[("SCPSFM_API_KEY", &UNKNOWN[..20])]), 2, "fewer than 32");
    expect(run_with(["list", "--server", &server.grpc], &north), 77, "--tls-ca");
    let far = ["list", "--server", "http://192.0.2.1:1"];
    expect(run_with(far, &north), 2, "https://");
    let mut showing = with(&["list"]);
    showing.extend(["--tls-cert", text(&client.certificate), "--tls-key", text(&client.key)]);
    expect(run_with(showing, &north), 0, "tenants/north/jobs/a");
    let print = ["serve", "--print-config"].into_iter().chain(flags.concat());
    expect(run_with(print, &variables), 0, "keys_file");

    // Another program's client, which does not mark the header as a secret.
    let trusted = Certificate::from_pem(std::fs::read(&ours).expect("read"));
    let endpoint = Endpoint::from_shared(server.grpc.clone()).expect("a URL");
    let endpoint = endpoint.tls_config(ClientTlsConfig::new().ca_certificate(trusted)).expect("TLS");
    let channel = endpoint.connect().await.expect("a connection");
    for (key, accepted) in [(NORTH, true), (SOUTH, false), (UNKNOWN, false)] {
        let request = proto::CreateJobRequest { parent: "tenants/north".into(), ..create_tracks() };
        let created = JobServiceClient::new(keyed(&channel, key)).create_job(request).await;
        assert_eq!(created.is_ok(), accepted, "{created:?}");
        told.push(format!("{created:?}"));
        if let Ok(job) = created {
            assert_ne!(job.into_inner().state(), JobState::Failed);
        }
    }

    told.push(server.page("/metrics"));
    drop(server);
    told.push(std::fs::read_to_string(&log).expect("a log"));
    let told = told.concat();
    assert!(told.contains("TRACE"), "the log is a full one");
    let private = [&here.key, &client.key].map(|key| std::fs::read_to_string(key).expect("a key"));
    let lines = private.iter().flat_map(|key| key.lines().filter(|line| !line.starts_with("-----")));
    let hashes = [NORTH, SOUTH].map(|key| Sha256::digest(key).iter().map(|b| format!("{b:02x}")).collect::<String>());
    let secrets = [NORTH, SOUTH, UNKNOWN].into_iter().chain(lines).chain(hashes.iter().map(String::as_str));
    for secret in secrets {
        let place = told.find(secret).map(|at| &told[at.saturating_sub(300)..(at + 100).min(told.len())]);
        assert_eq!(place, None, "a secret is told");
    }
}
