//! Sets of matches as they arrive, and as a client sends them.

use super::input::{view_from_wire, view_to_wire};
use crate::domain::{PairMatches, RawMatches};
use crate::rpc::proto;

pub(super) fn to_raw(set: proto::MatchSet) -> RawMatches {
    RawMatches {
        views: set.views.iter().map(view_from_wire).collect(),
        keypoint_counts: set.keypoint_counts,
        x: set.xs,
        y: set.ys,
        pairs: PairMatches {
            first_view: set.first_view_indices,
            second_view: set.second_view_indices,
            count: set.match_counts,
            first_keypoint: set.first_keypoint_indices,
            second_keypoint: set.second_keypoint_indices,
        },
    }
}

/// A whole set in one message.
pub fn to_wire(matches: RawMatches) -> proto::MatchSet {
    proto::MatchSet {
        views: matches.views.iter().map(view_to_wire).collect(),
        keypoint_counts: matches.keypoint_counts,
        xs: matches.x,
        ys: matches.y,
        first_view_indices: matches.pairs.first_view,
        second_view_indices: matches.pairs.second_view,
        match_counts: matches.pairs.count,
        first_keypoint_indices: matches.pairs.first_keypoint,
        second_keypoint_indices: matches.pairs.second_keypoint,
    }
}

#[cfg(test)]
mod tests {
    use super::super::input::Draft;
    use super::super::input_message::{CHUNK_ENTRIES, InputMessage};
    use super::*;
    use crate::domain::{Limits, View};
    use crate::rpc::proto::input_data::Data;
    use crate::rpc::proto::solve_request::Message;

    #[test]
    fn chunks_add_up_to_the_whole() {
        let keypoints = CHUNK_ENTRIES as u32 + 7;
        let mut pairs = PairMatches::default();
        pairs.push([0, 1], (0..keypoints).map(|k| [k, keypoints - 1 - k]));
        let raw = RawMatches {
            views: vec![View { name: Some("a.jpg".into()), ..View::default() }, View::default()],
            keypoint_counts: vec![keypoints; 2],
            x: (0..2 * keypoints).map(|k| f64::from(k) / 3.0).collect(),
            y: (0..2 * keypoints).map(f64::from).collect(),
            pairs,
        };
        let limits = Limits::default();
        let set = to_wire(raw.clone());
        assert_eq!(to_raw(set.clone()), raw);
        let mut draft = Draft::begin(Some(Data::MatchSet(set.head())), &limits).expect("a head");
        let mut count = 0;
        while let Some(chunk) = set.chunk(count) {
            draft.append(Message::MatchSetChunk(chunk)).expect("a chunk");
            draft.check_size().expect("within the limits");
            count += 1;
        }
        // Both views' keypoints are in one array.
        assert_eq!(count, 3);
        let whole = Draft::begin(Some(Data::MatchSet(set)), &limits).expect("a whole").finish().expect("valid");
        assert_eq!(whole.joined_tracks().map(|joined| joined.joining.match_count), Some(keypoints));
        assert_eq!(draft.finish().expect("valid"), whole);
    }

    #[test]
    fn an_endless_stream_is_refused_as_soon_as_it_is_above_the_limits() {
        let limits = Limits { max_observations: 10, ..Limits::default() };
        let mut draft = Draft::begin(Some(Data::MatchSet(proto::MatchSet::default())), &limits).expect("a head");
        let chunk = proto::MatchSetChunk { second_keypoint_indices: vec![0; 6], ..Default::default() };
        draft.append(Message::MatchSetChunk(chunk.clone())).expect("a chunk");
        assert_eq!(draft.check_size(), Ok(()));
        draft.append(Message::MatchSetChunk(chunk)).expect("a chunk");
        let error = draft.check_size().expect_err("12 of 10");
        assert_eq!(error.to_string(), "match_set.second_keypoint_indices: 12 are above the limit of 10");
        let error = draft.append(Message::TrackSetChunk(Default::default())).expect_err("another kind");
        assert_eq!(error.to_string(), "track_set_chunk: the config holds a match_set");
    }
}
