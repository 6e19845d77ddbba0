//! Adjustment of a problem by dense normal equations: of the system of the cameras that is left when the points are
//! eliminated.
//!
//! With `V = Jp' Jp` damped and factored as `L L'`, and `Q = L^-1 Jp'`, the reduced system is `Jc' (I - Q' Q) Jc`:
//! every pair of observations of a point adds `Jc_a' (d_ab I - Q_a' Q_b) Jc_b`, a product through 2x2 blocks. That
//! costs half of what the product of the 12x4 blocks `Jc' Jp` costs and is linear in the points. Where most cameras see
//! a point, that product (`Jc' Q'` times its transpose) is nevertheless three times as fast.

use std::marker::PhantomData;
use std::ops::Range;

use nalgebra::{Cholesky, Const, Matrix2, SMatrix, SVector, Vector2};

use super::camera_elimination::{self, CameraElimination};
use super::dense::{self, PANEL_COLUMNS, PANEL_SHARE};
use super::problem::{BundleProblem, Jacobian, Layout, Step, UNDEFINED_SQUARED, usable_squared_norm};
use super::{Loss, Observation, Options, Report};
use crate::domain::StopToken;
use crate::geometry::levenberg_marquardt::{self, LeastSquares};
use crate::simd::vectorised;

/// Damping of the reduced system beside Marquardt's, as a share of its mean diagonal: holds the gauge (15 directions
/// of a projective, 7 of a metric reconstruction) at a thousandth of what observed directions weigh at worst.
const GAUGE_DAMPING: f64 = 1e-9;
/// Least diagonal of a point's block as a share of its trace, for points whose position nothing determines.
pub(super) const POINT_DAMPING: f64 = 1e-12;

/// Minimises the loss over all unknowns, starting from and ending in `problem`.
///
/// The cost never rises. `stop` is asked before every damped solve; a stopped, stuck or degenerate problem keeps its
/// last good state.
pub(crate) fn minimise<const C: usize, const P: usize>(
    problem: &mut impl BundleProblem<C, P>,
    observations: &[Observation],
    options: &Options,
    stop: &StopToken,
) -> Report {
    let (cameras, points) = problem.counts();
    let layout = Layout::new(observations, cameras, points);
    if !camera_elimination::is_worth_it(problem, &layout) {
        return descend(problem, &layout, options, stop);
    }
    let layout = camera_elimination::layout(&layout, cameras);
    let mut exchanged = CameraElimination(problem.clone());
    let report = descend(&mut exchanged, &layout, options, stop);
    *problem = exchanged.0;
    report
}

/// The loop, eliminating what the problem calls points.
pub(super) fn descend<const C: usize, const P: usize, T: BundleProblem<C, P>>(
    problem: &mut T,
    layout: &Layout,
    options: &Options,
    stop: &StopToken,
) -> Report {
    let (cameras, _) = problem.counts();
    let mut equations = NormalEquations::<C, P, T>::new(layout, cameras, options.loss);
    levenberg_marquardt::minimise(&mut equations, problem, options, stop)
}

/// The linearisation at one state, and the reduced system with the scratch to build and solve it.
struct NormalEquations<'a, const C: usize, const P: usize, T> {
    problem: PhantomData<T>,
    layout: &'a Layout,
    loss: Loss,
    /// With their robust weights; zero for an undefined observation.
    residuals: Vec<Vector2<f64>>,
    jacobians: Vec<Jacobian<C, P>>,
    /// Of the diagonal blocks of `J' J`.
    camera_diagonals: Vec<SVector<f64, C>>,
    point_blocks: Vec<SMatrix<f64, P, P>>,
    /// The reduced system, square and column-major, lower triangle; unknowns camera after camera.
    matrix: Vec<f64>,
    /// Right-hand side, then solution.
    vector: Vec<f64>,
    factors: Vec<Option<Cholesky<f64, Const<P>>>>,
    /// `Q_a = L^-1 Jp_a'` for the observations of one point.
    whitened: Vec<SMatrix<f64, P, 2>>,
    /// Residuals of one point, linearised, after the cameras' part of a step.
    moved: Vec<Vector2<f64>>,
    /// `Jc' Q'` of some points side by side, `C` rows a camera and `P` columns a point, column-major: times its own
    /// transpose it is what eliminating the points takes off the camera blocks, by one product that runs at the
    /// processor's full speed. `None` where a point is seen by few of the cameras: pair by pair is then cheaper.
    panel: Option<Vec<f64>>,
    step: Step<C, P>,
}

impl<const C: usize, const P: usize, T: BundleProblem<C, P>> LeastSquares for NormalEquations<'_, C, P, T> {
    type State = T;

    fn cost(&self, problem: &T) -> f64 {
        let mut sum = 0.0;
        for seen in &self.layout.observations {
            let (residual, _) = problem.evaluate(*seen);
            sum += self.loss.cost(seen.weight * usable_squared_norm(&residual).unwrap_or(UNDEFINED_SQUARED));
        }
        sum
    }

    fn linearise(&mut self, problem: &T) {
        self.camera_diagonals.fill(SVector::zeros());
        self.point_blocks.fill(SMatrix::zeros());
        for (k, seen) in self.layout.observations.iter().enumerate() {
            let (residual, jacobian) = (&mut self.residuals[k], &mut self.jacobians[k]);
            let (unweighted, derivatives) = problem.evaluate(*seen);
            match usable_squared_norm(&unweighted) {
                Some(squared) => {
                    let weight = seen.weight.sqrt() * self.loss.root_weight(seen.weight * squared);
                    *residual = unweighted * weight;
                    *jacobian = derivatives();
                    jacobian.camera *= weight;
                    jacobian.point *= weight;
                }
                None => {
                    *residual = Vector2::zeros();
                    *jacobian = Jacobian::zeros();
                }
            }
            for component in 0..2 {
                let camera = jacobian.camera.column(component);
                self.camera_diagonals[seen.view] += camera.component_mul(&camera);
            }
            self.point_blocks[seen.point] += jacobian.point * jacobian.point.transpose();
        }
    }

    fn step(&mut self, from: &T, damping: f64, to: &mut T) -> Option<f64> {
        let is_built = vectorised(
            #[inline(always)]
            || self.eliminate_points(from, damping),
        );
        if !is_built {
            return None;
        }
        self.damp(from, damping);
        if !dense::solve(&mut self.matrix, &mut self.vector) {
            return None;
        }
        for (camera, values) in self.step.cameras.iter_mut().zip(self.vector.chunks_exact(C)) {
            camera.copy_from_slice(values);
        }
        let predicted = self.substitute_points();
        self.step.is_finite().then(|| to.retract(from, &self.step))?;
        Some(predicted)
    }
}

impl<'a, const C: usize, const P: usize, T: BundleProblem<C, P>> NormalEquations<'a, C, P, T> {
    fn new(layout: &'a Layout, cameras: usize, loss: Loss) -> Self {
        let (observations, points) = (layout.observations.len(), layout.starts.len() - 1);
        let dimension = C * cameras;
        let by_panels = observations as f64 >= PANEL_SHARE * (cameras * points) as f64;
        Self {
            problem: PhantomData,
            layout,
            loss,
            residuals: vec![Vector2::zeros(); observations],
            jacobians: vec![Jacobian::zeros(); observations],
            camera_diagonals: vec![SVector::zeros(); cameras],
            point_blocks: vec![SMatrix::zeros(); points],
            matrix: vec![0.0; dimension * dimension],
            vector: vec![0.0; dimension],
            factors: vec![None; points],
            whitened: Vec::new(),
            moved: Vec::new(),
            panel: by_panels.then(|| Vec::with_capacity(dimension * (PANEL_COLUMNS + P))),
            step: Step::zeros(cameras, points),
        }
    }

    /// Builds the reduced system; `false` when a point's block cannot be factored.
    #[inline(always)]
    fn eliminate_points(&mut self, problem: &T, damping: f64) -> bool {
        let dimension = self.vector.len();
        self.matrix.fill(0.0);
        self.vector.fill(0.0);
        // What an attempt left that ended before.
        self.panel.iter_mut().for_each(Vec::clear);
        for point in 0..self.factors.len() {
            let range = self.layout.starts[point]..self.layout.starts[point + 1];
            let mut block = self.point_blocks[point];
            let trace = block.trace();
            for k in 0..P {
                block[(k, k)] += damping * block[(k, k)] + POINT_DAMPING * trace + f64::MIN_POSITIVE;
            }
            let gauge = problem.point_gauge(point);
            block += gauge * gauge.transpose() * trace;
            self.factors[point] = Cholesky::new(block);
            let Some(factor) = &self.factors[point] else { return false };
            self.whitened.clear();
            for jacobian in &self.jacobians[range.clone()] {
                let mut whitened = jacobian.point;
                factor.l_dirty().solve_lower_triangular_mut(&mut whitened);
                self.whitened.push(whitened);
            }
            self.add_gradient(range.clone());
            let Some(panel) = &mut self.panel else {
                self.add_camera_pairs(range);
                continue;
            };
            let (observations, jacobians) = (&self.layout.observations[range.clone()], &self.jacobians[range]);
            push_columns(panel, dimension, observations, jacobians, &self.whitened);
            if panel.len() >= dimension * PANEL_COLUMNS {
                dense::subtract_panel(panel, dimension, &mut self.matrix);
                panel.clear();
            }
            // `Jc' Jc`, all that the camera blocks are but for the points.
            for (seen, Jacobian { camera, .. }) in observations.iter().zip(jacobians) {
                add_block(&mut self.matrix, dimension, (seen.view, seen.view), camera, &Matrix2::identity(), camera);
            }
        }
        if let Some(panel) = &self.panel {
            dense::subtract_panel(panel, dimension, &mut self.matrix);
        }
        true
    }

    /// The right-hand side of the observations of a point.
    #[inline(always)]
    fn add_gradient(&mut self, range: Range<usize>) {
        let mut whitened_gradient = SVector::<f64, P>::zeros();
        for (whitened, residual) in self.whitened.iter().zip(&self.residuals[range.clone()]) {
            whitened_gradient += whitened * residual;
        }
        for (k, whitened) in range.zip(&self.whitened) {
            let left = self.residuals[k] - whitened.tr_mul(&whitened_gradient);
            let first = C * self.layout.observations[k].view;
            let gradient = self.jacobians[k].camera * left;
            for (slot, value) in self.vector[first..first + C].iter_mut().zip(gradient.iter()) {
                *slot -= value;
            }
        }
    }

    /// The blocks between the cameras that see a point, lower triangle.
    #[inline(always)]
    fn add_camera_pairs(&mut self, range: Range<usize>) {
        let (observations, jacobians) = (&self.layout.observations[range.clone()], &self.jacobians[range]);
        let (matrix, dimension) = (&mut self.matrix, self.vector.len());
        for a in 0..observations.len() {
            for b in 0..=a {
                let mut through = -self.whitened[a].tr_mul(&self.whitened[b]);
                if a == b {
                    through += Matrix2::identity();
                }
                let views @ (row, column) = (observations[a].view, observations[b].view);
                let (left, right) = (&jacobians[a].camera, &jacobians[b].camera);
                add_block(matrix, dimension, views, left, &through, right);
                // Two observations of one point in one view: the exchanged pair falls into the same block.
                if a != b && row == column {
                    add_block(matrix, dimension, views, right, &through.transpose(), left);
                }
            }
        }
    }

    /// Marquardt's damping, and what holds the gauge.
    fn damp(&mut self, problem: &T, damping: f64) {
        let dimension = self.vector.len();
        let diagonal = |index: usize| self.camera_diagonals[index / C][index % C];
        let mean = (0..dimension).map(diagonal).sum::<f64>() / dimension as f64;
        for index in 0..dimension {
            self.matrix[index * (dimension + 1)] +=
                damping * diagonal(index) + GAUGE_DAMPING * mean + f64::MIN_POSITIVE;
        }
        for (camera, diagonal) in self.camera_diagonals.iter().enumerate() {
            let gauge = problem.camera_gauge(camera);
            let weight = diagonal.sum() / C as f64;
            let first = C * camera;
            for k in 0..C {
                let start = (first + k) * dimension + first;
                for (slot, value) in self.matrix[start..start + C].iter_mut().zip(gauge.iter()) {
                    *slot += weight * gauge[k] * value;
                }
            }
        }
    }

    /// The points' part of the step, `-V^-1 Jp' (r + Jc dc)`.
    ///
    /// Returns by how much the linearised residuals shrink under the whole step, `|r|^2 - |r + J d|^2`.
    fn substitute_points(&mut self) -> f64 {
        let (layout, step) = (self.layout, &mut self.step);
        let mut predicted = 0.0;
        for (point, factor) in self.factors.iter().enumerate() {
            let mut gradient = SVector::<f64, P>::zeros();
            self.moved.clear();
            for k in layout.starts[point]..layout.starts[point + 1] {
                let jacobian = &self.jacobians[k];
                let moved = self.residuals[k] + jacobian.camera.tr_mul(&step.cameras[layout.observations[k].view]);
                gradient -= jacobian.point * moved;
                self.moved.push(moved);
            }
            if let Some(factor) = factor {
                factor.solve_mut(&mut gradient);
            }
            step.points[point] = gradient;
            for (k, moved) in (layout.starts[point]..).zip(&self.moved) {
                let left = moved + self.jacobians[k].point.tr_mul(&gradient);
                predicted += self.residuals[k].norm_squared() - left.norm_squared();
            }
        }
        predicted
    }
}

/// Appends a point's columns to a panel of so many rows.
#[inline(always)]
fn push_columns<const C: usize, const P: usize>(
    panel: &mut Vec<f64>,
    rows: usize,
    observations: &[Observation],
    jacobians: &[Jacobian<C, P>],
    whitened: &[SMatrix<f64, P, 2>],
) {
    let first = panel.len();
    panel.resize(first + rows * P, 0.0);
    for ((seen, jacobian), whitened) in observations.iter().zip(jacobians).zip(whitened) {
        let [u, v] = &jacobian.camera.data.0;
        for k in 0..P {
            let (x, y) = (whitened[(k, 0)], whitened[(k, 1)]);
            let start = first + k * rows + C * seen.view;
            if let Some(slots) = panel[start..].first_chunk_mut::<C>() {
                for ((slot, u), v) in slots.iter_mut().zip(u).zip(v) {
                    *slot += u * x + v * y;
                }
            }
        }
    }
}

/// Adds `left through right'` to the block of two cameras of a square matrix.
#[inline(always)]
fn add_block<const C: usize>(
    matrix: &mut [f64],
    dimension: usize,
    (row, column): (usize, usize),
    left: &SMatrix<f64, C, 2>,
    through: &Matrix2<f64>,
    right: &SMatrix<f64, C, 2>,
) {
    let ([first, second], [u, v]) = (&left.data.0, &right.data.0);
    for (k, (u, v)) in u.iter().zip(v).enumerate() {
        let x = through.m11 * u + through.m12 * v;
        let y = through.m21 * u + through.m22 * v;
        let start = (C * column + k) * dimension + C * row;
        if let Some(slots) = matrix[start..].first_chunk_mut::<C>() {
            for ((slot, first), second) in slots.iter_mut().zip(first).zip(second) {
                *slot += first * x + second * y;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::projective::Projective;
    use super::super::testing;
    use super::*;

    /// More points than a panel holds, some of them missing in some views and one seen twice in the same.
    #[test]
    fn panels_and_pairs_build_the_same_system() {
        let scene = testing::scene(1, 5, 150, testing::NOISE);
        let mut seen: Vec<Observation> =
            scene.observations.iter().copied().filter(|seen| (seen.point + seen.view) % 7 != 0).collect();
        seen.push(Observation { xy: seen[0].xy + Vector2::new(0.01, 0.0), ..seen[0] });
        let problem =
            Projective { cameras: scene.cameras(), points: scene.points.iter().map(|point| point.push(1.0)).collect() };
        let layout = Layout::new(&seen, 5, 150);
        let build = |by_panels: bool| {
            let mut equations = NormalEquations::<12, 4, Projective>::new(&layout, 5, Loss::Squared);
            equations.panel = by_panels.then(Vec::new);
            equations.linearise(&problem);
            assert!(equations.eliminate_points(&problem, 1e-3));
            (equations.matrix, equations.vector)
        };
        let ((panels, right), (pairs, expected)) = (build(true), build(false));
        assert_eq!(right, expected);
        let largest = pairs.iter().fold(0.0f64, |largest, value| largest.max(value.abs()));
        for column in 0..60 {
            for row in column..60 {
                let (a, b) = (panels[60 * column + row], pairs[60 * column + row]);
                assert!((a - b).abs() < 1e-12 * largest, "row {row}, column {column}: {a} and {b}");
            }
        }
    }
}
