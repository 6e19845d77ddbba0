//! What a nat of the trained network's odds is worth in the score of hypotheses: the sweep that the solver's constant
//! comes from. Its scenes are none of the comparison's.

use serde::{Deserialize, Serialize};

use super::Condition;
use crate::domain::{Input, Limits, StopToken};
use crate::evaluation::records;
use crate::synthetic::metrics::average_precision;
use crate::synthetic::{Scene, SceneOptions};
use scpsfm_core::evaluation::proposal::Study;

/// Costs that are tried, in units of the truncated cost of a track at even odds; 0: the network only draws the samples.
pub const COSTS_PER_NAT: [f64; 7] = [0.0, 0.05, 0.1, 0.15, 0.2, 0.3, 0.5];
/// Samples of a search: few, so that the score has to tell good hypotheses from others.
const SAMPLES: usize = 600;
/// First seed, below those of every comparison.
const FIRST_SEED: u64 = 7_000;

/// The file of the records.
pub const RECORDS: &str = "sweep.jsonl";

/// The records of the sweep: average precision of the best hypothesis's ranking of the tracks, in the order of
/// [`COSTS_PER_NAT`], where a scene has right tracks.
pub type Records = records::Records<Run, Vec<Option<f64>>>;

/// One scene under every cost.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Run {
    scene: SceneOptions,
}

/// One condition.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    pub condition: &'static str,
    pub seeds: usize,
    /// Means over the seeds, in the order of [`COSTS_PER_NAT`].
    pub average_precision: Vec<f64>,
}

/// Every scene, seed by seed.
pub fn runs(conditions: &[Condition], seeds: u64) -> Vec<Run> {
    (0..seeds).flat_map(|seed| conditions.iter().map(move |condition| run(condition, seed))).collect()
}

fn run(condition: &Condition, seed: u64) -> Run {
    Run { scene: condition.scene(FIRST_SEED + seed) }
}

/// One scene; `None` where it was stopped.
///
/// # Errors
/// A scene that cannot be made, in words.
pub fn measure(run: &Run, stop: &StopToken) -> Result<Option<Vec<Option<f64>>>, String> {
    let scene = Scene::generate(&run.scene).map_err(|error| error.to_string())?;
    let input = Input::new(scene.input, &Limits::default(), "scene").map_err(|error| error.to_string())?;
    let study = Study::new(&input, stop);
    let precision = |per_nat| {
        let ranking = study.best_under(per_nat, SAMPLES, run.scene.seed)?;
        average_precision(&ranking, &scene.truth.inlier)
    };
    let precisions = COSTS_PER_NAT.into_iter().map(precision).collect();
    Ok((!stop.is_stopped()).then_some(precisions))
}

/// A row for each condition with right tracks to rank, of what is recorded.
pub fn rows(conditions: &[Condition], seeds: u64, records: &Records) -> Vec<Row> {
    let row = |condition: &Condition| {
        let of_seed = |seed| records.get(&run(condition, seed))?.iter().copied().collect::<Option<Vec<f64>>>();
        let all: Vec<Vec<f64>> = (0..seeds).filter_map(of_seed).collect();
        let mean = |k: usize| all.iter().map(|of_scene| of_scene[k]).sum::<f64>() / all.len() as f64;
        let average_precision = (0..COSTS_PER_NAT.len()).map(mean).collect();
        (!all.is_empty()).then_some(Row { condition: condition.name, seeds: all.len(), average_precision })
    };
    conditions.iter().filter_map(row).collect()
}

/// The rows in words.
pub fn text(rows: &[Row]) -> String {
    let mut lines = vec![format!("{:<18}{:>5}", "AP by cost a nat", "n")];
    for cost in COSTS_PER_NAT {
        lines[0] += &format!("{cost:>8}");
    }
    for row in rows {
        let mut line = format!("{:<18}{:>5}", row.condition, row.seeds);
        row.average_precision.iter().for_each(|value| line += &format!("{value:>8.4}"));
        lines.push(line);
    }
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::priors::scenes;

    #[test]
    fn a_sweep_ranks_scenes_with_right_tracks_and_leaves_out_those_without() {
        let few = |name: &str| scenes::all().into_iter().find(|condition| condition.name == name).expect("a condition");
        let conditions = [few("outliers .9"), few("all wrong")];
        let directory = tempfile::tempdir().expect("a temporary directory");
        let mut records = Records::open(directory.path(), RECORDS, "a build").expect("a writable directory");
        let stop = StopToken::default();
        let mut scenes = 0;
        let told = &mut |_: &Run| scenes += 1;
        records.run(&runs(&conditions, 1), 2, &stop, &|run| measure(run, &stop), told).expect("runs");
        let rows = rows(&conditions, 1, &records);
        assert_eq!((rows.len(), scenes, rows[0].condition), (1, 2, "outliers .9"));
        assert!(rows[0].average_precision.iter().all(|value| (0.5..=1.0).contains(value)), "{rows:?}");
        assert_eq!(text(&rows).lines().count(), 2);
    }
}
