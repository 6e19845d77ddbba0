//! Warnings in the caller's words: the solver numbers views and tracks, an input has names for them.

use super::LabelledInput;
use super::result_json::{track_label, view_label};
use crate::domain::duplicates::Duplicates;
use crate::domain::{Limits, Solution, Warning, WarningCode};

/// The warnings of a result, views and tracks under the input's own ids or names; without the input, as the solver gave
/// them.
pub fn named(solution: &Solution, input: Option<&LabelledInput>) -> Vec<Warning> {
    let Some(input) = input else { return solution.warnings.clone() };
    let told = solution.left_out_warnings(|view| view_label(solution, Some(input), view).shown());
    let mut warnings: Vec<Warning> = solution.warnings.clone();
    if !told.is_empty() {
        warnings.retain(|warning| warning.code != WarningCode::ViewsLeftOut);
        warnings.extend(told);
    }
    if let Some(place) = warnings.iter().position(|warning| warning.code == WarningCode::DuplicateTracks) {
        // Above the limits of this program, as a server may allow, tracks keep their numbers.
        let duplicates = input.check(&Limits::default()).ok().and_then(|checked| Duplicates::of(&checked));
        if let Some(duplicates) = duplicates {
            warnings[place] = duplicates.warning(|track| track_label(Some(input), track).shown());
        }
    }
    warnings
}

/// Why there is no calibration; `None` where there is one, or where nothing was said. No such warning names views or
/// tracks.
pub fn reason(solution: &Solution) -> Option<&Warning> {
    solution.warnings.iter().find(|warning| warning.code.refuses() && !solution.is_metric())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::LeftOut;
    use crate::formats::{Label, fixture};

    #[test]
    fn views_go_by_the_names_of_the_input() {
        let (mut input, mut solution) = fixture::solved();
        assert_eq!(named(&solution, Some(&input)), solution.warnings, "nothing is left out");
        solution.views[1] = fixture::left_out(LeftOut::NoObservations);
        solution.views[3] = fixture::left_out(LeftOut::NotRegistered { points: 12, agreeing: 4 });
        let left_out = solution.left_out_warnings(|view| view.to_string());
        solution.warnings.extend(left_out);
        input.view_labels[1] = Label::Name("west.jpg".into());
        let details = |input| -> Vec<String> {
            named(&solution, input).into_iter().skip(1).map(|warning| warning.detail).collect()
        };
        assert_eq!(
            details(Some(&input)),
            [
                "1 of 4 views could not be registered: 33 (4 of the 12 points it sees agree on a pose)",
                "nothing is observed in 1 of 5 views: west.jpg"
            ]
        );
        assert!(details(None)[0].contains(": 3 (4 of"), "{:?}", details(None));
    }

    #[test]
    fn duplicates_go_by_the_names_of_the_input() {
        let (mut input, mut solution) = fixture::solved();
        for k in 0..input.raw.x.len() {
            let like = |j: &usize| input.raw.track[*j] == 4 && input.raw.view[*j] == input.raw.view[k];
            if input.raw.track[k] == 7 {
                let like = (0..input.raw.x.len()).find(like).expect("complete tracks");
                (input.raw.x[k], input.raw.y[k]) = (input.raw.x[like], input.raw.y[like]);
            }
        }
        solution.warnings.push(Warning::new(WarningCode::DuplicateTracks, "1 of 40 tracks: 7 (as 4)"));
        let detail = |input| named(&solution, input).pop().expect("a warning").detail;
        assert!(detail(Some(&input)).ends_with(": 114 (as 108)"), "{}", detail(Some(&input)));
        assert!(detail(None).ends_with(": 7 (as 4)"));
    }
}
