//! Long sequences: the same motion at any length, with the observations of a view held.

use std::f64::consts::TAU;

use super::{FocalKind, LensKind, PhotographedMotion, PhotographedOptions, VisibilityKind, WrongKind};

/// Motions of any length.
pub const MOTIONS: [PhotographedMotion; 4] = [
    PhotographedMotion::Drive,
    PhotographedMotion::Corridor,
    PhotographedMotion::AerialGrid,
    PhotographedMotion::WalkAround,
];
/// Tracks for each view: with the lifetimes below 500 views observe a million times.
const TRACKS_OF_VIEW: usize = 300;
/// Views of a track, as feature matching gives them.
const LIFETIME: (usize, usize) = (3, 10);
/// Of a walk around, whose tracks close the loop: the probability that a view observes a point that it is before, times
/// the views. About three views in ten are before a point.
const SEEN_VIEWS: f64 = 22.0;
/// The same probability of an aerial grid, whose flight lines overlap: some twenty views are before a point.
const SEEN_SHARE: f64 = 0.35;

impl PhotographedOptions {
    /// A sequence of so many views of one camera with a mild lens, three in ten of its tracks permuted: a drive that
    /// turns by 20 degrees, a corridor, an aerial grid or a walk all around, whose tracks close the loop.
    pub fn long(motion: PhotographedMotion, views: usize, seed: u64) -> Self {
        let (turn_rad, visibility, seen_share) = match motion {
            PhotographedMotion::Drive => (0.35, VisibilityKind::Banded, 1.0),
            PhotographedMotion::WalkAround => (TAU, VisibilityKind::Scattered, (SEEN_VIEWS / views as f64).min(1.0)),
            PhotographedMotion::AerialGrid => (0.3, VisibilityKind::Scattered, SEEN_SHARE),
            _ => (0.3, VisibilityKind::Banded, 1.0),
        };
        Self {
            views,
            tracks: TRACKS_OF_VIEW * views,
            motion,
            turn_rad,
            baseline: 0.0,
            lens: LensKind::Mild,
            focal_px: 1400.0,
            focal: FocalKind::ConstantFocal,
            focal_ratio: 1.0,
            principal_point: [0.0; 2],
            aspect: 1.0,
            radial: [-0.05, 0.0],
            noise_px: 0.5,
            visibility,
            lifetime: LIFETIME,
            seen_share,
            wrong: WrongKind::Permuted,
            wrong_share: 0.3,
            seed,
        }
    }
}
