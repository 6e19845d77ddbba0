//! What a scene shall be, and which wishes make no scene.

use serde::{Deserialize, Serialize};

use super::FOCAL_RANGE_PX;
use super::contamination::OutlierKind;
use super::motion::Motion;
use super::noise::NoiseKind;
use super::shape::Shape;
use crate::domain::error::{InvalidInput, Violation, Violations};

options! {
    /// What to generate. The defaults are the paper's scenes (its section 5.1); a field that a file lacks has its own.
    #[derive(Serialize, Deserialize)]
    #[serde(default)]
    pub struct SceneOptions {
        views: usize = 10,
        tracks: usize = 200,
        /// Standard deviation of the noise as a share of the image width (of the depth, for depths).
        noise: f64 = 0.003,
        /// How the noise is distributed.
        noise_kind: NoiseKind = NoiseKind::Gaussian,
        /// Share of the tracks that are outliers, those of the second body among them.
        outliers: f64 = 0.9,
        /// What the wrong observations of outliers are.
        outlier_kind: OutlierKind = OutlierKind::Permuted,
        /// In how many views an outlier track is wrong, random ones for each track; 0: in all that the kind can spoil
        /// (half for [`OutlierKind::Repeated`]).
        wrong_views: usize = 0,
        /// How many views observe a track, those whose cameras are nearest to that of a random view; 0: all. An outlier
        /// that is wrong in a number of views may be so where it is not observed.
        seen_views: usize = 0,
        /// How many observations of every right track are replaced by uniform points in the image, in random views for
        /// each track, whose depth is that of a random track. The tracks stay right.
        wrong_observations: usize = 0,
        /// How many observations of every track are left out, random ones for each track, whether right or wrong.
        deleted_observations: usize = 0,
        /// Share of all tracks that belong to a second rigid body, which in every view has a small random motion of its
        /// own (up to 0.2 rad about each axis and 0.3 along it). They count among the outliers; the outliers that are
        /// left are of the kind above.
        second_motion: f64 = 0.0,
        /// How the points lie.
        shape: Shape = Shape::Box,
        /// How the cameras move.
        motion: Motion = Motion::General,
        /// Largest rotation about each axis that the motion turns about, in radians.
        max_rotation_rad: f64 = 0.4,
        /// Largest roll: each camera is turned about its optical axis as well, uniform in `+-max_roll_rad`, whatever
        /// the motion.
        max_roll_rad: f64 = 0.0,
        /// Range of the focal length in pixels; equal ends fix it.
        focal_range_px: (f64, f64) = FOCAL_RANGE_PX,
        /// Whether every view has a camera of its own, and is a camera group: a focal length in that range, a principal
        /// point up to .02 of the width off the common one along each axis, and a distortion within 5 % of the common
        /// one; a zoom does not matter then.
        own_cameras: bool = false,
        /// Displacement of the principal point from the image's centre, right and down, as a share of the image width.
        principal_point: [f64; 2] = [0.0, 0.0],
        /// Radial distortion, `x_d = x_n (1 + k1 r^2)` with `x_n` and its length `r` in normalised camera coordinates
        /// (focal lengths from the principal point); negative: a barrel. Cameras for which the image of the scene would
        /// fold are drawn again.
        radial_k1: f64 = 0.0,
        /// The focal length of each view is uniform in `f (1 +- zoom)`; 0: one focal length for all.
        zoom: f64 = 0.0,
        /// Whether projective depths are part of the input.
        with_depths: bool = false,
        seed: u64 = 0,
    }
}

impl SceneOptions {
    /// Four views of four cameras under strong lenses, as a real set has them: focal lengths of 390 to 422 px in images
    /// of a width of 640 px, k1 of about -.28, 450 tracks.
    pub fn four_cameras() -> Self {
        Self {
            views: 4,
            tracks: 450,
            noise: 0.0005,
            outliers: 0.3,
            own_cameras: true,
            focal_range_px: (609.0, 659.0),
            radial_k1: -0.28,
            ..Self::default()
        }
    }
}

impl Default for SceneOptions {
    /// The paper's centre of all sweeps, without depths.
    fn default() -> Self {
        Self::DEFAULT
    }
}

impl SceneOptions {
    /// Views and tracks that one scene may have, so that a slip of the finger does not fill the memory.
    pub const MAX_VIEWS: usize = 1_000;
    pub const MAX_TRACKS: usize = 100_000;
    /// Right observations that every right track keeps: three make a point that can be verified.
    pub const MIN_RIGHT_OBSERVATIONS: usize = 3;
    /// Farther from the centre the principal point would be outside the image.
    pub const MAX_DISPLACEMENT: f64 = 0.5;
    /// Stronger distortion is a fisheye's, which another model describes.
    pub const MAX_RADIAL_K1: f64 = 0.5;
    /// The longest focal length is then 19 times the shortest, as far as zooms go.
    pub const MAX_ZOOM: f64 = 0.9;

    /// Checks every option.
    ///
    /// # Errors
    /// Each violation names its option.
    pub fn validate(&self) -> Result<(), InvalidInput> {
        let mut found = Violations::default();
        if !(2..=Self::MAX_VIEWS).contains(&self.views) {
            found.push(Violation::of("views", format!("{} is not in 2..={}", self.views, Self::MAX_VIEWS)));
        }
        if !(1..=Self::MAX_TRACKS).contains(&self.tracks) {
            found.push(Violation::of("tracks", format!("{} is not in 1..={}", self.tracks, Self::MAX_TRACKS)));
        }
        if !(0.0..=1.0).contains(&self.noise) {
            found.push(Violation::of("noise", format!("{} is not a share in 0..=1 of the width", self.noise)));
        }
        self.check_outliers(&mut found);
        self.check_rotation(&mut found);
        self.check_camera(&mut found);
        found.into_result()
    }

    fn check_outliers(&self, found: &mut Violations) {
        if !(0.0..=1.0).contains(&self.outliers) {
            found.push(Violation::of("outliers", format!("{} is not a share in 0..=1", self.outliers)));
        } else if !(0.0..=self.outliers).contains(&self.second_motion) {
            let reason = format!("{} is not in 0..={}, the share of the outliers", self.second_motion, self.outliers);
            found.push(Violation::of("second_motion", reason));
        }
        let (kind, most) = (self.outlier_kind.name(), self.outlier_kind.most_wrong_views(self.views));
        if self.wrong_views > most {
            let reason = format!("{} is above {most}, the most that {kind} outliers can have", self.wrong_views);
            found.push(Violation::of("wrong_views", reason));
        }
        if self.wrong_views > 0 && self.outlier_kind == OutlierKind::Permuted && self.tracks == 1 {
            found.push(Violation::of("wrong_views", "1 track has no other to exchange points with, give 2 tracks"));
        }
        if self.seen_views == 1 || self.seen_views > self.views {
            found.push(Violation::of("seen_views", format!("{} is not 0 or in 2..={}", self.seen_views, self.views)));
        }
        // Those that are deleted may all be right ones.
        let seen = if self.seen_views == 0 { self.views } else { self.seen_views };
        let counts =
            [("wrong_observations", self.wrong_observations), ("deleted_observations", self.deleted_observations)];
        let mut left = seen.saturating_sub(Self::MIN_RIGHT_OBSERVATIONS);
        for (name, count) in counts {
            if count > left {
                let reason = format!(
                    "{count} is above {left}: of {} observations a track, {} shall be right and kept",
                    seen,
                    Self::MIN_RIGHT_OBSERVATIONS
                );
                found.push(Violation::of(name, reason));
            }
            left = left.saturating_sub(count);
        }
        if self.outlier_kind == OutlierKind::Slid {
            if self.views == 2 {
                found.push(Violation::of(
                    "outlier_kind",
                    "a slid track agrees with any two views, give 3 views or more",
                ));
            }
            if self.motion == Motion::PureRotation {
                let reason = format!("nothing slides where cameras do not move, as in {}", self.motion.name());
                found.push(Violation::of("outlier_kind", reason));
            }
        }
    }

    fn check_rotation(&self, found: &mut Violations) {
        if !(0.0..=std::f64::consts::PI).contains(&self.max_rotation_rad) {
            found.push(Violation::of("rotation", format!("{} is not in 0..=pi", self.max_rotation_rad)));
        }
        if !(0.0..=std::f64::consts::PI).contains(&self.max_roll_rad) {
            found.push(Violation::of("roll", format!("{} is not in 0..=pi", self.max_roll_rad)));
        }
        if self.motion.needs_rotation() && self.max_rotation_rad == 0.0 {
            let motion = self.motion.name();
            found.push(Violation::of("rotation", format!("0 leaves nothing of the motion {motion}, give more than 0")));
        }
    }

    fn check_camera(&self, found: &mut Violations) {
        check_focal_range(self.focal_range_px, found);
        for (axis, displacement) in self.principal_point.into_iter().enumerate() {
            let most = Self::MAX_DISPLACEMENT;
            if !(-most..=most).contains(&displacement) {
                let reason = format!("{displacement} is not a share in -{most}..={most} of the width");
                found.push(Violation::at("principal_point", axis, reason));
            }
        }
        let most = Self::MAX_RADIAL_K1;
        if !(-most..=most).contains(&self.radial_k1) {
            found.push(Violation::of("radial_k1", format!("{} is not in -{most}..={most}", self.radial_k1)));
        }
        if !(0.0..=Self::MAX_ZOOM).contains(&self.zoom) {
            found.push(Violation::of("zoom", format!("{} is not a share in 0..={}", self.zoom, Self::MAX_ZOOM)));
        }
    }
}

/// Focal lengths that lenses have before images 1,000 px wide: a tenth of the width and less is no perspective lens, a
/// hundred widths a telescope.
const FOCAL_LIMITS_PX: (f64, f64) = (100.0, 100_000.0);

/// Refuses what is no range of focal lengths.
pub(in crate::synthetic) fn check_focal_range((least, most): (f64, f64), found: &mut Violations) {
    let (shortest, longest) = FOCAL_LIMITS_PX;
    if !(least >= shortest && least <= most && most <= longest) {
        found.push(match least == most {
            true => Violation::of("focal_px", format!("{least:?} px is not within {shortest}..={longest} px")),
            false => Violation::of(
                "focal_range_px",
                format!("{least:?} to {most:?} px is not a range within {shortest}..={longest} px"),
            ),
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_option_out_of_range_is_named() {
        let default = SceneOptions::default;
        let cases = [
            ("views", SceneOptions { views: 1, ..default() }),
            ("tracks", SceneOptions { tracks: 0, ..default() }),
            ("noise", SceneOptions { noise: f64::NAN, ..default() }),
            ("outliers", SceneOptions { outliers: 1.1, ..default() }),
            ("second_motion", SceneOptions { second_motion: 0.31, outliers: 0.3, ..default() }),
            ("second_motion", SceneOptions { second_motion: -0.1, ..default() }),
            ("second_motion", SceneOptions { second_motion: f64::NAN, ..default() }),
            ("wrong_views", SceneOptions { wrong_views: 11, ..default() }),
            ("wrong_views", SceneOptions { wrong_views: 10, outlier_kind: OutlierKind::Slid, ..default() }),
            ("wrong_views", SceneOptions { wrong_views: 1, tracks: 1, ..default() }),
            ("seen_views", SceneOptions { seen_views: 11, ..default() }),
            ("seen_views", SceneOptions { seen_views: 1, ..default() }),
            ("wrong_observations", SceneOptions { seen_views: 5, wrong_observations: 3, ..default() }),
            ("wrong_observations", SceneOptions { wrong_observations: 8, ..default() }),
            ("wrong_observations", SceneOptions { views: 2, wrong_observations: 1, ..default() }),
            ("deleted_observations", SceneOptions { deleted_observations: 8, ..default() }),
            ("deleted_observations", SceneOptions { wrong_observations: 3, deleted_observations: 5, ..default() }),
            ("outlier_kind", SceneOptions { views: 2, outlier_kind: OutlierKind::Slid, ..default() }),
            (
                "outlier_kind",
                SceneOptions { motion: Motion::PureRotation, outlier_kind: OutlierKind::Slid, ..default() },
            ),
            ("rotation", SceneOptions { max_rotation_rad: 4.0, ..default() }),
            ("rotation", SceneOptions { max_rotation_rad: 0.0, motion: Motion::Orbit, ..default() }),
            ("rotation", SceneOptions { max_rotation_rad: 0.0, motion: Motion::PureRotation, ..default() }),
            ("roll", SceneOptions { max_roll_rad: -0.1, ..default() }),
            ("roll", SceneOptions { max_roll_rad: 3.2, ..default() }),
            ("principal_point", SceneOptions { principal_point: [0.0, 0.6], ..default() }),
            ("radial_k1", SceneOptions { radial_k1: f64::INFINITY, ..default() }),
            ("zoom", SceneOptions { zoom: 1.0, ..default() }),
            ("focal_range_px", SceneOptions { focal_range_px: (500.0, 400.0), ..default() }),
            ("focal_px", SceneOptions { focal_range_px: (0.0, 0.0), ..default() }),
            ("focal_px", SceneOptions { focal_range_px: (1e308, 1e308), ..default() }),
            ("focal_range_px", SceneOptions { focal_range_px: (f64::NAN, 900.0), ..default() }),
        ];
        for (name, options) in cases {
            let error = options.validate().expect_err(name);
            assert_eq!(error.violations().len(), 1, "{error}");
            assert_eq!(error.violations()[0].field, name, "{error}");
        }
        assert_eq!(default().validate(), Ok(()));
    }

    #[test]
    fn options_of_an_older_file_read_as_the_scene_they_made() {
        let older = r#"{"views": 4, "tracks": 30, "noise": 0.01, "outliers": 0.5, "max_rotation_rad": 0.2,
            "with_depths": true, "seed": 9}"#;
        let read: SceneOptions = serde_json::from_str(older).expect("JSON");
        let expected = SceneOptions {
            views: 4,
            tracks: 30,
            noise: 0.01,
            outliers: 0.5,
            max_rotation_rad: 0.2,
            with_depths: true,
            seed: 9,
            ..SceneOptions::default()
        };
        assert_eq!(read, expected);
    }
}
