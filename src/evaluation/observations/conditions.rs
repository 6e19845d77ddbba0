//! The inputs.

use super::{Declared, Generator};
use crate::synthetic::SceneOptions;

/// A kind of input.
#[derive(Debug, Clone)]
pub struct Condition {
    pub name: String,
    pub generator: Generator,
    pub declared: Declared,
}

/// Every condition.
pub fn all() -> Vec<Condition> {
    grid().collect()
}

/// Right tracks that hold wrong observations: 10 views, 200 tracks, noise of .3 %; complete, and with one observation of
/// each track deleted.
fn grid() -> impl Iterator<Item = Condition> {
    let tracks = [0.0, 0.3, 0.5, 0.7].into_iter();
    let counts = tracks.flat_map(|outliers| [1, 2, 3].map(|count| (outliers, count)));
    counts.flat_map(|(outliers, wrong_observations)| {
        [("complete", 0), ("deleted", 1)].map(|(name, deleted_observations)| {
            let options =
                SceneOptions { outliers, wrong_observations, deleted_observations, ..SceneOptions::default() };
            Condition {
                name: format!("{name} {outliers}, K {wrong_observations}"),
                generator: Generator::Scene(options),
                declared: Declared::OneCamera,
            }
        })
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
