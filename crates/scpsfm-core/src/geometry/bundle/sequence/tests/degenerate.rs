//! Input that determines little or nothing, or is no number.

use super::*;
use crate::geometry::bundle::Loss;

fn run(mut sequence: MetricReconstruction, observations: &[Observation]) -> MetricReconstruction {
    for model in
        [IntrinsicsModel::FIXED, IntrinsicsModel::FOCAL, IntrinsicsModel::FOCAL_PER_VIEW, IntrinsicsModel::FULL]
    {
        for loss in [Loss::Squared, Loss::Cauchy { scale: 0.003 }] {
            let models = vec![model; sequence.intrinsics.len()];
            let options = Options { loss, ..Options::DEFAULT };
            let report = adjusted(&mut sequence, observations, &models, &options);
            assert!(report.cost.is_finite() && report.cost <= report.initial_cost, "{report:?}");
        }
    }
    sequence
}

fn is_finite(sequence: &MetricReconstruction) -> bool {
    let poses = sequence.poses.iter().flat_map(|pose| pose.rotation.iter().chain(pose.translation.iter()));
    let points = sequence.points.iter().flat_map(|point| point.iter());
    poses.chain(points).all(|value| value.is_finite())
        && sequence.intrinsics.iter().all(|intrinsics| intrinsics.focal.is_finite() && intrinsics.focal > 0.0)
}

#[test]
fn little_or_odd_input_neither_panics_nor_yields_nan() {
    for views in [6, 60] {
        let (truth, observations) = chain(1, views, 4, 4, 0.001);
        assert!(is_finite(&run(truth.clone(), &[])));
        let empty = MetricReconstruction {
            intrinsics: vec![],
            focals: vec![],
            group_of: vec![],
            poses: vec![],
            points: vec![],
            has_common_centre: false,
        };
        run(empty, &observations);
        // One view a track: nothing is determined.
        let alone: Vec<Observation> =
            observations.iter().filter(|seen| seen.view == seen.point % views).copied().collect();
        assert!(is_finite(&run(truth.clone(), &alone)));
        // Depth zero, far away, all points in one place, a view that sees a single point, groups without views.
        let mut odd = truth.clone();
        odd.points[0] = odd.poses[0].rotation.tr_mul(&-odd.poses[0].translation);
        odd.points[1] *= 1e9;
        odd.intrinsics = vec![odd.intrinsics[0]; 3];
        odd.group_of[1] = 2;
        let few: Vec<Observation> =
            observations.iter().filter(|seen| seen.view != 2 || seen.point == 3).copied().collect();
        assert!(is_finite(&run(odd, &few)));
        let mut collapsed = truth.clone();
        collapsed.points.fill(Vector3::new(0.0, 0.0, 4.0));
        assert!(is_finite(&run(collapsed, &observations)));
        let mut still = truth.clone();
        still.poses.fill(truth.poses[0]);
        assert!(is_finite(&run(still, &observations)));
    }
}

#[test]
fn what_is_no_number_or_out_of_range_is_left_alone() {
    for views in [6, 60] {
        let (truth, mut observations) = chain(2, views, 4, 4, 0.001);
        let mut start = perturbed(&truth, 0.005, 2);
        let (mut same, clean) = (start.clone(), observations.clone());
        let first = observations[0];
        observations.push(Observation { view: views, ..first });
        observations.push(Observation { point: truth.points.len(), ..first });
        observations.push(Observation { xy: Vector2::new(f64::NAN, 0.0), ..first });
        for weight in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            observations.push(Observation { weight, ..first });
        }
        let models = [IntrinsicsModel::FOCAL];
        let report = adjusted(&mut start, &observations, &models, &Options::DEFAULT);
        assert_eq!(report, adjusted(&mut same, &clean, &models, &Options::DEFAULT));
        assert_eq!(start, same);

        let mut broken = perturbed(&truth, 0.005, 2);
        broken.poses[1].translation.fill(f64::NAN);
        broken.points[2].fill(f64::INFINITY);
        let broken = run(broken, &observations);
        assert!(broken.poses[0].translation.iter().all(|value| value.is_finite()));
        // A view without a group.
        let mut ungrouped = truth.clone();
        ungrouped.group_of[3] = 7;
        ungrouped.group_of.pop();
        run(ungrouped.clone(), &observations);
        // And one without a focal length where views have their own.
        ungrouped.focals = vec![1.1; views - 1];
        run(ungrouped, &observations);
    }
}
