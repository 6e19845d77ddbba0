//! The camera system that is left when the points are eliminated, accumulated point by point.
//!
//! With `V = Jp' Jp` damped and factored as `L L'`, and `Q = L^-1 Jp'`, the reduced system is
//! `Jc' (I - Q' Q) Jc`: every pair of observations of a point adds `Jc_a' (d_ab I - Q_a' Q_b) Jc_b`, a product through
//! 2x2 blocks. That costs half of what the product of the 12x4 blocks `Jc' Jp` costs and is linear in the points.

use faer::linalg::matmul::triangular::{self, BlockStructure};
use faer::{Accum, MatMut, MatRef, Par};
use nalgebra::{Cholesky, Matrix2, SMatrix, SVector, Vector2};

use super::cholesky::CholeskySolver;
use super::engine::{Jacobian, Layout, Problem, Sink, Step, usable_squared_norm};
use super::{Loss, Observation};
use crate::simd::vectorised;

/// Damping of the reduced system beside Marquardt's, as a share of its mean diagonal: holds the gauge (15 directions
/// of a projective, 7 of a metric reconstruction) at a thousandth of what observed directions weigh at worst.
const GAUGE_DAMPING: f64 = 1e-9;
/// Least diagonal of a point's block as a share of its trace, for points whose position nothing determines.
const POINT_DAMPING: f64 = 1e-12;

/// Share of all pairs of point and camera that must be observed for the points to be eliminated by [`Panel`]s, which
/// calculate with zeros for the others: a product of panels takes about a third of the time of its pairs, whose number
/// falls with the square of the share.
const PANEL_SHARE: f64 = 0.6;
/// Points of a panel: enough for the product to run at full speed, few enough for a second-level cache.
const PANEL_POINTS: usize = 64;

/// Residuals and Jacobians at one state, with their robust weights, and the diagonal blocks of `J' J`.
pub(super) struct Linearisation<const G: usize, const C: usize, const P: usize> {
    residuals: Vec<Vector2<f64>>,
    jacobians: Vec<Jacobian<G, C, P>>,
    globals_diagonal: SVector<f64, G>,
    camera_diagonals: Vec<SVector<f64, C>>,
    point_blocks: Vec<SMatrix<f64, P, P>>,
}

/// Writes one observation's weighted residual and Jacobian in place; an undefined one becomes zero.
struct Entry<'a, const G: usize, const C: usize, const P: usize> {
    loss: Loss,
    residual: &'a mut Vector2<f64>,
    jacobian: &'a mut Jacobian<G, C, P>,
}

impl<const G: usize, const C: usize, const P: usize> Sink<G, C, P> for Entry<'_, G, C, P> {
    #[inline]
    fn take(&mut self, residual: Vector2<f64>, jacobian: impl FnOnce() -> Jacobian<G, C, P>) {
        match usable_squared_norm(&residual) {
            Some(squared) => {
                let weight = self.loss.root_weight(squared);
                *self.residual = residual * weight;
                *self.jacobian = jacobian();
                if weight != 1.0 {
                    self.jacobian.globals *= weight;
                    self.jacobian.camera *= weight;
                    self.jacobian.point *= weight;
                }
            }
            None => {
                *self.residual = Vector2::zeros();
                *self.jacobian = Jacobian::zeros();
            }
        }
    }
}

impl<const G: usize, const C: usize, const P: usize> Jacobian<G, C, P> {
    pub fn zeros() -> Self {
        Self { globals: SMatrix::zeros(), camera: SMatrix::zeros(), point: SMatrix::zeros() }
    }
}

impl<const G: usize, const C: usize, const P: usize> Linearisation<G, C, P> {
    pub fn new(layout: &Layout, cameras: usize) -> Self {
        let observations = layout.observations.len();
        Self {
            residuals: vec![Vector2::zeros(); observations],
            jacobians: vec![Jacobian::zeros(); observations],
            globals_diagonal: SVector::zeros(),
            camera_diagonals: vec![SVector::zeros(); cameras],
            point_blocks: vec![SMatrix::zeros(); layout.starts.len() - 1],
        }
    }

    /// Diagonal of the information on the globals with everything else known.
    pub fn globals_diagonal(&self) -> &SVector<f64, G> {
        &self.globals_diagonal
    }

    /// Linearises at the state of `problem`.
    pub fn fill(&mut self, problem: &impl Problem<G, C, P>, layout: &Layout, loss: Loss) {
        self.globals_diagonal = SVector::from(problem.global_beliefs().map(|belief| belief.information));
        self.camera_diagonals.fill(SVector::zeros());
        self.point_blocks.fill(SMatrix::zeros());
        for (k, seen) in layout.observations.iter().enumerate() {
            let (residual, jacobian) = (&mut self.residuals[k], &mut self.jacobians[k]);
            problem.observe(seen, &mut Entry { loss, residual, jacobian });
            for component in 0..2 {
                let globals = jacobian.globals.column(component);
                self.globals_diagonal += globals.component_mul(&globals);
                let camera = jacobian.camera.column(component);
                self.camera_diagonals[seen.camera] += camera.component_mul(&camera);
            }
            self.point_blocks[seen.point] += jacobian.point * jacobian.point.transpose();
        }
    }
}

/// The reduced system and the scratch to build and solve it, reused from step to step.
pub(super) struct Reduced<const G: usize, const C: usize, const P: usize> {
    dimension: usize,
    /// Column-major `dimension x dimension`, lower triangle; unknowns are the globals, then camera after camera.
    pub matrix: Vec<f64>,
    /// Right-hand side, then solution.
    pub vector: Vec<f64>,
    factors: Vec<Option<Cholesky<f64, nalgebra::Const<P>>>>,
    /// `Q_a = L^-1 Jp_a'` for the observations of one point.
    whitened: Vec<SMatrix<f64, P, 2>>,
    /// `None` where a point is seen by few of the cameras: pair by pair is then cheaper.
    panel: Option<Panel<C, P>>,
    solver: CholeskySolver,
}

impl<const G: usize, const C: usize, const P: usize> Reduced<G, C, P> {
    pub fn new(layout: &Layout, cameras: usize) -> Self {
        let dimension = G + C * cameras;
        let longest = layout.starts.windows(2).map(|pair| pair[1] - pair[0]).max().unwrap_or(0);
        Self {
            dimension,
            matrix: vec![0.0; dimension * dimension],
            vector: vec![0.0; dimension],
            factors: vec![None; layout.starts.len() - 1],
            whitened: Vec::with_capacity(longest),
            panel: Panel::<C, P>::is_worth_it(layout, cameras).then(|| Panel::new(cameras)),
            solver: CholeskySolver::new(dimension),
        }
    }

    /// Solves for the step at this damping; `false` when the system is not positive definite.
    pub fn solve(
        &mut self,
        problem: &impl Problem<G, C, P>,
        layout: &Layout,
        linearisation: &Linearisation<G, C, P>,
        damping: f64,
        step: &mut Step<G, C, P>,
    ) -> bool {
        if !self.build(problem, layout, linearisation, damping) {
            return false;
        }
        self.damp(problem, linearisation, damping);
        if !self.solver.solve(&mut self.matrix, &mut self.vector) {
            return false;
        }
        step.globals.copy_from_slice(&self.vector[..G]);
        for (camera, values) in step.cameras.iter_mut().zip(self.vector[G..].chunks_exact(C)) {
            camera.copy_from_slice(values);
        }
        self.substitute_points(layout, linearisation, step);
        true
    }

    /// Eliminates the points; `false` when a point's block cannot be factored.
    pub fn build(
        &mut self,
        problem: &impl Problem<G, C, P>,
        layout: &Layout,
        linearisation: &Linearisation<G, C, P>,
        damping: f64,
    ) -> bool {
        vectorised(
            #[inline(always)]
            || self.eliminate(problem, layout, linearisation, damping),
        )
    }

    #[inline(always)]
    fn eliminate(
        &mut self,
        problem: &impl Problem<G, C, P>,
        layout: &Layout,
        linearisation: &Linearisation<G, C, P>,
        damping: f64,
    ) -> bool {
        self.matrix.fill(0.0);
        self.vector.fill(0.0);
        for (k, belief) in problem.global_beliefs().iter().enumerate() {
            self.matrix[k * (self.dimension + 1)] += belief.information;
            self.vector[k] -= belief.information * belief.deviation;
        }
        for point in 0..self.factors.len() {
            let range = layout.starts[point]..layout.starts[point + 1];
            let mut block = linearisation.point_blocks[point];
            let trace = block.trace();
            for k in 0..P {
                block[(k, k)] += damping * block[(k, k)] + POINT_DAMPING * (1.0 + trace);
            }
            let gauge = problem.point_gauge(point);
            block += gauge * gauge.transpose() * trace;
            self.factors[point] = Cholesky::new(block);
            let Some(factor) = &self.factors[point] else { return false };
            self.whitened.clear();
            for jacobian in &linearisation.jacobians[range.clone()] {
                let mut whitened = jacobian.point;
                factor.l_dirty().solve_lower_triangular_mut(&mut whitened);
                self.whitened.push(whitened);
            }
            self.add_globals_and_gradient(
                &layout.observations[range.clone()],
                &linearisation.jacobians[range.clone()],
                &linearisation.residuals[range.clone()],
            );
            let (observations, jacobians) = (&layout.observations[range.clone()], &linearisation.jacobians[range]);
            match &mut self.panel {
                Some(panel) => {
                    panel.push(observations, jacobians, &self.whitened);
                    if panel.is_full() {
                        panel.subtract(&mut self.matrix, G);
                    }
                    self.add_cameras(observations, jacobians);
                }
                None => self.add_camera_pairs(observations, jacobians),
            }
        }
        if let Some(panel) = &mut self.panel {
            panel.subtract(&mut self.matrix, G);
        }
        true
    }

    /// `Jc' Jc`, all that the camera blocks are but for the points.
    #[inline(always)]
    fn add_cameras(&mut self, observations: &[Observation], jacobians: &[Jacobian<G, C, P>]) {
        for (seen, jacobian) in observations.iter().zip(jacobians) {
            self.add_block(seen.camera, seen.camera, &jacobian.camera, &Matrix2::identity(), &jacobian.camera);
        }
    }

    /// Right-hand side, and the rows and columns of the globals: linear in the observations of the point.
    #[inline(always)]
    fn add_globals_and_gradient(
        &mut self,
        observations: &[Observation],
        jacobians: &[Jacobian<G, C, P>],
        residuals: &[Vector2<f64>],
    ) {
        let mut pull = SVector::<f64, P>::zeros();
        let mut coupling = SMatrix::<f64, P, G>::zeros();
        for ((whitened, jacobian), residual) in self.whitened.iter().zip(jacobians).zip(residuals) {
            pull += whitened * residual;
            coupling += whitened * jacobian.globals.transpose();
        }
        for (k, (seen, jacobian)) in observations.iter().zip(jacobians).enumerate() {
            let left = residuals[k] - self.whitened[k].tr_mul(&pull);
            let first = G + C * seen.camera;
            let gradient = jacobian.camera * left;
            for (slot, value) in self.vector[first..first + C].iter_mut().zip(gradient.iter()) {
                *slot -= value;
            }
            if G == 0 {
                continue;
            }
            let gradient = jacobian.globals * left;
            for (slot, value) in self.vector[..G].iter_mut().zip(gradient.iter()) {
                *slot -= value;
            }
            let left = jacobian.globals.transpose() - self.whitened[k].tr_mul(&coupling);
            let among_globals = jacobian.globals * left;
            let with_camera = jacobian.camera * left;
            for global in 0..G {
                let column = &mut self.matrix[global * self.dimension..(global + 1) * self.dimension];
                for (slot, value) in column[..G].iter_mut().zip(among_globals.column(global).iter()) {
                    *slot += value;
                }
                for (slot, value) in column[first..first + C].iter_mut().zip(with_camera.column(global).iter()) {
                    *slot += value;
                }
            }
        }
    }

    /// The blocks between the cameras that see the point, lower triangle.
    #[inline(always)]
    fn add_camera_pairs(&mut self, observations: &[Observation], jacobians: &[Jacobian<G, C, P>]) {
        for a in 0..observations.len() {
            for b in 0..=a {
                let mut through = -self.whitened[a].tr_mul(&self.whitened[b]);
                if a == b {
                    through += Matrix2::identity();
                }
                let (row, column) = (observations[a].camera, observations[b].camera);
                self.add_block(row, column, &jacobians[a].camera, &through, &jacobians[b].camera);
                // Two observations of one point in one view: the mirrored pair falls into the same block.
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
        let (row, column) = (G + C * row, G + C * column);
        let ([first, second], [u, v]) = (&left.data.0, &right.data.0);
        // Loops by hand over arrays: this is the innermost loop of every search, and iterators cost four times as
        // much in builds for tests, which barely optimise.
        let mut k = 0;
        while k < C {
            let x = through.m11 * u[k] + through.m12 * v[k];
            let y = through.m21 * u[k] + through.m22 * v[k];
            let start = (column + k) * self.dimension + row;
            if let Some(slots) = self.matrix[start..].first_chunk_mut::<C>() {
                let mut r = 0;
                while r < C {
                    slots[r] += first[r] * x + second[r] * y;
                    r += 1;
                }
            }
            k += 1;
        }
    }

    /// Marquardt's damping, and what holds the gauge.
    fn damp(&mut self, problem: &impl Problem<G, C, P>, linearisation: &Linearisation<G, C, P>, damping: f64) {
        let diagonal = |index: usize| {
            if index < G {
                linearisation.globals_diagonal[index]
            } else {
                linearisation.camera_diagonals[(index - G) / C][(index - G) % C]
            }
        };
        let mean = (0..self.dimension).map(diagonal).sum::<f64>() / self.dimension as f64;
        for index in 0..self.dimension {
            self.matrix[index * (self.dimension + 1)] +=
                damping * diagonal(index) + GAUGE_DAMPING * mean + f64::MIN_POSITIVE;
        }
        for camera in 0..problem.camera_count() {
            let gauge = problem.camera_gauge(camera);
            let weight = linearisation.camera_diagonals[camera].sum() / C as f64;
            let first = G + C * camera;
            for k in 0..C {
                let start = (first + k) * self.dimension + first;
                for (slot, value) in self.matrix[start..start + C].iter_mut().zip(gauge.iter()) {
                    *slot += weight * gauge[k] * value;
                }
            }
        }
    }

    /// The points' part of the step, `-V^-1 Jp' (r + Jc dc + Jg dg)`.
    fn substitute_points(&self, layout: &Layout, linearisation: &Linearisation<G, C, P>, step: &mut Step<G, C, P>) {
        for (point, factor) in self.factors.iter().enumerate() {
            let mut gradient = SVector::<f64, P>::zeros();
            for k in layout.starts[point]..layout.starts[point + 1] {
                let jacobian = &linearisation.jacobians[k];
                let moved = linearisation.residuals[k]
                    + jacobian.globals.tr_mul(&step.globals)
                    + jacobian.camera.tr_mul(&step.cameras[layout.observations[k].camera]);
                gradient -= jacobian.point * moved;
            }
            if let Some(factor) = factor {
                factor.solve_mut(&mut gradient);
            }
            step.points[point] = gradient;
        }
    }
}

/// `Jc' Q'` of some points side by side, `C` rows a camera and `P` columns a point: times its own transpose it is what
/// eliminating the points takes off the camera blocks, by one product that runs at the processor's full speed.
struct Panel<const C: usize, const P: usize> {
    /// Rows: `C` times the cameras.
    rows: usize,
    /// Column-major.
    values: Vec<f64>,
}

impl<const C: usize, const P: usize> Panel<C, P> {
    /// Whether enough of the pairs of point and camera are observed.
    fn is_worth_it(layout: &Layout, cameras: usize) -> bool {
        let pairs = cameras * (layout.starts.len() - 1);
        layout.observations.len() as f64 >= PANEL_SHARE * pairs as f64
    }

    fn new(cameras: usize) -> Self {
        let rows = C * cameras;
        Self { rows, values: Vec::with_capacity(rows * P * PANEL_POINTS) }
    }

    fn is_full(&self) -> bool {
        self.values.len() >= self.rows * P * PANEL_POINTS
    }

    /// Appends a point's columns.
    #[inline(always)]
    fn push<const G: usize>(
        &mut self,
        observations: &[Observation],
        jacobians: &[Jacobian<G, C, P>],
        whitened: &[SMatrix<f64, P, 2>],
    ) {
        let first = self.values.len();
        self.values.resize(first + self.rows * P, 0.0);
        for ((seen, jacobian), whitened) in observations.iter().zip(jacobians).zip(whitened) {
            let [u, v] = &jacobian.camera.data.0;
            let mut k = 0;
            while k < P {
                let (x, y) = (whitened[(k, 0)], whitened[(k, 1)]);
                let start = first + k * self.rows + C * seen.camera;
                if let Some(slots) = self.values[start..].first_chunk_mut::<C>() {
                    let mut r = 0;
                    while r < C {
                        slots[r] += u[r] * x + v[r] * y;
                        r += 1;
                    }
                }
                k += 1;
            }
        }
    }

    /// Subtracts the product with its transpose from the lower triangle of `matrix` below and right of `offset`, and
    /// empties the panel.
    fn subtract(&mut self, matrix: &mut [f64], offset: usize) {
        let dimension = offset + self.rows;
        let panel = MatRef::from_column_major_slice(&self.values, self.rows, self.values.len() / self.rows.max(1));
        let cameras = MatMut::from_column_major_slice_mut(matrix, dimension, dimension)
            .submatrix_mut(offset, offset, self.rows, self.rows);
        triangular::matmul(
            cameras,
            BlockStructure::TriangularLower,
            Accum::Add,
            panel,
            BlockStructure::Rectangular,
            panel.transpose(),
            BlockStructure::Rectangular,
            -1.0,
            Par::Seq,
        );
        self.values.clear();
    }
}
