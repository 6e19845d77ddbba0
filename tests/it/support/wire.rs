//! Messages to send.

use scpsfm::domain::{RawInput, View};
use scpsfm::rpc::convert;
use scpsfm::rpc::proto::{self, create_job_request::Source, solve_request::Message};
use tonic::{Status, Streaming};

/// A complete input: every track in every view.
pub fn raw(views: usize, tracks: usize) -> RawInput {
    let each = || (0..views as u32).flat_map(|view| (0..tracks as u32).map(move |track| (view, track)));
    RawInput {
        views: vec![View::default(); views],
        track_count: tracks,
        view: each().map(|(view, _)| view).collect(),
        track: each().map(|(_, track)| track).collect(),
        x: each().map(|(view, track)| f64::from(10 * track + view)).collect(),
        y: each().map(|(view, track)| f64::from(track) - f64::from(view)).collect(),
        depth: Vec::new(),
        sigma: Vec::new(),
    }
}

/// A valid track set of three views and four tracks.
pub fn track_set() -> proto::TrackSet {
    convert::input::to_wire(raw(3, 4))
}

/// A valid matrix of two views and three tracks.
pub fn matrix() -> proto::MeasurementMatrix {
    #[rustfmt::skip]
    let values = vec![
        1.0, 2.0, 3.0,
        4.0, 5.0, 6.0,
        1.0, 1.0, 1.0,
        7.0, 8.0, 9.0,
        1.0, 2.0, 3.0,
        1.0, 1.0, 1.0,
    ];
    proto::MeasurementMatrix { view_count: 2, track_count: 3, values, ..Default::default() }
}

/// The example of the proto: a track of three views and one of two.
pub fn match_set() -> proto::MatchSet {
    proto::MatchSet {
        views: vec![proto::View::default(); 3],
        keypoint_counts: vec![3, 2, 2],
        xs: vec![10.0, 20.0, 30.0, 12.0, 22.0, 14.0, 24.0],
        ys: vec![50.0, 60.0, 70.0, 51.0, 61.0, 52.0, 62.0],
        first_view_indices: vec![0, 1],
        second_view_indices: vec![1, 2],
        match_counts: vec![2, 1],
        first_keypoint_indices: vec![0, 1, 1],
        second_keypoint_indices: vec![1, 0, 0],
    }
}

pub fn create(source: Source) -> proto::CreateJobRequest {
    proto::CreateJobRequest { parent: "tenants/default".into(), source: Some(source), ..Default::default() }
}

pub fn create_raw(raw: &RawInput) -> proto::CreateJobRequest {
    create(Source::TrackSet(convert::input::to_wire(raw.clone())))
}

/// A valid request.
pub fn create_tracks() -> proto::CreateJobRequest {
    create(Source::TrackSet(track_set()))
}

pub fn solve_request(message: Message) -> proto::SolveRequest {
    proto::SolveRequest { message: Some(message) }
}

/// Everything that a stream says, and how it ends.
pub async fn all<T>(mut stream: Streaming<T>) -> (Vec<T>, Result<(), Status>) {
    let mut messages = Vec::new();
    loop {
        match stream.message().await {
            Ok(Some(message)) => messages.push(message),
            Ok(None) => return (messages, Ok(())),
            Err(status) => return (messages, Err(status)),
        }
    }
}

/// The state that an event tells, if it tells one.
pub fn state_of(event: &proto::JobEvent) -> Option<proto::JobState> {
    match &event.body {
        Some(proto::job_event::Body::StateChange(change)) => Some(change.state()),
        _ => None,
    }
}
