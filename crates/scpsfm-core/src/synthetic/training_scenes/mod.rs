//! Training scenes for a network that learns to tell right tracks from wrong ones: many kinds of world, motion, noise
//! and contamination, drawn on the fly, with a label for every observation.
//!
//! One file a subject: what a batch holds (`plan`), where the points lie (`world`), how the cameras move (`motion`),
//! what is not seen (`holes`), what is wrong (`contamination`), from there to labels (`draft`), and the scenes of
//! [`Scene::generate`](super::Scene::generate) among them (`product`). Unlike those, a scene need not be reproducible
//! piece by piece: a batch is, by its seed and number.
//!
//! # What is labelled
//! A label must be decidable from the images, or it teaches noise. So an observation is right when it lies within a
//! few standard deviations of the noise of its track's own point, however it got there; a track's own point is the one
//! that it shows most often; with fewer than [`LEAST_RIGHT_IN_TRACK`] right observations no geometry can tell, and all
//! count as wrong; and groups of wrong tracks that agree among themselves are smaller than the group of right ones.

mod contamination;
mod draft;
mod draw;
mod holes;
mod motion;
mod plan;
mod product;
#[cfg(test)]
mod tests;
mod world;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use self::draft::Draft;
use self::plan::Plan;

/// Right observations without which a track has none: any two images of a point agree with some point.
pub const LEAST_RIGHT_IN_TRACK: usize = 3;

/// One training scene with its labels. Arrays are view by view, then track by track (index = view * tracks + track).
#[derive(Debug, Clone, PartialEq)]
pub struct TrainingScene {
    pub views: usize,
    pub tracks: usize,
    /// Image points in image widths, with any origin; `[0, 0]` where there is no observation.
    pub points: Vec<[f64; 2]>,
    pub visible: Vec<bool>,
    /// Whether there is an observation, and it is of its track's own point.
    pub right: Vec<bool>,
    /// One entry a track: all visible observations are right, and there are [`LEAST_RIGHT_IN_TRACK`] or more.
    pub inlier: Vec<bool>,
}

impl TrainingScene {
    /// Labels the tracks from their observations; `right` says whether an observation is of its track's own point,
    /// seen or not.
    fn new(views: usize, tracks: usize, mut points: Vec<[f64; 2]>, visible: Vec<bool>, mut right: Vec<bool>) -> Self {
        for k in (0..visible.len()).filter(|&k| !visible[k]) {
            points[k] = [0.0; 2];
            right[k] = false;
        }
        let mut inlier = vec![false; tracks];
        for (track, inlier) in inlier.iter_mut().enumerate() {
            let of_track = || (0..views).map(|view| view * tracks + track);
            let count = of_track().filter(|&k| right[k]).count();
            if count < LEAST_RIGHT_IN_TRACK {
                of_track().for_each(|k| right[k] = false);
            } else {
                *inlier = of_track().all(|k| right[k] || !visible[k]);
            }
        }
        Self { views, tracks, points, visible, right, inlier }
    }
}

/// Several scenes of one size (views, tracks), so that they can be computed side by side.
///
/// The same seed and batch number give the same scenes, whatever else was drawn. Every scene has 4 to 20 views, 50 to
/// 500 tracks and at least four inlier tracks, every track three observations, and every view eight.
pub fn batch(seed: u64, number: u64) -> Vec<TrainingScene> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(number);
    let plan = Plan::draw(&mut rng);
    (0..plan.scenes).map(|_| scene(&plan, &mut rng)).collect()
}

fn scene(plan: &Plan, rng: &mut ChaCha8Rng) -> TrainingScene {
    if plan.draws_product_scene(rng)
        && let Some(scene) = product::draw(plan.views, plan.tracks, rng)
    {
        return scene;
    }
    Draft::draw(plan, rng).finish(rng)
}
