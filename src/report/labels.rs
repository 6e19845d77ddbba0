//! The caller's names as a page shows them.

use crate::domain::Solution;
use crate::formats::LabelledInput;
use crate::formats::result_json::{track_label, view_label};

/// The name of view `index`.
pub fn view(solution: &Solution, input: Option<&LabelledInput>, index: usize) -> String {
    view_label(solution, input, index).shown()
}

/// The name of track `index`.
pub fn track(input: Option<&LabelledInput>, index: usize) -> String {
    track_label(input, index).shown()
}
