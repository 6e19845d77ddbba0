//! `scpsfm watch`: follows a job.

use super::args::{ServerArgs, parse_whole};
use super::exit::{Exit, Failure};
use super::job_view::{self, GivenName};

const EXAMPLES: &str = "\
Examples:
  scpsfm watch tenants/default/jobs/a1b2
  scpsfm watch a1b2 --json | jq .progress.focal_px
  scpsfm watch a1b2 --after 17 --json";

/// Follow a job to its end
///
/// Tells the job's events from the first, or from a sequence number, over broken connections. Ending this command does
/// not end the job.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES, after_long_help = format!("{EXAMPLES}\n\n{}", super::exit::HELP))]
pub struct Args {
    /// The job's name, or the last part of it
    #[arg(value_name = "NAME", value_parser = GivenName::parse)]
    pub name: GivenName,

    #[command(flatten)]
    pub server: ServerArgs,

    /// Begin after the event of this sequence number
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = parse_whole::<u64>)]
    pub after: u64,

    /// One event a line on stdout, as JSON, instead of progress
    #[arg(long)]
    pub json: bool,
}

/// Runs the command.
pub async fn run(args: Args) -> Result<Exit, Failure> {
    let name = args.name.of(&args.server.access)?;
    let mut client = args.server.connect().await?;
    job_view::watch_to_end(&mut client, &args.server, &name, args.after, args.json).await
}
