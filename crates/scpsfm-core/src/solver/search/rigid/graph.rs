//! Which pairs of tracks are rigid at which focal length, and the sets that are rigid together.

use crate::geometry::daq::scan_focal;
use crate::solver::search::options::{RigidGraphOptions, RigidOptions};

const OPTIONS: RigidGraphOptions = RigidOptions::DEFAULT.graph;

/// Moments over the views of the two parts of a pair's squared distance: `a`, which the focal length scales, and `b`,
/// the depths'.
#[derive(Debug, Clone, Copy, Default)]
pub struct Pair {
    a: f64,
    b: f64,
    aa: f64,
    ab: f64,
    bb: f64,
}

impl Pair {
    pub fn add(&mut self, a: f64, b: f64) {
        self.a += a;
        self.b += b;
        self.aa += a * a;
        self.ab += a * b;
        self.bb += b * b;
    }

    pub fn divided(self, count: f64) -> Self {
        let Self { a, b, aa, ab, bb } = self;
        Self { a: a / count, b: b / count, aa: aa / count, ab: ab / count, bb: bb / count }
    }

    /// Whether the distance at `g = 1/f^2` deviates by less than `tolerance`, and is not near zero in its terms.
    fn is_rigid(&self, g: f64, tolerance: f64) -> bool {
        let squared_distance = g * self.a + self.b;
        let second = g * g * self.aa + 2.0 * g * self.ab + self.bb;
        let variance = (second - squared_distance * squared_distance).max(0.0);
        // The deviation of a root is that of its square over twice the root.
        squared_distance > (OPTIONS.least_distance * tolerance).powi(2)
            && variance < 4.0 * squared_distance * tolerance * tolerance
    }
}

/// Which pairs are rigid.
pub struct Graph {
    pub tracks: usize,
    /// Standard deviation of a distance below which a pair is rigid.
    pub tolerance: f64,
    /// Upper triangle, row by row.
    pub pairs: Vec<Pair>,
}

impl Graph {
    fn focal(k: usize) -> f64 {
        scan_focal(k, OPTIONS.focals)
    }

    /// The focal lengths with most rigid pairs, no two of them neighbours on the grid.
    pub fn best_focals(&self, count: usize) -> Vec<f64> {
        let scales: [f64; OPTIONS.focals] = std::array::from_fn(|k| Self::focal(k).powi(-2));
        let mut totals = [0usize; OPTIONS.focals];
        for pair in &self.pairs {
            for (total, g) in totals.iter_mut().zip(scales) {
                *total += usize::from(pair.is_rigid(g, self.tolerance));
            }
        }
        let mut ranked: Vec<usize> = (0..OPTIONS.focals).filter(|&k| totals[k] > 0).collect();
        ranked.sort_by(|&a, &b| totals[b].cmp(&totals[a]).then(a.cmp(&b)));
        let mut chosen: Vec<usize> = Vec::new();
        for k in ranked {
            if chosen.len() < count && chosen.iter().all(|&other| k.abs_diff(other) > 1) {
                chosen.push(k);
            }
        }
        chosen.into_iter().map(Self::focal).collect()
    }

    /// Which pairs are rigid at a focal length.
    pub fn edges(&self, focal: f64) -> Edges {
        let mut adjacent = vec![vec![false; self.tracks]; self.tracks];
        let order = (0..self.tracks).flat_map(|a| (a + 1..self.tracks).map(move |b| (a, b)));
        let g = focal.powi(-2);
        for ((a, b), pair) in order.zip(&self.pairs) {
            let rigid = pair.is_rigid(g, self.tolerance);
            (adjacent[a][b], adjacent[b][a]) = (rigid, rigid);
        }
        let degree = adjacent.iter().map(|row| row.iter().filter(|&&edge| edge).count()).collect();
        Edges { adjacent, degree }
    }
}

/// The rigid pairs at one focal length.
pub struct Edges {
    adjacent: Vec<Vec<bool>>,
    degree: Vec<usize>,
}

impl Edges {
    /// A set of tracks nearly all of which are rigid with each other, begun from the best-connected one that no earlier
    /// core covers.
    pub fn core(&self, covered: &[bool]) -> Vec<usize> {
        let tracks = self.degree.len();
        let Some(first) =
            (0..tracks).filter(|&track| !covered[track]).max_by_key(|&track| (self.degree[track], tracks - track))
        else {
            return Vec::new();
        };
        let mut candidates: Vec<usize> = (0..tracks).filter(|&track| self.adjacent[first][track]).collect();
        candidates.sort_by(|&a, &b| self.degree[b].cmp(&self.degree[a]).then(a.cmp(&b)));
        let mut core = vec![first];
        for track in candidates {
            let rigid = core.iter().filter(|&&member| self.adjacent[track][member]).count();
            if rigid as f64 >= OPTIONS.core_share * core.len() as f64 && core.len() < OPTIONS.most_core {
                core.push(track);
            }
        }
        core
    }
}
