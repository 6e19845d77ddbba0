//! The Helm chart knows the server's configuration, and what it renders is taken by the server.

use std::collections::BTreeSet;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::Command;

use scpsfm::config::Config;
use serde_json::Value;

use crate::support::program::program;

const SCHEMA: &str = include_str!("../../deploy/helm/scpsfm/values.schema.json");
const EXAMPLE: &str = include_str!("../../deploy/scpsfm.toml");

/// What the chart sets itself, from values of its own or from secrets, by section; empty: the whole section.
const OWN: [(&str, &[&str]); 7] = [
    ("server", &["listen", "insecure", "plaintext_keys"]),
    ("tls", &[]),
    ("http", &["listen"]),
    ("auth", &[]),
    ("metrics", &[]),
    ("store", &["data_dir", "url"]),
    ("webhooks", &["secret_file"]),
];

fn chart() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("deploy/helm/scpsfm")
}

/// Every key of the example configuration, those that are commented out too, as `section.key`.
fn keys_of_the_example() -> BTreeSet<String> {
    let mut keys = BTreeSet::new();
    let mut section = "";
    for line in EXAMPLE.lines() {
        if let Some(name) = line.strip_prefix('[').and_then(|rest| rest.strip_suffix(']')) {
            section = name;
        } else if let Some((key, _)) = line.trim_start_matches("# ").split_once(" = ")
            && key.chars().all(|sign| sign.is_ascii_lowercase() || sign == '_')
        {
            keys.insert(format!("{section}.{key}"));
        }
    }
    keys
}

fn is_the_charts_own(key: &str) -> bool {
    let (section, key) = key.split_once('.').expect("a section");
    OWN.iter().any(|(name, keys)| *name == section && (keys.is_empty() || keys.contains(&key)))
}

/// Sections of `config` in the chart's values, with the schema of each key.
fn sections() -> Vec<(String, Vec<(String, Value)>)> {
    let schema: Value = serde_json::from_str(SCHEMA).expect("JSON");
    let properties = |value: &Value| value["properties"].as_object().expect("properties").clone();
    let sections = properties(&schema["properties"]["config"]);
    sections.into_iter().map(|(name, keys)| (name, properties(&keys).into_iter().collect())).collect()
}

/// A value that the schema of a key allows, as TOML.
fn sample(section: &str, key: &str, schema: &Value) -> String {
    let text = match (section, key) {
        ("store", "retention") | ("upload", "abandoned_after") | ("webhooks", "retry_for") => "12h",
        ("otlp", "endpoint") => "http://collector.monitoring:4317",
        ("http", "hosts") => "solver.example",
        ("http", "allowed_origins") => "https://app.example",
        ("engine", "tenant_weights") => "acme=3, globex=2",
        ("compute", "prior") => "/models/my.prior",
        ("log", "filter") => "info,scpsfm::engine=debug",
        _ => match (schema["enum"][0].as_str(), schema["type"].as_str()) {
            (Some(word), _) => word,
            (None, Some("boolean")) => return "true".into(),
            (None, Some("integer")) => return schema["minimum"].as_u64().unwrap_or(0).max(7).to_string(),
            _ => panic!("{section}.{key}: {schema}"),
        },
    };
    format!("\"{text}\"")
}

#[test]
fn values_have_every_key_of_the_configuration_and_no_other() {
    let mut told = BTreeSet::new();
    let mut file = tempfile::NamedTempFile::new().expect("a temporary file");
    for (section, keys) in sections() {
        writeln!(file, "[{section}]").expect("written");
        for (key, schema) in keys {
            writeln!(file, "{key} = {}", sample(&section, &key, &schema)).expect("written");
            told.insert(format!("{section}.{key}"));
        }
    }
    Config::load(Some(file.path()), &[]).expect("every key is known, and such a value right");
    let known: BTreeSet<String> = keys_of_the_example().into_iter().filter(|key| !is_the_charts_own(key)).collect();
    assert!(known.len() > 20, "{known:?}");
    assert_eq!(told, known);
}

#[test]
fn the_chart_names_this_version_and_keeps_the_services_variables_out() {
    let read = |path: &str| std::fs::read_to_string(chart().join(path)).expect(path);
    let version = env!("CARGO_PKG_VERSION");
    assert!(read("Chart.yaml").contains(&format!("\nappVersion: \"{version}\"\n")));
    assert!(read("../../README.md").contains(&format!("/scpsfm:{version} .")));
    assert!(read("../../../clients/python/pyproject.toml").contains(&format!("\nversion = \"{version}\"\n")));
    // Kubernetes would set SCPSFM_METRICS_SERVICE_HOST for a service scpsfm-metrics.
    assert!(read("templates/deployment.yaml").contains("\n      enableServiceLinks: false\n"));
    let refused = program(["serve", "--print-config"]).env("SCPSFM_METRICS_SERVICE_HOST", "10.0.0.1").output();
    assert_eq!(refused.expect("the program runs").status.code(), Some(64));
}

/// Helm, where it is there. Without it the test is skipped, loudly, unless `SCPSFM_REQUIRE_HELM` forbids it.
fn helm() -> Option<String> {
    let helm = std::env::var("SCPSFM_HELM").unwrap_or_else(|_| "helm".into());
    if Command::new(&helm).arg("version").output().is_ok_and(|output| output.status.success()) {
        return Some(helm);
    }
    let missing = format!("{helm} is missing (SCPSFM_HELM names a program)");
    assert!(std::env::var_os("SCPSFM_REQUIRE_HELM").is_none(), "{missing}");
    // Past the capture of a passing test's output.
    writeln!(std::io::stderr(), "SKIPPED the chart's configuration: {missing}").expect("stderr");
    None
}

fn rendered(helm: &str, values: Option<&Path>, flags: &[&str]) -> Result<String, String> {
    let mut command = Command::new(helm);
    command.args(["template", "scpsfm"]).arg(chart()).args(flags);
    if let Some(values) = values {
        command.arg("--values").arg(values);
    }
    let output = command.output().expect("helm runs");
    let text = |bytes| String::from_utf8(bytes).expect("UTF-8");
    if output.status.success() { Ok(text(output.stdout)) } else { Err(text(output.stderr)) }
}

/// The configuration file within the rendered ConfigMap.
fn configuration(manifests: &str) -> String {
    let (_, rest) = manifests.split_once("  scpsfm.toml: |\n").expect("the file");
    let lines = rest.lines().take_while(|line| line.is_empty() || line.starts_with("    "));
    lines.map(|line| format!("{}\n", line.trim_start())).collect()
}

#[test]
fn what_the_chart_renders_is_taken_by_the_server() {
    let Some(helm) = helm() else { return };
    let examples = std::fs::read_dir(chart().join("../examples")).expect("examples");
    let examples: Vec<PathBuf> = examples.map(|entry| entry.expect("a file").path()).collect();
    assert!(!examples.is_empty());
    for values in std::iter::once(None).chain(examples.iter().map(|path| Some(path.as_path()))) {
        let manifests = rendered(&helm, values, &[]).expect("rendered");
        let mut file = tempfile::NamedTempFile::new().expect("a temporary file");
        file.write_all(configuration(&manifests).as_bytes()).expect("written");
        let mut serve = program(["serve", "--print-config", "--config"]);
        // As in the pod, where these undo what the image sets.
        for name in ["SCPSFM_SERVER__LISTEN", "SCPSFM_METRICS__LISTEN", "SCPSFM_STORE__DATA_DIR", "SCPSFM_LOG__FORMAT"]
        {
            assert!(manifests.contains(&format!("{{ name: {name}, value: \"\" }}")), "{name}");
            serve.env(name, "");
        }
        let output = serve.arg(file.path()).env("SCPSFM_STORE__URL", "postgres://db/scpsfm").output();
        let output = output.expect("the program runs");
        assert!(output.status.success(), "{values:?}: {}", String::from_utf8_lossy(&output.stderr));
        let printed = String::from_utf8(output.stdout).expect("UTF-8");
        for line in ["listen = \"0.0.0.0:50051\"", "listen = \"0.0.0.0:9464\"", "workers = 2", "format = \"json\""] {
            assert!(printed.lines().any(|printed| printed == line), "{values:?}: no `{line}` in\n{printed}");
        }
    }
}

#[test]
fn slips_of_values_are_refused_by_name() {
    let Some(helm) = helm() else { return };
    let cases: [(&[&str], &str); 8] = [
        (&["--set", "config.engine.wrokers=3"], "wrokers"),
        (&["--set", "replicas=3"], "replicas"),
        (&["--set", "config.store.retention=30"], "retention"),
        (&["--set", "config.otlp.metrics=true"], "endpoint"),
        (&["--set", "tls.secret="], "tls.unencrypted=keys-in-the-clear"),
        (&["--set", "tls.secret=", "--set", "auth.keysSecret="], "tls.unencrypted=anyone"),
        (&["--set", "tls.unencrypted=anyone"], "tls.secret and tls.unencrypted"),
        (&["--set", "autoscaling.kind=keda", "--set", "config.engine.workers=0"], "autoscaling.jobsPerReplica"),
    ];
    for (flags, said) in cases {
        let error = rendered(&helm, None, flags).expect_err("refused");
        assert!(error.contains(said), "{flags:?}: {error}");
    }
    // The endpoint of a secret, which wins over the file.
    let of_environment = ["config.otlp.metrics=true", "extraEnv[0].name=SCPSFM_OTLP__ENDPOINT"];
    rendered(&helm, None, &of_environment.map(|value| ["--set", value]).concat()).expect("an endpoint is given");
}
