//! The inputs.

use super::{Declared, Generator};
use crate::synthetic::{Motion, SceneOptions, SequenceOptions};

/// A kind of input.
#[derive(Debug, Clone)]
pub struct Condition {
    pub name: String,
    pub generator: Generator,
    pub declared: Declared,
}

/// Every condition.
pub fn all() -> Vec<Condition> {
    grid().chain(straight()).chain(zooms()).chain(four_cameras()).collect()
}

/// Right tracks that hold wrong observations: 10 views, 200 tracks, noise of .3 %; complete, and with one observation
/// of each track deleted; without depths and with them.
fn grid() -> impl Iterator<Item = Condition> {
    let tracks = [0.0, 0.3, 0.5, 0.7].into_iter();
    let counts = tracks.flat_map(|outliers| [1, 2, 3].map(|count| (outliers, count)));
    counts.flat_map(|(outliers, wrong_observations)| {
        let kinds = [
            ("complete", 0, false),
            ("deleted", 1, false),
            ("complete with depths", 0, true),
            ("deleted with depths", 1, true),
        ];
        kinds.map(|(name, deleted_observations, with_depths)| {
            let options = SceneOptions {
                outliers,
                wrong_observations,
                deleted_observations,
                with_depths,
                ..SceneOptions::default()
            };
            Condition {
                name: format!("{name} {outliers}, K {wrong_observations}"),
                generator: Generator::Scene(options),
                declared: Declared::OneCamera,
            }
        })
    })
}

/// Cameras that move and do not turn, so that nothing can be calibrated: at random, on a grid and on a straight walk;
/// each track is observed by some neighbouring views.
fn straight() -> impl Iterator<Item = Condition> {
    let scene = |name: &str, motion: Motion, views: usize| {
        let (tracks, noise, outliers) = (30 * views, 0.0005, 0.3);
        let options = SceneOptions { views, tracks, noise, outliers, motion, seen_views: 5, ..SceneOptions::default() };
        Condition {
            name: format!("{name}, {views} views"),
            generator: Generator::Scene(options),
            declared: Declared::OneCamera,
        }
    };
    let walk = |views: usize| {
        let lifetime = SequenceOptions::lifetime_within(views);
        let options =
            SequenceOptions { views, tracks: 50 * views, lifetime, straight: views, ..SequenceOptions::default() };
        Condition {
            name: format!("straight walk, {views} views"),
            generator: Generator::Sequence(options),
            declared: Declared::OneCamera,
        }
    };
    let random = [7, 15, 40].into_iter().map(move |views| scene("translation", Motion::PureTranslation, views));
    let grids = [9, 16, 36].into_iter().map(move |views| scene("grid", Motion::Grid, views));
    random.chain(grids).chain([7, 15, 40].into_iter().map(walk))
}

/// A zoom: the last focal length is longer than the first by a share, under a lens that stays.
fn zooms() -> impl Iterator<Item = Condition> {
    let changes = [0.05, 0.2, 0.5].into_iter();
    changes.flat_map(|change| [0.0, -0.1, -0.2].map(|k1| (change, k1))).map(|(change, radial_k1)| {
        // The generator's is about the middle: (1 + zoom) / (1 - zoom) = 1 + change.
        let zoom = change / (2.0 + change);
        Condition {
            name: format!("zoom {:.0} %, k1 {radial_k1}", 100.0 * change),
            generator: Generator::Sequence(SequenceOptions { zoom, ramp: true, radial_k1, ..Default::default() }),
            declared: Declared::FocalPerView,
        }
    })
}

/// Four views of four cameras under strong lenses, declared as such and as one camera.
fn four_cameras() -> impl Iterator<Item = Condition> {
    let options = SceneOptions::four_cameras();
    [("groups", Declared::Groups), ("one camera", Declared::OneCamera)].into_iter().map(move |(name, declared)| {
        Condition { name: format!("four cameras as {name}"), generator: Generator::Scene(options.clone()), declared }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_condition_makes_inputs_and_has_a_name_of_its_own() {
        let mut names = std::collections::HashSet::new();
        for condition in all() {
            let made = condition.generator.with_seed(1).generate();
            made.unwrap_or_else(|error| panic!("{}: {error}", condition.name));
            assert!(names.insert(condition.name.clone()), "{} twice", condition.name);
        }
    }
}
