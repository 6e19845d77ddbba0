//! Which observations of a track are right, given what is said of each and of pairs of them.
//!
//! Of a track with observations k the probability that exactly those with `b_k = 1` are right is proportional to `Π_k
//! exp(b_k u_k) Π_{k,l} exp(b_k b_l r_kl)`: a pair speaks by its likelihood ratio where both are right, else not at
//! all. As pairs reach no farther than two observations back, sums over all combinations are those of a chain whose
//! state is the last two (the forward-backward algorithm, Rabiner 1989): exact, and linear in the observations.

/// Logarithms of the odds of a track and of its observations.
#[derive(Debug, Clone, PartialEq)]
pub struct Posterior {
    /// That each observation is right.
    pub observations: Vec<f64>,
    /// That all of them are.
    pub track: f64,
}

/// Odds beyond which nobody is: what is certain as a number remains comparable.
const MOST_LN_ODDS: f64 = 1e6;

/// * `alone`: u, logarithms of the odds of each observation by itself
/// * `ratios`: of each observation, r with the one before it and with the one before that; 0 where nothing is known
pub fn posterior(alone: &[f64], ratios: &[[f64; 2]]) -> Posterior {
    let count = alone.len();
    // What observation k adds, given the state (k - 2, k - 1) before it.
    let gain = |k: usize, older: usize, newer: usize, here: usize| -> f64 {
        if here == 0 {
            return 0.0;
        }
        alone[k] + newer as f64 * ratios[k][0] + older as f64 * ratios[k][1]
    };
    // Index 2 a + b: observation k - 1 is a, observation k is b.
    let mut forward = vec![[f64::NEG_INFINITY; 4]; count];
    for k in 0..count {
        for here in 0..2 {
            for newer in 0..2 {
                let before = |older: usize| match k {
                    // Before the first there is nothing that is right.
                    0 if older + newer == 0 => 0.0,
                    0 => f64::NEG_INFINITY,
                    _ => forward[k - 1][2 * older + newer],
                };
                forward[k][2 * newer + here] = ln_sum([0, 1].map(|older| before(older) + gain(k, older, newer, here)));
            }
        }
    }
    let mut backward = vec![[0.0; 4]; count];
    for k in (1..count).rev() {
        for older in 0..2 {
            for newer in 0..2 {
                backward[k - 1][2 * older + newer] =
                    ln_sum([0, 1].map(|here| gain(k, older, newer, here) + backward[k][2 * newer + here]));
            }
        }
    }
    let odds = |k: usize| {
        let total = |here: usize| ln_sum([0, 2].map(|newer| forward[k][newer + here] + backward[k][newer + here]));
        bounded(total(1) - total(0))
    };
    // All are right, or observation k is the first that is not.
    let (mut all, mut not_all) = (0.0, f64::NEG_INFINITY);
    for (k, after) in backward.iter().enumerate() {
        let (older, newer) = (usize::from(k > 1), usize::from(k > 0));
        not_all = ln_sum([not_all, all + after[2 * newer]]);
        all += gain(k, older, newer, 1);
    }
    Posterior { observations: (0..count).map(odds).collect(), track: bounded(all - not_all) }
}

fn bounded(ln_odds: f64) -> f64 {
    // An observation that nobody speaks of may be infinity less infinity.
    if ln_odds.is_nan() { 0.0 } else { ln_odds.clamp(-MOST_LN_ODDS, MOST_LN_ODDS) }
}

/// Logarithm of the sum of two numbers given by theirs.
fn ln_sum([a, b]: [f64; 2]) -> f64 {
    let (most, least) = if a > b { (a, b) } else { (b, a) };
    if most == f64::NEG_INFINITY { most } else { most + (least - most).exp().ln_1p() }
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    /// The sums over every combination, one by one.
    fn counted(alone: &[f64], ratios: &[[f64; 2]]) -> Posterior {
        let count = alone.len();
        let (mut right, mut wrong) = (vec![0.0; count], vec![0.0; count]);
        let (mut total, mut all) = (0.0, 0.0);
        for combination in 0..1usize << count {
            let is = |k: usize| combination >> k & 1 == 1;
            let mut ln = 0.0;
            for k in (0..count).filter(|&k| is(k)) {
                ln += alone[k];
                ln += if k > 0 && is(k - 1) { ratios[k][0] } else { 0.0 };
                ln += if k > 1 && is(k - 2) { ratios[k][1] } else { 0.0 };
            }
            total += ln.exp();
            all = ln.exp();
            for k in 0..count {
                *(if is(k) { &mut right[k] } else { &mut wrong[k] }) += ln.exp();
            }
        }
        let observations = right.iter().zip(&wrong).map(|(right, wrong): (&f64, &f64)| (right / wrong).ln()).collect();
        Posterior { observations, track: (all / (total - all)).ln() }
    }

    #[test]
    fn the_chain_sums_what_counting_sums() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        for count in 1..8 {
            let alone: Vec<f64> = (0..count).map(|_| rng.random_range(-3.0..3.0)).collect();
            let ratios: Vec<[f64; 2]> = (0..count).map(|_| [0, 1].map(|_| rng.random_range(-4.0..4.0))).collect();
            let (found, expected) = (posterior(&alone, &ratios), counted(&alone, &ratios));
            let pairs = found.observations.iter().zip(&expected.observations);
            for (found, expected) in pairs.chain([(&found.track, &expected.track)]) {
                assert!((found - expected).abs() < 1e-9, "{count} observations: {found} is not {expected}");
            }
        }
    }

    #[test]
    fn one_wrong_observation_is_told_from_the_others() {
        // The third of five agrees with none that it is paired with.
        let ratios = [[0.0, 0.0], [5.0, 0.0], [-30.0, -30.0], [-30.0, 5.0], [5.0, -30.0]];
        let found = posterior(&[0.0; 5], &ratios);
        for (k, odds) in found.observations.iter().enumerate() {
            assert!(if k == 2 { *odds < -10.0 } else { *odds > 4.0 }, "{found:?}");
        }
        assert!(found.track < -10.0, "{found:?}");
    }

    #[test]
    fn certainty_and_nothing_are_numbers() {
        assert!(posterior(&[], &[]).observations.is_empty());
        let found = posterior(&[f64::INFINITY, 1e300, 0.0], &[[0.0; 2], [1e300, 0.0], [f64::NEG_INFINITY, 0.0]]);
        assert!(found.observations.iter().chain([&found.track]).all(|odds| odds.is_finite()), "{found:?}");
    }
}
