//! Rates, from outside: what is beyond them is refused with the time after which it would pass.

use std::num::NonZeroU32;
use std::process::Stdio;
use std::time::Duration;

use futures_util::future::join_all;
use scpsfm::rpc::keys::Sources;
use scpsfm::rpc::proto::GetCapabilitiesRequest;
use scpsfm::rpc::proto::calibration_service_client::CalibrationServiceClient;
use scpsfm::rpc::rates::{self, Rate};
use scpsfm::rpc::server::Options;
use serde_json::json;
use tonic::Code;
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_client::HealthClient;
use tonic_types::StatusExt;

use crate::support::http::request;
use crate::support::keys::{Keyed, NORTH, SOUTH, keyed};
use crate::support::program::{Serving, run};
use crate::support::scrape::Page;
use crate::support::server::{TestServer, one_worker};
use crate::support::solvers::quick;

/// Calls at once, of which a rate of one a second lets all through only in a minute and a half.
const CALLS: usize = 100;

async fn ask(client: &CalibrationServiceClient<Keyed>) -> Result<(), tonic::Status> {
    client.clone().get_capabilities(GetCapabilitiesRequest {}).await.map(drop)
}

#[tokio::test]
async fn a_key_that_calls_too_often_is_told_when_to_come_back_and_no_other_is() {
    let number = |number| NonZeroU32::new(number).expect("from 1 on");
    let rate = Rate { per_second: number(1), burst: number(3) };
    let fixed = format!("north:{NORTH}, south:{SOUTH}").parse().expect("two keys");
    let options = Options {
        keys: Sources { file: None, fixed: Some(fixed) },
        rates: rates::Options { calls: Some(rate), jobs: None },
        ..Options::default()
    };
    let server = TestServer::start_with(quick(), options, one_worker()).await;
    let channel = server.channel().await;
    let north = CalibrationServiceClient::new(keyed(&channel, NORTH));
    let answers = join_all((0..CALLS).map(|_| ask(&north))).await;
    assert!(answers.iter().filter(|answer| answer.is_ok()).count() >= 3, "the burst");
    let mut longest = Duration::ZERO;
    for refused in answers.iter().filter_map(|answer| answer.as_ref().err()) {
        let info = refused.get_details_error_info().expect("an ErrorInfo");
        assert_eq!((refused.code(), info.reason.as_str()), (Code::ResourceExhausted, "RATE_LIMITED"));
        assert_eq!(info.metadata["bound"], "calls");
        assert_eq!(info.metadata["key"], "rates.calls_per_second");
        let wait = refused.get_details_retry_info().and_then(|retry| retry.retry_delay).expect("a RetryInfo");
        assert!(wait > Duration::ZERO && wait <= Duration::from_secs(1), "{wait:?}");
        longest = longest.max(wait);
    }
    assert!(longest > Duration::ZERO, "none was refused");
    ask(&CalibrationServiceClient::new(keyed(&channel, SOUTH))).await.expect("another key has a rate of its own");
    for _ in 0..CALLS {
        let check = HealthCheckRequest { service: String::new() };
        HealthClient::new(channel.clone()).check(check).await.expect("health checks have no rate");
    }
    tokio::time::sleep(Duration::from_secs(1)).await;
    ask(&north).await.expect("a second has one call");
}

#[test]
fn a_tenant_that_creates_too_many_jobs_is_refused_over_http_alike() {
    let data = tempfile::tempdir().expect("a temporary directory");
    let server = Serving::start_with(data.path(), &[("SCPSFM_RATES__JOBS_PER_SECOND", "1")], Stdio::null());
    // None of them is a job; they count all the same, and the second thousand is due in a thousand seconds.
    let batch = json!({"requests": vec![json!({}); 1_000]}).to_string();
    let create = || {
        let headers = [("content-type", "application/json")];
        request(&server, "POST", "/v1/tenants/-/jobs:batchCreate", &headers, batch.as_bytes())
    };
    let first = create();
    assert_eq!((first.code, first.refusal().0.as_str()), (400, "INVALID_ARGUMENT"));
    let second = create();
    assert_eq!((second.code, second.refusal().0.as_str()), (429, "RATE_LIMITED"));
    assert!(second.has("retry-after: "), "{}", second.head);
    let page = Page::parse(&server.page("/metrics"));
    assert_eq!(page.value("scpsfm_admission_refusals_total{reason=\"RATE_LIMITED\",bound=\"jobs\"}"), 1.0);
}

/// Jobs of one call, for which a rate of one a second makes a client wait longer than it does.
const TOO_MANY: usize = 60;

#[test]
fn the_program_waits_as_a_rate_tells_it_and_no_longer_than_it_says() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let rates = [
        ("SCPSFM_RATES__CALLS_PER_SECOND", "1"),
        ("SCPSFM_RATES__CALLS_BURST", "2"),
        ("SCPSFM_RATES__JOBS_PER_SECOND", "1"),
    ];
    let server = Serving::start_with(&directory.path().join("data"), &rates, Stdio::null());
    let scene = directory.path().join("scene");
    let path = |path: &std::path::Path| path.to_str().expect("UTF-8").to_owned();
    let made = run(["synth", "--views", "4", "--tracks", "30", "--outliers", "0.2", "--out", path(&scene).as_str()]);
    assert_eq!(made.code, Some(0), "{made:?}");
    let input = path(&scene.join("observations.csv"));
    let on = ["--server", server.grpc.as_str()];
    let submit = |count: usize| {
        let inputs = vec![input.as_str(); count];
        run(["submit", "--method", "geometry"].iter().copied().chain(inputs).chain(on))
    };
    // One call for all of them, then one for each page: more than the burst, at once.
    let submitted = submit(4);
    assert_eq!((submitted.code, submitted.stdout.lines().count()), (Some(0), 4), "{submitted:?}");
    let listed = run(["list", "--all", "--page-size", "1"].iter().copied().chain(on));
    assert_eq!((listed.code, listed.stdout.lines().count()), (Some(0), 4), "{listed:?}");
    let name = submitted.stdout.lines().next().expect("a name");
    for command in [vec!["watch", name], vec!["get", name], vec!["priority", name, "1"]] {
        let run = run(command.iter().copied().chain(on));
        assert_ne!(run.code, Some(69), "{command:?}: {run:?}");
    }

    // All jobs that come at once after a pause: none of them is one, and they count all the same.
    let batch = json!({"requests": vec![json!({}); 1_000]}).to_string();
    loop {
        let headers = [("content-type", "application/json")];
        let answer = request(&server, "POST", "/v1/tenants/-/jobs:batchCreate", &headers, batch.as_bytes());
        if answer.code == 400 {
            break;
        }
        assert_eq!((answer.code, answer.refusal().0.as_str()), (429, "RATE_LIMITED"));
        std::thread::sleep(Duration::from_millis(200));
    }
    let refused = submit(TOO_MANY);
    assert_eq!(refused.code, Some(69), "{refused:?}");
    assert!(refused.stderr.contains("rates.jobs_per_second"), "{refused:?}");
    assert_eq!(refused.stderr.matches("come back in").count(), 1, "told once: {refused:?}");
    assert!(!refused.stderr.contains("try again") && !refused.stderr.contains("waiting"), "{refused:?}");
}
