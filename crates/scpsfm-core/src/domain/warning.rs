//! What a caller must know about a result.

use serde::{Deserialize, Serialize};

/// What a caller must know about a result, by a code that programs can match.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "SCREAMING_SNAKE_CASE")]
pub enum WarningCode {
    /// Homographies explain the views, and the data do not tell a planar scene from a camera that only turned.
    PlanarOrRotation,
    /// The views hardly differ but for noise: a turn explains them as well as a shift.
    LittleMotion,
    /// The points of the consensus lie on a plane.
    PlanarScene,
    /// The camera turned about its centre without moving: in a metric result tracks have no points.
    PureRotation,
    /// The camera moved without turning: every focal length fits. Forward motion is a case of it.
    PureTranslation,
    /// The motion leaves the focal length (nearly) free, or the one that fits best is that of no lens; the detail says
    /// which.
    UnobservableFocal,
    /// Another calibration explains the data about as well.
    SecondMinimum,
    /// The metric model fits notably worse than the projective one: distortion, a zoom, a wrong principal point.
    ModelMismatch,
    /// Focal lengths known beforehand contradict the tracks or each other.
    FocalPriorContradicted,
    /// Too few inlier tracks to verify or to calibrate.
    FewInliers,
    /// The data do not determine the principal point; it was taken to be near the image centre.
    PrincipalPointUnobservable,
    /// Points lie behind cameras.
    Cheirality,
    /// No consensus was found.
    NoConsensus,
    /// Tracks outside the consensus agree on another rigid structure: a second motion.
    SecondStructure,
    /// Views were left out; the detail lists them.
    ViewsLeftOut,
    /// No image size was given; the extent of the points stood in.
    AssumedImageSize,
    /// The points do not lie as pixels of images of the given size do: see [`super::image_fit`].
    PointsOutsideImage,
    /// Views of several camera groups or sizes were treated as one camera.
    CameraGroupsMerged,
    /// Nothing was verified; the weights are the trained network's scores of the tracks, by SCPSFM the paper's
    /// network's.
    UnverifiedRanking,
    /// Tracks have the very same observations as others; they were solved as one.
    DuplicateTracks,
    /// Tracks stay where they are in the image while others move, and no scene holds them.
    StaticTracks,
    /// The inliers fit at a noise far above the one that was assumed: wrong observations may be among them.
    HighNoise,
    /// A code that this version does not know: a server of a later one gave it. The detail says what it is.
    #[serde(other)]
    Unknown,
}

impl WarningCode {
    /// Whether it can be why there is no focal length; the others tell of what was assumed or left out.
    pub fn refuses(self) -> bool {
        match self {
            WarningCode::LittleMotion
            | WarningCode::PureTranslation
            | WarningCode::UnobservableFocal
            | WarningCode::SecondMinimum
            | WarningCode::ModelMismatch
            | WarningCode::FocalPriorContradicted
            | WarningCode::FewInliers
            | WarningCode::Cheirality
            | WarningCode::NoConsensus => true,
            WarningCode::PlanarOrRotation
            | WarningCode::PlanarScene
            | WarningCode::PureRotation
            | WarningCode::PrincipalPointUnobservable
            | WarningCode::SecondStructure
            | WarningCode::ViewsLeftOut
            | WarningCode::AssumedImageSize
            | WarningCode::PointsOutsideImage
            | WarningCode::CameraGroupsMerged
            | WarningCode::UnverifiedRanking
            | WarningCode::DuplicateTracks
            | WarningCode::StaticTracks
            | WarningCode::HighNoise
            | WarningCode::Unknown => false,
        }
    }

    /// Whether the tracks contradict the calibration, or what is known of it.
    pub fn is_misfit(self) -> bool {
        matches!(self, WarningCode::ModelMismatch | WarningCode::FocalPriorContradicted)
    }

    /// The code as it stands in files.
    pub fn name(self) -> &'static str {
        match self {
            WarningCode::PlanarOrRotation => "PLANAR_OR_ROTATION",
            WarningCode::LittleMotion => "LITTLE_MOTION",
            WarningCode::PlanarScene => "PLANAR_SCENE",
            WarningCode::PureRotation => "PURE_ROTATION",
            WarningCode::PureTranslation => "PURE_TRANSLATION",
            WarningCode::UnobservableFocal => "UNOBSERVABLE_FOCAL",
            WarningCode::PrincipalPointUnobservable => "PRINCIPAL_POINT_UNOBSERVABLE",
            WarningCode::SecondStructure => "SECOND_STRUCTURE",
            WarningCode::SecondMinimum => "SECOND_MINIMUM",
            WarningCode::ModelMismatch => "MODEL_MISMATCH",
            WarningCode::FocalPriorContradicted => "FOCAL_PRIOR_CONTRADICTED",
            WarningCode::FewInliers => "FEW_INLIERS",
            WarningCode::Cheirality => "CHEIRALITY",
            WarningCode::NoConsensus => "NO_CONSENSUS",
            WarningCode::ViewsLeftOut => "VIEWS_LEFT_OUT",
            WarningCode::AssumedImageSize => "ASSUMED_IMAGE_SIZE",
            WarningCode::PointsOutsideImage => "POINTS_OUTSIDE_IMAGE",
            WarningCode::CameraGroupsMerged => "CAMERA_GROUPS_MERGED",
            WarningCode::UnverifiedRanking => "UNVERIFIED_RANKING",
            WarningCode::DuplicateTracks => "DUPLICATE_TRACKS",
            WarningCode::StaticTracks => "STATIC_TRACKS",
            WarningCode::HighNoise => "HIGH_NOISE",
            WarningCode::Unknown => "UNKNOWN",
        }
    }
}

/// A warning in words.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Warning {
    pub code: WarningCode,
    pub detail: String,
    /// The camera group that it is of, by the input's number; `None`: the result as a whole.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub camera_group: Option<u32>,
}

impl Warning {
    pub fn new(code: WarningCode, detail: impl Into<String>) -> Self {
        Self { code, detail: detail.into(), camera_group: None }
    }

    /// The same of one camera group.
    pub fn of_group(self, camera_group: u32) -> Self {
        Self { camera_group: Some(camera_group), ..self }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_is_that_of_the_files() {
        let code = WarningCode::CameraGroupsMerged;
        assert_eq!(serde_json::to_value(code).expect("serialisable"), code.name());
    }

    #[test]
    fn a_later_versions_code_is_read_as_unknown() {
        let read = |name: &str| serde_json::from_value::<WarningCode>(name.into()).expect("any name");
        assert_eq!(read("OF_A_LATER_VERSION"), WarningCode::Unknown);
        assert_eq!(read(WarningCode::Unknown.name()), WarningCode::Unknown);
        assert_eq!(read("STATIC_TRACKS"), WarningCode::StaticTracks);
    }
}
