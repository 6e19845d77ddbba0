//! The dashboard, the alerts and the chart's autoscaling ask for metrics that the server has.

use std::collections::BTreeSet;
use std::path::PathBuf;

use crate::support::live::is_served;
use crate::support::program::Serving;

fn deployed(path: &str) -> String {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("deploy").join(path);
    std::fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// Every name of ours within a text.
fn named(text: &str) -> BTreeSet<String> {
    let part_of_name = |character: char| character.is_ascii_alphanumeric() || character == '_';
    let words = text.split(|character| !part_of_name(character));
    words.filter(|word| word.starts_with("scpsfm_")).map(str::to_owned).collect()
}

/// Every expression of the dashboard, wherever it stands in it.
fn expressions(value: &serde_json::Value, found: &mut Vec<String>) {
    match value {
        serde_json::Value::Object(fields) => {
            found.extend(fields.get("expr").and_then(|expression| expression.as_str()).map(str::to_owned));
            fields.values().for_each(|value| expressions(value, found));
        }
        serde_json::Value::Array(values) => values.iter().for_each(|value| expressions(value, found)),
        _ => {}
    }
}

/// Names of the series that a server exports: those of a histogram are three.
fn exported(page: &str) -> BTreeSet<String> {
    let kinds = page.lines().filter_map(|line| line.strip_prefix("# TYPE ")?.split_once(' '));
    let series = kinds.flat_map(|(name, kind)| match kind {
        "histogram" => ["_bucket", "_sum", "_count"].map(|end| format!("{name}{end}")).to_vec(),
        _ => vec![name.to_owned()],
    });
    series.collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_metric_that_is_asked_for_is_exported() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let server = Serving::start(&directory.path().join("data"));
    // The series of calls begin with the first one.
    is_served(&server.grpc).await;
    let dashboard = deployed("grafana/dashboards/scpsfm.json");
    let mut asked = Vec::new();
    expressions(&serde_json::from_str(&dashboard).expect("JSON"), &mut asked);
    let in_dashboard = named(&asked.join(" "));
    let in_rules = named(&deployed("prometheus-rules.yml"));
    assert!(in_dashboard.len() > 10 && in_rules.len() > 5, "{in_dashboard:?} {in_rules:?}");
    let in_chart = named(&deployed("helm/scpsfm/templates/_helpers.tpl"));
    assert_eq!(in_chart.len(), 2, "{in_chart:?}");
    let page = server.page("/metrics");
    let exported = exported(&page);
    let asked = [in_dashboard, in_rules, in_chart].into_iter().flatten();
    let missing: Vec<_> = asked.filter(|name| !exported.contains(name)).collect();
    assert!(missing.is_empty(), "{missing:?} are not in\n{page}");
}
