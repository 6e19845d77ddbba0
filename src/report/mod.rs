//! `report.html`: one self-contained page that shows a result to a person, without a network.
//!
//! May depend on `domain` and on the labels of `formats`. Every string is escaped on its way into the page.

use crate::domain::Solution;
use crate::formats::LabelledInput;

/// The page.
pub fn page(_solution: &Solution, _input: Option<&LabelledInput>) -> String {
    String::new()
}
