//! What an input that was joined from matches remembers of them.

use serde::{Deserialize, Serialize};

/// How an input was joined from matches.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Joining {
    /// Keypoint of each observation in the caller's order, counted within its view.
    pub keypoint: Vec<u32>,
    pub match_count: u32,
    /// Matches that were cut: they would have put two keypoints of one view into one track.
    pub cut_match_count: u32,
}

/// The observations of an input that was joined from matches, and how they came about.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct JoinedTracks {
    pub view: Vec<u32>,
    pub track: Vec<u32>,
    pub joining: Joining,
}
