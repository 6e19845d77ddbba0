//! `scpsfm evaluate --long`: the same motions at growing lengths.

use serde_json::json;

use super::evaluate_suite::{SuiteRunner, chosen};
use super::exit::{Exit, Failure};
use crate::evaluation::long::{self, Plan, RECORDS};
use crate::evaluation::observations;
use crate::synthetic::photographed::long::MOTIONS;

/// Seeds where none are asked for.
pub const SEEDS: u64 = 1;

/// Long sequences instead of the sweeps.
#[derive(Debug, Clone, clap::Args)]
#[command(next_help_heading = "Long sequences")]
pub struct LongArgs {
    /// Solve a drive, a corridor, an aerial grid and a walk around of 60, 120, 250 and 500 views, up to a million
    /// observations, instead of the sweeps, one after the other (ten minutes). A table shows how grade, error, time and
    /// memory go with the length. Writes long.json, and long.jsonl, with which it goes on where it was stopped.
    /// --scenes TEXTS takes the motions whose names hold one of the texts
    #[arg(long, group = "suite", conflicts_with_all = ["threads", "real", "quick", "sweeps", "beyond", "ablation",
        "depths", "methods", "paper_width"])]
    pub long: bool,
}

/// Runs the command on the motions whose names hold one of these texts.
///
/// # Errors
/// A text that no motion has in its name, as wrong usage; files that cannot be written, a defect of the solver.
pub fn run(scenes: &[&str], seeds: u64, suite: &SuiteRunner) -> Result<Exit, Failure> {
    let plan = Plan { motions: chosen(MOTIONS.to_vec(), |motion| motion.name().to_owned(), scenes, None)?, seeds };
    suite.run(RECORDS, &plan.runs(), observations::measure, "long.json", |records| {
        let rows = plan.rows(records);
        (json!({ "seeds": seeds, "rows": rows }), long::text(&rows))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_text_without_motions_names_those_that_there_are() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let suite = SuiteRunner { out: directory.path(), threads: 1, quiet: true, json: false };
        let failure = run(&["zeppelin"], 1, &suite).expect_err("no such motion");
        assert_eq!(failure.exit, Exit::Usage);
        assert!(
            failure.message.contains("--scenes zeppelin: no scenes have it in their name; there are drive; corridor"),
            "{failure}"
        );
    }
}
