//! `scpsfm get`: one job.

use super::args::ServerArgs;
use super::exit::{Exit, Failure};
use super::job_view::{self, GivenName};

const EXAMPLES: &str = "\
Examples:
  scpsfm get tenants/default/jobs/a1b2
  scpsfm get a1b2 --json | jq -r .state";

/// Show a job
///
/// Ends with 0 whatever the job's state is: a failed job's reason is part of the answer.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES, after_long_help = format!("{EXAMPLES}\n\n{}", super::exit::HELP))]
pub struct Args {
    /// The job's name, or the last part of it
    #[arg(value_name = "NAME", value_parser = GivenName::parse)]
    pub name: GivenName,

    #[command(flatten)]
    pub server: ServerArgs,

    /// Everything, as JSON
    #[arg(long)]
    pub json: bool,
}

/// Runs the command.
pub async fn run(args: Args) -> Result<Exit, Failure> {
    let name = args.name.of(&args.server.access)?;
    let job = args.server.connect().await?.get(&name).await?;
    job_view::print_job(&job, args.json)?;
    Ok(Exit::Done)
}
