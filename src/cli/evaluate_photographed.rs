//! `scpsfm evaluate --photographed`: scenes as people photograph them.

use std::ops::Range;

use serde_json::json;

use super::args::parse_within;
use super::evaluate_suite::{MOST_SEEDS, SuiteRunner, chosen};
use super::exit::{Exit, Failure};
use crate::evaluation::observations;
use crate::evaluation::photographed::{self, Plan, RECORDS, table};
use crate::synthetic::PhotographedOptions;

/// Seeds where none are asked for.
pub const SEEDS: u64 = 300;

/// Photographed scenes instead of the sweeps.
#[derive(Debug, Clone, clap::Args)]
#[command(next_help_heading = "Photographed scenes")]
pub struct PhotographedArgs {
    /// Solve scenes as people photograph them instead of the sweeps, one for each seed: ten motions, eight
    /// lenses, constant, drifting and two focal lengths, tracks of some views, and nothing or 10 to 70 % wrong in eight
    /// kinds. Tables by each of these, beside the Cramer-Rao bound of the scenes. Writes photographed.json, and
    /// photographed.jsonl, with which it goes on where it was stopped. With --peer another program is run on the
    /// scenes of one focal length. The name that --scenes looks at is
    /// motion/lens/focal-length/visibility/wrong, such as orbit/barrel/constant-focal/banded/static
    #[arg(long, groups = ["suite", "beside"],
        conflicts_with_all = ["quick", "sweeps", "beyond", "ablation", "depths", "methods", "paper_width"])]
    pub photographed: bool,
    /// First of the --seeds seeds. Use another one to check a result on scenes that the program was not tuned on
    #[arg(long, value_name = "SEED", default_value_t = photographed::FIRST_SEED, requires = "photographed",
        value_parser = parse_within(0..=u64::MAX - MOST_SEEDS))]
    pub first_seed: u64,
}

/// Runs the command on the scenes whose names hold one of these texts.
///
/// # Errors
/// A text that no scene has in its name, as wrong usage; files that cannot be written, a defect of the solver.
pub fn run(scenes: &[&str], seeds: Range<u64>, peer: Vec<String>, suite: &SuiteRunner) -> Result<Exit, Failure> {
    let (first, count) = (seeds.start, seeds.end - seeds.start);
    let words = photographed::words();
    let there_are =
        format!("those of {count} seeds (--seeds) from {first} on (--first-seed), whose names join with / {words}");
    let all = photographed::scenes(seeds);
    let plan = Plan { scenes: chosen(all, PhotographedOptions::name, scenes, Some(there_are))?, peer };
    suite.run(RECORDS, &plan.runs(), observations::measure, "photographed.json", |records| {
        let (scenes, peer, tables) = (plan.scenes.len(), &plan.peer, plan.tables(records));
        let json = json!({ "first_seed": first, "seeds": count, "scenes": scenes, "peer": peer, "tables": tables });
        (json, table::text(&tables))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_text_without_photographed_scenes_names_those_that_there_are() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let suite = SuiteRunner { out: directory.path(), threads: 1, quiet: true, json: false };
        let failure = run(&["orbit", "zeppelin"], 7..57, Vec::new(), &suite).expect_err("no such scene");
        assert_eq!(failure.exit, Exit::Usage);
        let known =
            ["--scenes zeppelin", "50 seeds", "from 7 on", "motion (orbit, walk-around", "action-camera", "wrong-link"];
        assert!(known.iter().all(|word| failure.message.contains(word)), "{failure}");
    }
}
