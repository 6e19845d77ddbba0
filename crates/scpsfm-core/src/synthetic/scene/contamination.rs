//! Which tracks are wrong, in which views, and how.

use nalgebra::Vector3;
use rand::Rng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;

use super::camera::Camera;
use super::noise::Observation;
use super::stream::Stream;
use super::{IMAGE_SIDE_PX, SceneOptions};

/// How far apart the two of a repeated structure are, as a share of the image width: far above the noise, and near
/// enough to be taken for each other.
const REPEATED_SHIFT: (f64, f64) = (0.1, 0.2);
/// A slid point is at most so many times farther from, or nearer to, the reference camera than the track's own point.
const LARGEST_SLIDE: f64 = 3.0;
/// Distance in pixels by which a slide shall move the image, 2 % of the width: seven times the paper's noise, so that
/// what is called wrong is wrong.
const LEAST_SLIDE_PX: f64 = 0.02 * IMAGE_SIDE_PX as f64;
/// Slides tried for one observation; near an epipole none moves the image far, and the farthest is taken.
const SLIDE_DRAWS: usize = 50;

named! {
    /// What the wrong observations of an outlier track are. All but the uniform ones bring the depth of what they show.
    #[derive(Default)]
    pub enum OutlierKind {
        /// Image points of other outlier tracks in the same view, by a random permutation (paper, section 5.1). Where
        /// whole tracks are permuted, a few points stay where they are, as in the paper; else none does.
        #[default]
        Permuted = "permuted",
        /// Anywhere in the image, with the depth of a random track.
        Uniform = "uniform",
        /// Slid along the epipolar lines of view 0: in view 0 the track is right, and in every wrong view it is the
        /// image of a point on the same ray of view 0, at another depth in each. Each view agrees with view 0, but no
        /// point agrees with all views. Near an epipole (the middle of the image in forward motion) and in cameras near
        /// the first a slide moves the image little, and what is called wrong may hide in the noise.
        Slid = "slid",
        /// Taken for its like: shifted by one constant vector, the same in all views and tracks, of .1 to .2 of the
        /// width. Without a number of wrong views, half of a track's views are.
        Repeated = "repeated",
    }
}

impl OutlierKind {
    /// The first view that can be wrong: what is slid has view 0 as its reference.
    fn first_wrong_view(self) -> usize {
        usize::from(self == OutlierKind::Slid)
    }

    /// How many of so many views can be wrong in one track.
    pub fn most_wrong_views(self, views: usize) -> usize {
        views - self.first_wrong_view().min(views)
    }
}

/// What is wrong with a scene.
#[derive(Debug)]
pub struct Contamination {
    kind: OutlierKind,
    /// Whether outlier tracks are wrong throughout, not in a number of views.
    whole_tracks: bool,
    /// The outlier tracks in ascending order, those of the second body among them.
    outliers: Vec<usize>,
    second_body: Vec<bool>,
    /// The tracks that are wrong in each view, in ascending order; those of the second body are not listed.
    wrong: Vec<Vec<usize>>,
    /// Views and tracks in which right tracks are wrong.
    wrong_observations: Vec<Vec<bool>>,
    repeated_shift_px: [f64; 2],
    rng: ChaCha8Rng,
    observation_rng: ChaCha8Rng,
}

impl Contamination {
    /// Chooses the outliers from `rng`, the paper's stream, and everything else from a stream of its own.
    ///
    /// * `visible`: the views that observe each track
    pub fn draw(options: &SceneOptions, visible: &[Vec<usize>], rng: &mut ChaCha8Rng) -> Self {
        let share = |share: f64| (share * options.tracks as f64).round() as usize;
        let mut outliers: Vec<usize> = (0..options.tracks).collect();
        outliers.shuffle(rng);
        outliers.truncate(share(options.outliers));
        let mut second_body = vec![false; options.tracks];
        outliers.iter().take(share(options.second_motion)).for_each(|&track| second_body[track] = true);
        outliers.sort_unstable();

        let mut rng = Stream::Contamination.of(options.seed);
        let shift_px = f64::from(IMAGE_SIDE_PX) * rng.random_range(REPEATED_SHIFT.0..REPEATED_SHIFT.1);
        let direction = rng.random_range(0.0..std::f64::consts::TAU);
        let mut wrong = vec![Vec::new(); options.views];
        for &track in outliers.iter().filter(|&&track| !second_body[track]) {
            for view in draw_wrong_views(options, &mut rng) {
                wrong[view].push(track);
            }
        }
        let mut observation_rng = Stream::WrongObservations.of(options.seed);
        let mut wrong_observations =
            draw_observations(options.views, visible, options.wrong_observations, &mut observation_rng);
        wrong_observations.iter_mut().for_each(|of| outliers.iter().for_each(|&track| of[track] = false));
        Self {
            kind: options.outlier_kind,
            whole_tracks: options.wrong_views == 0,
            outliers,
            second_body,
            wrong,
            wrong_observations,
            repeated_shift_px: [shift_px * direction.cos(), shift_px * direction.sin()],
            rng,
            observation_rng,
        }
    }

    /// Whether each track belongs to the second body.
    pub fn second_body(&self) -> &[bool] {
        &self.second_body
    }

    /// Whether each track is no outlier.
    pub fn inlier(&self) -> Vec<bool> {
        let mut inlier = vec![true; self.second_body.len()];
        self.outliers.iter().for_each(|&track| inlier[track] = false);
        inlier
    }

    /// Spoils the observations of one view, one a track. The paper's permutation is drawn from `rng`.
    pub fn apply(
        &mut self,
        view: usize,
        cameras: &[Camera],
        points: &[Vector3<f64>],
        image: &mut [Observation],
        rng: &mut ChaCha8Rng,
    ) {
        // Drawn for every kind, so that the paper's stream goes on alike and the noise is the same.
        let mut permutation = self.outliers.clone();
        permutation.shuffle(rng);
        let wrong = std::mem::take(&mut self.wrong[view]);
        match self.kind {
            OutlierKind::Permuted if self.whole_tracks => {
                permutation.retain(|&track| !self.second_body[track]);
                exchange(image, &wrong, &permutation);
            }
            OutlierKind::Permuted => self.exchange_all(image, &wrong),
            OutlierKind::Uniform => wrong.iter().for_each(|&track| scatter(image, track, &mut self.rng)),
            OutlierKind::Slid => {
                for &track in &wrong {
                    if let Some(slid) = slide(&cameras[0], &cameras[view], &points[track], &mut self.rng) {
                        image[track] = Observation { image: slid, right: false, ..image[track] };
                    }
                }
            }
            OutlierKind::Repeated => {
                for &track in &wrong {
                    let [x, y, depth] = image[track].image;
                    let shifted = [x + self.repeated_shift_px[0], y + self.repeated_shift_px[1], depth];
                    image[track] = Observation { image: shifted, right: false, ..image[track] };
                }
            }
        }
        for (track, _) in self.wrong_observations[view].iter().enumerate().filter(|(_, wrong)| **wrong) {
            scatter(image, track, &mut self.observation_rng);
        }
    }

    /// Exchanges the points of these tracks so that none keeps its own. A track that is the only wrong one of its view
    /// gets a copy of any other track's point.
    fn exchange_all(&mut self, image: &mut [Observation], wrong: &[usize]) {
        if let [only] = *wrong {
            let other = self.other_track(only, image.len());
            return exchange(image, &[only], &[other]);
        }
        let mut cycle = wrong.to_vec();
        cycle.shuffle(&mut self.rng);
        let mut next = cycle.clone();
        next.rotate_left(cycle.len().min(1));
        exchange(image, &cycle, &next);
    }

    /// A random track other than this one; there are `count`, two or more.
    fn other_track(&mut self, track: usize, count: usize) -> usize {
        let other = self.rng.random_range(0..count - 1);
        other + usize::from(other >= track)
    }
}

/// Puts a track's point anywhere in the image; the noise of x and y is part of "anywhere".
fn scatter(image: &mut [Observation], track: usize, rng: &mut ChaCha8Rng) {
    let side_px = f64::from(IMAGE_SIDE_PX);
    let [x, y] = std::array::from_fn(|_| rng.random_range(-0.5..side_px - 0.5));
    let Observation { image: [.., depth], noise: [.., in_depth], .. } = image[rng.random_range(0..image.len())];
    image[track] = Observation { image: [x, y, depth], noise: [0.0, 0.0, in_depth], right: false };
}

/// Chooses `count` observations of every track among the views that observe it; whether chosen, by view and track.
pub fn draw_observations(views: usize, visible: &[Vec<usize>], count: usize, rng: &mut ChaCha8Rng) -> Vec<Vec<bool>> {
    let mut chosen = vec![vec![false; visible.len()]; views];
    for (track, seen) in visible.iter().enumerate() {
        seen.clone().partial_shuffle(rng, count).0.iter().for_each(|&view| chosen[view][track] = true);
    }
    chosen
}

/// The views in which one outlier track is wrong.
fn draw_wrong_views(options: &SceneOptions, rng: &mut ChaCha8Rng) -> Vec<usize> {
    let mut views: Vec<usize> = (options.outlier_kind.first_wrong_view()..options.views).collect();
    let count = match (options.wrong_views, options.outlier_kind) {
        (0, OutlierKind::Repeated) => options.views / 2,
        (0, _) => return views,
        (count, _) => count,
    };
    views.partial_shuffle(rng, count).0.to_vec()
}

/// Gives each track of `to` what its counterpart in `from` had before.
fn exchange(image: &mut [Observation], to: &[usize], from: &[usize]) {
    let original: Vec<Observation> = from.iter().map(|&track| image[track]).collect();
    for ((&to, &from), observation) in to.iter().zip(from).zip(original) {
        image[to] = Observation { right: observation.right && from == to, ..observation };
    }
}

/// Image in `camera` of a point elsewhere on the ray from `reference` to this point. `None` where every point tried is
/// too near to `camera` or behind it.
pub fn slide(reference: &Camera, camera: &Camera, point: &Vector3<f64>, rng: &mut ChaCha8Rng) -> Option<[f64; 3]> {
    let centre = reference.pose.centre();
    let [x, y, _] = camera.project(point);
    let mut farthest: Option<(f64, [f64; 3])> = None;
    for _ in 0..SLIDE_DRAWS {
        let factor = rng.random_range(-LARGEST_SLIDE.ln()..LARGEST_SLIDE.ln()).exp();
        let slid = centre + (point - centre) * factor;
        if !camera.sees(&slid) {
            continue;
        }
        let image = camera.project(&slid);
        let moved_px = (image[0] - x).hypot(image[1] - y);
        if farthest.is_none_or(|(most_px, _)| moved_px > most_px) {
            farthest = Some((moved_px, image));
        }
        if moved_px >= LEAST_SLIDE_PX {
            break;
        }
    }
    farthest.map(|(_, image)| image)
}
