//! Wrong tracks that agree among themselves, or with some of the views.

use nalgebra::Vector3;
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::{Frame, Kind, image_size};
use crate::synthetic::training_scenes::draft::{Draft, project};
use crate::synthetic::training_scenes::draw::{chance, normal, uniform};
use crate::synthetic::training_scenes::motion::MIN_DEPTH;

/// Share of the wrong tracks that are in a group; what else is wrong is permuted.
const IN_GROUP: (f64, f64) = (0.2, 1.0);
/// Size of a second body as a multiple of the number of right tracks. Below 1, or it would be the first.
const SECOND_BODY: (f64, f64) = (0.2, 0.7);
/// Most tracks of a group as a multiple of the number of right tracks: below 1 where the group agrees in all views,
/// above it where its tracks agree with a part of the views only, each with another one.
const MOST_ALIKE: f64 = 0.8;
const MOST_LOCAL: f64 = 2.0;
const MOST_SLID: f64 = 3.0;
/// Standard deviation of the logarithm of the factor by which a slid point is farther from, or nearer to, the first
/// camera.
const SLIDE: (f64, f64) = (0.2, 0.6);
/// Slides tried for one observation before it stays where it is: a point must be in front of the camera.
const SLIDE_DRAWS: usize = 8;
/// Standard deviation of each coordinate of a shift, as a share of the image.
const SHIFT: (f64, f64) = (0.05, 0.3);
/// Jitter of what sticks to the sensor, in image widths, in half of the scenes.
const STATIC_JITTER: f64 = 0.01;
/// Clusters, their standard deviation as a share of the image, and in that of the noise: among tracks that are as
/// close to one place as the noise allows, right and wrong cannot be told apart.
const CLUSTERS: usize = 4;
const CLUSTER_SIZE: (f64, f64) = (0.01, 0.08);
const CLUSTER_SIZE_IN_NOISE: f64 = 4.0;
/// How far wrong points are from their place in repeated texture: a share of the image, but so many standard deviations
/// of the noise at least, times a factor along each axis.
const LOCAL: (f64, f64) = (0.02, 0.2);
const LOCAL_IN_NOISE: f64 = 6.0;
const LOCAL_FACTOR: (f64, f64) = (0.5, 1.5);
/// Share of the views in which such a track is wrong.
const LOCALLY_WRONG: (f64, f64) = (0.3, 1.0);

/// How many of the wrong tracks are in the group, given how many tracks are right.
pub fn size(draft: &Draft, kind: Kind, right: usize, wrong: usize, rng: &mut ChaCha8Rng) -> usize {
    if draft.recipe.dominant {
        return wrong;
    }
    let right = right as f64;
    let size = match kind {
        Kind::SecondMotion => right * uniform(SECOND_BODY, rng),
        _ => {
            let most = match kind {
                Kind::Slid => MOST_SLID,
                Kind::Local => MOST_LOCAL,
                _ => MOST_ALIKE,
            };
            (wrong as f64 * uniform(IN_GROUP, rng)).min(right * most)
        }
    };
    (size as usize).min(wrong)
}

/// Spoils the tracks of a group.
pub fn spoil(draft: &mut Draft, kind: Kind, group: &[usize], frames: &[Frame], rng: &mut ChaCha8Rng) {
    match kind {
        Kind::SecondMotion => move_apart(draft, group, rng),
        Kind::Slid => slide(draft, group, rng),
        Kind::Shifted => shift(draft, group, image_size(frames), rng),
        Kind::Local => displace(draft, group, image_size(frames), rng),
        Kind::Static => stick(draft, group, rng),
        Kind::Clusters => gather(draft, group, frames, rng),
        Kind::Permuted | Kind::Uniform | Kind::Partial | Kind::Chained => {}
    }
}

/// Gives the group a motion of its own, of the same kind as the cameras'.
fn move_apart(draft: &mut Draft, group: &[usize], rng: &mut ChaCha8Rng) {
    let body: Vec<Vector3<f64>> = group.iter().map(|&track| draft.world.points[track]).collect();
    if body.is_empty() {
        return;
    }
    for (view, pose) in draft.path.poses(draft.views, &body, rng).iter().enumerate() {
        for (&track, point) in group.iter().zip(&body) {
            draft.image[view * draft.tracks + track] = project(pose, point, draft.world.focal);
        }
    }
}

/// Moves the group's points along their rays from the first camera, in every other view to another depth.
fn slide(draft: &mut Draft, group: &[usize], rng: &mut ChaCha8Rng) {
    let deviation = uniform(SLIDE, rng);
    let centre = draft.poses[0].centre();
    for view in 1..draft.views {
        for &track in group {
            let ray = draft.world.points[track] - centre;
            let pose = draft.poses[view];
            let slid = (0..SLIDE_DRAWS)
                .map(|_| centre + ray * (normal(rng) * deviation).exp())
                .find(|point| pose.apply(point).z > MIN_DEPTH);
            if let Some(point) = slid {
                draft.image[view * draft.tracks + track] = project(&pose, &point, draft.world.focal);
            }
        }
    }
}

/// Which views of a group's track are spoilt: each with this probability, but at least one, and not all.
fn spoilt_views(views: usize, share: f64, rng: &mut ChaCha8Rng) -> Vec<bool> {
    let mut spoilt: Vec<bool> = (0..views).map(|_| chance(share, rng)).collect();
    let (wrong, right) = (rng.random_range(0..views), rng.random_range(1..views));
    spoilt[wrong] = true;
    spoilt[(wrong + right) % views] = false;
    spoilt
}

/// Displaces the group by one vector, each track in about half of its views: in no view more than the right tracks.
fn shift(draft: &mut Draft, group: &[usize], image_size: f64, rng: &mut ChaCha8Rng) {
    let size = uniform(SHIFT, rng) * image_size;
    let by = [size * normal(rng), size * normal(rng)];
    for &track in group {
        for (view, spoilt) in spoilt_views(draft.views, 0.5, rng).into_iter().enumerate() {
            if spoilt {
                let [x, y] = &mut draft.image[view * draft.tracks + track];
                (*x, *y) = (*x + by[0], *y + by[1]);
            }
        }
    }
}

/// Displaces each of the group's points by a vector of its own, in some views.
fn displace(draft: &mut Draft, group: &[usize], image_size: f64, rng: &mut ChaCha8Rng) {
    let size = (uniform(LOCAL, rng) * image_size).max(LOCAL_IN_NOISE * draft.noise);
    let share = uniform(LOCALLY_WRONG, rng);
    for &track in group {
        for (view, spoilt) in spoilt_views(draft.views, share, rng).into_iter().enumerate() {
            if spoilt {
                for coordinate in &mut draft.image[view * draft.tracks + track] {
                    let by = size * uniform(LOCAL_FACTOR, rng);
                    *coordinate += if chance(0.5, rng) { by } else { -by };
                }
            }
        }
    }
}

/// Leaves the group where it is in one of the views.
fn stick(draft: &mut Draft, group: &[usize], rng: &mut ChaCha8Rng) {
    let from = rng.random_range(0..draft.views);
    let jitter = if chance(0.5, rng) { STATIC_JITTER } else { 0.0 };
    for view in 0..draft.views {
        for &track in group {
            let [x, y] = draft.exact[from * draft.tracks + track];
            draft.image[view * draft.tracks + track] = [x + jitter * normal(rng), y + jitter * normal(rng)];
        }
    }
}

/// Puts the group into a few clusters, which are elsewhere in every view.
fn gather(draft: &mut Draft, group: &[usize], frames: &[Frame], rng: &mut ChaCha8Rng) {
    let size = (uniform(CLUSTER_SIZE, rng) * image_size(frames)).max(CLUSTER_SIZE_IN_NOISE * draft.noise);
    let cluster: Vec<usize> = group.iter().map(|_| rng.random_range(0..CLUSTERS)).collect();
    for (view, frame) in frames.iter().enumerate() {
        let centres: [[f64; 2]; CLUSTERS] = std::array::from_fn(|_| frame.anywhere(rng));
        for (&track, &cluster) in group.iter().zip(&cluster) {
            let [x, y] = centres[cluster];
            draft.image[view * draft.tracks + track] = [x + size * normal(rng), y + size * normal(rng)];
        }
    }
}
