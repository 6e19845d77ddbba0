//! Linear layers and pooling over the views.

use super::arrays::Layer;
use super::rows;

/// Encodings pooled over the views: their mean over those that show the track, and their largest.
pub struct Pool {
    tracks: usize,
    sum: Vec<f32>,
    largest: Vec<f32>,
}

impl Pool {
    pub fn new(features: usize, tracks: usize) -> Self {
        Self { tracks, sum: vec![0.0; features * tracks], largest: vec![0.0; features * tracks] }
    }

    /// Rectifies and adds a view's encodings; of what is unobserved they count as 0.
    #[inline(always)]
    pub fn add(&mut self, encoded: Vec<f32>, visible: &[f32]) {
        let pooled = self.sum.chunks_exact_mut(self.tracks).zip(self.largest.chunks_exact_mut(self.tracks));
        for ((sum, largest), encoded) in pooled.zip(encoded.chunks_exact(self.tracks)) {
            for j in 0..self.tracks {
                let value = encoded[j].max(0.0) * visible[j];
                sum[j] += value;
                largest[j] = largest[j].max(value);
            }
        }
    }

    /// Means, then largest.
    #[inline(always)]
    pub fn finish(self, counts: &[f32]) -> Vec<f32> {
        let Self { tracks, sum: mut pooled, largest } = self;
        for row in pooled.chunks_exact_mut(tracks) {
            for (value, count) in row.iter_mut().zip(counts) {
                *value /= count;
            }
        }
        pooled.extend(largest);
        pooled
    }
}

impl Layer<Vec<f32>> {
    pub fn outputs(&self) -> usize {
        self.bias.len()
    }

    /// `W X + b`, the rows of X in several pieces.
    #[inline(always)]
    pub fn affine(&self, inputs: &[&[f32]], tracks: usize) -> Vec<f32> {
        let rows: Vec<&[f32]> = inputs.iter().flat_map(|rows| rows.chunks_exact(tracks)).collect();
        rows::affine(&self.weight, &self.bias, &rows, tracks)
    }
}
