//! Some tracks judged side by side: which observations each retains, and whether it is right by them.

use std::ops::Range;

use super::{Geometry, Judged, OPTIONS, TrackPoint};
use crate::domain::VERIFIED;
use crate::geometry::observation::Observation;
use crate::geometry::robust_triangulation::{Triangulator, squared_in_front};
use crate::geometry::triangulation::batch::{Batch, LANES};
use crate::geometry::{Camera, Point, triangulation};
use crate::solver::noise_model::NoiseModel;
use crate::solver::problem::Problem;

/// The verdict on one track.
#[derive(Debug, Clone)]
struct TrackVerdict {
    weight: f64,
    inlier: bool,
    point: Point,
    /// One entry an observation.
    retained: Vec<bool>,
}

/// What was found of one track.
pub struct Finding {
    track: usize,
    observations: Vec<Observation>,
    /// Of the observations, among the caller's observations.
    places: Vec<usize>,
    verdict: TrackVerdict,
    others: Vec<Other>,
}

/// A further point that a track joins, with the observations that show it.
struct Other {
    verdict: TrackVerdict,
    observations: Vec<usize>,
}

/// What tracks are judged by.
pub struct TrackClassifier<'a> {
    pub problem: &'a Problem<'a>,
    /// Of every view; those of views that are not registered are never asked.
    pub cameras: &'a [Camera],
    pub triangulator: Triangulator<'a>,
    pub geometry: &'a Geometry,
    /// Share of its observations that a right track retains.
    pub least_share: f64,
    pub noise: NoiseModel,
}

impl TrackClassifier<'_> {
    /// Judges some tracks, no more than a [`Batch`] takes, and, of those that are right and may hold wrong
    /// observations, what they leave; without those that are not of the scene, or that one view sees.
    pub fn find(&self, tracks: Range<usize>) -> Vec<Finding> {
        let Self { problem, geometry, .. } = self;
        let (tracks, seen): (Vec<usize>, Vec<Vec<usize>>) = tracks
            .filter(|&track| geometry.of_static || !problem.is_static[track])
            .map(|track| (track, geometry.of_track(problem, track)))
            .filter(|(_, seen)| seen.len() >= 2)
            .unzip();
        let observations: Vec<Vec<Observation>> =
            seen.iter().map(|seen| seen.iter().map(|&k| geometry.observation(problem, k)).collect()).collect();
        let verdicts = self.judge(&observations.iter().map(Vec::as_slice).collect::<Vec<_>>());
        let found = tracks.into_iter().zip(seen).zip(observations).zip(verdicts);
        found
            .map(|(((track, seen), observations), verdict)| {
                let places = seen.into_iter().map(|k| problem.input.caller_index(k)).collect();
                let others = match geometry.by_observation && verdict.inlier {
                    true => self.others(&observations, &verdict),
                    false => Vec::new(),
                };
                Finding { track, observations, places, verdict, others }
            })
            .collect()
    }

    /// Drops the worst observation of each track as long as it is more likely wrong than right, then weighs what
    /// remains. No more tracks than a [`Batch`] takes.
    fn judge(&self, tracks: &[&[Observation]]) -> Vec<TrackVerdict> {
        let gate = self.noise.gate();
        let mut retained: Vec<Option<Vec<usize>>> =
            tracks.iter().map(|observations| self.retained_at_first(observations, gate)).collect();
        let mut batch = Batch::new(self.cameras, tracks);
        for (lane, (observations, retained)) in tracks.iter().zip(&retained).enumerate() {
            let Some(retained) = retained else { continue };
            let is_left = |k: &usize| retained.binary_search(k).is_err();
            (0..observations.len()).filter(is_left).for_each(|k| batch.drop_observation(lane, k));
        }
        let mut found = batch.refine(batch.linear(), |_| true, OPTIONS.dropping_steps);
        while !self.problem.stop.is_stopped() {
            let worst = |squared: &[[f64; LANES]], lane: usize| {
                let retained = retained.get(lane).and_then(Option::as_ref)?;
                worst_beyond(retained, self.least_retained(tracks[lane]), gate, |k| squared[k][lane])
            };
            let squared = batch.squared_residuals(&found);
            let is_near =
                |lane: usize| worst(&squared, lane).is_some_and(|(_, worst)| worst < OPTIONS.far_gates * gate);
            found = batch.refine(found, is_near, OPTIONS.point_steps);
            let squared = batch.squared_residuals(&found);
            let dropped: [Option<usize>; LANES] =
                std::array::from_fn(|lane| worst(&squared, lane).map(|(place, _)| place));
            if dropped == [None; LANES] {
                break;
            }
            for (lane, (retained, dropped)) in retained.iter_mut().zip(dropped).enumerate() {
                if let (Some(retained), Some(place)) = (retained, dropped) {
                    batch.drop_observation(lane, retained.remove(place));
                }
            }
            let is_dropped = |lane: usize| dropped[lane].is_some();
            found = batch.refine(batch.linear(), is_dropped, OPTIONS.dropping_steps).or(is_dropped, found);
        }
        let can_be_right = |lane: usize| {
            let retained = retained.get(lane).and_then(Option::as_ref);
            retained.is_some_and(|retained| retained.len() >= self.least_retained(tracks[lane]))
        };
        let found = batch.refine(found, can_be_right, OPTIONS.point_steps);
        let verdict = |(lane, (observations, retained)): (usize, (&&[Observation], Option<Vec<usize>>))| {
            let point = found.point(lane);
            match retained {
                Some(retained) => self.weigh(observations, &retained, point, found.cost(lane)),
                // No two observations agree on a point in front of their cameras.
                None => TrackVerdict { weight: 0.0, inlier: false, point, retained: vec![false; observations.len()] },
            }
        };
        tracks.iter().zip(retained).enumerate().map(verdict).collect()
    }

    /// Observations that a track must retain; of one that two views see, both.
    fn least_retained(&self, observations: &[Observation]) -> usize {
        let count = observations.len();
        VERIFIED.max((self.least_share * count as f64).ceil() as usize).min(count)
    }

    /// The verdict on a track by the observations that it retains, with its point at infinity where that fits.
    ///
    /// * `cost`: sum of their weighted squared residuals
    fn weigh(&self, observations: &[Observation], retained: &[usize], point: Point, cost: f64) -> TrackVerdict {
        let (point, cost) = self.at_infinity_if_behind(observations, retained, point).unwrap_or((point, cost));
        let dropped = observations.len() - retained.len();
        // The density of a coordinate of weight w is the root of w times as high where the residual is 0, and the point
        // takes three of the coordinates. What a lens weighs them by goes for wrong observations, too.
        let count = 2.0 * retained.len() as f64;
        let of_weights = retained.iter().map(|&k| self.given_weight(&observations[k]).ln()).sum::<f64>();
        let of_weights = of_weights * (count - 3.0) / count;
        let ln_odds = self.noise.ln_odds(cost, retained.len(), dropped, self.geometry.inlier_share) + of_weights;
        let is_enough = retained.len() >= self.least_retained(observations);
        let weight = if is_enough && cost.is_finite() { 1.0 / (1.0 + (-ln_odds).exp()) } else { 0.0 };
        let gate = self.noise.gate();
        let mut flags = vec![false; observations.len()];
        for &k in retained {
            flags[k] = self.seen_squared(&point, &observations[k]) <= gate;
        }
        let whole = flags.iter().filter(|&&flag| flag).count() >= VERIFIED;
        TrackVerdict { weight, inlier: weight > 0.5 && whole, point, retained: flags }
    }

    /// The point at infinity in place of one that lies behind a camera that retains it, and its cost: what is so far
    /// away that noise has it pass through infinity is seen as well there. `None` for any other point.
    fn at_infinity_if_behind(
        &self,
        observations: &[Observation],
        retained: &[usize],
        point: Point,
    ) -> Option<(Point, f64)> {
        let seen = || retained.iter().map(|&k| &observations[k]);
        if !self.geometry.is_metric || seen().all(|seen| self.seen_squared(&point, seen).is_finite()) {
            return None;
        }
        let depths = seen().map(|seen| (self.cameras[seen.view].fixed_view::<1, 3>(2, 0) * point.xyz()).x.signum());
        let direction = point.xyz() * if depths.sum::<f64>() < 0.0 { -1.0 } else { 1.0 };
        let far = direction.push(0.0).try_normalize(f64::MIN_POSITIVE)?;
        Some((far, seen().map(|seen| self.seen_squared(&far, seen)).sum()))
    }

    /// Weight by the sigma that an observation came with, without that of the lens.
    fn given_weight(&self, seen: &Observation) -> f64 {
        if !self.problem.input.has_sigmas() {
            return 1.0;
        }
        let given = self.problem.of_track(seen.point).find(|&k| self.problem.view_of(k) == seen.view);
        given.map_or(1.0, |k| self.geometry.given_weight(self.problem, k))
    }

    /// Weighted squared residual of an observation of a point, infinite behind a metric camera.
    fn seen_squared(&self, point: &Point, seen: &Observation) -> f64 {
        match self.geometry.is_metric {
            true => squared_in_front(self.cameras, seen, point),
            false => self.squared(point, seen),
        }
    }

    /// The observations that a verdict begins with: all, or those that agree where links may be wrong, which of two
    /// says nothing; `None` where none do.
    fn retained_at_first(&self, observations: &[Observation], gate: f64) -> Option<Vec<usize>> {
        if !self.geometry.by_observation || observations.len() < VERIFIED {
            return Some((0..observations.len()).collect());
        }
        let found = self.triangulator.robust(observations, gate)?;
        Some((0..observations.len()).filter(|&k| found.agrees[k]).collect())
    }

    /// Weighted squared residual of an observation of a point.
    fn squared(&self, point: &Point, seen: &Observation) -> f64 {
        triangulation::weighted_squared(&self.cameras[seen.view], point, seen)
    }

    /// Enters what was found of a track.
    pub fn write(&self, judged: &mut Judged, finding: &Finding) {
        let Finding { track, observations, places, verdict, others } = finding;
        let track = *track;
        if observations.len() < VERIFIED {
            let TrackVerdict { weight, point, .. } = *verdict;
            let found = TrackPoint { track, number: 0, weight, point, retained: observations.clone() };
            judged.two_view_points.extend(Some(found).filter(|_| weight > 0.5));
            return;
        }
        judged.tracks.weight[track] = verdict.weight as f32;
        judged.tracks.inlier[track] = verdict.inlier;
        for ((&place, observation), &retained) in places.iter().zip(observations).zip(&verdict.retained) {
            let squared = self.squared(&verdict.point, observation);
            judged.observations.residual_px[place] =
                Some((squared / self.given_weight(observation)).sqrt() * self.problem.scale_px)
                    .filter(|residual| residual.is_finite());
            let is_in_front = self.seen_squared(&verdict.point, observation).is_finite();
            judged.observations.weight[place] = if is_in_front { self.noise.weight(squared) as f32 } else { 0.0 };
            judged.observations.inlier[place] = verdict.inlier && retained;
        }
        if verdict.inlier {
            let retained = observations.iter().zip(&verdict.retained).filter(|(_, retained)| **retained);
            judged.retained[track] = retained.map(|(observation, _)| *observation).collect();
            judged.points[track] = Some(verdict.point);
        }
        for (number, other) in (1..).zip(others) {
            other.observations.iter().for_each(|&k| judged.observations.split[places[k]] = number);
            let TrackVerdict { weight, point, .. } = other.verdict;
            let retained = chosen(observations, &other.observations);
            judged.splits.push(TrackPoint { track, number, weight, point, retained });
        }
    }

    /// Looks for the other points that a right track joins, among the observations that its own leaves.
    fn others(&self, observations: &[Observation], verdict: &TrackVerdict) -> Vec<Other> {
        let mut left: Vec<usize> = (0..observations.len()).filter(|&k| !verdict.retained[k]).collect();
        let mut others = Vec::new();
        while left.len() >= VERIFIED && !self.problem.stop.is_stopped() {
            let these = chosen(observations, &left);
            let Some(verdict) = self.judge(&[&these]).pop().filter(|verdict| verdict.inlier) else { break };
            let (of_other, rest): (Vec<_>, Vec<_>) = left.iter().zip(&verdict.retained).partition(|(_, kept)| **kept);
            let indices = |these: Vec<(&usize, &bool)>| these.into_iter().map(|(&k, _)| k).collect::<Vec<usize>>();
            let (observations, rest) = (indices(of_other), indices(rest));
            others.push(Other { verdict, observations });
            left = rest;
        }
        others
    }
}

/// Place among the retained observations of the one of the largest squared residual, and that, if it is beyond the
/// gate. A track that cannot retain enough is wrong already and keeps the rest.
fn worst_beyond(retained: &[usize], least: usize, gate: f64, squared: impl Fn(usize) -> f64) -> Option<(usize, f64)> {
    if retained.len() < least.max(VERIFIED + 1) {
        return None;
    }
    let residuals = retained.iter().map(|&k| squared(k)).enumerate();
    residuals.max_by(|a, b| a.1.total_cmp(&b.1)).filter(|(_, worst)| *worst > gate || worst.is_nan())
}

fn chosen(observations: &[Observation], which: &[usize]) -> Vec<Observation> {
    which.iter().map(|&k| observations[k]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector2;

    use crate::domain::{Input, Limits, RawInput, View};
    use crate::parallel::Threads;

    fn cameras(views: usize) -> Vec<Camera> {
        (0..views)
            .map(|view| {
                let t = view as f64;
                Camera::new(1.2, 0.0, 0.0, 0.5 * t, 0.0, 1.2, 0.0, 0.2 * t, 0.0, 0.0, 1.0, 3.0)
            })
            .collect()
    }

    fn geometry(by_observation: bool) -> Geometry {
        Geometry {
            cameras: Vec::new(),
            lenses: Vec::new(),
            is_metric: false,
            component_of_view: Vec::new(),
            component_of_track: Vec::new(),
            by_observation,
            of_static: false,
            noise: 0.001,
            inlier_share: 0.3,
        }
    }

    /// A classifier of tracks that are seen by cameras in a row, under an input of one track in so many views.
    fn classifier(cameras: &[Camera], by_observation: bool) -> TrackClassifier<'static> {
        let (input, settings) = (Box::leak(Box::new(input(cameras.len()))), Box::leak(Box::default()));
        let problem = Box::leak(Box::new(Problem::new(input, settings, Threads::ONE, Box::leak(Box::default()))));
        let cameras: &[Camera] = Box::leak(cameras.to_vec().into_boxed_slice());
        let geometry = Box::leak(Box::new(geometry(by_observation)));
        let noise = NoiseModel::new(geometry.noise, 2.0);
        let least_share = if by_observation { 0.0 } else { 0.6 };
        TrackClassifier { problem, cameras, triangulator: Triangulator::new(cameras), geometry, least_share, noise }
    }

    fn judged(classifier: &TrackClassifier, observations: &[Observation]) -> TrackVerdict {
        classifier.judge(&[observations]).pop().expect("a verdict")
    }

    fn observations(cameras: &[Camera], shifts: &[f64]) -> Vec<Observation> {
        let point = Point::new(0.2, -0.1, 0.5, 1.0);
        cameras
            .iter()
            .zip(shifts)
            .enumerate()
            .map(|(view, (camera, shift))| {
                let image = camera * point;
                Observation::new(view, 0, image.xy() / image.z + Vector2::new(0.3 * shift, *shift))
            })
            .collect()
    }

    #[test]
    fn a_right_track_a_track_with_one_wrong_observation_and_a_wrong_track() {
        let cameras = cameras(6);
        let classifier = classifier(&cameras, false);
        let verdict = |shifts: [f64; 6]| judged(&classifier, &observations(&cameras, &shifts));
        let right = verdict([0.001, -0.001, 0.0005, 0.0, -0.0005, 0.001]);
        assert!(right.inlier && right.weight > 0.999 && right.retained.iter().all(|&kept| kept));
        let one_wrong = verdict([0.0, 0.0, 0.2, 0.0, 0.0, 0.0]);
        assert!(one_wrong.inlier);
        assert_eq!(one_wrong.retained, [true, true, false, true, true, true]);
        let wrong = verdict([0.1, -0.2, 0.15, -0.1, 0.3, -0.05]);
        assert!(!wrong.inlier && wrong.weight < 0.01, "{}", wrong.weight);
    }

    /// To the last bit: of all kinds, of different lengths, with none and several observations to drop.
    #[test]
    fn tracks_side_by_side_get_the_verdicts_that_each_gets_alone() {
        let cameras = cameras(10);
        for by_observation in [false, true] {
            let classifier = classifier(&cameras, by_observation);
            let shifts: [&[f64]; LANES] = [
                &[0.001, -0.001, 0.0005, 0.0, -0.0005, 0.001],
                &[0.0, 0.0, 0.2, 0.0, 0.0, 0.0, 0.0, 0.0, -0.1, 0.0],
                &[0.0005, 0.0, 0.0],
                &[0.1, -0.2, 0.15, -0.1, 0.3, -0.05, 0.25, -0.3],
                &[0.0, 0.001, 0.0, 0.3, 0.0, -0.001, 0.2],
                &[0.3, 0.0, 0.0, 0.0],
                &[0.02, 0.0, 0.0, 0.001, 0.0, -0.001, 0.0, 0.0, 0.0],
                &[0.1, -0.3, 0.2],
            ];
            let tracks = shifts.map(|shifts| observations(&cameras, shifts));
            let together = classifier.judge(&tracks.each_ref().map(Vec::as_slice));
            assert_eq!(together.len(), tracks.len());
            let mut right = 0;
            for (track, together) in tracks.iter().zip(&together) {
                let alone = judged(&classifier, track);
                assert_eq!(
                    (together.weight, together.point),
                    (alone.weight, alone.point),
                    "by observation: {by_observation}"
                );
                assert_eq!(
                    (together.inlier, &together.retained),
                    (alone.inlier, &alone.retained),
                    "by observation: {by_observation}"
                );
                right += usize::from(alone.inlier);
            }
            assert!((3..LANES).contains(&right), "by observation: {by_observation}, {right} are right");
        }
    }

    /// Noise has the rays to a far point part: they meet behind the cameras, or nowhere.
    #[test]
    fn what_is_beyond_infinity_is_at_infinity_and_what_is_behind_is_wrong() {
        let cameras = cameras(6);
        let metric = Box::leak(Box::new(Geometry { is_metric: true, ..geometry(true) }));
        let classifier = TrackClassifier { geometry: metric, ..classifier(&cameras, true) };
        let verdict = |point: Point| {
            let image = |camera: &Camera| (camera * point).xy() / (camera * point).z;
            let seen = cameras.iter().enumerate().map(|(view, camera)| Observation::new(view, 0, image(camera)));
            classifier.weigh(&seen.collect::<Vec<_>>(), &[0, 1, 2, 3, 4, 5], point.normalize(), 0.0)
        };
        let near = verdict(Point::new(0.1, 0.2, 1.0, 0.2));
        assert!(near.inlier && near.point.w > 0.0, "{near:?}");
        let beyond = verdict(Point::new(0.1, 0.2, 1.0, -0.0002));
        assert!(beyond.inlier && beyond.retained == [true; 6], "{beyond:?}");
        assert!(beyond.point.w == 0.0 && beyond.point.z > 0.0, "{beyond:?}");
        let behind = verdict(Point::new(0.1, 0.2, -10.0, 1.0));
        assert!(!behind.inlier, "{behind:?}");
    }

    /// No point in front of both cameras agrees with them, and the one at infinity does.
    #[test]
    fn two_observations_of_what_is_beyond_infinity_are_of_a_point_there() {
        let cameras = cameras(2);
        let metric = Box::leak(Box::new(Geometry { is_metric: true, ..geometry(true) }));
        let classifier = TrackClassifier { geometry: metric, ..classifier(&cameras, true) };
        let beyond = Point::new(0.1, 0.2, 1.0, -0.0002);
        let image = |camera: &Camera| (camera * beyond).xy() / (camera * beyond).z;
        let seen = cameras.iter().enumerate().map(|(view, camera)| Observation::new(view, 0, image(camera)));
        let verdict = judged(&classifier, &seen.collect::<Vec<_>>());
        assert!(verdict.weight > 0.5 && !verdict.inlier && verdict.point.w == 0.0, "{verdict:?}");
    }

    /// No point is in front of cameras that look away from each other, wherever it is.
    #[test]
    fn what_no_camera_has_in_front_weighs_nothing() {
        let ahead = Camera::new(1.2, 0.0, 0.0, 0.0, 0.0, 1.2, 0.0, 0.2, 0.0, 0.0, 1.0, 1.0);
        let back = Camera::new(-1.2, 0.0, 0.0, 0.1, 0.0, 1.2, 0.0, 0.1, 0.0, 0.0, -1.0, -2.0);
        let cameras = [ahead, back, ahead];
        let metric = Box::leak(Box::new(Geometry { is_metric: true, ..geometry(true) }));
        let classifier = TrackClassifier { geometry: metric, ..classifier(&cameras, true) };
        for (x, y) in [(0.0, 0.0), (0.1, -0.2), (0.3, 0.1)] {
            let seen = (0..3).map(|view| Observation::new(view, 0, Vector2::new(x, y + 0.01 * view as f64)));
            let observations: Vec<Observation> = seen.collect();
            let point = Point::new(x, y, 1.0, 0.1);
            let verdict = classifier.weigh(&observations, &[0, 1, 2], point, 1e-6);
            assert!(verdict.weight == 0.0 && !verdict.inlier, "{verdict:?}");
        }
    }

    /// A track that goes over to another point, and one wrong observation between the two.
    #[test]
    fn a_track_that_joins_two_points_is_split_and_one_that_strays_is_not() {
        let cameras = cameras(8);
        let classifier = classifier(&cameras, true);
        let split = |observations: &[Observation]| {
            let mut all = Judged::nothing(classifier.problem.input, classifier.noise);
            let verdict = judged(&classifier, observations);
            assert!(verdict.inlier);
            let others = classifier.others(observations, &verdict);
            let (observations, places) = (observations.to_vec(), (0..8).collect());
            classifier.write(&mut all, &Finding { track: 0, observations, places, verdict, others });
            (all.observations.split, all.splits.len())
        };
        let mut joined = observations(&cameras, &[0.0, 0.0005, -0.0005, 0.0, 0.31, 0.0, 0.0, 0.0]);
        let second = Point::new(-0.5, 0.4, 1.5, 1.0);
        for seen in &mut joined[5..] {
            let image = cameras[seen.view] * second;
            seen.xy = image.xy() / image.z;
        }
        assert_eq!(split(&joined), (vec![0, 0, 0, 0, 0, 1, 1, 1], 1));
        let astray = observations(&cameras, &[0.0, 0.0005, -0.0005, 0.0, 0.31, -0.22, 0.17, -0.4]);
        assert_eq!(split(&astray), (vec![0; 8], 0));
    }

    fn input(views: usize) -> Input {
        let raw = RawInput {
            views: vec![View::default(); views],
            track_count: 1,
            view: (0..views as u32).collect(),
            track: vec![0; views],
            x: (0..views).map(|view| view as f64).collect(),
            y: vec![0.0; views],
            ..RawInput::default()
        };
        Input::new(raw, &Limits::default(), "track").expect("valid")
    }

    #[test]
    fn of_a_linked_track_the_right_run_is_kept_and_nothing_behind_the_cameras() {
        let cameras = cameras(6);
        let joined = observations(&cameras, &[0.0, 0.0005, -0.0005, 0.2, -0.15, 0.31]);
        let verdict = judged(&classifier(&cameras, true), &joined);
        assert!(verdict.inlier, "{}", verdict.weight);
        assert_eq!(verdict.retained, [true, true, true, false, false, false]);
        let behind: Vec<Camera> = cameras.iter().map(|camera| -camera).collect();
        let verdict = judged(&classifier(&behind, true), &observations(&cameras, &[0.0; 6]));
        assert!(!verdict.inlier && verdict.weight == 0.0, "{}", verdict.weight);
    }
}
