//! A result in a few lines for people.

use crate::domain::{Grade, Solution, Status};

/// The result in words, one fact a line, without a newline at the end.
pub fn text(solution: &Solution) -> String {
    let mut lines = vec![headline(solution)];
    let mut fact = |name: &str, value: String| lines.push(format!("  {name:<13}{value}"));
    if let [first, rest @ ..] = solution.calibrations.as_slice() {
        fact("focal", focal(first.focal_px, first.sigma_log_focal));
        for camera in rest {
            fact("", focal(camera.focal_px, camera.sigma_log_focal));
        }
    } else if solution.is_focal_unobservable() {
        fact("focal", "unobservable: none is given".into());
    }
    let tracks = solution.tracks.inlier.len();
    let observations = solution.observations.inlier.len();
    fact(
        "inliers",
        format!(
            "{} of {tracks} tracks, {} of {observations} observations",
            solution.inlier_track_count(),
            solution.inlier_observation_count()
        ),
    );
    fact("views", format!("{} of {} registered", solution.registered_views().len(), solution.views.len()));
    if let Some(rms_px) = solution.reprojection_rms_px {
        fact("reprojection", format!("{rms_px:.2} px RMS over the inliers"));
    }
    if let Some(noise_px) = solution.noise_px {
        fact("noise", format!("{noise_px:.2} px"));
    }
    let mut spent = format!("{:.2} s, {}", solution.seconds, solution.method.name());
    if solution.iterations > 0 {
        spent.push_str(&format!(", {} network iterations", solution.iterations));
    }
    if let Some(prior) = solution.winning_prior {
        spent.push_str(&format!(", found by the prior `{}`", prior.name()));
    }
    fact("solve", spent);
    for warning in &solution.warnings {
        lines.push(format!("  warning: {}: {}", warning.code.name(), warning.detail));
    }
    lines.join("\n")
}

fn headline(solution: &Solution) -> String {
    match (solution.status, solution.grade) {
        (Status::NoReconstruction, _) => "NO_RECONSTRUCTION".into(),
        (Status::Solved, None) => "SOLVED".into(),
        (Status::Solved, Some(grade)) => {
            let meaning = match grade {
                Grade::Metric => "",
                Grade::Weak => ": the focal length is known to 2 to 10 %",
                Grade::ProjectiveOnly => ": the data carry no calibration to rely on",
            };
            format!("SOLVED, {}{meaning}", grade.name())
        }
    }
}

/// `1204.3 px +- 0.40 % (one sigma)`, or that nothing holds it.
fn focal(focal_px: f64, sigma_log: Option<f64>) -> String {
    match sigma_log {
        Some(sigma) => format!("{focal_px:.1} px +- {:.2} % (one sigma)", sigma * 100.0),
        None => format!("{focal_px:.1} px, unobservable"),
    }
}

#[cfg(test)]
mod tests {
    use super::text;
    use crate::formats::fixture;

    #[test]
    fn says_what_was_found_and_every_warning() {
        let (_, mut solution) = fixture::solved();
        let lines = text(&solution);
        assert!(lines.starts_with("SOLVED, METRIC\n"), "{lines}");
        assert!(lines.contains("+- 0.40 % (one sigma)"), "{lines}");
        assert!(lines.contains("20 of 40 tracks, 100 of 200 observations"), "{lines}");
        assert!(lines.contains("5 of 5 registered"), "{lines}");
        assert!(lines.contains("warning: FEW_INLIERS: "), "{lines}");
        solution.calibrations[0].sigma_log_focal = None;
        assert!(text(&solution).contains("unobservable"));
    }

    #[test]
    fn a_projective_result_names_no_focal_length() {
        let lines = text(&fixture::projective_only().1);
        assert!(lines.starts_with("SOLVED, PROJECTIVE_ONLY: "), "{lines}");
        let focal =
            lines.lines().find(|line| line.trim_start().starts_with("focal")).expect("a line on the focal length");
        assert!(focal.contains("unobservable") && !focal.contains("px"), "{focal}");
    }
}
