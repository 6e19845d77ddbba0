//! `scpsfm list`: a server's jobs.

use clap::ValueEnum;
use clap::builder::PossibleValue;

use super::args::{PageArgs, ServerArgs};
use super::exit::{Exit, Failure};
use super::{job_view, print};
use crate::domain::job::JobState;

const EXAMPLES: &str = "\
Examples:
  scpsfm list
  scpsfm list --state queued,running
  scpsfm list --filter 'state = QUEUED OR state = RUNNING AND labels.site = \"north\"'
  scpsfm list --all --filter 'labels.site = \"north\"' --json | jq -r .name";

/// List jobs, the newest first
///
/// Prints one page, or all; where there are more, the token of the next page goes to stderr.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES, after_long_help = format!("{EXAMPLES}\n\n{}", super::exit::HELP))]
pub struct Args {
    #[command(flatten)]
    pub server: ServerArgs,

    /// Only jobs in one of these states, in lower or upper case; may be repeated
    #[arg(long = "state", value_enum, ignore_case = true, value_delimiter = ',')]
    pub states: Vec<JobState>,

    /// Only jobs that match, such as 'labels.site = "north"' or 'state = FAILED OR state = CANCELLED': terms joined by
    /// AND, states also by OR
    #[arg(long, default_value = "")]
    pub filter: String,

    #[command(flatten)]
    pub page: PageArgs,

    /// One job a line, as JSON
    #[arg(long)]
    pub json: bool,
}

impl ValueEnum for JobState {
    fn value_variants<'a>() -> &'a [Self] {
        &Self::ALL
    }

    fn to_possible_value(&self) -> Option<PossibleValue> {
        Some(match self {
            // With an underscore as it is printed.
            Self::DeadlineExceeded => PossibleValue::new("deadline-exceeded").alias("deadline_exceeded"),
            Self::Queued => PossibleValue::new("queued"),
            Self::Running => PossibleValue::new("running"),
            Self::Succeeded => PossibleValue::new("succeeded"),
            Self::Failed => PossibleValue::new("failed"),
            Self::Cancelled => PossibleValue::new("cancelled"),
        })
    }
}

/// Runs the command.
pub async fn run(mut args: Args) -> Result<Exit, Failure> {
    let mut client = args.server.connect().await?;
    loop {
        let page = client.list(&filter(&args), args.page.page_size, &args.page.page_token).await?;
        for job in &page.jobs {
            print(&if args.json { job_view::job_json(job).to_string() } else { job_view::job_line(job) })?;
        }
        if !args.page.next(page.next_page_token) {
            return Ok(Exit::Done);
        }
    }
}

/// States and filter together.
fn filter(args: &Args) -> String {
    let states: Vec<String> = args.states.iter().map(|state| format!("state = {}", state.name())).collect();
    let terms = [states.join(" OR "), args.filter.clone()];
    terms.into_iter().filter(|term| !term.trim().is_empty()).collect::<Vec<_>>().join(" AND ")
}
