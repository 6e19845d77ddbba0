//! Rigid motions of their own among the tracks that are no inliers: moving bodies and repeated structures.

use serde::{Deserialize, Serialize};

/// How a second structure moves against the scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "SCREAMING_SNAKE_CASE")]
pub enum SecondStructureKind {
    /// It stands still between less than a fifth of all pairs of its views.
    MovingBody,
    /// It stands still between a fifth of all pairs of its views or more: copies of one part of the scene that were
    /// taken for each other, or a body that stood still for a while.
    RepeatedStructure,
}

/// A rigid motion of its own, of tracks that are no inliers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SecondStructure {
    /// As [`TrackResults::second_structure`](super::result::TrackResults::second_structure) has it.
    pub number: u32,
    /// `None`: fewer than three views have poses, or it is a kind that this version does not know.
    pub kind: Option<SecondStructureKind>,
    /// By view; views of its reconstruction that have a pose in the scene. Empty without a metric result, and where its
    /// tracks make no reconstruction under the calibration: one that fits, has parallax, is in front of its cameras and
    /// is the only one.
    pub poses: Vec<StructurePose>,
    /// The points of its reconstruction, by track, in the frame of `poses`.
    pub points: Vec<StructurePoint>,
}

/// The pose of a view in the frame of a second structure: `x = R X + t` takes its points into camera coordinates. The
/// frame and the scale are the structure's own; the ratio to the scale of the scene is not determined.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct StructurePose {
    pub view: u32,
    pub rotation: [[f64; 3]; 3],
    pub translation: [f64; 3],
}

/// A point of a second structure.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct StructurePoint {
    /// Index of the track.
    pub track: u32,
    pub point: [f64; 3],
}
