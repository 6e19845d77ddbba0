//! Views that take no part in a result: the reason as data, and the sentences made of it.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::warning::{Warning, WarningCode};
use super::words::counted;

/// Views named one by one in a warning; past these they are only counted.
const MOST_LISTED: usize = 20;
/// The same for views that nothing is observed in: their number says what went wrong, a few names where to look.
const MOST_LISTED_EMPTY: usize = 5;

/// Views that see many points of which few agree, from which on another camera is named: one or two may hold wrong
/// matches.
const LEAST_CONTRADICTED_VIEWS: usize = 3;
/// Points that are many: three times as many as determine a pose beyond chance. Few is less than a third of them.
const MANY_POINTS: u32 = 24;

/// Why a view is not registered.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "SCREAMING_SNAKE_CASE")]
pub enum LeftOut {
    /// No observation lies in it.
    NoObservations,
    /// It is outside the block of views that was solved.
    OutsideBlock,
    /// Of the points of a reconstruction that it sees, too few agree on a pose.
    NotRegistered { points: u32, agreeing: u32 },
    /// A reason that this version does not know: a server of a later one gave it.
    Unknown,
}

impl LeftOut {
    /// Whether the view sees many points of which few agree.
    fn is_contradicted(self) -> bool {
        let LeftOut::NotRegistered { points, agreeing } = self else { return false };
        points >= MANY_POINTS && agreeing < points / 3
    }

    /// The reason as it stands in files.
    pub fn name(self) -> &'static str {
        match self {
            LeftOut::NoObservations => "NO_OBSERVATIONS",
            LeftOut::OutsideBlock => "OUTSIDE_BLOCK",
            LeftOut::NotRegistered { .. } => "NOT_REGISTERED",
            LeftOut::Unknown => "UNKNOWN",
        }
    }
}

/// The reason in words, to stand behind a view's name.
impl fmt::Display for LeftOut {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            LeftOut::NoObservations => f.write_str("nothing is observed in it"),
            LeftOut::OutsideBlock => f.write_str("is outside the block that was solved"),
            LeftOut::NotRegistered { points: 0, .. } => f.write_str("sees too few points of the reconstruction"),
            LeftOut::NotRegistered { points, agreeing } => {
                write!(f, "{agreeing} of the {} it sees agree on a pose", counted(*points, "point"))
            }
            LeftOut::Unknown => f.write_str("for a reason that this version does not know"),
        }
    }
}

/// The warnings that the reasons of the views amount to, one a kind of reason.
///
/// * `reasons`: of each view; `None` where it takes part
/// * `name`: of a view, by its index
pub fn warnings(reasons: &[Option<LeftOut>], name: impl Fn(usize) -> String) -> Vec<Warning> {
    let of = |wanted: fn(LeftOut) -> bool| -> Vec<(usize, LeftOut)> {
        let left_out = reasons.iter().enumerate().filter_map(|(view, reason)| Some((view, (*reason)?)));
        left_out.filter(|(_, reason)| wanted(*reason)).collect()
    };
    let unregistered = of(|reason| matches!(reason, LeftOut::NotRegistered { .. } | LeftOut::Unknown));
    let outside = of(|reason| reason == LeftOut::OutsideBlock);
    let empty = of(|reason| reason == LeftOut::NoObservations);
    let observed = reasons.len() - empty.len();
    let names = |left: &[(usize, LeftOut)], most| listed(left.iter().map(|(view, _)| name(*view)), most);
    let mut details = Vec::new();
    if !unregistered.is_empty() {
        let named = unregistered.iter().map(|(view, reason)| format!("{} ({reason})", name(*view)));
        let contradicted = unregistered.iter().filter(|(_, reason)| reason.is_contradicted()).count();
        let hint = match contradicted >= LEAST_CONTRADICTED_VIEWS {
            true => "; views that see many points of which few agree may be of another camera or zoom",
            false => "",
        };
        details.push(format!(
            "{} of {observed} views could not be registered: {}{hint}",
            unregistered.len(),
            listed(named, MOST_LISTED)
        ));
    }
    if !outside.is_empty() {
        details.push(format!(
            "{} of {observed} views are outside the block that was solved and were left out: {}",
            outside.len(),
            names(&outside, MOST_LISTED)
        ));
    }
    if !empty.is_empty() {
        details.push(format!(
            "nothing is observed in {} of {} views: {}",
            empty.len(),
            reasons.len(),
            names(&empty, MOST_LISTED_EMPTY)
        ));
    }
    details.into_iter().map(|detail| Warning::new(WarningCode::ViewsLeftOut, detail)).collect()
}

/// The names with commas between them, past the first few only counted.
fn listed(names: impl ExactSizeIterator<Item = String>, most: usize) -> String {
    let count = names.len();
    let mut listed: Vec<String> = names.take(most).collect();
    if count > listed.len() {
        listed.push(format!("and {} more", count - listed.len()));
    }
    listed.join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_kind_of_reason_is_told_once_with_names() {
        let unseen = LeftOut::NotRegistered { points: 0, agreeing: 0 };
        let lost = LeftOut::NotRegistered { points: 12, agreeing: 4 };
        let empty = Some(LeftOut::NoObservations);
        let reasons = [None, Some(lost), empty, Some(unseen), empty, empty, empty, empty, empty];
        let told = warnings(&reasons, |view| format!("{view}.jpg"));
        assert!(told.iter().all(|warning| warning.code == WarningCode::ViewsLeftOut));
        let details: Vec<&str> = told.iter().map(|warning| warning.detail.as_str()).collect();
        assert_eq!(
            details,
            [
                "2 of 3 views could not be registered: 1.jpg (4 of the 12 points it sees agree on a pose), 3.jpg (sees too \
                 few points of the reconstruction)",
                "nothing is observed in 6 of 9 views: 2.jpg, 4.jpg, 5.jpg, 6.jpg, 7.jpg, and 1 more",
            ]
        );
    }

    #[test]
    fn views_that_many_points_contradict_may_be_of_another_camera() {
        let views = |count: usize, points: u32| {
            let reason = LeftOut::NotRegistered { points, agreeing: 10 };
            warnings(&vec![Some(reason); count], |view| view.to_string())[0].detail.clone()
        };
        assert!(views(3, 70).ends_with("may be of another camera or zoom"), "{}", views(3, 70));
        assert!(!views(2, 70).contains("another camera") && !views(3, 28).contains("another camera"));
    }

    #[test]
    fn a_block_lists_what_it_leaves_out_and_no_reason_tells_nothing() {
        let reasons = [None, Some(LeftOut::OutsideBlock)];
        let told = warnings(&reasons, |view| view.to_string());
        assert_eq!(told.len(), 1);
        assert_eq!(told[0].detail, "1 of 2 views are outside the block that was solved and were left out: 1");
        assert!(warnings(&reasons[..1], |view| view.to_string()).is_empty());
    }
}
