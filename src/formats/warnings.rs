//! Warnings in the caller's words: the solver numbers views, an input has names for them.

use super::LabelledInput;
use super::result_json::view_label;
use crate::domain::{Solution, Warning, WarningCode, left_out};

/// The warnings of a result, views under the input's own ids or image names; without the input, as the solver gave them.
pub fn named(solution: &Solution, input: Option<&LabelledInput>) -> Vec<Warning> {
    let told = left_out::warnings(&solution.views, |view| view_label(input, view).shown());
    if input.is_none() || told.is_empty() {
        return solution.warnings.clone();
    }
    let others = solution.warnings.iter().filter(|warning| warning.code != WarningCode::ViewsLeftOut);
    others.cloned().chain(told).collect()
}

/// Why there is no calibration; `None` where there is one, or where nothing was said.
pub fn reason(solution: &Solution, input: Option<&LabelledInput>) -> Option<Warning> {
    if solution.is_metric() {
        return None;
    }
    named(solution, input).into_iter().find(|warning| warning.code.refuses())
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
        solution.warnings.extend(left_out::warnings(&solution.views, |view| view.to_string()));
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
}
