//! `scpsfm evaluate --photographed`: scenes as people photograph them.

use serde_json::json;

use super::evaluate_suite::SuiteRunner;
use super::exit::{Exit, Failure};
use crate::evaluation::observations;
use crate::evaluation::photographed::{Plan, RECORDS, table};

/// Seeds where none are asked for.
pub const SEEDS: u64 = 300;

/// Photographed scenes instead of the sweeps.
#[derive(Debug, Clone, clap::Args)]
#[command(next_help_heading = "Photographed scenes")]
pub struct PhotographedArgs {
    /// Solve scenes as people photograph them instead of the sweeps, one for each of 300 seeds: ten motions, eight
    /// lenses, constant, drifting and two focal lengths, tracks of some views, and nothing or 10 to 70 % wrong in eight
    /// kinds. Tables by each of these, beside the Cramer-Rao bound of the scenes. Writes photographed.json, and
    /// photographed.jsonl, with which it goes on where it was stopped. With --peer another program is run on the
    /// scenes of one focal length. The name that --scenes looks at is
    /// motion/lens/focal-length/visibility/wrong, such as orbit/barrel/constant-focal/banded/static
    #[arg(long, groups = ["suite", "beside"],
        conflicts_with_all = ["quick", "sweeps", "beyond", "ablation", "depths", "methods", "paper_width"])]
    pub photographed: bool,
}

/// Runs the command on the scenes whose names hold one of these texts.
///
/// # Errors
/// A text that no scene has in its name, as wrong usage; files that cannot be written, a defect of the solver.
pub fn run(scenes: &[&str], seeds: u64, peer: Vec<String>, suite: &SuiteRunner) -> Result<Exit, Failure> {
    let plan = Plan::new(seeds, scenes, peer);
    let names = plan.names();
    if let Some(text) = scenes.iter().find(|text| !names.iter().any(|name| name.contains(**text))) {
        return Err(Failure::usage(format!(
            "--scenes {text}: none of the {seeds} scenes has it in its name; names are \
             motion/lens/focal-length/visibility/wrong, such as {}",
            Plan::new(1, &[], Vec::new()).names().join(", ")
        )));
    }
    suite.run(
        RECORDS,
        &plan.runs(),
        observations::measure,
        |_| String::new(),
        "photographed.json",
        |records| {
            let tables = plan.tables(records);
            let json = json!({ "seeds": seeds, "scenes": names.len(), "peer": plan.peer, "tables": tables });
            Ok((json, table::text(&tables)))
        },
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_text_without_photographed_scenes_names_the_flag() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let suite = SuiteRunner { out: directory.path(), threads: 1, quiet: true, json: false };
        let failure = run(&["orbit", "zeppelin"], 50, Vec::new(), &suite).expect_err("no such scene");
        assert_eq!(failure.exit, Exit::Usage);
        assert!(failure.message.contains("--scenes zeppelin"), "{failure}");
    }
}
