//! Guided search without depths: four tracks span an affine model of all others.
//!
//! Perspective makes right tracks deviate from affine by some tenths of a view's spread, hence the loose tolerance:
//! the winner is no reconstruction, but its best-ranked tracks are right often enough to grow one from.

use nalgebra::DMatrix;
use rand_chacha::ChaCha8Rng;

use super::options::{AffineOptions, SamplingOptions};
use super::{Sampler, Seed, Shortlist};
use crate::domain::StopToken;
use crate::geometry::factorization;
use crate::geometry::measurement::CompleteBlock;

const OPTIONS: AffineOptions = SamplingOptions::DEFAULT.affine;

/// A minimal sample: the origin and an orthonormal basis of the three directions to the others.
#[derive(Debug, Clone)]
pub struct Hypothesis {
    origin: usize,
    basis: [Vec<f64>; 3],
}

/// The centred coordinates of a block, ready to be searched.
#[derive(Debug, Clone)]
pub struct AffineSearch {
    /// 2n x m; columns are contiguous.
    centred: DMatrix<f64>,
}

impl AffineSearch {
    pub fn new(block: &CompleteBlock) -> Self {
        Self { centred: block.centred_by_view() }
    }

    /// The centred coordinates, 2n x m, in units of each view's spread.
    pub fn centred(&self) -> &DMatrix<f64> {
        &self.centred
    }

    /// Draws `samples` samples and offers them to the shortlist.
    ///
    /// * `truncations`: what a hypothesis pays for each track that it leaves out, in units of the cost of a residual of
    ///   [`AffineOptions::tolerance`]: 1, or more for tracks that a prior believes in (the logarithm of the posterior,
    ///   up to a constant)
    pub fn run(
        &self,
        sampler: &Sampler,
        truncations: &[f64],
        samples: usize,
        rng: &mut ChaCha8Rng,
        shortlist: &mut Shortlist<Hypothesis>,
        stop: &StopToken,
    ) {
        for k in 0..samples {
            if k.is_multiple_of(OPTIONS.samples_per_look) && stop.is_stopped() {
                return;
            }
            let Some(hypothesis) = sampler.draw(rng).and_then(|sample| self.span(sample)) else { continue };
            let cost = self.cost(&hypothesis, truncations, shortlist.bound());
            shortlist.offer(cost, hypothesis);
        }
    }

    /// Gram-Schmidt on the directions from the first track to the three others.
    fn span(&self, sample: [usize; 4]) -> Option<Hypothesis> {
        let origin = self.centred.column(sample[0]);
        let mut basis: [Vec<f64>; 3] = Default::default();
        for k in 0..3 {
            let mut direction: Vec<f64> =
                self.centred.column(sample[k + 1]).iter().zip(origin.iter()).map(|(a, b)| a - b).collect();
            for earlier in &basis[..k] {
                let along = dot(&direction, earlier);
                for (entry, unit) in direction.iter_mut().zip(earlier) {
                    *entry -= along * unit;
                }
            }
            let norm = dot(&direction, &direction).sqrt();
            if norm < OPTIONS.least_direction {
                return None;
            }
            direction.iter_mut().for_each(|entry| *entry /= norm);
            basis[k] = direction;
        }
        Some(Hypothesis { origin: sample[0], basis })
    }

    /// Truncated cost over all tracks; gives up above `bound`.
    fn cost(&self, hypothesis: &Hypothesis, truncations: &[f64], bound: f64) -> f64 {
        let unit = self.unit();
        let mut cost = 0.0;
        for (track, &truncation) in truncations.iter().enumerate() {
            cost += (self.squared(hypothesis, track) / unit).min(truncation);
            if cost >= bound {
                break;
            }
        }
        cost
    }

    /// Squared distance of a track that costs 1.
    fn unit(&self) -> f64 {
        OPTIONS.tolerance * OPTIONS.tolerance * self.centred.nrows() as f64
    }

    /// Squared distance of a track from the model.
    fn squared(&self, hypothesis: &Hypothesis, track: usize) -> f64 {
        let rows = self.centred.nrows();
        let column = &self.centred.as_slice()[track * rows..(track + 1) * rows];
        let origin = &self.centred.as_slice()[hypothesis.origin * rows..(hypothesis.origin + 1) * rows];
        let [first, second, third] = &hypothesis.basis;
        let (mut energy, mut along) = (0.0, [0.0; 3]);
        for row in 0..rows {
            let offset = column[row] - origin[row];
            energy += offset * offset;
            along[0] += offset * first[row];
            along[1] += offset * second[row];
            along[2] += offset * third[row];
        }
        (energy - along.iter().map(|value| value * value).sum::<f64>()).max(0.0)
    }

    /// What each track costs a hypothesis more than leaving it out would: least for those that belong to it.
    pub fn costs(&self, hypothesis: &Hypothesis, truncations: &[f64]) -> Vec<f64> {
        let unit = self.unit();
        let cost = |(track, truncation): (usize, &f64)| self.squared(hypothesis, track) / unit - truncation;
        truncations.iter().enumerate().map(cost).collect()
    }

    /// Affine factorisations of the hypothesis's best-ranked tracks.
    pub fn seeds(&self, block: &CompleteBlock, hypothesis: &Hypothesis, truncations: &[f64]) -> Vec<Seed> {
        seeds_from_ranking(block, &self.costs(hypothesis, truncations))
    }
}

/// Affine factorisations of the tracks of least cost, one for each support size.
pub fn seeds_from_ranking(block: &CompleteBlock, costs: &[f64]) -> Vec<Seed> {
    let mut ranked: Vec<usize> = (0..block.tracks()).collect();
    ranked.sort_by(|&a, &b| costs[a].total_cmp(&costs[b]).then(a.cmp(&b)));
    OPTIONS
        .support_sizes
        .iter()
        .filter(|&&size| size <= ranked.len())
        .filter_map(|&size| seed(block, ranked[..size].to_vec()))
        .collect()
}

/// The affine factorisation of some tracks.
pub fn seed(block: &CompleteBlock, mut support: Vec<usize>) -> Option<Seed> {
    support.sort_unstable();
    let (cameras, points) = factorization::affine(block, &support)?;
    Some(Seed { cameras, points, support })
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}
