//! `scpsfm result`: the result of a job.

use std::path::PathBuf;

use super::args::ServerArgs;
use super::exit::{Exit, Failure};
use super::export_args::ExportArgs;
use super::input_args::ReadingArgs;
use super::job_view::GivenName;
use super::next_steps::Files;
use super::{print, summary};
use crate::domain::{Solution, counted};
use crate::formats::{LabelledInput, result_files};

const EXAMPLES: &str = "\
Examples:
  scpsfm result tenants/default/jobs/a1b2 --out answer --input tracks.csv --width 3072 --height 2048
  scpsfm result a1b2 --json | jq .focal_px";

/// Read the result of a job
///
/// With `--input`, writes the very files that `scpsfm solve` writes. Without it, observations.csv and the report's
/// picture of the tracks are left out, and views and tracks are numbered from 0 as in the job's input.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES, after_long_help = format!("{EXAMPLES}\n\n{}", super::exit::HELP))]
pub struct Args {
    /// The job's name, or the last part of it
    #[arg(value_name = "NAME", value_parser = GivenName::parse)]
    pub name: GivenName,

    #[command(flatten)]
    pub server: ServerArgs,

    /// The file that the job was submitted with, for its ids and the files that need its points. What the submission
    /// said of it is needed again: --width, --height, --format, --matches, --focal-px, --focal-sigma, --view-table
    #[arg(long, value_name = "INPUT", requires = "out")]
    pub input: Option<PathBuf>,

    #[command(flatten)]
    pub reading: ReadingArgs,

    #[command(flatten)]
    pub export: ExportArgs,

    /// Directory for the result files; created, files of these names in it are replaced, and those of a former result
    /// go. Required without --json
    #[arg(long, value_name = "DIR", required_unless_present = "json")]
    pub out: Option<PathBuf>,

    /// Print what result.json holds on stdout, instead of words
    #[arg(long)]
    pub json: bool,

    /// Show no words
    #[arg(long, short)]
    pub quiet: bool,
}

/// Runs the command.
pub async fn run(args: Args) -> Result<Exit, Failure> {
    let input = args.input.as_deref().map(|path| args.reading.read(path)).transpose()?;
    if input.is_none() && !args.export.export.is_empty() {
        return Err(Failure::usage("--export needs --input, whose points and names it writes"));
    }
    let reading = args.reading.flags();
    if input.is_none() && !reading.is_empty() {
        return Err(Failure::usage(format_args!(
            "{} says how to read --input, which is not given",
            reading.trim_start()
        )));
    }
    if let (Some(out), Some(path), Some(input)) = (&args.out, &args.input, &input) {
        args.export.check(out, path, args.reading.view_table.as_deref(), input.format)?;
    }
    let name = args.name.of(&args.server.access)?;
    let solution = args.server.connect().await?.read_result(&name).await?;
    if let Some(input) = &input {
        belongs_together(input, &solution)?;
    }
    let exports = match &args.out {
        Some(out) => args.export.write(out, &solution, input.as_ref())?,
        None => Vec::new(),
    };
    if args.json {
        print(result_files::result_json(&solution, input.as_ref())?.trim_end())?;
    } else if let Some(out) = args.out.as_deref().filter(|_| !args.quiet) {
        let format = input.as_ref().and_then(|input| input.format);
        let files = Files { directory: out, exports: &exports, format };
        print(&summary::text_with_files(&solution, input.as_ref(), &files))?;
    }
    Ok(Exit::of(&solution))
}

/// What of the views' names differs from those of the job's input.
fn other_names(input: &LabelledInput, solution: &Solution) -> Option<String> {
    // Servers of older versions tell no names.
    let pairs = input
        .raw
        .views
        .iter()
        .zip(&solution.views)
        .filter_map(|(view, result)| Some((view, &result.name.as_ref()?[..])));
    let others: Vec<_> = pairs.filter(|(view, name)| view.name.as_deref() != Some(name)).collect();
    let &(view, name) = others.first()?;
    let here = view.name.as_deref().map_or_else(|| "no name".to_owned(), |name| format!("{name:?}"));
    let (others, views) = (others.len(), solution.views.len());
    Some(format!("{others} of {views} views have other names, the first {here} for {name:?}"))
}

/// Refuses a file that is not the job's input: its verdicts are listed by place alone.
fn belongs_together(input: &LabelledInput, solution: &Solution) -> Result<(), Failure> {
    let of_file = (input.raw.views.len(), input.raw.track_count, input.raw.x.len());
    let of_job = (solution.views.len(), solution.tracks.inlier.len(), solution.observations.inlier.len());
    if of_file != of_job {
        let words = |(views, tracks, observations)| {
            let (views, tracks) = (counted::<usize>(views, "view"), counted::<usize>(tracks, "track"));
            format!("{views}, {tracks} and {}", counted::<usize>(observations, "observation"))
        };
        let message = format!("the file has {}, the job's input had {}", words(of_file), words(of_job));
        return Err(Failure { exit: Exit::BadInput, message });
    }
    // Servers of older versions do not tell.
    if solution.input_content_sha256.is_none_or(|sha256| sha256 == input.raw.sha256()) {
        return Ok(());
    }
    let differs = other_names(input, solution).unwrap_or_else(|| {
        "its observations, their order, or what is known of its views (--width, --height, --focal-px, --focal-sigma, \
         --view-table) are others"
            .into()
    });
    let message = format!("the file is not the job's input: {differs}, and verdicts go by place");
    Err(Failure { exit: Exit::BadInput, message })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::formats::fixture;

    #[test]
    fn views_of_other_names_are_why_a_file_is_refused() {
        let (mut input, mut solution) = fixture::solved();
        assert_eq!(other_names(&input, &solution), None, "neither has names");
        input.raw.views[1].name = Some("a.jpg".into());
        assert_eq!(other_names(&input, &solution), None, "an older server tells none");
        solution.views[1].name = Some("a.jpg".into());
        assert_eq!(other_names(&input, &solution), None, "the same");
        solution.views[1].name = Some("b.jpg".into());
        solution.views[2].name = Some("c.jpg".into());
        let told = other_names(&input, &solution).expect("two");
        assert_eq!(told, "2 of 5 views have other names, the first \"a.jpg\" for \"b.jpg\"");
    }
}
