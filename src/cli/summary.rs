//! A result in a few lines for people.

use super::next_steps::{self, Files};
use crate::domain::{Grade, Solution, Status, VERIFIED, counted};
use crate::formats::result_json::{CameraGroupJson, SecondStructureCounts, camera_groups};
use crate::formats::track_counts::TrackCounts;
use crate::formats::{LabelledInput, result_files, second_structures, warnings};

/// Cameras told one by one; a photo collection may have one an image, and result.json has them all.
const MOST_CAMERAS: usize = 20;
/// Parts whose views are counted one by one.
const MOST_PARTS: usize = 10;

/// The result in words, one fact a line, without a newline at the end; without the input, warnings number the views.
pub fn text(solution: &Solution, input: Option<&LabelledInput>) -> String {
    let mut lines = vec![headline(solution)];
    let mut fact = |name: &str, value: String| lines.push(format!("  {name:<13}{value}"));
    let groups = camera_groups(solution);
    match (solution.calibrations.first(), groups.as_slice()) {
        (None, _) if solution.is_focal_unobservable() => fact("focal", "unobservable: none is given".into()),
        (None, _) => {}
        (Some(only), [_]) => fact("focal", focal(only.focal_px, only.sigma_log_focal)),
        (Some(_), several) => {
            for camera in several.iter().take(MOST_CAMERAS) {
                fact(&format!("camera {} ", camera.camera_group), self::camera(camera));
            }
            if several.len() > MOST_CAMERAS {
                fact("", format!("and {}: see result.json", counted(several.len() - MOST_CAMERAS, "more camera")));
            }
        }
    }
    if let Some((low, high)) = solution.view_focals_px() {
        fact("of views", format!("{low:.1} to {high:.1} px, one each; above is their geometric mean"));
    }
    let tracks = TrackCounts::new(solution, input);
    let observations = solution.observations.inlier.len();
    fact(
        "inliers",
        format!(
            "{} of {}, {} of {}",
            tracks.inlier,
            counted(solution.tracks.inlier.len(), "track"),
            solution.inlier_observation_count(),
            counted(observations, "observation")
        ),
    );
    if tracks.two_view > 0 {
        let what = "that two views of a part see, consistent with these and not verified";
        fact("two views", format!("{} {what}", counted(tracks.two_view, "track")));
    }
    if let Some(count @ 1..) = tracks.unclassified {
        let others = counted(count, if tracks.two_view > 0 { "other track" } else { "track" });
        let them = if count == 1 { "it" } else { "them" };
        fact("unclassified", format!("{others}: fewer than {VERIFIED} registered views see {them}"));
    }
    if let Some(count @ 1..) = tracks.rejected {
        let agreeing =
            if solution.second_structures.is_empty() { "" } else { ", some of which agree on other motions" };
        fact("rejected", format!("{}{agreeing}", counted(count, "track")));
    }
    if let (Status::Solved, None, count @ 1..) = (solution.status, tracks.rejected, tracks.others) {
        let others = counted(count, "track");
        fact("not counted", format!("{others}, rejected or unclassified: the input tells which (--input)"));
    }
    for counts in second_structures::counts(solution) {
        fact(&format!("structure {} ", counts.number), structure(&counts));
    }
    if !solution.splits.is_empty() {
        fact("splits", format!("{} in tracks that join several", counted(solution.splits.len(), "further point")));
    }
    fact("views", format!("{} of {} registered", solution.registered_views().len(), solution.views.len()));
    if let Some(parts) = parts(solution) {
        fact("parts", parts);
    }
    if let Some(rms_px) = solution.reprojection_rms_px {
        fact("reprojection", format!("{rms_px:.2} px RMS over the inliers"));
    }
    if let Some(noise_px) = solution.noise_px {
        fact("noise", format!("{noise_px:.2} px"));
    }
    let mut spent = format!("{:.2} s, {}", solution.seconds, solution.method.name());
    if solution.iterations > 0 {
        spent.push_str(&format!(", {}", counted(solution.iterations, "network iteration")));
    }
    if let Some(proposal) = solution.winning_proposal {
        spent.push_str(&format!(", found by the proposal `{}`", proposal.name()));
    }
    fact("solve", spent);
    for warning in warnings::named(solution, input) {
        lines.push(format!("  warning: {}: {}", warning.code.name(), warning.detail));
    }
    lines.join("\n")
}

/// The same with where the files are and what to do next.
pub fn text_with_files(solution: &Solution, input: Option<&LabelledInput>, files: &Files) -> String {
    let mut lines = vec![text(solution, input)];
    lines.push(format!("  {:<13}{}", "files", result_files::said(files.directory, solution)));
    lines.push(next(solution, files));
    lines.join("\n")
}

/// What to do next.
pub fn next(solution: &Solution, files: &Files) -> String {
    let steps = next_steps::steps(solution.into(), files);
    format!("  {:<13}{}", "next", steps.join(&format!("\n  {:<13}", "")))
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

/// Where there are several reconstructions: how many, and their views.
fn parts(solution: &Solution) -> Option<String> {
    let count = solution.part_count() as usize;
    if count < 2 {
        return None;
    }
    let mut views = vec![0usize; count];
    solution.registered_views().into_iter().for_each(|view| views[solution.views[view].part as usize] += 1);
    let mut each: Vec<String> = views.iter().take(MOST_PARTS).map(usize::to_string).collect();
    each.extend((count > MOST_PARTS).then(|| "...".to_owned()));
    Some(format!("{count}, of {} views, each with a frame and a scale of its own", each.join(", ")))
}

/// What is known of a second structure.
fn structure(counts: &SecondStructureCounts) -> String {
    let kind = counts.kind.map_or_else(String::new, |kind| format!(", a {}", second_structures::kind_words(kind)));
    let poses =
        if counts.views > 0 { format!("posed in {}", counted(counts.views, "view")) } else { "no poses".to_owned() };
    format!("{}{kind}, {poses}", counted(counts.tracks, "track"))
}

/// What is known of one camera of several.
fn camera(camera: &CameraGroupJson) -> String {
    let views = format!("{} of {}", camera.registered_views, counted(camera.views, "view"));
    let Some(focal_px) = camera.intrinsics.focal_px else { return format!("no calibration, {views}") };
    let mut text = format!("{}, {views}", focal(focal_px, camera.intrinsics.sigma_log_focal));
    if let Some(grade) = camera.grade {
        text.push_str(&format!(", {}", grade.name()));
    }
    text
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
    use super::{Files, text, text_with_files};
    use crate::domain::result::TwoViewTrack;
    use crate::domain::second_structure::{SecondStructure, SecondStructureKind, StructurePose};
    use crate::domain::{Calibration, Grade};
    use crate::formats::fixture;

    #[test]
    fn says_what_was_found_and_every_warning() {
        let (_, mut solution) = fixture::solved();
        let lines = text(&solution, None);
        assert!(lines.starts_with("SOLVED, METRIC\n"), "{lines}");
        assert!(lines.contains("+- 0.40 % (one sigma)"), "{lines}");
        assert!(lines.contains("20 of 40 tracks, 100 of 200 observations"), "{lines}");
        assert!(lines.contains("5 of 5 registered"), "{lines}");
        assert!(lines.contains("warning: FEW_INLIERS: "), "{lines}");
        solution.calibrations[0].sigma_log_focal = None;
        assert!(text(&solution, None).contains("unobservable"));
    }

    #[test]
    fn tells_how_many_tracks_have_which_verdict() {
        let (input, mut solution) = fixture::solved();
        let lines = text(&solution, Some(&input));
        assert!(lines.contains("rejected     20 tracks\n") && !lines.contains("unclassified"), "{lines}");
        let without_input = text(&solution, None);
        assert!(without_input.contains("not counted  20 tracks, rejected or unclassified: "), "{without_input}");
        assert!(!without_input.contains("  rejected") && !lines.contains("not counted"), "{without_input}");
        solution.views[..3].iter_mut().for_each(|view| view.projection = None);
        let lines = text(&solution, Some(&input));
        assert!(lines.contains("unclassified 20 tracks: fewer than 3 registered views see them"), "{lines}");
        assert!(!lines.contains("rejected"), "{lines}");
        let outlier = solution.tracks.inlier.iter().position(|inlier| !inlier).expect("an outlier") as u32;
        solution.two_view_tracks = vec![TwoViewTrack { track: outlier, weight: 0.75, part: 0, point: None }];
        let lines = text(&solution, Some(&input));
        assert!(lines.contains("two views    1 track that two views of a part see"), "{lines}");
        assert!(lines.contains("unclassified 19 other tracks: fewer than 3 registered views see them"), "{lines}");
    }

    #[test]
    fn ends_with_what_to_do_next() {
        let (input, solution) = fixture::projective_only();
        let files = Files { directory: "answer".as_ref(), exports: &[], format: None };
        let lines = text_with_files(&solution, Some(&input), &files);
        let last: Vec<&str> = lines.lines().rev().take(3).collect();
        assert!(last[2] == "  files        answer" && last[1].starts_with("  next         open answer/"), "{lines}");
        assert!(last[0].starts_with("               PROJECTIVE_ONLY because of UNOBSERVABLE_FOCAL: "), "{lines}");
    }

    #[test]
    fn tells_of_tracks_that_join_points() {
        assert!(text(&fixture::solved_with_a_split().1, None).contains("splits       1 further point in"));
    }

    #[test]
    fn tells_how_second_structures_move() {
        let (_, mut solution) = fixture::solved();
        solution.tracks.second_structure = (0..40).map(|track| u32::from(track < 3)).collect();
        let rotation = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        let poses: Vec<StructurePose> =
            (0..2).map(|view| StructurePose { view, rotation, translation: [0.0; 3] }).collect();
        let mut said = |kind, poses: &[StructurePose]| {
            let structure = SecondStructure { number: 1, kind, poses: poses.to_vec(), points: Vec::new() };
            solution.second_structures = vec![structure];
            let lines = text(&solution, None);
            lines.lines().find(|line| line.starts_with("  structure")).expect("a line").to_owned()
        };
        assert_eq!(
            said(Some(SecondStructureKind::MovingBody), &poses),
            "  structure 1  3 tracks, a moving body, posed in 2 views"
        );
        assert_eq!(
            said(Some(SecondStructureKind::RepeatedStructure), &[]),
            "  structure 1  3 tracks, a repeated structure or a body that stands still at times, no poses"
        );
        assert_eq!(said(None, &poses), "  structure 1  3 tracks, posed in 2 views");
    }

    #[test]
    fn tells_every_camera_and_every_part() {
        let (_, mut solution) = fixture::solved_in_two_parts();
        assert!(text(&solution, None).contains("parts        2, of 3, 2 views, each with a frame"));
        let second =
            Calibration { camera_group: 9, focal_px: 77.0, grade: Some(Grade::Weak), ..solution.calibrations[0] };
        solution.calibrations.push(second);
        solution.views[4].camera_group = 9;
        let lines = text(&solution, None);
        assert!(lines.contains("  camera 0     ") && lines.contains("4 of 4 views, METRIC"), "{lines}");
        assert!(lines.contains("  camera 9     77.0 px +- 0.40 % (one sigma), 1 of 1 view, WEAK"), "{lines}");
        solution.views[4].projection = None;
        solution.calibrations.pop();
        assert!(text(&solution, None).contains("camera 9     no calibration, 0 of 1 view"));
    }

    #[test]
    fn tells_that_the_focal_length_is_a_mean_where_views_have_their_own() {
        let (_, mut solution) = fixture::solved();
        assert!(!text(&solution, None).contains("of views"));
        (solution.views[0].focal_px, solution.views[2].focal_px) = (Some(678.0), Some(1127.0));
        assert!(text(&solution, None).contains("of views     678.0 to 1127.0 px, one each"));
    }

    #[test]
    fn a_projective_result_names_no_focal_length() {
        let lines = text(&fixture::projective_only().1, None);
        assert!(lines.starts_with("SOLVED, PROJECTIVE_ONLY: "), "{lines}");
        let focal =
            lines.lines().find(|line| line.trim_start().starts_with("focal")).expect("a line on the focal length");
        assert!(focal.contains("unobservable") && !focal.contains("px"), "{focal}");
    }
}
