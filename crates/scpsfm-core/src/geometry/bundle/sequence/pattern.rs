//! Where the blocks of the reduced system are that are not zero.

use super::super::dense::PANEL_SHARE;
use super::MetricReconstruction;
use super::layout::{Layout, Unknowns};
use crate::domain::StopToken;

/// Unknowns up to which a system is a square matrix, about forty views: its dense factorisation needs no analysis.
const SQUARE_LIMIT: usize = 256;
/// The same of a system of which [`PANEL_SHARE`] is coupled: 72 MB each for the values and for those that are left.
const SQUARE_LIMIT_OF_COUPLED: usize = 3_000;

/// The lower triangle of a symmetric matrix of blocks, by block columns.
///
/// The blocks of one column are a dense panel, column-major, the diagonal block (held in full) on top: the values are
/// those of a compressed sparse column matrix whose row indices are the same all over a panel. Of a system that is
/// small, or coupled as a whole, they are those of a square matrix.
#[derive(Debug)]
pub(super) struct Pattern {
    /// Whether the values are those of a square matrix, column-major, of which only the lower triangle counts.
    pub is_square: bool,
    pub unknowns: Unknowns,
    /// Where a block column starts in `rows`.
    pub column_starts: Vec<usize>,
    /// Row blocks of the columns, ascending, first the diagonal.
    pub rows: Vec<u32>,
    /// Where a row block starts in the panel of its column.
    heights: Vec<u32>,
    /// Where the panel of a block column starts among the values.
    panel_starts: Vec<usize>,
    /// Distance between the columns of the panel of a block column.
    pub strides: Vec<usize>,
}

/// A block among the values: its first, and the distance between its columns.
#[derive(Debug, Clone, Copy)]
pub(super) struct Place {
    pub start: usize,
    pub stride: usize,
}

impl Pattern {
    /// Blocks that a point links, and the pose of every view with the intrinsics of its group; all, in a square matrix,
    /// where they are few or most are linked. `None` when it was stopped.
    pub fn new(sequence: &MetricReconstruction, layout: &Layout, stop: &StopToken) -> Option<Self> {
        let limit = if layout.coupled_share() >= PANEL_SHARE { SQUARE_LIMIT_OF_COUPLED } else { SQUARE_LIMIT };
        if layout.unknowns.count() <= limit {
            return Some(Self::square(&layout.unknowns));
        }
        Self::sparse(sequence, layout, stop)
    }

    /// Without the blocks that are zero; `None` when it was stopped.
    pub fn sparse(sequence: &MetricReconstruction, layout: &Layout, stop: &StopToken) -> Option<Self> {
        let unknowns = &layout.unknowns;
        let blocks = unknowns.block_count();
        let mut group_of = vec![None; blocks];
        for (view, block) in unknowns.view_block.iter().enumerate() {
            block.iter().for_each(|block| group_of[*block] = unknowns.group_block_of_view(sequence, view));
        }
        let mut points_by_block = vec![Vec::new(); blocks];
        for point in 0..layout.point_count() {
            for incident in layout.incident_blocks(point) {
                points_by_block[incident.block as usize].push(point as u32);
            }
        }
        let (mut column_starts, mut rows) = (vec![0], Vec::new());
        // Column for which a row was listed last.
        let mut listed_for = vec![usize::MAX; blocks];
        for (column, group) in group_of.into_iter().enumerate() {
            if stop.is_stopped() {
                return None;
            }
            let first = rows.len();
            let mut list = |row: usize| {
                if row >= column && listed_for[row] != column {
                    listed_for[row] = column;
                    rows.push(row as u32);
                }
            };
            list(column);
            group.into_iter().for_each(&mut list);
            for &point in &points_by_block[column] {
                layout.incident_blocks(point as usize).iter().for_each(|incident| list(incident.block as usize));
            }
            rows[first..].sort_unstable();
            column_starts.push(rows.len());
        }
        Some(Self::from_rows(unknowns, column_starts, rows))
    }

    fn square(unknowns: &Unknowns) -> Self {
        let (blocks, n) = (unknowns.block_count(), unknowns.count());
        let (mut column_starts, mut rows) = (vec![0], Vec::new());
        for column in 0..blocks {
            rows.extend(column as u32..blocks as u32);
            column_starts.push(rows.len());
        }
        let mut panel_starts: Vec<usize> = unknowns.offsets.iter().map(|offset| offset * (n + 1)).collect();
        panel_starts[blocks] = n * n;
        let strides = vec![n; blocks];
        Self { is_square: true, panel_starts, strides, ..Self::from_rows(unknowns, column_starts, rows) }
    }

    fn from_rows(unknowns: &Unknowns, column_starts: Vec<usize>, rows: Vec<u32>) -> Self {
        let mut heights = Vec::with_capacity(rows.len());
        let (mut panel_starts, mut strides) = (vec![0], Vec::new());
        let mut values = 0;
        for column in 0..column_starts.len() - 1 {
            let mut height = 0;
            for &row in &rows[column_starts[column]..column_starts[column + 1]] {
                heights.push(height as u32);
                height += unknowns.size(row as usize);
            }
            values += height * unknowns.size(column);
            panel_starts.push(values);
            strides.push(height);
        }
        Self { is_square: false, unknowns: unknowns.clone(), column_starts, rows, heights, panel_starts, strides }
    }

    pub fn value_count(&self) -> usize {
        self.panel_starts[self.unknowns.block_count()]
    }

    /// Where the panels of a run of block columns are among the values.
    pub fn panels(&self, columns: std::ops::Range<usize>) -> std::ops::Range<usize> {
        self.panel_starts[columns.start]..self.panel_starts[columns.end]
    }

    pub fn column(&self, column: usize) -> Column<'_> {
        let range = self.column_starts[column]..self.column_starts[column + 1];
        Column { rows: &self.rows[range.clone()], heights: &self.heights[range], start: self.panel_starts[column] }
    }

    /// Where a block is; `None` where it is zero.
    pub fn place(&self, row: usize, column: usize) -> Option<Place> {
        let start = self.column(column).start_of(row as u32)?;
        Some(Place { start, stride: self.strides[column] })
    }

    /// Calls `take` with row, column and index of every value, those of the diagonal blocks' upper triangles too.
    pub fn for_each(&self, mut take: impl FnMut(usize, usize, usize)) {
        for block in 0..self.unknowns.block_count() {
            for (k, column) in self.unknowns.range(block).enumerate() {
                let mut index = self.panel_starts[block] + k * self.strides[block];
                for &row in self.column(block).rows {
                    for row in self.unknowns.range(row as usize) {
                        take(row, column, index);
                        index += 1;
                    }
                }
            }
        }
    }

    /// Where the diagonal is among the values, unknown after unknown.
    pub fn diagonal(&self) -> Vec<usize> {
        let of_block = |block: usize| {
            let (start, stride) = (self.panel_starts[block], self.strides[block]);
            (0..self.unknowns.size(block)).map(move |k| start + k * (stride + 1))
        };
        (0..self.unknowns.block_count()).flat_map(of_block).collect()
    }
}

pub(super) struct Column<'a> {
    pub rows: &'a [u32],
    heights: &'a [u32],
    start: usize,
}

impl Column<'_> {
    /// Where a row block starts among the values; `None` where it is not listed.
    #[inline]
    pub fn start_of(&self, row: u32) -> Option<usize> {
        // Rows ascend without repeats, so that a row is at most so many places down; mostly it is just there.
        let last = row.checked_sub(*self.rows.first()?)? as usize;
        let at = match self.rows.get(last) {
            Some(listed) if *listed == row => last,
            _ => self.rows[..last.min(self.rows.len())].binary_search(&row).ok()?,
        };
        Some(self.start + self.heights[at] as usize)
    }
}
