//! Training scenes that are scenes of [`Scene::generate`], on which the product is evaluated: its motions, shapes,
//! noises, lenses and outliers.

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::TrainingScene;
use super::draw::{chance, log_uniform, pick, uniform};
use crate::synthetic::scene::{IMAGE_SIDE_PX, Motion, NoiseKind, OutlierKind, Scene, SceneOptions, Shape};

/// Noise, beyond the paper's largest (1 %) in both directions.
const NOISE: (f64, f64) = (2e-4, 0.03);
const NOISE_KINDS: [(NoiseKind, f64); 4] =
    [(NoiseKind::Gaussian, 0.55), (NoiseKind::Heavy, 0.2), (NoiseKind::Laplace, 0.15), (NoiseKind::Uniform, 0.1)];
/// Share of the scenes with a moderate share of outliers, that share, and the share of the others, as in the rest of
/// the training scenes.
const MODERATE: f64 = 0.4;
const MODERATE_WRONG: (f64, f64) = (0.3, 0.9);
const HARD_WRONG: (f64, f64) = (0.88, 0.98);
const LEAST_RIGHT: f64 = 5.0;
/// Kinds of outliers; the paper's leads.
const OUTLIER_KINDS: [(OutlierKind, f64); 4] = [
    (OutlierKind::Permuted, 0.5),
    (OutlierKind::Uniform, 0.15),
    (OutlierKind::Slid, 0.15),
    (OutlierKind::Repeated, 0.2),
];
/// Share of the scenes in which outlier tracks are wrong in some views only.
const PARTLY: f64 = 0.4;
/// Repeated structure is one group of observations, shifted alike: in a view it may hold this share of the
/// observations, so that it stays smaller than the group of right ones.
const MOST_SHIFTED: f64 = 0.4;
/// Share of the scenes with a second body, and its size as a multiple of the number of right tracks.
const SECOND_BODIES: f64 = 0.2;
const SECOND_BODY: (f64, f64) = (0.2, 0.7);
const MOTIONS: [(Motion, f64); 6] = [
    (Motion::General, 0.45),
    (Motion::Orbit, 0.15),
    (Motion::Turntable, 0.1),
    (Motion::PureTranslation, 0.1),
    (Motion::Forward, 0.12),
    (Motion::PureRotation, 0.08),
];
/// Share of the scenes whose points lie in a plane.
const PLANES: f64 = 0.12;
/// Largest rotations: the paper's and around it, and in the rest of the scenes as large as they get.
const TURN_RAD: (f64, f64) = (0.1, 0.5);
const WIDE_TURNS: f64 = 0.25;
const WIDE_TURN_RAD: (f64, f64) = (0.5, std::f64::consts::PI);
/// Share of the scenes with each departure from the paper's camera, and how far they go: stronger barrels than this
/// fold the images of near cameras, and the generator would search long for others.
const DEPARTURES: f64 = 0.2;
const RADIAL_K1: (f64, f64) = (-0.05, 0.1);
const DISPLACEMENT: (f64, f64) = (-0.1, 0.1);
const ZOOM: (f64, f64) = (0.05, 0.3);

/// A scene of this size as a training scene; `None` if no camera of the drawn kind sees the whole scene.
pub fn draw(views: usize, tracks: usize, rng: &mut ChaCha8Rng) -> Option<TrainingScene> {
    let scene = Scene::generate(&options(views, tracks, rng)).ok()?;
    let side_px = f64::from(IMAGE_SIDE_PX);
    let points = scene.input.x.iter().zip(&scene.input.y).map(|(x, y)| [x / side_px, y / side_px]).collect();
    Some(TrainingScene::new(views, tracks, points, vec![true; views * tracks], scene.truth.observation_right))
}

/// Options of a random scene; its seed is drawn from all there are, so that scenes of small seeds, on which results are
/// reported, are not among the scenes.
pub fn options(views: usize, tracks: usize, rng: &mut ChaCha8Rng) -> SceneOptions {
    let outlier_kind = pick(&OUTLIER_KINDS, rng);
    let motion = match pick(&MOTIONS, rng) {
        // Nothing slides where the camera stays.
        Motion::PureRotation if outlier_kind == OutlierKind::Slid => Motion::General,
        motion => motion,
    };
    let wrong_views = if chance(PARTLY, rng) { rng.random_range(1..=outlier_kind.most_wrong_views(views)) } else { 0 };
    let outliers = draw_outliers(views, tracks, outlier_kind, wrong_views, rng);
    let second_body = if chance(SECOND_BODIES, rng) { uniform(SECOND_BODY, rng) } else { 0.0 };
    // Cameras that turn on the spot would soon look elsewhere.
    let turns_about_scene = matches!(motion, Motion::General | Motion::Orbit | Motion::Turntable);
    let turns_widely = turns_about_scene && chance(WIDE_TURNS, rng);
    let [right, down, radial_k1, zoom] = [DISPLACEMENT, DISPLACEMENT, RADIAL_K1, ZOOM]
        .map(|range| if chance(DEPARTURES, rng) { uniform(range, rng) } else { 0.0 });
    SceneOptions {
        views,
        tracks,
        noise: log_uniform(NOISE, rng),
        noise_kind: pick(&NOISE_KINDS, rng),
        outliers,
        outlier_kind,
        wrong_views,
        second_motion: (second_body * (1.0 - outliers)).min(outliers),
        shape: if chance(PLANES, rng) { Shape::Plane } else { Shape::Box },
        motion,
        max_rotation_rad: uniform(if turns_widely { WIDE_TURN_RAD } else { TURN_RAD }, rng),
        // Kept, as cameras on a sphere are, to show what the network makes of what it has not seen.
        max_roll_rad: 0.0,
        principal_point: [right, down],
        radial_k1,
        zoom,
        with_depths: false,
        seed: rng.random(),
        ..SceneOptions::default()
    }
}

/// The share of outlier tracks.
fn draw_outliers(views: usize, tracks: usize, kind: OutlierKind, wrong_views: usize, rng: &mut ChaCha8Rng) -> f64 {
    let range = if chance(MODERATE, rng) { MODERATE_WRONG } else { HARD_WRONG };
    let outliers = uniform(range, rng).min(1.0 - LEAST_RIGHT / tracks as f64);
    if kind == OutlierKind::Repeated {
        let shifted_views = if wrong_views == 0 { views / 2 } else { wrong_views };
        outliers.min(MOST_SHIFTED * views as f64 / shifted_views as f64)
    } else {
        outliers
    }
}
