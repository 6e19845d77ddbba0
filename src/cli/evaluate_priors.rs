//! `scpsfm evaluate --priors`: what the search starts from, compared.

use serde_json::json;

use super::evaluate_suite::{SuiteRunner, chosen};
use super::exit::{Exit, Failure};
use crate::evaluation::priors::{self, Plan, scenes, sweep, table};

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
}

/// Runs the command.
pub fn run(args: &PriorArgs, texts: &[&str], seeds: u64, suite: &SuiteRunner) -> Result<Exit, Failure> {
    let conditions = chosen(scenes::all(), |condition| condition.name.to_owned(), texts, None)?;
    if args.sweep {
        let runs = sweep::runs(&conditions, seeds);
        return suite.run(sweep::RECORDS, &runs, sweep::measure, "sweep.json", |records| {
            let rows = sweep::rows(&conditions, seeds, records);
            let json = json!({ "seeds": seeds, "costs_per_nat": sweep::COSTS_PER_NAT, "rows": rows });
            (json, sweep::text(&rows))
        });
    }
    let plan = Plan { conditions, seeds, each_prior: !args.auto_only };
    suite.run(priors::RECORDS, &plan.runs(), priors::measure, "priors.json", |records| {
        let rows = plan.rows(records);
        (json!({ "seeds": seeds, "rows": rows }), table::text(&rows))
    })
}
