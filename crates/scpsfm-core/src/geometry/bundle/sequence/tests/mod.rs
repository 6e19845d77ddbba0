//! What the tests of sequences share: chains of views with short tracks, and perturbed starts.

mod adjust;
mod degenerate;
mod equations;
mod measure;

use nalgebra::{Rotation3, Vector2, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::super::metric::{Intrinsics, IntrinsicsModel, IntrinsicsPrior, MetricReconstruction, Pose};
use super::super::testing::{TestScene, normal, perturbed};
use super::super::{Options, Report};
use super::{Free, Observation, Run, adjust};
use crate::domain::StopToken;
use crate::parallel::Threads;

/// Distance between the views of a chain, as a share of the depth of what they see about a tenth.
const BASELINE: f64 = 0.4;

fn quiet<'a>(stop: &'a StopToken, heartbeat: &'a mut dyn FnMut()) -> Run<'a> {
    Run { threads: Threads::ONE, stop, heartbeat }
}

/// Views on a line that sways and turns, each track seen by `length` neighbours, `tracks_a_view` beginning in each.
fn chain(
    seed: u64,
    views: usize,
    tracks_a_view: usize,
    length: usize,
    noise: f64,
) -> (MetricReconstruction, Vec<Observation>) {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut uniform = |range: f64| rng.random_range(-range..range);
    let poses: Vec<Pose> = (0..views)
        .map(|view| {
            let centre = Vector3::new(BASELINE * view as f64, uniform(0.3), uniform(0.3));
            let rotation = Rotation3::from_euler_angles(uniform(0.25), uniform(0.25), uniform(0.5)).into_inner();
            Pose { rotation, translation: -rotation * centre }
        })
        .collect();
    let mut sequence = MetricReconstruction::new(Intrinsics::from_focal(1.1), poses, vec![]);
    let mut observations = Vec::new();
    for first in 0..=views - length {
        for _ in 0..tracks_a_view {
            let middle = BASELINE * (first as f64 + 0.5 * (length as f64 - 1.0));
            let point = sequence.points.len();
            sequence.points.push(Vector3::new(middle + uniform(1.0), uniform(1.0), 4.0 + uniform(1.5)));
            let see = |view| Observation { view, point, xy: Vector2::zeros(), weight: 1.0 };
            observations.extend((first..first + length).map(see));
        }
    }
    observe(&sequence, &mut observations, noise, seed);
    (sequence, observations)
}

/// Draws the image points anew.
fn observe(sequence: &MetricReconstruction, observations: &mut [Observation], noise: f64, seed: u64) {
    let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0x5eed);
    for seen in observations {
        seen.xy = Vector2::zeros();
        seen.xy = sequence.residual(seen) + noise * Vector2::new(normal(&mut rng), normal(&mut rng));
    }
}

fn sequence_of(scene: &TestScene) -> (MetricReconstruction, Vec<Observation>) {
    (scene.reconstruction(), scene.observations.clone())
}

/// The chain bent to an arc of so many radians, as a reconstruction drifts that grows view by view.
fn bent(straight: &MetricReconstruction, angle: f64) -> MetricReconstruction {
    let length = BASELINE * straight.poses.len() as f64;
    let radius = length / angle;
    // Rotation and shift of what is so far along the line.
    let bend = |along: f64| {
        let angle = along / radius;
        let rotation = Rotation3::from_axis_angle(&Vector3::y_axis(), angle).into_inner();
        let on_arc = radius * Vector3::new(angle.sin(), 0.0, angle.cos() - 1.0);
        (rotation, on_arc - rotation * Vector3::new(along, 0.0, 0.0))
    };
    let mut bent = straight.clone();
    for pose in &mut bent.poses {
        let centre = -pose.rotation.tr_mul(&pose.translation);
        let (rotation, shift) = bend(centre.x);
        pose.rotation *= rotation.transpose();
        pose.translation = -pose.rotation * (rotation * centre + shift);
    }
    for point in &mut bent.points {
        let (rotation, shift) = bend(point.x);
        *point = rotation * *point + shift;
    }
    bent
}

/// To the last digit.
fn thorough() -> Options {
    Options { max_iterations: 100, relative_tolerance: 1e-14, ..Options::DEFAULT }
}

fn adjusted(
    sequence: &mut MetricReconstruction,
    observations: &[Observation],
    models: &[IntrinsicsModel],
    options: &Options,
) -> Report {
    let priors = vec![IntrinsicsPrior::NONE; models.len()];
    adjust(sequence, observations, &Free::all(models), &priors, options, quiet(&StopToken::default(), &mut || ()))
}
