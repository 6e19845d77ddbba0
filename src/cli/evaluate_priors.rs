//! `scpsfm evaluate --priors`: what the search starts from, compared.

use std::path::{Path, PathBuf};

use serde_json::json;

use super::evaluate;
use super::exit::{Exit, Failure};
use super::interrupt::Interrupt;
use super::print;
use crate::domain::StopToken;
use crate::evaluation::priors::{self, Condition, Plan, Records, scenes, sweep, table, windows};
use crate::evaluation::real::{Sequence, folder};
use crate::formats::result_files::{create_directory, pretty, write_atomically};
use crate::network::subspace;

/// The comparison of priors instead of the sweeps.
#[derive(Debug, Clone, clap::Args)]
#[command(next_help_heading = "Priors")]
pub struct PriorArgs {
    /// Compare priors instead: each alone (ranking, searches of 600, 6,000 and 60,000 samples), and AUTO with and
    /// without the trained network; scenes without depths, of training's kinds and of others. Writes priors.json, and
    /// priors.jsonl, with which it goes on where it was stopped. With --real: how well pairs of views, the trained network
    /// and both together rank the observations of these sequences, window by window; writes windows.json
    #[arg(long, conflicts_with_all = ["quick", "sweeps", "beyond", "ablation", "depths", "methods", "paper_width"])]
    pub priors: bool,

    /// AUTO alone, without the searches of each prior
    #[arg(long, requires = "priors", conflicts_with = "real")]
    pub auto_only: bool,

    /// Only the sweep over what a nat of the trained network's odds counts in the score of hypotheses, on other seeds than
    /// those of every comparison; writes nothing
    #[arg(long, requires = "priors", conflicts_with_all = ["auto_only", "real"])]
    pub sweep: bool,

    /// The scenes of this name, or all whose name holds this text [default: all]
    #[arg(long, value_name = "TEXT", requires = "priors", conflicts_with = "real")]
    pub scenes: Option<String>,
}

/// Runs the command.
pub async fn run(
    args: &PriorArgs,
    out: &Path,
    seeds: u64,
    threads: usize,
    json: bool,
    quiet: bool,
) -> Result<Exit, Failure> {
    let mut conditions = scenes::all();
    if let Some(text) = &args.scenes {
        let names: Vec<&str> = conditions.iter().map(|condition| condition.name).collect();
        let unknown = format!("--scenes {text}: no scenes have it in their name; there are {}", names.join("; "));
        let exact = names.contains(&text.as_str());
        conditions.retain(
            |condition| {
                if exact { condition.name == text } else { condition.name.contains(text.as_str()) }
            },
        );
        if conditions.is_empty() {
            return Err(Failure::usage(unknown));
        }
    }
    if args.sweep {
        return sweep(&conditions, seeds, json, quiet);
    }
    let plan = Plan { conditions, seeds, each_prior: !args.auto_only };
    create_directory(out)?;
    let mut records = Records::open(out, priors::RECORDS, &evaluate::build()?)?;
    let runs = plan.runs();
    let done = runs.iter().filter(|run| records.get(run).is_some()).count();
    let bar = evaluate::progress_bar(quiet, runs.len(), done);
    let stop = StopToken::default();
    let interrupt = Interrupt::listen()?;
    let relay = interrupt.stops(&stop);
    let outcome = tokio::task::block_in_place(|| {
        records.run(&runs, threads, &stop, &|run| priors::measure(run, &stop), &mut |_| bar.inc(1))
    });
    relay.abort();
    bar.finish_and_clear();
    outcome?;
    let rows = plan.rows(&records);
    let text = written(out, "priors.json", json!({ "seeds": seeds, "rows": rows }))?;
    print(if json { text.trim_end().to_owned() } else { table::text(&rows) }.trim_end())?;
    if stop.is_stopped() {
        return Err(Failure::interrupted_with("interrupted; called again with the same --out it goes on"));
    }
    Ok(Exit::Done)
}

/// `--sweep`.
fn sweep(conditions: &[Condition], seeds: u64, json: bool, quiet: bool) -> Result<Exit, Failure> {
    let bar = evaluate::progress_bar(quiet, conditions.len() * seeds as usize, 0);
    let stop = StopToken::default();
    let interrupt = Interrupt::listen()?;
    let relay = interrupt.stops(&stop);
    let outcome = tokio::task::block_in_place(|| sweep::run(conditions, seeds, &stop, &mut || bar.inc(1)));
    relay.abort();
    bar.finish_and_clear();
    let rows = outcome.map_err(Failure::internal)?;
    let text = match json {
        true => pretty(&json!({ "costs_per_nat": sweep::COSTS_PER_NAT, "rows": rows }))?,
        false => sweep::text(&rows),
    };
    print(text.trim_end())?;
    if stop.is_stopped() {
        return Err(Failure::interrupted_with("interrupted; the rows are of the scenes so far"));
    }
    Ok(Exit::Done)
}

/// Runs the command with `--real`.
pub async fn run_on_windows(directories: &[PathBuf], out: &Path, json: bool, quiet: bool) -> Result<Exit, Failure> {
    let folders = folder::find(directories)?;
    let sequences: Vec<Sequence> = folders.iter().map(|folder| Sequence::read(folder)).collect::<Result<_, _>>()?;
    create_directory(out)?;
    let bar = evaluate::progress_bar(quiet, sequences.len(), 0);
    let stop = StopToken::default();
    let interrupt = Interrupt::listen()?;
    let relay = interrupt.stops(&stop);
    let outcome = tokio::task::block_in_place(|| windows::rows(&sequences, &stop, &mut || bar.inc(1)));
    relay.abort();
    bar.finish_and_clear();
    let rows = outcome.map_err(Failure::bad_input)?;
    if stop.is_stopped() {
        print(windows::text(&rows).trim_end())?;
        return Err(Failure::interrupted_with("interrupted; the rows so far were not written"));
    }
    let text = written(out, "windows.json", json!({ "rows": rows }))?;
    print(if json { text.trim_end().to_owned() } else { windows::text(&rows) }.trim_end())?;
    Ok(Exit::Done)
}

/// Writes rows with the version and the network that they are of; returns the JSON.
fn written(out: &Path, name: &str, mut rows: serde_json::Value) -> Result<String, Failure> {
    let network = subspace::current();
    rows["version"] = json!(env!("CARGO_PKG_VERSION"));
    rows["network"] = json!({ "origin": network.origin, "sha256": network.checksum() });
    let text = pretty(&rows)?;
    write_atomically(out, name, text.as_bytes())?;
    Ok(text)
}
