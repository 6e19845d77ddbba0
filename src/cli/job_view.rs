//! Jobs and events on stdout: a line for people, JSON for programs.

use std::time::SystemTime;

use serde_json::{Value, json};

use super::access::AccessArgs;
use super::args::ServerArgs;
use super::exit::{Exit, Failure};
use super::interrupt::Signals;
use super::next_steps;
use super::print;
use super::progress::ProgressView;
use crate::client::{self, Client, ErrorKind};
use crate::domain::job::{EventBody, Failure as JobFailure, Job, JobEvent, JobName, JobState, PastAttempt, Summary};
use crate::domain::{Grade, InputName, Status, Warning, Webhook, counted};

/// A job's name as it was given: whole, or its last part alone.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum GivenName {
    Whole(JobName),
    /// Of the tenant that calls; see [`own_id`].
    Id(String),
}

impl GivenName {
    /// # Errors
    /// For what is neither.
    pub fn parse(text: &str) -> Result<Self, String> {
        let given = match own_id(text, "jobs") {
            Some(id) => Some(Self::Id(id.to_owned())),
            None => JobName::parse(text).map(Self::Whole),
        };
        given.ok_or_else(|| format!("{text:?} is not a job's name, such as tenants/default/jobs/a1b2"))
    }

    /// The whole name.
    ///
    /// # Errors
    /// For a tenant that is none, and a flag that names another one, as wrong usage.
    pub fn of(&self, access: &AccessArgs) -> Result<JobName, Failure> {
        match self {
            Self::Whole(name) => access.tenant.check(&name.tenant, name).map(|()| name.clone()),
            Self::Id(job) => Ok(JobName { tenant: access.tenant()?, job: job.clone() }),
        }
    }
}

/// The last part of a name of the tenant that calls, of this collection: given alone, or after `tenants/-/`, as the
/// commands print it where the key names the tenant.
pub fn own_id<'a>(text: &'a str, collection: &str) -> Option<&'a str> {
    let after = text.strip_prefix("tenants/-/").and_then(|rest| rest.strip_prefix(collection)?.strip_prefix('/'));
    let id = after.unwrap_or(text);
    JobName::is_id(id).then_some(id)
}

/// What ended a job that is DEADLINE_EXCEEDED.
const DEADLINE_EXCEEDED: &str = "  its deadline passed before a result stood";

/// A job in a line.
pub fn job_line(job: &Job) -> String {
    let mut line = format!("{}  {:<9}  {}", job.name, job.state.name(), time(job.create_time));
    line.push_str(&format!("  {}, {}", counted(job.view_count, "view"), counted(job.track_count, "track")));
    if let Some(summary) = &job.summary {
        line.push_str(&format!("  {}", summary_words(summary)));
    } else if let Some(failure) = &job.failure {
        line.push_str(&format!("  {}: {}", failure.reason, failure.message));
    } else if job.state == JobState::DeadlineExceeded {
        line.push_str(DEADLINE_EXCEEDED);
    } else if let Some(progress) = job.progress.filter(|_| job.state == JobState::Running) {
        line.push_str(&format!("  {} {:.0} %", progress.stage.name(), 100.0 * progress.fraction));
    }
    if job.cancel_requested && !job.state.is_terminal() {
        line.push_str("  cancel requested");
    }
    // That of new jobs is 0.
    if job.priority != 0 {
        line.push_str(&format!("  priority {}", job.priority));
    }
    job.labels.iter().for_each(|(key, value)| line.push_str(&format!("  {key}={}", label(value))));
    line
}

/// A value as it is where that is one plain word, else quoted and escaped: other clients wrote it, and it must not break
/// the line or reach the terminal.
fn label(value: &str) -> String {
    let is_plain = |c: char| c.is_alphanumeric() || "-_./:@+".contains(c);
    if !value.is_empty() && value.chars().all(is_plain) { value.to_owned() } else { format!("{value:?}") }
}

fn summary_words(summary: &Summary) -> String {
    if summary.status == Status::NoReconstruction {
        let codes: Vec<&str> = summary.warnings.iter().map(|warning| warning.code.name()).collect();
        let why = if codes.is_empty() { String::new() } else { format!(": {}", codes.join(", ")) };
        return format!("no reconstruction{why}");
    }
    let grade = summary.grade.map_or("solved", Grade::name);
    let focal = summary.focal_px.map(|focal_px| format!(", focal {focal_px:.1} px")).unwrap_or_default();
    let tracks = counted(summary.inlier_tracks, "inlier track");
    format!("{grade}, {tracks}{focal}, {:.1} s", summary.seconds)
}

/// The warnings of a result, a line each as `scpsfm solve` tells them; where there is no reconstruction, they say why.
fn warning_lines(summary: &Summary) -> Vec<String> {
    let line = |warning: &Warning| format!("  warning: {}: {}", warning.code.name(), warning.detail);
    summary.warnings.iter().map(line).collect()
}

/// Prints a job: a line, one more for its uploaded input, its webhook and each of its warnings; or everything as JSON.
pub fn print_job(job: &Job, json: bool) -> Result<(), Failure> {
    if json {
        return print(&format!("{:#}", job_json(job)));
    }
    let mut lines = vec![job_line(job)];
    lines.extend(job.input.as_ref().map(|input| format!("  input: {input}")));
    lines.extend(job.webhook.as_ref().map(webhook_line));
    lines.extend(job.summary.iter().flat_map(warning_lines));
    print(&lines.join("\n"))
}

/// Changes each of several jobs and prints it as it stands then; stops at the first that cannot be changed.
pub async fn change_each(
    server: &ServerArgs,
    names: &[GivenName],
    json: bool,
    change: impl AsyncFn(&mut Client, &JobName) -> Result<Job, client::Error>,
) -> Result<Exit, Failure> {
    // All of them are named before the first is changed.
    let names = names.iter().map(|name| name.of(&server.access)).collect::<Result<Vec<_>, _>>()?;
    let mut client = server.connect().await?;
    for name in names {
        print_job(&change(&mut client, &name).await?, json)?;
    }
    Ok(Exit::Done)
}

/// Why a job failed, for programs; attempts only where there are any to tell of.
fn failure_json(failure: &JobFailure) -> Value {
    let mut value = json!({ "reason": failure.reason, "message": failure.message });
    let past = |past: &PastAttempt| {
        json!({
            "attempt": past.attempt,
            "server": past.server,
            "start_time": time(past.start_time),
            "end_time": time(past.end_time),
            "end": past.end,
        })
    };
    if !failure.attempts.is_empty() {
        value["attempts"] = failure.attempts.iter().map(past).collect();
    }
    value
}

fn webhook_json(webhook: &Webhook) -> Value {
    json!({
        "url": webhook.url,
        "state": webhook.state,
        "attempt_count": webhook.attempts,
        "last_error": webhook.last_error,
    })
}

/// A webhook in a line.
fn webhook_line(webhook: &Webhook) -> String {
    let mut line = format!("  webhook: {}  {}", webhook.url, webhook.state.name());
    if webhook.attempts > 0 {
        line.push_str(&format!("  attempts: {}", webhook.attempts));
    }
    if let Some(error) = &webhook.last_error {
        line.push_str(&format!("  {error}"));
    }
    line
}

/// A job for programs; times as RFC 3339.
pub fn job_json(job: &Job) -> Value {
    json!({
        "name": job.name.to_string(),
        "state": job.state,
        "attempt_count": job.attempt,
        "settings": job.settings,
        "input": job.input.as_ref().map(InputName::to_string),
        "views": job.view_count,
        "tracks": job.track_count,
        "observations": job.observation_count,
        "labels": job.labels,
        "priority": job.priority,
        "create_time": time(job.create_time),
        "start_time": job.start_time.map(time),
        "end_time": job.end_time.map(time),
        "deadline_time": job.deadline.map(time),
        "progress": job.progress,
        "last_sequence": job.last_sequence,
        "summary": job.summary,
        "error": job.failure.as_ref().map(failure_json),
        "cancel_requested": job.cancel_requested,
        "expire_time": job.expire_time.map(time),
        "webhook": job.webhook.as_ref().map(webhook_json),
        "etag": job.etag(),
    })
}

/// An event for programs.
pub fn event_json(event: &JobEvent) -> Value {
    let (kind, body) = match &event.body {
        EventBody::State { state, failure } => {
            ("state_change", json!({ "state": state, "error": failure.as_ref().map(failure_json) }))
        }
        EventBody::Progress(progress) => ("progress", json!(progress)),
        EventBody::Weights { iteration, weights } => ("weights", json!({ "iteration": iteration, "weight": weights })),
        EventBody::Summary(summary) => ("summary", json!(summary)),
    };
    json!({
        "job": event.job.to_string(),
        "attempt": event.attempt,
        "sequence": event.sequence,
        "time": time(event.time),
        kind: body,
    })
}

fn time(time: SystemTime) -> String {
    prost_types::Timestamp::from(time).to_string()
}

/// Shows an event on the progress view.
pub fn show_event(view: &mut ProgressView, event: &JobEvent) {
    match &event.body {
        EventBody::State { state, failure: None } => view.state(&format!("{} {}", event.job, state.name())),
        EventBody::State { state, failure: Some(failure) } => {
            view.state(&format!("{} {}: {}", event.job, state.name(), failure.message));
        }
        EventBody::Progress(progress) => view.show(progress),
        EventBody::Weights { .. } => {}
        EventBody::Summary(summary) => view.state(&summary_words(summary)),
    }
}

/// Follows a job to its end and ends as it did; with `json` one event a line on stdout. Where nothing came after
/// `after` any more, it says so.
pub async fn watch_to_end(
    client: &mut Client,
    server: &ServerArgs,
    name: &JobName,
    after: u64,
    json: bool,
) -> Result<Exit, Failure> {
    let mut view = ProgressView::new(json);
    let mut result = None;
    let mut unprinted = Ok(());
    let mut on_event = |event: &JobEvent| {
        if let EventBody::Summary(summary) = &event.body {
            result = Some(summary.clone());
        }
        if !json {
            show_event(&mut view, event);
            if let EventBody::Summary(summary) = &event.body {
                warning_lines(summary).iter().for_each(|line| view.state(line));
            }
        } else if unprinted.is_ok() {
            unprinted = print(&event_json(event).to_string());
        }
    };
    let mut reached = after;
    // As the server names it, where the key names the tenant.
    let mut whole_name = None;
    let mut on_numbered = |event: &JobEvent| {
        reached = event.sequence.unwrap_or(reached);
        whole_name.get_or_insert_with(|| event.job.clone());
        on_event(event);
    };
    let mut signals = Signals::listen()?;
    let watched = tokio::select! {
        watched = client.watch(name, after, &mut on_numbered) => Some(watched),
        () = signals.next() => None,
    };
    view.finish();
    let whole_name = whole_name.as_ref().unwrap_or(name);
    let job = Lost { name: whole_name, server, after: reached, files: " --out DIR" };
    let Some(watched) = watched else {
        return Err(Failure::interrupted_with(format!("interrupted; the job goes on\n{}", taken_up_again(&job))));
    };
    let last = watched.map_err(|error| lost(error, &job))?;
    unprinted?;
    if let Some(last) = &last {
        client::ended(last)?;
        if let Some(summary) = &result {
            if !json {
                tell_next(&job, summary);
            }
            return Ok(Exit::of_status(summary.status));
        }
    }
    // The event that tells the result, or the end, came before.
    let job = client.get(name).await?;
    if last.is_none() {
        tell!("nothing comes after event {after}: {} is {}", job.name, job.state.name());
    }
    client::ended_as(&job.name, job.state, job.failure.as_ref())?;
    Ok(job.summary.map_or(Exit::Done, |summary| Exit::of_status(summary.status)))
}

/// Tells on stderr how to get the files of a result, and what would make it better.
fn tell_next(job: &Lost, summary: &Summary) {
    let Lost { name, server, files, .. } = job;
    tell!("next: scpsfm result {name}{}{files}", server.flags());
    if let Some(advice) = next_steps::advice(summary.into()) {
        tell!("      {advice}");
    }
}

/// A job whose server was lost, and what its result is to be read with.
#[derive(Debug)]
pub struct Lost<'a> {
    pub name: &'a JobName,
    /// With which it was reached.
    pub server: &'a ServerArgs,
    /// The last event that was seen.
    pub after: u64,
    /// Flags of `scpsfm result`.
    pub files: &'a str,
}

/// The failure of a call; where the server is lost, with the commands that take the job up again.
pub fn lost(error: client::Error, job: &Lost) -> Failure {
    if error.kind != ErrorKind::Unavailable {
        return error.into();
    }
    let mut failure = Failure::from(error);
    let commands = taken_up_again(job);
    failure.message.push_str(&format!("\nthe job is {}; once the server answers again:\n{commands}", job.name));
    failure
}

/// The commands that take a job up again.
fn taken_up_again(job: &Lost) -> String {
    let Lost { name, server, after, files } = job;
    let server = server.flags();
    let after = if *after > 0 { format!(" --after {after}") } else { String::new() };
    format!("  scpsfm watch {name}{server}{after}\n  scpsfm result {name}{server}{files}")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::access::TenantArg;

    #[test]
    fn names_may_be_given_in_full_or_by_their_id() {
        let given = |text: &str, tenant: Option<&str>, is_flag: bool| {
            let tenant = TenantArg { id: tenant.map(str::to_owned), is_flag };
            let access = AccessArgs { tenant, ..AccessArgs::default() };
            GivenName::parse(text).map(|given| given.of(&access))
        };
        let of = |text: &str, tenant| given(text, tenant, false).map(|name| name.expect("a tenant").to_string());
        assert_eq!(of("a-1", None).as_deref(), Ok("tenants/default/jobs/a-1"));
        assert_eq!(of("a-1", Some("north")).as_deref(), Ok("tenants/north/jobs/a-1"));
        assert_eq!(of("tenants/south/jobs/a-1", Some("north")).as_deref(), Ok("tenants/south/jobs/a-1"));
        assert_eq!(of("tenants/-/jobs/a-1", None).as_deref(), Ok("tenants/default/jobs/a-1"));
        let flag = |text: &str| given(text, Some("north"), true).expect("a name");
        for same in ["a-1", "tenants/-/jobs/a-1", "tenants/north/jobs/a-1"] {
            assert_eq!(flag(same).expect(same).to_string(), "tenants/north/jobs/a-1");
        }
        let refused = flag("tenants/south/jobs/a-1").expect_err("of another tenant");
        assert_eq!(refused.exit, Exit::Usage);
        assert!(
            refused.message.starts_with("--tenant north: tenants/south/jobs/a-1 is of the tenant south"),
            "{refused}"
        );
        assert!(of("A", None).is_err());
        assert!(of("jobs/a", None).is_err());
        assert!(of("tenants/-/inputs/a", None).is_err());
        assert!(of("tenants/-/jobs/", None).is_err());
    }

    #[test]
    fn labels_of_others_neither_break_the_line_nor_reach_the_terminal() {
        let shown = ["north", "v1.2:a/b", "Zürich", "", "a b", "x\ny", "\u{1b}[2J"].map(label);
        assert_eq!(shown, ["north", "v1.2:a/b", "Zürich", "\"\"", "\"a b\"", "\"x\\ny\"", "\"\\u{1b}[2J\""]);
    }

    #[test]
    fn a_lost_server_leaves_the_commands_that_go_on() {
        let given = GivenName::parse("a-1").expect("a name");
        let name = given.of(&AccessArgs::default()).expect("a tenant");
        let access = AccessArgs { tls_ca: Some("ca.pem".into()), ..AccessArgs::default() };
        let server = ServerArgs { server: "https://h:1".into(), access };
        let job = Lost { name: &name, server: &server, after: 7, files: " --out 'a b'" };
        let words = lost(ErrorKind::Unavailable.error("gone"), &job).message;
        assert!(words.starts_with("gone\nthe job is tenants/default/jobs/a-1;"), "{words}");
        let there = "tenants/default/jobs/a-1 --server https://h:1 --tls-ca ca.pem";
        assert!(words.contains(&format!("\n  scpsfm watch {there} --after 7\n")), "{words}");
        assert!(words.ends_with(&format!("\n  scpsfm result {there} --out 'a b'")), "{words}");
        assert_eq!(lost(ErrorKind::Refused.error("no"), &job).message, "no");
    }

    #[test]
    fn an_event_is_json_under_its_kind() {
        let event = JobEvent {
            job: JobName { tenant: "default".into(), job: "a".into() },
            attempt: 1,
            sequence: Some(3),
            time: SystemTime::UNIX_EPOCH,
            body: EventBody::State { state: JobState::Running, failure: None },
        };
        let value = event_json(&event);
        assert_eq!(value["state_change"]["state"], "RUNNING");
        assert_eq!((&value["sequence"], &value["time"]), (&json!(3), &json!("1970-01-01T00:00:00Z")));
    }
}
