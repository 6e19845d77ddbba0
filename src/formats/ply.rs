//! Points as PLY: those of the inlier tracks of one part in `points.ply` and those that two views see in
//! `points-two-view.ply`, coloured by weight, and those of a model.

use std::fmt::Write;

use super::LabelledInput;
use super::metric::Model;
use super::result_json::track_label;
use crate::domain::Solution;

/// The points of a part as an ASCII PLY: text, so that results can be compared line by line.
///
/// A vertex has `x y z` (metric where the result is metric, else dehomogenised in the frame of the projective cameras,
/// which a comment tells), a colour from orange (weight 0) to blue (weight 1), the weight, the caller's id of the
/// track, or where that is no number its place among the tracks, and which of the points that the track joins it is: 0
/// for its own, else the number in the column `split` of `observations.csv`.
pub fn points(solution: &Solution, input: Option<&LabelledInput>, part: u32) -> String {
    let tracks = &solution.tracks;
    let of_part = |track: usize| tracks.part_of(track) == Some(part);
    let own = (0..tracks.point.len()).filter(|&track| of_part(track)).filter_map(|track| {
        let weight = tracks.weight.get(track).copied().unwrap_or(0.0);
        Some((track, 0, weight, tracks.point[track]?))
    });
    let others = solution.splits.iter().filter(|split| of_part(split.track as usize));
    let others = others.filter_map(|split| Some((split.track as usize, split.number, split.weight, split.point?)));
    let vertices: Vec<(usize, u32, f32, [f64; 3])> = own.chain(others).collect();
    let which = match solution.part_count() {
        0 | 1 => String::new(),
        several => format!(" of part {part} of {several}"),
    };
    let frame = if solution.is_metric() {
        "metric up to scale"
    } else {
        "projective (pixels, frame P1 = [I|0] of the first registered view): no distances, no angles"
    };
    weighted(&format!("scpsfm points{which}, {frame}, coloured by weight"), "split", vertices, input)
}

/// The points of the tracks that two views see, of all parts; `None` where there are none. A vertex is as in
/// [`points`], with the part in place of the split.
pub fn two_view_points(solution: &Solution, input: Option<&LabelledInput>) -> Option<String> {
    let found = solution.two_view_tracks.iter();
    let vertices: Vec<(usize, u32, f32, [f64; 3])> =
        found.filter_map(|found| Some((found.track as usize, found.part, found.weight, found.point?))).collect();
    let comment = "scpsfm points that two views see: consistent with these, not verified; frames as in points.ply and \
                   points-part-N.ply";
    (!vertices.is_empty()).then(|| weighted(comment, "part", vertices, input))
}

/// Points with their weights and tracks, and a number of this name.
fn weighted(
    comment: &str,
    number_name: &str,
    vertices: Vec<(usize, u32, f32, [f64; 3])>,
    input: Option<&LabelledInput>,
) -> String {
    let mut text = format!(
        "ply\nformat ascii 1.0\ncomment {comment}\nelement vertex {}\n\
         property double x\nproperty double y\nproperty double z\n\
         property uchar red\nproperty uchar green\nproperty uchar blue\n\
         property float weight\nproperty double track\nproperty uint {number_name}\nend_header\n",
        vertices.len()
    );
    for (track, number, weight, [x, y, z]) in vertices {
        let [red, green, blue] = colour(weight);
        let label = track_label(input, track).number().unwrap_or(track as u64);
        // Writing to a String cannot fail.
        let _ = writeln!(text, "{x} {y} {z} {red} {green} {blue} {weight} {label} {number}");
    }
    text
}

/// The points of a model as an ASCII PLY that other programs read: position and colour.
pub fn of_model(model: &Model) -> String {
    let mut text = format!(
        "ply\nformat ascii 1.0\nelement vertex {}\nproperty double x\nproperty double y\nproperty double z\n\
         property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n",
        model.points.len()
    );
    for point in &model.points {
        let ([x, y, z], [red, green, blue]) = (point.position, point.colour);
        // Writing to a String cannot fail.
        let _ = writeln!(text, "{x} {y} {z} {red} {green} {blue}");
    }
    text
}

/// Colours of the weights 0 and 1, orange and blue.
const LOW: [f32; 3] = [230.0, 120.0, 20.0];
const HIGH: [f32; 3] = [30.0, 100.0, 220.0];

/// The colour of a weight: a straight line from orange (0) to blue (1), apart for the colour-blind too.
pub fn colour(weight: f32) -> [u8; 3] {
    let share = if weight.is_finite() { weight.clamp(0.0, 1.0) } else { 0.0 };
    std::array::from_fn(|k| (LOW[k] + (HIGH[k] - LOW[k]) * share).round() as u8)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::result::TwoViewTrack;
    use crate::formats::fixture;

    #[test]
    fn declares_as_many_vertices_as_it_holds() {
        let (input, solution) = fixture::solved();
        let text = points(&solution, Some(&input), 0);
        let body = text.split_once("end_header\n").expect("a header").1;
        let inliers = solution.inlier_track_count();
        assert!(inliers > 0);
        assert!(text.contains(&format!("element vertex {inliers}\n")));
        assert_eq!(body.lines().count(), inliers);
        let first = body.lines().next().expect("a vertex").split(' ').collect::<Vec<_>>();
        let track = solution.tracks.inlier.iter().position(|&inlier| inlier).expect("an inlier");
        assert_eq!((first.len(), first[8]), (9, "0"));
        assert_eq!(first[7], input.track_labels[track].to_string());
        assert_eq!(first[0], solution.tracks.point[track].expect("a point")[0].to_string());
    }

    #[test]
    fn says_in_which_frame_the_points_are() {
        let comment = |solution: &Solution| {
            let text = points(solution, None, 0);
            text.lines().find(|line| line.starts_with("comment")).expect("a comment").to_owned()
        };
        assert!(comment(&fixture::solved().1).contains("metric up to scale"));
        let (_, projective) = fixture::projective_only();
        let comment = comment(&projective);
        assert!(comment.contains("projective (pixels") && !comment.contains("metric"), "{comment}");
        assert!(
            points(&projective, None, 0).contains(&format!("element vertex {}\n", projective.inlier_track_count()))
        );
    }

    #[test]
    fn both_points_of_a_split_track_are_vertices() {
        let (input, solution) = fixture::solved_with_a_split();
        let split = solution.splits[0];
        let text = points(&solution, Some(&input), 0);
        assert!(text.contains(&format!("element vertex {}\n", solution.inlier_track_count() + 1)));
        let label = input.track_labels[split.track as usize].to_string();
        let of_track = text.lines().filter(|line| line.split(' ').nth(7) == Some(&label));
        let numbers: Vec<&str> = of_track.filter_map(|line| line.rsplit(' ').next()).collect();
        assert_eq!(numbers, ["0", "1"]);
    }

    #[test]
    fn what_two_views_see_has_a_file_of_its_own() {
        let (input, mut solution) = fixture::solved();
        let before = points(&solution, Some(&input), 0);
        assert_eq!(two_view_points(&solution, Some(&input)), None);
        let seen = TwoViewTrack { track: 1, weight: 0.75, part: 2, point: Some([1.5, -2.0, 3.0]) };
        solution.two_view_tracks = vec![seen, TwoViewTrack { track: 3, point: None, ..seen }];
        let text = two_view_points(&solution, Some(&input)).expect("a point");
        assert!(text.contains("element vertex 1\n") && text.contains("property uint part\n"), "{text}");
        let [red, green, blue] = colour(0.75);
        let label = &input.track_labels[1];
        assert!(text.ends_with(&format!("\n1.5 -2 3 {red} {green} {blue} 0.75 {label} 2\n")), "{text}");
        assert_eq!(points(&solution, Some(&input), 0), before);
    }

    #[test]
    fn colours_are_ordered_and_survive_nonsense() {
        assert_eq!(colour(0.0), [230, 120, 20]);
        assert_eq!(colour(1.0), [30, 100, 220]);
        assert_eq!(colour(f32::NAN), colour(0.0));
        assert_eq!(colour(7.0), colour(1.0));
    }
}
