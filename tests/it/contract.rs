//! What programs outside rely on: the API as it was released, and the names in the files of a result, in what commands
//! print with `--json`, and over HTTP of the paths and in errors, as far as a run or an event shows them.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;
use std::process::Stdio;
use std::time::SystemTime;

use prost_reflect::{DescriptorPool, EnumDescriptor, FieldDescriptor, MessageDescriptor};
use scpsfm::cli::job_view::event_json;
use scpsfm::domain::job::{AttemptEnd, EventBody, Failure, JobEvent, JobName, JobState, PastAttempt};
use scpsfm::domain::{HeadProgress, Losses, Phase, Progress, ReconstructionProgress, Stage, Step, Task};
use scpsfm::rpc::proto;
use serde_json::{Value, json};

use crate::support::http::{get, post};
use crate::support::program::{Serving, run};

/// How far a job was when it was asked for: what is in it depends on the moment. [`rare_events`] has all of it.
const PROGRESS: &str = "progress";

/// 32 bytes.
const WEBHOOK_SECRET: &str = "whsec_c2VjcmV0LXNlY3JldC1zZWNyZXQtc2VjcmV0LXNlYzE=";

/// Names by where they are, one line each.
#[derive(Default)]
struct Names(BTreeSet<String>);

impl Names {
    fn add(&mut self, place: &str, name: &str) {
        self.0.insert(format!("{place}: {name}"));
    }

    /// The keys of an object and of all that it holds, but for [`PROGRESS`].
    fn add_keys(&mut self, place: &str, path: &str, value: &Value) {
        match value {
            Value::Object(fields) => {
                for (key, value) in fields {
                    let path = format!("{path}{key}");
                    self.add(place, &path);
                    if key != PROGRESS {
                        self.add_keys(place, &format!("{path}."), value);
                    }
                }
            }
            Value::Array(values) => values.iter().for_each(|value| self.add_keys(place, path, value)),
            _ => {}
        }
    }

    /// The names in the files of a directory: keys, columns and properties.
    fn add_files(&mut self, directory: &Path) {
        for entry in fs::read_dir(directory).expect("a directory") {
            let path = entry.expect("an entry").path();
            let name = path.file_name().and_then(|name| name.to_str()).expect("a name").to_owned();
            let text = || fs::read_to_string(&path).expect("text");
            match path.extension().and_then(|extension| extension.to_str()) {
                Some("json") => self.add_keys(&name, "", &serde_json::from_str(&text()).expect("JSON")),
                Some("csv") => {
                    text().lines().next().expect("a header").split(',').for_each(|column| self.add(&name, column));
                }
                Some("ply") => {
                    let text = text();
                    let header = text.lines().take_while(|line| *line != "end_header");
                    header.filter(|line| line.starts_with("property")).for_each(|line| self.add(&name, line));
                }
                _ => self.add(&name, "the file"),
            }
        }
    }
}

/// What a watch prints only at times: progress with all that it can hold, interim weights, and a failure with its
/// attempts.
fn rare_events() -> [Value; 3] {
    let head = HeadProgress {
        head: 1,
        iteration: 1,
        phase: Some(Phase::Growth),
        weight_sum: 1.0,
        weight_histogram: [1; HeadProgress::BINS],
        tolerance: Some(0.5),
        best_daq_residual: Some(0.5),
    };
    let step = Step { task: Task::Heads, step: 1, steps: 2 };
    let progress = Progress {
        stage: Stage::Search,
        fraction: 0.5,
        iteration: 1,
        losses: Some(Losses { num: 1.0, proj: 1.0, daq: 1.0 }),
        head: Some(head),
        inliers: 1,
        focal_px: Some(1.0),
        best_cost: Some(0.5),
        elapsed_seconds: 1.0,
        reconstruction: ReconstructionProgress { step: Some(step), ..ReconstructionProgress::default() },
    };
    let attempt = PastAttempt {
        attempt: 1,
        server: "here".into(),
        start_time: SystemTime::UNIX_EPOCH,
        end_time: SystemTime::UNIX_EPOCH,
        end: AttemptEnd::Lost,
    };
    let failure = Failure { attempts: vec![attempt], ..Failure::new("ATTEMPTS_EXHAUSTED", "no more") };
    let bodies = [
        EventBody::Progress(progress),
        EventBody::Weights { iteration: 1, weights: vec![0.5] },
        EventBody::State { state: JobState::Failed, failure: Some(failure) },
    ];
    bodies.map(|body| {
        let job = JobName { tenant: "default".into(), job: "a".into() };
        event_json(&JobEvent { job, attempt: 1, sequence: Some(1), time: SystemTime::UNIX_EPOCH, body })
    })
}

/// Runs the program; returns what it printed. Ending without a reconstruction is as good as any.
fn printed(arguments: &[&str]) -> String {
    let ran = run(arguments);
    assert!(matches!(ran.code, Some(0 | 3)), "{arguments:?}: {ran:?}");
    ran.stdout
}

#[test]
fn no_released_name_is_gone_and_every_new_one_is_listed() {
    let directory = tempfile::tempdir().expect("a temporary directory");
    let path = |name: &str| directory.path().join(name).to_str().expect("a path of ours").to_owned();
    let mut names = Names::default();
    let size = ["--width", "1000", "--height", "1000"];
    let mut solved = |scene: &[&str], settings: &[&str], out: &str| {
        let input = path(&format!("{out}-input"));
        printed(&[&["synth", "--out", &input], scene].concat());
        let input = format!("{input}/observations.csv");
        printed(&[&["solve", &input, "--quiet", "--out", &path(out)], &size[..], settings].concat());
        names.add_files(Path::new(&path(out)));
        input
    };
    // A second motion, whose tracks are marked; tracks of two views; nothing but wrong tracks; windows of a walk.
    let input = solved(&["--outliers", "0.5", "--second-motion", "0.3", "--seed", "1"], &[], "metric");
    solved(&["--photographed", "--seed", "800196"], &[], "two-views");
    solved(&["--outliers", "1", "--tracks", "60"], &[], "nothing");
    let walk = ["--sequence", "--views", "8", "--tracks", "200"];
    solved(&walk, &["--window", "4"], "windows");

    let webhooks = [("SCPSFM_WEBHOOKS__SECRET", WEBHOOK_SECRET), ("SCPSFM_WEBHOOKS__ALLOW_PRIVATE_ADDRESSES", "true")];
    let server = Serving::start_with(&directory.path().join("data"), &webhooks, Stdio::null());
    let at = ["--server", &server.grpc];
    // Long enough to tell of its progress.
    let long = ["--method", "paper", "--iterations", "1000"];
    // Nobody hears of its end.
    let webhook = ["--webhook", "http://127.0.0.1:1/"];
    let job = printed(&[&["submit", &input], &size[..], &long, &webhook, &at].concat());
    let job = job.trim();
    printed(&[&["upload", &input], &size[..], &at].concat());
    let commands = [&["watch", job][..], &["get", job], &["list"], &["inputs"], &["admin", "queue"]];
    for command in commands {
        let place = format!("{} --json", command.join(" ").replace(job, "JOB"));
        let answer = printed(&[command, &["--json"], &at].concat());
        let values = serde_json::Deserializer::from_str(&answer).into_iter::<Value>();
        values.for_each(|value| names.add_keys(&place, "", &value.expect("JSON")));
    }
    for event in rare_events() {
        names.add_keys("watch JOB --json", "", &event);
        names.add_keys("watch JOB --json", "progress.", &event[PROGRESS]);
    }
    let (unknown, malformed) =
        (get(&server, "/v1/tenants/-/jobs/none"), post(&server, "/v1/tenants/-/jobs", &json!({})));
    for refusal in [unknown, malformed] {
        names.add_keys("an error over HTTP", "", &refusal.json());
    }
    for (path, methods) in get(&server, "/openapi.json").json()["paths"].as_object().expect("paths") {
        methods.as_object().expect("methods").keys().for_each(|method| names.add(method, path));
    }

    let drained = printed(&[&["admin", "drain", "--json"], &at[..]].concat());
    names.add_keys("admin drain --json", "", &serde_json::from_str(&drained).expect("JSON"));

    let listed = include_str!("contract.txt").lines().filter(|line| !line.starts_with('#'));
    let listed: BTreeSet<String> = listed.map(str::to_owned).collect();
    let gone: Vec<&String> = listed.difference(&names.0).collect();
    let new: Vec<&String> = names.0.difference(&listed).collect();
    assert!(gone.is_empty(), "names that programs rely on are gone: {gone:#?}");
    assert!(new.is_empty(), "new names, to be listed in tests/it/contract.txt: {new:#?}");
}

/// What a description of the API promises, a line each.
fn promises(pool: &DescriptorPool) -> BTreeSet<String> {
    let is_ours = |name: &str| name.starts_with("scpsfm.");
    let field = |of: FieldDescriptor| {
        let group = of.containing_oneof().map(|group| group.name().to_owned());
        format!(
            "{} = {}, {:?} {:?}, {group:?}, {}",
            of.full_name(),
            of.number(),
            of.cardinality(),
            of.kind(),
            of.json_name()
        )
    };
    let of_message = |message: MessageDescriptor| message.fields().map(field).collect::<Vec<String>>();
    let value = |of: EnumDescriptor| {
        of.values().map(|value| format!("{} = {}", value.full_name(), value.number())).collect::<Vec<String>>()
    };
    let fields = pool.all_messages().filter(|message| is_ours(message.full_name())).flat_map(of_message);
    let values = pool.all_enums().filter(|of| is_ours(of.full_name())).flat_map(value);
    let methods = pool.services().flat_map(|service| service.methods().collect::<Vec<_>>()).map(|method| {
        let streams = (method.is_client_streaming(), method.is_server_streaming());
        let (input, output) = (method.input(), method.output());
        format!("{}: {} -> {}, {streams:?}", method.full_name(), input.full_name(), output.full_name())
    });
    fields.chain(values).chain(methods).collect()
}

/// The same as `buf breaking`, which not every machine has, but for what only generated code notices.
#[test]
fn the_released_api_is_there_and_is_all_of_it_where_nothing_is_unreleased() {
    let decoded = |bytes: &[u8]| promises(&DescriptorPool::decode(bytes).expect("a set of files"));
    let released = decoded(include_bytes!("../../proto/released.binpb"));
    let now = decoded(proto::FILE_DESCRIPTOR_SET);
    assert!(released.len() > 300, "{} promises", released.len());
    let broken: Vec<&String> = released.difference(&now).collect();
    assert!(broken.is_empty(), "the API breaks what was released: {broken:#?}");
    let (_, unreleased) = include_str!("../../CHANGELOG.md").split_once("## [Unreleased]").expect("a section");
    let unreleased = unreleased.split("\n## ").next().unwrap_or_default();
    let new: Vec<&String> = now.difference(&released).collect();
    assert!(new.is_empty() || unreleased.contains("API:"), "a release makes released.binpb: {new:#?}");
}
