//! Inputs as they arrive, in one message or in chunks, and as a client sends them.

use super::input_message::InputMessage;
use super::{matches, matrix, size_to_wire};
use crate::domain::{FocalPrior, ImageSize, Input, InvalidInput, Limits, RawInput, View, Violation};
use crate::engine::StoredInput;
use crate::rpc::proto;
use proto::input_data::Data;
use proto::solve_request::Message;

/// Bytes of an observation in memory at most: a view, a track, and four reals.
pub const OBSERVATION_BYTES: u64 = 2 * 4 + 4 * 8;

/// An input that may not be complete yet. Never holds more than the limits allow and one message on top.
#[derive(Debug)]
pub struct Draft {
    data: Data,
    limits: Limits,
}

/// The field of a message that follows the config.
pub fn field_of(message: &Message) -> &'static str {
    match message {
        Message::Config(_) => "config",
        Message::TrackSetChunk(_) => "track_set_chunk",
        Message::MeasurementMatrixChunk(_) => "measurement_matrix_chunk",
        Message::MatchSetChunk(_) => "match_set_chunk",
    }
}

impl Draft {
    /// Begins with what came with the job: a whole input or the head of one.
    ///
    /// # Errors
    /// A violation of `source` where there is none; see [`Draft::check_size`].
    pub fn begin(data: Option<Data>, limits: &Limits) -> Result<Self, InvalidInput> {
        let missing =
            "is not set; give a track_set, a measurement_matrix, a match_set or the name of an uploaded input";
        let data = data.ok_or_else(|| Violation::of("source", missing))?;
        Ok(Self { data, limits: limits.clone() })
    }

    /// Appends a chunk.
    ///
    /// # Errors
    /// A violation where the input is of another kind; see [`Draft::check_size`].
    pub fn append(&mut self, message: Message) -> Result<(), InvalidInput> {
        match (&mut self.data, message) {
            (Data::TrackSet(set), Message::TrackSetChunk(chunk)) => set.append(chunk),
            (Data::MeasurementMatrix(matrix), Message::MeasurementMatrixChunk(chunk)) => matrix.append(chunk),
            (Data::MatchSet(set), Message::MatchSetChunk(chunk)) => set.append(chunk),
            (data, other) => {
                let kind = match data {
                    Data::TrackSet(_) => proto::TrackSet::NAME,
                    Data::MeasurementMatrix(_) => proto::MeasurementMatrix::NAME,
                    Data::MatchSet(_) => proto::MatchSet::NAME,
                };
                return Err(Violation::of(field_of(&other), format!("the config holds a {kind}")).into());
            }
        }
        Ok(())
    }

    /// Refuses what is above the limits already, by what is claimed and by what has arrived, so that an endless
    /// stream ends early.
    ///
    /// # Errors
    /// A violation of the first field that is too long.
    pub fn check_size(&self) -> Result<(), InvalidInput> {
        match &self.data {
            Data::TrackSet(set) => set.check_counts(&self.limits),
            Data::MeasurementMatrix(matrix) => matrix::check_size(matrix, &self.limits),
            Data::MatchSet(set) => set.check_counts(&self.limits),
        }
    }

    /// Bytes that it takes in memory, see [`InputMessage::bytes`].
    pub fn bytes(&self) -> u64 {
        match &self.data {
            Data::TrackSet(set) => set.bytes(),
            Data::MeasurementMatrix(matrix) => matrix.bytes(),
            Data::MatchSet(set) => set.bytes(),
        }
    }

    /// Checks the whole.
    ///
    /// # Errors
    /// Every violation found, by field and index.
    pub fn finish(self) -> Result<Input, InvalidInput> {
        match self.data {
            Data::TrackSet(set) => Input::new(track_set_to_raw(set), &self.limits, proto::TrackSet::NAME),
            Data::MeasurementMatrix(matrix) => matrix::to_input(matrix, &self.limits),
            Data::MatchSet(set) => matches::to_raw(set).into_input(&self.limits, proto::MatchSet::NAME),
        }
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

/// A whole input in one message.
pub fn to_wire(raw: RawInput) -> proto::TrackSet {
    proto::TrackSet {
        // A count that does not fit is above every server's limit; saturated, it is refused there with its sentence.
        track_count: u32::try_from(raw.track_count).unwrap_or(u32::MAX),
        views: raw.views.iter().map(view_to_wire).collect(),
        view_indices: raw.view,
        track_indices: raw.track,
        xs: raw.x,
        ys: raw.y,
        depths: raw.depth,
        sigmas_px: raw.sigma,
    }
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
    use super::super::input_message::CHUNK_ENTRIES;
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
        let raw = raw(CHUNK_ENTRIES + 7);
        let limits = Limits::default();
        let set = to_wire(raw.clone());
        let mut draft = Draft::begin(Some(Data::TrackSet(set.head())), &limits).expect("a head");
        let mut count = 0;
        while let Some(chunk) = set.chunk(count) {
            draft.append(Message::TrackSetChunk(chunk)).expect("a chunk");
            draft.check_size().expect("within the limits");
            count += 1;
        }
        assert_eq!(count, 2);
        let whole = Draft::begin(Some(Data::TrackSet(set)), &limits).expect("a whole");
        let expected = Input::new(raw, &limits, proto::TrackSet::NAME).expect("valid");
        assert_eq!(draft.finish().expect("valid"), expected);
        assert_eq!(whole.finish().expect("valid"), expected);
    }

    #[test]
    fn an_endless_stream_is_refused_as_soon_as_it_is_above_the_limits() {
        let limits = Limits { max_observations: 10, ..Limits::default() };
        let mut draft = Draft::begin(Some(Data::TrackSet(to_wire(raw(4)).head())), &limits).expect("a head");
        let chunk = proto::TrackSetChunk { ys: vec![0.0; 6], ..Default::default() };
        draft.append(Message::TrackSetChunk(chunk.clone())).expect("a chunk");
        assert_eq!(draft.check_size(), Ok(()));
        draft.append(Message::TrackSetChunk(chunk)).expect("a chunk");
        let error = draft.check_size().expect_err("12 of 10");
        assert_eq!(error.to_string(), "track_set.ys: 12 are above the limit of 10");
    }

    #[test]
    fn a_chunk_of_the_other_kind_is_refused() {
        let limits = Limits::default();
        let mut draft = Draft::begin(Some(Data::TrackSet(to_wire(raw(4)).head())), &limits).expect("a head");
        let error = draft.append(Message::MeasurementMatrixChunk(Default::default())).expect_err("another kind");
        assert_eq!(error.to_string(), "measurement_matrix_chunk: the config holds a track_set");
    }

    #[test]
    fn wrong_sigmas_name_their_index() {
        let mut set = to_wire(raw(4));
        set.sigmas_px = vec![1.0, 0.5, f64::NAN, 1.0];
        let finish = |set| Draft::begin(Some(Data::TrackSet(set)), &Limits::default()).expect("set").finish();
        let error = finish(set.clone()).expect_err("NaN");
        assert_eq!(error.violations()[0].path(), "track_set.sigmas_px[2]");
        set.sigmas_px = vec![1.0];
        assert_eq!(finish(set).expect_err("short").violations()[0].path(), "track_set.sigmas_px");
    }
}
