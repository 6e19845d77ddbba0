//! `scpsfm retry`: has jobs solved again that ended without a result.

use super::args::ServerArgs;
use super::exit::{Exit, Failure};
use super::job_view::{self, GivenName};

const EXAMPLES: &str = "\
Examples:
  scpsfm retry tenants/default/jobs/a1b2
  scpsfm list --all --state failed --json | jq -r .name | xargs -r scpsfm retry";

/// Put jobs that failed, were cancelled or exceeded their deadline into the queue again
///
/// Each keeps its name, input and settings; its lost attempts are counted anew, and a deadline that has passed is
/// dropped. A job that waits or runs stays as it is; one that has succeeded is refused. Prints each job as it stands
/// then. Stops at the first that cannot be retried.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES, after_long_help = format!("{EXAMPLES}\n\n{}", super::exit::HELP))]
pub struct Args {
    /// The jobs' names, or the last parts of them
    #[arg(value_name = "JOB", required = true, value_parser = GivenName::parse)]
    pub names: Vec<GivenName>,

    #[command(flatten)]
    pub server: ServerArgs,

    /// Each job as JSON
    #[arg(long)]
    pub json: bool,
}

/// Runs the command.
pub async fn run(args: Args) -> Result<Exit, Failure> {
    job_view::change_each(&args.server, &args.names, args.json, async |client, name| client.retry(name).await).await
}
