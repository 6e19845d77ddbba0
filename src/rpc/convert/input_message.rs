//! The kinds of inputs, and the arrays of each: one table, by which messages are checked, measured and decoded, cut into
//! chunks by clients and put together again by servers.

use prost::Message;

use crate::domain::{InvalidInput, Limits, Violation};
use crate::rpc::proto;

/// Entries of an array in one chunk that a client sends: at most 2.8 MB, well below any server's message limit.
pub const CHUNK_ENTRIES: usize = 65_536;

/// How often the bytes of a match are in memory while matches are joined: the match itself, its place in the order, and
/// in the lists of neighbours and of pieces, some 52 bytes for the 8 of two keypoints.
const JOINING_COPIES: u64 = 3;

/// An array of an input.
pub enum Array<'a> {
    Integers(&'a mut Vec<u32>),
    Reals(&'a mut Vec<f64>),
    Bytes(&'a mut Vec<u8>),
}

/// How much of something there is, and how much there may be.
pub struct Count {
    pub name: &'static str,
    pub count: usize,
    pub max: usize,
}

impl Count {
    fn of<T>(array: &'static str, entries: &[T], limits: &Limits) -> Self {
        Self { name: array, count: entries.len(), max: max_entries(array, limits) }
    }
}

/// An input in one message, or as a head and chunks.
pub trait InputMessage: Message + Default {
    type Chunk;

    /// Its name in requests and in violations.
    const NAME: &'static str;

    /// What precedes the chunks.
    fn head(&self) -> Self;

    /// What follows the head, part by part; `None` after the last one. Arrays of unequal lengths are sent as they are:
    /// the server says what is wrong with them.
    fn chunk(&self, number: usize) -> Option<Self::Chunk>;

    /// Adds what follows.
    fn append(&mut self, chunk: Self::Chunk);

    /// The counts that it declares, and its views.
    fn declared_counts(&self, limits: &Limits) -> impl Iterator<Item = Count>;

    /// The lengths of its arrays.
    fn array_counts(&self, limits: &Limits) -> impl Iterator<Item = Count>;

    /// Bytes that it takes in memory; those of matches count as often as joining needs them.
    fn bytes(&self) -> u64;

    /// The array with this tag, and its name.
    fn array(&mut self, tag: u32) -> Option<(&'static str, Array<'_>)>;

    /// Refuses what is above the limits by what it declares and by what has arrived.
    ///
    /// # Errors
    /// A violation of the first field that is too long.
    fn check_counts(&self, limits: &Limits) -> Result<(), InvalidInput> {
        within(Self::NAME, self.declared_counts(limits))?;
        within(Self::NAME, self.array_counts(limits))
    }
}

/// Implements [`InputMessage`]. `head` is what is in no chunk, `declares` what is bounded of that, `head_array` the
/// array of it.
macro_rules! input_messages {
    ($($set:ident, $chunk:ident, $name:literal {
        head: $($head:ident),+;
        declares: $($declared:ident <= $bound:ident),*;
        head_array: $($head_tag:literal $head_array:ident $head_kind:ident)?;
        arrays: $($tag:literal $array:ident $kind:ident),+;
    })+) => {$(
        impl InputMessage for proto::$set {
            type Chunk = proto::$chunk;

            const NAME: &'static str = $name;

            fn head(&self) -> Self {
                Self { $($head: self.$head.clone(),)+ ..Self::default() }
            }

            fn chunk(&self, number: usize) -> Option<proto::$chunk> {
                let chunk = proto::$chunk { $($array: part(&self.$array, number)),+ };
                (chunk.encoded_len() > 0).then_some(chunk)
            }

            fn append(&mut self, mut chunk: proto::$chunk) {
                $(self.$array.append(&mut chunk.$array);)+
            }

            fn declared_counts(&self, limits: &Limits) -> impl Iterator<Item = Count> {
                [
                    $(Count { name: stringify!($declared), count: self.$declared as usize, max: limits.$bound },)*
                    Count { name: "views", count: self.views.len(), max: limits.max_views },
                ]
                .into_iter()
            }

            fn array_counts(&self, limits: &Limits) -> impl Iterator<Item = Count> {
                [
                    $(Count::of(stringify!($head_array), &self.$head_array, limits),)?
                    $(Count::of(stringify!($array), &self.$array, limits),)+
                ]
                .into_iter()
            }

            fn bytes(&self) -> u64 {
                let of_head = 0 $(+ bytes_of(stringify!($head_array), &self.$head_array))?;
                of_head + bytes_of("views", &self.views) $(+ bytes_of(stringify!($array), &self.$array))+
            }

            fn array(&mut self, tag: u32) -> Option<(&'static str, Array<'_>)> {
                match tag {
                    $($head_tag => Some((stringify!($head_array), Array::$head_kind(&mut self.$head_array))),)?
                    $($tag => Some((stringify!($array), Array::$kind(&mut self.$array))),)+
                    _ => None,
                }
            }
        }
    )+};
}

input_messages! {
    TrackSet, TrackSetChunk, "track_set" {
        head: track_count, views;
        declares: track_count <= max_tracks;
        head_array: ;
        arrays: 3 view_indices Integers, 4 track_indices Integers, 5 xs Reals, 6 ys Reals, 7 sigmas_px Reals,
            8 depths Reals;
    }
    MeasurementMatrix, MeasurementMatrixChunk, "measurement_matrix" {
        head: view_count, track_count, has_depths, views;
        declares: view_count <= max_views, track_count <= max_tracks;
        head_array: ;
        arrays: 3 values Reals, 5 visibility Bytes;
    }
    MatchSet, MatchSetChunk, "match_set" {
        head: keypoint_counts, views;
        declares: ;
        head_array: 2 keypoint_counts Integers;
        arrays: 3 xs Reals, 4 ys Reals, 5 first_view_indices Integers, 6 second_view_indices Integers,
            7 match_counts Integers, 8 first_keypoint_indices Integers, 9 second_keypoint_indices Integers;
    }
}

/// Entries that an array may have at most.
pub fn max_entries(array: &str, limits: &Limits) -> usize {
    match array {
        "keypoint_counts" => limits.max_views,
        "values" => limits.max_observations.saturating_mul(3),
        _ => limits.max_observations,
    }
}

fn bytes_of<T>(array: &str, entries: &Vec<T>) -> u64 {
    let copies = match array {
        "first_keypoint_indices" | "second_keypoint_indices" => JOINING_COPIES,
        _ => 1,
    };
    copies * (entries.capacity() * size_of::<T>()) as u64
}

fn part<T: Clone>(entries: &[T], number: usize) -> Vec<T> {
    entries.iter().skip(number * CHUNK_ENTRIES).take(CHUNK_ENTRIES).cloned().collect()
}

/// Refuses the first count that is above its limit.
pub fn within(prefix: &str, mut counts: impl Iterator<Item = Count>) -> Result<(), InvalidInput> {
    match counts.find(|Count { count, max, .. }| count > max) {
        Some(Count { name, count, max }) => {
            Err(Violation::of(format!("{prefix}.{name}"), format!("{count} are above the limit of {max}")).into())
        }
        None => Ok(()),
    }
}
