//! `scpsfm evaluate --long`: the same motions at growing lengths.

use serde_json::json;

use super::evaluate_priors::{self, Work, chosen};
use super::exit::{Exit, Failure};
use super::print;
use crate::evaluation::long::{self, Plan, RECORDS};
use crate::evaluation::observations;
use crate::formats::publish::create_directory;
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
    /// --scenes TEXT takes the motions whose name holds the text
    #[arg(long, group = "suite", conflicts_with_all = ["threads", "real", "quick", "sweeps", "beyond", "ablation",
        "depths", "methods", "paper_width"])]
    pub long: bool,
}

/// Runs the command on the motions whose name holds this text.
///
/// # Errors
/// A text that no motion has in its name, as wrong usage; files that cannot be written, a defect of the solver.
pub fn run(scenes: Option<&str>, seeds: u64, work: &Work, json: bool) -> Result<Exit, Failure> {
    let plan = Plan { motions: chosen(MOTIONS.to_vec(), |motion| motion.name(), scenes)?, seeds };
    create_directory(work.out)?;
    let records = work.run(RECORDS, &plan.runs(), observations::measure, |records| {
        print(long::text(&plan.rows(records)).trim_end())
    })?;
    let rows = plan.rows(&records);
    let text = evaluate_priors::written(work.out, "long.json", json!({ "seeds": seeds, "rows": rows }))?;
    print(if json { text.trim_end().to_owned() } else { long::text(&rows) }.trim_end())?;
    Ok(Exit::Done)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_text_without_motions_names_those_that_there_are() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let work = Work { out: directory.path(), threads: 1, quiet: true };
        let failure = run(Some("zeppelin"), 1, &work, false).expect_err("no such motion");
        assert_eq!(failure.exit, Exit::Usage);
        assert!(
            failure.message.contains("--scenes zeppelin: no scenes have it in their name; there are drive; corridor"),
            "{failure}"
        );
    }
}
