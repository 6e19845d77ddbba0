//! Sources, checks, and what a configuration shows of itself.

use std::io::Write;

use super::{Config, Endpoint, Error, Server};
use crate::domain::Backend;
use crate::telemetry::tracing::Format;

fn file(text: &str) -> tempfile::NamedTempFile {
    let mut file = tempfile::NamedTempFile::new().expect("temporary file");
    file.write_all(text.as_bytes()).expect("write");
    file
}

fn variables(pairs: &[(&str, &str)]) -> Vec<(String, String)> {
    pairs.iter().map(|(name, value)| ((*name).to_owned(), (*value).to_owned())).collect()
}

#[test]
fn nothing_given_is_the_default_and_the_example_file_says_the_same() {
    assert_eq!(Config::from_sources(None, vec![], &[]).expect("defaults"), Config::default());
    let example = file(include_str!("../../deploy/scpsfm.toml"));
    let read = Config::from_sources(Some(example.path()), vec![], &[]).expect("example");
    assert_eq!(read, Config::default());
    // Every key that the configuration has stands in the example.
    let keys = |text: &str| -> Vec<String> {
        let keys = text.lines().filter(|line| !line.starts_with('#')).filter_map(|line| line.split_once(" = "));
        let mut keys: Vec<String> = keys.map(|(key, _)| key.to_owned()).collect();
        keys.sort();
        keys
    };
    assert_eq!(keys(include_str!("../../deploy/scpsfm.toml")), keys(&Config::default().to_toml().expect("TOML")));
}

#[test]
fn refusals_name_keys_that_there_are() {
    use crate::domain::Quota;
    let all: toml::Table = toml::from_str(&Config::default().to_toml().expect("TOML")).expect("a table");
    for quota in Quota::OF_QUEUE.into_iter().chain(Quota::OF_UPLOADS).chain([Quota::SolverBytes]) {
        let (section, key) = quota.key().split_once('.').expect("a section");
        assert!(all[section].get(key).is_some(), "{} is no key", quota.key());
    }
}

#[test]
fn later_sources_win_key_by_key() {
    let file = file("[engine]\nworkers = 1\nqueue_capacity = 2\nmax_attempts = 4\n[log]\nformat = \"json\"\n");
    let environment = variables(&[
        ("SCPSFM_ENGINE__WORKERS", "5"),
        ("SCPSFM_ENGINE__QUEUE_CAPACITY", "6"),
        ("SCPSFM_COMPUTE__BACKEND", "ndarray"),
        ("SCPSFM_OTLP__ENDPOINT", ""),
        ("SCPSFM_REQUIRE_PYTHON", "1"),
        ("PATH", "/bin"),
    ]);
    let flags = [("engine.workers", "7".to_owned()), ("server.listen", "[::1]:0".to_owned())];
    let config = Config::from_sources(Some(file.path()), environment, &flags).expect("configuration");
    assert_eq!(config.engine.max_attempts, 4, "file over default");
    assert_eq!(config.engine.queue_capacity, 6, "environment over file");
    assert_eq!(config.engine.workers, 7, "flag over environment");
    assert_eq!(config.log.format, Format::Json);
    assert_eq!(config.compute.backend, Backend::Ndarray);
    assert_eq!(config.otlp.endpoint, None, "an empty variable is none");
    assert_eq!(config.server.listen, "[::1]:0".parse().expect("address"));
    assert_eq!(config.engine.lease_seconds, Config::default().engine.lease_seconds);
}

#[test]
fn a_printed_configuration_reads_back() {
    let flags = [("otlp.endpoint", "http://collector:4317".to_owned()), ("engine.workers", "3".to_owned())];
    let environment = variables(&[("SCPSFM_OTLP__METRICS", "true"), ("SCPSFM_OTLP__METRICS_INTERVAL_SECONDS", "15")]);
    let config = Config::from_sources(None, environment, &flags).expect("configuration");
    assert_eq!(config.otlp.metrics_interval(), Some(std::time::Duration::from_secs(15)));
    let printed = file(&config.to_toml().expect("TOML"));
    assert_eq!(Config::from_sources(Some(printed.path()), vec![], &[]).expect("configuration"), config);
}

#[test]
fn the_password_of_the_store_is_shown_nowhere() {
    let given = "postgres://me:hunter2@db/scpsfm";
    let config = Config::from_sources(None, variables(&[("SCPSFM_STORE__URL", given)]), &[]).expect("valid");
    assert_eq!(config.store.url.as_ref().map(|url| url.reveal()), Some(given));
    for shown in [format!("{config:?}"), config.to_toml().expect("TOML")] {
        assert!(shown.contains("me:***@db") && !shown.contains("hunter2"), "{shown}");
    }
    // Printed and read back: with the address from elsewhere it is the same, without it is refused in plain words.
    let printed = config.to_toml().expect("TOML");
    assert!(printed.starts_with("# The password in store.url is not shown"), "{printed}");
    let printed = file(&printed);
    let again = Config::from_sources(Some(printed.path()), variables(&[("SCPSFM_STORE__URL", given)]), &[]);
    assert_eq!(again.expect("complete"), config);
    let error = Config::from_sources(Some(printed.path()), vec![], &[]).expect_err("no password").to_string();
    assert!(error.contains("store.url") && error.contains("***") && error.contains("SCPSFM_STORE__URL"), "{error}");
    let bare = Config::from_sources(None, variables(&[("SCPSFM_STORE__URL", "postgres://me@db/scpsfm")]), &[]);
    let printed = file(&bare.expect("valid").to_toml().expect("TOML"));
    assert!(Config::from_sources(Some(printed.path()), vec![], &[]).is_ok(), "nothing is hidden");
}

#[test]
fn the_password_of_the_collector_is_shown_nowhere() {
    let load = |given: &str| Config::from_sources(None, variables(&[("SCPSFM_OTLP__ENDPOINT", given)]), &[]);
    let given = "http://me:hunter2@collector:4317/v1";
    let config = load(given).expect("valid");
    assert_eq!(config.otlp.endpoint.as_ref().map(Endpoint::reveal), Some(given));
    let printed = config.to_toml().expect("TOML");
    for shown in [&format!("{config:?}"), &printed] {
        assert!(shown.contains("http://me:***@collector:4317/v1") && !shown.contains("hunter2"), "{shown}");
    }
    assert!(printed.starts_with("# The password in otlp.endpoint is not shown"), "{printed}");
    let printed = file(&printed);
    let again = Config::from_sources(Some(printed.path()), variables(&[("SCPSFM_OTLP__ENDPOINT", given)]), &[]);
    assert_eq!(again.expect("complete"), config);
    let error = Config::from_sources(Some(printed.path()), vec![], &[]).expect_err("no password").to_string();
    assert!(error.contains("otlp.endpoint") && error.contains("SCPSFM_OTLP__ENDPOINT"), "{error}");
    for wrong in ["ftp://me:hunter2@collector", "me:hunter2@collector:4317", "http://me:hunter2 @collector"] {
        let error = load(wrong).expect_err(wrong).to_string();
        assert!(error.contains("otlp.endpoint") && !error.contains("hunter2"), "{error}");
    }
    let bare = load("http://me@collector:4317").expect("valid").to_toml().expect("TOML");
    assert!(bare.contains("http://me@collector:4317") && !bare.contains("not shown"), "{bare}");
}

#[test]
fn keys_are_kept_as_hashes_and_shown_nowhere() {
    let key = "0123456789abcdef0123456789abcdef";
    let given = format!("north:{key}");
    let variables = variables(&[("SCPSFM_AUTH__KEYS", &given), ("SCPSFM_SERVER__PLAINTEXT_KEYS", "true")]);
    let config = Config::from_sources(None, variables, &[]).expect("valid");
    assert!(config.auth.is_on());
    let ring = config.auth.keys.as_ref().expect("keys");
    assert_eq!(ring.tenant_of(key), Some("north"));
    for shown in [format!("{config:?}"), config.to_toml().expect("TOML")] {
        assert!(!shown.contains(key), "{shown}");
    }
    let printed = config.to_toml().expect("TOML");
    assert!(printed.contains("# auth.keys are set and not shown"), "{printed}");
}

#[test]
fn secrets_of_webhooks_are_shown_nowhere_and_those_of_the_file_are_added() {
    let secret = "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw";
    let given = variables(&[("SCPSFM_WEBHOOKS__SECRET", secret), ("SCPSFM_WEBHOOKS__RETRY_FOR", "90m")]);
    let mut config = Config::from_sources(None, given, &[]).expect("valid");
    for shown in [format!("{config:?}"), config.to_toml().expect("TOML")] {
        assert!(!shown.contains("MfKQ"), "{shown}");
    }
    assert!(config.to_toml().expect("TOML").contains("# webhooks.secret is set and not shown"));
    let options = |config: &Config| config.webhooks.options(|_| Ok(Vec::new()));
    assert!(options(&Config::default()).expect("off").is_none());
    let own = file(&format!("# one tenant's\nnorth:{secret}\n{secret}\n"));
    config.webhooks.secret_file = Some(own.path().to_owned());
    let both = options(&config).expect("readable").expect("on");
    assert_eq!((both.secrets.of("north").len(), both.secrets.of("south").len()), (1, 2));
    assert_eq!(both.retry_for, Some(std::time::Duration::from_secs(90 * 60)));
    config.webhooks.secret_file = Some(file("north:hunter2").path().to_owned());
    let error = options(&config).expect_err("the file is gone").to_string();
    assert!(error.contains("webhooks.secret_file"), "{error}");
    let wrong = file("north:hunter2");
    config.webhooks.secret_file = Some(wrong.path().to_owned());
    let error = options(&config).expect_err("no secret").to_string();
    assert!(
        error.contains("webhooks.secret_file") && error.contains("entry 1") && !error.contains("hunter2"),
        "{error}"
    );
}

#[test]
fn errors_name_the_key_and_what_would_be_right() {
    let from_file = |text: &str| Config::from_sources(Some(file(text).path()), vec![], &[]);
    let from_variable = |name: &str, value: &str| Config::from_sources(None, variables(&[(name, value)]), &[]);
    let cases: Vec<(Result<Config, Error>, &[&str])> = vec![
        (from_file("[engine]\nwrokers = 1\n"), &["wrokers", "workers"]),
        (from_file("[engine]\nqueue_capacity = 0\n"), &["engine.queue_capacity", "from 1 on"]),
        (from_file("[server]\nlisten = \"localhost\"\n"), &["server.listen", "127.0.0.1:50051"]),
        (from_file("[compute]\nbackend = \"cuda\"\n"), &["compute.backend", "flex", "ndarray"]),
        (from_file("[log]\nfilter = \"scpsfm=loud\"\n"), &["log.filter", "`info`"]),
        (from_variable("SCPSFM_STORE__URL", "mysql://me:hunter2@host/db"), &["store.url", "postgres://USER"]),
        (from_variable("SCPSFM_ENGINE__WORKERS", "many"), &["engine.workers", "many", "environment"]),
        (
            from_variable("SCPSFM_ENGINE__TENANT_WEIGHTS", "acme=0"),
            &["engine.tenant_weights", "TENANT=WEIGHT", "acme=0"],
        ),
        (from_variable("SCPSFM_ENGINE_WORKERS", "4"), &["SCPSFM_ENGINE_WORKERS", "SCPSFM_ENGINE__WORKERS"]),
        (from_variable("SCPSFM_OTLP__ENDPOINT", "x:4317"), &["otlp.endpoint", "http://127.0.0.1:4317"]),
        (from_variable("SCPSFM_OTLP__METRICS", "true"), &["otlp.metrics", "otlp.endpoint", "http://127.0.0.1:4317"]),
        (from_file("[otlp]\nmetrics_interval_seconds = 0\n"), &["otlp.metrics_interval_seconds", "from 1 on"]),
        (from_file("[rates]\ncalls_burst = 1\n"), &["rates.calls_burst", "from 2 on", "upload"]),
        (from_file("[rates]\njobs_burst = 999\n"), &["rates.jobs_burst", "from 1000 on"]),
        (from_variable("SCPSFM_RATES_CALLS_PER_SECOND", "4"), &["SCPSFM_RATES__CALLS_PER_SECOND"]),
        (from_variable("SCPSFM_AUTH__KEYS", "north:hunter2"), &["auth.keys", "entry 1", "32"]),
        (from_variable("SCPSFM_AUTH_KEYS", "north:hunter2"), &["SCPSFM_AUTH_KEYS", "SCPSFM_AUTH__KEYS"]),
        (from_variable("SCPSFM_WEBHOOKS__SECRET", "whsec_hunter2"), &["webhooks.secret", "entry 1", "whsec_"]),
        (from_variable("SCPSFM_WEBHOOKS_SECRET", "hunter2"), &["SCPSFM_WEBHOOKS_SECRET", "SCPSFM_WEBHOOKS__SECRET"]),
        (from_file("[http]\nallowed_origins = \"*\"\n"), &["http.allowed_origins", "`*`", "https://app.example"]),
        (from_variable("SCPSFM_HTTP__ALLOWED_ORIGINS", "https://a.example, https://b.example/x"), &["b.example/x"]),
        (from_variable("SCPSFM_HTTP__ALLOWED_ORIGINS", "https://a.example:443"), &["a.example:443", "port 443"]),
        (from_file("[tls]\ncertificate = \"c\"\n"), &["tls.certificate", "tls.key"]),
        (from_file("[tls]\nclient_ca = \"c\"\n"), &["tls.client_ca", "tls.certificate"]),
        (from_file("[server]\nlisten = \"0.0.0.0:1\"\n"), &["server.listen", "--tls-certificate", "--insecure"]),
        (
            from_file("[server]\nlisten = \"[::]:1\"\ninsecure = true\n[auth]\nkeys_file = \"k\"\n"),
            &["server.listen", "--tls-certificate", "--plaintext-keys"],
        ),
        (from_file("[auth]\nkeys = [\"north:hunter2\"]\n"), &["auth.keys"]),
        (Config::from_sources(Some("no/such/file".as_ref()), vec![], &[]), &["no/such/file"]),
    ];
    for (result, parts) in cases {
        let message = result.expect_err(parts[0]).to_string();
        for part in parts {
            assert!(message.contains(part), "`{message}` does not say `{part}`");
        }
        assert!(!message.contains("hunter2"), "{message}");
    }
}

#[test]
fn errors_show_a_files_path_as_it_was_given() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    // Nobody who rewrites a path keeps this form of it.
    let path = directory.path().join("./scpsfm.toml");
    let shown = path.display().to_string();
    let errors =
        [("[store]\nurl = \"", "line 2"), ("[engine]\nworkers = \"many\"\n", "engine.workers"), ("", "cannot read")];
    for (text, part) in errors {
        match text {
            "" => std::fs::remove_file(&path).expect("removed"),
            text => std::fs::write(&path, text).expect("written"),
        }
        let error = Config::from_sources(Some(&path), vec![], &[]).expect_err(part).to_string();
        assert!(error.contains(part) && error.contains(&shown), "{shown} is not in {error}");
    }
}

#[test]
fn bounds_are_refused_by_key_and_what_is_within_them_is_taken() {
    let given = |name: &str, value: &str| Config::from_sources(None, variables(&[(name, value)]), &[]);
    for (name, key) in
        [("SCPSFM_STORE__RETENTION", "store.retention"), ("SCPSFM_UPLOAD__ABANDONED_AFTER", "upload.abandoned_after")]
    {
        let error = given(name, "3000000d").expect_err(key).to_string();
        assert!(error.contains(key) && error.contains("365250d") && error.contains("`forever`"), "{error}");
        assert!(given(name, "365250d").is_ok() && given(name, "forever").is_ok(), "{key}");
    }
    assert!(given("SCPSFM_RATES__CALLS_BURST", "2").is_ok());
    let least = Server::LEAST_MESSAGE_BYTES;
    for small in ["0", "1", &(least - 1).to_string()] {
        let error = given("SCPSFM_SERVER__MAX_MESSAGE_BYTES", small).expect_err(small).to_string();
        assert!(error.contains("server.max_message_bytes") && error.contains(&least.to_string()), "{error}");
    }
    assert!(given("SCPSFM_SERVER__MAX_MESSAGE_BYTES", &least.to_string()).is_ok());
    let error = given("SCPSFM_SERVER__MAX_INFLIGHT_BYTES", "67108863").expect_err("less than a message").to_string();
    assert!(error.contains("server.max_inflight_bytes") && error.contains("server.max_message_bytes"), "{error}");
    assert!(given("SCPSFM_SERVER__MAX_INFLIGHT_BYTES", "67108864").is_ok());
}

#[test]
fn a_file_that_is_no_toml_is_told_without_the_line_and_its_password() {
    let file = file("[store]\nurl = \"postgres://me:hunter2@host/db\n");
    let error = Config::from_sources(Some(file.path()), vec![], &[]).expect_err("no end of the string");
    let (shown, debug) = (error.to_string(), format!("{error:?}"));
    assert!(!shown.contains("hunter2") && !debug.contains("hunter2"), "{shown} {debug}");
    assert!(shown.contains("line 2") && shown.contains(&file.path().display().to_string()), "{shown}");
}
