//! How much memory a solve takes at most, from the shape of its input: for those who bound what runs at once.

use super::consensus::LEAST_INLIERS;

/// The networks' arrays: the trained one is asked about some 50,000 observations at a time, which takes 100 MB, the
/// paper's has less.
const NETWORK_BYTES: u128 = 128 << 20;

/// An observation as it came (44), normalised and by view (28), twice among those of an adjustment (40 each), its
/// coupling of a view with a point (168), and an allowance for the classification, the solution and the encoded result.
/// Measured: 424 with everything else that the process holds, at the peak of a job of 566,000 observations in 400 views.
const OBSERVATION_BYTES: u128 = 500;

/// A track: its coupling with the intrinsics (216), and an allowance for its point, the point's blocks in the
/// adjustment, its classification and its result.
const TRACK_BYTES: u128 = 600;

/// Unknowns of a view in the metric adjustment: its pose and a focal length of its own.
const METRIC_UNKNOWNS: u128 = 7;

/// Lower triangles of the metric system, where every two views share a point: its normal equations, what is left of
/// them once the points are eliminated, and its factor.
const METRIC_TRIANGLES: u128 = 3;

/// Unknowns of a view and of a point in the projective adjustment of complete tracks.
const PROJECTIVE_UNKNOWNS: (u128, u128) = (12, 4);

/// Square matrices of the projective system: itself and its factor.
const PROJECTIVE_SQUARES: u128 = 2;

/// Bytes of an f64.
const NUMBER: u128 = size_of::<f64>() as u128;

/// An upper estimate of the bytes that a solve of an input of this shape takes, whatever its observations say and its
/// settings ask for: those change how long it takes, not what it holds.
///
/// What grows without proportion is the system that couples views with each other. It is taken to be full, as where a
/// track leads through all views; that of an ordinary sequence is mostly empty. Camera groups of few views with many
/// free intrinsics each take more than is counted.
pub fn estimated_bytes(views: u32, tracks: u32, observations: u32) -> u64 {
    let (views, tracks, observations) = (u128::from(views), u128::from(tracks), u128::from(observations));
    let metric = METRIC_UNKNOWNS * views;
    let metric = METRIC_TRIANGLES * NUMBER * (metric * metric / 2);
    let projective = projective_unknowns(views, observations);
    let projective = PROJECTIVE_SQUARES * NUMBER * projective * projective;
    // One is gone before the other is built.
    let bytes = NETWORK_BYTES + OBSERVATION_BYTES * observations + TRACK_BYTES * tracks + metric.max(projective);
    u64::try_from(bytes).unwrap_or(u64::MAX)
}

/// Unknowns of the projective system of all views: those of the views, or of the points where they are half as many;
/// none where no tracks can be complete.
fn projective_unknowns(views: u128, observations: u128) -> u128 {
    let (of_view, of_point) = PROJECTIVE_UNKNOWNS;
    let complete_tracks = observations / views.max(1);
    if complete_tracks < LEAST_INLIERS as u128 {
        return 0;
    }
    let (views, points) = (of_view * views, of_point * complete_tracks);
    if points <= views / 2 { points } else { views }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_measured_is_below_the_estimate_and_not_far() {
        let estimated = estimated_bytes(400, 100_000, 566_000);
        assert!((240_000_000..1_000_000_000).contains(&estimated), "{estimated}");
    }

    #[test]
    fn more_of_anything_takes_no_less() {
        for shape in [[2, 8, 16], [10, 1_000, 5_000], [400, 100_000, 566_000], [2_000, 1_000_000, 4_000_000]] {
            let [views, tracks, observations] = shape;
            let estimated = estimated_bytes(views, tracks, observations);
            assert!(estimated_bytes(views, tracks + 1, observations) > estimated, "{shape:?}");
            assert!(estimated_bytes(views, tracks, observations + 1) > estimated, "{shape:?}");
        }
        assert!(estimated_bytes(2_000, 1_000, 4_000) > estimated_bytes(1_000, 1_000, 4_000));
    }

    #[test]
    fn no_shape_is_too_large_to_be_estimated() {
        assert_eq!(estimated_bytes(u32::MAX, u32::MAX, u32::MAX), u64::MAX);
    }
}
