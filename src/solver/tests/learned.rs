//! The network that was trained beforehand, in the search.

use super::*;
use crate::domain::WarningCode;
use crate::geometry::measurement::CompleteBlock;
use crate::solver::learned::Opinion;
use crate::solver::search::{Sampler, Shortlist, affine};
use crate::synthetic::Motion;
use crate::synthetic::metrics::average_precision;

fn wrong(outliers: f64, seed: u64) -> (Input, Scene) {
    scene(SceneOptions { outliers, seed, ..SceneOptions::default() })
}

fn warns_of_ranking(solution: &Solution) -> bool {
    solution.warnings.iter().any(|warning| warning.code == WarningCode::UnverifiedRanking)
}

#[test]
fn eight_right_tracks_of_two_hundred_are_found_at_once() {
    for seed in 40..43 {
        let (input, scene) = wrong(0.96, seed);
        let solution = solved(&input, &SolveSettings::default());
        assert_eq!(solution.status, Status::Solved, "seed {seed}");
        assert_eq!(solution.winning_prior, Some(Prior::Learned), "seed {seed}");
        let f1 = agreement(&solution.tracks.inlier, &scene.truth.inlier).f1;
        assert!(f1 > 0.99, "seed {seed}: F1 {f1}");
        assert!(!warns_of_ranking(&solution), "what is verified needs no ranking");
    }
}

#[test]
fn what_geometry_cannot_verify_is_ranked_and_said_to_be_no_more() {
    for seed in 40..42 {
        let (input, scene) = wrong(0.97, seed);
        let solution = solved(&input, &SolveSettings { iterations: 50, ..SolveSettings::default() });
        assert_eq!(solution.status, Status::NoReconstruction, "seed {seed}: six tracks cannot be verified");
        assert!(warns_of_ranking(&solution), "seed {seed}: {:?}", solution.warnings);
        assert!(solution.tracks.inlier.iter().all(|inlier| !inlier));
        let weights: Vec<f64> = solution.tracks.weight.iter().map(|&weight| f64::from(weight)).collect();
        let precision = average_precision(&weights, &scene.truth.inlier).expect("right tracks");
        assert!(precision > 0.95, "seed {seed}: AP {precision}");
    }
}

#[test]
fn nothing_is_claimed_of_entirely_wrong_tracks() {
    for seed in 40..42 {
        let (input, _) = wrong(1.0, seed);
        let solution = solved(&input, &SolveSettings { iterations: 50, ..SolveSettings::default() });
        assert_eq!(solution.status, Status::NoReconstruction, "seed {seed}");
        assert!(!warns_of_ranking(&solution), "seed {seed}: {:?}", solution.warnings);
        assert!(solution.tracks.weight.iter().all(|&weight| weight == 0.0), "seed {seed}");
    }
}

#[test]
fn without_the_trained_network_the_search_stands_on_its_own() {
    let (input, scene) = wrong(0.9, 40);
    let without = SolveSettings { excluded_priors: vec![Prior::Learned], ..SolveSettings::default() };
    for settings in [without, SolveSettings { method: Method::Geometry, ..SolveSettings::default() }] {
        let solution = solved(&input, &settings);
        assert!(solution.winning_prior.is_some_and(|prior| prior != Prior::Learned));
        let f1 = agreement(&solution.tracks.inlier, &scene.truth.inlier).f1;
        assert!(f1 > 0.99, "F1 {f1}");
    }
}

/// How often the best hypothesis of 600 samples ranks right tracks first, over what a nat of the network's odds counts.
#[test]
#[ignore = "a sweep to read, some minutes"]
fn the_sweep_of_the_learned_prior() {
    const SEEDS: std::ops::Range<u64> = 7_000..7_040;
    let paper = SceneOptions::default;
    let orbit = SceneOptions { motion: Motion::Orbit, max_rotation_rad: 1.57, outliers: 0.97, ..paper() };
    let kinds = [
        ("outliers .95", SceneOptions { outliers: 0.95, ..paper() }),
        ("outliers .97", SceneOptions { outliers: 0.97, ..paper() }),
        ("orbit .97", orbit),
        ("noise 5 %, .9", SceneOptions { noise: 0.05, ..paper() }),
    ];
    for (name, options) in kinds {
        for per_nat in [0.0, 0.05, 0.1, 0.15, 0.2, 0.3] {
            let mut precisions = Vec::new();
            for seed in SEEDS {
                let (input, scene) = scene(SceneOptions { seed, ..options.clone() });
                let block = whole(&input);
                let opinion = Opinion::of(&block).expect("few views");
                let search = affine::Search::new(&block);
                let truncations = opinion.truncations_at(per_nat);
                let mut shortlist = Shortlist::new(1);
                let mut rng = rand::SeedableRng::seed_from_u64(seed);
                let sampler = Sampler::new(&opinion.probabilities());
                search.run(&sampler, &truncations, 600, &mut rng, &mut shortlist, &StopToken::default());
                let best = shortlist.into_entries().next().expect("a hypothesis");
                let gains: Vec<f64> = search.costs(&best, &truncations).into_iter().map(|cost| -cost).collect();
                precisions.extend(average_precision(&gains, &scene.truth.inlier));
            }
            let mean = precisions.iter().sum::<f64>() / precisions.len() as f64;
            println!("{name}: {per_nat} a nat: mean average precision {mean:.4} over {} scenes", precisions.len());
        }
    }
}

fn whole(input: &Input) -> CompleteBlock {
    let (normalization, _) = block::normalization(input);
    let views: Vec<usize> = (0..input.view_count()).collect();
    block::extract(input, &block::track_ranges(input), &normalization, &views).complete
}
