//! The one type that every kind of input ends as: observations of tracks in views.

mod checks;

use serde::{Deserialize, Serialize};

pub(in crate::domain) use self::checks::check_position;
pub use self::checks::too_few_views;
use super::error::{InvalidInput, Violations, quoted};
use super::joined_tracks::{JoinedTracks, Joining};
use super::limits::Limits;

/// Width and height of an image in pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ImageSize {
    pub width_px: u32,
    pub height_px: u32,
}

impl ImageSize {
    /// Sides above this are a unit mistake: no camera has them.
    pub const MAX_SIDE_PX: u32 = 1_000_000;
}

/// What the caller knows of the focal length beforehand (EXIF, a network's guess).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct FocalPrior {
    pub focal_px: f64,
    /// One standard deviation of the natural logarithm of the focal length.
    pub sigma_log: f64,
}

impl FocalPrior {
    /// Values outside are mistakes of the unit: the largest is a field of view of a thousandth of a radian in the
    /// [largest](ImageSize::MAX_SIDE_PX) image.
    pub const FOCAL_RANGE_PX: (f64, f64) = (1e-6, 1e9);
    /// A smaller value is finer than any calibration, a larger one says nothing.
    pub const SIGMA_LOG_RANGE: (f64, f64) = (1e-9, 1e3);
}

/// One image.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct View {
    /// The image's name, such as its file's; no two views have the same.
    pub name: Option<Box<str>>,
    /// The image's size; where unknown, the extent of the points stands in, with a warning.
    pub size: Option<ImageSize>,
    /// Views of one group share one constant calibration.
    pub camera_group: u32,
    pub focal_prior: Option<FocalPrior>,
}

impl View {
    /// Longest name in bytes: paths have at most 4,096 on the usual systems.
    pub const MAX_NAME_BYTES: usize = 4096;

    /// Whether a text can be a view's name.
    ///
    /// # Errors
    /// Empty, too long, or with control characters, which would break the lines of result files.
    pub fn check_name(name: &str) -> Result<(), String> {
        if name.is_empty() {
            Err("has no name".into())
        } else if name.len() > Self::MAX_NAME_BYTES {
            Err(format!("the name {} is longer than {} bytes", quoted(name), Self::MAX_NAME_BYTES))
        } else if name.chars().any(char::is_control) {
            Err(format!("the name {} holds control characters", quoted(name)))
        } else {
            Ok(())
        }
    }
}

/// An input as a caller states it, before any check. Structure of arrays: one entry an observation.
///
/// Field names in violations are prefixed by `prefix`, so that each transport names its own fields.
#[derive(Debug, Clone, Default)]
pub struct RawInput {
    pub views: Vec<View>,
    pub track_count: usize,
    /// View of each observation, counted from 0.
    pub view: Vec<u32>,
    /// Track of each observation, counted from 0.
    pub track: Vec<u32>,
    /// Pixels; the centre of the top-left pixel is (0, 0).
    pub x: Vec<f64>,
    pub y: Vec<f64>,
    /// Projective depths, all or none; empty: none.
    pub depth: Vec<f64>,
    /// Standard deviation of a coordinate of each observation in pixels, all or none; empty: all are as noisy.
    pub sigma: Vec<f64>,
}

/// A checked input: every number finite, every index in range, no observation twice, something in at least two views.
///
/// Observations are sorted by (track, view). Tracks and views keep the caller's indices; a track or a view may be
/// without observations (padding).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Input {
    views: Vec<View>,
    track_count: usize,
    view: Vec<u32>,
    track: Vec<u32>,
    x: Vec<f64>,
    y: Vec<f64>,
    depth: Option<Vec<f64>>,
    /// Position of each observation in the caller's order.
    caller_order: Vec<u32>,
    sigma: Option<Vec<f64>>,
    /// Of an input that was joined from matches.
    #[serde(default)]
    joining: Option<Joining>,
}

impl Input {
    /// Coordinates beyond this many pixels are a unit mistake or a hostile file.
    pub const MAX_COORDINATE_PX: f64 = 1e7;

    /// Sizes that a projective depth may have: its scale is free, and squares of these stay far from overflow.
    pub const DEPTH_RANGE: (f64, f64) = (1e-30, 1e30);

    /// Standard deviations that an observation may have, pixels: their squares weigh observations against each other,
    /// and a computer tells no more than 1e16 from 1.
    pub const SIGMA_RANGE: (f64, f64) = (1e-4, 1e4);

    /// Checks a raw input and sorts its observations.
    ///
    /// # Errors
    /// Every violation found, its field prefixed by `prefix` (`track_set`, `measurement_matrix`).
    pub fn new(raw: RawInput, limits: &Limits, prefix: &str) -> Result<Self, InvalidInput> {
        let field = |name: &str| format!("{prefix}.{name}");
        let mut found = Violations::default();
        checks::check_counts(&raw, limits, &field, &mut found);
        checks::check_views(&raw.views, &field, &mut found);
        found.into_result()?;
        let mut found = Violations::default();
        checks::check_observations(&raw, &field, &mut found);
        let mut order: Vec<u32> = (0..raw.view.len() as u32).collect();
        order.sort_by_key(|&k| (raw.track[k as usize], raw.view[k as usize], k));
        checks::check_duplicates(&raw, &order, &field, &mut found);
        checks::check_views_with_observations(&raw, &field, &mut found);
        found.into_result()?;
        let pick = |values: &[f64]| order.iter().map(|&k| values[k as usize]).collect::<Vec<f64>>();
        Ok(Self {
            view: order.iter().map(|&k| raw.view[k as usize]).collect(),
            track: order.iter().map(|&k| raw.track[k as usize]).collect(),
            x: pick(&raw.x),
            y: pick(&raw.y),
            depth: (!raw.depth.is_empty()).then(|| pick(&raw.depth)),
            sigma: (!raw.sigma.is_empty()).then(|| pick(&raw.sigma)),
            views: raw.views,
            track_count: raw.track_count,
            caller_order: order,
            joining: None,
        })
    }

    /// The same input, joined from matches in this way.
    pub(super) fn joined_by(self, joining: Joining) -> Self {
        Self { joining: Some(joining), ..self }
    }

    /// The input restricted to the observations for which `keeps` is true. Views and tracks keep their indices, also
    /// where nothing is left of them; [`Self::caller_index`] counts the kept observations in sorted order.
    ///
    /// * `keeps`: of an observation's place in sorted order
    pub fn restricted_to(&self, keeps: impl Fn(usize) -> bool) -> Self {
        let kept: Vec<usize> = (0..self.observation_count()).filter(|&k| keeps(k)).collect();
        let pick = |values: &[f64]| kept.iter().map(|&k| values[k]).collect::<Vec<f64>>();
        Self {
            views: self.views.clone(),
            track_count: self.track_count,
            view: kept.iter().map(|&k| self.view[k]).collect(),
            track: kept.iter().map(|&k| self.track[k]).collect(),
            x: pick(&self.x),
            y: pick(&self.y),
            depth: self.depth.as_deref().map(pick),
            sigma: self.sigma.as_deref().map(pick),
            caller_order: (0..kept.len() as u32).collect(),
            joining: None,
        }
    }

    /// Observations and keypoints of an input that was joined from matches, in the caller's order; `None` for others.
    pub fn joined_tracks(&self) -> Option<JoinedTracks> {
        let joining = self.joining.clone()?;
        let RawInput { view, track, .. } = self.to_raw();
        Some(JoinedTracks { view, track, joining })
    }

    pub fn views(&self) -> &[View] {
        &self.views
    }

    pub fn view_count(&self) -> usize {
        self.views.len()
    }

    pub fn track_count(&self) -> usize {
        self.track_count
    }

    pub fn observation_count(&self) -> usize {
        self.view.len()
    }

    /// View of observation `k` (sorted order).
    pub fn view_of(&self, k: usize) -> usize {
        self.view[k] as usize
    }

    /// Track of observation `k` (sorted order).
    pub fn track_of(&self, k: usize) -> usize {
        self.track[k] as usize
    }

    /// Pixel coordinates of observation `k` (sorted order).
    pub fn point_px(&self, k: usize) -> [f64; 2] {
        [self.x[k], self.y[k]]
    }

    /// Whether projective depths were given.
    pub fn has_depths(&self) -> bool {
        self.depth.is_some()
    }

    /// Projective depth of observation `k` (sorted order), if depths were given.
    pub fn depth(&self, k: usize) -> Option<f64> {
        self.depth.as_ref().map(|depth| depth[k])
    }

    /// Whether standard deviations of the observations were given.
    pub fn has_sigmas(&self) -> bool {
        self.sigma.is_some()
    }

    /// Standard deviation of a coordinate of observation `k` (sorted order) in pixels, if these were given.
    pub fn sigma_px(&self, k: usize) -> Option<f64> {
        self.sigma.as_ref().map(|sigma| sigma[k])
    }

    /// Where the observations of each track lie in sorted order: those of track `j` are `ranges[j]..ranges[j + 1]`.
    pub fn track_ranges(&self) -> Vec<usize> {
        let mut ends = vec![0; self.track_count() + 1];
        for k in 0..self.observation_count() {
            ends[self.track_of(k) + 1] += 1;
        }
        for track in 0..self.track_count() {
            ends[track + 1] += ends[track];
        }
        ends
    }

    /// Where observation `k` (sorted order) stood in the caller's arrays.
    pub fn caller_index(&self, k: usize) -> usize {
        self.caller_order[k] as usize
    }

    /// The input as its caller stated it, observations in the caller's order.
    pub fn to_raw(&self) -> RawInput {
        let count = self.observation_count();
        let mut raw = RawInput {
            views: self.views.clone(),
            track_count: self.track_count,
            view: vec![0; count],
            track: vec![0; count],
            x: vec![0.0; count],
            y: vec![0.0; count],
            depth: if self.has_depths() { vec![0.0; count] } else { Vec::new() },
            sigma: if self.sigma.is_some() { vec![0.0; count] } else { Vec::new() },
        };
        for k in 0..count {
            let to = self.caller_index(k);
            raw.view[to] = self.view[k];
            raw.track[to] = self.track[k];
            raw.x[to] = self.x[k];
            raw.y[to] = self.y[k];
            if let Some(depth) = &self.depth {
                raw.depth[to] = depth[k];
            }
            if let Some(sigma) = &self.sigma {
                raw.sigma[to] = sigma[k];
            }
        }
        raw
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// Four observations, not in order.
    pub fn raw() -> RawInput {
        RawInput {
            views: vec![View::default(); 2],
            track_count: 2,
            view: vec![1, 0, 0, 1],
            track: vec![1, 1, 0, 0],
            x: vec![3.0, 2.0, 0.0, 1.0],
            y: vec![30.0, 20.0, 0.0, 10.0],
            depth: Vec::new(),
            sigma: Vec::new(),
        }
    }

    #[test]
    fn sorts_and_remembers_the_callers_order() {
        let input = Input::new(raw(), &Limits::default(), "track_set").expect("valid");
        let points: Vec<f64> = (0..4).map(|k| input.point_px(k)[0]).collect();
        assert_eq!(points, [0.0, 1.0, 2.0, 3.0]);
        assert_eq!((0..4).map(|k| input.caller_index(k)).collect::<Vec<_>>(), [2, 3, 1, 0]);
        let back = input.to_raw();
        assert_eq!((back.view, back.track, back.x), (raw().view, raw().track, raw().x));
    }

    #[test]
    fn a_restricted_input_keeps_indices_and_all_that_is_known_of_an_observation() {
        let all = RawInput { depth: vec![4.0, 3.0, 1.0, 2.0], sigma: vec![0.4, 0.3, 0.1, 0.2], ..raw() };
        let input = Input::new(all, &Limits::default(), "track_set").expect("valid");
        let rest = input.restricted_to(|k| k != 1);
        assert_eq!((rest.view_count(), rest.track_count(), rest.observation_count()), (2, 2, 3));
        let seen = |input: &Input, k: usize| {
            (input.view_of(k), input.track_of(k), input.point_px(k), input.depth(k), input.sigma_px(k))
        };
        let of_all = [0, 2, 3].map(|k| seen(&input, k));
        assert_eq!([0, 1, 2].map(|k| seen(&rest, k)), of_all);
        assert_eq!((rest.track_ranges(), rest.caller_index(2)), (vec![0, 1, 3], 2));
    }
}
