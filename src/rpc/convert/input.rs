//! Inputs as they arrive, in one message or in chunks, and as a client sends them.

use std::borrow::Borrow;

use super::{matches, matrix, size_to_wire};
use crate::domain::{FocalPrior, ImageSize, Input, InvalidInput, Limits, RawInput, View, Violation};
use crate::engine::StoredInput;
use crate::rpc::proto;
use proto::create_job_request::Source as Inline;

/// Name of a track set in violations.
const TRACK_SET: &str = "track_set";

/// Bytes of an observation in memory at most: a view, a track, and four reals.
pub const OBSERVATION_BYTES: u64 = 2 * 4 + 4 * 8;

/// Observations in one chunk that a client sends: at most 2.8 MB, well below any server's message limit.
const CHUNK_OBSERVATIONS: usize = 65_536;

/// An input that may not be complete yet. Never holds more than the limits allow and one message on top.
#[derive(Debug)]
pub struct Draft {
    body: Body,
    limits: Limits,
}

#[derive(Debug)]
enum Body {
    TrackSet(proto::TrackSet),
    Matrix(proto::MeasurementMatrix),
    Matches(proto::MatchSet),
}

impl Body {
    /// Its name in a request.
    fn name(&self) -> &'static str {
        match self {
            Body::TrackSet(_) => TRACK_SET,
            Body::Matrix(_) => matrix::MATRIX,
            Body::Matches(_) => matches::MATCH_SET,
        }
    }

    /// The refusal of a chunk of another kind.
    fn is_no(&self, chunk: &str) -> InvalidInput {
        Violation::of(chunk, format!("the config holds a {}", self.name())).into()
    }
}

impl Draft {
    /// Begins with what came with the job: a whole input or the head of one.
    ///
    /// # Errors
    /// A violation of `source` where there is none; see [`Draft::check_size`].
    pub fn begin(input: Option<Inline>, limits: &Limits) -> Result<Self, InvalidInput> {
        let body = match input {
            Some(Inline::TrackSet(set)) => Body::TrackSet(set),
            Some(Inline::MeasurementMatrix(matrix)) => Body::Matrix(matrix),
            Some(Inline::MatchSet(set)) => Body::Matches(set),
            Some(Inline::Input(_)) | None => {
                return Err(Violation::of(
                    "source",
                    "is not set; give a track_set, a measurement_matrix, a match_set or the name of an uploaded input",
                )
                .into());
            }
        };
        Ok(Self { body, limits: limits.clone() })
    }

    /// Appends observations.
    ///
    /// # Errors
    /// A violation where the input is of another kind; see [`Draft::check_size`].
    pub fn append_track_set(&mut self, mut chunk: proto::TrackSetChunk) -> Result<(), InvalidInput> {
        let Body::TrackSet(set) = &mut self.body else {
            return Err(self.body.is_no("track_set_chunk"));
        };
        set.view_indices.append(&mut chunk.view_indices);
        set.track_indices.append(&mut chunk.track_indices);
        set.xs.append(&mut chunk.xs);
        set.ys.append(&mut chunk.ys);
        set.sigmas_px.append(&mut chunk.sigmas_px);
        set.depths.append(&mut chunk.depths);
        Ok(())
    }

    /// Appends numbers and visibility.
    ///
    /// # Errors
    /// A violation where the input is of another kind; see [`Draft::check_size`].
    pub fn append_matrix(&mut self, mut chunk: proto::MeasurementMatrixChunk) -> Result<(), InvalidInput> {
        let Body::Matrix(matrix) = &mut self.body else {
            return Err(self.body.is_no("measurement_matrix_chunk"));
        };
        matrix.values.append(&mut chunk.values);
        matrix.visibility.append(&mut chunk.visibility);
        Ok(())
    }

    /// Appends keypoints, pairs and matches.
    ///
    /// # Errors
    /// A violation where the input is of another kind; see [`Draft::check_size`].
    pub fn append_match_set(&mut self, chunk: proto::MatchSetChunk) -> Result<(), InvalidInput> {
        let Body::Matches(set) = &mut self.body else { return Err(self.body.is_no("match_set_chunk")) };
        matches::append(set, chunk);
        Ok(())
    }

    /// Refuses what is above the limits already, by what is claimed and by what has arrived, so that an endless
    /// stream ends early.
    ///
    /// # Errors
    /// A violation of the first field that is too long.
    pub fn check_size(&self) -> Result<(), InvalidInput> {
        match &self.body {
            Body::TrackSet(set) => check_track_set_size(set, &self.limits),
            Body::Matrix(matrix) => matrix::check_size(matrix, &self.limits),
            Body::Matches(set) => matches::check_size(set, &self.limits),
        }
    }

    /// Bytes that its arrays take in memory; those of matches count as often as joining needs them.
    pub fn bytes(&self) -> u64 {
        fn of<T>(array: &Vec<T>) -> u64 {
            (array.capacity() * size_of::<T>()) as u64
        }
        match &self.body {
            Body::TrackSet(set) => {
                let reals = [&set.xs, &set.ys, &set.sigmas_px, &set.depths].map(of).into_iter().sum::<u64>();
                of(&set.views) + of(&set.view_indices) + of(&set.track_indices) + reals
            }
            Body::Matrix(matrix) => of(&matrix.views) + of(&matrix.values) + of(&matrix.visibility),
            Body::Matches(set) => {
                let pairs = [&set.first_view_indices, &set.second_view_indices, &set.match_counts];
                let matches =
                    [&set.first_keypoint_indices, &set.second_keypoint_indices].map(of).into_iter().sum::<u64>();
                of(&set.views)
                    + of(&set.keypoint_counts)
                    + of(&set.xs)
                    + of(&set.ys)
                    + pairs.map(of).into_iter().sum::<u64>()
                    + matches::JOINING_COPIES * matches
            }
        }
    }

    /// Checks the whole.
    ///
    /// # Errors
    /// Every violation found, by field and index.
    pub fn finish(self) -> Result<Input, InvalidInput> {
        match self.body {
            Body::TrackSet(set) => Input::new(track_set_to_raw(set), &self.limits, TRACK_SET),
            Body::Matrix(matrix) => matrix::to_input(matrix, &self.limits),
            Body::Matches(set) => matches::to_raw(set).into_input(&self.limits, matches::MATCH_SET),
        }
    }
}

pub(super) fn check_track_set_size(set: &proto::TrackSet, limits: &Limits) -> Result<(), InvalidInput> {
    let lengths = [
        ("views", set.views.len(), limits.max_views),
        ("track_count", set.track_count as usize, limits.max_tracks),
        ("view_indices", set.view_indices.len(), limits.max_observations),
        ("track_indices", set.track_indices.len(), limits.max_observations),
        ("xs", set.xs.len(), limits.max_observations),
        ("ys", set.ys.len(), limits.max_observations),
        ("sigmas_px", set.sigmas_px.len(), limits.max_observations),
        ("depths", set.depths.len(), limits.max_observations),
    ];
    within(TRACK_SET, &lengths)
}

/// Refuses the first of `(field, count, limit)` that is above its limit.
pub(super) fn within(prefix: &str, counts: &[(&str, usize, usize)]) -> Result<(), InvalidInput> {
    match counts.iter().find(|(_, count, limit)| count > limit) {
        Some((field, count, limit)) => {
            Err(Violation::of(format!("{prefix}.{field}"), format!("{count} are above the limit of {limit}")).into())
        }
        None => Ok(()),
    }
}

fn track_set_to_raw(set: proto::TrackSet) -> RawInput {
    RawInput {
        views: set.views.iter().map(view_from_wire).collect(),
        track_count: set.track_count as usize,
        view: set.view_indices,
        track: set.track_indices,
        x: set.xs,
        y: set.ys,
        depth: set.depths,
        sigma: set.sigmas_px,
    }
}

pub(super) fn view_from_wire(view: &proto::View) -> View {
    View {
        name: (!view.name.is_empty()).then(|| view.name.as_str().into()),
        size: view.size.map(|proto::ImageSize { width_px, height_px }| ImageSize { width_px, height_px }),
        camera_group: view.camera_group,
        focal_prior: view
            .focal_prior
            .map(|proto::FocalPrior { focal_px, sigma_log }| FocalPrior { focal_px, sigma_log }),
    }
}

pub(super) fn view_to_wire(view: &View) -> proto::View {
    proto::View {
        name: view.name.as_deref().unwrap_or_default().to_owned(),
        size: view.size.map(|ImageSize { width_px, height_px }| proto::ImageSize { width_px, height_px }),
        camera_group: view.camera_group,
        focal_prior: view
            .focal_prior
            .map(|FocalPrior { focal_px, sigma_log }| proto::FocalPrior { focal_px, sigma_log }),
    }
}

/// Counts and views of an input, without its observations: what precedes [`chunks`].
pub fn head_to_wire(raw: &RawInput) -> proto::TrackSet {
    proto::TrackSet {
        // A count that does not fit is above every server's limit; saturated, it is refused there with its sentence.
        track_count: u32::try_from(raw.track_count).unwrap_or(u32::MAX),
        views: raw.views.iter().map(view_to_wire).collect(),
        ..proto::TrackSet::default()
    }
}

/// A whole input in one message.
pub fn to_wire(raw: &RawInput) -> proto::TrackSet {
    proto::TrackSet {
        view_indices: raw.view.clone(),
        track_indices: raw.track.clone(),
        xs: raw.x.clone(),
        ys: raw.y.clone(),
        depths: raw.depth.clone(),
        sigmas_px: raw.sigma.clone(),
        ..head_to_wire(raw)
    }
}

/// The observations of an input in chunks. Arrays of unequal lengths are sent as they are: the server says what is
/// wrong with them.
pub fn chunks<R: Borrow<RawInput>>(raw: R) -> impl Iterator<Item = proto::TrackSetChunk> {
    fn slice<T: Clone>(values: &[T], from: usize) -> Vec<T> {
        values.iter().skip(from).take(CHUNK_OBSERVATIONS).cloned().collect()
    }
    let longest = {
        let raw = raw.borrow();
        let lengths = [raw.view.len(), raw.track.len(), raw.x.len(), raw.y.len(), raw.depth.len(), raw.sigma.len()];
        lengths.into_iter().max().unwrap_or(0)
    };
    (0..longest).step_by(CHUNK_OBSERVATIONS).map(move |from| {
        let raw = raw.borrow();
        proto::TrackSetChunk {
            view_indices: slice(&raw.view, from),
            track_indices: slice(&raw.track, from),
            xs: slice(&raw.x, from),
            ys: slice(&raw.y, from),
            sigmas_px: slice(&raw.sigma, from),
            depths: slice(&raw.depth, from),
        }
    })
}

/// An uploaded input.
pub fn uploaded_to_wire(input: &StoredInput) -> proto::Input {
    proto::Input {
        name: input.name.to_string(),
        create_time: Some(input.create_time.into()),
        size_bytes: size_to_wire(input.upload_bytes),
        sha256: input.sha256.to_vec(),
        view_count: input.view_count,
        track_count: input.track_count,
        observation_count: input.observation_count,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn raw(observations: usize) -> RawInput {
        let tracks = observations.div_ceil(2);
        let size = ImageSize { width_px: 640, height_px: 480 };
        let focal_prior = FocalPrior { focal_px: 500.0, sigma_log: 0.1 };
        RawInput {
            views: vec![
                View { name: Some("a.jpg".into()), size: Some(size), camera_group: 3, focal_prior: Some(focal_prior) },
                View::default(),
            ],
            track_count: tracks,
            view: (0..observations as u32).map(|k| k % 2).collect(),
            track: (0..observations as u32).map(|k| k / 2).collect(),
            x: (0..observations).map(|k| k as f64 / 3.0).collect(),
            y: (0..observations).map(|k| -(k as f64)).collect(),
            depth: (0..observations).map(|k| 1.0 + k as f64).collect(),
            sigma: (0..observations).map(|k| 0.5 + (k % 7) as f64).collect(),
        }
    }

    #[test]
    fn chunks_add_up_to_the_whole() {
        let raw = raw(CHUNK_OBSERVATIONS + 7);
        let limits = Limits::default();
        let mut draft = Draft::begin(Some(Inline::TrackSet(head_to_wire(&raw))), &limits).expect("a head");
        let mut count = 0;
        for chunk in chunks(&raw) {
            draft.append_track_set(chunk).expect("a chunk");
            draft.check_size().expect("within the limits");
            count += 1;
        }
        assert_eq!(count, 2);
        let whole = Draft::begin(Some(Inline::TrackSet(to_wire(&raw))), &limits).expect("a whole");
        let expected = Input::new(raw, &limits, TRACK_SET).expect("valid");
        assert_eq!(draft.finish().expect("valid"), expected);
        assert_eq!(whole.finish().expect("valid"), expected);
    }

    #[test]
    fn an_endless_stream_is_refused_as_soon_as_it_is_above_the_limits() {
        let limits = Limits { max_observations: 10, ..Limits::default() };
        let mut draft = Draft::begin(Some(Inline::TrackSet(head_to_wire(&raw(4)))), &limits).expect("a head");
        let chunk = proto::TrackSetChunk { ys: vec![0.0; 6], ..Default::default() };
        draft.append_track_set(chunk.clone()).expect("a chunk");
        assert_eq!(draft.check_size(), Ok(()));
        draft.append_track_set(chunk).expect("a chunk");
        let error = draft.check_size().expect_err("12 of 10");
        assert_eq!(error.to_string(), "track_set.ys: 12 are above the limit of 10");
    }

    #[test]
    fn a_chunk_of_the_other_kind_is_refused() {
        let limits = Limits::default();
        let mut draft = Draft::begin(Some(Inline::TrackSet(head_to_wire(&raw(4)))), &limits).expect("a head");
        let error = draft.append_matrix(proto::MeasurementMatrixChunk::default()).expect_err("another kind");
        assert_eq!(error.to_string(), "measurement_matrix_chunk: the config holds a track_set");
    }

    #[test]
    fn wrong_sigmas_name_their_index() {
        let mut set = to_wire(&raw(4));
        set.sigmas_px = vec![1.0, 0.5, f64::NAN, 1.0];
        let finish = |set| Draft::begin(Some(Inline::TrackSet(set)), &Limits::default()).expect("set").finish();
        let error = finish(set.clone()).expect_err("NaN");
        assert_eq!(error.violations()[0].path(), "track_set.sigmas_px[2]");
        set.sigmas_px = vec![1.0];
        assert_eq!(finish(set).expect_err("short").violations()[0].path(), "track_set.sigmas_px");
    }
}
