//! `scpsfm cancel`: stops jobs.

use super::args::ServerArgs;
use super::exit::{Exit, Failure};
use super::job_view::{self, GivenName};

const EXAMPLES: &str = "\
Examples:
  scpsfm cancel tenants/default/jobs/a1b2
  scpsfm list --all --state queued --json | jq -r .name | xargs -r scpsfm cancel";

/// Stop jobs
///
/// A queued job is cancelled at once, a running one within 200 ms or one network iteration; one that has ended stays as
/// it is. Prints each job as it stands then. Stops at the first that cannot be cancelled.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES, after_long_help = format!("{EXAMPLES}\n\n{}", super::exit::HELP))]
pub struct Args {
    /// The jobs' names, or the last parts of them
    #[arg(value_name = "NAME", required = true, value_parser = GivenName::parse)]
    pub names: Vec<GivenName>,

    #[command(flatten)]
    pub server: ServerArgs,

    /// Each job as JSON
    #[arg(long)]
    pub json: bool,
}

/// Runs the command.
pub async fn run(args: Args) -> Result<Exit, Failure> {
    job_view::change_each(&args.server, &args.names, args.json, async |client, name| client.cancel(name).await).await
}
