//! What a nat of the trained network's odds is worth in the score of hypotheses: the sweep that the solver's constant comes
//! from. Its scenes are none of the comparison's.

use serde::Serialize;

use super::Condition;
use crate::domain::{Input, Limits, StopToken};
use crate::solver::study::Study;
use crate::synthetic::Scene;
use crate::synthetic::metrics::average_precision;

/// Costs that are tried, in units of the truncated cost of a track at even odds; 0: the network only draws the samples.
pub const COSTS_PER_NAT: [f64; 7] = [0.0, 0.05, 0.1, 0.15, 0.2, 0.3, 0.5];
/// Samples of a search: few, so that the score has to tell good hypotheses from others.
const SAMPLES: usize = 600;
/// First seed, below those of every comparison.
const FIRST_SEED: u64 = 7_000;

/// One condition.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    pub condition: &'static str,
    pub seeds: u64,
    /// Mean average precision of the best hypothesis's ranking of the tracks, in the order of [`COSTS_PER_NAT`].
    pub average_precision: Vec<f64>,
}

/// Sweeps the conditions that have right tracks to rank; a stopped sweep leaves out what was not reached. `told` hears of
/// every scene.
///
/// # Errors
/// A scene that cannot be made, in words.
pub fn run(conditions: &[Condition], seeds: u64, stop: &StopToken, told: &mut dyn FnMut()) -> Result<Vec<Row>, String> {
    let mut rows = Vec::new();
    for condition in conditions {
        let mut totals = vec![(0.0, 0usize); COSTS_PER_NAT.len()];
        for seed in FIRST_SEED..FIRST_SEED + seeds {
            let scene = Scene::generate(&condition.scene(seed)).map_err(|error| error.to_string())?;
            let input = Input::new(scene.input, &Limits::default(), "scene").map_err(|error| error.to_string())?;
            let study = Study::new(&input, stop);
            for (per_nat, (sum, count)) in COSTS_PER_NAT.into_iter().zip(&mut totals) {
                let ranking = study.best_under(per_nat, SAMPLES, seed);
                if let Some(precision) = ranking.and_then(|ranking| average_precision(&ranking, &scene.truth.inlier)) {
                    *sum += precision;
                    *count += 1;
                }
            }
            if stop.is_stopped() {
                return Ok(rows);
            }
            told();
        }
        if totals.iter().all(|(_, count)| *count > 0) {
            let average_precision = totals.into_iter().map(|(sum, count)| sum / count as f64).collect();
            rows.push(Row { condition: condition.name, seeds, average_precision });
        }
    }
    Ok(rows)
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
        let mut scenes = 0;
        let rows = run(&[few("outliers .9"), few("all wrong")], 1, &StopToken::default(), &mut || scenes += 1);
        let rows = rows.expect("rows");
        assert_eq!((rows.len(), scenes, rows[0].condition), (1, 2, "outliers .9"));
        assert!(rows[0].average_precision.iter().all(|value| (0.5..=1.0).contains(value)), "{rows:?}");
        assert_eq!(text(&rows).lines().count(), 2);
    }
}
