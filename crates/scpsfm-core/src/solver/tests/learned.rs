//! The network that was trained beforehand, in the search.

use super::*;
use crate::domain::WarningCode;
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
        assert_eq!(solution.winning_proposal, Some(Proposal::Learned), "seed {seed}");
        let f1 = agreement(&solution.tracks.inlier, &scene.truth.inlier).f1;
        assert!(f1 > 0.99, "seed {seed}: F1 {f1}");
        assert!(!warns_of_ranking(&solution), "what is verified needs no ranking");
        assert_eq!(solution.trained_network_sha256, Some(trained_network_sha256()), "two networks, two answers");
        assert_eq!(solution.iterations, 0, "decided before the paper's network");
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
    let without = SolveSettings { excluded_proposals: vec![Proposal::Learned], ..SolveSettings::default() };
    for settings in [without, SolveSettings { method: Method::Geometry, ..SolveSettings::default() }] {
        let solution = solved(&input, &settings);
        assert!(solution.winning_proposal.is_some_and(|prior| prior != Proposal::Learned));
        let f1 = agreement(&solution.tracks.inlier, &scene.truth.inlier).f1;
        assert!(f1 > 0.99, "F1 {f1}");
        assert_eq!(solution.trained_network_sha256, None);
    }
}

/// Of 3,000 tracks a search looks at 600; a random sample of these scenes has seven right ones, and geometry asks for
/// eight.
#[test]
fn where_hardly_any_track_of_a_sample_is_right_the_likeliest_of_all_are_searched() {
    for seed in [500_012, 500_031, 500_092] {
        let (input, scene) = scene(SceneOptions { tracks: 3_000, outliers: 0.98, seed, ..SceneOptions::default() });
        let solution = solved(&input, &SolveSettings::default());
        let f1 = agreement(&solution.tracks.inlier, &scene.truth.inlier).f1;
        assert!(f1 > 0.95, "seed {seed}: F1 {f1}, {:?}", solution.warnings);
        assert_eq!(solution.grade, Some(Grade::Metric), "seed {seed}");
    }
}

/// The network has seen no scene of so few tracks, and takes a few of them to be right whatever they are.
#[test]
fn of_a_dozen_tracks_geometry_alone_has_the_word() {
    for (seed, tracks) in [8, 10, 12, 14].into_iter().enumerate() {
        let seed = 60 + seed as u64;
        for (outliers, status) in [(0.0, Status::Solved), (1.0, Status::NoReconstruction)] {
            let (input, scene) = scene(SceneOptions { tracks, outliers, seed, ..SceneOptions::default() });
            let solution = solved(&input, &SolveSettings { iterations: 50, ..SolveSettings::default() });
            assert_eq!(solution.status, status, "{tracks} tracks, seed {seed}: {:?}", solution.warnings);
            let wrongly =
                solution.tracks.inlier.iter().zip(&scene.truth.inlier).filter(|(found, right)| found != right);
            // Noise may take one beyond the gate.
            assert!(wrongly.count() <= 1, "{tracks} tracks, seed {seed}: {:?}", solution.tracks.inlier);
        }
    }
}
