//! A scene in the making: the exact images of a rigid scene, what contamination makes of them, and the labels that
//! follow.

use rand_chacha::ChaCha8Rng;

use super::TrainingScene;
use super::contamination::{self, Recipe};
use super::draw::normal;
use super::motion::Path;
use super::plan::Plan;
use super::world::World;
use crate::synthetic::scene::Pose;

/// Noise at most, as a share of the median deviation of a view's coordinates from their medians: beyond it the images
/// of near points cannot be told apart. It is 4 % of the image width for the paper's box.
const MOST_NOISE: f64 = 0.2;
/// An observation within so many standard deviations of the noise of its track's own point is right, however it got
/// there: 4 % of the right ones are farther off.
const RIGHT_WITHIN: f64 = 2.5;

/// All of a scene but its noise and labels. Arrays with one entry an observation are view by view, then track by
/// track.
#[derive(Debug, Clone)]
pub struct Draft {
    pub views: usize,
    pub tracks: usize,
    pub world: World,
    pub path: Path,
    pub poses: Vec<Pose>,
    pub visible: Vec<bool>,
    pub recipe: Recipe,
    /// Standard deviation of the noise, in image widths.
    pub noise: f64,
    /// Image of each point in each view, in image widths from the principal point.
    pub exact: Vec<[f64; 2]>,
    /// What the tracks show, before the noise.
    pub image: Vec<[f64; 2]>,
    /// The point that each track is of: the one of its own number, unless a chain shows another one more often.
    pub own: Vec<usize>,
}

impl Draft {
    pub fn draw(plan: &Plan, rng: &mut ChaCha8Rng) -> Self {
        let (views, tracks) = (plan.views, plan.tracks);
        let world = World::draw(tracks, rng);
        let path = Path::draw(&world, rng);
        let poses = path.poses(views, &world.points, rng);
        let visible = plan.holes.draw(views, tracks, rng);
        let recipe = Recipe::draw(plan, rng);
        let exact: Vec<[f64; 2]> =
            poses.iter().flat_map(|pose| world.points.iter().map(|point| project(pose, point, world.focal))).collect();
        let noise = recipe.noise.min(MOST_NOISE * deviation(&exact, tracks));
        let image = exact.clone();
        let own = (0..tracks).collect();
        let mut draft = Self { views, tracks, world, path, poses, visible, recipe, noise, exact, image, own };
        contamination::apply(&mut draft, rng);
        draft
    }

    /// Tells right observations from wrong ones by where they are, and adds the noise.
    pub fn finish(self, rng: &mut ChaCha8Rng) -> TrainingScene {
        let within = RIGHT_WITHIN * self.noise;
        let mut right = Vec::with_capacity(self.image.len());
        let mut points = Vec::with_capacity(self.image.len());
        for (k, &[x, y]) in self.image.iter().enumerate() {
            let [own_x, own_y] = self.exact[k - k % self.tracks + self.own[k % self.tracks]];
            let is_right = (x - own_x).hypot(y - own_y) <= within;
            let [x, y] = if is_right { [own_x, own_y] } else { [x, y] };
            points.push([x + self.noise * normal(rng), y + self.noise * normal(rng)]);
            right.push(is_right);
        }
        TrainingScene::new(self.views, self.tracks, points, self.visible, right)
    }
}

/// Image of a point in image widths from the principal point.
pub fn project(pose: &Pose, point: &nalgebra::Vector3<f64>, focal: f64) -> [f64; 2] {
    let seen = pose.apply(point);
    [focal * seen.x / seen.z, focal * seen.y / seen.z]
}

/// Median over the views of the median deviation of the coordinates from their medians.
fn deviation(exact: &[[f64; 2]], tracks: usize) -> f64 {
    let of_view = |view: &[[f64; 2]]| {
        let mut off: Vec<f64> = Vec::with_capacity(2 * tracks);
        for axis in 0..2 {
            let centre = median(view.iter().map(|point| point[axis]).collect());
            off.extend(view.iter().map(|point| (point[axis] - centre).abs()));
        }
        median(off)
    };
    median(exact.chunks(tracks).map(of_view).collect())
}

/// The upper median of at least one number.
fn median(mut numbers: Vec<f64>) -> f64 {
    let middle = numbers.len() / 2;
    *numbers.select_nth_unstable_by(middle, f64::total_cmp).1
}
