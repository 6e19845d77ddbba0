//! `scpsfm evaluate --photographed`: scenes as people photograph them.

use serde_json::json;

use super::evaluate_priors::{self, Work};
use super::exit::{Exit, Failure};
use super::print;
use crate::evaluation::observations;
use crate::evaluation::photographed::{Plan, RECORDS, table};
use crate::formats::publish::create_directory;

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
    /// scenes of one focal length. The name that --scenes TEXT looks at is
    /// motion/lens/focal-length/visibility/wrong, such as orbit/barrel/constant-focal/banded/static
    #[arg(long, groups = ["suite", "beside"],
        conflicts_with_all = ["quick", "sweeps", "beyond", "ablation", "depths", "methods", "paper_width"])]
    pub photographed: bool,
}

/// Runs the command on the scenes whose name holds this text.
///
/// # Errors
/// A text that no scene has in its name, as wrong usage; files that cannot be written, a defect of the solver.
pub fn run(scenes: Option<&str>, seeds: u64, peer: Vec<String>, work: &Work, json: bool) -> Result<Exit, Failure> {
    let plan = Plan::new(seeds, scenes, peer);
    if plan.scene_count() == 0 {
        let text = scenes.unwrap_or_default();
        return Err(Failure::usage(format!(
            "--scenes {text}: none of the {seeds} scenes has it in its name; names are \
             motion/lens/focal-length/visibility/wrong, such as {}",
            Plan::new(1, None, Vec::new()).names().join(", ")
        )));
    }
    create_directory(work.out)?;
    let records = work.run(RECORDS, &plan.runs(), observations::measure, |records| {
        print(table::text(&plan.tables(records)).trim_end())
    })?;
    let tables = plan.tables(&records);
    let text = json!({ "seeds": seeds, "scenes": plan.scene_count(), "peer": plan.peer, "tables": tables });
    let text = evaluate_priors::written(work.out, "photographed.json", text)?;
    print(if json { text.trim_end().to_owned() } else { table::text(&tables) }.trim_end())?;
    Ok(Exit::Done)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_text_without_photographed_scenes_names_the_flag() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let work = Work { out: directory.path(), threads: 1, quiet: true };
        let failure = run(Some("zeppelin"), 5, Vec::new(), &work, false).expect_err("no such scene");
        assert_eq!(failure.exit, Exit::Usage);
        assert!(failure.message.contains("--scenes zeppelin"), "{failure}");
    }
}
