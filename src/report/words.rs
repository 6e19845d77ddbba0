//! Codes in plain words.

use crate::domain::{Grade, Solution, Status, WarningCode};

/// What a warning means for whoever uses the result.
pub fn warning(code: WarningCode) -> &'static str {
    match code {
        WarningCode::PlanarOrRotation => {
            "The points lie on one plane, or the camera only turned, or turned and zoomed: such views show little depth."
        }
        WarningCode::LittleMotion => {
            "The views hardly differ: the camera nearly stood still, and nothing tells a turn from a shift."
        }
        WarningCode::PlanarScene => {
            "The points lie on one plane. Views that are tilted against each other tell a focal length all the same."
        }
        WarningCode::PureRotation => {
            "The camera only turned and did not move. Such views show no depth: there are directions but no points."
        }
        WarningCode::PureTranslation => {
            "The camera moved but did not turn. Such views carry no focal length: every value fits them alike."
        }
        WarningCode::UnobservableFocal => {
            "The tracks do not tell the focal length: many values fit them alike, or the best is that of no lens."
        }
        WarningCode::SecondMinimum => "Another calibration explains the tracks about as well as the one shown.",
        WarningCode::ModelMismatch => {
            "The cameras are not what the calibration takes them to be: expect several cameras, a zoom, or a lens that no model here describes."
        }
        WarningCode::FocalPriorContradicted => {
            "A focal length that was given contradicts the tracks, or another one that was given."
        }
        WarningCode::FewInliers => "So few tracks agree that the result can hardly be verified.",
        WarningCode::PrincipalPointUnobservable => {
            "The tracks do not tell where the principal point is; it was taken to be near the image centre."
        }
        WarningCode::Cheirality => "Some points come out behind the cameras that saw them.",
        WarningCode::NoConsensus => "No set of tracks was found that one rigid scene explains.",
        WarningCode::SecondStructure => "Some of the tracks left out agree on a motion of their own.",
        WarningCode::ViewsLeftOut => "Not every view takes part in the result.",
        WarningCode::AssumedImageSize => {
            "No image size was given, so the extent of the points stood in; the principal point may be off."
        }
        WarningCode::PointsOutsideImage => {
            "The points do not lie as pixels of the images do; with a wrong size or origin the calibration is wrong."
        }
        WarningCode::CameraGroupsMerged => "Views of different cameras or sizes were treated as one camera.",
        WarningCode::UnverifiedRanking => {
            "Too few tracks hold together for geometry to verify them; their weights are the trained network's scores."
        }
        WarningCode::StaticTracks => {
            "Tracks that stay where they are in the image are no part of the scene: dirt, a watermark, the carrier of the camera."
        }
        WarningCode::HighNoise => {
            "The tracks fit with much more noise than was assumed: wrong ones may be among them, unless the points were measured that roughly."
        }
        WarningCode::DuplicateTracks => {
            "Some tracks stand in the input several times; they count once, and all have the same answer."
        }
        WarningCode::Unknown => "The server is of a later version and gives a warning that this program does not know.",
    }
}

/// What the outcome means.
pub fn outcome(solution: &Solution) -> &'static str {
    match (solution.status, solution.grade) {
        (Status::NoReconstruction, _) => "No reconstruction stands. The warnings say why.",
        (_, Some(Grade::Metric)) => {
            "The focal length is known to better than 2 %; cameras and points are metric, up to scale."
        }
        (_, Some(Grade::Weak)) => {
            "The focal length is known to 2 to 10 % only; use the metric reconstruction with care."
        }
        (_, Some(Grade::ProjectiveOnly)) => {
            "Which tracks are right is known, and the projective reconstruction stands; the data carry no focal length to rely on, so none is given."
        }
        (_, None) => "Which tracks are right is known; nothing was calibrated.",
    }
}
