//! What a scene shall be, and which wishes make no scene.

use serde::{Deserialize, Serialize};

use super::lens;
use crate::domain::error::{InvalidInput, Violation, Violations};

named! {
    /// How the camera moves. Distances are in units of the world, points mostly 2 to 8 of them away.
    pub enum PhotographedMotion {
        /// On a circle about an object, looking at it.
        Orbit = "orbit",
        /// On foot about an object, at changing distances and heights, looking roughly at it.
        WalkAround = "walk-around",
        /// From random places, looking at one part of a room; the order of the views means nothing.
        HandHeld = "hand-held",
        /// Forward through a corridor, with swings to either side.
        Corridor = "corridor",
        /// Forward along a street with turns.
        Drive = "drive",
        /// Above ground, on a grid: the first half of the views looks down along one flight direction, the other half
        /// looks obliquely along the other.
        AerialGrid = "aerial-grid",
        /// A turn on the spot whose centre moves by a few hundredths of the scene's distance.
        NearRotation = "near-rotation",
        /// A turn about the camera's centre: constant intrinsics show, depths do not.
        PureRotation = "pure-rotation",
        /// Random places without any turn: critical, no calibration.
        Translation = "translation",
        /// Views of a plane from several sides.
        PlanarScene = "planar-scene",
    }
}

named! {
    /// What the lens does; [`PhotographedOptions`] holds the numbers.
    pub enum LensKind {
        Pinhole = "pinhole",
        /// A little radial distortion of either sign, as of a phone.
        Mild = "mild",
        Barrel = "barrel",
        Pincushion = "pincushion",
        /// A wide barrel that needs a second coefficient.
        ActionCamera = "action-camera",
        /// Equidistant, 150 degrees across the diagonal.
        Fisheye = "fisheye",
        /// A pinhole whose principal point is off the centre, as in a cropped image.
        DisplacedPrincipalPoint = "displaced-principal-point",
        /// A pinhole whose pixels are not square.
        Aspect = "aspect",
    }
}

named! {
    /// How focal lengths differ between views.
    pub enum FocalKind {
        ConstantFocal = "constant-focal",
        /// Steadily from the first view to the last.
        DriftingFocal = "drifting-focal",
        /// The views of two cameras in turns, each a camera group.
        TwoGroups = "two-groups",
    }
}

named! {
    /// Which of the views that a point is in front of observe it.
    pub enum VisibilityKind {
        /// Views in a row.
        Banded = "banded",
        /// Each with the same probability, whatever its place.
        Scattered = "scattered",
    }
}

named! {
    /// What is wrong with the wrong tracks.
    pub enum WrongKind {
        /// Nothing.
        Clean = "clean",
        /// Each observation is that of another wrong track in the same view.
        Permuted = "permuted",
        /// From some view on, the observations slide along the epipolar lines of the track's first view.
        Slid = "slid",
        /// From some view on, the observations drift off in the image at a constant speed.
        DriftingTracks = "drifting-tracks",
        /// The observations stay in one place of the image: a watermark, dirt on the lens.
        Static = "static",
        /// The points are of a second rigid body with a motion of its own.
        SecondBody = "second-body",
        /// In fewer than half of the views, the observation is that of the same point of the neighbouring copy of a
        /// repeated structure.
        Repeated = "repeated",
        /// Copies of few wrong tracks, within .3 px.
        NearDuplicates = "near-duplicates",
        /// One wrong link: the track goes over to another point for good.
        WrongLink = "wrong-link",
    }
}

/// What to generate: every choice, so that a record of them gives the scene again.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PhotographedOptions {
    pub views: usize,
    pub tracks: usize,
    pub motion: PhotographedMotion,
    /// How far the motion turns, in radians: all the way about the object or along the street, and otherwise the
    /// largest turn of a view to either side.
    pub turn_rad: f64,
    /// How far the centre of a camera that turns on the spot moves to either side, as a share of the distance of the
    /// scene; other motions do not look at it.
    pub baseline: f64,
    pub lens: LensKind,
    /// Focal length of the middle view, or of the first camera of two, in pixels along x.
    pub focal_px: f64,
    pub focal: FocalKind,
    /// The last focal length over the first, or that of the second camera over that of the first.
    pub focal_ratio: f64,
    /// Displacement of the principal point from the centre of the image, right and down, as a share of its width.
    pub principal_point: [f64; 2],
    /// Focal length along y over that along x.
    pub aspect: f64,
    /// `k1` and `k2`; a fisheye does not look at them.
    pub radial: [f64; 2],
    /// Standard deviation of the core of the noise in pixels.
    pub noise_px: f64,
    pub visibility: VisibilityKind,
    /// Banded: views of a track, uniform between the two as far as its point is in view.
    pub lifetime: (usize, usize),
    /// Scattered: probability that a view which is before a point observes it.
    pub seen_share: f64,
    pub wrong: WrongKind,
    /// Share of the tracks that are wrong.
    pub wrong_share: f64,
    pub seed: u64,
}

impl PhotographedOptions {
    /// Views and tracks that one scene may have, so that a slip of the finger does not fill the memory.
    pub const MAX_VIEWS: usize = 1_000;
    pub const MAX_TRACKS: usize = 200_000;

    /// The scene in a line: its motion, lens, focal lengths, visibility and what is wrong.
    pub fn name(&self) -> String {
        let Self { motion, lens, focal, visibility, wrong, .. } = self;
        [motion.name(), lens.name(), focal.name(), visibility.name(), wrong.name()].join("/")
    }

    /// Checks every option.
    ///
    /// # Errors
    /// Each violation names its option.
    pub fn validate(&self) -> Result<(), InvalidInput> {
        let mut found = Violations::default();
        let mut within = |name: &str, value: f64, least: f64, most: f64| {
            if !(least..=most).contains(&value) {
                found.push(Violation::of(name, format!("{value} is not in {least}..={most}")));
            }
        };
        within("views", self.views as f64, 2.0, Self::MAX_VIEWS as f64);
        within("tracks", self.tracks as f64, 1.0, Self::MAX_TRACKS as f64);
        within("turn_rad", self.turn_rad, 0.0, std::f64::consts::TAU);
        within("baseline", self.baseline, 0.0, 0.5);
        within("focal_px", self.focal_px, 100.0, 1e5);
        within("focal_ratio", self.focal_ratio, 0.1, 10.0);
        within("aspect", self.aspect, 0.5, 2.0);
        within("noise_px", self.noise_px, 0.0, 100.0);
        within("seen_share", self.seen_share, 0.01, 1.0);
        within("wrong_share", self.wrong_share, 0.0, 1.0);
        self.principal_point.iter().for_each(|&shift| within("principal_point", shift, -0.3, 0.3));
        let (least, most) = self.lifetime;
        if least < 2 || most < least {
            let reason = format!("{least} to {most} is not a range of two views or more");
            found.push(Violation::of("lifetime", reason));
        }
        found.into_result()?;
        if !lens::images_all(self) {
            let reason = format!(
                "k1 {} and k2 {} fold the image at a focal length of {} px",
                self.radial[0], self.radial[1], self.focal_px
            );
            return Err(Violation::of("radial", reason).into());
        }
        Ok(())
    }
}
