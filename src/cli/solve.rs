//! `scpsfm solve`: one input, start to end, in process or through a server.

use std::path::PathBuf;

use super::access::AccessArgs;
use super::args::ServerArgs;
use super::exit::{Exit, Failure};
use super::export_args::ExportArgs;
use super::input_args::{InputArgs, tell_notes};
use super::interrupt::Interrupt;
use super::job_view::Lost;
use super::next_steps::Files;
use super::prior_file::PriorFileArgs;
use super::progress::ProgressView;
use super::settings_args::SettingsArgs;
use super::shell::quoted;
use super::windows::{self, Show, WindowArgs};
use super::{job_view, print, remote, summary};
use crate::client::ErrorKind;
use crate::domain::job::JobEvent;
use crate::domain::{Limits, Solution, SolveSettings, StopToken};
use crate::formats::publish::create_directory;
use crate::formats::{LabelledInput, result_files};
use crate::parallel::Threads;
use crate::solver;

/// More threads than any machine has cores for one solve: a slip of the finger.
const MOST_THREADS: i64 = 1_024;

const EXAMPLES: &str = "\
Examples:
  scpsfm solve observations.csv --width 3072 --height 2048 --out answer
  scpsfm solve observations.csv --out answer --json | jq .focal_px
  scpsfm solve observations.csv --out answer --server http://127.0.0.1:50051
  scpsfm solve database.db --out answer --export colmap-db,colmap   # COLMAP's mapper goes on from either
  scpsfm solve tracks.csv --width 3072 --height 2048 --out answer
  scpsfm solve kitti.csv --width 1242 --height 375 --window 11 --out windows   # the paper's KITTI protocol

Files in the output directory: result.json (the summary), tracks.csv, observations.csv (every answer under the ids \
of the input), cameras.json, points.ply (where there are several parts: of the largest; points-part-1.ply and on hold \
the others), report.html (open it in a browser), and where there are such points-two-view.ply (consistent tracks of \
two views) and second-structures.json (bodies that move by themselves).";

/// Solve one input
///
/// In this process by default, through a server with --server; the files are the same. Shows progress on stderr and the
/// result in words on stdout.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES, after_long_help = format!("{EXAMPLES}\n\n{}", super::exit::HELP))]
pub struct Args {
    #[command(flatten)]
    pub input: InputArgs,

    /// Solve on this server instead of in this process
    #[arg(long, value_name = "URL")]
    pub server: Option<String>,

    #[command(flatten)]
    pub access: AccessArgs,

    /// Directory for the result files; created, files of these names in it are replaced, and those of a former result
    /// go
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,

    /// Print what result.json holds on stdout, instead of words
    #[arg(long)]
    pub json: bool,

    /// Show no progress and no words
    #[arg(long, short)]
    pub quiet: bool,

    /// Threads to solve on, here and not with --server; with --window, windows at a time, one thread each. The answers
    /// are the same [default: one a core]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=MOST_THREADS), conflicts_with = "server")]
    pub threads: Option<u16>,

    #[command(flatten)]
    pub window: WindowArgs,

    #[command(flatten)]
    pub export: ExportArgs,

    #[command(flatten)]
    pub settings: SettingsArgs,

    #[command(flatten)]
    pub prior: PriorFileArgs,
}

/// Runs the command.
pub async fn run(args: Args) -> Result<Exit, Failure> {
    if args.server.is_none() && args.access.is_given() {
        return Err(Failure::usage("flags on the access to a server need --server"));
    }
    if args.server.is_some() && args.prior.prior.is_some() {
        return Err(Failure::usage("--prior: the server asks its own network, see `scpsfm serve --prior`"));
    }
    args.prior.install()?;
    let settings = args.settings.settings()?;
    let input = args.input.read()?;
    if !args.quiet {
        tell_notes(&input);
    }
    // Found out now rather than after the work.
    let view_table = args.input.reading.view_table.as_deref();
    args.export.check(&args.out, &args.input.input, view_table, input.format)?;
    create_directory(&args.out)?;
    let threads = args.threads.map_or_else(Threads::one_a_core, |count| Threads::new(count.into()));
    if let Some(length) = args.window.window {
        let show = Show { json: args.json, quiet: args.quiet };
        return windows::run(&args.window, length, threads, &input, &settings, &args.out, show);
    }
    let mut progress = ProgressView::new(args.quiet);
    let solution = match &args.server {
        Some(server) => on_server(server, &args, &input, &settings, &mut progress).await?,
        None => in_process(threads, &input, &settings, &mut progress)?,
    };
    progress.finish();
    deliver(&args, &solution, &input)
}

/// Solves here; Ctrl-C stops it within 50 ms or one network iteration.
fn in_process(
    threads: Threads,
    input: &LabelledInput,
    settings: &SolveSettings,
    progress: &mut ProgressView,
) -> Result<Solution, Failure> {
    let checked = input.check(&Limits::default())?;
    let stop = StopToken::default();
    let interrupt = Interrupt::listen()?;
    let relay = interrupt.stops(&stop);
    let outcome = tokio::task::block_in_place(|| solver::solve_on(threads, &checked, settings, progress, &stop));
    relay.abort();
    outcome.map_err(|error| match error {
        solver::Error::Stopped(_) => Failure::interrupted(),
        solver::Error::Internal(_) => Failure::internal(error),
    })
}

/// Solves on a server; Ctrl-C cancels the job there. Where the server is lost, the failure says how to find the job
/// again.
async fn on_server(
    server: &str,
    args: &Args,
    input: &LabelledInput,
    settings: &SolveSettings,
    progress: &mut ProgressView,
) -> Result<Solution, Failure> {
    let server = ServerArgs { server: server.to_owned(), access: args.access.clone() };
    let interrupt = Interrupt::listen()?;
    let mut seen = None;
    let mut on_event = |event: &JobEvent| {
        seen.get_or_insert_with(|| event.job.clone());
        job_view::show_event(progress, event);
    };
    let outcome = server.connect().await?.solve(input, settings, &mut on_event, interrupt.token()).await;
    outcome.map_err(|error| match (error.kind, seen) {
        (ErrorKind::Cancelled, _) if interrupt.token().is_cancelled() => Failure::interrupted(),
        (ErrorKind::Unavailable, Some(name)) => {
            let files = format!(
                " --out {} --input {}{}",
                quoted(&args.out.to_string_lossy()),
                quoted(&args.input.input.to_string_lossy()),
                args.input.reading.flags()
            );
            job_view::lost(error, &Lost { name: &name, server: &server, after: 0, files: &files })
        }
        _ => remote::at_lines(error, input),
    })
}

/// Writes the files and tells what they hold.
fn deliver(args: &Args, solution: &Solution, input: &LabelledInput) -> Result<Exit, Failure> {
    let exports = args.export.write(&args.out, solution, Some(input))?;
    if args.json {
        print(result_files::result_json(solution, Some(input))?.trim_end())?;
    } else if !args.quiet {
        let files = Files { directory: &args.out, exports: &exports, format: input.format };
        print(&summary::text_with_files(solution, Some(input), &files))?;
    }
    Ok(Exit::of(solution))
}
