//! `scpsfm evaluate --priors`: what the search starts from, compared.

use std::path::Path;

use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::json;

use super::evaluate;
use super::exit::{Exit, Failure};
use super::interrupt::Interrupt;
use super::print;
use crate::domain::StopToken;
use crate::evaluation::priors::{self, Plan, scenes, sweep, table};
use crate::evaluation::records;
use crate::formats::publish::{create_directory, pretty, write_atomically};
use scpsfm_core::subspace;

/// The comparison of priors instead of the sweeps.
#[derive(Debug, Clone, clap::Args)]
#[command(next_help_heading = "Priors")]
pub struct PriorArgs {
    /// Compare priors instead: each alone (ranking, searches of 600, 6,000 and 60,000 samples), and AUTO with and
    /// without the trained network; scenes without depths, of training's kinds and of others. Writes priors.json, and
    /// priors.jsonl, with which it goes on where it was stopped
    #[arg(long, group = "suite",
        conflicts_with_all = ["quick", "real", "sweeps", "beyond", "ablation", "depths", "methods", "paper_width"])]
    pub priors: bool,

    /// AUTO alone, without the searches of each prior
    #[arg(long, requires = "priors")]
    pub auto_only: bool,

    /// Only the sweep over what a nat of the trained network's odds counts in the score of hypotheses, on other seeds
    /// than those of every comparison; writes sweep.json, and sweep.jsonl, with which it goes on
    #[arg(long, requires = "priors", conflicts_with = "auto_only")]
    pub sweep: bool,

    /// The scenes of this name, or all whose name holds this text [default: all]
    #[arg(long, value_name = "TEXT", requires = "suite", conflicts_with = "real")]
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
    let conditions = chosen(scenes::all(), |condition| condition.name, args.scenes.as_deref())?;
    create_directory(out)?;
    let work = Work { out, threads, quiet };
    if args.sweep {
        let runs = sweep::runs(&conditions, seeds);
        let records = work.run(sweep::RECORDS, &runs, sweep::measure, |records| {
            print(sweep::text(&sweep::rows(&conditions, seeds, records)).trim_end())
        })?;
        let rows = sweep::rows(&conditions, seeds, &records);
        let text = json!({ "seeds": seeds, "costs_per_nat": sweep::COSTS_PER_NAT, "rows": rows });
        let text = written(out, "sweep.json", text)?;
        print(if json { text.trim_end().to_owned() } else { sweep::text(&rows) }.trim_end())?;
        return Ok(Exit::Done);
    }
    let plan = Plan { conditions, seeds, each_prior: !args.auto_only };
    let records = work.run(priors::RECORDS, &plan.runs(), priors::measure, |records| {
        print(table::text(&plan.rows(records)).trim_end())
    })?;
    let rows = plan.rows(&records);
    let text = written(out, "priors.json", json!({ "seeds": seeds, "rows": rows }))?;
    print(if json { text.trim_end().to_owned() } else { table::text(&rows) }.trim_end())?;
    Ok(Exit::Done)
}

/// The conditions of this name, or all whose name holds this text.
pub fn chosen<T>(mut all: Vec<T>, name: fn(&T) -> &str, text: Option<&str>) -> Result<Vec<T>, Failure> {
    let Some(text) = text else { return Ok(all) };
    let names: Vec<&str> = all.iter().map(name).collect();
    let unknown = format!("--scenes {text}: no scenes have it in their name; there are {}", names.join("; "));
    let exact = names.contains(&text);
    all.retain(|condition| if exact { name(condition) == text } else { name(condition).contains(text) });
    if all.is_empty() { Err(Failure::usage(unknown)) } else { Ok(all) }
}

/// Where and how runs are done.
pub struct Work<'a> {
    pub out: &'a Path,
    pub threads: usize,
    pub quiet: bool,
}

impl Work<'_> {
    /// Does what the records of this name lack; where it was interrupted `so_far` shows what there is.
    pub fn run<R, M>(
        &self,
        name: &str,
        runs: &[R],
        measure: fn(&R, &StopToken) -> Result<Option<M>, String>,
        so_far: impl Fn(&records::Records<R, M>) -> Result<(), Failure>,
    ) -> Result<records::Records<R, M>, Failure>
    where
        R: Serialize + DeserializeOwned + Sync,
        M: Serialize + DeserializeOwned + Clone + Send,
    {
        let mut records: records::Records<R, M> = records::Records::open(self.out, name, &evaluate::build()?)?;
        let done = runs.iter().filter(|run| records.get(run).is_some()).count();
        let bar = evaluate::progress_bar(self.quiet, runs.len(), done);
        let stop = StopToken::default();
        let interrupt = Interrupt::listen()?;
        let relay = interrupt.stops(&stop);
        let outcome = tokio::task::block_in_place(|| {
            records.run(runs, self.threads, &stop, &|run| measure(run, &stop), &mut |_| bar.inc(1))
        });
        relay.abort();
        bar.finish_and_clear();
        outcome?;
        if stop.is_stopped() {
            so_far(&records)?;
            return Err(Failure::interrupted_with("interrupted; called again with the same --out it goes on"));
        }
        Ok(records)
    }
}

/// Writes rows with the version and the network that they are of; returns the JSON.
pub fn written(out: &Path, name: &str, mut rows: serde_json::Value) -> Result<String, Failure> {
    let network = subspace::current();
    rows["version"] = json!(env!("CARGO_PKG_VERSION"));
    rows["network"] = json!({ "origin": network.origin, "sha256": subspace::current_sha256().to_string() });
    let text = pretty(&rows)?;
    write_atomically(out, name, text.as_bytes())?;
    Ok(text)
}
