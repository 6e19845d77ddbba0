//! The camera system that is left when the points are eliminated, accumulated point by point.
//!
//! With `V = Jp' Jp` damped and factored as `L L'`, and `Q = L^-1 Jp'`, the reduced system is `Jc' (I - Q' Q) Jc`:
//! every pair of observations of a point adds `Jc_a' (d_ab I - Q_a' Q_b) Jc_b`, a product through 2x2 blocks. That
//! costs half of what the product of the 12x4 blocks `Jc' Jp` costs and is linear in the points. Where most cameras see
//! a point, that product (`Jc' Q'` times its transpose, see [`Panel`]) is nevertheless three times as fast.

use nalgebra::{Cholesky, Matrix2, SMatrix, SVector, Vector2};

use super::cholesky;
use super::panel::Panel;
use super::problem::{BundleProblem, Jacobian, Layout, Step, usable_squared_norm};
use super::{Loss, Observation};
use crate::simd::vectorised;

/// Damping of the reduced system beside Marquardt's, as a share of its mean diagonal: holds the gauge (15 directions
/// of a projective, 7 of a metric reconstruction) at a thousandth of what observed directions weigh at worst.
const GAUGE_DAMPING: f64 = 1e-9;
/// Least diagonal of a point's block as a share of its trace, for points whose position nothing determines.
pub(super) const POINT_DAMPING: f64 = 1e-12;

/// Residuals and Jacobians at one state, with their robust weights, and the diagonal blocks of `J' J`.
pub(super) struct Linearisation<'a, const C: usize, const P: usize> {
    layout: &'a Layout,
    residuals: Vec<Vector2<f64>>,
    jacobians: Vec<Jacobian<C, P>>,
    camera_diagonals: Vec<SVector<f64, C>>,
    point_blocks: Vec<SMatrix<f64, P, P>>,
}

impl<const C: usize, const P: usize> Jacobian<C, P> {
    pub fn zeros() -> Self {
        Self { camera: SMatrix::zeros(), point: SMatrix::zeros() }
    }
}

impl<'a, const C: usize, const P: usize> Linearisation<'a, C, P> {
    pub fn new(layout: &'a Layout, cameras: usize) -> Self {
        let observations = layout.observations.len();
        Self {
            layout,
            residuals: vec![Vector2::zeros(); observations],
            jacobians: vec![Jacobian::zeros(); observations],
            camera_diagonals: vec![SVector::zeros(); cameras],
            point_blocks: vec![SMatrix::zeros(); layout.starts.len() - 1],
        }
    }

    /// Linearises at the state of `problem`; an undefined observation gets a residual and a Jacobian of zero.
    pub fn fill(&mut self, problem: &impl BundleProblem<C, P>, loss: Loss) {
        self.camera_diagonals.fill(SVector::zeros());
        self.point_blocks.fill(SMatrix::zeros());
        for (k, seen) in self.layout.observations.iter().enumerate() {
            let (residual, jacobian) = (&mut self.residuals[k], &mut self.jacobians[k]);
            let (unweighted, derivatives) = problem.evaluate(*seen);
            match usable_squared_norm(&unweighted) {
                Some(squared) => {
                    let weight = seen.weight.sqrt() * loss.root_weight(seen.weight * squared);
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
}

/// The reduced system and the scratch to build and solve it, reused from step to step.
pub(super) struct Reduced<const C: usize, const P: usize> {
    dimension: usize,
    /// Column-major `dimension x dimension`, lower triangle; unknowns camera after camera.
    pub matrix: Vec<f64>,
    /// Right-hand side, then solution.
    pub vector: Vec<f64>,
    factors: Vec<Option<Cholesky<f64, nalgebra::Const<P>>>>,
    /// `Q_a = L^-1 Jp_a'` for the observations of one point.
    whitened: Vec<SMatrix<f64, P, 2>>,
    /// Residuals of one point, linearised, after the cameras' part of a step.
    moved: Vec<Vector2<f64>>,
    /// `None` where a point is seen by few of the cameras: pair by pair is then cheaper.
    panel: Option<Panel<C, P>>,
    /// What was solved for last.
    pub step: Step<C, P>,
}

impl<const C: usize, const P: usize> Reduced<C, P> {
    pub fn new(layout: &Layout, cameras: usize) -> Self {
        let dimension = C * cameras;
        let longest = layout.starts.windows(2).map(|pair| pair[1] - pair[0]).max().unwrap_or(0);
        Self {
            dimension,
            matrix: vec![0.0; dimension * dimension],
            vector: vec![0.0; dimension],
            factors: vec![None; layout.starts.len() - 1],
            whitened: Vec::with_capacity(longest),
            moved: Vec::with_capacity(longest),
            panel: Panel::<C, P>::is_worth_it(layout, cameras).then(|| Panel::new(cameras)),
            step: Step::zeros(cameras, layout.starts.len() - 1),
        }
    }

    /// Solves for the step at this damping. Returns the decrease of the cost that the linearisation predicts; `None`
    /// when the system is not positive definite.
    pub fn solve(&mut self, problem: &impl BundleProblem<C, P>, at: &Linearisation<C, P>, damping: f64) -> Option<f64> {
        if !self.build(problem, at, damping) {
            return None;
        }
        self.damp(problem, at, damping);
        if !cholesky::solve(&mut self.matrix, &mut self.vector) {
            return None;
        }
        for (camera, values) in self.step.cameras.iter_mut().zip(self.vector.chunks_exact(C)) {
            camera.copy_from_slice(values);
        }
        Some(self.substitute_points(at))
    }

    /// Eliminates the points; `false` when a point's block cannot be factored.
    pub fn build(&mut self, problem: &impl BundleProblem<C, P>, at: &Linearisation<C, P>, damping: f64) -> bool {
        vectorised(
            #[inline(always)]
            || self.eliminate(problem, at, damping),
        )
    }

    #[inline(always)]
    fn eliminate(&mut self, problem: &impl BundleProblem<C, P>, at: &Linearisation<C, P>, damping: f64) -> bool {
        let layout = at.layout;
        self.matrix.fill(0.0);
        self.vector.fill(0.0);
        for point in 0..self.factors.len() {
            let range = layout.starts[point]..layout.starts[point + 1];
            let mut block = at.point_blocks[point];
            let trace = block.trace();
            for k in 0..P {
                block[(k, k)] += damping * block[(k, k)] + POINT_DAMPING * trace + f64::MIN_POSITIVE;
            }
            let gauge = problem.point_gauge(point);
            block += gauge * gauge.transpose() * trace;
            self.factors[point] = Cholesky::new(block);
            let Some(factor) = &self.factors[point] else { return false };
            self.whitened.clear();
            for jacobian in &at.jacobians[range.clone()] {
                let mut whitened = jacobian.point;
                factor.l_dirty().solve_lower_triangular_mut(&mut whitened);
                self.whitened.push(whitened);
            }
            let (observations, jacobians) = (&layout.observations[range.clone()], &at.jacobians[range.clone()]);
            self.add_gradient(observations, jacobians, &at.residuals[range]);
            match &mut self.panel {
                Some(panel) => {
                    panel.push(observations, jacobians, &self.whitened);
                    if panel.is_full() {
                        panel.subtract(&mut self.matrix);
                    }
                    self.add_cameras(observations, jacobians);
                }
                None => self.add_camera_pairs(observations, jacobians),
            }
        }
        if let Some(panel) = &mut self.panel {
            panel.subtract(&mut self.matrix);
        }
        true
    }

    /// `Jc' Jc`, all that the camera blocks are but for the points.
    #[inline(always)]
    fn add_cameras(&mut self, observations: &[Observation], jacobians: &[Jacobian<C, P>]) {
        for (seen, jacobian) in observations.iter().zip(jacobians) {
            self.add_block(seen.view, seen.view, &jacobian.camera, &Matrix2::identity(), &jacobian.camera);
        }
    }

    /// The right-hand side.
    #[inline(always)]
    fn add_gradient(&mut self, observations: &[Observation], jacobians: &[Jacobian<C, P>], residuals: &[Vector2<f64>]) {
        let mut whitened_gradient = SVector::<f64, P>::zeros();
        for (whitened, residual) in self.whitened.iter().zip(residuals) {
            whitened_gradient += whitened * residual;
        }
        for (k, (seen, jacobian)) in observations.iter().zip(jacobians).enumerate() {
            let left = residuals[k] - self.whitened[k].tr_mul(&whitened_gradient);
            let first = C * seen.view;
            let gradient = jacobian.camera * left;
            for (slot, value) in self.vector[first..first + C].iter_mut().zip(gradient.iter()) {
                *slot -= value;
            }
        }
    }

    /// The blocks between the cameras that see the point, lower triangle.
    #[inline(always)]
    fn add_camera_pairs(&mut self, observations: &[Observation], jacobians: &[Jacobian<C, P>]) {
        for a in 0..observations.len() {
            for b in 0..=a {
                let mut through = -self.whitened[a].tr_mul(&self.whitened[b]);
                if a == b {
                    through += Matrix2::identity();
                }
                let (row, column) = (observations[a].view, observations[b].view);
                self.add_block(row, column, &jacobians[a].camera, &through, &jacobians[b].camera);
                // Two observations of one point in one view: the exchanged pair falls into the same block.
                if a != b && row == column {
                    self.add_block(row, column, &jacobians[b].camera, &through.transpose(), &jacobians[a].camera);
                }
            }
        }
    }

    /// Adds `left through right'` to the block of two cameras.
    #[inline(always)]
    fn add_block(
        &mut self,
        row: usize,
        column: usize,
        left: &SMatrix<f64, C, 2>,
        through: &Matrix2<f64>,
        right: &SMatrix<f64, C, 2>,
    ) {
        let (row, column) = (C * row, C * column);
        let ([first, second], [u, v]) = (&left.data.0, &right.data.0);
        for (k, (u, v)) in u.iter().zip(v).enumerate() {
            let x = through.m11 * u + through.m12 * v;
            let y = through.m21 * u + through.m22 * v;
            let start = (column + k) * self.dimension + row;
            if let Some(slots) = self.matrix[start..].first_chunk_mut::<C>() {
                for ((slot, first), second) in slots.iter_mut().zip(first).zip(second) {
                    *slot += first * x + second * y;
                }
            }
        }
    }

    /// Marquardt's damping, and what holds the gauge.
    fn damp(&mut self, problem: &impl BundleProblem<C, P>, at: &Linearisation<C, P>, damping: f64) {
        let diagonal = |index: usize| at.camera_diagonals[index / C][index % C];
        let mean = (0..self.dimension).map(diagonal).sum::<f64>() / self.dimension as f64;
        for index in 0..self.dimension {
            self.matrix[index * (self.dimension + 1)] +=
                damping * diagonal(index) + GAUGE_DAMPING * mean + f64::MIN_POSITIVE;
        }
        for (camera, diagonal) in at.camera_diagonals.iter().enumerate() {
            let gauge = problem.camera_gauge(camera);
            let weight = diagonal.sum() / C as f64;
            let first = C * camera;
            for k in 0..C {
                let start = (first + k) * self.dimension + first;
                for (slot, value) in self.matrix[start..start + C].iter_mut().zip(gauge.iter()) {
                    *slot += weight * gauge[k] * value;
                }
            }
        }
    }

    /// The points' part of the step, `-V^-1 Jp' (r + Jc dc)`.
    ///
    /// Returns by how much the linearised residuals shrink under the whole step, `|r|^2 - |r + J d|^2`.
    fn substitute_points(&mut self, at: &Linearisation<C, P>) -> f64 {
        let (layout, step) = (at.layout, &mut self.step);
        let mut predicted = 0.0;
        for (point, factor) in self.factors.iter().enumerate() {
            let mut gradient = SVector::<f64, P>::zeros();
            self.moved.clear();
            for k in layout.starts[point]..layout.starts[point + 1] {
                let jacobian = &at.jacobians[k];
                let moved = at.residuals[k] + jacobian.camera.tr_mul(&step.cameras[layout.observations[k].view]);
                gradient -= jacobian.point * moved;
                self.moved.push(moved);
            }
            if let Some(factor) = factor {
                factor.solve_mut(&mut gradient);
            }
            step.points[point] = gradient;
            for (k, moved) in (layout.starts[point]..).zip(&self.moved) {
                let left = moved + at.jacobians[k].point.tr_mul(&gradient);
                predicted += at.residuals[k].norm_squared() - left.norm_squared();
            }
        }
        predicted
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
        let mut linearisation = Linearisation::new(&layout, 5);
        linearisation.fill(&problem, Loss::Squared);
        let build = |by_panels: bool| {
            let mut reduced = Reduced::new(&layout, 5);
            reduced.panel = by_panels.then(|| Panel::new(5));
            assert!(reduced.build(&problem, &linearisation, 1e-3));
            (reduced.matrix, reduced.vector)
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
