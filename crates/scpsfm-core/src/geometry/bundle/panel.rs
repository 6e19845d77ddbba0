//! Points eliminated many at a time, where most cameras see them.

use faer::linalg::matmul::triangular::{self, BlockStructure};
use faer::prelude::ReborrowMut;
use faer::{Accum, MatMut, MatRef, Par};
use nalgebra::SMatrix;

use super::Observation;
use super::problem::{Jacobian, Layout};

/// Share of all pairs of point and camera that must be observed for the points to be eliminated by panels, which
/// calculate with zeros for the others: a product of panels takes a quarter of the time of its pairs or less, whose
/// number falls with the square of the share. A step of 37 views that see .53 of 390 points takes 4.9 ms by panels and
/// 8.0 by pairs.
pub(super) const PANEL_SHARE: f64 = 0.5;
/// Columns of a panel: enough for the product to run at full speed, few enough for a second-level cache.
const PANEL_COLUMNS: usize = 256;

/// `Jc' Q'` of some points side by side, `C` rows a camera and `P` columns a point: times its own transpose it is what
/// eliminating the points takes off the camera blocks, by one product that runs at the processor's full speed.
pub(super) struct Panel<const C: usize, const P: usize> {
    /// Rows: `C` times the cameras.
    rows: usize,
    /// Column-major.
    values: Vec<f64>,
}

impl<const C: usize, const P: usize> Panel<C, P> {
    /// Whether enough of the pairs of point and camera are observed.
    pub fn is_worth_it(layout: &Layout, cameras: usize) -> bool {
        let pairs = cameras * (layout.starts.len() - 1);
        layout.observations.len() as f64 >= PANEL_SHARE * pairs as f64
    }

    pub fn new(cameras: usize) -> Self {
        let rows = C * cameras;
        Self { rows, values: Vec::with_capacity(rows * (PANEL_COLUMNS + P)) }
    }

    pub fn is_full(&self) -> bool {
        self.values.len() >= self.rows * PANEL_COLUMNS
    }

    /// Appends a point's columns.
    #[inline(always)]
    pub fn push(
        &mut self,
        observations: &[Observation],
        jacobians: &[Jacobian<C, P>],
        whitened: &[SMatrix<f64, P, 2>],
    ) {
        let first = self.values.len();
        self.values.resize(first + self.rows * P, 0.0);
        for ((seen, jacobian), whitened) in observations.iter().zip(jacobians).zip(whitened) {
            let [u, v] = &jacobian.camera.data.0;
            for k in 0..P {
                let (x, y) = (whitened[(k, 0)], whitened[(k, 1)]);
                let start = first + k * self.rows + C * seen.view;
                if let Some(slots) = self.values[start..].first_chunk_mut::<C>() {
                    for ((slot, u), v) in slots.iter_mut().zip(u).zip(v) {
                        *slot += u * x + v * y;
                    }
                }
            }
        }
    }

    /// Subtracts the product with its transpose from the lower triangle of `matrix`, and empties the panel.
    pub fn subtract(&mut self, matrix: &mut [f64]) {
        subtract(&self.values, self.rows, matrix);
        self.values.clear();
    }
}

/// Subtracts the product of a panel with its transpose from the lower triangle of a square matrix.
///
/// * `panel`, `matrix`: column-major, of so many rows
pub(super) fn subtract(panel: &[f64], rows: usize, matrix: &mut [f64]) {
    let mut block = MatMut::from_column_major_slice_mut(matrix, rows, rows);
    for columns in panel.chunks(PANEL_COLUMNS * rows.max(1)) {
        let columns = MatRef::from_column_major_slice(columns, rows, columns.len() / rows.max(1));
        triangular::matmul(
            block.rb_mut(),
            BlockStructure::TriangularLower,
            Accum::Add,
            columns,
            BlockStructure::Rectangular,
            columns.transpose(),
            BlockStructure::Rectangular,
            -1.0,
            Par::Seq,
        );
    }
}
