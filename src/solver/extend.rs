//! From the tracks and views that were searched to all that are complete.
//!
//! A search looks at a sample: more tracks and views make a consensus no easier to find. They do make its cameras and
//! its calibration more exact, by the root of their number, so what was left aside joins once a consensus stands.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::Context;
use super::block::{self, Block};
use super::grow::{self, Consensus};
use crate::geometry::bundle::{self, projective};
use crate::geometry::statistics::chi_square_gate;
use crate::geometry::{Camera, Point, resection};

/// Tracks that are judged, and inliers among them that cameras are adjusted to: beyond, an adjustment takes seconds and
/// other errors than noise bound what it gives.
const MOST_TRACKS: usize = 5_000;
const MOST_INLIERS: usize = 600;
/// Views that a block is extended to: adjustment is cubic in them.
const MOST_VIEWS: usize = 100;
/// Iterations of an adjustment that starts at the noise.
const ADJUSTMENTS: usize = 10;
/// Rounds of judging, adjusting and estimating the noise, at most: those that judge wider, and as many again, of which
/// two make the inliers stand still most of the time.
const MOST_ROUNDS: usize = 7;
/// Noise that the first rounds judge at, in units of what is estimated: the cameras were fitted to fewer tracks, and
/// what they err adds to the residuals of the others. At the noise itself up to a third of the right ones stayed
/// outside, and some for good.
const WIDENINGS: [f64; 3] = [2.0, 1.5, 1.2];
/// Share of the searched inliers that must remain, or the extension is given up.
const LEAST_KEPT: f64 = 0.8;
/// Gates within which an image agrees with a camera that was resected from points with errors of their own.
const REGISTRATION_GATES: f64 = 9.0;

/// The block and its consensus with the tracks and views that the search left aside; `None` where there are none, or
/// where what was found does not carry over.
pub fn extend(block: &Block, consensus: &Consensus, context: &Context) -> Option<(Block, Consensus)> {
    let others = block::complete_views(context.input, context.ranges).unwrap_or_default();
    let wanted = with_others(&block.views, &others);
    if wanted.len() > block.views.len()
        && let Some(extended) = extend_to(block, consensus, &wanted, context)
    {
        return Some(extended);
    }
    extend_to(block, consensus, &block.views, context)
}

/// The same over these views, or as many of them as fit.
fn extend_to(block: &Block, consensus: &Consensus, views: &[usize], context: &Context) -> Option<(Block, Consensus)> {
    let extract = |views: &[usize]| {
        block::extract(context.input, context.ranges, context.normalization, views).sample_with(
            MOST_TRACKS,
            context.settings.seed,
            &block.tracks,
        )
    };
    let mut whole = extract(views);
    if whole.views.len() == block.views.len() && whole.tracks.len() == block.tracks.len() {
        return None;
    }
    let registered = register(block, consensus, &whole, context);
    let fitting: Vec<usize> =
        whole.views.iter().zip(&registered).filter(|(_, camera)| camera.is_some()).map(|(&view, _)| view).collect();
    if fitting.len() < whole.views.len() {
        whole = extract(&fitting);
    }
    let cameras: Vec<Camera> = registered.into_iter().flatten().collect();
    let mut found = grow::judge(&whole.complete, cameras, WIDENINGS[0] * consensus.noise, context.stop);
    let mut before = Vec::new();
    for round in 1..=MOST_ROUNDS {
        let inliers = found.inliers();
        if round > WIDENINGS.len() && inliers == before {
            break;
        }
        if inliers.len() < grow::LEAST_INLIERS || context.stop.is_stopped() {
            return None;
        }
        let noise = grow::estimate_noise(&found, &inliers);
        let cameras = adjusted(&whole, &found, &evenly(&inliers, MOST_INLIERS), noise, context);
        let widening = WIDENINGS.get(round).copied().unwrap_or(1.0);
        found = grow::judge(&whole.complete, cameras, widening * noise, context.stop);
        before = inliers;
    }
    (kept_share(block, consensus, &whole, &found) >= LEAST_KEPT).then_some((whole, found))
}

/// The views of the block and as many of the others as there is room for, evenly spread.
fn with_others(own: &[usize], all: &[usize]) -> Vec<usize> {
    let others: Vec<usize> = all.iter().copied().filter(|view| !own.contains(view)).collect();
    let mut views = own.to_vec();
    views.extend(evenly(&others, MOST_VIEWS.saturating_sub(own.len())));
    views.sort_unstable();
    views
}

/// At most `most` of the items, evenly spread.
pub fn evenly(items: &[usize], most: usize) -> Vec<usize> {
    let count = items.len().min(most);
    (0..count).map(|k| items[k * items.len() / count]).collect()
}

/// The cameras of all views of `whole`: the block's own, and the others resected from its inliers; `None` for views
/// that do not fit.
fn register(block: &Block, consensus: &Consensus, whole: &Block, context: &Context) -> Vec<Option<Camera>> {
    let mut rng = ChaCha8Rng::seed_from_u64(context.settings.seed);
    let gate = REGISTRATION_GATES * chi_square_gate(2.0) * consensus.noise * consensus.noise;
    // Inliers that are complete over the new views too.
    let inliers: Vec<(usize, usize)> = consensus
        .inliers()
        .into_iter()
        .filter_map(|track| Some((track, whole.tracks.binary_search(&block.tracks[track]).ok()?)))
        .collect();
    let points: Vec<Point> = inliers.iter().map(|&(track, _)| consensus.points[track]).collect();
    let least = (LEAST_KEPT * points.len() as f64).ceil() as usize;
    let mut camera = |(i, view): (usize, &usize)| {
        if let Ok(own) = block.views.binary_search(view) {
            return Some(consensus.cameras[own]);
        }
        if context.stop.is_stopped() {
            return None;
        }
        let images: Vec<_> = inliers.iter().map(|&(_, place)| whole.complete.point(i, place)).collect();
        resection::robust(&points, &images, gate, least, &mut rng, context.stop).map(|(camera, _)| camera)
    };
    whole.views.iter().enumerate().map(&mut camera).collect()
}

fn adjusted(whole: &Block, found: &Consensus, support: &[usize], noise: f64, context: &Context) -> Vec<Camera> {
    let mut cameras = found.cameras.clone();
    let mut points = support.iter().map(|&track| found.points[track]).collect::<Vec<_>>();
    let observations = grow::observations_of(&whole.complete, support);
    let options = bundle::Options { max_iterations: ADJUSTMENTS, loss: grow::robust(noise), ..Default::default() };
    projective::adjust(&mut cameras, &mut points, &observations, &options, context.stop);
    cameras
}

/// Share of the searched inliers that are inliers still.
fn kept_share(block: &Block, consensus: &Consensus, whole: &Block, found: &Consensus) -> f64 {
    let inliers = consensus.inliers();
    let kept = inliers
        .iter()
        .filter(|&&track| whole.tracks.binary_search(&block.tracks[track]).is_ok_and(|place| found.inlier[place]))
        .count();
    kept as f64 / inliers.len().max(1) as f64
}
