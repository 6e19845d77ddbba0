//! Tracks that are wrong each in its own way.

use rand::Rng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;

use super::Frame;
use crate::synthetic::training_scenes::draft::Draft;
use crate::synthetic::training_scenes::draw::{chance, uniform};

/// Share of the views in which a partly wrong track is wrong, the same for all tracks of a scene.
const PARTLY_WRONG: (f64, f64) = (0.2, 1.0);
/// Share of the views in which the observations of partly wrong tracks are permuted; in the others they are anywhere.
const PARTLY_PERMUTED: f64 = 0.7;
/// Probability that a chain goes over to another point from one view to the next.
const JUMP: (f64, f64) = (0.05, 0.5);

/// Exchanges the points of these tracks in every view, so that none keeps its own; one track alone is put anywhere.
pub fn permute(draft: &mut Draft, wrong: &[usize], frames: &[Frame], rng: &mut ChaCha8Rng) {
    for (view, frame) in frames.iter().enumerate() {
        permute_view(draft, view, wrong.to_vec(), frame, rng);
    }
}

fn permute_view(draft: &mut Draft, view: usize, mut wrong: Vec<usize>, frame: &Frame, rng: &mut ChaCha8Rng) {
    let first = view * draft.tracks;
    if let [only] = wrong[..] {
        draft.image[first + only] = frame.anywhere(rng);
        return;
    }
    wrong.shuffle(rng);
    for (k, &track) in wrong.iter().enumerate() {
        draft.image[first + track] = draft.exact[first + wrong[(k + 1) % wrong.len()]];
    }
}

/// Puts these tracks anywhere in every view.
pub fn scatter(draft: &mut Draft, wrong: &[usize], frames: &[Frame], rng: &mut ChaCha8Rng) {
    for (view, frame) in frames.iter().enumerate() {
        scatter_view(draft, view, wrong, frame, rng);
    }
}

fn scatter_view(draft: &mut Draft, view: usize, wrong: &[usize], frame: &Frame, rng: &mut ChaCha8Rng) {
    wrong.iter().for_each(|&track| draft.image[view * draft.tracks + track] = frame.anywhere(rng));
}

/// Spoils these tracks in some of their views, each in one at least.
pub fn spoil_partly(draft: &mut Draft, wrong: &[usize], frames: &[Frame], rng: &mut ChaCha8Rng) {
    let share = uniform(PARTLY_WRONG, rng);
    let least: Vec<usize> = wrong.iter().map(|&track| seen_view(draft, track, rng)).collect();
    for (view, frame) in frames.iter().enumerate() {
        let spoilt = wrong.iter().zip(&least).filter(|&(_, &least)| least == view || chance(share, rng));
        let spoilt: Vec<usize> = spoilt.map(|(&track, _)| track).collect();
        if chance(PARTLY_PERMUTED, rng) {
            permute_view(draft, view, spoilt, frame, rng);
        } else {
            scatter_view(draft, view, &spoilt, frame, rng);
        }
    }
}

/// A random view that sees the track.
fn seen_view(draft: &Draft, track: usize, rng: &mut ChaCha8Rng) -> usize {
    let seen: Vec<usize> = (0..draft.views).filter(|view| draft.visible[view * draft.tracks + track]).collect();
    seen[rng.random_range(0..seen.len())]
}

/// Lets these tracks follow a point and jump to another one now and then. Each is of the point that it shows in most
/// views, and no other one is shown in as many.
pub fn chain(draft: &mut Draft, wrong: &[usize], rng: &mut ChaCha8Rng) {
    let jump = uniform(JUMP, rng);
    for &track in wrong {
        let seen: Vec<usize> = (0..draft.views).filter(|view| draft.visible[view * draft.tracks + track]).collect();
        let mut point = track;
        let mut shown = Vec::with_capacity(seen.len());
        for k in 0..seen.len() {
            if k > 0 && chance(jump, rng) {
                point = another(point, draft.tracks, rng);
            }
            shown.push(point);
        }
        draft.own[track] = settle(&mut shown, draft.tracks, rng);
        for (view, point) in seen.into_iter().zip(shown) {
            let first = view * draft.tracks;
            draft.image[first + track] = draft.exact[first + point];
        }
    }
}

/// The point that is shown most often, the first of equals; every other one that is shown as often gives up its last
/// view to yet another point, since nothing in the images would say which of them is the track's.
fn settle(shown: &mut [usize], tracks: usize, rng: &mut ChaCha8Rng) -> usize {
    let count = |shown: &[usize], point: usize| shown.iter().filter(|&&other| other == point).count();
    let own = shown.iter().copied().rev().max_by_key(|&point| count(shown, point)).unwrap_or_default();
    let most = count(shown, own);
    while most > 1
        && let Some(last) = (0..shown.len()).rev().find(|&k| shown[k] != own && count(shown, shown[k]) >= most)
    {
        shown[last] = another(own, tracks, rng);
    }
    own
}

/// A random point other than this one.
fn another(point: usize, tracks: usize, rng: &mut ChaCha8Rng) -> usize {
    let other = rng.random_range(0..tracks - 1);
    other + usize::from(other >= point)
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;

    use super::*;

    #[test]
    fn a_settled_chain_has_one_point_that_it_shows_most_often() {
        let mut rng = ChaCha8Rng::seed_from_u64(0);
        let cases: [(&[usize], usize); 5] = [
            (&[7, 7, 7, 3, 3, 3], 7),
            (&[7, 3, 3, 3, 7], 3),
            (&[7, 7, 3, 3, 5, 5], 7),
            (&[7, 3, 5, 1], 7),
            (&[7, 7, 7, 7], 7),
        ];
        for (chain, own) in cases {
            let mut shown = chain.to_vec();
            assert_eq!(settle(&mut shown, 50, &mut rng), own, "{chain:?}");
            let count = |point| shown.iter().filter(|&&other| other == point).count();
            let most = count(own);
            assert!(
                most == 1 || shown.iter().all(|&point| point == own || count(point) < most),
                "{chain:?}: {shown:?}"
            );
            assert_eq!(most, chain.iter().filter(|&&point| point == own).count());
        }
    }
}
