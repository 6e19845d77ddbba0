//! How widely the image points of a block are spread: the yardstick of chance.

use crate::geometry::measurement::CompleteBlock;
use crate::geometry::statistics::{DEVIATION_PER_MEDIAN, median};

/// Largest spread that points of an image can have: half its side.
pub const MOST_SPREAD: f64 = 0.5;

/// Standard deviation of the image points from the middle of their view, one coordinate, normalised units: median
/// over the views of a robust estimate, for a single far point must not make chance look small.
pub fn spread(block: &CompleteBlock) -> f64 {
    let mut spreads: Vec<f64> = (0..block.views())
        .map(|view| {
            let of_axis = |axis: usize| {
                let mut values: Vec<f64> = (0..block.tracks()).map(|track| block.point(view, track)[axis]).collect();
                let middle = median(&mut values);
                values.iter_mut().for_each(|value| *value = (*value - middle).abs());
                median(&mut values)
            };
            DEVIATION_PER_MEDIAN * (of_axis(0) + of_axis(1)) / 2.0
        })
        .collect();
    median(&mut spreads).clamp(f64::MIN_POSITIVE, MOST_SPREAD)
}
