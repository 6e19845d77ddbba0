//! The tracks in the images: the picture of a view, and the data behind it.

use std::fmt::Write;

use serde_json::{Value, json};

use super::counts::ViewCount;
use super::html::{script_json, short};
use super::labels;
use super::pack::{Packed, quantised, residual_code};
use crate::domain::{Solution, counted};
use crate::formats::LabelledInput;

/// Observations in the page, 11 bytes each: 1.3 MB. More than a canvas of 900 px shows apart.
const MAX_OBSERVATIONS: usize = 120_000;
/// Names of tracks in the page, bytes; where they are longer, the tracks are numbered.
const MAX_LABEL_BYTES: usize = 700_000;
/// Residuals of this many times the RMS and above are of one colour.
const RESIDUALS_SHOWN: f64 = 3.0;
/// Set in the code of an observation, and of a track, that is an inlier.
const INLIER: u16 = 0x8000;

/// Set in the code of an observation that shows another point of its track; residuals end below it.
const OTHER_POINT: u16 = 0x4000;

/// The tracks to draw, and how many of all they are.
pub struct Tracks {
    pub json: Value,
    pub shown: usize,
    pub all: usize,
    /// Whether their names fit into the page.
    pub named: bool,
}

/// The section; a note where the input is not at hand.
pub fn section(solution: &Solution, input: Option<&LabelledInput>, counts: &[ViewCount]) -> String {
    let mut html = String::from("<section id=\"images\">\n<h2>Tracks in the images</h2>\n");
    let Some(input) = input else {
        html.push_str(
            "<p class=\"note\">This page was made without the input: there are no points to draw.</p>\n</section>\n",
        );
        return html;
    };
    let tracks = tracks(solution, input, counts);
    let _ = write!(
        html,
        "<p class=\"tools\"><label>View <select id=\"view\"></select></label>\n\
         <button type=\"button\" id=\"previous\" aria-label=\"previous view\">\u{2190}</button>\
         <button type=\"button\" id=\"next\" aria-label=\"next view\">\u{2192}</button>\n\
         <label>Colour by <select id=\"colour\"><option value=\"inlier\">inlier</option><option value=\"weight\">weight</option>\
         <option value=\"residual\">residual</option></select></label>\n\
         <label><input type=\"checkbox\" id=\"outliers\" checked> outliers</label>\n\
         <label><input type=\"checkbox\" id=\"flow\" checked> flow to the next view</label></p>\n\
         <p id=\"view-figures\" aria-live=\"polite\"></p>\n\
         <canvas id=\"image\" tabindex=\"0\" role=\"img\" aria-label=\"tracks of the chosen view; left and right arrow: other views\"></canvas>\n\
         <p class=\"note\" id=\"legend\"></p>\n\
         <p class=\"note\" id=\"hover\">Point at an observation to see its track.</p>\n\
         <table id=\"worst\"></table>\n<p class=\"note\">{} of {} are drawn; the figures are of all.{}</p>\n\
         <noscript><p class=\"note\">The picture needs the page's own script; the figures of the views stand in the table below.</p></noscript>\n\
         <script type=\"application/json\" id=\"tracks-data\">{}</script>\n</section>\n",
        tracks.shown,
        counted(tracks.all, "track"),
        if tracks.named { "" } else { " Their names are too long for this page: they are numbered from 0." },
        script_json(&tracks.json)
    );
    html
}

/// What the script draws.
///
/// * `views`: `[label, registered, part, x0, y0, x1, y1 (the frame of the image), observations, inliers, mean px,
///   RMS px, [[track, px] of the worst], observations that show another point of their track]`
/// * `labels`: of the tracks; null where they are too long together: `numbers` counts the tracks from 0 then
/// * `tracks`: packed, two u16 a track: observations, weight in thousandths + [`INLIER`]
/// * `observations`: packed, four u16 each, track by track: view, x and y as shares of the frame widened by itself on
///   every side, residual + [`INLIER`] or [`OTHER_POINT`]
///
/// Thinned by whole tracks: half of the room is the inliers'.
pub fn tracks(solution: &Solution, input: &LabelledInput, counts: &[ViewCount]) -> Tracks {
    let raw = &input.raw;
    let all = solution.tracks.inlier.len();
    let of_track = observations_of_tracks(solution, input);
    let (inliers, outliers): (Vec<usize>, Vec<usize>) =
        (0..all).filter(|&track| !of_track[track].is_empty()).partition(|&track| solution.tracks.inlier[track]);
    let count = |tracks: &[usize]| tracks.iter().map(|&track| of_track[track].len()).sum::<usize>();
    // What the outliers leave of their half is the inliers' too.
    let room_for_inliers = (MAX_OBSERVATIONS / 2).max(MAX_OBSERVATIONS.saturating_sub(count(&outliers)));
    let inliers = thinned(&inliers, &of_track, room_for_inliers);
    let outliers = thinned(&outliers, &of_track, MAX_OBSERVATIONS.saturating_sub(count(&inliers)));
    let mut kept: Vec<usize> = inliers.into_iter().chain(outliers).collect();
    kept.sort_unstable();
    let frames = frames(input);
    let (mut of_tracks, mut observations) = (Packed::default(), Packed::default());
    for &track in &kept {
        let weight = solution.tracks.weight.get(track).copied().unwrap_or(0.0).clamp(0.0, 1.0);
        let flag = if solution.tracks.inlier[track] { INLIER } else { 0 };
        of_tracks.push_u16(of_track[track].len() as u16);
        of_tracks.push_u16((weight * 1e3).round() as u16 | flag);
        for &k in &of_track[track] {
            let [x0, y0, x1, y1] = frames[raw.view[k] as usize];
            let inlier = solution.observations.inlier.get(k) == Some(&true);
            let residual = solution.observations.residual_px.get(k).copied().flatten();
            observations.push_u16(raw.view[k] as u16);
            observations.push_u16(quantised(raw.x[k], 2.0 * x0 - x1, 2.0 * x1 - x0));
            observations.push_u16(quantised(raw.y[k], 2.0 * y0 - y1, 2.0 * y1 - y0));
            let shows_other = solution.observations.split.get(k).is_some_and(|&number| number > 0);
            let flag = if inlier { INLIER } else { OTHER_POINT * u16::from(shows_other) };
            observations.push_u16(residual_code(residual) | flag);
        }
    }
    let named = names_fit(input, &kept, counts);
    let name = |track: usize| if named { labels::track(Some(input), track) } else { format!("no. {track}") };
    let json = json!({
        "views": views(solution, input, counts, &frames, name),
        "labels": named.then(|| kept.iter().map(|&track| name(track)).collect::<Vec<_>>()),
        "numbers": if named { Vec::new() } else { kept.clone() },
        "tracks": of_tracks.text(),
        "observations": observations.text(),
        "limit": solution.reprojection_rms_px.map_or(1.0, |rms| RESIDUALS_SHOWN * rms),
    });
    Tracks { shown: kept.len(), all, named, json }
}

/// The observations of each track by view; those that 16 bits cannot name are not drawn.
fn observations_of_tracks(solution: &Solution, input: &LabelledInput) -> Vec<Vec<usize>> {
    let raw = &input.raw;
    let drawable = raw.views.len().min(solution.views.len()).min(usize::from(u16::MAX));
    let mut of_track: Vec<Vec<usize>> = vec![Vec::new(); solution.tracks.inlier.len()];
    for (k, &track) in raw.track.iter().enumerate() {
        if let Some(observations) = of_track.get_mut(track as usize).filter(|_| (raw.view[k] as usize) < drawable) {
            observations.push(k);
        }
    }
    of_track.iter_mut().for_each(|observations| observations.sort_by_key(|&k| raw.view[k]));
    of_track
}

/// Whether the names of the tracks drawn, and of each view's worst, are short enough to stand in the page.
fn names_fit(input: &LabelledInput, kept: &[usize], counts: &[ViewCount]) -> bool {
    let worst = counts.iter().flat_map(|count| count.worst.iter().map(|worst| worst.1));
    let length = |track| script_json(&json!(labels::track(Some(input), track))).len();
    kept.iter().copied().chain(worst).map(length).sum::<usize>() <= MAX_LABEL_BYTES
}

fn views(
    solution: &Solution,
    input: &LabelledInput,
    counts: &[ViewCount],
    frames: &[[f64; 4]],
    name: impl Fn(usize) -> String,
) -> Vec<Value> {
    let px = |value: Option<f64>| value.map(short);
    let entry = |(view, [x0, y0, x1, y1]): (usize, &[f64; 4])| {
        let count = counts.get(view).cloned().unwrap_or_default();
        let result = solution.views.get(view).filter(|view| view.projection.is_some());
        let worst: Vec<Value> = count.worst.iter().map(|&(px, track)| json!([name(track), short(px)])).collect();
        json!([
            labels::view(solution, Some(input), view),
            u8::from(result.is_some()),
            result.map_or(0, |view| view.part),
            rounded(*x0),
            rounded(*y0),
            rounded(*x1),
            rounded(*y1),
            count.observations,
            count.inliers,
            px(count.mean_px()),
            px(count.rms_px()),
            worst,
            count.others
        ])
    };
    frames.iter().enumerate().map(entry).collect()
}

/// Every `k`-th track, `k` such that about `room` of their observations remain, and never more.
fn thinned(tracks: &[usize], of_track: &[Vec<usize>], room: usize) -> Vec<usize> {
    if room == 0 {
        return Vec::new();
    }
    let count: usize = tracks.iter().map(|&track| of_track[track].len()).sum();
    let mut used = 0;
    let fits = |track: &usize| {
        used += of_track[*track].len();
        used <= room
    };
    tracks.iter().copied().step_by(count.div_ceil(room).max(1)).take_while(fits).collect()
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

/// A tenth of a pixel is finer than the picture.
fn rounded(value: f64) -> f64 {
    (value * 10.0).round() / 10.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::formats::fixture;
    use crate::report::counts;

    #[test]
    fn small_scenes_are_shown_whole() {
        let (input, solution) = fixture::solved();
        let tracks = tracks(&solution, &input, &counts::of_views(&solution, Some(&input)));
        assert_eq!((tracks.shown, tracks.all), (40, 40));
        assert_eq!(tracks.json["labels"][0], "100");
        let length = |name: &str| tracks.json[name].as_str().expect("text").len();
        assert_eq!(length("tracks"), (40usize * 4).div_ceil(3) * 4);
        assert_eq!(length("observations"), (40usize * 5 * 8).div_ceil(3) * 4);
        let view = tracks.json["views"][1].as_array().expect("a view");
        assert_eq!(view[..8], json!(["13", 1, 0, -0.5, -0.5, 999.5, 999.5, 40]).as_array().expect("array")[..]);
        assert_eq!(view[8], solution.inlier_track_count());
        assert_eq!(view[11].as_array().expect("the worst").len(), 5);
    }

    #[test]
    fn an_observation_of_another_point_is_marked() {
        let (input, solution) = fixture::solved_with_a_split();
        let counts = counts::of_views(&solution, Some(&input));
        let views = tracks(&solution, &input, &counts).json["views"].clone();
        let others: Vec<&Value> = (0..5).map(|view| &views[view][12]).collect();
        assert_eq!(others, [0, 0, 0, 1, 1]);
        assert!(residual_code(Some(1e300)) < OTHER_POINT && residual_code(None) < OTHER_POINT);
    }

    #[test]
    fn thinning_keeps_within_the_room_and_both_kinds() {
        let of_track = vec![vec![0; 10]; 5];
        assert_eq!(thinned(&[1, 2, 3, 4], &of_track, 20), [1, 3]);
        assert_eq!(thinned(&[1, 2, 3, 4], &of_track, 40), [1, 2, 3, 4]);
        assert_eq!(thinned(&[1, 2], &of_track, 0), [0usize; 0]);
        assert_eq!(thinned(&[1, 2, 3], &of_track, 15), [1], "never more than the room");
    }

    #[test]
    fn long_names_are_cut() {
        let (mut input, solution) = fixture::solved();
        let long: Box<str> = "x".repeat(4096).into();
        input.track_labels = vec![crate::formats::Label::Name(long); 40];
        let shown = tracks(&solution, &input, &[]);
        assert!(shown.json["labels"][0].as_str().expect("a name").chars().count() <= 48);
        assert!(shown.json.to_string().len() < 10_000);
    }
}
