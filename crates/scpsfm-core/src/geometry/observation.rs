//! One image point.

use nalgebra::Vector2;

/// An image point of a track in a view, in normalised coordinates.
///
/// Indices are into the slices of views (cameras) and points that it is used with. What is adjusted ignores
/// observations with an index out of range, a coordinate that is not finite, or a weight that is not finite and
/// positive.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Observation {
    pub view: usize,
    pub point: usize,
    /// Pixels minus the guessed principal point, over the larger image side.
    pub xy: Vector2<f64>,
    /// Factor on the squared residual: `(sigma / own sigma)^2`, 1 for an observation as noisy as most.
    pub weight: f64,
}

impl Observation {
    /// One that is as noisy as most.
    pub fn new(view: usize, point: usize, xy: Vector2<f64>) -> Self {
        Self { view, point, xy, weight: 1.0 }
    }

    /// Whether it can be used with so many views and points.
    pub fn is_usable(&self, views: usize, points: usize) -> bool {
        self.view < views
            && self.point < points
            && self.xy.iter().all(|x| x.is_finite())
            && self.weight > 0.0
            && self.weight.is_finite()
    }
}

/// A point that is known, and where a camera sees it.
#[derive(Debug, Clone, Copy)]
pub struct Correspondence<P> {
    pub point: P,
    pub xy: Vector2<f64>,
    /// As [`Observation::weight`].
    pub weight: f64,
}

/// How many of so many points have an observation.
pub fn observed_points(observations: &[Observation], points: usize) -> usize {
    let mut seen = vec![false; points];
    for observation in observations {
        if let Some(seen) = seen.get_mut(observation.point) {
            *seen = true;
        }
    }
    seen.iter().filter(|seen| **seen).count()
}
