//! Enums: the domain's and the wire's have the same variants, but for the wire's `UNSPECIFIED`.

use crate::domain::job::{AttemptEnd, JobState};
use crate::domain::second_structure::SecondStructureKind;
use crate::domain::{
    Backend, Grade, LensProjection, Method, Phase, Proposal, Stage, Status, Task, Violation, WarningCode, WebhookState,
};
use crate::rpc::proto;

/// A domain enum that has a twin on the wire.
pub trait Twin: Sized {
    /// Reads the wire's number; `None` for `UNSPECIFIED`.
    ///
    /// # Errors
    /// A violation of `field` for a number that this version does not know.
    fn from_wire(number: i32, field: &str) -> Result<Option<Self>, Violation>;

    /// Reads the wire's number where `UNSPECIFIED` will not do.
    ///
    /// # Errors
    /// A violation of `field`.
    fn required(number: i32, field: &str) -> Result<Self, Violation> {
        super::required(Self::from_wire(number, field)?, field)
    }

    /// Reads the wire's number where an answer means something without it; `None` for `UNSPECIFIED`, and for a number
    /// that this version does not know.
    fn known(number: i32) -> Option<Self> {
        Self::from_wire(number, "").ok().flatten()
    }

    /// The wire's number.
    fn to_wire(self) -> i32;
}

/// Implements [`Twin`] for pairs of enums with the same variants; one that is missing does not compile. After `;` comes
/// a variant that the wire does not have; it is written as `UNSPECIFIED`.
macro_rules! twins {
    ($($domain:ident = $wire:ident { $($variant:ident),+ $(,)? $(; $unknown:ident)? })+) => {$(
        impl Twin for $domain {
            fn from_wire(number: i32, field: &str) -> Result<Option<Self>, Violation> {
                match proto::$wire::try_from(number) {
                    Ok(proto::$wire::Unspecified) => Ok(None),
                    $(Ok(proto::$wire::$variant) => Ok(Some($domain::$variant)),)+
                    Err(_) => Err(Violation::of(field, format!("{number} is not a known {}", stringify!($wire)))),
                }
            }

            fn to_wire(self) -> i32 {
                match self {
                    $($domain::$variant => proto::$wire::$variant as i32,)+
                    $($domain::$unknown => proto::$wire::Unspecified as i32,)?
                }
            }
        }
    )+};
}

twins! {
    Method = Method { Auto, Paper, Geometry, Psfm, Scpsfm }
    Backend = Backend { Flex, Ndarray }
    Stage = Stage { Prepare, Search, Refine, Calibrate, Extend, Classify }
    Phase = Phase { Relaxation, Rank, Growth }
    Task = Task { Adjust, Cameras, Windows, Classify, Heads }
    Status = ResultStatus { Solved, NoReconstruction }
    Grade = Grade { Metric, Weak, ProjectiveOnly }
    LensProjection = LensProjection { Perspective, Fisheye }
    SecondStructureKind = SecondStructureKind { MovingBody, RepeatedStructure }
    Proposal = Proposal { Network, Irls, Consistency, Rigidity, Uniform, Learned }
    JobState = JobState { Queued, Running, Succeeded, Failed, Cancelled, DeadlineExceeded }
    AttemptEnd = AttemptEnd { Ended, GivenBack, Lost }
    WebhookState = WebhookState { Pending, Delivered, GivenUp }
    WarningCode = WarningCode {
        PlanarOrRotation,
        PlanarScene,
        PureRotation,
        PureTranslation,
        UnobservableFocal,
        SecondMinimum,
        ModelMismatch,
        FocalPriorContradicted,
        FewInliers,
        PrincipalPointUnobservable,
        Cheirality,
        NoConsensus,
        SecondStructure,
        ViewsLeftOut,
        AssumedImageSize,
        PointsOutsideImage,
        CameraGroupsMerged,
        UnverifiedRanking,
        DuplicateTracks,
        StaticTracks,
        LittleMotion,
        HighNoise;
        Unknown
    }
}

/// The wire's number of an optional value; `UNSPECIFIED` for `None`.
pub fn optional_to_wire<T: Twin>(value: Option<T>) -> i32 {
    value.map_or(0, Twin::to_wire)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_round_trip_and_unknown_ones_name_the_field() {
        for method in Method::ALL {
            assert_eq!(Method::from_wire(method.to_wire(), "method"), Ok(Some(method)));
        }
        for state in JobState::ALL {
            assert_eq!(JobState::required(state.to_wire(), "state"), Ok(state));
        }
        assert_eq!(Method::from_wire(0, "method"), Ok(None));
        assert!(JobState::required(0, "state").is_err());
        let violation = Method::from_wire(99, "job.settings.method").expect_err("unknown");
        assert_eq!(violation.to_string(), "job.settings.method: 99 is not a known Method");
    }

    #[test]
    fn names_on_the_wire_are_the_domains_with_the_enums_prefix() {
        for code in [
            WarningCode::LittleMotion,
            WarningCode::PlanarOrRotation,
            WarningCode::PlanarScene,
            WarningCode::PureRotation,
            WarningCode::PureTranslation,
            WarningCode::PrincipalPointUnobservable,
            WarningCode::SecondStructure,
            WarningCode::CameraGroupsMerged,
            WarningCode::UnverifiedRanking,
            WarningCode::DuplicateTracks,
            WarningCode::StaticTracks,
            WarningCode::HighNoise,
        ] {
            let wire = proto::WarningCode::try_from(code.to_wire()).expect("known");
            assert_eq!(wire.as_str_name(), format!("WARNING_CODE_{}", code.name()));
        }
        for state in JobState::ALL {
            let wire = proto::JobState::try_from(state.to_wire()).expect("known");
            assert_eq!(wire.as_str_name(), format!("JOB_STATE_{}", state.name()));
        }
        for state in WebhookState::ALL {
            let wire = proto::WebhookState::try_from(state.to_wire()).expect("known");
            assert_eq!(wire.as_str_name(), format!("WEBHOOK_STATE_{}", state.name()));
        }
    }
}
