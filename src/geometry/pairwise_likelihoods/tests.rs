//! Votes on scenes whose truth is known.

use nalgebra::Vector2;
use rand::Rng;

use super::*;
use crate::geometry::bundle::testing::{self, normal};
use crate::geometry::observation::Observation;
use crate::synthetic::metrics::average_precision;

const NOISE: f64 = 0.001;
/// What the votes are told of it, five times as much.
const ASSUMED: f64 = 0.005;
/// Enough for half of the matches to be wrong.
const SAMPLES: usize = 1_000;
const VIEWS: usize = 6;
const TRACKS: usize = 80;

/// A rigid scene of which `wrong` says what of the observation of a view and track is right: a point for one that is
/// wrong. Returns the truth of the observations, too.
fn scene(
    seed: u64,
    mut wrong: impl FnMut(usize, usize, Vector2<f64>, &mut ChaCha8Rng) -> Option<Vector2<f64>>,
) -> (Tracks, Vec<bool>) {
    let scene = testing::scene(seed, VIEWS, TRACKS, NOISE);
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut tracks = vec![Vec::new(); TRACKS];
    let mut truth = vec![Vec::new(); TRACKS];
    for view in 0..VIEWS {
        for seen in scene.observations.iter().filter(|seen| seen.view == view) {
            let instead = wrong(view, seen.point, seen.xy, &mut rng);
            truth[seen.point].push(instead.is_none());
            tracks[seen.point].push(Observation { xy: instead.unwrap_or(seen.xy), ..*seen });
        }
    }
    (Tracks::new(VIEWS, tracks), truth.concat())
}

fn anywhere(rng: &mut ChaCha8Rng) -> Vector2<f64> {
    Vector2::from_fn(|_, _| rng.random_range(-0.5..0.5))
}

/// The first tracks are wrong throughout, the next ones in the view of their number.
fn contaminated(seed: u64) -> (Tracks, Vec<bool>) {
    scene(seed, |view, track, _, rng| {
        let point = anywhere(rng);
        (track < 20 || (track < 32 && track % VIEWS == view)).then_some(point)
    })
}

fn votes(tracks: &Tracks, seed: u64) -> Option<Votes> {
    Votes::ask(tracks, ASSUMED, SAMPLES, seed, &StopToken::default())
}

#[test]
fn wrong_observations_and_tracks_are_told_from_right_ones() {
    for seed in 0..5 {
        let (tracks, truth) = contaminated(seed);
        let votes = votes(&tracks, seed).unwrap_or_else(|| panic!("seed {seed}: no votes"));
        let found = votes.alone();
        let precision = average_precision(&found.observations, &truth).expect("right ones");
        let misjudged = found.observations.iter().zip(&truth).filter(|(odds, right)| (**odds > 0.0) != **right).count();
        println!(
            "seed {seed}: {} pairs, noise {:.5}, AP {precision:.4}, {misjudged} misjudged",
            votes.pairs, votes.noise
        );
        assert_eq!(votes.pairs, 2 * VIEWS - 3, "seed {seed}");
        assert!((0.7..1.4).contains(&(votes.noise / NOISE)), "seed {seed}: noise {}", votes.noise);
        assert!(precision > 0.995, "seed {seed}: {precision}");
        // A pair with a wrong point agrees by chance in one case of seventy: of two hundred such pairs three do, and
        // each speaks for two observations.
        assert!(misjudged < truth.len() / 16, "seed {seed}: {misjudged} of {} are misjudged", truth.len());
        let whole: Vec<bool> = (0..TRACKS).map(|track| truth[tracks.range(track)].iter().all(|right| *right)).collect();
        let precision = average_precision(&found.tracks, &whole).expect("right ones");
        assert!(precision > 0.99, "seed {seed}: tracks {precision}");
    }
}

#[test]
fn near_misses_are_told_from_hits() {
    for seed in 0..5 {
        // Ten deviations off, every third track in one view.
        let (tracks, truth) = scene(seed, |view, track, at, rng| {
            let off = Vector2::from_fn(|_, _| normal(rng)).normalize() * 10.0 * NOISE;
            (track % 3 == 0 && track % VIEWS == view).then_some(at + off)
        });
        let found = votes(&tracks, seed).expect("votes").alone();
        let wrong: Vec<bool> = truth.iter().map(|right| !right).collect();
        let doubts: Vec<f64> = found.observations.iter().map(|odds| -odds).collect();
        let (precision, by_chance) = (average_precision(&doubts, &wrong).expect("wrong ones"), 1.0 / 18.0);
        println!("seed {seed}: AP of the wrong ones {precision:.3}, by chance {by_chance:.3}");
        // What is off along the lines of both neighbours is off for no pair.
        assert!(precision > 0.4, "seed {seed}: {precision}");
    }
}

#[test]
fn what_is_known_beside_the_votes_counts() {
    let (tracks, _) = contaminated(1);
    let votes = votes(&tracks, 1).expect("votes");
    let alone = votes.alone();
    // One observation of a right track: its own odds enter as they are, and say nothing of other tracks.
    let (track, about) = (50, tracks.range(50).start + 2);
    let mut known = vec![0.0; tracks.observations().len()];
    known[about] = -2.0;
    let together = votes.with(&known);
    assert!((together.observations[about] - alone.observations[about] + 2.0).abs() < 1e-9);
    assert!(together.tracks[track] < alone.tracks[track]);
    for k in (0..known.len()).filter(|k| !tracks.range(track).contains(k)) {
        assert_eq!(together.observations[k], alone.observations[k], "observation {k}");
    }
}

#[test]
fn tracks_with_holes_are_voted_on() {
    let (complete, truth) = contaminated(2);
    // Every view of the fourth is missing from every other track, and single observations remain.
    let kept = |track: usize, view: usize| (track.is_multiple_of(2) || view != 3) && (track != 40 || view == 2);
    let holed: Vec<Vec<Observation>> = (0..TRACKS)
        .map(|track| {
            let seen = &complete.observations()[complete.range(track)];
            seen.iter().filter(|seen| kept(track, seen.view)).copied().collect()
        })
        .collect();
    let tracks = Tracks::new(VIEWS, holed);
    let found = votes(&tracks, 2).expect("votes").alone();
    let truth: Vec<bool> = (0..TRACKS)
        .flat_map(|track| complete.range(track).map(move |k| (track, k)))
        .filter(|&(track, k)| kept(track, complete.observations()[k].view))
        .map(|(_, k)| truth[k])
        .collect();
    assert!(average_precision(&found.observations, &truth).expect("right ones") > 0.99);
    assert_eq!(found.observations[tracks.range(40)], [0.0], "nothing speaks of a single observation");
}

#[test]
fn one_seed_has_one_answer() {
    let (tracks, _) = contaminated(3);
    assert_eq!(votes(&tracks, 7), votes(&tracks, 7));
}

#[test]
fn where_pairs_agree_by_chance_or_not_at_all_there_are_no_votes() {
    for seed in 0..3 {
        let (tracks, _) = scene(seed, |_, _, _, rng| Some(anywhere(rng)));
        assert_eq!(votes(&tracks, seed), None, "seed {seed}");
    }
    let (tracks, _) = contaminated(0);
    let few = |count: usize| (0..count).map(|track| tracks.observations()[tracks.range(60 + track)].to_vec());
    assert_eq!(votes(&Tracks::new(VIEWS, few(7)), 0), None);
    // Eight matches are fitted by some matrix whatever they are.
    assert_eq!(votes(&Tracks::new(VIEWS, few(8)), 0), None);
    assert_eq!(votes(&Tracks::new(0, Vec::<Vec<Observation>>::new()), 0), None);
    let stop = StopToken::default();
    stop.stop(crate::domain::StopReason::Cancelled);
    assert_eq!(Votes::ask(&tracks, ASSUMED, SAMPLES, 0, &stop), None);
}

#[test]
fn pairs_are_linear_in_the_views() {
    let views = 200;
    let track = || (0..views).map(|view| Observation::new(view, 0, Vector2::zeros()));
    let pairs = matched(&Tracks::new(views, [track(), track()]));
    assert_eq!(pairs.iter().filter(|(places, _)| !places.is_empty()).count(), 2 * views - 3);
    assert!(pairs.iter().all(|(places, matches)| places.len() == matches.len() && places.len() <= 2));
}
