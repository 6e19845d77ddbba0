//! `scpsfm cancel`: stops a job.

use super::args::ServerArgs;
use super::exit::{Exit, Failure};
use super::job_view::{self, GivenName};

const EXAMPLES: &str = "\
Examples:
  scpsfm cancel tenants/default/jobs/a1b2
  scpsfm list --state queued --json | jq -r .name | xargs -n 1 scpsfm cancel";

/// Stop a job
///
/// A queued job is cancelled at once, a running one within 200 ms or one network iteration; one that has ended stays as
/// it is. Prints the job as it stands then.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES, after_long_help = format!("{EXAMPLES}\n\n{}", super::exit::HELP))]
pub struct Args {
    /// The job's name, or the last part of it
    #[arg(value_name = "NAME", value_parser = GivenName::parse)]
    pub name: GivenName,

    #[command(flatten)]
    pub server: ServerArgs,

    /// The job as JSON
    #[arg(long)]
    pub json: bool,
}

/// Runs the command.
pub async fn run(args: Args) -> Result<Exit, Failure> {
    let name = args.name.of(&args.server.access)?;
    let job = args.server.connect().await?.cancel(&name).await?;
    job_view::print_job(&job, args.json)?;
    Ok(Exit::Done)
}
