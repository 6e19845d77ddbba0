//! What `second-structures.json` holds, and what other files say of second structures. Field names and spellings are a
//! contract: add, never rename.

use serde::Serialize;

use super::result_json::{SecondStructureCounts, track_label, view_label};
use super::{Label, LabelledInput};
use crate::domain::Solution;
use crate::domain::second_structure::SecondStructureKind;

/// What `second-structures.json` holds.
#[derive(Debug, Clone, Serialize)]
pub struct SecondStructuresJson {
    /// By number.
    pub structures: Vec<SecondStructureJson>,
}

/// One of them. Its poses and points are in a frame and a scale of its own.
#[derive(Debug, Clone, Serialize)]
pub struct SecondStructureJson {
    /// As the column `second_structure` of `tracks.csv` has it.
    pub number: u32,
    /// Null: fewer than three views have poses, or it is a kind that this version does not know.
    pub kind: Option<SecondStructureKind>,
    /// The caller's ids of its tracks, in the order of `tracks.csv`.
    pub tracks: Vec<Label>,
    /// The views that have a pose in its frame, in the order of `cameras.json`.
    pub views: Vec<StructureViewJson>,
    /// The points of its reconstruction, in the order of `tracks.csv`.
    pub points: Vec<StructurePointJson>,
}

/// A view's pose in the frame of a structure: `x ~ K (R X + t)` for its points `X`, before the distortion of the lens.
/// Matrices row by row.
#[derive(Debug, Clone, Serialize)]
#[allow(non_snake_case, reason = "the field's name for this matrix is a capital")]
pub struct StructureViewJson {
    /// The caller's id of the view: a number, or a text where the input has names.
    pub view: Label,
    pub R: [[f64; 3]; 3],
    pub t: [f64; 3],
}

/// A point of a structure.
#[derive(Debug, Clone, Serialize)]
pub struct StructurePointJson {
    /// The caller's id of the track.
    pub track: Label,
    pub point: [f64; 3],
}

impl SecondStructuresJson {
    /// Without the input, tracks and views without a name are numbered from 0.
    pub fn new(solution: &Solution, input: Option<&LabelledInput>) -> Self {
        let view_of = |view: u32| view_label(solution, input, view as usize);
        let track_of = |track: u32| track_label(input, track as usize);
        let structures = solution.second_structures.iter().map(|structure| {
            let poses = structure.poses.iter();
            let points = structure.points.iter();
            SecondStructureJson {
                number: structure.number,
                kind: structure.kind,
                tracks: tracks(solution, structure.number).map(|track| track_label(input, track)).collect(),
                views: poses
                    .map(|pose| StructureViewJson { view: view_of(pose.view), R: pose.rotation, t: pose.translation })
                    .collect(),
                points: points
                    .map(|point| StructurePointJson { track: track_of(point.track), point: point.point })
                    .collect(),
            }
        });
        Self { structures: structures.collect() }
    }
}

/// What `result.json` says of the structures, by number.
pub fn counts(solution: &Solution) -> Vec<SecondStructureCounts> {
    let structures = solution.second_structures.iter().map(|structure| SecondStructureCounts {
        number: structure.number,
        kind: structure.kind,
        tracks: tracks(solution, structure.number).count(),
        views: structure.poses.len(),
        points: structure.points.len(),
    });
    structures.collect()
}

/// The kind, as people are told it.
pub fn kind_words(kind: SecondStructureKind) -> &'static str {
    match kind {
        SecondStructureKind::MovingBody => "moving body",
        SecondStructureKind::RepeatedStructure => "repeated structure or a body that stands still at times",
    }
}

/// Indices of the tracks of a structure, rising.
fn tracks(solution: &Solution, number: u32) -> impl Iterator<Item = usize> {
    let numbers = solution.tracks.second_structure.iter().enumerate();
    numbers.filter(move |(_, of)| **of == number).map(|(track, _)| track)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use serde_json::{Value, json};

    use super::*;
    use crate::formats::result_files::{self, SECOND_STRUCTURES};
    use crate::formats::{LabelledInput, fixture};

    fn written(directory: &Path, solution: &Solution, input: &LabelledInput) {
        result_files::write(directory, solution, Some(input), &[]).expect("written");
    }

    #[test]
    fn poses_and_points_have_a_file_of_their_own() {
        let (input, solution) = fixture::solved_with_second_structures();
        let directory = tempfile::tempdir().expect("a temporary directory");
        written(directory.path(), &solution, &input);
        let path = directory.path().join(SECOND_STRUCTURES);
        let file: Value = serde_json::from_slice(&std::fs::read(&path).expect("a file")).expect("JSON");
        let track = |track: usize| json!(input.track_labels[track]);
        let tracks: Vec<Value> = (1..40).step_by(4).map(track).collect();
        let rotation = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]];
        let views = [0, 3].map(|at| json!({ "view": input.view_labels[at], "R": rotation, "t": [1.0, 2.0, 3.0] }));
        let first = json!({
            "number": 1,
            "kind": "MOVING_BODY",
            "tracks": tracks,
            "views": views,
            "points": [{ "track": track(5), "point": [4.0, 5.0, 6.0] }],
        });
        let tracks: Vec<Value> = (3..40).step_by(4).map(track).collect();
        let second = json!({ "number": 2, "kind": null, "tracks": tracks, "views": [], "points": [] });
        assert_eq!(file, json!({ "structures": [first, second] }));
        // It goes with the next result that has none.
        written(directory.path(), &fixture::solved().1, &input);
        assert!(!path.exists());
    }

    #[test]
    fn the_summary_counts_them() {
        let counted = |solution: &Solution| {
            let text = result_files::result_json(solution, None).expect("serialisable");
            serde_json::from_str::<Value>(&text).expect("JSON")["second_structures"].take()
        };
        let counts = json!([
            { "number": 1, "kind": "MOVING_BODY", "tracks": 10, "views": 2, "points": 1 },
            { "number": 2, "kind": null, "tracks": 10, "views": 0, "points": 0 },
        ]);
        assert_eq!(counted(&fixture::solved_with_second_structures().1), counts);
        assert_eq!(counted(&fixture::solved().1), json!([]));
    }
}
