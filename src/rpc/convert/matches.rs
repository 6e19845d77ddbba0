//! Sets of matches as they arrive, and as a client sends them.

use prost::Message;

use super::input::{view_from_wire, view_to_wire, within};
use crate::domain::{InvalidInput, Limits, PairMatches, RawMatches};
use crate::rpc::proto;

/// Name of a set of matches in violations.
pub(super) const MATCH_SET: &str = "match_set";

/// How often the bytes of a match are in memory while matches are joined: the match itself, its place in the order, and
/// in the lists of neighbours and of pieces, some 52 bytes for the 8 of two keypoints.
pub(super) const JOINING_COPIES: u64 = 3;

/// Entries of an array in one chunk that a client sends: at most 2.4 MB, well below any server's message limit.
const CHUNK_ENTRIES: usize = 65_536;

/// Refuses what is above the limits by what has arrived.
pub(super) fn check_size(set: &proto::MatchSet, limits: &Limits) -> Result<(), InvalidInput> {
    let most = limits.max_observations;
    let lengths = [
        ("views", set.views.len(), limits.max_views),
        ("keypoint_counts", set.keypoint_counts.len(), limits.max_views),
        ("xs", set.xs.len(), most),
        ("ys", set.ys.len(), most),
        ("first_view_indices", set.first_view_indices.len(), most),
        ("second_view_indices", set.second_view_indices.len(), most),
        ("match_counts", set.match_counts.len(), most),
        ("first_keypoint_indices", set.first_keypoint_indices.len(), most),
        ("second_keypoint_indices", set.second_keypoint_indices.len(), most),
    ];
    within(MATCH_SET, &lengths)
}

pub(super) fn append(set: &mut proto::MatchSet, mut chunk: proto::MatchSetChunk) {
    set.xs.append(&mut chunk.xs);
    set.ys.append(&mut chunk.ys);
    set.first_view_indices.append(&mut chunk.first_view_indices);
    set.second_view_indices.append(&mut chunk.second_view_indices);
    set.match_counts.append(&mut chunk.match_counts);
    set.first_keypoint_indices.append(&mut chunk.first_keypoint_indices);
    set.second_keypoint_indices.append(&mut chunk.second_keypoint_indices);
}

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

/// Views and numbers of keypoints of a set: what precedes [`chunk`]s.
pub fn head(set: &proto::MatchSet) -> proto::MatchSet {
    proto::MatchSet {
        views: set.views.clone(),
        keypoint_counts: set.keypoint_counts.clone(),
        ..proto::MatchSet::default()
    }
}

/// What follows the head, part by part; `None` after the last one.
pub fn chunk(set: &proto::MatchSet, number: usize) -> Option<proto::MatchSetChunk> {
    fn part<T: Clone>(values: &[T], number: usize) -> Vec<T> {
        values.iter().skip(number * CHUNK_ENTRIES).take(CHUNK_ENTRIES).cloned().collect()
    }
    let chunk = proto::MatchSetChunk {
        xs: part(&set.xs, number),
        ys: part(&set.ys, number),
        first_view_indices: part(&set.first_view_indices, number),
        second_view_indices: part(&set.second_view_indices, number),
        match_counts: part(&set.match_counts, number),
        first_keypoint_indices: part(&set.first_keypoint_indices, number),
        second_keypoint_indices: part(&set.second_keypoint_indices, number),
    };
    (chunk.encoded_len() > 0).then_some(chunk)
}

#[cfg(test)]
mod tests {
    use super::super::input::Draft;
    use super::*;
    use crate::domain::View;
    use crate::rpc::proto::create_job_request::Source as Inline;

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
        let mut draft = Draft::begin(Some(Inline::MatchSet(head(&set))), &limits).expect("a head");
        let mut count = 0;
        while let Some(chunk) = chunk(&set, count) {
            draft.append_match_set(chunk).expect("a chunk");
            draft.check_size().expect("within the limits");
            count += 1;
        }
        // Both views' keypoints are in one array.
        assert_eq!(count, 3);
        let whole = Draft::begin(Some(Inline::MatchSet(set)), &limits).expect("a whole").finish().expect("valid");
        assert_eq!(whole.joined_tracks().map(|joined| joined.joining.match_count), Some(keypoints));
        assert_eq!(draft.finish().expect("valid"), whole);
    }

    #[test]
    fn an_endless_stream_is_refused_as_soon_as_it_is_above_the_limits() {
        let limits = Limits { max_observations: 10, ..Limits::default() };
        let mut draft = Draft::begin(Some(Inline::MatchSet(proto::MatchSet::default())), &limits).expect("a head");
        let chunk = proto::MatchSetChunk { second_keypoint_indices: vec![0; 6], ..Default::default() };
        draft.append_match_set(chunk.clone()).expect("a chunk");
        assert_eq!(draft.check_size(), Ok(()));
        draft.append_match_set(chunk).expect("a chunk");
        let error = draft.check_size().expect_err("12 of 10");
        assert_eq!(error.to_string(), "match_set.second_keypoint_indices: 12 are above the limit of 10");
        let error = draft.append_track_set(proto::TrackSetChunk::default()).expect_err("another kind");
        assert_eq!(error.to_string(), "track_set_chunk: the config holds a match_set");
    }
}
