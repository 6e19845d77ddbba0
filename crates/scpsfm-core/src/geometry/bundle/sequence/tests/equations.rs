//! The normal equations against finite differences, and the places of the blocks.

use nalgebra::{DMatrix, DVector};

use super::super::layout::Layout;
use super::super::minimise::retract;
use super::super::normal::Normal;
use super::super::pattern::Pattern;
use super::super::reduced::Reduced;
use super::super::worker_pool::BATCH;
use super::super::worker_pool::WorkerPool;
use super::*;
use crate::domain::{LensProjection, StopReason};
use crate::geometry::bundle::Loss;
use crate::geometry::bundle::metric::{Extension, Parameter};

/// Three groups, one of them held, a held view, unequal weights.
fn mixed() -> (MetricReconstruction, Vec<Observation>, Vec<IntrinsicsModel>, Vec<bool>) {
    let (mut sequence, mut observations) = chain(1, 7, 3, 4, 0.003);
    sequence.group_of = vec![0, 0, 1, 1, 2, 2, 0];
    sequence.intrinsics = vec![Intrinsics::from_focal(1.1), Intrinsics::from_focal(0.9), Intrinsics::from_focal(1.3)];
    sequence.intrinsics[0].radial = [-0.1, 0.05, 0.02];
    sequence.intrinsics[0].tangential = [0.01, -0.02];
    sequence.intrinsics[0].aspect = 1.1;
    observe(&sequence, &mut observations, 0.003, 1);
    observations.iter_mut().enumerate().for_each(|(k, seen)| seen.weight = 0.5 + 0.1 * (k % 7) as f64);
    // The same point a second time in one view.
    observations.push(observations[5]);
    let models =
        vec![IntrinsicsModel::FULL, IntrinsicsModel::FIXED, IntrinsicsModel::FOCAL.with(Extension::PrincipalPoint)];
    let views = (0..7).map(|view| view != 3).collect();
    (sequence, observations, models, views)
}

fn laid_out(sequence: &MetricReconstruction, observations: &[Observation], free: &Free) -> (Layout, Pattern) {
    let layout = Layout::new(sequence, observations, free);
    let pattern = Pattern::new(sequence, &layout, &StopToken::default()).expect("goes on");
    (layout, pattern)
}

/// Weighted residuals and their derivatives by central differences through the retraction: unknowns of the cameras,
/// then of the points.
fn differentiate(
    sequence: &MetricReconstruction,
    observations: &[Observation],
    layout: &Layout,
) -> (DVector<f64>, DMatrix<f64>) {
    const WIDTH: f64 = 1e-6;
    let cameras = layout.unknowns.offsets[layout.unknowns.block_count()];
    let residuals = |sequence: &MetricReconstruction| {
        let weighted = |seen: &Observation| sequence.residual(seen) * seen.weight.sqrt();
        DVector::from_iterator(
            2 * observations.len(),
            observations.iter().flat_map(|seen| <[f64; 2]>::from(weighted(seen))),
        )
    };
    let moved = |unknown: usize, by: f64| {
        let mut moved = sequence.clone();
        let mut step = vec![0.0; cameras];
        if unknown < cameras {
            step[unknown] = by;
            assert!(retract(&mut moved, sequence, layout, &step));
        } else {
            moved.points[(unknown - cameras) / 3][(unknown - cameras) % 3] += by;
        }
        residuals(&moved)
    };
    let columns: Vec<_> = (0..cameras + 3 * sequence.points.len())
        .map(|unknown| (moved(unknown, WIDTH) - moved(unknown, -WIDTH)) / (2.0 * WIDTH))
        .collect();
    (residuals(sequence), DMatrix::from_columns(&columns))
}

#[test]
fn normal_equations_agree_with_finite_differences() {
    let (sequence, observations, models, views) = mixed();
    compare(&sequence, &observations, &models, &views, 6 * 6 + 9 + 3, "six views, nine and three intrinsics");
    // Two views with focal lengths of their own behind one lens.
    let (mut sequence, mut observations, mut models, views) = mixed();
    sequence.focals = vec![1.0, 1.1, 0.9, 1.0, 1.2, 1.3, 1.1];
    models[2] = IntrinsicsModel::FOCAL_PER_VIEW.with(Extension::RadialK1);
    observe(&sequence, &mut observations, 0.003, 1);
    compare(&sequence, &observations, &models, &views, 6 * 6 + 2 + 9 + 1, "two more unknowns of views");
    sequence.intrinsics.iter_mut().for_each(|lens| lens.projection = LensProjection::Fisheye);
    observe(&sequence, &mut observations, 0.003, 1);
    compare(&sequence, &observations, &models, &views, 6 * 6 + 2 + 9 + 1, "fisheyes");
    sequence.intrinsics.iter_mut().for_each(|lens| lens.projection = LensProjection::Perspective);
    observe(&sequence, &mut observations, 0.003, 1);
    models[2] = IntrinsicsModel::FOCAL_PER_VIEW.with_all_extensions();
    compare(&sequence, &observations, &models, &views, 6 * 6 + 2 + 9 + 8, "all that a lens has");
}

/// Sparse, square and pair by pair, and by panels.
#[test]
fn every_layout_of_the_system_is_the_same_system() {
    let scene = crate::geometry::bundle::testing::scene(1, 6, 200, 0.003);
    let (sequence, mut observations) = sequence_of(&scene);
    observations.retain(|seen| (seen.point + seen.view) % 7 != 0 && seen.point != 5);
    observations.push(observations[0]);
    let stop = StopToken::default();
    let models = [IntrinsicsModel::FOCAL];
    let layout = Layout::new(&sequence, &observations, &Free::all(&models));
    let pool = WorkerPool::new(&layout, Threads::ONE, &stop);
    let mut built = Vec::new();
    for by_panels in [None, Some(false), Some(true)] {
        let pattern = match by_panels {
            None => Pattern::sparse(&sequence, &layout, &stop),
            Some(_) => Pattern::new(&sequence, &layout, &stop),
        };
        let pattern = pattern.expect("goes on");
        assert_eq!(pattern.is_square, by_panels.is_some());
        let mut normal = Normal::new(&layout, &pattern, &sequence);
        assert!(normal.fill(&sequence, &[], Loss::Squared, &pool));
        let mut reduced = Reduced::new(&layout, pattern);
        reduced.by_panels = by_panels == Some(true);
        assert!(reduced.build(&normal, 1e-3, &pool));
        let mut matrix = DMatrix::zeros(37, 37);
        reduced.pattern.for_each(|row, column, index| {
            if row >= column {
                matrix[(row, column)] = reduced.values[index];
            }
        });
        built.push((matrix, DVector::from_column_slice(&reduced.vector)));
    }
    for (matrix, vector) in &built[1..] {
        assert!((matrix - &built[0].0).amax() < 1e-11 * built[0].0.amax());
        assert!((vector - &built[0].1).amax() < 1e-11 * built[0].1.amax());
    }
}

fn compare(
    sequence: &MetricReconstruction,
    observations: &[Observation],
    models: &[IntrinsicsModel],
    views: &[bool],
    unknowns: usize,
    what: &str,
) {
    let free = Free { models, views: Some(views) };
    let (layout, pattern) = laid_out(sequence, observations, &free);
    let cameras = pattern.unknowns.count();
    assert_eq!(cameras, unknowns, "{what}");
    let mut normal = Normal::new(&layout, &pattern, sequence);
    let stop = StopToken::default();
    assert!(normal.fill(sequence, &[], Loss::Squared, &WorkerPool::new(&layout, Threads::ONE, &stop)));
    let (residuals, jacobian) = differentiate(sequence, observations, &layout);
    let information = jacobian.transpose() * &jacobian;
    let gradient = jacobian.transpose() * residuals;
    let close = |found: f64, expected: f64, what: &str| {
        let error = (found - expected).abs();
        assert!(error < 1e-6 * (1.0 + information.amax()), "{what}: {found} instead of {expected}");
    };
    let mut among = DMatrix::zeros(cameras, cameras);
    pattern.for_each(|row, column, index| among[(row.max(column), row.min(column))] = normal.values[index]);
    for column in 0..cameras {
        close(normal.gradient[column], gradient[column], "gradient");
        for row in column..cameras {
            close(among[(row, column)], information[(row, column)], "cameras");
        }
    }
    for (point, block) in normal.points.iter().enumerate() {
        let first = cameras + 3 * point;
        let mut coupling = DMatrix::zeros(cameras, 3);
        for incident in layout.incident_blocks(point) {
            let range = layout.unknowns.range(incident.block as usize);
            let values = &normal.couplings[layout.couplings_of(point..point + 1)][incident.coupling as usize..];
            for (k, unknown) in range.clone().enumerate() {
                (0..3).for_each(|column| coupling[(unknown, column)] = values[column * range.len() + k]);
            }
        }
        (0..3).for_each(|k| close(block.gradient[k], gradient[first + k], "gradient of a point"));
        for (row, value) in coupling.column_iter().enumerate() {
            (0..cameras).for_each(|unknown| close(value[unknown], information[(unknown, first + row)], "coupling"));
        }
    }
}

#[test]
fn what_is_known_beforehand_takes_part() {
    let (sequence, observations, models, ..) = mixed();
    let prior = IntrinsicsPrior::NONE.knowing(Parameter::LogFocal, 0.2, 0.1, 0.01);
    let (layout, pattern) = laid_out(&sequence, &observations, &Free::all(&models));
    let with = |priors: &[IntrinsicsPrior]| {
        let mut normal = Normal::new(&layout, &pattern, &sequence);
        let stop = StopToken::default();
        let pool = WorkerPool::new(&layout, Threads::ONE, &stop);
        assert!(normal.fill(&sequence, priors, Loss::Squared, &pool));
        let block = layout.unknowns.group_block[2].expect("free");
        let unknown = layout.unknowns.range(block).start;
        (normal.values[normal.diagonal[unknown]], normal.gradient[unknown])
    };
    let (information, gradient) = with(&[]);
    let (informed, pulled) = with(&[prior, prior, prior]);
    let deviation = 1.3f64.ln() - 0.2;
    assert!((informed - information - 0.01).abs() < 1e-9 && (pulled - gradient - 0.01 * deviation).abs() < 1e-9);
}

#[test]
fn what_is_stopped_before_it_begins_changes_nothing() {
    let (sequence, observations) = chain(2, 10, 1 + BATCH / 20, 5, 0.001);
    let free = Free::all(&[IntrinsicsModel::FOCAL]);
    let (layout, pattern) = laid_out(&sequence, &observations, &free);
    let mut normal = Normal::new(&layout, &pattern, &sequence);
    let stop = StopToken::default();
    stop.stop(StopReason::Cancelled);
    for threads in [1, 3] {
        let pool = WorkerPool::new(&layout, Threads::new(threads), &stop);
        assert!(!normal.fill(&sequence, &[], Loss::Squared, &pool), "{threads} threads");
        assert_eq!(pool.of_points(Some), None, "{threads} threads");
    }
    let mut start = sequence.clone();
    let report = adjust(&mut start, &observations, &free, &[], &Options::DEFAULT, quiet(&stop, &mut || ()));
    assert_eq!((report.iterations, report.cost), (0, report.initial_cost));
    assert_eq!(start, sequence);
}
