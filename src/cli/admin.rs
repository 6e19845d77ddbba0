//! `scpsfm admin`: the queue and its servers.

use clap::Subcommand;
use serde_json::{Value, json};

use super::access::TenantArg;
use super::args::ServerArgs;
use super::exit::{Exit, Failure};
use super::print;
use crate::domain::job::JobState;
use crate::rpc::convert::enums::Twin;
use crate::rpc::proto;

const EXAMPLES: &str = "\
Examples:
  scpsfm admin queue
  scpsfm admin pause
  scpsfm admin drain --server http://10.0.0.7:50051    # the server itself, not a balancer
  scpsfm admin queue --json | jq .paused";

/// Look at the queue, pause and resume it, drain a server
///
/// Where the server asks for API keys, this needs one of the scope admin. `scpsfm retry` and `scpsfm priority` change
/// single jobs.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES, after_long_help = format!("{EXAMPLES}\n\n{}", super::exit::HELP))]
pub struct Args {
    #[command(subcommand)]
    pub action: Action,
}

/// What to do.
#[derive(Debug, Subcommand)]
pub enum Action {
    /// Show the queue of all servers of the store
    Queue(ActionArgs),
    /// Let no server of the store begin a job until `resume`, also after a restart; jobs that run go on
    Pause(ActionArgs),
    /// End a pause
    Resume(ActionArgs),
    /// Have the server that answers drain, as on SIGTERM, and end its process
    Drain(ActionArgs),
}

/// What each of them takes: no tenant, since the queue and its servers are those of all.
#[derive(Debug, clap::Args)]
#[command(mut_arg(TenantArg::ID, |tenant| tenant.hide(true)))]
pub struct ActionArgs {
    #[command(flatten)]
    pub server: ServerArgs,

    /// The answer as JSON
    #[arg(long)]
    pub json: bool,
}

/// Runs the command.
pub async fn run(args: Args) -> Result<Exit, Failure> {
    let (Action::Queue(given) | Action::Pause(given) | Action::Resume(given) | Action::Drain(given)) = &args.action;
    if let Some(tenant) = given.server.access.tenant.flag() {
        return Err(Failure::usage(format_args!(
            "--tenant {tenant}: the queue and its servers are those of all tenants; leave it out"
        )));
    }
    let mut client = given.server.connect().await?;
    let queue = match args.action {
        Action::Queue(_) => client.queue().await?,
        Action::Pause(_) => client.pause_queue().await?,
        Action::Resume(_) => client.resume_queue().await?,
        Action::Drain(_) => {
            let server = client.drain_server().await?;
            let line = if given.json { json!({ "server": server }).to_string() } else { format!("{server} drains") };
            print(&line)?;
            return Ok(Exit::Done);
        }
    };
    print(&if given.json { format!("{:#}", queue_json(&queue)) } else { queue_text(&queue) })?;
    Ok(Exit::Done)
}

/// The name of the state that is counted; a server of a later version may count others.
fn state_name(of: &proto::JobCount) -> &'static str {
    JobState::known(of.state).map_or("UNKNOWN", JobState::name)
}

fn queue_json(queue: &proto::Queue) -> Value {
    let counts = queue.job_counts.iter().map(|of| (state_name(of).to_owned(), json!(of.count)));
    let tenant = |of: &proto::TenantQueue| {
        let (queued, running) = (of.queued_job_count, of.running_job_count);
        json!({ "tenant": of.tenant, "queued_jobs": queued, "running_jobs": running })
    };
    json!({
        "paused": queue.paused,
        "pause_time": queue.pause_time.map(|time| time.to_string()),
        "jobs": counts.collect::<serde_json::Map<_, _>>(),
        "oldest_job": Some(&queue.oldest_job).filter(|name| !name.is_empty()),
        "oldest_queue_time": queue.oldest_queue_time.map(|time| time.to_string()),
        "tenants": queue.tenants.iter().map(tenant).collect::<Vec<_>>(),
    })
}

fn queue_text(queue: &proto::Queue) -> String {
    let mut lines = vec![match queue.pause_time {
        Some(time) => format!("paused since {time}"),
        None => "not paused".to_owned(),
    }];
    lines.extend(queue.job_counts.iter().map(|of| format!("{:<17} {:>8}", state_name(of), of.count)));
    if let Some(time) = queue.oldest_queue_time {
        lines.push(format!("oldest waiting: {} since {time}", queue.oldest_job));
    }
    for of in &queue.tenants {
        lines.push(format!("{}: {} waiting, {} running", of.tenant, of.queued_job_count, of.running_job_count));
    }
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_queue_is_told_in_lines_and_as_json() {
        let time = prost_types::Timestamp { seconds: 0, nanos: 0 };
        let mut queue = proto::Queue {
            paused: true,
            pause_time: Some(time),
            job_counts: vec![proto::JobCount { state: proto::JobState::DeadlineExceeded as i32, count: 3 }],
            oldest_job: "tenants/north/jobs/a".into(),
            oldest_queue_time: Some(time),
            tenants: vec![proto::TenantQueue {
                tenant: "tenants/north".into(),
                queued_job_count: 2,
                running_job_count: 1,
            }],
        };
        let text = queue_text(&queue);
        let expected = [
            "paused since 1970-01-01T00:00:00Z",
            "DEADLINE_EXCEEDED        3",
            "oldest waiting: tenants/north/jobs/a since 1970-01-01T00:00:00Z",
            "tenants/north: 2 waiting, 1 running",
        ];
        assert_eq!(text.lines().collect::<Vec<_>>(), expected);
        let value = queue_json(&queue);
        assert_eq!((&value["paused"], &value["jobs"]["DEADLINE_EXCEEDED"]), (&json!(true), &json!(3)));
        assert_eq!(value["tenants"][0]["queued_jobs"], 2);
        queue = proto::Queue::default();
        assert_eq!(queue_text(&queue), "not paused");
        assert_eq!(queue_json(&queue)["oldest_job"], Value::Null);
    }
}
