//! The transform from pixels that a whole solve uses.

use nalgebra::Vector2;

use crate::domain::image_fit::{self, ImageFitOptions};
use crate::domain::{ImageSize, Input, Warning, WarningCode};
use crate::geometry::measurement::Normalization;

/// The transform from pixels of a solve: principal points assumed in the image centres, lengths in units of the largest
/// image side.
pub fn normalization(input: &Input) -> (Normalization, Vec<Warning>) {
    let mut warnings = Vec::new();
    // One camera took the views of unknown size: one centre, or its principal point would move from view to view.
    let [low, high] = extent_of_unsized(input);
    let assumed = ((low + high) / 2.0, (high - low).amax());
    let frames: Vec<(Vector2<f64>, f64)> = input
        .views()
        .iter()
        .map(|view| {
            view.size.map_or(assumed, |size| (image_centre(size), f64::from(size.width_px.max(size.height_px))))
        })
        .collect();
    let scale_px = frames.iter().map(|(_, side)| *side).fold(0.0, f64::max);
    let centres_px = frames.into_iter().map(|(centre, _)| centre).collect();
    let unknown = input.views().iter().filter(|view| view.size.is_none()).count();
    if unknown > 0 {
        warnings.push(Warning::new(
            WarningCode::AssumedImageSize,
            format!(
                "{unknown} of {} views came without an image size; the extent of their points stood in, so the principal \
                 point and with it the calibration may be off; give the size",
                input.view_count()
            ),
        ));
    }
    warnings.extend(image_fit::suspicion(input, &ImageFitOptions::DEFAULT));
    // All points in one place: any scale will do.
    let scale_px = if scale_px > 0.0 { scale_px } else { 1.0 };
    (Normalization { centres_px, scale_px }, warnings)
}

/// Centre of an image whose top-left pixel's centre is (0, 0).
fn image_centre(size: ImageSize) -> Vector2<f64> {
    Vector2::new((f64::from(size.width_px) - 1.0) / 2.0, (f64::from(size.height_px) - 1.0) / 2.0)
}

/// Share of the points on either side that the extent leaves out: a few wild ones do not make an image.
const EXTENT_TAIL: f64 = 0.02;

/// Box around the points of all views without a size, but for a tail on every side; the unit square without points.
fn extent_of_unsized(input: &Input) -> [Vector2<f64>; 2] {
    let points: Vec<[f64; 2]> = (0..input.observation_count())
        .filter(|&k| input.views()[input.view_of(k)].size.is_none())
        .map(|k| input.point_px(k))
        .collect();
    if points.is_empty() {
        return [Vector2::zeros(), Vector2::repeat(1.0)];
    }
    let tail = (EXTENT_TAIL * points.len() as f64) as usize;
    let bounds = [0, 1].map(|axis| {
        let mut values: Vec<f64> = points.iter().map(|point| point[axis]).collect();
        values.sort_by(f64::total_cmp);
        [values[tail], values[values.len() - 1 - tail]]
    });
    [Vector2::new(bounds[0][0], bounds[1][0]), Vector2::new(bounds[0][1], bounds[1][1])]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{Limits, RawInput, View};

    #[test]
    fn views_of_unknown_size_share_one_centre() {
        let raw = RawInput {
            views: vec![View::default(); 3],
            track_count: 4,
            view: vec![0, 1, 1, 2, 0, 2, 0, 1, 2],
            track: vec![0, 0, 1, 1, 2, 2, 3, 3, 3],
            x: (0..9).map(f64::from).collect(),
            y: (0..9).map(|k| f64::from(k * k)).collect(),
            ..RawInput::default()
        };
        let input = Input::new(raw, &Limits::default(), "test").expect("valid");
        let (normalization, _) = normalization(&input);
        assert!(normalization.centres_px.iter().all(|centre| *centre == normalization.centres_px[0]));
    }
}
