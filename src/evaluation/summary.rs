//! Figures of a cell from its records, and what all of them together say of the grades.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::Serialize;

use super::plan::{Contestant, Depths, Plan, Run};
use super::runner::Records;
use crate::domain::Grade;
use crate::statistics::midpoint_median;
use crate::synthetic::{Motion, SceneOptions, Shape};
use scpsfm_core::evaluation::measures::Measures;

/// Resamples of a bootstrap interval, its seed, and the share on either side that it leaves out.
const RESAMPLES: usize = 2_000;
const BOOTSTRAP_SEED: u64 = 1;
const TAIL: f64 = 0.025;
/// Error of the focal length, as a logarithm, from which a METRIC answer is wrong.
const WRONG_FOCAL: f64 = 0.05;

/// F1 from which a scene counts as solved in an ablation.
const REACHED_F1: f64 = 0.98;

/// One contestant on one cell.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Cell {
    pub sweep: &'static str,
    pub x: f64,
    /// The same, as it is shown.
    pub place: String,
    pub depths: Depths,
    pub contestant: Contestant,
    /// Seeds recorded.
    pub seeds: usize,
    pub mean_f1: f64,
    pub least_f1: f64,
    /// Mean over the seeds, by observation.
    pub observation_f1: Option<f64>,
    /// Share of the seeds with an F1 of .98 or more, and the median seconds of those solves.
    pub reached: f64,
    pub seconds_to_reach: Option<f64>,
    /// Share of the seeds in which something was reconstructed.
    pub solved: f64,
    /// Medians over the seeds that have a value; `None` where none has.
    pub error_2d_px: Option<f64>,
    pub error_3d: Option<f64>,
    pub focal_error: Option<f64>,
    /// Bootstrap intervals (95 %, seeds resampled) of the mean F1 and of these medians.
    pub f1_interval: Option<[f64; 2]>,
    pub error_2d_px_interval: Option<[f64; 2]>,
    pub error_3d_interval: Option<[f64; 2]>,
    pub focal_error_interval: Option<[f64; 2]>,
    /// Median focal error over the oracle's, on the seeds where this contestant gives one, with its bootstrap interval
    /// (95 %, seeds resampled in pairs).
    pub focal_ratio: Option<f64>,
    pub focal_ratio_interval: Option<[f64; 2]>,
    /// Shares of the seeds by grade.
    pub metric: f64,
    pub weak: f64,
    pub projective_only: f64,
    pub median_seconds: f64,
}

/// All cells of a plan that have records, in its order.
pub fn cells(plan: &Plan, records: &Records) -> Vec<Cell> {
    let mut cells = Vec::new();
    for sweep in &plan.sweeps {
        for &depths in &plan.depths {
            for &contestant in &plan.contestants {
                for (index, (x, scene)) in sweep.cells.iter().enumerate() {
                    if !contestant.takes_part(scene, depths) {
                        continue;
                    }
                    let pairs: Vec<(&Measures, Option<&Measures>)> = (0..plan.seeds)
                        .filter_map(|seed| {
                            let own = plan.run(scene, depths, seed, contestant);
                            Some((records.get(&own)?, records.get(&Run::oracle(own.scene))))
                        })
                        .collect();
                    if !pairs.is_empty() {
                        cells.push(cell((sweep.name, *x, sweep.place(index)), depths, contestant, &pairs));
                    }
                }
            }
        }
    }
    cells
}

fn cell(
    (sweep, x, place): (&'static str, f64, String),
    depths: Depths,
    contestant: Contestant,
    pairs: &[(&Measures, Option<&Measures>)],
) -> Cell {
    let count = pairs.len() as f64;
    let own = || pairs.iter().map(|(measures, _)| *measures);
    let share = |grade: Grade| own().filter(|measures| measures.grade == Some(grade)).count() as f64 / count;
    let focal_errors: Vec<(f64, f64)> = pairs
        .iter()
        .filter_map(|(measures, oracle)| {
            Some((measures.log_focal_error?.abs(), oracle.as_ref()?.log_focal_error?.abs()))
        })
        .collect();
    let with_oracle = contestant != Contestant::Oracle && !focal_errors.is_empty();
    let f1: Vec<f64> = own().map(|measures| measures.f1).collect();
    let error_2d_px: Vec<f64> = own().filter_map(|measures| measures.error_2d_px).collect();
    let error_3d: Vec<f64> = own().filter_map(|measures| measures.error_3d).collect();
    let focal_error: Vec<f64> = own().filter_map(|measures| measures.log_focal_error.map(f64::abs)).collect();
    let of_median = |values: &[f64]| bootstrap(values, |resampled| median(resampled.to_vec()));
    Cell {
        sweep,
        x,
        place,
        depths,
        contestant,
        seeds: pairs.len(),
        mean_f1: mean(f1.iter().copied()).unwrap_or(0.0),
        least_f1: own().map(|measures| measures.f1).fold(1.0, f64::min),
        observation_f1: mean(own().filter_map(|measures| measures.observations).map(|observations| observations.f1)),
        reached: own().filter(|measures| measures.f1 >= REACHED_F1).count() as f64 / count,
        seconds_to_reach: median(
            own().filter(|measures| measures.f1 >= REACHED_F1).map(|measures| measures.seconds).collect(),
        ),
        solved: own().filter(|measures| measures.solved).count() as f64 / count,
        f1_interval: bootstrap(&f1, |resampled| mean(resampled.iter().copied())),
        error_2d_px_interval: of_median(&error_2d_px),
        error_3d_interval: of_median(&error_3d),
        focal_error_interval: of_median(&focal_error),
        error_2d_px: median(error_2d_px),
        error_3d: median(error_3d),
        focal_error: median(focal_error),
        focal_ratio: if with_oracle { ratio_of_medians(&focal_errors) } else { None },
        focal_ratio_interval: if with_oracle { bootstrap(&focal_errors, ratio_of_medians) } else { None },
        metric: share(Grade::Metric),
        weak: share(Grade::Weak),
        projective_only: share(Grade::ProjectiveOnly),
        median_seconds: median(own().map(|measures| measures.seconds).collect()).unwrap_or(0.0),
    }
}

/// `None` without values.
pub fn mean(values: impl IntoIterator<Item = f64>) -> Option<f64> {
    let (count, sum) = values.into_iter().fold((0, 0.0), |(count, sum), value| (count + 1, sum + value));
    (count > 0).then(|| sum / f64::from(count))
}

/// Median, the mean of the two middle ones for an even number; `None` without values.
pub fn median(mut values: Vec<f64>) -> Option<f64> {
    (!values.is_empty()).then(|| midpoint_median(&mut values))
}

fn ratio_of_medians(pairs: &[(f64, f64)]) -> Option<f64> {
    let own = median(pairs.iter().map(|pair| pair.0).collect())?;
    let oracle = median(pairs.iter().map(|pair| pair.1).collect())?;
    (oracle > 0.0).then_some(own / oracle)
}

/// Interval of a statistic over resampled values; `None` where it has no value.
fn bootstrap<T: Copy>(values: &[T], statistic: impl Fn(&[T]) -> Option<f64>) -> Option<[f64; 2]> {
    let mut rng = ChaCha8Rng::seed_from_u64(BOOTSTRAP_SEED);
    let mut found: Vec<f64> = (0..RESAMPLES)
        .filter_map(|_| {
            let resampled: Vec<T> = (0..values.len()).map(|_| values[rng.random_range(0..values.len())]).collect();
            statistic(&resampled)
        })
        .collect();
    found.sort_by(f64::total_cmp);
    let last = found.len().checked_sub(1)? as f64;
    let at = |share: f64| found[(share * last).round() as usize];
    Some([at(TAIL), at(1.0 - TAIL)])
}

/// What METRIC is worth: claims against truth over all scenes of a plan.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Coverage {
    pub contestant: Contestant,
    pub scenes: usize,
    pub metric: usize,
    /// Shares of the METRIC answers within one and three of their own standard deviations.
    pub within_one_sigma: f64,
    pub within_three_sigma: f64,
    /// METRIC answers wrong by more than 5 %.
    pub metric_and_wrong: usize,
    /// Scenes whose Cramer-Rao bound is below .01, and the share of them that ended METRIC.
    pub determined: usize,
    pub determined_metric: f64,
}

/// Standard deviation of the log focal length, by the Cramer-Rao bound, below which METRIC is expected.
const DETERMINED: f64 = 0.01;

/// Whether a scene has nothing that forbids a calibration.
fn is_general(scene: &SceneOptions) -> bool {
    matches!(scene.motion, Motion::General | Motion::Orbit) && scene.shape == Shape::Box
}

/// Coverage of one contestant over all its records in the plan.
pub fn coverage(plan: &Plan, records: &Records, contestant: Contestant) -> Option<Coverage> {
    // A zoom has no one focal length to compare with.
    let has_one_focal = |run: &Run| run.contestant == contestant && run.scene.zoom == 0.0;
    let runs: Vec<Run> = plan.runs().into_iter().filter(has_one_focal).collect();
    let answers: Vec<(&Measures, Option<f64>)> = runs
        .iter()
        .filter_map(|run| {
            let bound = records.get(&Run::oracle(run.scene.clone())).and_then(|oracle| oracle.sigma_log_focal);
            Some((records.get(run)?, bound.filter(|_| is_general(&run.scene))))
        })
        .collect();
    let deviations: Vec<(f64, f64)> = answers
        .iter()
        .filter(|(measures, _)| measures.grade == Some(Grade::Metric))
        .filter_map(|(measures, _)| Some((measures.log_focal_error?.abs(), measures.sigma_log_focal?)))
        .collect();
    let within = |sigmas: f64| {
        deviations.iter().filter(|(error, sigma)| *error <= sigmas * sigma).count() as f64
            / deviations.len().max(1) as f64
    };
    let determined: Vec<bool> = answers
        .iter()
        .filter(|(_, bound)| bound.is_some_and(|bound| bound < DETERMINED))
        .map(|(measures, _)| measures.grade == Some(Grade::Metric))
        .collect();
    (!answers.is_empty()).then(|| Coverage {
        contestant,
        scenes: answers.len(),
        metric: deviations.len(),
        within_one_sigma: within(1.0),
        within_three_sigma: within(3.0),
        metric_and_wrong: deviations.iter().filter(|(error, _)| *error > WRONG_FOCAL).count(),
        determined: determined.len(),
        determined_metric: determined.iter().filter(|metric| **metric).count() as f64 / determined.len().max(1) as f64,
    })
}

/// The cells as a table, one a line; empty where there is no value.
pub fn csv(cells: &[Cell]) -> String {
    let mut text = String::from(
        "sweep,x,place,depths,contestant,seeds,mean_f1,least_f1,observation_f1,reached,seconds_to_reach,solved,error_2d_px,error_3d,focal_error,focal_ratio,\
         focal_ratio_low,focal_ratio_high,metric,weak,projective_only,median_seconds,f1_low,f1_high,error_2d_px_low,\
         error_2d_px_high,error_3d_low,error_3d_high,focal_error_low,focal_error_high\n",
    );
    let shown = |value: Option<f64>| value.map_or_else(String::new, |value| format!("{value:.6}"));
    for cell in cells {
        let ends = |interval: Option<[f64; 2]>| interval.map_or([None; 2], |interval| interval.map(Some));
        let [low, high] = ends(cell.focal_ratio_interval);
        let intervals =
            [cell.f1_interval, cell.error_2d_px_interval, cell.error_3d_interval, cell.focal_error_interval];
        let values = [
            Some(cell.mean_f1),
            Some(cell.least_f1),
            cell.observation_f1,
            Some(cell.reached),
            cell.seconds_to_reach,
            Some(cell.solved),
            cell.error_2d_px,
            cell.error_3d,
            cell.focal_error,
            cell.focal_ratio,
            low,
            high,
            Some(cell.metric),
            Some(cell.weak),
            Some(cell.projective_only),
            Some(cell.median_seconds),
        ];
        let values: Vec<String> = values.into_iter().chain(intervals.into_iter().flat_map(ends)).map(shown).collect();
        text.push_str(&format!(
            "{},{},{},{},{},{},{}\n",
            cell.sweep,
            cell.x,
            cell.place,
            cell.depths.name(),
            cell.contestant.name(),
            cell.seeds,
            values.join(",")
        ));
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn medians_of_odd_even_and_none() {
        assert_eq!(median(vec![3.0, 1.0, 2.0]), Some(2.0));
        assert_eq!(median(vec![3.0, 1.0, 2.0, 10.0]), Some(2.5));
        assert_eq!(median(Vec::new()), None);
    }

    #[test]
    fn a_bootstrap_interval_holds_the_ratio_and_shrinks_with_more_seeds() {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let mut pairs = |count: usize| -> Vec<(f64, f64)> {
            (0..count).map(|_| (rng.random_range(0.5..2.5), rng.random_range(0.5..1.5))).collect()
        };
        let (few, many) = (pairs(20), pairs(2000));
        let width = |pairs: &[(f64, f64)]| {
            let [low, high] = bootstrap(pairs, ratio_of_medians).expect("values");
            let ratio = ratio_of_medians(pairs).expect("values");
            assert!(low <= ratio && ratio <= high, "{low} {ratio} {high}");
            high - low
        };
        assert!(width(&many) < 0.3 * width(&few));
        assert_eq!(bootstrap(&[], ratio_of_medians), None);
    }
}
