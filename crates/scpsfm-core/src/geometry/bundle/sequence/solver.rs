//! Sparse Cholesky factorisation of a system with a block pattern.

use faer::dyn_stack::{MemBuffer, MemStack, StackReq};
use faer::perm::Perm;
use faer::sparse::linalg::amd;
use faer::sparse::linalg::cholesky::{SymbolicCholesky, SymmetricOrdering, factorize_symbolic_cholesky};
use faer::sparse::{SparseColMatRef, SymbolicSparseColMat, SymbolicSparseColMatRef};
use faer::{Conj, MatMut, Par, Side};

use super::pattern::Pattern;

/// Sparse Cholesky factorisation, supernodal where it pays, in an order of approximately minimum degree.
pub(super) struct SparseCholesky {
    structure: SymbolicSparseColMat<usize>,
    symbolic: SymbolicCholesky<usize>,
    factor: Vec<f64>,
    memory: MemBuffer,
}

impl SparseCholesky {
    /// Orders and analyses; `None` without unknowns, or without the memory for it.
    pub fn new(pattern: &Pattern) -> Option<Self> {
        let n = pattern.unknowns.count();
        if n == 0 {
            return None;
        }
        let structure = structure(pattern);
        let (forward, inverse) = order(pattern)?;
        let order = Perm::new_checked(forward.into(), inverse.into(), n);
        let ordering = SymmetricOrdering::Custom(order.as_ref());
        let symbolic =
            factorize_symbolic_cholesky(structure.as_ref(), Side::Lower, ordering, Default::default()).ok()?;
        let scratch = StackReq::any_of(&[
            symbolic.factorize_numeric_llt_scratch::<f64>(Par::Seq, Default::default()),
            symbolic.solve_in_place_scratch::<f64>(1, Par::Seq),
        ]);
        let memory = MemBuffer::try_new(scratch).ok()?;
        Some(Self { factor: vec![0.0; symbolic.len_val()], structure, symbolic, memory })
    }

    /// Factors the matrix with these values and solves in place of `vector`; `false` when it is not positive definite.
    pub fn solve(&mut self, values: &[f64], vector: &mut [f64]) -> bool {
        let stack = MemStack::new(&mut self.memory);
        let matrix = SparseColMatRef::new(self.structure.as_ref(), values);
        let (par, regularisation, parameters) = (Par::Seq, Default::default(), Default::default());
        let factor = &mut self.factor;
        let factored =
            self.symbolic.factorize_numeric_llt(factor, matrix, Side::Lower, regularisation, par, stack, parameters);
        let Ok(factor) = factored else { return false };
        let vector = MatMut::from_column_major_slice_mut(vector, self.structure.nrows(), 1);
        factor.solve_in_place_with_conj(Conj::No, vector, par, MemStack::new(&mut self.memory));
        true
    }
}

/// The pattern, unknown by unknown. What it holds above the diagonal is ignored in the factorisation.
fn structure(pattern: &Pattern) -> SymbolicSparseColMat<usize> {
    let n = pattern.unknowns.count();
    let (mut starts, mut rows) = (vec![0], Vec::with_capacity(pattern.value_count()));
    for block in 0..pattern.unknowns.block_count() {
        for _ in pattern.unknowns.range(block) {
            for &row in pattern.column(block).rows {
                rows.extend(pattern.unknowns.range(row as usize));
            }
            starts.push(rows.len());
        }
    }
    SymbolicSparseColMat::new_checked(n, n, starts, None, rows)
}

/// An order of the unknowns that keeps the factor sparse, found on the blocks: which unknown comes when, and when each
/// comes.
fn order(pattern: &Pattern) -> Option<(Vec<usize>, Vec<usize>)> {
    let blocks = pattern.unknowns.block_count();
    let rows: Vec<usize> = pattern.rows.iter().map(|row| *row as usize).collect();
    let graph = SymbolicSparseColMatRef::new_checked(blocks, blocks, &pattern.column_starts, None, &rows);
    let (mut order, mut inverse) = (vec![0; blocks], vec![0; blocks]);
    let mut memory = MemBuffer::try_new(amd::order_scratch::<usize>(blocks, rows.len())).ok()?;
    let stack = MemStack::new(&mut memory);
    amd::order(&mut order, &mut inverse, graph, Default::default(), stack).ok()?;
    let forward: Vec<usize> = order.iter().flat_map(|&block| pattern.unknowns.range(block)).collect();
    let mut inverse = vec![0; forward.len()];
    forward.iter().enumerate().for_each(|(place, &unknown)| inverse[unknown] = place);
    Some((forward, inverse))
}
