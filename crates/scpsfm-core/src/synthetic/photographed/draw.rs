//! The options of a seed.

use std::f64::consts::TAU;

use rand::Rng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;

use super::stream::Stream;
use super::{FocalKind, IMAGE_SIZE, LensKind, PhotographedMotion, PhotographedOptions, VisibilityKind, WrongKind};

/// Views and tracks of a scene.
const VIEWS: (f64, f64) = (6.0, 60.0);
const TRACKS: (f64, f64) = (300.0, 1500.0);
/// Tracks for each view at least: of fewer, a view of a long walk would observe too little.
const TRACKS_OF_VIEW: usize = 15;
/// Noise of the core in pixels.
const NOISE_PX: (f64, f64) = (0.3, 1.0);
/// Views of a banded track at most, the most of them.
const LONGEST: (usize, usize) = (5, 25);
/// Probability that a view observes a point that it is before where the visibility is scattered, but no less than what
/// makes four views of all.
const SEEN_SHARE: (f64, f64) = (0.15, 0.7);
const SEEN_VIEWS: f64 = 4.0;
/// Share of wrong tracks. More than half of all on a second body, and it would be the scene.
const WRONG_SHARE: (f64, f64) = (0.1, 0.7);
const SECOND_BODY_SHARE: (f64, f64) = (0.1, 0.45);
/// Half the angle across the diagonal of a fisheye.
const FISHEYE_HALF_ANGLE_RAD: f64 = 75.0 * std::f64::consts::PI / 180.0;
/// Share of planar scenes without tilt, which determine nothing.
const FRONTO_PARALLEL: f64 = 0.15;

impl PhotographedOptions {
    /// The scene of a seed, with every choice drawn from a stream of its own. Among as many consecutive seeds as a
    /// choice has values, from a multiple of these on, each value occurs once.
    pub fn drawn(seed: u64) -> Self {
        let motion = balanced(&PhotographedMotion::ALL, Stream::MotionChoice, seed);
        let lens = balanced(&LensKind::ALL, Stream::LensChoice, seed);
        let focal = balanced(&FocalKind::ALL, Stream::FocalChoice, seed);
        let visibility = balanced(&VisibilityKind::ALL, Stream::VisibilityChoice, seed);
        let wrong = balanced(&WrongKind::ALL, Stream::WrongChoice, seed);
        let rng = &mut Stream::Sizes.of(seed);
        let views = log_uniform(VIEWS, rng).round() as usize;
        let tracks = (log_uniform(TRACKS, rng).round() as usize).max(TRACKS_OF_VIEW * views);
        let wide = matches!(lens, LensKind::ActionCamera | LensKind::Fisheye);
        let turn_rad = draw_turn(motion, wide, rng);
        let baseline = rng.random_range(0.01..0.06);
        let glass = Glass::draw(lens, rng);
        let focal_ratio = draw_ratio(focal, rng);
        // A longer focal length is always possible: that of the lens is the shortest.
        let widest = match focal {
            FocalKind::ConstantFocal => 1.0,
            FocalKind::DriftingFocal => focal_ratio.powf(-0.5).min(focal_ratio.sqrt()),
            FocalKind::TwoGroups => focal_ratio.min(1.0),
        };
        let longest = rng.random_range(LONGEST.0..=LONGEST.1).min(views);
        let seen_share = rng.random_range(SEEN_SHARE.0..SEEN_SHARE.1).max(SEEN_VIEWS / views as f64);
        let noise_px = rng.random_range(NOISE_PX.0..NOISE_PX.1);
        let (least, most) = if wrong == WrongKind::SecondBody { SECOND_BODY_SHARE } else { WRONG_SHARE };
        let wrong_share = if wrong == WrongKind::Clean { 0.0 } else { rounded(rng.random_range(least..most)) };
        Self {
            views,
            tracks,
            motion,
            turn_rad,
            baseline: rounded(baseline),
            lens,
            focal_px: (glass.focal * f64::from(IMAGE_SIZE.width_px) / widest).round(),
            focal,
            focal_ratio,
            principal_point: glass.principal_point,
            aspect: glass.aspect,
            radial: glass.radial,
            noise_px: rounded(noise_px),
            visibility,
            lifetime: (2, longest),
            seen_share: rounded(seen_share),
            wrong,
            wrong_share,
            seed,
        }
    }
}

/// The value of a choice for a seed: seeds fall into blocks as long as the choice has values, and each block has these
/// in an order of its own.
fn balanced<T: Copy>(values: &[T], stream: Stream, seed: u64) -> T {
    let count = values.len() as u64;
    let mut order = values.to_vec();
    order.shuffle(&mut stream.of(seed / count));
    order[(seed % count) as usize]
}

/// What a lens is made of.
struct Glass {
    /// In image widths.
    focal: f64,
    principal_point: [f64; 2],
    aspect: f64,
    radial: [f64; 2],
}

impl Glass {
    fn draw(lens: LensKind, rng: &mut ChaCha8Rng) -> Self {
        let plain = |range: (f64, f64), rng: &mut ChaCha8Rng| Self {
            focal: rng.random_range(range.0..range.1),
            principal_point: [0.0; 2],
            aspect: 1.0,
            radial: [0.0; 2],
        };
        let radial =
            |range: (f64, f64), k1: f64, rng: &mut ChaCha8Rng| Self { radial: [rounded(k1), 0.0], ..plain(range, rng) };
        match lens {
            LensKind::Pinhole => plain((0.7, 1.4), rng),
            LensKind::Mild => {
                let k1 = rng.random_range(0.02..0.08) * sign(rng);
                radial((0.7, 1.3), k1, rng)
            }
            LensKind::Barrel => radial((0.85, 1.2), rng.random_range(-0.2..-0.1), rng),
            LensKind::Pincushion => radial((0.9, 1.4), rng.random_range(0.06..0.2), rng),
            LensKind::ActionCamera => {
                let k1: f64 = rng.random_range(-0.3..-0.2);
                // Above .45 k1^2 nothing folds.
                let k2 = k1 * k1 * rng.random_range(0.6..0.9);
                Self { radial: [rounded(k1), rounded(k2)], ..plain((0.5, 0.65), rng) }
            }
            LensKind::Fisheye => {
                let [width, height] = [IMAGE_SIZE.width_px, IMAGE_SIZE.height_px].map(f64::from);
                let focal = 0.5 * width.hypot(height) / FISHEYE_HALF_ANGLE_RAD / width;
                Self { focal, ..plain((0.7, 1.4), rng) }
            }
            LensKind::DisplacedPrincipalPoint => {
                let (distance, direction) = (rng.random_range(0.04..0.1), rng.random_range(0.0..TAU));
                let principal_point = [distance * direction.cos(), distance * direction.sin()].map(rounded);
                Self { principal_point, ..plain((0.7, 1.4), rng) }
            }
            LensKind::Aspect => {
                let log_aspect = rng.random_range(0.03..0.1) * sign(rng);
                Self { aspect: rounded(log_aspect.exp()), ..plain((0.7, 1.4), rng) }
            }
        }
    }
}

/// How far a motion turns.
///
/// * `wide`: the lens sees twice as much, so that a turn on the spot keeps more of the scene in view
fn draw_turn(motion: PhotographedMotion, wide: bool, rng: &mut ChaCha8Rng) -> f64 {
    let wider = if wide { 1.5 } else { 1.0 };
    let (least, most) = match motion {
        PhotographedMotion::Orbit => (0.6, TAU),
        PhotographedMotion::WalkAround => (2.0, TAU),
        PhotographedMotion::HandHeld => (0.05, 0.25),
        PhotographedMotion::Corridor => (0.1, 0.35),
        PhotographedMotion::Drive => (0.35, 3.0),
        PhotographedMotion::AerialGrid => (0.3, 0.7),
        PhotographedMotion::NearRotation | PhotographedMotion::PureRotation => (0.2 * wider, 0.5 * wider),
        PhotographedMotion::Translation => return 0.0,
        PhotographedMotion::PlanarScene => {
            let tilt = rng.random_range(0.3..0.9);
            return if rng.random::<f64>() < FRONTO_PARALLEL { 0.0 } else { rounded(tilt) };
        }
    };
    rounded(rng.random_range(least..most))
}

fn draw_ratio(focal: FocalKind, rng: &mut ChaCha8Rng) -> f64 {
    let (drift, other) = (rng.random_range(0.05..0.4), rng.random_range(0.15..0.6));
    let log_ratio: f64 = match focal {
        FocalKind::ConstantFocal => 0.0,
        FocalKind::DriftingFocal => drift * sign(rng),
        FocalKind::TwoGroups => other * sign(rng),
    };
    if log_ratio == 0.0 { 1.0 } else { rounded(log_ratio.exp()) }
}

fn sign(rng: &mut ChaCha8Rng) -> f64 {
    if rng.random::<bool>() { 1.0 } else { -1.0 }
}

fn log_uniform((least, most): (f64, f64), rng: &mut ChaCha8Rng) -> f64 {
    rng.random_range(least.ln()..most.ln()).exp()
}

/// To four digits after the point: options that a reader can copy.
fn rounded(value: f64) -> f64 {
    (value * 1e4).round() / 1e4
}
