//! How widely image points are spread: the yardstick of chance.

use nalgebra::Vector2;

use crate::geometry::measurement::CompleteBlock;
use crate::geometry::statistics::{DEVIATION_PER_MEDIAN, median};

/// Largest spread that points of an image can have: half its side.
pub const MOST_SPREAD: f64 = 0.5;

/// Standard deviation of the image points of a block from the middle of their view, one coordinate, normalised units:
/// the median over the views.
pub fn spread(block: &CompleteBlock) -> f64 {
    let points = |view: usize| (0..block.tracks()).map(|track| block.point(view, track)).collect::<Vec<_>>();
    let mut spreads: Vec<f64> = (0..block.views()).map(|view| spread_of(&points(view))).collect();
    median(&mut spreads).clamp(f64::MIN_POSITIVE, MOST_SPREAD)
}

/// The same of the points of one view: a robust estimate, for a single far point must not make chance look small.
pub fn spread_of(points: &[Vector2<f64>]) -> f64 {
    let of_axis = |axis: usize| {
        let mut values: Vec<f64> = points.iter().map(|point| point[axis]).collect();
        let middle = median(&mut values);
        values.iter_mut().for_each(|value| *value = (*value - middle).abs());
        median(&mut values)
    };
    DEVIATION_PER_MEDIAN * (of_axis(0) + of_axis(1)) / 2.0
}
