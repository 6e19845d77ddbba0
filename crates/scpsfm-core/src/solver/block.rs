//! A set of views with the tracks that are seen in all of them.

use nalgebra::Vector2;
use rand::SeedableRng;
use rand::seq::index;
use rand_chacha::ChaCha8Rng;

use super::normalization::normalization;
use crate::domain::Input;
use crate::geometry::measurement::CompleteBlock;
use crate::geometry::statistics::median;

/// A set of views with the tracks that are seen in all of them.
#[derive(Debug, Clone)]
pub struct Block {
    /// Views of the input, increasing.
    pub views: Vec<usize>,
    /// Tracks of the input, increasing.
    pub tracks: Vec<usize>,
    /// Their points; view `i` and track `j` are `views[i]` and `tracks[j]` of the input.
    pub complete: CompleteBlock,
}

impl Block {
    /// The block of at most `most` of its tracks, chosen at random; `seed` decides which.
    pub fn sample(self, most: usize, seed: u64) -> Self {
        self.sample_with(most, seed, &[])
    }

    /// The same; tracks of the input that are among `kept` (increasing) stay in any case.
    pub fn sample_with(self, most: usize, seed: u64, kept: &[usize]) -> Self {
        if self.tracks.len() <= most {
            return self;
        }
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut chosen = index::sample(&mut rng, self.tracks.len(), most).into_vec();
        chosen.extend((0..self.tracks.len()).filter(|&j| kept.binary_search(&self.tracks[j]).is_ok()));
        chosen.sort_unstable();
        chosen.dedup();
        self.select(&chosen)
    }

    /// The block of these of its tracks, increasing.
    pub fn select(&self, chosen: &[usize]) -> Self {
        let tracks = chosen.iter().map(|&j| self.tracks[j]).collect();
        Self { views: self.views.clone(), tracks, complete: self.complete.select(chosen) }
    }
}

/// The block of all views of an input.
pub fn of_all_views(input: &Input) -> Block {
    let (normalization, _) = normalization(input);
    let xy = |k| normalization.normalize(input.view_of(k), input.point_px(k));
    extract(input, &input.track_ranges(), xy, &(0..input.view_count()).collect::<Vec<_>>())
}

/// The block of these views: all tracks that are complete over them, with their depths in a unit in which these are
/// about 1.
///
/// * `xy`: normalised image point of an observation
pub fn extract(input: &Input, ranges: &[usize], xy: impl Fn(usize) -> Vector2<f64>, views: &[usize]) -> Block {
    let mut place = vec![None; input.view_count()];
    for (i, &view) in views.iter().enumerate() {
        place[view] = Some(i);
    }
    let mut tracks = Vec::new();
    let mut points = Vec::new();
    let mut depths = Vec::new();
    for track in 0..input.track_count() {
        // Observations of a track are sorted by view, and so are the views of a block.
        let inside: Vec<usize> =
            (ranges[track]..ranges[track + 1]).filter(|&k| place[input.view_of(k)].is_some()).collect();
        if inside.len() == views.len() {
            tracks.push(track);
            for k in inside {
                points.push(xy(k));
                depths.extend(input.depth(k));
            }
        }
    }
    let unit = unit_of(&depths);
    depths.iter_mut().for_each(|depth| *depth /= unit);
    let depths = input.has_depths().then_some(depths);
    let complete = CompleteBlock::new(views.len(), tracks.len(), &points, depths);
    Block { views: views.to_vec(), tracks, complete }
}

/// The power of two nearest to the median size of depths, by which to divide changes no digit: callers may give them in
/// any unit, of which positions and translations would have the size, and adjustment would lose its accuracy.
fn unit_of(depths: &[f64]) -> f64 {
    let mut sizes: Vec<f64> = depths.iter().map(|depth| depth.abs()).collect();
    if sizes.is_empty() { 1.0 } else { median(&mut sizes).log2().round().exp2() }
}
