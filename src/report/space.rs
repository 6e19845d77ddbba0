//! Cameras and points in space: the data of the picture that turns, and the section around it.

use std::fmt::Write;

use nalgebra::Vector3;
use serde_json::{Value, json};

use super::html::script_json;
use super::pack::Packed;
use super::{counts, labels, plan};
use crate::domain::{Grade, Solution, counted};
use crate::formats::LabelledInput;
use crate::formats::cameras_json::CamerasJson;

/// Points in the page, 18 bytes each: 0.7 MB. As many as turn smoothly on a plain canvas.
const MAX_POINTS: usize = 40_000;
/// Parts whose plans stand in the page; each has some 20 kB.
const MAX_PLANS: usize = 6;

/// A camera in the frame of its part.
pub struct Camera {
    pub label: String,
    pub centre: Vector3<f64>,
    /// World to camera, row by row: right, down, forward.
    pub rotation: [[f64; 3]; 3],
    /// The image's borders at depth 1: left, right, top, bottom.
    pub borders: [f64; 4],
}

/// A point in the frame of its part, with its weight: that of its track, or its own where the track joins several.
pub struct Point {
    pub at: Vector3<f64>,
    pub weight: f64,
}

/// What has a frame of its own.
pub struct Part {
    pub part: u32,
    pub cameras: Vec<Camera>,
    /// Thinned.
    pub points: Vec<Point>,
    /// Points before they were thinned.
    pub all_points: usize,
    /// Of these the further ones of tracks that join several.
    pub further_points: usize,
}

/// The parts of a metric result; none without one.
pub fn parts(solution: &Solution, input: Option<&LabelledInput>) -> Vec<Part> {
    let mut parts: Vec<Part> = counts::parts(solution)
        .keys()
        .map(|&part| Part { part, cameras: Vec::new(), points: Vec::new(), all_points: 0, further_points: 0 })
        .collect();
    let place = |parts: &[Part], part: u32| parts.binary_search_by_key(&part, |entry| entry.part).ok();
    for (index, camera) in CamerasJson::new(solution, input).views.iter().enumerate() {
        let Some(at) = camera.part.and_then(|part| place(&parts, part)) else { continue };
        let (Some(k), Some(r), Some(t)) = (camera.K, camera.R, camera.t) else { continue };
        let centre = Vector3::from_fn(|i, _| -(0..3).map(|j| r[j][i] * t[j]).sum::<f64>());
        if !centre.iter().chain(r.as_flattened()).all(|value| value.is_finite()) {
            continue;
        }
        let size = input.and_then(|input| input.raw.views.get(index)?.size);
        // Without a size, the principal point is taken as the middle.
        let (width, height) =
            size.map_or((2.0 * k[0][2], 2.0 * k[1][2]), |size| (f64::from(size.width_px), f64::from(size.height_px)));
        let (x, y) = (|px: f64| (px - k[0][2]) / k[0][0], |px: f64| (px - k[1][2]) / k[1][1]);
        let borders = [x(0.0), x(width), y(0.0), y(height)];
        parts[at].cameras.push(Camera { label: labels::view(solution, input, index), centre, rotation: r, borders });
    }
    parts.retain(|part| !part.cameras.is_empty());
    add_points(&mut parts, solution);
    parts
}

/// Every `k`-th point, of all parts together.
fn add_points(parts: &mut [Part], solution: &Solution) {
    let place = |part: u32| parts.binary_search_by_key(&part, |entry| entry.part).ok();
    let placed: Vec<(usize, counts::PlacedPoint)> =
        counts::points(solution).filter_map(|point| Some((place(point.part)?, point))).collect();
    let step = placed.len().div_ceil(MAX_POINTS).max(1);
    for (index, (part, point)) in placed.into_iter().enumerate() {
        parts[part].all_points += 1;
        parts[part].further_points += usize::from(point.is_further);
        if index % step == 0 {
            parts[part].points.push(Point { at: point.at.into(), weight: f64::from(point.weight).clamp(0.0, 1.0) });
        }
    }
}

/// What the script draws, an entry a part: `[part, cameras, points, weights]`, cameras
/// `[label, [centre], [R], [left, right, top, bottom at depth 1]]`, points packed as three f32 each, weights as one u8.
fn data(parts: &[Part]) -> Value {
    let entry = |part: &Part| {
        let cameras: Vec<Value> = part
            .cameras
            .iter()
            .map(|camera| {
                json!([
                    camera.label,
                    camera.centre.as_slice().iter().map(|&value| significant(value)).collect::<Vec<_>>(),
                    camera.rotation.as_flattened().iter().map(|value| decimals(*value)).collect::<Vec<_>>(),
                    camera.borders.map(decimals)
                ])
            })
            .collect();
        let (mut points, mut weights) = (Packed::default(), Packed::default());
        for point in &part.points {
            point.at.iter().for_each(|&value| points.push_f32(value as f32));
            weights.push_u8((point.weight * 255.0).round() as u8);
        }
        json!([part.part, cameras, points.text(), weights.text()])
    };
    Value::Array(parts.iter().map(entry).collect())
}

/// Six significant digits, finer than the picture.
fn significant(value: f64) -> f64 {
    format!("{value:.5e}").parse().unwrap_or(value)
}

/// Four decimals: a rotation to a hundredth of a degree.
fn decimals(value: f64) -> f64 {
    (value * 1e4).round() / 1e4
}

/// The section; without a metric result, the reason why there is no picture.
pub fn section(solution: &Solution, input: Option<&LabelledInput>) -> String {
    let mut html = String::from("<section id=\"space\">\n<h2>Cameras and points</h2>\n");
    let parts = parts(solution, input);
    if parts.is_empty() {
        html.push_str("<p class=\"note\">There is no metric reconstruction to show.");
        if solution.grade == Some(Grade::ProjectiveOnly) {
            html.push_str(
                " The cameras and points are known up to a projective transformation only: lengths, angles and shapes \
                 mean nothing in their frame.",
            );
        }
        html.push_str("</p>\n</section>\n");
        return html;
    }
    if parts.len() > 1 {
        html.push_str("<p class=\"tools\"><label>Part <select id=\"part\">");
        for (index, part) in parts.iter().enumerate() {
            let _ = write!(
                html,
                "<option value=\"{index}\">{} ({}, {})</option>",
                part.part,
                counted(part.cameras.len(), "view"),
                counted(part.all_points, "point")
            );
        }
        html.push_str("</select></label></p>\n");
    }
    let cameras: usize = parts.iter().map(|part| part.cameras.len()).sum();
    let shown: usize = parts.iter().map(|part| part.points.len()).sum();
    let all: usize = parts.iter().map(|part| part.all_points).sum();
    let further = match parts.iter().map(|part| part.further_points).sum::<usize>() {
        0 => String::new(),
        count => format!(" {count} of the {all} are further points of tracks that join several."),
    };
    let _ = write!(
        html,
        "<canvas id=\"solid\" tabindex=\"0\" role=\"img\" aria-label=\"{} and {} in space; arrows turn, \
         shift and arrows move, plus and minus zoom, 0 goes back\"></canvas>\n\
         <p class=\"note\">Drag or arrows to turn, wheel, pinch or + and - to zoom, shift-drag, two fingers or shift and arrows to \
         move, double click or 0 to go back. Points are coloured by weight, from orange (0) to blue (1); cameras by part. \
         {shown} of {} are drawn.{further}</p>\n",
        counted(cameras, "camera"),
        counted(all, "point"),
        counted(all, "point")
    );
    html.push_str("<div class=\"grid\" id=\"plans\">\n");
    for part in parts.iter().take(MAX_PLANS) {
        let _ = writeln!(html, "<figure>{}</figure>", plan::svg(part));
    }
    let _ = write!(
        html,
        "</div>\n<script type=\"application/json\" id=\"space-data\">{}</script>\n</section>\n",
        script_json(&data(&parts))
    );
    html
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::formats::fixture;

    #[test]
    fn centres_are_where_the_cameras_stand() {
        let (input, solution) = fixture::solved();
        let parts = parts(&solution, Some(&input));
        assert_eq!((parts.len(), parts[0].cameras.len()), (1, 5));
        assert_eq!(parts[0].points.len(), solution.inlier_track_count());
        for (camera, view) in parts[0].cameras.iter().zip(&solution.views) {
            let p = view.projection.expect("registered");
            for row in p {
                let at: f64 = (0..3).map(|k| row[k] * camera.centre[k]).sum::<f64>() + row[3];
                assert!(at.abs() < 1e-6 * row.iter().map(|value| value.abs()).sum::<f64>(), "P C = {at}");
            }
        }
        let focal = solution.calibrations[0].focal_px;
        let [left, right, ..] = parts[0].cameras[0].borders;
        assert!(((right - left) * focal - 1000.0).abs() < 1e-6);
    }

    #[test]
    fn both_points_of_a_split_track_are_there() {
        let (input, solution) = fixture::solved_with_a_split();
        assert_eq!(parts(&solution, Some(&input))[0].all_points, solution.inlier_track_count() + 1);
    }

    #[test]
    fn parts_are_shown_apart() {
        let (input, solution) = fixture::solved();
        assert!(!section(&solution, Some(&input)).contains("id=\"part\""), "one part needs no choice");
        let (input, solution) = fixture::solved_in_two_parts();
        let html = section(&solution, Some(&input));
        let points = solution.inlier_track_count() / 2;
        assert!(html.contains(&format!("<option value=\"1\">1 (2 views, {points} points)</option>")), "{html}");
        assert_eq!(html.matches("class=\"plan\"").count(), 2);
    }

    #[test]
    fn without_poses_there_is_no_space_to_show() {
        let (input, mut solution) = fixture::solved();
        assert!(section(&solution, Some(&input)).contains("id=\"space-data\""));
        solution.views.iter_mut().for_each(|view| view.rotation = None);
        let html = section(&solution, Some(&input));
        assert!(html.contains("no metric reconstruction to show") && !html.contains("projective transformation"));
    }
}
