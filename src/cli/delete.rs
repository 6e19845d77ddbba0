//! `scpsfm delete`: removes jobs that have ended.

use super::args::ServerArgs;
use super::client::Client;
use super::exit::{Exit, Failure};
use super::{job_view, print};
use crate::domain::job::JobName;

const EXAMPLES: &str = "\
Examples:
  scpsfm delete a1b2 c3d4
  scpsfm list --state failed --json | jq -r .name | xargs scpsfm delete";

/// Delete jobs that have ended
///
/// Removes each with its input, events and result, for good, and prints its name. One that waits or runs is refused:
/// cancel it first. Stops at the first that cannot be deleted.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES, after_long_help = format!("{EXAMPLES}\n\n{}", super::exit::HELP))]
pub struct Args {
    /// The jobs' names, or the last parts of them
    #[arg(value_name = "JOB", required = true, value_parser = job_view::parse_name)]
    pub names: Vec<JobName>,

    #[command(flatten)]
    pub server: ServerArgs,
}

/// Runs the command.
pub async fn run(args: Args) -> Result<Exit, Failure> {
    let mut client = Client::connect(&args.server.server).await?;
    for name in &args.names {
        client.delete(name).await?;
        print(&name.to_string())?;
    }
    Ok(Exit::Done)
}
