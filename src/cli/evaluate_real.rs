//! `scpsfm evaluate --real`: this program and another one on the same real sequences.

use std::path::PathBuf;
use std::time::Duration;

use serde_json::json;

use super::args::parse_within;
use super::evaluate_suite::{RunCounts, with_note};
use super::exit::{Exit, Failure};
use super::interrupt::Interrupt;
use super::print;
use super::progress::RunsView;
use crate::domain::StopToken;
use crate::evaluation::real::{self, Options, Row, Sequence, folder, page, table};
use crate::formats::publish::{create_directory, pretty, write_atomically};

/// What the files of a sequence must hold.
pub const FORMAT: &str = "\
A sequence folder of --real holds, with pixels as unit and (0, 0) the centre of the top-left one:
  observations.csv: view,track,x,y with whole numbers from 0 as ids
  meta.json: the image size as width and height (or image_width and image_height, or image_size: [width, height]) and \
K, the known calibration, 3x3 row by row or a list of such, one a view
  labels.csv: view,track,inlier (0 or 1), one line an observation; other columns are ignored
  cameras.json, where known: P, a list of 3x4 matrices, one a view, null where none is known; estimated, true where they \
were found from these tracks
Written to --out: real.json, real.csv and real.html.

A peer is called as COMMAND observations.csv WIDTH HEIGHT -o FILE and writes a JSON object: views (how many it \
registered, in one reconstruction), focal (pixels or null), inlier (0 or 1 for each track id from 0 on) or \
observation_inlier (the same for each line of its input), and where it has them sigma_log_focal, k1, reproj (mean) and rms in pixels, grade, warnings (texts), \
centres ([x, y, z] or null for each view).";

/// Real sequences instead of sweeps.
#[derive(Debug, Clone, clap::Args)]
#[command(next_help_heading = "Real sequences")]
pub struct RealArgs {
    /// Solve real sequences instead: a sequence folder, or a folder of such (see below); may be repeated
    #[arg(long, value_name = "DIR", group = "beside", conflicts_with_all = ["seeds", "quick", "threads", "sweeps", "beyond", "ablation",
        "depths", "methods", "paper_width"])]
    pub real: Vec<PathBuf>,

    /// Another program to run on the same sequences: one text, split at spaces, or one argument at a time, repeated
    #[arg(long, value_name = "COMMAND", requires = "beside", conflicts_with = "priors", allow_hyphen_values = true)]
    pub peer: Vec<String>,

    /// Seconds after which the peer is ended on a sequence
    #[arg(long, value_name = "SECONDS", requires = "peer", default_value_t = 600,
        value_parser = parse_within(1..=1_000_000))]
    pub peer_timeout: u64,
}

impl RealArgs {
    /// The peer's words: a single text is split at spaces.
    ///
    /// # Errors
    /// A text that names no program.
    pub fn peer_words(&self) -> Result<Vec<String>, Failure> {
        let words: Vec<String> = match self.peer.as_slice() {
            [one] => one.split_whitespace().map(str::to_owned).collect(),
            several => several.to_vec(),
        };
        if words.is_empty() && !self.peer.is_empty() {
            return Err(Failure::usage("--peer names no program"));
        }
        Ok(words)
    }
}

/// Runs the command; `out`, `json` and `quiet` are those of `evaluate`.
pub async fn run(args: &RealArgs, out: &std::path::Path, json: bool, quiet: bool) -> Result<Exit, Failure> {
    let peer = args.peer_words()?;
    // All of them are read before the first is solved: what is wrong is said at once.
    let folders = folder::find(&args.real)?;
    let sequences: Vec<Sequence> = folders.iter().map(|folder| Sequence::read(folder)).collect::<Result<_, _>>()?;
    create_directory(out)?;
    let program = std::env::current_exe()?;
    let options = Options { program, peer, peer_timeout: Duration::from_secs(args.peer_timeout) };
    let sides = if options.peer.is_empty() { 1 } else { 2 };
    let bar = RunsView::new(quiet, sides * sequences.len(), 0);
    let stop = StopToken::default();
    let interrupt = Interrupt::listen()?;
    let relay = interrupt.stops(&stop);
    let outcome = tokio::task::block_in_place(|| {
        real::run(
            &sequences,
            &options,
            &stop,
            &mut |sequence, side| bar.show(format!("{}: {}", sequence.name, side.name())),
            &mut |_| bar.finished(),
        )
    });
    relay.abort();
    bar.finish();
    let rows = outcome.map_err(Failure::internal)?;
    let counts = RunCounts { done: rows.len(), planned: sides * sequences.len() };
    let text = write(out, &rows, &options, counts)?;
    print(&if json { text.trim_end().to_owned() } else { with_note(table::text(&rows), counts.note()) })?;
    if stop.is_stopped() {
        return Err(Failure::interrupted_with("interrupted; the rows so far were written"));
    }
    Ok(Exit::Done)
}

/// Writes the three files; returns the JSON.
fn write(out: &std::path::Path, rows: &[Row], options: &Options, counts: RunCounts) -> Result<String, Failure> {
    let mut figures = json!({
        "version": env!("CARGO_PKG_VERSION"),
        "peer": (!options.peer.is_empty()).then_some(&options.peer),
        "rows": rows,
    });
    counts.add_to(&mut figures);
    let text = pretty(&figures)?;
    write_atomically(out, "real.json", text.as_bytes())?;
    write_atomically(out, "real.csv", table::csv(rows).as_bytes())?;
    write_atomically(out, "real.html", page::page(rows, &options.peer, counts.note().as_deref()).as_bytes())?;
    Ok(text)
}

impl From<real::Error> for Failure {
    fn from(error: real::Error) -> Self {
        Failure::bad_input(error)
    }
}
