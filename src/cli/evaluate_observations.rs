//! `scpsfm evaluate --observations`: inputs that need verdicts on single observations.

use serde_json::json;

use super::evaluate_suite::{SuiteRunner, chosen};
use super::exit::{Exit, Failure};
use crate::evaluation::observations::{self, Plan, conditions, table};

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

/// Runs the command on the inputs of these names.
pub fn run(scenes: &[&str], seeds: u64, peer: Vec<String>, suite: &SuiteRunner) -> Result<Exit, Failure> {
    let plan =
        Plan { conditions: chosen(conditions::all(), |condition| condition.name.clone(), scenes, None)?, seeds, peer };
    suite.run(observations::RECORDS, &plan.runs(), observations::measure, "observations.json", |records| {
        let rows = plan.rows(records);
        (json!({ "seeds": plan.seeds, "peer": plan.peer, "rows": rows }), table::text(&rows))
    })
}
