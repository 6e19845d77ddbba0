//! The last word on every track and observation, under the final geometry and noise.
//!
//! A right observation has a core of Gaussian noise and a tail of three times that width; a wrong one may be anywhere
//! in the image. A track is judged by what it retains once observations that are more likely wrong than right are
//! dropped, at a price for each.

use nalgebra::Vector2;

use crate::domain::result::{ObservationResults, TrackResults};
use crate::domain::{Input, StopToken};
use crate::geometry::bundle::metric::Intrinsics;
use crate::geometry::measurement::{Normalization, Sighting};
use crate::geometry::{Camera, Point, robust_triangulation, triangulation};

/// Share of right observations in the tail, before it is known, and the tail's width in units of the core. Feature
/// detectors have a core of .1 to .3 px and tails that a Gaussian of that width would call impossible; together with the
/// uniform outliers this puts the gate at 12 to 17 core deviations, where real sequences want it (15 to 20).
const TAIL_SHARE: f64 = 0.05;
const TAIL_WIDTH: f64 = 3.0;
/// Bounds of the share that is estimated: noise without a tail still has a rare blunder that is no wrong match.
const TAIL_BOUNDS: (f64, f64) = (0.001, 0.2);
/// Observations from which the share is estimated, and rounds of the estimation; it converges in five.
const TAIL_OBSERVATIONS: usize = 100;
const TAIL_ROUNDS: usize = 10;
/// Prior probability that a single observation of a right track is wrong.
const WRONG_OBSERVATION: f64 = 0.05;
/// Observations that a track must retain, and the share of those it has in the registered views.
const LEAST_RETAINED: usize = 3;
const LEAST_RETAINED_SHARE: f64 = 0.6;
/// Tracks between two looks at the stop token: a few milliseconds.
const TRACKS_PER_LOOK: usize = 16;
/// Refinement steps of a point.
const POINT_STEPS: usize = 10;

/// The geometry to judge by.
pub struct Geometry<'a> {
    /// Projective camera of every view of the input, normalised; `None`: not registered.
    pub cameras: &'a [Option<Camera>],
    /// Where views are in several frames: the frame of each view and the one that each track is judged in.
    pub parts: Option<(&'a [u32], &'a [u32])>,
    pub normalization: &'a Normalization,
    /// The lens of each view, whose distortion is undone before the cameras, pinholes, are asked; empty: all are pinholes.
    pub lenses: &'a [Intrinsics],
    /// Whether tracks were linked from view to view, so that one wrong link joins two points: the observations that
    /// agree on one are looked for then, however few they are beside the others. The cameras must be metric. Otherwise
    /// a track is right in most of its observations or wrong.
    pub linked: bool,
    /// Core noise, one standard deviation of a coordinate, normalised units.
    pub noise: f64,
    /// Density of a wrong coordinate: one over the width of the points' distribution, normalised units.
    pub outlier_density: f64,
    /// Prior probability that a track is right.
    pub inlier_share: f64,
}

impl Geometry<'_> {
    /// Whether a track is judged by what a view saw of it.
    fn judges(&self, track: usize, view: usize) -> bool {
        self.cameras[view].is_some() && self.parts.is_none_or(|(of_view, of_track)| of_view[view] == of_track[track])
    }

    /// Where a pinhole would see observation `k`; what a lens images nowhere stays where it is, far from any point.
    fn point(&self, input: &Input, k: usize) -> Vector2<f64> {
        let xy = self.normalization.normalize(input.view_of(k), input.point_px(k));
        self.lenses.get(input.view_of(k)).and_then(|lens| lens.undistort(&xy)).unwrap_or(xy)
    }
}

/// Density of a wrong coordinate among points that are spread like these: one over the width of a uniform distribution
/// of their standard deviation.
pub fn outlier_density(points: &[Vector2<f64>]) -> f64 {
    let count = points.len().max(1) as f64;
    let mean = points.iter().sum::<Vector2<f64>>() / count;
    let variance = points.iter().map(|point| (point - mean).norm_squared()).sum::<f64>() / (2.0 * count);
    density_of_spread(variance.sqrt().clamp(f64::MIN_POSITIVE, super::portfolio::MOST_SPREAD))
}

/// The same from the standard deviation of a coordinate: a uniform distribution is `sqrt(12)` times as wide.
pub fn density_of_spread(spread: f64) -> f64 {
    1.0 / (12.0f64.sqrt() * spread)
}

/// Squared residual within which an observation is more likely right than wrong while nothing is known of the noise's tail.
pub fn working_gate(noise: f64, outlier_density: f64) -> f64 {
    observation_gate(&NoiseModel { core: noise, tail_share: TAIL_SHARE }, outlier_density)
}

/// How the residuals of right observations are distributed.
#[derive(Debug, Clone, Copy, PartialEq)]
struct NoiseModel {
    /// Core, one standard deviation of a coordinate.
    core: f64,
    tail_share: f64,
}

/// The verdict on one track.
#[derive(Debug, Clone)]
struct Verdict {
    weight: f64,
    inlier: bool,
    point: Point,
    /// One entry a sighting.
    retained: Vec<bool>,
}

/// Every track and observation of the input, judged. Points stay homogeneous, projective and normalised.
pub struct Judged {
    pub tracks: TrackResults,
    pub observations: ObservationResults,
    /// Retained sightings of each inlier track, with views of the input.
    pub retained: Vec<Vec<Sighting>>,
    pub points: Vec<Option<Point>>,
}

/// Judges every track that has three observations in registered views or more; the others have weight 0 and no
/// residuals.
///
/// Twice: with a wide tail first, then with the tail that the tracks show which are right in all their observations.
/// Where there is none, a wrong observation is told from a right one nearer by: at 8 to 9 core deviations instead of 12 at .3 % noise.
///
/// Once `stop` fires the rest stays unjudged: nobody will look at the result.
pub fn judge(input: &Input, ranges: &[usize], geometry: &Geometry, stop: &StopToken) -> Judged {
    let mut noise = NoiseModel { core: geometry.noise, tail_share: TAIL_SHARE };
    let judged = judge_under(input, ranges, geometry, &noise, stop);
    let Some(share) = tail_share(input, ranges, geometry, &judged) else { return judged };
    noise.tail_share = share;
    judge_under(input, ranges, geometry, &noise, stop)
}

/// The share of the tail by expectation and maximisation over the residuals of tracks that are right as a whole: a track
/// with a dropped observation may be wrong in others. `None` for too few of them.
fn tail_share(input: &Input, ranges: &[usize], geometry: &Geometry, judged: &Judged) -> Option<f64> {
    let squared: Vec<f64> = (0..input.track_count())
        .filter(|&track| judged.tracks.inlier[track])
        .filter(|&track| judged.retained[track].len() == ranges[track + 1] - ranges[track])
        .flat_map(|track| ranges[track]..ranges[track + 1])
        .filter_map(|k| judged.observations.residual_px[input.caller_index(k)])
        .map(|residual| (residual / geometry.normalization.scale_px / geometry.noise).powi(2))
        .collect();
    if squared.len() < TAIL_OBSERVATIONS {
        return None;
    }
    let mut share = TAIL_SHARE;
    for _ in 0..TAIL_ROUNDS {
        let of_tail = |squared: &f64| {
            let core = (1.0 - share) * (-0.5 * squared).exp();
            let tail = share * (-0.5 * squared / TAIL_WIDTH.powi(2)).exp() / TAIL_WIDTH.powi(2);
            tail / (core + tail).max(f64::MIN_POSITIVE)
        };
        share = squared.iter().map(of_tail).sum::<f64>() / squared.len() as f64;
    }
    Some(share.clamp(TAIL_BOUNDS.0, TAIL_BOUNDS.1))
}

fn judge_under(input: &Input, ranges: &[usize], geometry: &Geometry, noise: &NoiseModel, stop: &StopToken) -> Judged {
    let count = input.track_count();
    let observation_count = input.observation_count();
    let mut judged = Judged {
        tracks: TrackResults {
            weight: vec![0.0; count],
            inlier: vec![false; count],
            network_weight: Vec::new(),
            point: vec![None; count],
            part: Vec::new(),
        },
        observations: ObservationResults {
            inlier: vec![false; observation_count],
            residual_px: vec![None; observation_count],
        },
        retained: vec![Vec::new(); count],
        points: vec![None; count],
    };
    // Triangulation wants a slice; unregistered views are never sighted.
    let cameras: Vec<Camera> = geometry.cameras.iter().map(|camera| camera.unwrap_or_else(Camera::zeros)).collect();
    for track in 0..count {
        if track.is_multiple_of(TRACKS_PER_LOOK) && stop.is_stopped() {
            break;
        }
        let seen: Vec<usize> =
            (ranges[track]..ranges[track + 1]).filter(|&k| geometry.judges(track, input.view_of(k))).collect();
        if seen.len() < LEAST_RETAINED {
            continue;
        }
        let sightings: Vec<Sighting> =
            seen.iter().map(|&k| Sighting { view: input.view_of(k), xy: geometry.point(input, k) }).collect();
        let verdict = judge_track(&cameras, &sightings, geometry, noise);
        judged.tracks.weight[track] = verdict.weight as f32;
        judged.tracks.inlier[track] = verdict.inlier;
        for ((&k, sighting), &retained) in seen.iter().zip(&sightings).zip(&verdict.retained) {
            let residual = triangulation::reprojection(&cameras[sighting.view], &verdict.point, &sighting.xy).norm();
            let place = input.caller_index(k);
            judged.observations.residual_px[place] =
                Some(residual * geometry.normalization.scale_px).filter(|residual| residual.is_finite());
            judged.observations.inlier[place] = verdict.inlier && retained;
        }
        if verdict.inlier {
            let retained = sightings.iter().zip(&verdict.retained).filter(|(_, retained)| **retained);
            judged.retained[track] = retained.map(|(sighting, _)| *sighting).collect();
            judged.points[track] = Some(verdict.point);
        }
    }
    judged
}

/// Drops the worst observation as long as it is more likely wrong than right, then weighs what remains.
fn judge_track(cameras: &[Camera], sightings: &[Sighting], geometry: &Geometry, noise: &NoiseModel) -> Verdict {
    let gate = observation_gate(noise, geometry.outlier_density);
    let retained = retained_at_first(cameras, sightings, geometry, gate);
    let Some(mut retained) = retained else { return Verdict::wrong(cameras, sightings) };
    let (mut point, mut cost) = triangulate(cameras, &chosen(sightings, &retained));
    let share = if geometry.linked { 0.0 } else { LEAST_RETAINED_SHARE };
    let least = LEAST_RETAINED.max((share * sightings.len() as f64).ceil() as usize);
    // A track that cannot retain enough is wrong already.
    while retained.len() >= least && retained.len() > LEAST_RETAINED {
        let residual = |&k: &usize| {
            triangulation::reprojection(&cameras[sightings[k].view], &point, &sightings[k].xy).norm_squared()
        };
        let Some((place, worst)) = retained.iter().map(residual).enumerate().max_by(|a, b| a.1.total_cmp(&b.1)) else {
            break;
        };
        if worst <= gate {
            break;
        }
        retained.remove(place);
        (point, cost) = triangulate(cameras, &chosen(sightings, &retained));
    }
    let dropped = sightings.len() - retained.len();
    let ln_odds = ln_odds(cost, retained.len(), dropped, geometry, noise);
    let enough = retained.len() >= least;
    let weight = if enough { 1.0 / (1.0 + (-ln_odds).exp()) } else { 0.0 };
    let mut flags = vec![false; sightings.len()];
    for k in retained {
        let residual =
            triangulation::reprojection(&cameras[sightings[k].view], &point, &sightings[k].xy).norm_squared();
        flags[k] = residual <= gate;
    }
    let whole = flags.iter().filter(|&&flag| flag).count() >= LEAST_RETAINED;
    Verdict { weight, inlier: weight > 0.5 && whole, point, retained: flags }
}

impl Verdict {
    /// On a track of which no two observations agree on a point in front of their cameras.
    fn wrong(cameras: &[Camera], sightings: &[Sighting]) -> Self {
        let (point, _) = triangulate(cameras, sightings);
        Self { weight: 0.0, inlier: false, point, retained: vec![false; sightings.len()] }
    }
}

/// The sightings that a verdict begins with: all, or those that agree where links may be wrong; `None` where none do.
fn retained_at_first(cameras: &[Camera], sightings: &[Sighting], geometry: &Geometry, gate: f64) -> Option<Vec<usize>> {
    if !geometry.linked {
        return Some((0..sightings.len()).collect());
    }
    let found = robust_triangulation::robust(cameras, sightings, gate)?;
    Some((0..sightings.len()).filter(|&k| found.agrees[k]).collect())
}

fn chosen(sightings: &[Sighting], which: &[usize]) -> Vec<Sighting> {
    which.iter().map(|&k| sightings[k]).collect()
}

fn triangulate(cameras: &[Camera], sightings: &[Sighting]) -> (Point, f64) {
    triangulation::refine(cameras, sightings, triangulation::linear(cameras, sightings), POINT_STEPS)
}

/// Squared residual at which an observation is as likely wrong as right: by its core or by its tail, whichever reaches
/// farther. Strong noise has a core that reaches farther than a rare tail.
fn observation_gate(noise: &NoiseModel, outlier_density: f64) -> f64 {
    let wrong = WRONG_OBSERVATION * outlier_density.powi(2);
    let reach = |share: f64, width: f64| {
        let variance = (width * noise.core).powi(2);
        let right = (1.0 - WRONG_OBSERVATION) * share / (std::f64::consts::TAU * variance);
        2.0 * variance * (right / wrong).ln().max(0.0)
    };
    reach(1.0 - noise.tail_share, 1.0).max(reach(noise.tail_share, TAIL_WIDTH))
}

/// Log of the odds that a track is right: prior, times the density of its residuals under core and tail, over that of
/// coordinates anywhere, times the price of every dropped observation.
fn ln_odds(cost: f64, retained: usize, dropped: usize, geometry: &Geometry, noise: &NoiseModel) -> f64 {
    let dof = (2 * retained) as f64 - 3.0;
    let ln_density = |share: f64, width: f64| {
        let variance = (width * noise.core).powi(2);
        share.ln() - 0.5 * dof * (std::f64::consts::TAU * variance).ln() - 0.5 * cost / variance
    };
    let (core, tail) = (ln_density(1.0 - noise.tail_share, 1.0), ln_density(noise.tail_share, TAIL_WIDTH));
    let ln_right = core.max(tail) + (-(core - tail).abs()).exp().ln_1p() + dropped as f64 * WRONG_OBSERVATION.ln();
    let ln_wrong = dof * geometry.outlier_density.ln();
    let prior = (geometry.inlier_share / (1.0 - geometry.inlier_share)).ln();
    prior + ln_right - ln_wrong
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cameras(views: usize) -> Vec<Camera> {
        (0..views)
            .map(|view| {
                let t = view as f64;
                Camera::new(1.2, 0.0, 0.0, 0.5 * t, 0.0, 1.2, 0.0, 0.2 * t, 0.0, 0.0, 1.0, 3.0)
            })
            .collect()
    }

    fn geometry<'a>(normalization: &'a Normalization) -> Geometry<'a> {
        Geometry {
            cameras: &[],
            parts: None,
            normalization,
            lenses: &[],
            linked: false,
            noise: 0.001,
            outlier_density: 2.0,
            inlier_share: 0.3,
        }
    }

    fn sightings(cameras: &[Camera], shifts: &[f64]) -> Vec<Sighting> {
        let point = Point::new(0.2, -0.1, 0.5, 1.0);
        cameras
            .iter()
            .zip(shifts)
            .enumerate()
            .map(|(view, (camera, shift))| {
                let image = camera * point;
                Sighting { view, xy: image.xy() / image.z + Vector2::new(0.3 * shift, *shift) }
            })
            .collect()
    }

    #[test]
    fn the_gate_lets_the_core_of_any_noise_through() {
        for core in [1e-4, 0.003, 0.02, 0.05] {
            for tail_share in [TAIL_BOUNDS.0, TAIL_SHARE, TAIL_BOUNDS.1] {
                let gate = observation_gate(&NoiseModel { core, tail_share }, 1.0).sqrt() / core;
                assert!((2.5..25.0).contains(&gate), "noise {core}, tail {tail_share}: {gate} deviations");
            }
        }
    }

    #[test]
    fn a_right_track_a_track_with_one_wrong_observation_and_a_wrong_track() {
        let normalization = Normalization { centres_px: Vec::new(), scale_px: 1.0 };
        let geometry = geometry(&normalization);
        let cameras = cameras(6);
        let noise = NoiseModel { core: geometry.noise, tail_share: TAIL_SHARE };
        let verdict = |shifts: [f64; 6]| judge_track(&cameras, &sightings(&cameras, &shifts), &geometry, &noise);
        let right = verdict([0.001, -0.001, 0.0005, 0.0, -0.0005, 0.001]);
        assert!(right.inlier && right.weight > 0.999 && right.retained.iter().all(|&kept| kept));
        let one_wrong = verdict([0.0, 0.0, 0.2, 0.0, 0.0, 0.0]);
        assert!(one_wrong.inlier);
        assert_eq!(one_wrong.retained, [true, true, false, true, true, true]);
        let wrong = verdict([0.1, -0.2, 0.15, -0.1, 0.3, -0.05]);
        assert!(!wrong.inlier && wrong.weight < 0.01, "{}", wrong.weight);
    }

    #[test]
    fn of_a_linked_track_the_right_run_is_kept_and_nothing_behind_the_cameras() {
        let normalization = Normalization { centres_px: Vec::new(), scale_px: 1.0 };
        let geometry = Geometry { linked: true, ..geometry(&normalization) };
        let cameras = cameras(6);
        let noise = NoiseModel { core: geometry.noise, tail_share: TAIL_SHARE };
        let joined = sightings(&cameras, &[0.0, 0.0005, -0.0005, 0.2, -0.15, 0.31]);
        let verdict = judge_track(&cameras, &joined, &geometry, &noise);
        assert!(verdict.inlier, "{}", verdict.weight);
        assert_eq!(verdict.retained, [true, true, true, false, false, false]);
        let behind: Vec<Camera> = cameras.iter().map(|camera| -camera).collect();
        let verdict = judge_track(&behind, &sightings(&cameras, &[0.0; 6]), &geometry, &noise);
        assert!(!verdict.inlier && verdict.weight == 0.0, "{}", verdict.weight);
    }
}
