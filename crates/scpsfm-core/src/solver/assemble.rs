//! From what the stages found to the solution that callers read. Here it is decided which of two structures is the
//! result.

use nalgebra::{Matrix3, Matrix4};

use super::attempt::Attempt;
use super::baselines::Decided;
use super::calibration::Outcome;
use super::classification::{Judged, TrackPoint};
use super::consensus::{LEAST_INLIERS, LEAST_SUPPORT, LEAST_VIEWS};
use super::error::Error;
use super::noise_model;
use super::portfolio::Found;
use super::problem::{Problem, camera_groups};
use super::reconstruction::{Reconstruction, own_verdicts};
use super::recorder::Recorder;
use super::second_structures::{self, Structure};
use super::sequence::Ended;
use super::static_tracks;
use super::view_selection::LEAST_SHARED_BY_PAIR;
use crate::domain::result::{ObservationResults, Sigmas, TrackResults, TrackSplit, TwoViewTrack, ViewResult};
use crate::domain::second_structure::SecondStructure;
use crate::domain::words::counted;
use crate::domain::{Calibration, Grade, Solution, Stage, Status, Warning, WarningCode};
use crate::geometry::bundle::metric::{Intrinsics, Parameter, Pose};
use crate::geometry::daq::oriented;
use crate::geometry::observation::Observation;
use crate::geometry::statistics::root_mean_square;
use crate::geometry::{Camera, Point};

/// Observations that determine a point.
const LEAST_OBSERVATIONS: usize = 2;

/// The solution that the best of what was found gives; without any, the reason.
pub fn solution(ended: Ended, problem: &Problem, mut recorder: Recorder) -> Result<Solution, Error> {
    let mut warnings = problem.warnings.clone();
    let mut first = match Assembled::of(ended, problem, &mut recorder) {
        Ok(first) => first,
        Err(seed) => {
            warnings.push(why_unsolved(problem, seed.as_deref()));
            return Ok(unsolved(problem, seed.as_deref(), warnings, recorder));
        }
    };
    let mut structures = Vec::new();
    if problem.is_searched() {
        structures = first.second_structures(problem, &vec![false; problem.tracks()])?;
        if let Some(rival) = first.rival(problem, &structures, &mut recorder)? {
            let before = std::mem::replace(&mut first, rival).judged.tracks.inlier;
            structures = first.second_structures(problem, &before)?;
            structures.push(Structure::of_tracks(problem, &first.reconstruction.geometry, before)?);
        }
    }
    let Assembled { reconstruction, seed, judged, .. } = first;
    reconstruction.solution(problem, &seed, judged, structures, warnings, recorder)
}

/// A reconstruction and what it says of every track and observation.
struct Assembled {
    reconstruction: Reconstruction,
    seed: Attempt,
    judged: Judged,
    evidence: f64,
}

impl Assembled {
    /// Assembles what was found, and judges every track by it where that was not done already. Where nothing stands:
    /// what came nearest to it.
    fn of(ended: Ended, problem: &Problem, recorder: &mut Recorder) -> Result<Self, Option<Box<Attempt>>> {
        let evidence = ended.evidence(problem);
        let (reconstruction, seed) = match ended {
            Ended::Extended(extended) => (Some(extended.reconstruction(problem)), Some(Box::new(extended.seed))),
            Ended::Block(Some(attempt)) => (Reconstruction::of_attempt(problem, &attempt), Some(attempt)),
            Ended::Block(None) => (None, None),
        };
        let (mut reconstruction, mut seed) = match (reconstruction, seed) {
            (Some(reconstruction), Some(seed)) => (reconstruction, seed),
            (_, seed) => return Err(seed),
        };
        recorder.enter(Stage::Classify);
        let mut judged = seed.judged.take().unwrap_or_else(|| reconstruction.judged(problem, &seed, recorder));
        if reconstruction.is_metric() && seed.judges_observations() && seed.decided.is_none() {
            let contradicted = judged.contradicted_views(problem);
            if !contradicted.is_empty() {
                reconstruction.leave_out(contradicted);
                judged = reconstruction.judged(problem, &seed, recorder);
            }
        }
        Ok(Self { reconstruction, seed: *seed, judged, evidence })
    }

    /// As [`second_structures::find`].
    fn second_structures(&self, problem: &Problem, known: &[bool]) -> Result<Vec<Structure>, Error> {
        let Self { reconstruction, judged, evidence, .. } = self;
        second_structures::find(problem, &reconstruction.geometry, judged, *evidence, known)
    }

    /// What is the result in its place, where one of its second structures is the scene.
    fn rival(
        &self,
        problem: &Problem,
        structures: &[Structure],
        recorder: &mut Recorder,
    ) -> Result<Option<Self>, Error> {
        let Self { reconstruction, judged, .. } = self;
        let rival = second_structures::rival(problem, &reconstruction.geometry, judged, structures)?;
        let rival = rival.and_then(|ended| Self::of(ended, problem, recorder).ok());
        Ok(rival.filter(|rival| rival.replaces(self, problem)))
    }

    /// Whether it is the result in place of another: where it is verified, has more tracks in most of its views or the
    /// other is of static ones, and is graded no worse. A calibration is of the camera, whatever moved before it.
    fn replaces(&self, other: &Self, problem: &Problem) -> bool {
        let [own, others] =
            [self, other].map(|one| second_structures::distinct_count(problem, &one.judged.tracks.inlier));
        let [geometry, of_other] = [self, other].map(|one| &one.reconstruction.geometry);
        let views = second_structures::views_of_largest(geometry);
        let has_more = own > others && second_structures::are_most(views, of_other);
        own >= LEAST_INLIERS
            && (has_more || of_other.of_static)
            && !geometry.of_static
            && self.reconstruction.grade.is_no_worse_than(other.reconstruction.grade)
    }
}

impl Reconstruction {
    fn is_metric(&self) -> bool {
        self.grade != Grade::ProjectiveOnly
    }

    /// Writes down what it and the judged tracks say.
    ///
    /// * `structures`: other rigid motions
    ///
    /// With grade PROJECTIVE_ONLY nothing metric is in it, the focal length included: a number that must not be used
    /// is not given; points are then in the frame of the projective cameras.
    fn solution(
        self,
        problem: &Problem,
        seed: &Attempt,
        mut judged: Judged,
        structures: Vec<Structure>,
        mut warnings: Vec<Warning>,
        mut recorder: Recorder,
    ) -> Result<Solution, Error> {
        warnings.extend(self.warnings.iter().cloned());
        let inliers = judged.tracks.inlier.iter().filter(|&&inlier| inlier).count();
        let least = seed.least_inliers();
        if inliers < least {
            let detail = format!("{inliers} tracks hold under the final geometry; {least} can be verified");
            warnings.push(Warning::new(WarningCode::FewInliers, detail));
            recorder.found(0, None);
            return Ok(nothing(problem, Some(seed), warnings, recorder));
        }
        let structures = second_structures::verified(problem, structures, &judged.tracks.inlier);
        judged.tracks.second_structure = second_structures::numbers(&structures);
        let second_structures: Vec<SecondStructure> = (1..)
            .zip(&structures)
            .map(|(number, structure)| second_structures::describe(problem, &self, structure, number))
            .collect::<Result<_, _>>()?;
        warnings.extend(second_structures::warning(&second_structures, &judged.tracks.second_structure, inliers));
        warnings.extend(static_tracks::warning(&problem.is_static, &judged.tracks.inlier));
        warnings.extend(noise_model::warning(self.geometry.noise, problem.initial_noise, problem.scale_px));
        let frames = self.frames(problem);
        let backs: Vec<Option<Matrix4<f64>>> =
            frames.iter().map(|frame| frame.filter(|_| !self.is_metric())?.try_inverse()).collect();
        let place = |point: &Point, track: usize, retained: &[Observation]| {
            let back = backs[self.geometry.component_of_track[track] as usize];
            dehomogenise(&back.map_or(*point, |back| back * point)).filter(|_| self.holds(retained))
        };
        let points: Vec<Option<[f64; 3]>> = judged
            .points
            .iter()
            .enumerate()
            .map(|(track, point)| place(point.as_ref()?, track, &judged.retained[track]))
            .collect();
        let split = |split: &TrackPoint| TrackSplit {
            track: split.track as u32,
            number: split.number,
            weight: split.weight as f32,
            point: place(&split.point, split.track, &split.retained),
        };
        let splits = judged.splits.iter().map(split).collect();
        let two_view_track = |found: &TrackPoint| TwoViewTrack {
            track: found.track as u32,
            weight: found.weight as f32,
            part: self.geometry.component_of_track[found.track],
            point: place(&found.point, found.track, &found.retained),
        };
        // What depths or a method of its own make an inlier needs no other verdict.
        let is_told = |found: &&TrackPoint| !judged.tracks.inlier[found.track] && self.holds(&found.retained);
        let two_view_tracks = judged.two_view_points.iter().filter(is_told).map(two_view_track).collect();
        if self.geometry.component_of_view.iter().any(|&component| component > 0) {
            let of_point = |(point, component): (&Option<_>, &u32)| point.map_or(0, |_: [f64; 3]| *component);
            judged.tracks.part = points.iter().zip(&self.geometry.component_of_track).map(of_point).collect();
        }
        judged.tracks.point = points;
        judged.tracks.network_weight = network_weights(problem, seed);
        let (rms, mean) = reprojection(&judged.observations);
        let calibrations = self.calibrations(problem);
        recorder.found(inliers, calibrations.first().map(|first| first.focal_px));
        Ok(Solution {
            status: Status::Solved,
            grade: Some(self.grade),
            winning_proposal: seed.found.winning_proposal,
            calibrations,
            // The frame is affine to the metric one: its plane at infinity is (0, 0, 0, 1).
            plane_at_infinity: self.is_metric().then_some([0.0; 3]),
            views: self.views(problem, &frames),
            tracks: judged.tracks,
            observations: judged.observations,
            splits,
            two_view_tracks,
            second_structures,
            noise_px: Some(self.geometry.noise * problem.scale_px),
            reprojection_rms_px: rms,
            reprojection_mean_px: mean,
            ..nothing(problem, Some(seed), warnings, recorder)
        })
    }

    /// The calibration of each camera group with registered views in pixels, its principal point about the image centre
    /// of the group's first view; where views have their own focal lengths, with the geometric mean of the group's, or
    /// of all for one of which none is determined.
    fn calibrations(&self, problem: &Problem) -> Vec<Calibration> {
        if !self.is_metric() {
            return Vec::new();
        }
        let (group_of, groups) = camera_groups(problem.input);
        let mean = |views: &[usize]| {
            let sum: f64 = views.iter().map(|&view| self.geometry.lenses[view].focal.ln()).sum();
            (sum / views.len().max(1) as f64).exp()
        };
        let determined: Vec<usize> = (0..self.poses.len()).filter(|&view| self.poses[view].is_some()).collect();
        let of_group = |group: usize| {
            let views = || (0..group_of.len()).filter(|&view| group_of[view] == group);
            let view = views().next()?;
            views().find(|&view| self.geometry.cameras[view].is_some())?;
            let (intrinsics, outcome) = &self.calibrated[problem.camera_of[view]];
            let intrinsics = (*intrinsics)?;
            if !problem.has_own_focals() {
                return Some(pixel_calibration(&intrinsics, outcome, problem, view));
            }
            if determined.is_empty() {
                return None;
            }
            let own: Vec<usize> = determined.iter().copied().filter(|&view| group_of[view] == group).collect();
            let focal = mean(if own.is_empty() { &determined } else { &own });
            let mut calibration = pixel_calibration(&Intrinsics { focal, ..intrinsics }, outcome, problem, view);
            if own.is_empty() {
                calibration.grade = Some(Grade::ProjectiveOnly);
                calibration.sigma_log_focal = None;
            }
            Some(calibration)
        };
        (0..groups).filter_map(of_group).collect()
    }

    /// For each component the homography that takes the pixel camera of its first view to `[I|0]`.
    fn frames(&self, problem: &Problem) -> Vec<Option<Matrix4<f64>>> {
        let components = self.geometry.component_of_view.iter().copied().max().unwrap_or(0);
        let first = |component: u32| {
            (0..self.geometry.cameras.len()).find_map(|view| {
                let camera = self.geometry.cameras[view]
                    .as_ref()
                    .filter(|_| self.geometry.component_of_view[view] == component)?;
                let to_pixels = problem.normalization.to_pixels(view);
                match &self.canonical {
                    Some(canonical) => Some(canonical * affine_frame(&to_pixels, &Camera::identity())?),
                    None => affine_frame(&to_pixels, camera),
                }
            })
        };
        (0..=components).map(first).collect()
    }

    fn views(&self, problem: &Problem, frames: &[Option<Matrix4<f64>>]) -> Vec<ViewResult> {
        let result = |view: usize| {
            let frame = frames[self.geometry.component_of_view[view] as usize].as_ref();
            let (Some(camera), Some(frame)) = (&self.geometry.cameras[view], frame) else {
                return ViewResult::default();
            };
            let mut projection = problem.normalization.camera_px(view, camera) * frame;
            if self.canonical.is_some() {
                projection = oriented(&projection);
            }
            let pose = self.poses[view].as_ref();
            let has_own_focal = problem.has_own_focals() && pose.is_some();
            ViewResult {
                projection: Some(std::array::from_fn(|row| std::array::from_fn(|column| projection[(row, column)]))),
                rotation: pose.map(Pose::rotation_rows),
                translation: pose.map(|pose| pose.translation.into()),
                focal_px: has_own_focal.then(|| self.geometry.lenses[view].focal * problem.scale_px),
                part: self.geometry.component_of_view[view],
                ..ViewResult::default()
            }
        };
        let mut views: Vec<ViewResult> = (0..self.geometry.cameras.len()).map(result).collect();
        self.left_out.iter().for_each(|(view, reason)| views[*view].left_out = Some(*reason));
        views
    }

    /// Whether views with a pose hold the point of these observations: what others alone see is in no metric result.
    fn holds(&self, retained: &[Observation]) -> bool {
        let with_pose = retained.iter().filter(|seen| self.poses[seen.view].is_some()).count();
        !self.is_metric() || with_pose >= LEAST_OBSERVATIONS
    }
}

/// The homography that takes the pixel camera of a view to `[I|0]` and leaves the plane at infinity where it is.
fn affine_frame(to_pixels: &Matrix3<f64>, camera: &Camera) -> Option<Matrix4<f64>> {
    let camera = to_pixels * camera;
    let inverse = camera.fixed_columns::<3>(0).try_inverse()?;
    let mut frame = Matrix4::identity();
    frame.fixed_view_mut::<3, 3>(0, 0).copy_from(&inverse);
    frame.fixed_view_mut::<3, 1>(0, 3).copy_from(&-(inverse * camera.column(3)));
    Some(frame)
}

/// The solution of a scene in which nothing could be reconstructed; the reason is among `warnings`.
fn unsolved(problem: &Problem, attempt: Option<&Attempt>, warnings: Vec<Warning>, mut recorder: Recorder) -> Solution {
    let decided = attempt.and_then(|attempt| attempt.decided.as_ref());
    recorder.found(decided.map_or(0, |decided| decided.inlier.iter().filter(|&&inlier| inlier).count()), None);
    let mut solution = nothing(problem, attempt, warnings, recorder);
    let Some(attempt) = attempt else { return solution };
    if let Some(decided) = decided {
        own_verdicts(&attempt.block.tracks, decided, &mut solution.tracks);
    }
    if let Some(track_scores) = attempt.found.track_scores.as_ref().filter(|track_scores| track_scores.ranks()) {
        solution.tracks.weight = problem.scatter(&track_scores.probabilities(), &attempt.block.tracks);
        let detail = format!(
            "{} tracks look right to the trained network and geometry verifies none: `weight` of the tracks is what it \
             gives them, nothing has checked it",
            track_scores.likely()
        );
        solution.warnings.push(Warning::new(WarningCode::UnverifiedRanking, detail));
    }
    solution
}

/// A solution that says how the solve went, and nothing else. The last progress tells what [`Recorder::found`] was told
/// last: the caller says before what the solution holds.
fn nothing(problem: &Problem, attempt: Option<&Attempt>, warnings: Vec<Warning>, recorder: Recorder) -> Solution {
    let (seconds, iterations) = (recorder.seconds(), recorder.progress.iteration);
    let (stages, history) = recorder.finish();
    Solution {
        status: Status::NoReconstruction,
        grade: None,
        method: problem.settings.method,
        winning_proposal: None,
        iterations,
        seed: problem.settings.seed,
        calibrations: Vec::new(),
        plane_at_infinity: None,
        views: vec![ViewResult::default(); problem.views()],
        tracks: TrackResults {
            network_weight: attempt.map_or_else(Vec::new, |attempt| network_weights(problem, attempt)),
            ..TrackResults::unjudged(problem.tracks())
        },
        observations: ObservationResults::unjudged(problem.input.observation_count()),
        splits: Vec::new(),
        two_view_tracks: Vec::new(),
        second_structures: Vec::new(),
        noise_px: None,
        reprojection_rms_px: None,
        reprojection_mean_px: None,
        warnings,
        seconds,
        stages,
        proposal_times: attempt.map_or_else(Vec::new, |attempt| attempt.found.proposal_times.clone()),
        history,
        trained_network_sha256: None,
        input_content_sha256: None,
        joined_tracks: None,
    }
}

fn why_unsolved(problem: &Problem, best: Option<&Attempt>) -> Warning {
    match best {
        None if problem.views() < LEAST_VIEWS => Warning::new(
            WarningCode::NoConsensus,
            format!("{} views given; a reconstruction needs at least {}", problem.views(), LEAST_VIEWS),
        ),
        None if problem.ranges.windows(2).all(|range| range[1] - range[0] < LEAST_VIEWS) => Warning::new(
            WarningCode::FewInliers,
            format!("no track is seen in {LEAST_VIEWS} views: points that fewer see verify nothing"),
        ),
        None => Warning::new(
            WarningCode::FewInliers,
            format!(
                "no {LEAST_VIEWS} views are enough to begin with: they need {LEAST_INLIERS} tracks that all of them \
                 see, no two of them equal, or {LEAST_SHARED_BY_PAIR} that every two of them see and a fourth view \
                 that sees as many of these, and the tracks must agree more than by chance"
            ),
        ),
        // All 0: too little is observed for a head to run.
        Some(Attempt { decided: Some(Decided { is_verified: false, inlier, weights }), .. })
            if weights.iter().any(|&weight| weight > 0.0) =>
        {
            Warning::new(
                WarningCode::UnverifiedRanking,
                format!(
                    "the best of the network's heads keeps {}; they are too few, too like wrong ones or too far \
                     from one calibration to be verified: `weight` of the tracks is what it gives them, nothing has \
                     checked it",
                    counted(inlier.iter().filter(|&&inlier| inlier).count(), "track")
                ),
            )
        }
        Some(Attempt { decided: Some(decided), .. }) => Warning::new(
            WarningCode::FewInliers,
            format!(
                "the method kept {}; {} determine the cameras",
                counted(decided.inlier.iter().filter(|&&inlier| inlier).count(), "track"),
                LEAST_SUPPORT
            ),
        ),
        Some(Attempt { found: Found { rejected_by_network: Some((inliers, counted)), .. }, .. }) => Warning::new(
            WarningCode::FewInliers,
            format!(
                "{inliers} tracks hold under one geometry, but the trained network takes only {counted} of them to be \
                 right, and so few cameras can adapt to wrong ones; {} are needed. GEOMETRY does not ask the network",
                LEAST_INLIERS
            ),
        ),
        Some(Attempt { found: Found { near_duplicates: Some((inliers, counted)), .. }, .. }) => Warning::new(
            WarningCode::FewInliers,
            format!(
                "{inliers} tracks hold under one geometry, but lie within the noise of each other in every view: they \
                 count as {counted}, and {} are needed",
                LEAST_INLIERS
            ),
        ),
        Some(attempt) => Warning::new(
            WarningCode::NoConsensus,
            format!(
                "among the {} tracks complete over {} views no {} or more agree on one geometry more than by chance",
                attempt.block.tracks.len(),
                attempt.block.views.len(),
                LEAST_INLIERS
            ),
        ),
    }
}

/// The network's own weight of every track; empty where none ran, 0 for tracks it did not see.
fn network_weights(problem: &Problem, attempt: &Attempt) -> Vec<f32> {
    if attempt.found.network_weights.is_empty() {
        return Vec::new();
    }
    problem.scatter(&attempt.found.network_weights, &attempt.block.tracks)
}

/// `None` for points at infinity.
fn dehomogenise(point: &Point) -> Option<[f64; 3]> {
    let scaled = point.xyz() / point.w;
    scaled.iter().all(|entry| entry.is_finite()).then(|| scaled.into())
}

/// The calibration of this view's camera group in pixels, its principal point about the image centre of the view.
///
/// * `outcome`: says what it is worth
fn pixel_calibration(intrinsics: &Intrinsics, outcome: &Outcome, problem: &Problem, view: usize) -> Calibration {
    let offset = intrinsics.principal_point * problem.scale_px;
    Calibration {
        camera_group: problem.input.views()[view].camera_group,
        focal_px: intrinsics.focal * problem.scale_px,
        sigma_log_focal: outcome.sigma_log_focal,
        principal_point_px: (problem.normalization.centres_px[view] + offset).into(),
        aspect: intrinsics.aspect,
        lens_projection: intrinsics.projection,
        radial_k1: intrinsics.radial[0],
        radial_k2: intrinsics.radial[1],
        radial_k3: intrinsics.radial[2],
        tangential_p1: intrinsics.tangential[0],
        tangential_p2: intrinsics.tangential[1],
        grade: Some(outcome.grade),
        sigmas: sigmas(intrinsics, outcome, problem.scale_px),
    }
}

/// Standard deviations of what was estimated beside the focal length, in its units.
fn sigmas(intrinsics: &Intrinsics, outcome: &Outcome, scale_px: f64) -> Sigmas {
    let centre = outcome.sigma(Parameter::PrincipalX).zip(outcome.sigma(Parameter::PrincipalY));
    Sigmas {
        principal_point_px: centre.map(|(x, y)| [x * scale_px, y * scale_px]),
        // A small deviation of the logarithm is one of the ratio.
        aspect: outcome.sigma(Parameter::LogAspect).map(|sigma| sigma * intrinsics.aspect),
        radial_k1: outcome.sigma(Parameter::RadialK1),
        radial_k2: outcome.sigma(Parameter::RadialK2),
        radial_k3: outcome.sigma(Parameter::RadialK3),
        tangential_p1: outcome.sigma(Parameter::TangentialP1),
        tangential_p2: outcome.sigma(Parameter::TangentialP2),
    }
}

/// Root mean square and mean of the inlier observations' residuals.
fn reprojection(observations: &ObservationResults) -> (Option<f64>, Option<f64>) {
    let residuals: Vec<f64> = observations
        .inlier
        .iter()
        .zip(&observations.residual_px)
        .filter_map(|(&inlier, residual)| residual.filter(|_| inlier))
        .collect();
    let rms = root_mean_square(&residuals);
    (rms, rms.map(|_| residuals.iter().sum::<f64>() / residuals.len() as f64))
}
