//! What a solution says of every view beside its camera: the name, the camera group, and why a view is left out.

use super::problem::observed_views;
use crate::domain::result::ViewResult;
use crate::domain::{Input, LeftOut, Solution, Status};

/// Gives every view its name and its camera group, and every view that is not registered its reason, where the solver has not; the
/// warnings tell the reasons.
pub fn complete(solution: &mut Solution, input: &Input) {
    let mut observed = vec![false; input.view_count()];
    observed_views(input).into_iter().for_each(|view| observed[view] = true);
    let solved = solution.status == Status::Solved;
    for ((result, view), observed) in solution.views.iter_mut().zip(input.views()).zip(observed) {
        result.name.clone_from(&view.name);
        result.camera_group = view.camera_group;
        result.left_out = reason(result, observed, solved);
    }
    let told = solution.left_out_warnings(|view| view.to_string());
    solution.warnings.extend(told);
}

fn reason(result: &ViewResult, observed: bool, solved: bool) -> Option<LeftOut> {
    if result.projection.is_some() {
        None
    } else if !observed {
        Some(LeftOut::NoObservations)
    } else if solved {
        result.left_out.or(Some(LeftOut::OutsideBlock))
    } else {
        // Nothing was reconstructed: that reason is all of theirs.
        None
    }
}
