//! The data behind the two pictures of the page: the tracks in the images, and cameras and points in space.

use serde_json::{Value, json};

use crate::domain::Solution;
use crate::formats::LabelledInput;
use crate::formats::result_json::{CamerasJson, track_label, view_label};

/// Observations in the page, some 25 bytes each: 1 MB. More than a canvas of 900 px shows apart.
const MAX_OBSERVATIONS: usize = 40_000;
/// Points in the page, some 40 bytes each: 0.8 MB.
const MAX_POINTS: usize = 20_000;

/// The tracks to draw, and how many of all they are.
pub struct Tracks {
    pub json: Value,
    pub shown: usize,
    pub all: usize,
}

/// Observations by track: `views` is `[label, registered, x0, y0, x1, y1]` (the frame of the image), `tracks` is
/// `[label, weight, inlier, [view, x, y, inlier, ...]]`. Thinned by whole tracks, inliers last.
pub fn tracks(solution: &Solution, input: &LabelledInput) -> Tracks {
    let raw = &input.raw;
    let all = solution.tracks.inlier.len();
    let mut of_track: Vec<Vec<usize>> = vec![Vec::new(); all];
    for (k, &track) in raw.track.iter().enumerate() {
        if let Some(observations) = of_track.get_mut(track as usize) {
            observations.push(k);
        }
    }
    of_track.iter_mut().for_each(|observations| observations.sort_by_key(|&k| raw.view[k]));
    let (inliers, outliers): (Vec<usize>, Vec<usize>) =
        (0..all).filter(|&track| !of_track[track].is_empty()).partition(|&track| solution.tracks.inlier[track]);
    let count = |tracks: &[usize]| tracks.iter().map(|&track| of_track[track].len()).sum::<usize>();
    // Half of the room is the inliers'; what the outliers leave of the other half is theirs too.
    let room_for_inliers = (MAX_OBSERVATIONS / 2).max(MAX_OBSERVATIONS.saturating_sub(count(&outliers)));
    let inliers = thinned(&inliers, count(&inliers), room_for_inliers);
    let outliers = thinned(&outliers, count(&outliers), MAX_OBSERVATIONS.saturating_sub(count(&inliers)));
    let mut kept: Vec<usize> = inliers.into_iter().chain(outliers).collect();
    kept.sort_unstable();
    let drawn: Vec<Value> = kept
        .iter()
        .map(|&track| {
            let mut points = Vec::with_capacity(4 * of_track[track].len());
            for &k in &of_track[track] {
                let inlier = solution.observations.inlier.get(k).copied().unwrap_or(false);
                points.extend([json!(raw.view[k]), rounded(raw.x[k]), rounded(raw.y[k]), json!(u8::from(inlier))]);
            }
            let weight = solution.tracks.weight.get(track).copied().unwrap_or(0.0);
            json!([
                track_label(Some(input), track),
                (f64::from(weight) * 1e3).round() / 1e3,
                u8::from(solution.tracks.inlier[track]),
                points
            ])
        })
        .collect();
    let frames = frames(input);
    let views: Vec<Value> = frames
        .iter()
        .enumerate()
        .map(|(view, [x0, y0, x1, y1])| {
            let registered = solution.views.get(view).is_some_and(|view| view.projection.is_some());
            json!([
                view_label(Some(input), view),
                u8::from(registered),
                rounded(*x0),
                rounded(*y0),
                rounded(*x1),
                rounded(*y1)
            ])
        })
        .collect();
    Tracks { shown: kept.len(), all, json: json!({ "views": views, "tracks": drawn }) }
}

/// Every `k`-th track, `k` such that about `room` of the `count` observations remain.
fn thinned(tracks: &[usize], count: usize, room: usize) -> Vec<usize> {
    if room == 0 {
        return Vec::new();
    }
    tracks.iter().copied().step_by(count.div_ceil(room).max(1)).collect()
}

/// The frame of each image: its size, or where unknown the extent of its points.
fn frames(input: &LabelledInput) -> Vec<[f64; 4]> {
    let raw = &input.raw;
    let mut extent = vec![[f64::INFINITY, f64::INFINITY, f64::NEG_INFINITY, f64::NEG_INFINITY]; raw.views.len()];
    for k in 0..raw.x.len() {
        if let Some([x0, y0, x1, y1]) = extent.get_mut(raw.view[k] as usize) {
            (*x0, *y0, *x1, *y1) = (x0.min(raw.x[k]), y0.min(raw.y[k]), x1.max(raw.x[k]), y1.max(raw.y[k]));
        }
    }
    let frame = |(extent, view): (&[f64; 4], &crate::domain::View)| match view.size {
        // The centre of the top-left pixel is (0, 0).
        Some(size) => [-0.5, -0.5, f64::from(size.width_px) - 0.5, f64::from(size.height_px) - 0.5],
        None if extent[0].is_finite() => *extent,
        None => [0.0, 0.0, 1.0, 1.0],
    };
    extent.iter().zip(&raw.views).map(frame).collect()
}

/// Cameras `[label, [K], [R], [t], width, height]` and points `[x, y, z, weight]`; `None` without a metric result.
pub fn space(solution: &Solution, input: Option<&LabelledInput>) -> Option<Value> {
    let cameras: Vec<Value> = CamerasJson::new(solution, input)
        .views
        .iter()
        .enumerate()
        .filter_map(|(index, camera)| {
            let (k, r, t) = (camera.K?, camera.R?, camera.t?);
            let size = input.and_then(|input| input.raw.views.get(index)?.size);
            // Without a size, the principal point is taken as the middle.
            let (width, height) = size
                .map_or((2.0 * k[0][2], 2.0 * k[1][2]), |size| (f64::from(size.width_px), f64::from(size.height_px)));
            Some(json!([camera.view, k.as_flattened(), r.as_flattened(), t, width, height]))
        })
        .collect();
    if cameras.is_empty() {
        return None;
    }
    let points: Vec<(usize, [f64; 3])> =
        solution.tracks.point.iter().enumerate().filter_map(|(track, point)| Some((track, (*point)?))).collect();
    let step = points.len().div_ceil(MAX_POINTS).max(1);
    let points: Vec<Value> = points
        .iter()
        .step_by(step)
        .filter(|(_, point)| point.iter().all(|value| value.is_finite()))
        .map(|(track, point)| {
            let weight = solution.tracks.weight.get(*track).copied().unwrap_or(0.0);
            let [x, y, z] = point.map(significant);
            json!([x, y, z, (f64::from(weight) * 1e3).round() / 1e3])
        })
        .collect();
    Some(json!({ "cameras": cameras, "points": points }))
}

/// A tenth of a pixel is finer than the picture.
fn rounded(value: f64) -> Value {
    json!((value * 10.0).round() / 10.0)
}

/// Five significant digits, finer than the picture.
fn significant(value: f64) -> f64 {
    format!("{value:.4e}").parse().unwrap_or(value)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::formats::fixture;

    #[test]
    fn small_scenes_are_shown_whole() {
        let (input, solution) = fixture::solved();
        let tracks = tracks(&solution, &input);
        assert_eq!((tracks.shown, tracks.all), (40, 40));
        let first = &tracks.json["tracks"][0];
        assert_eq!(first[0], 100);
        assert_eq!(first[3].as_array().expect("points").len(), 4 * 5);
        assert_eq!(first[3][4], 1, "the second observation is of view 1");
        assert_eq!(tracks.json["views"][1], json!([13, 1, -0.5, -0.5, 999.5, 999.5]));
    }

    #[test]
    fn thinning_keeps_within_the_room_and_both_kinds() {
        assert_eq!(thinned(&[1, 2, 3, 4], 40, 20), [1, 3]);
        assert_eq!(thinned(&[1, 2, 3, 4], 40, 40), [1, 2, 3, 4]);
        assert_eq!(thinned(&[1, 2], 20, 0), [0usize; 0]);
    }

    #[test]
    fn without_poses_there_is_no_space_to_show() {
        let (input, mut solution) = fixture::solved();
        assert!(space(&solution, Some(&input)).is_some());
        solution.views.iter_mut().for_each(|view| view.rotation = None);
        assert!(space(&solution, Some(&input)).is_none());
    }
}
