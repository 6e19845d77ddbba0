//! `scpsfm evaluate --priors`: what the search starts from, compared.

use std::path::Path;

use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::{Value, json};

use super::evaluate::{self, GOES_ON};
use super::exit::{Exit, Failure};
use super::interrupt::Interrupt;
use super::print;
use super::progress::RunsView;
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

    /// The scenes of these names, or all whose names hold these texts, separated by commas; a comma before a space is
    /// part of a name [default: all]
    #[arg(long, value_name = "TEXTS", requires = "suite", conflicts_with = "real")]
    pub scenes: Option<String>,
}

impl PriorArgs {
    /// The texts of `--scenes`: a comma before a space belongs to a name, such as `complete 0.5, K 1`.
    pub fn texts(&self) -> Vec<&str> {
        let mut texts = Vec::new();
        let mut rest = self.scenes.as_deref().unwrap_or_default();
        while let Some((at, _)) = rest.match_indices(',').find(|(at, _)| !rest[at + 1..].starts_with(' ')) {
            texts.push(&rest[..at]);
            rest = &rest[at + 1..];
        }
        texts.push(rest);
        texts.retain(|text| !text.is_empty());
        texts
    }
}

/// Runs the command.
pub fn run(args: &PriorArgs, seeds: u64, work: &Work) -> Result<Exit, Failure> {
    let conditions = chosen(scenes::all(), |condition| condition.name, &args.texts())?;
    if args.sweep {
        let runs = sweep::runs(&conditions, seeds);
        return work.run(sweep::RECORDS, &runs, sweep::measure, "sweep.json", |records| {
            let rows = sweep::rows(&conditions, seeds, records);
            let json = json!({ "seeds": seeds, "costs_per_nat": sweep::COSTS_PER_NAT, "rows": rows });
            (json, sweep::text(&rows))
        });
    }
    let plan = Plan { conditions, seeds, each_prior: !args.auto_only };
    work.run(priors::RECORDS, &plan.runs(), priors::measure, "priors.json", |records| {
        let rows = plan.rows(records);
        (json!({ "seeds": seeds, "rows": rows }), table::text(&rows))
    })
}

/// The conditions of these names, or all whose names hold these texts; without a text all.
pub fn chosen<T>(mut all: Vec<T>, name: fn(&T) -> &str, texts: &[&str]) -> Result<Vec<T>, Failure> {
    let names: Vec<&str> = all.iter().map(name).collect();
    let exact = |text: &str| names.contains(&text);
    let is_of = |name: &str, text: &str| if exact(text) { name == text } else { name.contains(text) };
    if let Some(text) = texts.iter().find(|text| !names.iter().any(|name| is_of(name, text))) {
        let there_are = names.join("; ");
        return Err(Failure::usage(format!("--scenes {text}: no scenes have it in their name; there are {there_are}")));
    }
    let wanted: Vec<bool> =
        names.iter().map(|name| texts.is_empty() || texts.iter().any(|text| is_of(name, text))).collect();
    let mut wanted = wanted.into_iter();
    all.retain(|_| wanted.next() == Some(true));
    Ok(all)
}

/// Where and how runs are done, and how they are shown.
pub struct Work<'a> {
    pub out: &'a Path,
    pub threads: usize,
    pub quiet: bool,
    /// Figures on stdout as JSON, not as a table.
    pub json: bool,
}

impl Work<'_> {
    /// Does what the records of this name lack, and writes and prints the figures of all that is recorded.
    ///
    /// * `file`: that of the figures
    /// * `figures`: as JSON and as a table
    ///
    /// # Errors
    /// Files that cannot be read or written, a defect of the solver; interrupted, after the figures so far were given.
    pub fn run<R, M>(
        &self,
        name: &str,
        runs: &[R],
        measure: fn(&R, &StopToken) -> Result<Option<M>, String>,
        file: &str,
        figures: impl FnOnce(&records::Records<R, M>) -> (Value, String),
    ) -> Result<Exit, Failure>
    where
        R: Serialize + DeserializeOwned + Sync,
        M: Serialize + DeserializeOwned + Clone + Send,
    {
        create_directory(self.out)?;
        let mut records: records::Records<R, M> = records::Records::open(self.out, name, &evaluate::build()?)?;
        let done = runs.iter().filter(|run| records.get(run).is_some()).count();
        let bar = RunsView::new(self.quiet, runs.len(), done);
        let stop = StopToken::default();
        let interrupt = Interrupt::listen()?;
        let relay = interrupt.stops(&stop);
        let outcome = tokio::task::block_in_place(|| {
            records.run(runs, self.threads, &stop, &|run| measure(run, &stop), &mut |_| bar.finished())
        });
        relay.abort();
        bar.finish();
        outcome?;
        let (json, table) = figures(&records);
        let json = written(self.out, file, json)?;
        print(if self.json { &json } else { &table }.trim_end())?;
        if stop.is_stopped() {
            return Err(Failure::interrupted_with(GOES_ON));
        }
        Ok(Exit::Done)
    }
}

/// Writes rows with the version and the network that they are of; returns the JSON.
fn written(out: &Path, name: &str, mut rows: Value) -> Result<String, Failure> {
    let network = subspace::current();
    rows["version"] = json!(env!("CARGO_PKG_VERSION"));
    rows["network"] = json!({ "origin": network.origin, "sha256": subspace::current_sha256().to_string() });
    let text = pretty(&rows)?;
    write_atomically(out, name, text.as_bytes())?;
    Ok(text)
}
