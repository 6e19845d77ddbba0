//! Running the network. Arrays are features x tracks, row by row, so that every loop runs along the tracks.

use super::arrays::{Block, SubspaceNet};
use super::cloud::Cloud;
use super::layers::Pool;
use super::pairs::{PairFeatures, Pairs};
use super::ridge::{inverse_scatter, product};
use super::rows::{
    accumulate, halved, logarithm, normalise_rows, rectify, row, row_mut, rows, softmax, softmin_over_rows,
};
use super::{DEPTH_RANGE, LEAST_MEAN_DEPTH, LEAVE_ONE_OUT_FLOOR, MOST_PREDICTED, RESIDUAL_FLOOR};
use crate::simd::vectorised;

/// What the network says: logits, positive where it takes a track or an observation to be right.
#[derive(Debug, Clone, PartialEq)]
pub struct Scores {
    pub tracks: Vec<f32>,
    /// View by view; of what is unobserved they mean nothing.
    pub observations: Vec<f32>,
}

/// The tracks of one cloud on their way through the blocks.
struct State<'a> {
    cloud: &'a Cloud,
    /// Views that show each track, at least 1.
    counts: Vec<f32>,
    /// Place of each track averaged over its views, 2 x m.
    means: Vec<f32>,
    /// C x m.
    tracks: Vec<f32>,
    /// n x m.
    depths: Vec<f32>,
    /// The columns that subspaces are fitted to, 3n x m.
    columns: Vec<f32>,
    pairs: Pairs<'a>,
}

/// What a block's selections leave of every track.
struct Residuals {
    /// 3n x m for each selection.
    left: Vec<Vec<f32>>,
    /// n x H x m, logarithms.
    of_observations: Vec<f32>,
    /// H x m, logarithms.
    of_tracks: Vec<f32>,
    /// H x m, logarithms.
    leverages: Vec<f32>,
    /// What pairs of views say beside the selections.
    of_pairs: PairFeatures,
}

impl SubspaceNet<Vec<f32>> {
    /// Scores every track and observation of a cloud. Deterministic, on the calling thread.
    pub fn forward(&self, cloud: &Cloud) -> Scores {
        if cloud.tracks() == 0 || cloud.views() == 0 {
            return Scores { tracks: vec![0.0; cloud.tracks()], observations: vec![0.0; cloud.visible().len()] };
        }
        vectorised(
            #[inline(always)]
            || {
                let mut state = State::new(cloud, self);
                let mut last = None;
                for block in &self.blocks {
                    let residuals = state.residuals(block);
                    state.advance(block, &residuals);
                    state.rescale(block, &residuals);
                    last = Some((block, residuals));
                }
                match last {
                    Some((block, residuals)) => Scores {
                        tracks: block.logit.affine(&[&state.tracks], cloud.tracks()),
                        observations: state.observations(self, &residuals),
                    },
                    None => {
                        Scores { tracks: vec![0.0; cloud.tracks()], observations: vec![0.0; cloud.visible().len()] }
                    }
                }
            },
        )
    }

    /// Views that the partners of a pair are apart at most; 0 where no pairs are asked.
    fn strides(&self) -> usize {
        let pairs = self.blocks.first().and_then(|block| block.pairs.as_ref());
        pairs.map_or(0, |pairs| pairs.log_scale.len())
    }
}

impl<'a> State<'a> {
    #[inline(always)]
    fn new(cloud: &'a Cloud, network: &SubspaceNet<Vec<f32>>) -> Self {
        let (views, tracks) = (cloud.views(), cloud.tracks());
        let mut counts = vec![0.0f32; tracks];
        let mut means = vec![0.0f32; 2 * tracks];
        for view in 0..views {
            accumulate(&mut counts, row(cloud.visible(), tracks, view));
            for axis in [0, 1] {
                // What is unobserved is at 0.
                accumulate(row_mut(&mut means, tracks, axis), row(cloud.places(), tracks, 2 * view + axis));
            }
        }
        counts.iter_mut().for_each(|count| *count = count.max(1.0));
        for axis in [0, 1] {
            for (mean, count) in row_mut(&mut means, tracks, axis).iter_mut().zip(&counts) {
                *mean /= count;
            }
        }
        let mut state = Self {
            cloud,
            counts,
            means,
            tracks: Vec::new(),
            depths: vec![1.0; views * tracks],
            columns: vec![0.0; 3 * views * tracks],
            pairs: Pairs::new(cloud, network.strides()),
        };
        state.encode_first(network);
        state.fill_first();
        state
    }

    /// The first state, from where the observations are.
    #[inline(always)]
    fn encode_first(&mut self, network: &SubspaceNet<Vec<f32>>) {
        let tracks = self.cloud.tracks();
        let mut pool = Pool::new(network.first_encoder.outputs(), tracks);
        let mut offsets = vec![0.0; 4 * tracks];
        for view in 0..self.cloud.views() {
            let visible = row(self.cloud.visible(), tracks, view);
            let places = rows(self.cloud.places(), tracks, 2 * view, 2);
            let (plain, squared) = offsets.split_at_mut(2 * tracks);
            for axis in [0, 1] {
                let mean = row(&self.means, tracks, axis);
                let (plain, squared) = (row_mut(plain, tracks, axis), row_mut(squared, tracks, axis));
                for (j, place) in row(places, tracks, axis).iter().enumerate() {
                    plain[j] = (place - mean[j]) * visible[j];
                    squared[j] = plain[j] * plain[j];
                }
            }
            pool.add(network.first_encoder.affine(&[places, &offsets, visible], tracks), visible);
        }
        let pooled = pool.finish(&self.counts);
        self.tracks = network.first_state.affine(&[&pooled], tracks);
        normalise_rows(&mut self.tracks, tracks);
    }

    /// The first columns: homogeneous points, the track's mean place where there is none.
    #[inline(always)]
    fn fill_first(&mut self) {
        let tracks = self.cloud.tracks();
        for view in 0..self.cloud.views() {
            let visible = row(self.cloud.visible(), tracks, view);
            for axis in [0, 1] {
                let (place, mean) = (row(self.cloud.places(), tracks, 2 * view + axis), row(&self.means, tracks, axis));
                let column = row_mut(&mut self.columns, tracks, 3 * view + axis);
                for j in 0..tracks {
                    column[j] = place[j] + mean[j] * (1.0 - visible[j]);
                }
            }
            row_mut(&mut self.columns, tracks, 3 * view + 2).fill(1.0);
        }
    }

    /// Selections, ridge regressions and what they leave; beside them, pairs.
    #[inline(always)]
    fn residuals(&mut self, block: &Block<Vec<f32>>) -> Residuals {
        let (views, tracks) = (self.cloud.views(), self.cloud.tracks());
        let selections = block.log_ridge.len();
        let logits = block.selection.affine(&[&self.tracks], tracks);
        let mut found = Residuals {
            left: Vec::with_capacity(selections),
            of_observations: vec![0.0; views * selections * tracks],
            of_tracks: vec![0.0; selections * tracks],
            leverages: vec![0.0; selections * tracks],
            of_pairs: match &block.pairs {
                Some(layers) => self.pairs.ask(layers, &self.tracks),
                None => PairFeatures::default(),
            },
        };
        for selection in 0..selections {
            let ridge = block.log_ridge[selection].exp();
            let shares = softmax(row(&logits, tracks, selection));
            let (left, leverages) = self.leave_one_out(&shares, ridge);
            let of_track = row_mut(&mut found.of_tracks, tracks, selection);
            for view in 0..views {
                let visible = row(self.cloud.visible(), tracks, view);
                let [x, y, w] = [0, 1, 2].map(|k| row(&left, tracks, 3 * view + k));
                let logarithms = row_mut(&mut found.of_observations, tracks, view * selections + selection);
                for j in 0..tracks {
                    let squared = x[j] * x[j] + y[j] * y[j] + w[j] * w[j];
                    of_track[j] += squared * visible[j];
                    logarithms[j] = logarithm(squared + RESIDUAL_FLOOR);
                }
            }
            let leverage = row_mut(&mut found.leverages, tracks, selection);
            for j in 0..tracks {
                of_track[j] = logarithm(of_track[j] / self.counts[j] + RESIDUAL_FLOOR);
                leverage[j] = logarithm(leverages[j] * ridge / views as f32 + RESIDUAL_FLOOR);
            }
            found.left.push(left);
        }
        found
    }

    /// `R` (3n x m) and the leverages of one selection.
    #[inline(always)]
    fn leave_one_out(&self, shares: &[f32], ridge: f32) -> (Vec<f32>, Vec<f32>) {
        let tracks = self.cloud.tracks();
        let inverse = inverse_scatter(&self.columns, shares, ridge);
        let mut left = product(&inverse, &self.columns, tracks);
        let mut leverages = vec![0.0; tracks];
        for (left, column) in left.chunks_exact(tracks).zip(self.columns.chunks_exact(tracks)) {
            for j in 0..tracks {
                leverages[j] += left[j] * column[j];
            }
        }
        let factors: Vec<f32> = shares
            .iter()
            .zip(&leverages)
            .map(|(share, leverage)| ridge / (1.0 - share * leverage).max(LEAVE_ONE_OUT_FLOOR))
            .collect();
        for left in left.chunks_exact_mut(tracks) {
            for (left, factor) in left.iter_mut().zip(&factors) {
                *left *= factor;
            }
        }
        (left, leverages)
    }

    /// Moves the states by what the selections left.
    #[inline(always)]
    fn advance(&mut self, block: &Block<Vec<f32>>, residuals: &Residuals) {
        let tracks = self.cloud.tracks();
        let selections = block.log_ridge.len();
        let mut pool = Pool::new(block.encoder.outputs(), tracks);
        for view in 0..self.cloud.views() {
            let visible = row(self.cloud.visible(), tracks, view);
            let logarithms = rows(&residuals.of_observations, tracks, view * selections, selections);
            let places = halved(rows(self.cloud.places(), tracks, 2 * view, 2));
            let inputs = [logarithms, &places, visible, residuals.of_pairs.of_view(view)];
            pool.add(block.encoder.affine(&inputs, tracks), visible);
        }
        let pooled = pool.finish(&self.counts);
        let inputs = [&self.tracks[..], &pooled, &halved(&residuals.of_tracks), &halved(&residuals.leverages)];
        let mut hidden = block.hidden.affine(&inputs, tracks);
        normalise_rows(&mut hidden, tracks);
        rectify(&mut hidden);
        let change = block.change.affine(&[&hidden, &self.tracks], tracks);
        accumulate(&mut self.tracks, &change);
    }

    /// Moves the depths towards what the mixture of the selections predicts, and fills what is unobserved.
    #[inline(always)]
    fn rescale(&mut self, block: &Block<Vec<f32>>, residuals: &Residuals) {
        let (views, tracks) = (self.cloud.views(), self.cloud.tracks());
        let mixture = softmin_over_rows(&residuals.of_tracks, tracks);
        let rate = 1.0 / (1.0 + (-block.depth_rate[0]).exp());
        let mut predicted = self.columns.clone();
        for (selection, left) in residuals.left.iter().enumerate() {
            let share = row(&mixture, tracks, selection);
            for (predicted, left) in predicted.chunks_exact_mut(tracks).zip(left.chunks_exact(tracks)) {
                for j in 0..tracks {
                    predicted[j] -= left[j] * share[j];
                }
            }
        }
        let mut mean_depths = vec![0.0f32; tracks];
        for view in 0..views {
            let visible = row(self.cloud.visible(), tracks, view);
            let [x, y] = [0, 1].map(|axis| row(self.cloud.places(), tracks, 2 * view + axis));
            let [px, py, pw] = [0, 1, 2].map(|k| row(&predicted, tracks, 3 * view + k));
            let depths = row_mut(&mut self.depths, tracks, view);
            for j in 0..tracks {
                let factor = (px[j] * x[j] + py[j] * y[j] + pw[j]) / (x[j] * x[j] + y[j] * y[j] + 1.0);
                depths[j] += rate * (factor.clamp(DEPTH_RANGE.0, DEPTH_RANGE.1) - depths[j]);
                mean_depths[j] += depths[j] * visible[j];
            }
        }
        for (mean, count) in mean_depths.iter_mut().zip(&self.counts) {
            *mean = (*mean / count).max(LEAST_MEAN_DEPTH);
        }
        for view in 0..views {
            let visible = row(self.cloud.visible(), tracks, view);
            let depths = row(&self.depths, tracks, view);
            for k in 0..3 {
                let predicted = row(&predicted, tracks, 3 * view + k);
                let column = row_mut(&mut self.columns, tracks, 3 * view + k);
                let places = (k < 2).then(|| row(self.cloud.places(), tracks, 2 * view + k));
                for j in 0..tracks {
                    let place = places.map_or(1.0, |places| places[j]);
                    let filled = predicted[j].clamp(-MOST_PREDICTED, MOST_PREDICTED) * (1.0 - visible[j]);
                    column[j] = depths[j] / mean_depths[j] * place * visible[j] + filled;
                }
            }
        }
    }

    /// Logits of the observations, from the last block's residuals.
    #[inline(always)]
    fn observations(&self, network: &SubspaceNet<Vec<f32>>, residuals: &Residuals) -> Vec<f32> {
        let (views, tracks) = (self.cloud.views(), self.cloud.tracks());
        let selections = residuals.left.len();
        let mut mean = vec![0.0; tracks];
        for of_track in residuals.of_tracks.chunks_exact(tracks) {
            accumulate(&mut mean, of_track);
        }
        mean.iter_mut().for_each(|mean| *mean *= 0.5 / selections as f32);
        let mut in_image = vec![0.0; selections * tracks];
        let mut logits = Vec::with_capacity(views * tracks);
        for view in 0..views {
            for (selection, left) in residuals.left.iter().enumerate() {
                let [x, y] = [0, 1].map(|k| row(left, tracks, 3 * view + k));
                for (j, of_image) in row_mut(&mut in_image, tracks, selection).iter_mut().enumerate() {
                    *of_image = 0.5 * logarithm(x[j] * x[j] + y[j] * y[j] + RESIDUAL_FLOOR);
                }
            }
            let visible = row(self.cloud.visible(), tracks, view);
            let logarithms = rows(&residuals.of_observations, tracks, view * selections, selections);
            let places = halved(rows(self.cloud.places(), tracks, 2 * view, 2));
            let of_pairs = residuals.of_pairs.of_view(view);
            let inputs = [logarithms, &in_image, &places, visible, &mean, &self.tracks, of_pairs];
            let mut hidden = network.observation_hidden.affine(&inputs, tracks);
            rectify(&mut hidden);
            logits.extend(network.observation_logit.affine(&[&hidden], tracks));
        }
        logits
    }
}
