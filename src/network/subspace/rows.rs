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

/// Adds the products of factors and rows, one after the other: the same sums as a row at a time, whose output is written
/// to memory a quarter as often.
#[inline(always)]
pub fn accumulate_products(output: &mut [f32], factors: &[f32], rows: &[&[f32]]) {
    let length = output.len();
    let (fours, rest) = rows.as_chunks::<4>();
    let (factors_of_fours, factors_of_rest) = factors.as_chunks::<4>();
    for (rows, [p, q, r, s]) in fours.iter().zip(factors_of_fours) {
        let [a, b, c, d] = rows.map(|row| &row[..length]);
        for j in 0..length {
            output[j] = output[j] + p * a[j] + q * b[j] + r * c[j] + s * d[j];
        }
    }
    for (row, factor) in rest.iter().zip(factors_of_rest) {
        for (output, value) in output.iter_mut().zip(*row) {
            *output += factor * value;
        }
    }
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
