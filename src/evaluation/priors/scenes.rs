//! Scenes without depths on which priors are compared.

use crate::synthetic::{Motion, OutlierKind, SceneOptions};

/// A kind of scene.
#[derive(Debug, Clone)]
pub struct Condition {
    pub name: &'static str,
    options: SceneOptions,
}

impl Condition {
    /// The scene of a seed.
    pub fn scene(&self, seed: u64) -> SceneOptions {
        SceneOptions { seed, ..self.options.clone() }
    }
}

/// A quarter turn either way: what a camera that orbits a scene sees of it.
const QUARTER_TURN: f64 = std::f64::consts::FRAC_PI_2;

/// Every condition, those of training's kind first, then what lies outside it.
pub fn all() -> Vec<Condition> {
    let paper = SceneOptions::default;
    let at = |outliers| SceneOptions { outliers, ..paper() };
    let orbit = |outliers| SceneOptions { outliers, motion: Motion::Orbit, max_rotation_rad: QUARTER_TURN, ..paper() };
    let kind = |outlier_kind| SceneOptions { outliers: 0.7, outlier_kind, ..paper() };
    let conditions = [
        ("outliers .9", at(0.9)),
        ("outliers .95", at(0.95)),
        ("outliers .96", at(0.96)),
        ("outliers .97", at(0.97)),
        ("outliers .98", at(0.98)),
        ("orbit .9", orbit(0.9)),
        ("orbit .95", orbit(0.95)),
        ("orbit .97", orbit(0.97)),
        ("any roll, .97", SceneOptions { outliers: 0.97, max_roll_rad: std::f64::consts::PI, ..paper() }),
        ("noise 5 %, .9", SceneOptions { noise: 0.05, ..paper() }),
        ("20 x 50, .9", SceneOptions { views: 20, tracks: 50, noise: 0.006, ..paper() }),
        ("5 views, .9", SceneOptions { views: 5, ..paper() }),
        ("second motion .3", SceneOptions { outliers: 0.6, second_motion: 0.3, ..paper() }),
        ("slid .7", kind(OutlierKind::Slid)),
        ("repeated .7", kind(OutlierKind::Repeated)),
        ("turntable .9", SceneOptions { motion: Motion::Turntable, max_rotation_rad: QUARTER_TURN, ..paper() }),
        ("12 tracks, .2", SceneOptions { tracks: 12, ..at(0.2) }),
        ("30 tracks, .6", SceneOptions { tracks: 30, ..at(0.6) }),
        ("sphere, .9", SceneOptions { motion: Motion::Sphere, ..paper() }),
        ("sphere, .95", SceneOptions { motion: Motion::Sphere, outliers: 0.95, ..paper() }),
        ("40 views, .95", SceneOptions { views: 40, outliers: 0.95, ..paper() }),
        ("3000 tracks, .98", SceneOptions { tracks: 3_000, outliers: 0.98, ..paper() }),
        ("3000 tracks, all wrong", SceneOptions { tracks: 3_000, ..at(1.0) }),
        ("500 x 20, .96", SceneOptions { views: 20, tracks: 500, noise: 0.006, ..at(0.96) }),
        ("distorted, .9", SceneOptions { radial_k1: -0.3, ..paper() }),
        ("zoom, .9", SceneOptions { zoom: 0.5, ..paper() }),
        ("all wrong", at(1.0)),
    ];
    conditions.into_iter().map(|(name, options)| Condition { name, options }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_condition_makes_scenes() {
        for condition in all() {
            condition.scene(1).validate().unwrap_or_else(|error| panic!("{}: {error}", condition.name));
        }
    }
}
