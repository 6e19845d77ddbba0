//! An uploaded input, decoded as its bytes come by. What is decoded never grows beyond the limits on inputs, whatever
//! the bytes say: prost's own decoding would take fifteen times their length for the worst of them.

use prost::bytes::Buf;
use prost::encoding::WireType::LengthDelimited;
use prost::encoding::{DecodeContext, decode_key, decode_varint, skip_field};

use super::input::Draft;
use super::input_message::{Array, InputMessage};
use crate::domain::{InvalidInput, Limits, Violation};
use crate::rpc::proto::input_data::Data;

/// Field of violations that are not of a field of the input.
const DATA: &str = "data";

/// Bytes of a packed `double`.
const DOUBLE_BYTES: usize = 8;

/// Decodes an `InputData`, up to the limits.
///
/// # Errors
/// A violation of `data` for bytes that are no such message, or of the first field that is too long.
pub fn read(buf: &mut impl Buf, limits: &Limits) -> Result<Draft, InvalidInput> {
    let mut data = None;
    while buf.has_remaining() {
        let (tag, wire) = decode_key(buf).map_err(malformed)?;
        // The last kind wins, and a kind that comes again is merged, as everywhere in protobuf.
        data = match (tag, wire, data.take()) {
            (1, LengthDelimited, Some(Data::TrackSet(set))) => Some(Data::TrackSet(merged(buf, set, limits)?)),
            (1, LengthDelimited, _) => Some(Data::TrackSet(merged(buf, Default::default(), limits)?)),
            (2, LengthDelimited, Some(Data::MeasurementMatrix(matrix))) => {
                Some(Data::MeasurementMatrix(merged(buf, matrix, limits)?))
            }
            (2, LengthDelimited, _) => Some(Data::MeasurementMatrix(merged(buf, Default::default(), limits)?)),
            (3, LengthDelimited, Some(Data::MatchSet(set))) => Some(Data::MatchSet(merged(buf, set, limits)?)),
            (3, LengthDelimited, _) => Some(Data::MatchSet(merged(buf, Default::default(), limits)?)),
            (_, _, before) => {
                skip_field(wire, tag, buf, DecodeContext::default()).map_err(malformed)?;
                before
            }
        };
    }
    let draft = Draft::begin(data, limits)?;
    draft.check_size()?;
    Ok(draft)
}

fn malformed(error: impl std::fmt::Display) -> InvalidInput {
    Violation::of(DATA, format!("the bytes are no scpsfm.v1.InputData: {error}")).into()
}

/// Length of what follows, which must be there.
fn length(buf: &mut impl Buf) -> Result<usize, InvalidInput> {
    let length = decode_varint(buf).map_err(malformed)?;
    match usize::try_from(length) {
        Ok(length) if length <= buf.remaining() => Ok(length),
        _ => Err(malformed("it ends too early")),
    }
}

/// A set with the fields of a message within the message.
fn merged<S: InputMessage>(buf: &mut impl Buf, mut set: S, limits: &Limits) -> Result<S, InvalidInput> {
    let length = length(buf)?;
    let end = buf.remaining() - length;
    while buf.remaining() > end {
        let (tag, wire) = decode_key(buf).map_err(malformed)?;
        match set.array(tag, limits).filter(|_| wire == LengthDelimited) {
            Some((name, array, max)) => decode_array(buf, array, &format!("{}.{name}", S::NAME), max)?,
            None => {
                set.merge_field(tag, wire, buf, DecodeContext::default()).map_err(malformed)?;
                set.check_counts(limits)?;
            }
        }
    }
    if buf.remaining() == end { Ok(set) } else { Err(malformed("a field is longer than its message")) }
}

/// Adds the entries of a packed array.
fn decode_array(buf: &mut impl Buf, array: Array<'_>, field: &str, max: usize) -> Result<(), InvalidInput> {
    match array {
        Array::Integers(entries) => integers(buf, entries, field, max),
        Array::Reals(entries) => doubles(buf, entries, field, max),
        Array::Bytes(entries) => {
            let length = length(buf)?;
            check(field, length, max)?;
            *entries = vec![0; length];
            buf.copy_to_slice(entries);
            Ok(())
        }
    }
}

fn check(field: &str, count: usize, max: usize) -> Result<(), InvalidInput> {
    if count <= max {
        return Ok(());
    }
    Err(Violation::of(field, format!("{count} or more are above the limit of {max}")).into())
}

fn doubles(buf: &mut impl Buf, values: &mut Vec<f64>, field: &str, max: usize) -> Result<(), InvalidInput> {
    let length = length(buf)?;
    if length % DOUBLE_BYTES != 0 {
        return Err(malformed(format_args!("{field} does not end with a whole number")));
    }
    let count = length / DOUBLE_BYTES;
    check(field, values.len().saturating_add(count), max)?;
    values.reserve(count);
    for _ in 0..count {
        values.push(buf.get_f64_le());
    }
    Ok(())
}

fn integers(buf: &mut impl Buf, values: &mut Vec<u32>, field: &str, max: usize) -> Result<(), InvalidInput> {
    let length = length(buf)?;
    let end = buf.remaining() - length;
    while buf.remaining() > end {
        check(field, values.len() + 1, max)?;
        // Protobuf cuts what is longer than the type.
        values.push(decode_varint(buf).map_err(malformed)? as u32);
    }
    // How many there are is known only now.
    values.shrink_to_fit();
    if buf.remaining() == end { Ok(()) } else { Err(malformed(format_args!("{field} is longer than it says"))) }
}

#[cfg(test)]
mod tests {
    use prost::Message;

    use super::*;
    use crate::domain::RawInput;
    use crate::rpc::proto;

    fn limits() -> Limits {
        Limits { max_views: 3, max_tracks: 100, max_observations: 10 }
    }

    fn raw(observations: u32) -> RawInput {
        RawInput {
            views: vec![Default::default(); 2],
            track_count: 50,
            view: (0..observations).map(|k| k % 2).collect(),
            track: (0..observations).map(|k| k / 2 + 40).collect(),
            x: (0..observations).map(f64::from).collect(),
            y: (0..observations).map(|k| -f64::from(k)).collect(),
            depth: Vec::new(),
            sigma: Vec::new(),
        }
    }

    /// Two keypoints in each of three views, and a match between every two views.
    fn match_set() -> proto::MatchSet {
        proto::MatchSet {
            views: vec![Default::default(); 3],
            keypoint_counts: vec![2; 3],
            xs: (0..6).map(f64::from).collect(),
            ys: vec![300.0; 6],
            first_view_indices: vec![0, 0, 1],
            second_view_indices: vec![1, 2, 2],
            match_counts: vec![1; 3],
            first_keypoint_indices: vec![1; 3],
            second_keypoint_indices: vec![1; 3],
        }
    }

    fn encoded(data: Data) -> Vec<u8> {
        proto::InputData { data: Some(data) }.encode_to_vec()
    }

    fn track_set(observations: u32) -> Vec<u8> {
        encoded(Data::TrackSet(super::super::input::to_wire(raw(observations))))
    }

    #[test]
    fn what_prost_encodes_is_read_however_the_bytes_are_cut() {
        let bytes = track_set(10);
        let expected = crate::domain::Input::new(raw(10), &limits(), "").expect("valid");
        for cut in 1..bytes.len() {
            let mut buf = bytes[..cut].chain(&bytes[cut..]);
            let draft = read(&mut buf, &limits()).expect("within the limits");
            assert_eq!(draft.finish().expect("valid"), expected, "cut at {cut}");
        }
        let matrix = proto::MeasurementMatrix {
            view_count: 2,
            track_count: 3,
            values: (1..=18).map(f64::from).collect(),
            visibility: vec![1; 6],
            ..Default::default()
        };
        let whole = Draft::begin(Some(Data::MeasurementMatrix(matrix.clone())), &limits()).expect("a matrix");
        let bytes = encoded(Data::MeasurementMatrix(matrix));
        let draft = read(&mut bytes.as_slice(), &limits()).expect("within the limits");
        assert_eq!(draft.finish().expect("valid"), whole.finish().expect("valid"));
        let whole = Draft::begin(Some(Data::MatchSet(match_set())), &limits()).expect("matches").finish();
        let expected = whole.expect("valid");
        assert_eq!((expected.track_count(), expected.observation_count()), (1, 3));
        let bytes = encoded(Data::MatchSet(match_set()));
        for cut in 1..bytes.len() {
            let mut buf = bytes[..cut].chain(&bytes[cut..]);
            let draft = read(&mut buf, &limits()).expect("within the limits");
            assert_eq!(draft.finish().expect("valid"), expected, "cut at {cut}");
        }
    }

    #[test]
    fn numbers_one_by_one_and_messages_in_parts_are_read_as_protobuf_says() {
        // The message twice over, merged: the arrays one after the other; unknown fields are passed over.
        let (bytes, unknown) = (track_set(4), [0x7a, 2, 1, 1]);
        let twice = [&bytes[..], &unknown, &bytes[..]].concat();
        let mut merged = proto::InputData::decode(twice.as_slice()).expect("decodes");
        let Some(Data::TrackSet(set)) = merged.data.take() else { panic!("no track set") };
        assert_eq!((set.xs.len(), set.views.len()), (8, 4));
        let error = read(&mut twice.as_slice(), &limits()).expect_err("four views");
        assert_eq!(error.violations()[0].field, "track_set.views");
        // `x: 1.5` unpacked, tag 5 of wire type 1.
        let mut one = vec![5 << 3 | 1];
        one.extend(1.5_f64.to_le_bytes());
        let mut bytes = vec![1 << 3 | 2, one.len() as u8];
        bytes.extend(&one);
        assert!(read(&mut bytes.as_slice(), &limits()).is_ok());
    }

    #[test]
    fn what_is_above_the_limits_is_refused_before_it_takes_memory() {
        let field = |bytes: &[u8]| {
            let error = read(&mut { bytes }, &limits()).expect_err("too long");
            error.violations()[0].field.clone()
        };
        assert_eq!(field(&track_set(11)), "track_set.view_indices");
        // A million empty views in two megabytes; packed zeros, a byte each.
        let within = |tag: u8, body: &[u8]| {
            let mut inner = Vec::new();
            prost::encoding::encode_varint(u64::from(tag) << 3 | 2, &mut inner);
            prost::encoding::encode_varint(body.len() as u64, &mut inner);
            inner.extend(body);
            inner
        };
        let views = [2 << 3 | 2, 0].repeat(1_000_000);
        assert_eq!(field(&within(1, &views)), "track_set.views");
        assert_eq!(field(&within(1, &within(4, &[0; 1000]))), "track_set.track_indices");
        assert_eq!(field(&within(2, &within(5, &[1; 1000]))), "measurement_matrix.visibility");
        assert_eq!(field(&within(2, &within(3, &[0; 31 * 8]))), "measurement_matrix.values");
        assert_eq!(field(&within(3, &within(2, &[1; 4]))), "match_set.keypoint_counts");
        assert_eq!(field(&within(3, &within(3, &[0; 11 * 8]))), "match_set.xs");
        assert_eq!(field(&within(3, &within(8, &[0; 1000]))), "match_set.first_keypoint_indices");
        assert_eq!(field(&within(3, &[9 << 3, 0].repeat(11))), "match_set.second_keypoint_indices");
        let unpacked = [&[5 << 3 | 1][..], &[0; 8]].concat().repeat(11);
        assert_eq!(field(&within(1, &unpacked)), "track_set.xs");
    }

    #[test]
    fn what_is_no_input_is_told_and_panics_nowhere() {
        for bytes in [track_set(10), encoded(Data::MatchSet(match_set()))] {
            for cut in 0..bytes.len() {
                let outcome = read(&mut &bytes[..cut], &limits());
                assert!(outcome.is_err(), "cut at {cut}");
            }
            // Every byte of a valid message changed in turn.
            for at in 0..bytes.len() {
                for change in [0x01, 0x80, 0xff] {
                    let mut changed = bytes.clone();
                    changed[at] ^= change;
                    let _ = read(&mut changed.as_slice(), &limits()).and_then(Draft::finish);
                }
            }
        }
        for garbage in [&[0xff; 64][..], &[0; 64], b"track_set", &[1 << 3 | 2, 0xff, 0xff, 0xff, 0xff, 0x0f]] {
            let error = read(&mut { garbage }, &limits()).expect_err("no input");
            assert_eq!(error.violations()[0].field, DATA);
        }
    }
}
