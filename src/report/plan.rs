//! A part from above or from the side, as a still picture: what shows without a script, and on paper.

use std::fmt::Write;

use nalgebra::{Vector2, Vector3};

use super::space::{Camera, Part};
use crate::domain::counted;

const WIDTH: f64 = 460.0;
const HEIGHT: f64 = 300.0;
const TOP: f64 = 26.0;
const MARGIN: f64 = 16.0;
/// Points and cameras drawn: what this size shows apart.
const MAX_POINTS: usize = 2_000;
const MAX_CAMERAS: usize = 60;
/// Levels of weight, one path each.
const LEVELS: usize = 5;
/// Interquartile ranges beyond the quartiles, along each axis, past which a point may fall outside (Tukey's fences): up
/// to a quarter of the points may stand far off in a cluster of their own without shrinking the rest.
const FENCE: f64 = 1.5;
/// How much longer the cameras' way must be along their vertical than across it for a part to be looked at from the
/// side.
const SIDEWAYS: f64 = 2.0;
/// Length of a drawn camera as a share of the drawing.
const CAMERA: f64 = 0.035;

/// How a part is looked at: the directions to the right and down the page, the cameras' own axis that lies along the
/// first, and that in words.
struct Look {
    across: Vector3<f64>,
    back: Vector3<f64>,
    axis: usize,
    words: &'static str,
}

/// The cameras' mean forward direction, made level, points up the page. Where the cameras have no common down or
/// forward direction, axes stand in. Cameras that stand above each other, or took images that lie on their side, are
/// looked at from the side: from above they would hide each other.
fn look(cameras: &[Camera]) -> Look {
    let mean = |row: usize| cameras.iter().map(|camera| Vector3::from(camera.rotation[row])).sum::<Vector3<f64>>();
    let unit =
        |vector: Vector3<f64>, other: Vector3<f64>| vector.try_normalize(1e-6 * cameras.len() as f64).unwrap_or(other);
    let down = unit(mean(1), Vector3::y());
    let level = |vector: Vector3<f64>| vector - down * down.dot(&vector);
    let spare = if down.x.abs() < 0.9 { Vector3::x() } else { Vector3::z() };
    let forward = unit(level(mean(2)), unit(level(spare), Vector3::z()));
    let right = down.cross(&forward);
    let way = |along: &Vector3<f64>| {
        let at = || cameras.iter().map(|camera| along.dot(&camera.centre));
        at().fold(f64::NEG_INFINITY, f64::max) - at().fold(f64::INFINITY, f64::min)
    };
    // The way along the view shows in either picture.
    if way(&down) > SIDEWAYS * way(&right).max(way(&forward)) {
        Look { across: down, back: -forward, axis: 1, words: "from the side" }
    } else {
        Look { across: right, back: -forward, axis: 0, words: "from above" }
    }
}

/// The range of the values within the fences.
fn range(mut values: Vec<f64>) -> Option<(f64, f64)> {
    values.sort_by(f64::total_cmp);
    let last = values.len().checked_sub(1)?;
    let [lower, upper] = [0.25, 0.75].map(|share| values[(last as f64 * share).round() as usize]);
    let room = FENCE * (upper - lower);
    let inside = values.iter().copied().filter(|value| (lower - room..=upper + room).contains(value));
    inside.fold(None, |range, value| Some((range.map_or(value, |(low, _)| low), value)))
}

/// The drawing.
pub fn svg(part: &Part) -> String {
    let look = look(&part.cameras);
    let flat = |at: &Vector3<f64>| Vector2::new(look.across.dot(at), look.back.dot(at));
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
    let drawn = |at: &Vector2<f64>| {
        let at = place(at);
        (0.0..=WIDTH).contains(&at.x) && (TOP..=HEIGHT).contains(&at.y)
    };
    let outside = points.iter().filter(|at| !drawn(at)).count();
    let share = (100.0 * outside as f64 / points.len().max(1) as f64).max(1.0);
    let outside = if outside > 0 { format!(" ({share:.0} % outside)") } else { String::new() };
    let of_points = counted(part.all_points, "point");
    let mut svg = format!(
        "<svg class=\"plan\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" aria-label=\"part {} {}: {}, {of_points}\">\
         <text class=\"title\" x=\"8\" y=\"18\">Part {} {}: {}, {of_points}{outside}</text>",
        part.part,
        look.words,
        counted(part.cameras.len(), "camera"),
        part.part,
        look.words,
        counted(part.cameras.len(), "view")
    );
    if !scale.is_finite() {
        return svg + "</svg>";
    }
    draw_points(&mut svg, part, &points, place);
    draw_cameras(&mut svg, part, look.axis, &centres, place, flat);
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

/// The path through all centres, and some of the cameras on it as the triangles of their fields of view along one of
/// their axes, 0 (right) or 1 (down).
fn draw_cameras(
    svg: &mut String,
    part: &Part,
    axis: usize,
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
        let rows = camera.rotation.map(|row| flat(&Vector3::from(row)));
        let borders = [camera.borders[2 * axis], camera.borders[2 * axis + 1]];
        let rim = borders.map(|border| apex + (rows[axis] * border + rows[2]) * (CAMERA * WIDTH));
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
        let svg = svg(&Part { part: 7, cameras, points, all_points: 9, further_points: 0 });
        assert!(svg.contains("Part 7 from above: 3 views, 9 points") && svg.contains("class=\"path p1\""), "{svg}");
        let path = svg.split("points=\"").nth(1).and_then(|rest| rest.split('"').next()).expect("a path");
        let at: Vec<Vec<f64>> =
            path.split(' ').map(|pair| pair.split(',').filter_map(|number| number.parse().ok()).collect()).collect();
        assert!(at[1][0] > at[0][0] && at[1][1] == at[0][1] && at[2][1] < at[1][1], "{path}");
    }

    #[test]
    fn cameras_above_each_other_are_seen_from_the_side() {
        let mut cameras: Vec<Camera> = (0..5).map(|k| camera(0.1 * f64::from(k % 2), 0.0)).collect();
        cameras.iter_mut().enumerate().for_each(|(k, camera)| camera.centre.y = k as f64);
        let points = vec![Point { at: Vector3::new(0.0, 2.0, 4.0), weight: 1.0 }];
        let svg = svg(&Part { part: 0, cameras, points, all_points: 1, further_points: 0 });
        assert!(svg.contains("Part 0 from the side: 5 views"), "{svg}");
        let path = svg.split("points=\"").nth(1).and_then(|rest| rest.split('"').next()).expect("a path");
        let across: Vec<f64> = path.split(' ').filter_map(|pair| pair.split(',').next()?.parse().ok()).collect();
        assert!(across[4] - across[0] > 100.0 && across.is_sorted(), "down is to the right: {path}");
    }

    #[test]
    fn a_cluster_far_away_shrinks_nothing() {
        let near = (0..80).map(|k| (f64::from(k % 9) - 4.0, 4.0 + f64::from(k / 9)));
        let far = (0..20).map(|k| (900.0 + f64::from(k), 2000.0));
        let point = |(x, z): (f64, f64)| Point { at: Vector3::new(x, 0.0, z), weight: 1.0 };
        let points: Vec<Point> = near.chain(far).map(point).collect();
        let cameras = vec![camera(-1.0, 0.0), camera(1.0, 0.0)];
        let svg = svg(&Part { part: 0, cameras, points, all_points: 100, further_points: 0 });
        assert!(svg.contains("100 points (20 % outside)"), "{svg}");
        let places = svg.split('M').filter_map(|piece| piece.split_once("h2v2")?.0.split_once(' ')?.1.parse().ok());
        let places: Vec<f64> = places.collect();
        let (low, high) = (places.iter().copied().fold(f64::MAX, f64::min), places.iter().copied().fold(0.0, f64::max));
        assert!(places.len() == 80 && high - low > 0.4 * HEIGHT, "the points fill {low} to {high}");
    }

    #[test]
    fn one_camera_and_no_point_make_a_drawing() {
        let svg = svg(&Part {
            part: 0,
            cameras: vec![camera(0.0, 0.0)],
            points: Vec::new(),
            all_points: 0,
            further_points: 0,
        });
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
    }
}
