//! `scpsfm delete`: removes jobs that have ended.

use super::args::ServerArgs;
use super::exit::{Exit, Failure};
use super::job_view::GivenName;
use super::print;

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
    #[arg(value_name = "JOB", required = true, value_parser = GivenName::parse)]
    pub names: Vec<GivenName>,

    #[command(flatten)]
    pub server: ServerArgs,
}

/// Runs the command.
pub async fn run(args: Args) -> Result<Exit, Failure> {
    // All of them are named before the first is gone.
    let names = args.names.iter().map(|name| name.of(&args.server.access)).collect::<Result<Vec<_>, _>>()?;
    let mut client = args.server.connect().await?;
    for name in names {
        client.delete(&name).await?;
        print(&name.to_string())?;
    }
    Ok(Exit::Done)
}
