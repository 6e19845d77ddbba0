//! An input on its way to a server: tracks, or keypoints and matches, which the server joins into tracks.

use std::sync::Arc;

use prost::Message as _;

use crate::domain::{InputName, RawInput, RawMatches};
use crate::rpc::convert::input_message::InputMessage;
use crate::rpc::convert::{input, matches};
use crate::rpc::proto::{self, create_job_request::Source, input_data::Data, solve_request::Message};

/// An input as it is sent.
#[derive(Debug, Clone)]
pub enum InputData {
    TrackSet(Arc<proto::TrackSet>),
    MatchSet(Arc<proto::MatchSet>),
}

impl From<&RawInput> for InputData {
    fn from(raw: &RawInput) -> Self {
        Self::from(raw.clone())
    }
}

impl From<RawInput> for InputData {
    fn from(raw: RawInput) -> Self {
        Self::TrackSet(Arc::new(input::to_wire(raw)))
    }
}

impl From<RawMatches> for InputData {
    fn from(raw: RawMatches) -> Self {
        Self::MatchSet(Arc::new(matches::to_wire(raw)))
    }
}

/// What a job is created with.
#[derive(Debug, Clone)]
pub enum JobInput {
    /// Sent with the call, or uploaded before it where that is larger than the server's messages.
    Data(InputData),
    /// Uploaded before.
    Uploaded(InputName),
}

impl<T: Into<InputData>> From<T> for JobInput {
    fn from(data: T) -> Self {
        Self::Data(data.into())
    }
}

impl JobInput {
    /// The length as a message of what may be sent, in bytes.
    pub(super) fn encoded_len(&self) -> usize {
        match self {
            Self::Data(data) => data.encoded_len(),
            Self::Uploaded(_) => 0,
        }
    }
}

impl InputData {
    /// Its length as a message, in bytes.
    pub(super) fn encoded_len(&self) -> usize {
        match self {
            Self::TrackSet(set) => set.encoded_len(),
            Self::MatchSet(set) => set.encoded_len(),
        }
    }

    /// The whole, as a job is created with it.
    pub(super) fn into_source(self) -> Source {
        match self {
            Self::TrackSet(set) => Source::TrackSet(Arc::unwrap_or_clone(set)),
            Self::MatchSet(set) => Source::MatchSet(Arc::unwrap_or_clone(set)),
        }
    }

    /// The whole, as it is uploaded.
    pub(super) fn into_data(self) -> Data {
        match self {
            Self::TrackSet(set) => Data::TrackSet(Arc::unwrap_or_clone(set)),
            Self::MatchSet(set) => Data::MatchSet(Arc::unwrap_or_clone(set)),
        }
    }

    /// What precedes [`chunks`](Self::chunks).
    pub(super) fn head(&self) -> Source {
        match self {
            Self::TrackSet(set) => Source::TrackSet(set.head()),
            Self::MatchSet(set) => Source::MatchSet(set.head()),
        }
    }

    /// What follows the head.
    pub(super) fn chunks(&self) -> Box<dyn Iterator<Item = Message> + Send> {
        match self.clone() {
            Self::TrackSet(set) => {
                Box::new((0..).map_while(move |number| set.chunk(number)).map(Message::TrackSetChunk))
            }
            Self::MatchSet(set) => {
                Box::new((0..).map_while(move |number| set.chunk(number)).map(Message::MatchSetChunk))
            }
        }
    }
}
