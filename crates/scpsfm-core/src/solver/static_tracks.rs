//! Tracks that stay where they are in the image while others move: dirt, a watermark, the camera's own carrier.
//!
//! They agree on a camera that stands still, before any scene. Where they are many, a search finds nothing else, and they
//! hold every view that joins. Both therefore look at the others alone, and what comes of these holds no static track: a
//! camera that moves without turning would take them all for points infinitely far away. The far points of a drive and
//! the middle of an orbit, which stay in place too, are too few to count as static.

use nalgebra::Vector2;

use super::block::Block;
use super::consensus::LEAST_INLIERS;
use crate::domain::{VERIFIED, Warning, WarningCode};

options! {
    /// What counts as static.
    pub struct StaticTrackOptions {
        /// What a static track spreads by at most, normalised units. What a detector errs by: two pixels in a thousand.
        most_spread: f64 = 0.002,
        /// How far the others move, as a quantile of how far tracks spread about their mean: that of a moving track as
        /// long as no larger share is static. Where more is static, hardly anything is left to find.
        moving_quantile: f64 = 0.8,
        /// Share of that which a static track spreads by at most. What moves by less than twenty times the noise of a
        /// static track determines little either way.
        most_share: f64 = 0.05,
        /// Static tracks, and share of all, below which they hide nothing. As many as make a consensus of their own.
        least_static: usize = LEAST_INLIERS,
        /// Of a drive some tracks in twenty are far away, straight ahead, and say how the camera turns.
        least_share: f64 = 0.1,
        /// Others that a search needs. Half of them may be wrong.
        least_moving: usize = 2 * LEAST_INLIERS,
    }
}

const OPTIONS: StaticTrackOptions = StaticTrackOptions::DEFAULT;

/// Which tracks are static; none where they are few or nearly all.
///
/// * `ranges`: observations of each track
/// * `xy`: normalised image points
pub fn find(ranges: &[usize], xy: &[Vector2<f64>]) -> Vec<bool> {
    let tracks = || ranges.windows(2).map(|range| range[0]..range[1]);
    // Of one or two observations a track may stand still by chance.
    let spreads: Vec<Option<f64>> =
        tracks().map(|range| (range.len() >= VERIFIED).then(|| spread(&xy[range]))).collect();
    let mut sorted: Vec<f64> = spreads.iter().flatten().copied().collect();
    sorted.sort_by(f64::total_cmp);
    let moving = sorted.get((OPTIONS.moving_quantile * sorted.len() as f64) as usize).copied().unwrap_or(0.0);
    let most = (OPTIONS.most_share * moving).min(OPTIONS.most_spread);
    let is_static: Vec<bool> = spreads.iter().map(|spread| spread.is_some_and(|spread| spread < most)).collect();
    let count = is_static.iter().filter(|is_static| **is_static).count();
    let are_many = count >= OPTIONS.least_static && count as f64 >= OPTIONS.least_share * sorted.len() as f64;
    match are_many && sorted.len() - count >= OPTIONS.least_moving {
        true => is_static,
        false => vec![false; is_static.len()],
    }
}

/// The block without static tracks; `None` where it has none, or too little beside them.
///
/// * `is_static`: whether each track of the input is static
pub fn without(is_static: &[bool], block: &Block) -> Option<Block> {
    let moving = moving(is_static, block);
    (moving.len() < block.tracks.len() && moving.len() >= OPTIONS.least_moving).then(|| block.select(&moving))
}

/// The tracks of a block that are not static, by their place in it.
pub fn moving(is_static: &[bool], block: &Block) -> Vec<usize> {
    (0..block.tracks.len()).filter(|&k| !is_static[block.tracks[k]]).collect()
}

/// What is said of static tracks that are no part of the scene; `None` of few.
///
/// * `inlier`: whether each track is of the scene
pub fn warning(is_static: &[bool], inlier: &[bool]) -> Option<Warning> {
    let outside = is_static.iter().zip(inlier).filter(|(is_static, inlier)| **is_static && !**inlier).count();
    let detail = format!(
        "{outside} tracks stay where they are in the image while others move, and the scene holds none of them"
    );
    (outside >= OPTIONS.least_static).then(|| Warning::new(WarningCode::StaticTracks, detail))
}

/// Root mean square distance of the observations of a track from their mean.
fn spread(seen: &[Vector2<f64>]) -> f64 {
    let mean = seen.iter().sum::<Vector2<f64>>() / seen.len() as f64;
    (seen.iter().map(|seen| (seen - mean).norm_squared()).sum::<f64>() / seen.len() as f64).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Tracks of four observations each: so many that stay, within a pixel in a thousand, and so many that move by this.
    fn found(staying: usize, moving: usize, by: f64) -> usize {
        let xy: Vec<Vector2<f64>> = (0..staying + moving)
            .flat_map(|track| {
                let step = if track < staying { 0.0005 } else { by };
                (0..4).map(move |k| Vector2::new(0.01 * track as f64 + step * f64::from(k), 0.3))
            })
            .collect();
        let ranges: Vec<usize> = (0..=staying + moving).map(|track| 4 * track).collect();
        find(&ranges, &xy).into_iter().filter(|is_static| *is_static).count()
    }

    #[test]
    fn what_stays_beside_what_moves_is_static() {
        assert_eq!(found(30, 20, 0.05), 30);
        assert_eq!(found(0, 50, 0.05), 0);
    }

    #[test]
    fn nothing_is_static_where_little_moves_or_nearly_everything_stays() {
        assert_eq!(found(30, 20, 0.002), 0, "the others hardly move");
        assert_eq!(found(50, OPTIONS.least_moving - 1, 0.05), 0, "too few others");
        assert_eq!(found(90, 16, 0.05), 0, "the camera stands still, and little moves");
        assert_eq!(found(OPTIONS.least_static - 1, 40, 0.05), 0, "too few to hide anything");
        assert_eq!(found(OPTIONS.least_static, 80, 0.05), 0, "too few of all");
        assert_eq!(find(&[0], &[]), Vec::<bool>::new());
    }
}
