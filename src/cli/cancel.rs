//! `scpsfm cancel`: stops a job.

use super::args::ServerArgs;
use super::client::Client;
use super::exit::{Exit, Failure};
use super::job_view;
use crate::domain::job::JobName;

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
    #[arg(value_name = "NAME", value_parser = job_view::parse_name)]
    pub name: JobName,

    #[command(flatten)]
    pub server: ServerArgs,

    /// The job as JSON
    #[arg(long)]
    pub json: bool,
}

/// Runs the command.
pub async fn run(args: Args) -> Result<Exit, Failure> {
    let job = Client::connect(&args.server.server).await?.cancel(&args.name).await?;
    job_view::print_job(&job, args.json)?;
    Ok(Exit::Done)
}
