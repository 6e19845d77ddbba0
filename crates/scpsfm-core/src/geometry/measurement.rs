//! Normalised measurements: what every later step works on, as types that cannot be confused with pixels.

use nalgebra::{DMatrix, Matrix3, Vector2};

use super::Camera;
use super::observation::Observation;

/// One common similarity for all views of one camera: `x = (x_px - centre) / scale`.
///
/// # Pitfall
/// The scale is one number for all views. A transform a view (Hartley's) would make the calibration differ from view
/// to view, and a constant K could no longer be asked for.
#[derive(Debug, Clone, PartialEq)]
pub struct Normalization {
    /// Assumed principal point of each view in pixels.
    pub centres_px: Vec<Vector2<f64>>,
    /// Largest image side in pixels.
    pub scale_px: f64,
}

impl Normalization {
    /// Pixels of `view` to normalised coordinates.
    pub fn normalize(&self, view: usize, point_px: [f64; 2]) -> Vector2<f64> {
        (Vector2::from(point_px) - self.centres_px[view]) / self.scale_px
    }

    /// The inverse transform of `view` as a homography, normalised to pixels.
    pub fn to_pixels(&self, view: usize) -> Matrix3<f64> {
        let centre = self.centres_px[view];
        Matrix3::new(self.scale_px, 0.0, centre.x, 0.0, self.scale_px, centre.y, 0.0, 0.0, 1.0)
    }

    /// A camera that projects to pixels instead of normalised coordinates.
    pub fn camera_px(&self, view: usize, camera: &Camera) -> Camera {
        self.to_pixels(view) * camera
    }
}

/// Tracks that are complete over a set of views, normalised.
///
/// Stored track by track; `observations[track * views + view]`.
#[derive(Debug, Clone)]
pub struct CompleteBlock {
    views: usize,
    tracks: usize,
    observations: Vec<Observation>,
    /// Projective depths in the order of the observations.
    depths: Option<Vec<f64>>,
}

impl CompleteBlock {
    /// A block of `views` x `tracks` points given track by track, with depths in the same order or none.
    ///
    /// # Panics
    /// When the number of points or depths is not `views * tracks`: a defect of the caller.
    pub fn new(views: usize, tracks: usize, points: &[Vector2<f64>], depths: Option<Vec<f64>>) -> Self {
        assert_eq!(points.len(), views * tracks, "a complete block has a point for every view and track");
        assert!(depths.as_ref().is_none_or(|depths| depths.len() == points.len()), "one depth a point");
        let observations =
            points.iter().enumerate().map(|(k, &xy)| Observation::new(k % views, k / views, xy)).collect();
        Self { views, tracks, observations, depths }
    }

    pub fn views(&self) -> usize {
        self.views
    }

    pub fn tracks(&self) -> usize {
        self.tracks
    }

    /// The observations of a track, one a view, in the order of the views.
    pub fn track(&self, track: usize) -> &[Observation] {
        &self.observations[track * self.views..(track + 1) * self.views]
    }

    pub fn point(&self, view: usize, track: usize) -> Vector2<f64> {
        self.observations[track * self.views + view].xy
    }

    pub fn has_depths(&self) -> bool {
        self.depths.is_some()
    }

    /// The depths, `depths[track * views + view]`; `None` where none were given.
    pub fn depths(&self) -> Option<&[f64]> {
        self.depths.as_deref()
    }

    /// The same points with these depths, `depths[track * views + view]`.
    ///
    /// # Panics
    /// When the number of depths is not that of the points: a defect of the caller.
    pub fn with_depths(&self, depths: Vec<f64>) -> Self {
        assert_eq!(depths.len(), self.observations.len(), "one depth a point");
        Self { depths: Some(depths), ..self.clone() }
    }

    /// The block restricted to some of its tracks.
    pub fn select(&self, tracks: &[usize]) -> Self {
        let points: Vec<Vector2<f64>> = tracks.iter().flat_map(|&j| self.track(j).iter().map(|s| s.xy)).collect();
        let depths = self.depths.as_ref().map(|depths| {
            tracks.iter().flat_map(|&j| depths[j * self.views..(j + 1) * self.views].iter().copied()).collect()
        });
        Self::new(self.views, tracks.len(), &points, depths)
    }

    /// The measurement matrix, 3n x m: column j is track j, block row i is view i, entries `lambda (u, v, 1)`, with
    /// lambda = 1 where no depths were given.
    pub fn measurement_matrix(&self) -> DMatrix<f64> {
        DMatrix::from_fn(3 * self.views, self.tracks, |row, track| {
            let depth = self.depths.as_ref().map_or(1.0, |depths| depths[track * self.views + row / 3]);
            depth * self.point(row / 3, track).push(1.0)[row % 3]
        })
    }

    /// Every view's points centred on their median and divided by 1.5 times the median absolute deviation:
    /// column j holds the 2n coordinates of track j. The affine search works on these.
    ///
    /// A view whose points coincide keeps them at zero rather than dividing by it.
    pub fn centred_by_view(&self) -> DMatrix<f64> {
        let mut matrix = DMatrix::zeros(2 * self.views, self.tracks);
        for view in 0..self.views {
            let coordinate = |axis: usize| -> f64 {
                let mut values: Vec<f64> = (0..self.tracks).map(|j| self.point(view, j)[axis]).collect();
                super::statistics::median(&mut values)
            };
            let centre = Vector2::new(coordinate(0), coordinate(1));
            let mut deviations: Vec<f64> = (0..self.tracks)
                .flat_map(|j| {
                    let offset = self.point(view, j) - centre;
                    [offset.x.abs(), offset.y.abs()]
                })
                .collect();
            let spread = 1.5 * super::statistics::median(&mut deviations);
            let scale = if spread > f64::MIN_POSITIVE { 1.0 / spread } else { 0.0 };
            for track in 0..self.tracks {
                let offset = (self.point(view, track) - centre) * scale;
                matrix[(2 * view, track)] = offset.x;
                matrix[(2 * view + 1, track)] = offset.y;
            }
        }
        matrix
    }
}

/// Rounds of [`balance`]; the third changes entries by less than a part in a thousand.
const BALANCING_ROUNDS: usize = 3;

/// Balances a measurement matrix (3n x m): view blocks to equal energy, columns to unit norm, in turn.
///
/// Only projective depths are rescaled, so rank and column space up to a row scaling stay as they are, and arbitrary
/// scales of views and tracks in the given depths cancel (Sturm & Triggs 1996, section 3.3). Zero blocks and columns
/// stay zero.
pub fn balance(matrix: &DMatrix<f64>) -> DMatrix<f64> {
    let mut balanced = matrix.clone();
    let views = matrix.nrows() / 3;
    let block_energy = matrix.ncols() as f64 / views.max(1) as f64;
    for _ in 0..BALANCING_ROUNDS {
        for view in 0..views {
            let mut block = balanced.rows_mut(3 * view, 3);
            let energy = block.norm_squared();
            if energy > f64::MIN_POSITIVE {
                block *= (block_energy / energy).sqrt();
            }
        }
        for mut column in balanced.column_iter_mut() {
            let norm = column.norm();
            if norm > f64::MIN_POSITIVE {
                column /= norm;
            }
        }
    }
    balanced
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn balancing_cancels_scales_of_views_and_tracks() {
        let plain = DMatrix::from_fn(9, 7, |i, j| ((3 * i + 5 * j) as f64).sin() + 0.3 * (i as f64));
        let scaled = DMatrix::from_fn(9, 7, |i, j| plain[(i, j)] * (1.0 + (i / 3) as f64) * (0.5 + j as f64));
        let difference = (balance(&plain) - balance(&scaled)).amax();
        assert!(difference < 2e-3, "{difference}");
        for column in balance(&scaled).column_iter() {
            assert!((column.norm() - 1.0).abs() < 1e-12);
        }
    }

    #[test]
    fn balancing_leaves_zero_columns_alone() {
        let mut matrix = DMatrix::from_element(6, 3, 1.0);
        matrix.column_mut(1).fill(0.0);
        assert!(balance(&matrix).column(1).iter().all(|&entry| entry == 0.0));
    }

    #[test]
    fn a_camera_in_pixels_projects_where_the_normalised_one_does() {
        let normalization = Normalization { centres_px: vec![Vector2::new(319.5, 239.5)], scale_px: 640.0 };
        let camera = Camera::new(1.2, 0.0, 0.1, 0.3, 0.0, 1.2, -0.1, 0.2, 0.0, 0.0, 1.0, 2.0);
        let point = nalgebra::Vector4::new(0.3, -0.2, 1.5, 1.0);
        let (near, px) = (camera * point, normalization.camera_px(0, &camera) * point);
        let back = normalization.normalize(0, [px.x / px.z, px.y / px.z]);
        assert!((back - Vector2::new(near.x / near.z, near.y / near.z)).norm() < 1e-12);
    }

    #[test]
    fn depths_scale_the_columns_entries() {
        let points = [Vector2::new(0.1, 0.2), Vector2::new(0.3, 0.4)];
        let block = CompleteBlock::new(2, 1, &points, Some(vec![2.0, 3.0]));
        let column: Vec<f64> = block.measurement_matrix().iter().copied().collect();
        let expected = [0.2, 0.4, 2.0, 0.9, 1.2, 3.0];
        assert!(column.iter().zip(expected).all(|(found, expected)| (found - expected).abs() < 1e-12));
    }
}
