//! `scpsfm result`: the result of a job.

use std::path::PathBuf;

use super::args::ServerArgs;
use super::client::Client;
use super::exit::{Exit, Failure};
use super::{job_view, print, summary};
use crate::domain::job::JobName;
use crate::formats::result_files;

const EXAMPLES: &str = "\
Examples:
  scpsfm result tenants/default/jobs/a1b2 --out answer
  scpsfm result a1b2 --json | jq .focal_px";

/// Read the result of a job
///
/// Writes the files that `scpsfm solve` writes; views, tracks and observations have the numbers that they had in the
/// job's input, counted from 0.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES, after_long_help = format!("{EXAMPLES}\n\n{}", super::exit::HELP))]
pub struct Args {
    /// The job's name, or the last part of it
    #[arg(value_name = "NAME", value_parser = job_view::parse_name)]
    pub name: JobName,

    #[command(flatten)]
    pub server: ServerArgs,

    /// Directory for the result files; created, files of these names in it are replaced
    #[arg(long, value_name = "DIR", required_unless_present = "json")]
    pub out: Option<PathBuf>,

    /// Print what result.json holds on stdout, instead of words
    #[arg(long)]
    pub json: bool,
}

/// Runs the command.
pub async fn run(args: Args) -> Result<Exit, Failure> {
    let solution = Client::connect(&args.server.server).await?.read_result(&args.name).await?;
    if let Some(out) = &args.out {
        result_files::write(out, &solution, None)?;
    }
    if args.json {
        print(result_files::result_json(&solution)?.trim_end())?;
    } else {
        print(&summary::text(&solution))?;
        if let Some(out) = &args.out {
            print(&format!("  files        {}", out.display()))?;
        }
    }
    Ok(Exit::of(&solution))
}
