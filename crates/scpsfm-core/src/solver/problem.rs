//! An input as every stage sees it: normalised, by view and by track, its views in cameras that have a calibration
//! each.

use std::collections::BTreeSet;

use nalgebra::Vector2;

use super::block::{self, Block};
use super::calibration::{CalibrationOptions, Outcome, Uncalibrated};
use super::consensus::{LEAST_INLIERS, LEAST_VIEWS, NoiseOptions};
use super::error::Error;
use super::known_focal::{KnownFocal, known_focal};
use super::noise_model::{self, NoiseModel};
use super::normalization::normalization;
use super::{near_duplicates, static_tracks};
use crate::domain::{FocalPrior, Input, Method, SolveSettings, StopToken, VERIFIED, View, Warning, WarningCode};
use crate::geometry::bundle::metric::Intrinsics;
use crate::geometry::measurement::Normalization;
use crate::geometry::observation::Observation;
use crate::geometry::statistics::median;
use crate::geometry::{Camera, Point};
use crate::parallel::Threads;

/// Share of its observations that a complete track must retain: of 100 permuted tracks in ten views about one holds
/// three observations of one point by chance, and in fifty views nearly all do.
pub const LEAST_RETAINED_SHARE: f64 = 0.6;

/// What every stage of one solve works on; observations keep the input's sorted order (track, view).
pub struct Problem<'a> {
    pub input: &'a Input,
    pub settings: &'a SolveSettings,
    /// Observations of each track; see [`Input::track_ranges`].
    pub ranges: Vec<usize>,
    pub normalization: Normalization,
    /// Length of a normalised unit in pixels.
    pub scale_px: f64,
    /// The noise that a solve starts from, normalised: that of the settings, or a guess.
    pub initial_noise: f64,
    /// Normalised image points, one an observation.
    pub xy: Vec<Vector2<f64>>,
    /// See [`Observation::weight`]; one an observation.
    pub weights: Vec<f64>,
    /// The lenses that are undone before anything projective is looked for.
    pub undone: Option<Undone>,
    /// Whether each track is static: left aside in a search.
    pub is_static: Vec<bool>,
    /// The track that represents each until all are judged: itself, but for near-duplicates.
    pub representative: Vec<usize>,
    /// Observations of each view.
    pub of_view: Vec<Vec<u32>>,
    /// Camera of each view, each of which gets a calibration: the camera groups, counted from 0 in rising order of the
    /// input's numbers, or one for all where views have focal lengths of their own or the method knows no groups.
    pub camera_of: Vec<usize>,
    pub cameras: usize,
    /// What is known of the focal length of each camera beforehand; nothing where views have their own.
    pub focal_priors: Vec<Option<FocalPrior>>,
    /// Share of its observations in registered views that a right track retains: none where links may be wrong, so that
    /// a track holds several points, [`LEAST_RETAINED_SHARE`] where tracks are complete.
    pub least_share: f64,
    /// Density of a wrong coordinate: one over the width of the points' distribution, normalised units.
    pub outlier_density: f64,
    /// Thresholds of the calibration.
    pub calibration_options: CalibrationOptions,
    /// What is to be said of the input.
    pub warnings: Vec<Warning>,
    pub threads: Threads,
    pub stop: &'a StopToken,
}

/// Lenses that are undone, a hypothesis.
pub struct Undone {
    /// One a camera; a pinhole where none is undone.
    lenses: Vec<Intrinsics>,
    /// Largest radius of the observations of each camera, normalised.
    radii: Vec<f64>,
    /// Where pinholes would have made them.
    observations: Vec<Observation>,
}

impl Undone {
    /// These lenses of cameras undone in place of what is undone already; a lens that does not image all observations
    /// of its camera is not. `None` where nothing is undone.
    pub fn new(
        problem: &Problem,
        already: Option<&Self>,
        changed: impl IntoIterator<Item = (usize, Intrinsics)>,
    ) -> Option<Self> {
        let pinholes = vec![Intrinsics::from_focal(1.0); problem.cameras];
        let before = already.map_or(pinholes, |undone| undone.lenses.clone());
        let mut lenses = before.clone();
        changed.into_iter().for_each(|(camera, lens)| lenses[camera] = lens);
        let camera_of = |k: usize| problem.camera_of[problem.view_of(k)];
        let undistorted = |lenses: &[Intrinsics], k: usize| lenses[camera_of(k)].undistorted(&problem.observation(k));
        for k in 0..problem.xy.len() {
            if undistorted(&lenses, k).is_none() {
                lenses[camera_of(k)] = before[camera_of(k)];
            }
        }
        if !lenses.iter().any(Intrinsics::distorts) {
            return None;
        }
        let observations = (0..problem.xy.len()).map(|k| undistorted(&lenses, k)).collect::<Option<_>>()?;
        let mut radii = vec![0.0f64; problem.cameras];
        for (k, xy) in problem.xy.iter().enumerate() {
            let radius = &mut radii[camera_of(k)];
            *radius = radius.max(xy.norm());
        }
        Some(Self { lenses, radii, observations })
    }

    /// What the undone lens of each camera says of its focal length; `None` of a pinhole, which none is undone of.
    pub fn focal_priors(&self, scale_px: f64, sigma_log: f64) -> Vec<Option<FocalPrior>> {
        let of_lens = |lens: &Intrinsics| FocalPrior { focal_px: lens.focal * scale_px, sigma_log };
        self.lenses.iter().map(|lens| lens.distorts().then(|| of_lens(lens))).collect()
    }

    /// The lens of the images of a camera for which these intrinsics are found once its lens is undone.
    pub fn behind(&self, camera: usize, found: &Intrinsics) -> Intrinsics {
        let lens = &self.lenses[camera];
        if lens.distorts() { found.behind(lens, self.radii[camera]) } else { *found }
    }
}

impl<'a> Problem<'a> {
    pub fn new(input: &'a Input, settings: &'a SolveSettings, threads: Threads, stop: &'a StopToken) -> Self {
        let (normalization, warnings) = normalization(input);
        Self::normalized(input, normalization, warnings, settings, threads, stop)
    }

    /// The problem of some of the observations, normalised as all are.
    pub fn of_some<'b>(&'b self, input: &'b Input, settings: &'b SolveSettings) -> Problem<'b> {
        Problem::normalized(input, self.normalization.clone(), Vec::new(), settings, self.threads, self.stop)
    }

    fn normalized(
        input: &'a Input,
        normalization: Normalization,
        mut warnings: Vec<Warning>,
        settings: &'a SolveSettings,
        threads: Threads,
        stop: &'a StopToken,
    ) -> Self {
        let ranges = input.track_ranges();
        let has_groups = is_searched(settings) && !settings.focal_per_view;
        warnings.extend(merged_cameras(input, has_groups, settings.focal_per_view));
        let mut of_view = vec![Vec::new(); input.view_count()];
        let mut xy = Vec::with_capacity(input.observation_count());
        for k in 0..input.observation_count() {
            let view = input.view_of(k);
            of_view[view].push(k as u32);
            xy.push(normalization.normalize(view, input.point_px(k)));
        }
        let (camera_of, cameras) = match has_groups {
            true => camera_groups(input),
            false => (vec![0; input.view_count()], 1),
        };
        let initial_noise = initial_noise(settings, normalization.scale_px);
        let of_camera = |camera: usize| {
            known_focal(input.views().iter().enumerate().filter(|(view, _)| camera_of[*view] == camera))
        };
        let known: Vec<Option<KnownFocal>> = match settings.focal_per_view {
            true => vec![None; cameras],
            false => (0..cameras).map(of_camera).collect(),
        };
        let calibration_options = CalibrationOptions::DEFAULT;
        let contradicted = calibration_options.grades.prior_contradicted;
        for known in known.iter().flatten() {
            let warning = known.contradiction(contradicted).map(|warning| match has_groups {
                true => warning.of_group(input.views()[known.farthest].camera_group),
                false => warning,
            });
            warnings.extend(warning);
        }
        let representative: Vec<usize> = match is_searched(settings) {
            true => near_duplicates::representatives(&ranges, |k| input.view_of(k), &xy, initial_noise, stop),
            false => (0..input.track_count()).collect(),
        };
        // Many near-duplicates of one track would make the spread of the points that of these.
        let is_distinct = |k: &u32| {
            let track = input.track_of(*k as usize);
            representative[track] == track
        };
        let distinct: Vec<Vec<u32>> =
            of_view.iter().map(|seen| seen.iter().copied().filter(is_distinct).collect()).collect();
        Self {
            focal_priors: known.iter().map(|known| known.as_ref().map(|known| known.prior)).collect(),
            outlier_density: noise_model::outlier_density(&distinct, &xy),
            least_share: if complete_views(input, &ranges).is_some() { LEAST_RETAINED_SHARE } else { 0.0 },
            is_static: match is_searched(settings) {
                true => static_tracks::find(&ranges, &xy),
                false => vec![false; input.track_count()],
            },
            representative,
            initial_noise,
            input,
            settings,
            ranges,
            scale_px: normalization.scale_px,
            normalization,
            xy,
            weights: weights(input),
            undone: None,
            of_view,
            camera_of,
            cameras,
            calibration_options,
            warnings,
            threads,
            stop,
        }
    }

    /// `Err` once the token asks for a stop.
    pub fn stopped(&self) -> Result<(), Error> {
        Error::check(self.stop)
    }

    /// Whether the method searches, and judges every observation by itself; PAPER, SCPSFM and PSFM do not.
    pub fn is_searched(&self) -> bool {
        is_searched(self.settings)
    }

    /// Whether every view has a focal length of its own.
    pub fn has_own_focals(&self) -> bool {
        self.settings.focal_per_view
    }

    /// Camera of each of these views, counted among them, and the cameras that these are.
    pub fn cameras_of(&self, views: &[usize]) -> (Vec<usize>, Vec<usize>) {
        let mut cameras: Vec<usize> = views.iter().map(|&view| self.camera_of[view]).collect();
        cameras.sort_unstable();
        cameras.dedup();
        let place = |view: &usize| cameras.partition_point(|camera| *camera < self.camera_of[*view]);
        (views.iter().map(place).collect(), cameras)
    }

    /// As [`Outcome::doubt_implausible`], where the size of the images is known: where it was assumed, so was the place
    /// of the principal point.
    pub fn doubt_implausible(&self, outcome: &mut Outcome, found: &Intrinsics, camera: usize) {
        let is_assumed = self.warnings.iter().any(|warning| warning.code == WarningCode::AssumedImageSize);
        if !is_assumed {
            outcome.doubt_implausible(found, self.focal_priors[camera], &self.calibration_options, self.scale_px);
        }
    }

    /// What there is to calibrate of some views.
    ///
    /// * `reconstruction`: their cameras and points
    /// * `noise`, `group_of`, `focal_priors`, `heartbeat`: as of [`Uncalibrated`]
    pub fn uncalibrated<'b>(
        &'b self,
        reconstruction: (&'b [Camera], &'b [Point]),
        observations: &'b [Observation],
        noise: f64,
        group_of: &'b [usize],
        focal_priors: &'b [Option<FocalPrior>],
        heartbeat: &'b dyn Fn(),
    ) -> Uncalibrated<'b> {
        let (cameras, points) = reconstruction;
        Uncalibrated {
            cameras,
            points,
            observations,
            noise,
            outlier_density: self.outlier_density,
            group_of,
            focal_priors,
            focal_per_view: self.has_own_focals(),
            scale_px: self.scale_px,
            options: &self.calibration_options,
            stop: self.stop,
            heartbeat,
        }
    }

    /// Squared residual, normalised units, within which an observation agrees with its point at this noise, of whose
    /// tail nothing is known.
    pub fn gate(&self, noise: f64) -> f64 {
        NoiseModel::new(noise, self.outlier_density).gate()
    }

    /// The tracks that are complete over these views.
    pub fn block(&self, views: &[usize]) -> Block {
        block::extract(self.input, &self.ranges, |k| self.pinhole_observation(k).xy, views)
    }

    /// Weights of some tracks as weights of all, 0 elsewhere.
    pub fn scatter(&self, weights: &[f64], tracks: &[usize]) -> Vec<f32> {
        let mut all = vec![0.0; self.tracks()];
        for (&track, &weight) in tracks.iter().zip(weights) {
            all[track] = weight as f32;
        }
        all
    }

    pub fn views(&self) -> usize {
        self.of_view.len()
    }

    pub fn tracks(&self) -> usize {
        self.input.track_count()
    }

    pub fn view_of(&self, k: usize) -> usize {
        self.input.view_of(k)
    }

    pub fn track_of(&self, k: usize) -> usize {
        self.input.track_of(k)
    }

    pub fn observation(&self, k: usize) -> Observation {
        Observation { weight: self.weights[k], ..Observation::new(self.view_of(k), self.track_of(k), self.xy[k]) }
    }

    /// The observation where a pinhole would have made it, if the lens is one that is undone.
    pub fn pinhole_observation(&self, k: usize) -> Observation {
        self.undone.as_ref().map_or_else(|| self.observation(k), |undone| undone.observations[k])
    }

    /// Observations of a track.
    pub fn of_track(&self, track: usize) -> std::ops::Range<usize> {
        self.ranges[track]..self.ranges[track + 1]
    }

    /// The observation of a track in a view, the first of several.
    pub fn seen_in(&self, track: usize, view: usize) -> Option<usize> {
        self.of_track(track).find(|&k| self.view_of(k) == view)
    }

    /// Whether another track represents this one.
    pub fn is_near_duplicate(&self, track: usize) -> bool {
        self.representative[track] != track
    }

    /// Whether a reconstruction of these tracks is one of static tracks: whether most of them are.
    pub fn is_of_static(&self, tracks: &[usize]) -> bool {
        2 * tracks.iter().filter(|&&track| self.is_static[track]).count() > tracks.len()
    }

    /// Whether a track may support cameras until all are judged: not where another represents it, nor where it is static,
    /// unless the reconstruction is one of static tracks.
    pub fn supports_growth(&self, track: usize, of_static: bool) -> bool {
        !self.is_near_duplicate(track) && (of_static || !self.is_static[track])
    }

    /// How many of the tracks that may support cameras these views see so often that they may be verified.
    pub fn verifiable(&self, of_static: bool, is_registered: impl Fn(usize) -> bool) -> usize {
        let seen = |track: usize| self.of_track(track).filter(|&k| is_registered(self.view_of(k))).count();
        (0..self.tracks()).filter(|&track| self.supports_growth(track, of_static) && seen(track) >= VERIFIED).count()
    }

    /// The views in which anything is observed, increasing.
    pub fn observed_views(&self) -> Vec<usize> {
        (0..self.views()).filter(|&view| !self.of_view[view].is_empty()).collect()
    }
}

fn initial_noise(settings: &SolveSettings, scale_px: f64) -> f64 {
    let noise = settings.noise_px.map_or(NoiseOptions::DEFAULT.initial, |noise_px| noise_px / scale_px);
    NoiseOptions::DEFAULT.clamp(noise)
}

fn is_searched(settings: &SolveSettings) -> bool {
    matches!(settings.method, Method::Auto | Method::Geometry)
}

/// Says so where views of several cameras or sizes are given one focal length.
///
/// * `has_groups`: each group has a calibration of its own, so that sizes alone matter, within a group
/// * `has_own_focals`: each view has a focal length of its own, so that nothing is merged
fn merged_cameras(input: &Input, has_groups: bool, has_own_focals: bool) -> Option<Warning> {
    if has_own_focals {
        return None;
    }
    let (group_of, groups) = camera_groups(input);
    let size = |view: &View| view.size.map(|size| (size.width_px, size.height_px));
    let kinds: BTreeSet<_> =
        input.views().iter().zip(&group_of).map(|(view, group)| (has_groups.then_some(*group), size(view))).collect();
    let distinct = if has_groups { groups } else { 1 };
    if kinds.len() <= distinct && (has_groups || groups == 1) {
        return None;
    }
    let detail = if has_groups {
        "views of one camera group have several image sizes; they were solved with one focal length in pixels"
            .to_owned()
    } else {
        format!(
            "{groups} camera groups and {} image sizes were solved as one camera with one focal length",
            kinds.len()
        )
    };
    Some(Warning::new(WarningCode::CameraGroupsMerged, detail))
}

/// Camera group of each view, counted from 0 in rising order of the input's numbers, and how many there are.
pub fn camera_groups(input: &Input) -> (Vec<usize>, usize) {
    let numbers: BTreeSet<u32> = input.views().iter().map(|view| view.camera_group).collect();
    let numbers: Vec<u32> = numbers.into_iter().collect();
    let of = |view: &View| numbers.partition_point(|number| *number < view.camera_group);
    (input.views().iter().map(of).collect(), numbers.len())
}

/// Weight of each observation: the squared ratio of the median standard deviation of all to its own; 1 where none are
/// given.
fn weights(input: &Input) -> Vec<f64> {
    let count = input.observation_count();
    let mut sigmas: Vec<f64> = (0..count).filter_map(|k| input.sigma_px(k)).collect();
    let typical = median(&mut sigmas);
    (0..count).map(|k| input.sigma_px(k).map_or(1.0, |sigma| (typical / sigma).powi(2))).collect()
}

/// The views in which anything is observed, if at least half of the tracks that are observed at all, and enough of
/// them, are seen in all of these. Padding, views and tracks without observations, changes nothing.
pub fn complete_views(input: &Input, ranges: &[usize]) -> Option<Vec<usize>> {
    let views = observed_views(input);
    let observed = ranges.windows(2).filter(|range| range[1] > range[0]).count();
    let complete = ranges.windows(2).filter(|range| range[1] - range[0] == views.len()).count();
    (views.len() >= LEAST_VIEWS && complete >= LEAST_INLIERS && 2 * complete >= observed).then_some(views)
}

/// The views in which anything is observed, increasing.
pub fn observed_views(input: &Input) -> Vec<usize> {
    let mut seen = vec![false; input.view_count()];
    (0..input.observation_count()).for_each(|k| seen[input.view_of(k)] = true);
    (0..seen.len()).filter(|&view| seen[view]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{Limits, RawInput};

    /// Tracks all over the images, and as many again within a pixel of the first.
    #[test]
    fn near_duplicates_do_not_make_the_points_look_close_together() {
        let density = |duplicates: usize| {
            let mut raw =
                RawInput { views: vec![View::default(); 4], track_count: 60 + duplicates, ..Default::default() };
            for track in 0..60 + duplicates {
                let of = if track < 60 { track } else { 0 };
                for view in 0..4 {
                    raw.view.push(view as u32);
                    raw.track.push(track as u32);
                    raw.x.push((of * 617 % 1000 + 7 * view) as f64 + track as f64 / 120.0);
                    raw.y.push((of * 391 % 1000 + 5 * view) as f64);
                }
            }
            let input = Input::new(raw, &Limits::default(), "test").expect("valid");
            Problem::new(&input, &SolveSettings::default(), Threads::ONE, &StopToken::default()).outlier_density
        };
        let (alone, among) = (density(0), density(60));
        assert!((among / alone - 1.0).abs() < 0.05, "{among} for {alone}");
    }
}
