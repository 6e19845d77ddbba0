//! The last word on every track and observation, under the final geometry and noise.
//!
//! A right observation has a core of Gaussian noise and a tail of three times that width; a wrong one may be anywhere
//! in the image. A track is judged by what it retains once observations that are more likely wrong than right are
//! dropped, at a price for each.

mod noise;

pub use noise::{NoiseModel, density_of_spread, outlier_density, working_gate};

use nalgebra::Vector2;

use crate::domain::result::{ObservationResults, TrackResults};
use crate::domain::{Input, StopToken};
use crate::geometry::bundle::metric::Intrinsics;
use crate::geometry::measurement::{Normalization, Sighting};
use crate::geometry::{Camera, Point, robust_triangulation, triangulation};
use crate::parallel::Threads;
use crate::solver::per_track::{BATCH, TRACKS_A_RUN, WORTH_A_THREAD};

/// Observations that a track must retain, and the share of those it has in the registered views.
const LEAST_RETAINED: usize = 3;
const LEAST_RETAINED_SHARE: f64 = 0.6;
/// Refinement steps of a point.
const POINT_STEPS: usize = 10;

/// The geometry to judge by.
pub struct Geometry<'a> {
    /// Projective camera of every view of the input, normalised; `None`: not registered.
    pub cameras: &'a [Option<Camera>],
    /// Where views are in several frames: the frame of each view and the one that each track is judged in.
    pub parts: Option<(&'a [u32], &'a [u32])>,
    pub normalization: &'a Normalization,
    /// The lens of each view, whose distortion is undone before the cameras, pinholes, are asked; empty: all are
    /// pinholes.
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

/// The verdict on one track.
#[derive(Debug, Clone)]
struct Verdict {
    weight: f64,
    inlier: bool,
    point: Point,
    /// One entry a sighting.
    retained: Vec<bool>,
}

/// What was found of one track.
struct Finding {
    sightings: Vec<Sighting>,
    /// Of the sightings, among the caller's observations.
    places: Vec<usize>,
    verdict: Verdict,
    others: Vec<Other>,
}

/// A further point that a track joins, with the sightings that show it.
struct Other {
    verdict: Verdict,
    sightings: Vec<usize>,
}

/// Every track and observation of the input, judged. Points stay homogeneous, projective and normalised.
pub struct Judged {
    pub tracks: TrackResults,
    pub observations: ObservationResults,
    /// Retained sightings of each inlier track, with views of the input.
    pub retained: Vec<Vec<Sighting>>,
    pub points: Vec<Option<Point>>,
    /// The other points that linked tracks join, by track.
    pub splits: Vec<SplitPoint>,
    /// The noise that everything was judged by.
    pub noise: NoiseModel,
}

/// A point beside its own that a track joins: one wrong link is enough.
pub struct SplitPoint {
    pub track: usize,
    /// From 1, as [`ObservationResults::split`] has it.
    pub number: u32,
    pub weight: f64,
    pub point: Point,
    /// The sightings that show it.
    pub retained: Vec<Sighting>,
}

/// Judges every track that has three observations in registered views or more; the others have weight 0 and no
/// residuals.
///
/// Twice: with a wide tail first, then with the tail that the tracks show which are right in all their observations.
/// Where there is none, a wrong observation is told from a right one nearer by: at 8 to 9 core deviations instead of 12
/// at .3 % noise.
///
/// Once `stop` fires the rest stays unjudged: nobody will look at the result. `told` hears how many verdicts there are,
/// up to two a track. How many threads there are changes nothing.
pub fn judge(
    input: &Input,
    ranges: &[usize],
    geometry: &Geometry,
    threads: Threads,
    stop: &StopToken,
    told: &mut dyn FnMut(usize),
) -> Judged {
    let noise = NoiseModel::new(geometry.noise, geometry.outlier_density);
    let judged = judge_under(input, ranges, geometry, noise, threads, stop, told);
    match noise.with_tail(&whole_tracks(input, ranges, geometry, &judged)) {
        Some(noise) => {
            let mut told = |tracks| told(input.track_count() + tracks);
            judge_under(input, ranges, geometry, noise, threads, stop, &mut told)
        }
        None => judged,
    }
}

/// Squared residuals, in core variances, of the tracks that are right as a whole: a track with a dropped observation
/// may be wrong in others.
fn whole_tracks(input: &Input, ranges: &[usize], geometry: &Geometry, judged: &Judged) -> Vec<f64> {
    (0..input.track_count())
        .filter(|&track| judged.tracks.inlier[track])
        .filter(|&track| judged.retained[track].len() == ranges[track + 1] - ranges[track])
        .flat_map(|track| ranges[track]..ranges[track + 1])
        .filter_map(|k| judged.observations.residual_px[input.caller_index(k)])
        .map(|residual| (residual / geometry.normalization.scale_px / geometry.noise).powi(2))
        .collect()
}

fn judge_under(
    input: &Input,
    ranges: &[usize],
    geometry: &Geometry,
    noise: NoiseModel,
    threads: Threads,
    stop: &StopToken,
    told: &mut dyn FnMut(usize),
) -> Judged {
    // Triangulation wants a slice; unregistered views are never sighted.
    let cameras: Vec<Camera> = geometry.cameras.iter().map(|camera| camera.unwrap_or_else(Camera::zeros)).collect();
    let bench = Bench { cameras: &cameras, geometry, noise };
    let mut judged = Judged::nothing(input, noise);
    let threads = threads.if_worth(input.track_count() >= WORTH_A_THREAD);
    for first in (0..input.track_count()).step_by(BATCH) {
        let count = BATCH.min(input.track_count() - first);
        let of_track = |k: usize| (!stop.is_stopped()).then(|| bench.find(input, ranges, first + k)).flatten();
        let found = threads.map(count, TRACKS_A_RUN, of_track, &mut |tracks| told(first + tracks));
        for (k, finding) in found.into_iter().enumerate() {
            if let Some(finding) = finding {
                bench.write(&mut judged, first + k, &finding);
            }
        }
    }
    judged
}

impl Judged {
    /// Nothing judged yet.
    fn nothing(input: &Input, noise: NoiseModel) -> Self {
        let count = input.track_count();
        Self {
            tracks: TrackResults {
                weight: vec![0.0; count],
                inlier: vec![false; count],
                network_weight: Vec::new(),
                point: vec![None; count],
                part: Vec::new(),
            },
            observations: ObservationResults::unjudged(input.observation_count()),
            retained: vec![Vec::new(); count],
            points: vec![None; count],
            splits: Vec::new(),
            noise,
        }
    }
}

/// What tracks are judged by.
struct Bench<'a> {
    cameras: &'a [Camera],
    geometry: &'a Geometry<'a>,
    noise: NoiseModel,
}

impl Bench<'_> {
    /// Judges a track and, where tracks are linked and it is right, what it leaves; `None` where too few views see it.
    fn find(&self, input: &Input, ranges: &[usize], track: usize) -> Option<Finding> {
        let geometry = self.geometry;
        let seen: Vec<usize> =
            (ranges[track]..ranges[track + 1]).filter(|&k| geometry.judges(track, input.view_of(k))).collect();
        if seen.len() < LEAST_RETAINED {
            return None;
        }
        let sightings: Vec<Sighting> =
            seen.iter().map(|&k| Sighting { view: input.view_of(k), xy: geometry.point(input, k) }).collect();
        let places = seen.into_iter().map(|k| input.caller_index(k)).collect();
        let verdict = self.judge(&sightings);
        let others = if geometry.linked && verdict.inlier { self.others(&sightings, &verdict) } else { Vec::new() };
        Some(Finding { sightings, places, verdict, others })
    }

    /// Drops the worst observation as long as it is more likely wrong than right, then weighs what remains.
    fn judge(&self, sightings: &[Sighting]) -> Verdict {
        let gate = self.noise.gate();
        let retained = self.retained_at_first(sightings, gate);
        let Some(mut retained) = retained else { return Verdict::wrong(self.cameras, sightings) };
        let (mut point, mut cost) = triangulate(self.cameras, &chosen(sightings, &retained));
        let share = if self.geometry.linked { 0.0 } else { LEAST_RETAINED_SHARE };
        let least = LEAST_RETAINED.max((share * sightings.len() as f64).ceil() as usize);
        // A track that cannot retain enough is wrong already.
        while retained.len() >= least && retained.len() > LEAST_RETAINED {
            let residuals = retained.iter().map(|&k| self.squared(&point, &sightings[k]));
            let Some((place, worst)) = residuals.enumerate().max_by(|a, b| a.1.total_cmp(&b.1)) else { break };
            if worst <= gate {
                break;
            }
            retained.remove(place);
            (point, cost) = triangulate(self.cameras, &chosen(sightings, &retained));
        }
        let dropped = sightings.len() - retained.len();
        let ln_odds = self.noise.ln_odds(cost, retained.len(), dropped, self.geometry.inlier_share);
        let enough = retained.len() >= least;
        let weight = if enough { 1.0 / (1.0 + (-ln_odds).exp()) } else { 0.0 };
        let mut flags = vec![false; sightings.len()];
        for k in retained {
            flags[k] = self.squared(&point, &sightings[k]) <= gate;
        }
        let whole = flags.iter().filter(|&&flag| flag).count() >= LEAST_RETAINED;
        Verdict { weight, inlier: weight > 0.5 && whole, point, retained: flags }
    }

    /// The sightings that a verdict begins with: all, or those that agree where links may be wrong; `None` where none
    /// do.
    fn retained_at_first(&self, sightings: &[Sighting], gate: f64) -> Option<Vec<usize>> {
        if !self.geometry.linked {
            return Some((0..sightings.len()).collect());
        }
        let found = robust_triangulation::robust(self.cameras, sightings, gate)?;
        Some((0..sightings.len()).filter(|&k| found.agrees[k]).collect())
    }

    /// Squared residual of a sighting of a point.
    fn squared(&self, point: &Point, seen: &Sighting) -> f64 {
        triangulation::reprojection(&self.cameras[seen.view], point, &seen.xy).norm_squared()
    }

    /// Enters what was found of a track.
    fn write(&self, judged: &mut Judged, track: usize, finding: &Finding) {
        let Finding { sightings, places, verdict, others } = finding;
        judged.tracks.weight[track] = verdict.weight as f32;
        judged.tracks.inlier[track] = verdict.inlier;
        for ((&place, sighting), &retained) in places.iter().zip(sightings).zip(&verdict.retained) {
            let squared = self.squared(&verdict.point, sighting);
            judged.observations.residual_px[place] =
                Some(squared.sqrt() * self.geometry.normalization.scale_px).filter(|residual| residual.is_finite());
            judged.observations.weight[place] = self.noise.weight(squared) as f32;
            judged.observations.inlier[place] = verdict.inlier && retained;
        }
        if verdict.inlier {
            let retained = sightings.iter().zip(&verdict.retained).filter(|(_, retained)| **retained);
            judged.retained[track] = retained.map(|(sighting, _)| *sighting).collect();
            judged.points[track] = Some(verdict.point);
        }
        for (number, other) in (1..).zip(others) {
            other.sightings.iter().for_each(|&k| judged.observations.split[places[k]] = number);
            let Verdict { weight, point, .. } = other.verdict;
            let retained = chosen(sightings, &other.sightings);
            judged.splits.push(SplitPoint { track, number, weight, point, retained });
        }
    }

    /// Looks for the other points that a right track joins, among the observations that its own leaves.
    fn others(&self, sightings: &[Sighting], verdict: &Verdict) -> Vec<Other> {
        let mut left: Vec<usize> = (0..sightings.len()).filter(|&k| !verdict.retained[k]).collect();
        let mut others = Vec::new();
        while left.len() >= LEAST_RETAINED {
            let verdict = self.judge(&chosen(sightings, &left));
            if !verdict.inlier {
                break;
            }
            let (of_other, rest): (Vec<_>, Vec<_>) = left.iter().zip(&verdict.retained).partition(|(_, kept)| **kept);
            let indices = |these: Vec<(&usize, &bool)>| these.into_iter().map(|(&k, _)| k).collect::<Vec<usize>>();
            let (sightings, rest) = (indices(of_other), indices(rest));
            others.push(Other { verdict, sightings });
            left = rest;
        }
        others
    }
}

impl Verdict {
    /// On a track of which no two observations agree on a point in front of their cameras.
    fn wrong(cameras: &[Camera], sightings: &[Sighting]) -> Self {
        let (point, _) = triangulate(cameras, sightings);
        Self { weight: 0.0, inlier: false, point, retained: vec![false; sightings.len()] }
    }
}

fn chosen(sightings: &[Sighting], which: &[usize]) -> Vec<Sighting> {
    which.iter().map(|&k| sightings[k]).collect()
}

fn triangulate(cameras: &[Camera], sightings: &[Sighting]) -> (Point, f64) {
    triangulation::refine(cameras, sightings, triangulation::linear(cameras, sightings), POINT_STEPS)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{Limits, RawInput, View};

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

    fn bench<'a>(cameras: &'a [Camera], geometry: &'a Geometry) -> Bench<'a> {
        Bench { cameras, geometry, noise: NoiseModel::new(geometry.noise, geometry.outlier_density) }
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
    fn a_right_track_a_track_with_one_wrong_observation_and_a_wrong_track() {
        let normalization = Normalization { centres_px: Vec::new(), scale_px: 1.0 };
        let geometry = geometry(&normalization);
        let cameras = cameras(6);
        let bench = bench(&cameras, &geometry);
        let verdict = |shifts: [f64; 6]| bench.judge(&sightings(&cameras, &shifts));
        let right = verdict([0.001, -0.001, 0.0005, 0.0, -0.0005, 0.001]);
        assert!(right.inlier && right.weight > 0.999 && right.retained.iter().all(|&kept| kept));
        let one_wrong = verdict([0.0, 0.0, 0.2, 0.0, 0.0, 0.0]);
        assert!(one_wrong.inlier);
        assert_eq!(one_wrong.retained, [true, true, false, true, true, true]);
        let wrong = verdict([0.1, -0.2, 0.15, -0.1, 0.3, -0.05]);
        assert!(!wrong.inlier && wrong.weight < 0.01, "{}", wrong.weight);
    }

    /// A track that goes over to another point, and one wrong observation between the two.
    #[test]
    fn a_track_that_joins_two_points_is_split_and_one_that_strays_is_not() {
        let normalization = Normalization { centres_px: Vec::new(), scale_px: 1.0 };
        let geometry = Geometry { linked: true, ..geometry(&normalization) };
        let cameras = cameras(8);
        let bench = bench(&cameras, &geometry);
        let split = |sightings: &[Sighting]| {
            let mut judged = Judged::nothing(&testing_input(), bench.noise);
            let verdict = bench.judge(sightings);
            assert!(verdict.inlier);
            let others = bench.others(sightings, &verdict);
            let (sightings, places) = (sightings.to_vec(), (0..8).collect());
            bench.write(&mut judged, 0, &Finding { sightings, places, verdict, others });
            (judged.observations.split, judged.splits.len())
        };
        let mut joined = sightings(&cameras, &[0.0, 0.0005, -0.0005, 0.0, 0.31, 0.0, 0.0, 0.0]);
        let second = Point::new(-0.5, 0.4, 1.5, 1.0);
        for seen in &mut joined[5..] {
            let image = cameras[seen.view] * second;
            seen.xy = image.xy() / image.z;
        }
        assert_eq!(split(&joined), (vec![0, 0, 0, 0, 0, 1, 1, 1], 1));
        let astray = sightings(&cameras, &[0.0, 0.0005, -0.0005, 0.0, 0.31, -0.22, 0.17, -0.4]);
        assert_eq!(split(&astray), (vec![0; 8], 0));
    }

    /// One track in eight views.
    fn testing_input() -> Input {
        let raw = RawInput {
            views: vec![View::default(); 8],
            track_count: 1,
            view: (0..8).collect(),
            track: vec![0; 8],
            x: (0..8).map(f64::from).collect(),
            y: vec![0.0; 8],
            ..RawInput::default()
        };
        Input::new(raw, &Limits::default(), "track").expect("valid")
    }

    #[test]
    fn of_a_linked_track_the_right_run_is_kept_and_nothing_behind_the_cameras() {
        let normalization = Normalization { centres_px: Vec::new(), scale_px: 1.0 };
        let geometry = Geometry { linked: true, ..geometry(&normalization) };
        let cameras = cameras(6);
        let joined = sightings(&cameras, &[0.0, 0.0005, -0.0005, 0.2, -0.15, 0.31]);
        let verdict = bench(&cameras, &geometry).judge(&joined);
        assert!(verdict.inlier, "{}", verdict.weight);
        assert_eq!(verdict.retained, [true, true, true, false, false, false]);
        let behind: Vec<Camera> = cameras.iter().map(|camera| -camera).collect();
        let verdict = bench(&behind, &geometry).judge(&sightings(&cameras, &[0.0; 6]));
        assert!(!verdict.inlier && verdict.weight == 0.0, "{}", verdict.weight);
    }
}
