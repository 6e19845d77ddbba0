//! Time of an iteration against the number of observations; run by hand:
//! `cargo test --lib sequence::tests::measure -- --ignored --nocapture --test-threads 1`.

use std::time::Instant;

use super::super::layout::Layout;
use super::super::pattern::Pattern;
use super::super::solver::SparseCholesky;
use super::*;

/// Steps of a measurement, after which its time is divided.
const STEPS: usize = 5;

fn options() -> Options {
    Options { relative_tolerance: 0.0, ..Options::squared(STEPS) }
}

/// Seconds and what was found.
fn timed<T>(run: impl FnOnce() -> T) -> (f64, T) {
    let begun = Instant::now();
    let found = run();
    (begun.elapsed().as_secs_f64(), found)
}

#[test]
#[ignore = "prints a measurement"]
fn time_against_observations() {
    let mut logs = Vec::new();
    for (views, tracks) in [(20, 2_000), (200, 20_000), (1000, 200_000)] {
        for each_its_own in [false, true] {
            let (mut truth, observations) = chain(1, views, tracks / (views - 4), 5, 0.001);
            if each_its_own {
                truth.intrinsics = vec![truth.intrinsics[0]; views];
                truth.group_of = (0..views).collect();
            }
            let mut start = perturbed(&truth, 0.002, 1);
            let models = vec![IntrinsicsModel::FOCAL; truth.intrinsics.len()];
            let stop = StopToken::default();
            let (layout_seconds, layout) = timed(|| Layout::new(&truth, &observations, &Free::all(&models)));
            let (analysis_seconds, _) = timed(|| {
                let pattern = Pattern::new(&truth, &layout, &stop).expect("goes on");
                (!pattern.is_square).then(|| SparseCholesky::new(&pattern).expect("memory"))
            });
            drop(layout);
            let (seconds, report) = timed(|| adjusted(&mut start, &observations, &models, &options()));
            let (seconds, n) = (seconds / report.iterations as f64, observations.len());
            let (groups, each) = (models.len(), 1e6 * seconds / n as f64);
            println!("{n} observations, {views} views, {groups} groups: layout {layout_seconds:.3} s, analysis");
            println!("    {analysis_seconds:.3} s, iteration {seconds:.4} s, {each:.2} us an observation; {report:?}");
            if !each_its_own {
                logs.push(((n as f64).ln(), seconds.ln()));
            }
        }
    }
    println!("log-log slope {:.3}", (logs[2].1 - logs[0].1) / (logs[2].0 - logs[0].0));
}
