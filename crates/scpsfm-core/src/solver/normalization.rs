//! The transform from pixels that a whole solve uses, and whether the image sizes that it rests on hold the points.

use nalgebra::Vector2;

use crate::domain::{ImageSize, Input, Warning, WarningCode};
use crate::geometry::measurement::Normalization;
use crate::geometry::statistics::median;

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
    warnings.extend(outside(input));
    // All points in one place: any scale will do.
    let scale_px = if scale_px > 0.0 { scale_px } else { 1.0 };
    (Normalization { centres_px, scale_px }, warnings)
}

/// Distance from the middle of the image within which half of the points must lie, in the longer image side: within an
/// image it is half a side at most, the paper's scenes, whose cameras see beyond their image, have .8 of it, and a size
/// that is three times too small shows.
const MEDIAN_WITHIN: f64 = 1.0;

/// Share of the points beyond the right or lower edge of their image, and none beyond the others, from which its size
/// is suspect: that of a reduced copy leaves half of the points out, exchanged sides a fiftieth and more. Points of
/// scenes that were made up lie beyond all edges.
const BEYOND_TWO_EDGES: f64 = 0.01;
/// How far beyond an edge a point may lie, in pixels: there are conventions that differ by half of one.
const EDGE_PX: f64 = 1.0;

/// Says so where the points do not lie in images of the size that was given: the calibration rests on its middle.
fn outside(input: &Input) -> Option<Warning> {
    beyond_two_edges(input).or_else(|| far_outside(input))
}

/// Points that fill an image from its upper left corner, and a larger one than the size that was given.
fn beyond_two_edges(input: &Input) -> Option<Warning> {
    let (mut sized, mut beyond) = (0usize, 0usize);
    for k in 0..input.observation_count() {
        let Some(size) = input.views()[input.view_of(k)].size else { continue };
        let [x, y] = input.point_px(k);
        if x.min(y) < -EDGE_PX {
            return None;
        }
        sized += 1;
        beyond += usize::from(x > f64::from(size.width_px) + EDGE_PX || y > f64::from(size.height_px) + EDGE_PX);
    }
    let share = beyond as f64 / sized.max(1) as f64;
    (share > BEYOND_TWO_EDGES).then(|| {
        let detail = format!(
            "{:.0} % of the points lie beyond the right or lower edge of their image and none beyond the others: is the \
             size that was given that of these images, and are width and height in their places?",
            100.0 * share
        );
        Warning::new(WarningCode::PointsOutsideImage, detail)
    })
}

/// Points that no image of such a size could show.
fn far_outside(input: &Input) -> Option<Warning> {
    let of = |k: usize| {
        let size = input.views()[input.view_of(k)].size?;
        let offset = Vector2::from(input.point_px(k)) - image_centre(size);
        Some(offset.amax() / f64::from(size.width_px.max(size.height_px)))
    };
    let mut offsets: Vec<f64> = (0..input.observation_count()).filter_map(of).collect();
    (median(&mut offsets) > MEDIAN_WITHIN).then(|| {
        let detail = "half of the points lie farther from the middle of their image than it is long: is the size that was \
                      given that of these images, or of a reduced copy?";
        Warning::new(WarningCode::PointsOutsideImage, detail)
    })
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
    fn an_image_size_that_does_not_hold_the_points_is_doubted() {
        let codes = |width_px: u32, height_px: u32| {
            let raw = RawInput {
                views: vec![View { size: Some(ImageSize { width_px, height_px }), ..View::default() }; 3],
                track_count: 10,
                view: (0..30).map(|k| k % 3).collect(),
                track: (0..30).map(|k| k / 3).collect(),
                x: (0..30).map(|k| 30.0 * f64::from(k)).collect(),
                y: (0..30).map(|k| 20.0 * f64::from(k)).collect(),
                ..RawInput::default()
            };
            let input = Input::new(raw, &Limits::default(), "points").expect("valid");
            normalization(&input).1.iter().map(|warning| warning.code).collect::<Vec<_>>()
        };
        assert_eq!(codes(880, 600), []);
        // A reduced copy, and exchanged sides.
        for (width, height) in [(440, 300), (220, 150), (600, 880)] {
            assert_eq!(codes(width, height), [WarningCode::PointsOutsideImage], "{width} x {height}");
        }
    }

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
