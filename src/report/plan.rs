//! A part from above, as a still picture: what shows without a script, and on paper.

use std::fmt::Write;

use nalgebra::{Vector2, Vector3};

use super::space::{Camera, Part};

const WIDTH: f64 = 460.0;
const HEIGHT: f64 = 300.0;
const TOP: f64 = 26.0;
const MARGIN: f64 = 16.0;
/// Points and cameras drawn: what this size shows apart.
const MAX_POINTS: usize = 2_000;
const MAX_CAMERAS: usize = 60;
/// Levels of weight, one path each.
const LEVELS: usize = 5;
/// Share of the points at each end of each axis that may fall outside, so that strays do not shrink the rest.
const STRAY: f64 = 0.03;
/// Length of a drawn camera as a share of the drawing.
const CAMERA: f64 = 0.035;

/// The directions that a plan shows to the right and down the page: the cameras' mean forward direction, made level, points
/// up the page. Where the cameras have no common down or forward direction, axes stand in.
fn axes(cameras: &[Camera]) -> (Vector3<f64>, Vector3<f64>) {
    let mean = |row: usize| cameras.iter().map(|camera| Vector3::from(camera.rotation[row])).sum::<Vector3<f64>>();
    let unit =
        |vector: Vector3<f64>, other: Vector3<f64>| vector.try_normalize(1e-6 * cameras.len() as f64).unwrap_or(other);
    let down = unit(mean(1), Vector3::y());
    let level = |vector: Vector3<f64>| vector - down * down.dot(&vector);
    let spare = if down.x.abs() < 0.9 { Vector3::x() } else { Vector3::z() };
    let forward = unit(level(mean(2)), unit(level(spare), Vector3::z()));
    (down.cross(&forward), -forward)
}

/// The range of values without strays.
fn range(mut values: Vec<f64>) -> Option<(f64, f64)> {
    values.sort_by(f64::total_cmp);
    let stray = (values.len() as f64 * STRAY) as usize;
    Some((*values.get(stray)?, *values.get(values.len() - 1 - stray)?))
}

/// The drawing.
pub fn svg(part: &Part) -> String {
    let (right, back) = axes(&part.cameras);
    let flat = |at: &Vector3<f64>| Vector2::new(right.dot(at), back.dot(at));
    let points: Vec<Vector2<f64>> = part.points.iter().map(|point| flat(&point.at)).collect();
    let centres: Vec<Vector2<f64>> = part.cameras.iter().map(|camera| flat(&camera.centre)).collect();
    let bounds = |axis: usize| {
        let of_points = range(points.iter().map(|point| point[axis]).collect());
        let all = centres.iter().map(|centre| centre[axis]).chain(of_points.into_iter().flat_map(|(a, b)| [a, b]));
        all.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| (low.min(value), high.max(value)))
    };
    let ((x0, x1), (y0, y1)) = (bounds(0), bounds(1));
    let scale = ((WIDTH - 2.0 * MARGIN) / (x1 - x0).max(f64::MIN_POSITIVE))
        .min((HEIGHT - TOP - MARGIN) / (y1 - y0).max(f64::MIN_POSITIVE));
    let place = |at: &Vector2<f64>| {
        Vector2::new(
            WIDTH / 2.0 + (at.x - (x0 + x1) / 2.0) * scale,
            (HEIGHT + TOP - MARGIN) / 2.0 + (at.y - (y0 + y1) / 2.0) * scale,
        )
    };
    let mut svg = format!(
        "<svg class=\"plan\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" aria-label=\"part {} from above: {} cameras, {} points\">\
         <text class=\"title\" x=\"8\" y=\"18\">Part {} from above: {} views, {} points</text>",
        part.part,
        part.cameras.len(),
        part.all_points,
        part.part,
        part.cameras.len(),
        part.all_points
    );
    if !scale.is_finite() {
        return svg + "</svg>";
    }
    draw_points(&mut svg, part, &points, place);
    draw_cameras(&mut svg, part, &centres, place, flat);
    svg + "</svg>"
}

/// Small squares, one path a level of weight.
fn draw_points(svg: &mut String, part: &Part, points: &[Vector2<f64>], place: impl Fn(&Vector2<f64>) -> Vector2<f64>) {
    let mut paths = vec![String::new(); LEVELS];
    let step = points.len().div_ceil(MAX_POINTS).max(1);
    for (point, at) in part.points.iter().zip(points).step_by(step) {
        let at = place(at);
        if (0.0..=WIDTH).contains(&at.x) && (TOP..=HEIGHT).contains(&at.y) {
            let level = ((point.weight * LEVELS as f64) as usize).min(LEVELS - 1);
            let _ = write!(paths[level], "M{:.0} {:.0}h2v2h-2z", at.x - 1.0, at.y - 1.0);
        }
    }
    for (level, path) in paths.iter().enumerate().filter(|(_, path)| !path.is_empty()) {
        // Orange (0) to blue (1), as in points.ply.
        let share = level as f64 / (LEVELS - 1) as f64;
        let [r, g, b] = [(230.0, 30.0), (120.0, 100.0), (20.0, 220.0)].map(|(low, high)| low + (high - low) * share);
        let _ = write!(svg, "<path fill=\"rgb({r:.0},{g:.0},{b:.0})\" fill-opacity=\"0.75\" d=\"{path}\"/>");
    }
}

/// The path through all centres, and some of the cameras on it as the triangles of their horizontal fields of view.
fn draw_cameras(
    svg: &mut String,
    part: &Part,
    centres: &[Vector2<f64>],
    place: impl Fn(&Vector2<f64>) -> Vector2<f64>,
    flat: impl Fn(&Vector3<f64>) -> Vector2<f64>,
) {
    let class = format!("p{}", part.part % super::PART_COLOURS);
    let path: Vec<String> = centres.iter().map(&place).map(|at| format!("{:.1},{:.1}", at.x, at.y)).collect();
    let _ = write!(svg, "<polyline class=\"path {class}\" points=\"{}\"/>", path.join(" "));
    let step = centres.len().div_ceil(MAX_CAMERAS).max(1);
    let mut frusta = String::new();
    for (camera, centre) in part.cameras.iter().zip(centres).step_by(step) {
        let apex = place(centre);
        let [ex, _, ez] = camera.rotation.map(|row| flat(&Vector3::from(row)));
        let rim = [camera.borders[0], camera.borders[1]].map(|x| apex + (ex * x + ez) * (CAMERA * WIDTH));
        let _ = write!(
            frusta,
            "M{:.1} {:.1}L{:.1} {:.1}L{:.1} {:.1}z",
            apex.x, apex.y, rim[0].x, rim[0].y, rim[1].x, rim[1].y
        );
    }
    let _ = write!(svg, "<path class=\"camera {class}\" d=\"{frusta}\"/>");
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::space::Point;

    fn camera(x: f64, z: f64) -> Camera {
        let rotation = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        Camera { label: String::new(), centre: Vector3::new(x, 0.0, z), rotation, borders: [-0.5, 0.5, -0.5, 0.5] }
    }

    #[test]
    fn forward_is_up_and_right_is_right() {
        let cameras = vec![camera(0.0, 0.0), camera(1.0, 0.0), camera(1.0, 2.0)];
        let points = vec![Point { at: Vector3::new(0.0, 0.0, 4.0), weight: 1.0 }];
        let svg = svg(&Part { part: 7, cameras, points, all_points: 9 });
        assert!(svg.contains("Part 7 from above: 3 views, 9 points") && svg.contains("class=\"path p1\""), "{svg}");
        let path = svg.split("points=\"").nth(1).and_then(|rest| rest.split('"').next()).expect("a path");
        let at: Vec<Vec<f64>> =
            path.split(' ').map(|pair| pair.split(',').filter_map(|number| number.parse().ok()).collect()).collect();
        assert!(at[1][0] > at[0][0] && at[1][1] == at[0][1] && at[2][1] < at[1][1], "{path}");
    }

    #[test]
    fn one_camera_and_no_point_make_a_drawing() {
        let svg = svg(&Part { part: 0, cameras: vec![camera(0.0, 0.0)], points: Vec::new(), all_points: 0 });
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
    }
}
