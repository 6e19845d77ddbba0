//! Operations on arrays of features x tracks, row by row.

use super::VARIANCE_FLOOR;
use crate::network::lanes::{dot, sum};

/// Softmax over one row.
pub fn softmax(logits: &[f32]) -> Vec<f32> {
    let highest = logits.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let powers: Vec<f32> = logits.iter().map(|logit| (logit - highest).exp()).collect();
    let total: f32 = powers.iter().sum();
    powers.iter().map(|power| power / total).collect()
}

/// Softmax of the negated values over the rows, for each track.
pub fn softmin_over_rows(values: &[f32], tracks: usize) -> Vec<f32> {
    let mut shares = vec![0.0; values.len()];
    for j in 0..tracks {
        let column = || values.iter().skip(j).step_by(tracks);
        let least = column().copied().fold(f32::INFINITY, f32::min);
        let total: f32 = column().map(|value| (least - value).exp()).sum();
        for (share, value) in shares.iter_mut().skip(j).step_by(tracks).zip(column()) {
            *share = (least - value).exp() / total;
        }
    }
    shares
}

/// Every row to mean 0 and variance 1 over the tracks.
#[inline(always)]
pub fn normalise_rows(values: &mut [f32], tracks: usize) {
    for row in values.chunks_exact_mut(tracks) {
        let mean = sum(row) / tracks as f32;
        row.iter_mut().for_each(|value| *value -= mean);
        let deviation = (dot(row, row) / tracks as f32 + VARIANCE_FLOOR).sqrt();
        row.iter_mut().for_each(|value| *value /= deviation);
    }
}

pub fn rectify(values: &mut [f32]) {
    values.iter_mut().for_each(|value| *value = value.max(0.0));
}

pub fn halved(values: &[f32]) -> Vec<f32> {
    values.iter().map(|value| 0.5 * value).collect()
}

#[inline(always)]
pub fn accumulate(sums: &mut [f32], values: &[f32]) {
    for (sum, value) in sums.iter_mut().zip(values) {
        *sum += value;
    }
}

/// Tracks whose sums for four outputs stay in registers side by side: eight registers of eight numbers, which leaves
/// some for the inputs.
const TILE: usize = 16;
/// The same where fewer are left.
const HALF_TILE: usize = 8;

/// `W X + b`, outputs x tracks: the weights row by row, X in several rows.
///
/// Every sum runs over the inputs in their order, whatever its tile: tiles keep sums in registers that a row at a time
/// would write to memory for every product, and change no bit.
#[inline(always)]
pub fn affine(weights: &[f32], biases: &[f32], rows: &[&[f32]], tracks: usize) -> Vec<f32> {
    let mut output = vec![0.0; biases.len() * tracks];
    let weights_of = |output: usize| &weights[output * rows.len()..(output + 1) * rows.len()];
    let mut first = 0;
    while first < biases.len() {
        let count = if first + 4 <= biases.len() { 4 } else { 1 };
        // One output alone repeats itself, and is written last.
        let outputs = [0, 1, 2, 3].map(|k| first + k.min(count - 1));
        let layer =
            Four { outputs, weights: outputs.map(weights_of), biases: outputs.map(|k| biases[k]), rows, tracks };
        let mut track = 0;
        while track + TILE <= tracks {
            layer.tile::<TILE>(&mut output, track);
            track += TILE;
        }
        while track + HALF_TILE <= tracks {
            layer.tile::<HALF_TILE>(&mut output, track);
            track += HALF_TILE;
        }
        while track < tracks {
            layer.tile::<1>(&mut output, track);
            track += 1;
        }
        first += count;
    }
    output
}

/// Four outputs of [`affine`].
struct Four<'a> {
    outputs: [usize; 4],
    weights: [&'a [f32]; 4],
    biases: [f32; 4],
    rows: &'a [&'a [f32]],
    tracks: usize,
}

impl Four<'_> {
    /// Their sums for some tracks from one on.
    ///
    /// # Pitfall
    /// The compiler keeps sums in registers as long as each is a variable of its own: an array of the four takes ten
    /// times as long.
    #[inline(always)]
    fn tile<const T: usize>(&self, output: &mut [f32], track: usize) {
        let [a, b, c, d] = self.biases;
        let (mut a, mut b, mut c, mut d) = ([a; T], [b; T], [c; T], [d; T]);
        let [of_a, of_b, of_c, of_d] = self.weights;
        let count = self.rows.len();
        let (of_a, of_b, of_c, of_d) = (&of_a[..count], &of_b[..count], &of_c[..count], &of_d[..count]);
        for (k, row) in self.rows.iter().enumerate() {
            let Some(values) = row[track..].first_chunk::<T>() else { return };
            let values = *values;
            add_scaled(&mut a, of_a[k], &values);
            add_scaled(&mut b, of_b[k], &values);
            add_scaled(&mut c, of_c[k], &values);
            add_scaled(&mut d, of_d[k], &values);
        }
        for (place, sums) in self.outputs.iter().zip([&a, &b, &c, &d]) {
            let start = place * self.tracks + track;
            output[start..start + T].copy_from_slice(sums);
        }
    }
}

#[inline(always)]
fn add_scaled<const T: usize>(sums: &mut [f32; T], factor: f32, values: &[f32; T]) {
    let mut j = 0;
    while j < T {
        sums[j] += factor * values[j];
        j += 1;
    }
}

/// Natural logarithm of a positive normal number to 4e-7 of itself: a series in (m - 1) / (m + 1) for the significand m
/// about 1. It has no branch, so that the logarithms of a row are taken side by side. Infinity stays what it is; what
/// is not positive has none.
#[inline(always)]
pub fn logarithm(x: f32) -> f32 {
    const EXPONENT_BIAS: i32 = 127;
    const SIGNIFICAND: u32 = 0x007f_ffff;
    const ONE: u32 = 0x3f80_0000;
    let bits = x.to_bits();
    let exponent = ((bits >> 23) as i32 - EXPONENT_BIAS) as f32;
    let significand = f32::from_bits(bits & SIGNIFICAND | ONE);
    let is_large = significand > std::f32::consts::SQRT_2;
    let (m, exponent) = if is_large { (0.5 * significand, exponent + 1.0) } else { (significand, exponent) };
    let s = (m - 1.0) / (m + 1.0);
    let t = s * s;
    let series = 2.0 * s * (1.0 + t * (1.0 / 3.0 + t * (1.0 / 5.0 + t * (1.0 / 7.0 + t * (1.0 / 9.0)))));
    let finite = if x <= f32::MAX { series + exponent * std::f32::consts::LN_2 } else { x };
    if x > 0.0 { finite } else { f32::NAN }
}

pub fn row(values: &[f32], tracks: usize, index: usize) -> &[f32] {
    rows(values, tracks, index, 1)
}

pub fn rows(values: &[f32], tracks: usize, first: usize, count: usize) -> &[f32] {
    &values[first * tracks..(first + count) * tracks]
}

pub fn row_mut(values: &mut [f32], tracks: usize, index: usize) -> &mut [f32] {
    &mut values[index * tracks..(index + 1) * tracks]
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    #[test]
    fn tiles_change_no_bit() {
        for seed in 0..30 {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let (outputs, inputs, tracks) = (rng.random_range(1..10), rng.random_range(1..20), rng.random_range(1..70));
            let mut draw = |count: usize| (0..count).map(|_| rng.random_range(-1.0..1.0)).collect::<Vec<f32>>();
            let (weights, biases, values) = (draw(outputs * inputs), draw(outputs), draw(inputs * tracks));
            let rows: Vec<&[f32]> = values.chunks_exact(tracks).collect();
            let found = affine(&weights, &biases, &rows, tracks);
            for (place, &found) in found.iter().enumerate() {
                let (output, track) = (place / tracks, place % tracks);
                let products = (0..inputs).map(|k| weights[output * inputs + k] * rows[k][track]);
                let expected = products.fold(biases[output], |sum, product| sum + product);
                assert_eq!(found.to_bits(), expected.to_bits(), "seed {seed}: {outputs} x {inputs} x {tracks}");
            }
        }
    }

    #[test]
    fn logarithms_are_those_of_the_library() {
        let mut rng = ChaCha8Rng::seed_from_u64(0);
        for _ in 0..100_000 {
            let x = (rng.random_range(-1.0f32..1.0).powi(3) * 80.0).exp();
            let expected = f64::from(x).ln();
            let apart = (f64::from(logarithm(x)) - expected).abs();
            assert!(apart <= 4e-7 * expected.abs(), "{x}: {} for {expected}", logarithm(x));
        }
        assert_eq!(logarithm(1.0), 0.0);
        assert_eq!(logarithm(f32::INFINITY), f32::INFINITY);
        assert!([f32::NAN, f32::NEG_INFINITY, -1e-6, 0.0].into_iter().all(|none| logarithm(none).is_nan()));
    }
}
