//! Time and memory against the number of observations; run by hand:
//! `cargo test --release --lib sequence::tests::measure -- --ignored --nocapture --test-threads 1`.

use std::time::Instant;

use super::super::layout::Layout;
use super::super::minimise::pattern;
use super::super::solver::Solver;
use super::*;

/// Steps of a measurement, after which its time is divided.
const STEPS: usize = 5;

#[test]
#[ignore = "prints a measurement"]
fn time_an_iteration() {
    let mut logs = Vec::new();
    for (views, tracks) in [(20, 2_000), (200, 20_000), (1000, 200_000)] {
        for each_its_own in [false, true] {
            let begun = Instant::now();
            let (mut truth, sightings) = chain(1, views, tracks / (views - 4), 5, 0.001);
            if each_its_own {
                truth.intrinsics = vec![truth.intrinsics[0]; views];
                truth.group_of = (0..views).collect();
            }
            let mut start = perturbed(&truth, 0.002, 1);
            let models = vec![IntrinsicsModel::FOCAL; truth.intrinsics.len()];
            println!("made in {:.1} s", begun.elapsed().as_secs_f64());
            let begun = Instant::now();
            let layout = Layout::new(&truth, &sightings, &Free::all(&models), None);
            let layout_seconds = begun.elapsed().as_secs_f64();
            let begun = Instant::now();
            let pattern = pattern(&truth, &layout);
            Solver::new(&pattern).expect("memory");
            println!("layout {layout_seconds:.3} s, analysis {:.3} s", begun.elapsed().as_secs_f64());
            let begun = Instant::now();
            let options = Options { relative_tolerance: 0.0, ..Options::squared(STEPS) };
            let report = adjusted(&mut start, &sightings, &models, &options);
            let seconds = begun.elapsed().as_secs_f64() / report.iterations as f64;
            let n = sightings.len();
            println!(
                "{n} observations, {views} views, {} groups: {seconds:.4} s an iteration, {:.2} us an observation, {report:?}",
                models.len(),
                1e6 * seconds / n as f64
            );
            if !each_its_own {
                logs.push(((n as f64).ln(), seconds.ln()));
            }
        }
    }
    let slope = (logs[2].1 - logs[0].1) / (logs[2].0 - logs[0].0);
    println!("log-log slope {slope:.3}");
}
