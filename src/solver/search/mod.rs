//! Hypothesis search: minimal samples, drawn under a prior, scored against all tracks.

pub mod affine;
pub mod rigid;
pub mod subspace;

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use crate::geometry::{Camera, Point};

/// Share of the sampling weight that is spread over all tracks alike, whatever the prior says.
const UNIFORM_SHARE: f64 = 0.1;

/// A hypothesis that growing can start from.
#[derive(Debug, Clone)]
pub struct Seed {
    pub cameras: Vec<Camera>,
    /// Points of the support, in its order.
    pub points: Vec<Point>,
    /// Tracks that the hypothesis is believed to hold for.
    pub support: Vec<usize>,
}

/// Draws samples of four different tracks under a prior.
#[derive(Debug, Clone)]
pub struct Sampler {
    cumulative: Vec<f64>,
}

impl Sampler {
    /// Mixes the prior with the uniform distribution; weights that are negative or not finite count as 0.
    pub fn new(prior: &[f64]) -> Self {
        let usable = |weight: f64| if weight.is_finite() { weight.max(0.0) } else { 0.0 };
        let total: f64 = prior.iter().map(|&weight| usable(weight)).sum();
        let uniform = 1.0 / prior.len().max(1) as f64;
        let share = if total > 0.0 { UNIFORM_SHARE } else { 1.0 };
        let mut sum = 0.0;
        let cumulative = prior
            .iter()
            .map(|&weight| {
                let guided = if total > 0.0 { usable(weight) / total } else { 0.0 };
                sum += (1.0 - share) * guided + share * uniform;
                sum
            })
            .collect();
        Self { cumulative }
    }

    /// Four tracks, all different; `None` when this draw repeats one.
    pub fn draw(&self, rng: &mut ChaCha8Rng) -> Option<[usize; 4]> {
        let total = self.cumulative.last().copied()?;
        let mut sample = [0; 4];
        for k in 0..4 {
            let at = rng.random::<f64>() * total;
            sample[k] = self.cumulative.partition_point(|&sum| sum <= at).min(self.cumulative.len() - 1);
            if sample[..k].contains(&sample[k]) {
                return None;
            }
        }
        Some(sample)
    }
}

/// The few best of many, each with its cost; the worst of them bounds what is worth looking at.
#[derive(Debug, Clone)]
pub struct Shortlist<T> {
    size: usize,
    /// Increasing cost.
    entries: Vec<(f64, T)>,
}

impl<T> Shortlist<T> {
    pub fn new(size: usize) -> Self {
        Self { size, entries: Vec::with_capacity(size + 1) }
    }

    /// Cost at and above which nothing enters.
    pub fn bound(&self) -> f64 {
        if self.entries.len() < self.size { f64::INFINITY } else { self.entries[self.size - 1].0 }
    }

    pub fn offer(&mut self, cost: f64, entry: T) {
        if cost < self.bound() {
            let place = self.entries.partition_point(|(other, _)| *other <= cost);
            self.entries.insert(place, (cost, entry));
            self.entries.truncate(self.size);
        }
    }

    pub fn into_entries(self) -> impl Iterator<Item = T> {
        self.entries.into_iter().map(|(_, entry)| entry)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;

    #[test]
    fn a_shortlist_keeps_the_best_in_order() {
        let mut list = Shortlist::new(3);
        for cost in [5.0, 1.0, 4.0, 2.0, 3.0] {
            list.offer(cost, cost as i32);
        }
        assert_eq!(list.bound(), 3.0);
        assert_eq!(list.into_entries().collect::<Vec<_>>(), [1, 2, 3]);
    }

    #[test]
    fn samples_follow_the_prior_and_never_repeat_a_track() {
        let mut prior = vec![0.0; 20];
        prior[3..7].fill(1.0);
        let sampler = Sampler::new(&prior);
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let samples: Vec<[usize; 4]> = (0..2000).filter_map(|_| sampler.draw(&mut rng)).collect();
        let guided = samples.iter().flatten().filter(|&&track| (3..7).contains(&track)).count();
        assert!(guided as f64 > 0.75 * (4 * samples.len()) as f64, "{guided} of {}", 4 * samples.len());
        for sample in samples {
            let mut sorted = sample;
            sorted.sort_unstable();
            assert!(sorted.windows(2).all(|pair| pair[0] < pair[1]));
        }
    }

    #[test]
    fn a_prior_of_nothing_is_uniform() {
        let sampler = Sampler::new(&[0.0, f64::NAN, 0.0, -1.0]);
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        assert!((0..1000).filter_map(|_| sampler.draw(&mut rng)).count() > 20);
        assert!(Sampler::new(&[]).draw(&mut rng).is_none());
    }
}
