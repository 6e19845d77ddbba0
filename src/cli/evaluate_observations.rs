//! `scpsfm evaluate --observations`: inputs that need verdicts on single observations.

use serde_json::json;

use super::evaluate_priors::{self, Work, chosen};
use super::exit::{Exit, Failure};
use super::print;
use crate::evaluation::observations::{self, Plan, conditions, table};
use crate::formats::publish::create_directory;

/// Wrong observations in right tracks instead of the sweeps.
#[derive(Debug, Clone, clap::Args)]
#[command(next_help_heading = "Observations")]
pub struct ObservationArgs {
    /// Solve inputs whose right tracks hold wrong observations, complete and with missing ones, without depths and
    /// with them, instead of the sweeps. Writes observations.json, and observations.jsonl, with which it goes on where
    /// it was stopped. With --peer another program is run on the same files
    #[arg(long, groups = ["suite", "beside"],
        conflicts_with_all = ["quick", "sweeps", "beyond", "ablation", "depths", "methods", "paper_width"])]
    pub observations: bool,
}

/// Runs the command on the inputs of this name.
pub fn run(scenes: Option<&str>, seeds: u64, peer: Vec<String>, work: &Work, json: bool) -> Result<Exit, Failure> {
    let plan = Plan { conditions: chosen(conditions::all(), |condition| &condition.name, scenes)?, seeds, peer };
    create_directory(work.out)?;
    let records = work.run(observations::RECORDS, &plan.runs(), observations::measure, |records| {
        print(table::text(&plan.rows(records)).trim_end())
    })?;
    let rows = plan.rows(&records);
    let text = json!({ "seeds": plan.seeds, "peer": plan.peer, "rows": rows });
    let text = evaluate_priors::written(work.out, "observations.json", text)?;
    print(if json { text.trim_end().to_owned() } else { table::text(&rows) }.trim_end())?;
    Ok(Exit::Done)
}
