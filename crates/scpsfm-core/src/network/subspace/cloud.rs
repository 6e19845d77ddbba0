//! What the network is shown: image points in units of their view's own spread.

use super::{MOST_OFFSET, SPREAD_PER_DEVIATION};
use crate::geometry::statistics::midpoint_median;

/// Least unit of length of a view, in the units of its points: all in one place are not spread apart.
const LEAST_SPREAD: f64 = 1e-6;

/// Tracks of several views, normalised view by view: the median at the origin, 1.5 median absolute deviations for a
/// unit, what is farther out than [`MOST_OFFSET`] brought to it.
#[derive(Debug, Clone, PartialEq)]
pub struct Cloud {
    views: usize,
    tracks: usize,
    /// View by view: all x, then all y; 0 where unobserved.
    places: Vec<f32>,
    /// View by view: 1 where observed, else 0.
    visible: Vec<f32>,
}

impl Cloud {
    /// * `points`: view by view, then track by track, in any unit; what is unobserved is not looked at
    /// * `visible`: whether each is observed
    ///
    /// # Panics
    /// When either has other than views x tracks entries.
    pub fn new(views: usize, tracks: usize, points: &[[f64; 2]], visible: &[bool]) -> Self {
        assert_eq!(points.len(), views * tracks, "one point for each view and track");
        assert_eq!(visible.len(), views * tracks, "one mark for each view and track");
        let mut places = vec![0.0; 2 * views * tracks];
        for view in 0..views {
            let here = view * tracks..(view + 1) * tracks;
            let place = &mut places[2 * here.start..2 * here.end];
            normalise(&points[here.clone()], &visible[here], place);
        }
        Self { views, tracks, places, visible: visible.iter().map(|&seen| f32::from(u8::from(seen))).collect() }
    }

    pub fn views(&self) -> usize {
        self.views
    }

    pub fn tracks(&self) -> usize {
        self.tracks
    }

    /// Views x 2 x tracks.
    pub fn places(&self) -> &[f32] {
        &self.places
    }

    /// Views x tracks, 1 where observed.
    pub fn visible(&self) -> &[f32] {
        &self.visible
    }
}

/// One view: `place` gets all x, then all y.
fn normalise(points: &[[f64; 2]], visible: &[bool], place: &mut [f32]) {
    let seen = || points.iter().zip(visible).filter(|(_, seen)| **seen).map(|(point, _)| point);
    let centre = [0, 1].map(|axis| midpoint_median(&mut seen().map(|point| point[axis]).collect::<Vec<_>>()));
    let offsets = seen().flat_map(|point| [0, 1].map(|axis| (point[axis] - centre[axis]).abs()));
    let unit = (SPREAD_PER_DEVIATION * midpoint_median(&mut offsets.collect::<Vec<_>>())).max(LEAST_SPREAD);
    let most = f64::from(MOST_OFFSET);
    for (track, (point, _)) in points.iter().zip(visible).enumerate().filter(|(_, (_, seen))| **seen) {
        for axis in [0, 1] {
            let offset = ((point[axis] - centre[axis]) / unit).clamp(-most, most);
            place[axis * points.len() + track] = offset as f32;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_view_is_centred_on_its_median_in_units_of_its_spread() {
        let points = [[0.0, 10.0], [1.0, 10.0], [2.0, 10.0], [1e9, f64::NAN]];
        let cloud = Cloud::new(1, 4, &points, &[true, true, true, false]);
        // Medians 1 and 10; deviations 1 0 1 and 0 0 0, their median 0: the unit is the least.
        assert_eq!(cloud.places(), [-5.0, 0.0, 5.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
        assert_eq!(cloud.visible(), [1.0, 1.0, 1.0, 0.0]);

        let points = [[0.0, 0.0], [2.0, 4.0], [4.0, 8.0], [6.0, 12.0]];
        let cloud = Cloud::new(1, 4, &points, &[true; 4]);
        // Medians 3 and 6; deviations 3 1 1 3 and 6 2 2 6, their median 2.5, the unit 3.75.
        let expected = [-3.0, -1.0, 1.0, 3.0, -6.0, -2.0, 2.0, 6.0].map(|offset: f32| offset / 3.75);
        for (found, expected) in cloud.places().iter().zip(expected) {
            assert!((found - expected).abs() < 1e-6, "{:?}", cloud.places());
        }
    }

    #[test]
    fn an_empty_view_is_zeros() {
        let cloud = Cloud::new(1, 2, &[[1.0, 2.0]; 2], &[false; 2]);
        assert_eq!(cloud.places(), [0.0; 4]);
    }
}
