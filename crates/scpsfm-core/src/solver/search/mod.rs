//! Hypothesis search: minimal samples, drawn under a prior, scored against all tracks.

pub mod affine;
mod options;
pub mod rigid;
pub mod subspace;

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use crate::geometry::{Camera, Point};
use options::SamplingOptions;

/// A hypothesis that growing can start from.
#[derive(Debug, Clone)]
pub struct Seed {
    pub cameras: Vec<Camera>,
    /// Points of the support, in its order.
    pub points: Vec<Point>,
    /// Tracks that the hypothesis is believed to hold for.
    pub support: Vec<usize>,
}

/// Tracks of a sample.
const SAMPLE: usize = 4;

/// Draws samples of four different tracks under a prior.
#[derive(Debug, Clone)]
pub struct Sampler {
    cumulative: Vec<f64>,
}

impl Sampler {
    /// Mixes the prior with the uniform distribution; weights that are negative or not finite count as 0.
    ///
    /// No track has more than its share of a sample, a quarter of all weight: with more, it would be in every sample,
    /// and be it wrong, every sample would be.
    pub fn new(prior: &[f64]) -> Self {
        let usable = |weight: f64| if weight.is_finite() { weight.max(0.0) } else { 0.0 };
        let guided = capped(prior.iter().map(|&weight| usable(weight)).collect());
        let total: f64 = guided.iter().sum();
        let uniform = 1.0 / prior.len().max(1) as f64;
        let share = if total > 0.0 { SamplingOptions::DEFAULT.uniform_share } else { 1.0 };
        let mut sum = 0.0;
        let cumulative = guided
            .into_iter()
            .map(|weight| {
                let guided = if total > 0.0 { weight / total } else { 0.0 };
                sum += (1.0 - share) * guided + share * uniform;
                sum
            })
            .collect();
        Self { cumulative }
    }

    /// Four tracks, all different: each is drawn from those that are left. `None` of fewer than four.
    pub fn draw(&self, rng: &mut ChaCha8Rng) -> Option<[usize; SAMPLE]> {
        let last = self.cumulative.len().checked_sub(1).filter(|&last| last + 1 >= SAMPLE)?;
        let before = |track: usize| if track == 0 { 0.0 } else { self.cumulative[track - 1] };
        let mut sample = [0; SAMPLE];
        // The same in increasing order.
        let mut taken = [0; SAMPLE];
        for k in 0..SAMPLE {
            let weight: f64 = taken[..k].iter().map(|&track| self.cumulative[track] - before(track)).sum();
            let mut at = rng.random::<f64>() * (self.cumulative[last] - weight);
            // What was drawn is stepped over.
            for &track in &taken[..k] {
                if at >= before(track) {
                    at += self.cumulative[track] - before(track);
                }
            }
            let drawn = self.cumulative.partition_point(|&sum| sum <= at).min(last);
            // Rounding may still end at one of them: the next that is left is as good.
            let drawn = (drawn..=last).chain(0..drawn).find(|track| !taken[..k].contains(track))?;
            let place = taken[..k].partition_point(|&other| other < drawn);
            taken.copy_within(place..k, place + 1);
            taken[place] = drawn;
            sample[k] = drawn;
        }
        Some(sample)
    }
}

/// The weights, those that are more than a quarter of all lowered to as much.
fn capped(mut weights: Vec<f64>) -> Vec<f64> {
    let mut order: Vec<usize> = (0..weights.len()).collect();
    order.sort_by(|&a, &b| weights[b].total_cmp(&weights[a]));
    // Where so many are lowered, each may have what the others have over what those leave of a sample.
    for lowered in 0..SAMPLE.min(order.len()) {
        let (larger, others) = order.split_at(lowered);
        let most = others.iter().map(|&track| weights[track]).sum::<f64>() / (SAMPLE - lowered) as f64;
        if weights[others[0]] <= most {
            larger.iter().for_each(|&track| weights[track] = most);
            break;
        }
    }
    weights
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
        let samples: Vec<[usize; SAMPLE]> = (0..2000).filter_map(|_| sampler.draw(&mut rng)).collect();
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
        assert_eq!((0..1000).filter_map(|_| sampler.draw(&mut rng)).count(), 1000);
        assert!(Sampler::new(&[]).draw(&mut rng).is_none());
        assert!(Sampler::new(&[1.0; 3]).draw(&mut rng).is_none());
    }

    /// Reweighting gives a track that happens to lie in the subspace a million times the weight of others.
    #[test]
    fn a_few_weights_beyond_all_measure_starve_no_search() {
        for heavy in 1..=6 {
            let mut prior = vec![1.0; 200];
            prior[..heavy].iter_mut().zip(0..).for_each(|(weight, k)| *weight = 1e6 * f64::powi(10.0, k));
            let sampler = Sampler::new(&prior);
            let mut rng = ChaCha8Rng::seed_from_u64(heavy as u64);
            let samples: Vec<[usize; 4]> = (0..2000).filter_map(|_| sampler.draw(&mut rng)).collect();
            assert_eq!(samples.len(), 2000, "{heavy} heavy: draws that repeat a track are wasted");
            for track in 0..heavy.min(3) {
                // The heaviest are the last.
                let track = heavy - 1 - track;
                let with = samples.iter().filter(|sample| sample.contains(&track)).count();
                println!("{heavy} heavy: track {track} in {with} of 2000 samples");
                assert!((400..1990).contains(&with), "{heavy} heavy: track {track} in {with} of 2000 samples");
            }
        }
    }

    #[test]
    fn a_track_of_more_than_a_quarter_of_the_weight_has_a_quarter() {
        assert_eq!(capped(vec![1.0, 1.5, 1.0, 1.0, 3.0]), [1.0, 1.5, 1.0, 1.0, 1.5]);
        assert_eq!(capped(vec![1.0, 2.0, 1.0, 1.0, 3.0]), [1.0, 1.5, 1.0, 1.0, 1.5]);
        assert_eq!(capped(vec![1.0, 1.0, 1.0, 1e300]), [1.0; 4]);
        assert_eq!(capped(vec![0.0, 0.0, 7.0]), [0.0; 3]);
        assert!(capped(Vec::new()).is_empty());
    }
}
