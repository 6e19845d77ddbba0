//! `scpsfm priority`: puts a waiting job further ahead or behind.

use super::args::ServerArgs;
use super::exit::{Exit, Failure};
use super::job_view::{self, GivenName};
use crate::rpc::convert::create::MAX_PRIORITY;

const EXAMPLES: &str = "\
Examples:
  scpsfm priority a1b2 10
  scpsfm priority tenants/default/jobs/a1b2 -5 --json | jq .priority";

/// Change the priority of a job that waits
///
/// Of the waiting jobs of a tenant, those of larger priority run first, among equals the older. A job that runs or has
/// ended is refused. Prints the job as it stands then.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES, after_long_help = format!("{EXAMPLES}\n\n{}", super::exit::HELP))]
pub struct Args {
    /// The job's name, or the last part of it
    #[arg(value_name = "JOB", value_parser = GivenName::parse)]
    pub name: GivenName,

    #[arg(value_name = "N", help = format!("The priority, -{MAX_PRIORITY} to {MAX_PRIORITY}; that of new jobs is 0"),
        value_parser = clap::value_parser!(i32).range(i64::from(-MAX_PRIORITY)..=i64::from(MAX_PRIORITY)))]
    pub priority: i32,

    #[command(flatten)]
    pub server: ServerArgs,

    /// Everything, as JSON
    #[arg(long)]
    pub json: bool,
}

/// Runs the command.
pub async fn run(args: Args) -> Result<Exit, Failure> {
    let name = args.name.of(&args.server.access)?;
    let job = args.server.connect().await?.set_priority(&name, args.priority).await?;
    job_view::print_job(&job, args.json)?;
    Ok(Exit::Done)
}
