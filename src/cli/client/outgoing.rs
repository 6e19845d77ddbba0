//! An input on its way to a server: tracks, or keypoints and matches, which the server joins into tracks.

use std::sync::Arc;

use prost::Message as _;

use crate::domain::RawInput;
use crate::formats::LabelledInput;
use crate::rpc::convert::{input, matches};
use crate::rpc::proto::{self, create_job_request::Source, input_data::Data, solve_request::Message};

/// Longest set of matches that is sent, in bytes: half of the largest message that a server takes by default. Most
/// keypoints of a database are in no track, so that beyond this the tracks are far less to send.
const MAX_MATCH_SET_BYTES: usize = 32 << 20;

/// An input as it is sent.
#[derive(Debug, Clone)]
pub enum Outgoing {
    Tracks(Arc<RawInput>),
    Matches(Arc<proto::MatchSet>),
}

impl From<&RawInput> for Outgoing {
    fn from(raw: &RawInput) -> Self {
        Self::Tracks(Arc::new(raw.clone()))
    }
}

impl From<&LabelledInput> for Outgoing {
    /// Matches where the file has them. Joined here or there, they are the same tracks.
    fn from(input: &LabelledInput) -> Self {
        let set = input.raw_matches().map(matches::to_wire);
        match set.filter(|set| set.encoded_len() <= MAX_MATCH_SET_BYTES) {
            Some(set) => Self::Matches(Arc::new(set)),
            None => Self::from(&input.raw),
        }
    }
}

impl Outgoing {
    /// The whole, as a job is created with it.
    pub fn into_source(self) -> Source {
        match self {
            Self::Tracks(raw) => Source::TrackSet(input::to_wire(&raw)),
            Self::Matches(set) => Source::MatchSet(Arc::unwrap_or_clone(set)),
        }
    }

    /// The whole, as it is uploaded.
    pub fn into_data(self) -> Data {
        match self {
            Self::Tracks(raw) => Data::TrackSet(input::to_wire(&raw)),
            Self::Matches(set) => Data::MatchSet(Arc::unwrap_or_clone(set)),
        }
    }

    /// What precedes [`chunks`](Self::chunks).
    pub fn head(&self) -> Source {
        match self {
            Self::Tracks(raw) => Source::TrackSet(input::head_to_wire(raw)),
            Self::Matches(set) => Source::MatchSet(matches::head(set)),
        }
    }

    /// What follows the head.
    pub fn chunks(&self) -> Box<dyn Iterator<Item = Message> + Send> {
        match self {
            Self::Tracks(raw) => Box::new(input::chunks(Arc::clone(raw)).map(Message::TrackSetChunk)),
            Self::Matches(set) => {
                let set = Arc::clone(set);
                Box::new((0..).map_while(move |number| matches::chunk(&set, number)).map(Message::MatchSetChunk))
            }
        }
    }
}
