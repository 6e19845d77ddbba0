//! An input on its way to a server: tracks, or keypoints and matches, which the server joins into tracks.

use std::sync::Arc;

use crate::domain::{RawInput, RawMatches};
use crate::rpc::convert::{input, matches};
use crate::rpc::proto::{self, create_job_request::Source, input_data::Data, solve_request::Message};

/// An input as it is sent.
#[derive(Debug, Clone)]
pub enum InputData {
    TrackSet(Arc<RawInput>),
    MatchSet(Arc<proto::MatchSet>),
}

impl From<&RawInput> for InputData {
    fn from(raw: &RawInput) -> Self {
        Self::from(raw.clone())
    }
}

impl From<RawInput> for InputData {
    fn from(raw: RawInput) -> Self {
        Self::TrackSet(Arc::new(raw))
    }
}

impl From<RawMatches> for InputData {
    fn from(raw: RawMatches) -> Self {
        Self::MatchSet(Arc::new(matches::to_wire(raw)))
    }
}

impl InputData {
    /// The whole, as a job is created with it.
    pub(super) fn into_source(self) -> Source {
        match self {
            Self::TrackSet(raw) => Source::TrackSet(input::to_wire(&raw)),
            Self::MatchSet(set) => Source::MatchSet(Arc::unwrap_or_clone(set)),
        }
    }

    /// The whole, as it is uploaded.
    pub(super) fn into_data(self) -> Data {
        match self {
            Self::TrackSet(raw) => Data::TrackSet(input::to_wire(&raw)),
            Self::MatchSet(set) => Data::MatchSet(Arc::unwrap_or_clone(set)),
        }
    }

    /// What precedes [`chunks`](Self::chunks).
    pub(super) fn head(&self) -> Source {
        match self {
            Self::TrackSet(raw) => Source::TrackSet(input::head_to_wire(raw)),
            Self::MatchSet(set) => Source::MatchSet(matches::head(set)),
        }
    }

    /// What follows the head.
    pub(super) fn chunks(&self) -> Box<dyn Iterator<Item = Message> + Send> {
        match self {
            Self::TrackSet(raw) => Box::new(input::chunks(Arc::clone(raw)).map(Message::TrackSetChunk)),
            Self::MatchSet(set) => {
                let set = Arc::clone(set);
                Box::new((0..).map_while(move |number| matches::chunk(&set, number)).map(Message::MatchSetChunk))
            }
        }
    }
}
