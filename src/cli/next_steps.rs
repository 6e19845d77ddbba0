//! What to do with a result, in one to three sentences. What the summary and the warnings say is not repeated.

use std::path::Path;

use super::shell::quoted;
use crate::domain::job::Summary;
use crate::domain::{Grade, LEAST_VIEWS, Solution, Status, Warning, WarningCode};
use crate::formats::{Export, Format, result_files};

/// Warnings that can be why a result is less than METRIC, the most probable cause first, each with what would help. A
/// wrong size or a wrong model comes before what the views show under it.
const REMEDIES: [(WarningCode, &str); 16] = [
    (
        WarningCode::FocalPriorContradicted,
        "check the focal length that was given (--focal-px, --view-table, the cameras of COLMAP); it is in pixels, not in \
         mm",
    ),
    (
        WarningCode::PointsOutsideImage,
        "give points in pixels from the upper left corner, and the size of the images in which they were measured \
         (--width, --height)",
    ),
    (
        WarningCode::ModelMismatch,
        "if the camera zoomed, use --focal-per-view; if there were several cameras, give each its own camera group \
         (--view-table); otherwise check the tracks",
    ),
    (WarningCode::Cheirality, "check the order of the views and the size of the images (--width, --height)"),
    (WarningCode::LittleMotion, "add views that are taken from farther apart and in other directions"),
    (WarningCode::PlanarOrRotation, "add views from other places, and objects off the plane"),
    (WarningCode::PureRotation, "add views between which the camera moved, not only turned"),
    (WarningCode::PureTranslation, "add views between which the camera turned, or give the focal length (--focal-px)"),
    (WarningCode::PlanarScene, "add views of the plane from other angles, or objects off the plane"),
    (
        WarningCode::UnobservableFocal,
        "add views between which the camera turned or tilted, or give the focal length (--focal-px)",
    ),
    (WarningCode::SecondMinimum, "add views, or give the focal length (--focal-px)"),
    (WarningCode::UnverifiedRanking, "add views or longer tracks; the weights in tracks.csv only rank the tracks"),
    (WarningCode::FewInliers, "add tracks that three or more views share: more features, or photos with more overlap"),
    (
        WarningCode::NoConsensus,
        "check the matches and the order of the views; add views, and tracks that three or more views share",
    ),
    (
        WarningCode::CameraGroupsMerged,
        "give each camera a camera group of its own (--view-table), and use --method auto or geometry",
    ),
    (WarningCode::AssumedImageSize, "give the size of the images (--width, --height)"),
];

/// What helps where no warning says why the focal length is not known better.
const MORE_VIEWS: &str =
    "add views between which the camera turned and tilted, or give the focal length (--focal-px, --focal-sigma)";

/// What a calibration of views without depth is good for.
const NO_DEPTH: &str = "the camera only turned: calibration and rotations are those of a panorama; there is no depth, so \
    that there are no points and nothing to reconstruct densely";

/// What of a result the sentences depend on.
#[derive(Debug, Clone, Copy)]
pub struct Outcome<'a> {
    status: Status,
    grade: Option<Grade>,
    warnings: &'a [Warning],
    /// Whether every view has a focal length of its own.
    has_own_focals: bool,
    /// Whether the input has fewer views than a reconstruction needs.
    has_too_few_views: bool,
    /// Whether there is a calibration without depth.
    is_without_depth: bool,
}

impl<'a> From<&'a Solution> for Outcome<'a> {
    fn from(solution: &'a Solution) -> Self {
        let Solution { status, grade, ref warnings, .. } = *solution;
        Self {
            status,
            grade,
            warnings,
            has_own_focals: solution.view_focals_px().is_some(),
            has_too_few_views: solution.views.len() < LEAST_VIEWS,
            is_without_depth: solution.is_without_depth(),
        }
    }
}

impl<'a> From<&'a Summary> for Outcome<'a> {
    fn from(summary: &'a Summary) -> Self {
        let Summary { status, grade, ref warnings, .. } = *summary;
        // What else there is to say is said of the files, which are with the solution.
        Self { status, grade, warnings, has_own_focals: false, has_too_few_views: false, is_without_depth: false }
    }
}

/// The files of a result.
#[derive(Debug, Clone, Copy)]
pub struct Files<'a> {
    pub directory: &'a Path,
    /// What was written for other programs.
    pub exports: &'a [Export],
    /// Kind of the input; `None`: nothing more can be exported of it.
    pub format: Option<Format>,
}

/// The sentences: what to look at, where to go on, and what would make the result better.
pub fn steps(outcome: Outcome, files: &Files) -> Vec<String> {
    let report = files.directory.join(result_files::REPORT);
    let holds = match (outcome.status, outcome.grade) {
        (Status::NoReconstruction, _) => "; there are no cameras and no points",
        (_, Some(Grade::ProjectiveOnly)) => {
            "; tracks.csv and observations.csv say what is right; there are no K, R and t"
        }
        _ => "",
    };
    let look = format!("open {}{holds}", report.display());
    [Some(look), elsewhere(outcome, files), advice(outcome)].into_iter().flatten().collect()
}

/// What would make the result better, and why it is not; `None` where it is good, and no given focal length contradicts
/// it.
pub fn advice(outcome: Outcome) -> Option<String> {
    let found = match (outcome.status, outcome.grade) {
        (Status::NoReconstruction, _) => "NO_RECONSTRUCTION",
        (_, Some(grade)) => grade.name(),
        _ => return None,
    };
    let has = |code| outcome.warnings.iter().any(|warning| warning.code == code);
    if outcome.grade == Some(Grade::Metric) && !has(WarningCode::FocalPriorContradicted) {
        return None;
    }
    if outcome.has_too_few_views {
        return Some(format!("{found}: add views; a reconstruction needs at least {LEAST_VIEWS}"));
    }
    Some(match REMEDIES.iter().find(|(code, _)| has(*code)) {
        Some((code, remedy)) => format!("{found} because of {}: {remedy}", code.name()),
        None if has(WarningCode::Unknown) => format!("{found}: the server is newer, and its warnings may say why"),
        None if outcome.has_own_focals => format!("{found} is the best grade with --focal-per-view"),
        None => format!("{found}: {MORE_VIEWS}"),
    })
}

/// Where another program goes on: with what was exported, or with what can be.
fn elsewhere(outcome: Outcome, files: &Files) -> Option<String> {
    if outcome.status == Status::NoReconstruction {
        return None;
    }
    let is_metric = matches!(outcome.grade, Some(Grade::Metric | Grade::Weak));
    if outcome.is_without_depth {
        return Some(NO_DEPTH.into());
    }
    let folder = |export: Export| {
        let path = files.directory.join(export.folder());
        files.exports.contains(&export).then(|| quoted(&path.to_string_lossy()))
    };
    if let Some(folder) = folder(Export::ColmapDatabase) {
        return Some(format!(
            "COLMAP goes on: colmap mapper --database_path {folder}/database.db --image_path PHOTOS --output_path \
             sparse"
        ));
    }
    if let Some(folder) = folder(Export::Colmap).or_else(|| folder(Export::ColmapText)) {
        return Some(format!(
            "COLMAP goes on: colmap image_undistorter --image_path PHOTOS --input_path {folder} --output_path dense"
        ));
    }
    if let Some(folder) = folder(Export::Nerfstudio) {
        return Some(format!("with the photos in {folder}: ns-train nerfacto --data {folder}"));
    }
    if !files.exports.is_empty() {
        return None;
    }
    match (files.format?, is_metric) {
        (Format::ColmapDatabase, true) => Some(
            "--export colmap-db writes a database for COLMAP's mapper; colmap, nerfstudio or opensfm a model".into(),
        ),
        (Format::ColmapDatabase, false) => {
            Some("--export colmap-db writes a database with the right matches, for COLMAP's mapper".into())
        }
        (_, true) => Some("--export colmap, nerfstudio or opensfm writes the result for these programs".into()),
        (_, false) => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn outcome(grade: Option<Grade>, warnings: &[Warning]) -> Outcome<'_> {
        let status = if grade.is_some() { Status::Solved } else { Status::NoReconstruction };
        Outcome { status, grade, warnings, has_own_focals: false, has_too_few_views: false, is_without_depth: false }
    }

    fn files<'a>(exports: &'a [Export], format: Option<Format>) -> Files<'a> {
        Files { directory: Path::new("an answer"), exports, format }
    }

    #[test]
    fn a_metric_result_is_looked_at_and_goes_on_elsewhere() {
        let told = |exports: &[Export], format| steps(outcome(Some(Grade::Metric), &[]), &files(exports, format));
        assert_eq!(told(&[], None), ["open an answer/report.html"]);
        let table = told(&[], Some(Format::Observations));
        assert_eq!(table.len(), 2);
        assert!(table[1].starts_with("--export colmap, nerfstudio"), "{table:?}");
        assert!(told(&[], Some(Format::ColmapDatabase))[1].starts_with("--export colmap-db "));
        let second = |export| told(&[export], Some(Format::ColmapDatabase))[1].clone();
        assert!(second(Export::ColmapDatabase).contains("mapper --database_path 'an answer/colmap-db'/database.db "));
        assert!(second(Export::Colmap).contains("--input_path 'an answer/colmap' "));
        assert!(second(Export::ColmapText).contains("--input_path 'an answer/colmap-text' "));
        assert!(second(Export::Nerfstudio).ends_with("ns-train nerfacto --data 'an answer/nerfstudio'"));
        assert_eq!(told(&[Export::Bal], Some(Format::Observations)).len(), 1, "nothing is said of its readers");
    }

    #[test]
    fn every_cause_of_a_lower_grade_has_its_remedy() {
        for grade in [Some(Grade::Weak), Some(Grade::ProjectiveOnly), None] {
            let name = grade.map_or("NO_RECONSTRUCTION", Grade::name);
            for (code, remedy) in REMEDIES {
                let warnings = [Warning::new(WarningCode::DuplicateTracks, ""), Warning::new(code, "a detail")];
                let advice = advice(outcome(grade, &warnings)).expect("advice");
                assert_eq!(advice, format!("{name} because of {}: {remedy}", code.name()));
            }
            let unexplained = advice(outcome(grade, &[])).expect("advice");
            assert_eq!(unexplained, format!("{name}: {MORE_VIEWS}"));
        }
        let warnings = [Warning::new(WarningCode::PlanarScene, "")];
        assert_eq!(advice(outcome(Some(Grade::Metric), &warnings)), None);
        let own = Outcome { has_own_focals: true, ..outcome(Some(Grade::Weak), &[]) };
        assert!(advice(own).expect("advice").contains("is the best grade with --focal-per-view"));
    }

    #[test]
    fn a_focal_length_that_the_tracks_contradict_is_checked_first() {
        let of = |code| Warning::new(code, "");
        let warnings = [of(WarningCode::PointsOutsideImage), of(WarningCode::FocalPriorContradicted)];
        for grade in [Some(Grade::Metric), Some(Grade::Weak), Some(Grade::ProjectiveOnly), None] {
            let told = advice(outcome(grade, &warnings)).expect("advice");
            assert!(told.contains(" because of FOCAL_PRIOR_CONTRADICTED: check the focal length"), "{told}");
        }
        let zoomed = [of(WarningCode::ModelMismatch)];
        assert_eq!(advice(outcome(Some(Grade::Metric), &zoomed)), None);
        let weak = advice(outcome(Some(Grade::Weak), &zoomed)).expect("advice");
        assert!(weak.contains("if the camera zoomed"), "{weak}");
    }

    #[test]
    fn views_without_depth_go_nowhere() {
        let turned = Outcome { is_without_depth: true, ..outcome(Some(Grade::Metric), &[]) };
        for exports in [&[][..], &[Export::Colmap], &[Export::Nerfstudio], &[Export::ColmapDatabase]] {
            let told = steps(turned, &files(exports, Some(Format::ColmapDatabase)));
            assert_eq!(told[1..], [NO_DEPTH], "{exports:?}");
        }
    }

    #[test]
    fn two_views_are_too_few() {
        let warnings = [Warning::new(WarningCode::NoConsensus, "2 views given")];
        let two = Outcome { has_too_few_views: true, ..outcome(None, &warnings) };
        assert_eq!(advice(two).as_deref(), Some("NO_RECONSTRUCTION: add views; a reconstruction needs at least 3"));
    }

    #[test]
    fn an_option_that_is_advised_is_one_of_solve_and_of_submit() {
        let texts = REMEDIES.iter().map(|(_, remedy)| *remedy).chain([MORE_VIEWS, "--focal-per-view"]);
        let words = texts.flat_map(|text| text.split(|c: char| !c.is_ascii_alphanumeric() && c != '-'));
        let options: Vec<&str> = words.filter_map(|word| word.strip_prefix("--")).collect();
        assert!(options.len() > 10, "{options:?}");
        let program = crate::cli::command();
        for command in ["solve", "submit"] {
            let command = program.find_subcommand(command).expect("a command");
            for option in &options {
                let has = command.get_arguments().any(|argument| argument.get_long() == Some(option));
                assert!(has, "{} has no --{option}", command.get_name());
            }
        }
    }

    #[test]
    fn every_warning_that_refuses_a_focal_length_is_a_cause() {
        let codes = [
            WarningCode::LittleMotion,
            WarningCode::PureTranslation,
            WarningCode::UnobservableFocal,
            WarningCode::SecondMinimum,
            WarningCode::ModelMismatch,
            WarningCode::FewInliers,
            WarningCode::Cheirality,
            WarningCode::NoConsensus,
        ];
        for code in codes {
            assert!(code.refuses() && REMEDIES.iter().any(|(cause, _)| *cause == code), "{}", code.name());
        }
    }

    #[test]
    fn a_lower_grade_says_what_it_holds_and_at_most_three_things() {
        let turned = [Warning::new(WarningCode::UnobservableFocal, "")];
        let told = steps(outcome(Some(Grade::ProjectiveOnly), &turned), &files(&[], Some(Format::ColmapDatabase)));
        assert_eq!(told.len(), 3);
        assert!(told[0].ends_with("there are no K, R and t") && told[1].contains("right matches"), "{told:?}");
        let table = steps(outcome(Some(Grade::ProjectiveOnly), &turned), &files(&[], Some(Format::Observations)));
        assert_eq!(table.len(), 2, "only a database takes a result that is not metric: {table:?}");
        let exported = [Export::Colmap];
        let weak = steps(outcome(Some(Grade::Weak), &[]), &files(&exported, Some(Format::Observations)));
        assert_eq!(weak.len(), 3, "{weak:?}");
        let nothing = [Warning::new(WarningCode::NoConsensus, "")];
        let told = steps(outcome(None, &nothing), &files(&[], Some(Format::ColmapDatabase)));
        assert!(told.len() == 2 && told[0].ends_with("no cameras and no points"), "{told:?}");
    }
}
