//! The kinds of inputs, and the arrays of each: one table, by which messages are checked, measured and decoded, cut into
//! chunks by clients and put together again by servers.

use prost::Message;

use crate::domain::{InvalidInput, Limits, Violation};
use crate::rpc::proto;

/// Entries of an array in one chunk that a client sends: at most .7 MB, below the least message limit that a server may
/// have (1 MiB).
pub const CHUNK_ENTRIES: usize = 16_384;

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

    /// The array with this tag, its name, and how many entries it may have.
    fn array(&mut self, tag: u32, limits: &Limits) -> Option<(&'static str, Array<'_>, usize)>;

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
/// array of it. An array has its tag, its name, its kind, how many copies count as held where it is more than one, and
/// its bound.
macro_rules! input_messages {
    ($($set:ident, $chunk:ident, $name:literal {
        head: $($head:ident),+;
        declares: $($declared:ident <= $bound:ident),*;
        head_array: $($head_tag:literal $head_array:ident $head_kind:ident <= $head_max:ident)?;
        arrays: $($tag:literal $array:ident $kind:ident $(x $copies:ident)? <= $max:ident $(* $times:literal)?),+;
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
                    $((stringify!($head_array), self.$head_array.len(), limits.$head_max),)?
                    $((stringify!($array), self.$array.len(), limits.$max $(.saturating_mul($times))?),)+
                ]
                .into_iter()
                .map(|(name, count, max)| Count { name, count, max })
            }

            fn bytes(&self) -> u64 {
                bytes_of(&self.views) $(+ bytes_of(&self.$head_array))? $(+ bytes_of(&self.$array) $(* $copies)?)+
            }

            fn array(&mut self, tag: u32, limits: &Limits) -> Option<(&'static str, Array<'_>, usize)> {
                Some(match tag {
                    $($head_tag => {
                        (stringify!($head_array), Array::$head_kind(&mut self.$head_array), limits.$head_max)
                    })?
                    $($tag => {
                        let max = limits.$max $(.saturating_mul($times))?;
                        (stringify!($array), Array::$kind(&mut self.$array), max)
                    })+
                    _ => return None,
                })
            }
        }
    )+};
}

input_messages! {
    TrackSet, TrackSetChunk, "track_set" {
        head: track_count, views;
        declares: track_count <= max_tracks;
        head_array: ;
        arrays:
            3 view_indices Integers <= max_observations,
            4 track_indices Integers <= max_observations,
            5 xs Reals <= max_observations,
            6 ys Reals <= max_observations,
            7 sigmas_px Reals <= max_observations,
            8 depths Reals <= max_observations;
    }
    MeasurementMatrix, MeasurementMatrixChunk, "measurement_matrix" {
        head: view_count, track_count, has_depths, views;
        declares: view_count <= max_views, track_count <= max_tracks;
        head_array: ;
        arrays:
            3 values Reals <= max_observations * 3,
            5 visibility Bytes <= max_observations;
    }
    MatchSet, MatchSetChunk, "match_set" {
        head: keypoint_counts, views;
        declares: ;
        head_array: 2 keypoint_counts Integers <= max_views;
        arrays:
            3 xs Reals <= max_observations,
            4 ys Reals <= max_observations,
            5 first_view_indices Integers <= max_observations,
            6 second_view_indices Integers <= max_observations,
            7 match_counts Integers <= max_observations,
            8 first_keypoint_indices Integers x JOINING_COPIES <= max_observations,
            9 second_keypoint_indices Integers x JOINING_COPIES <= max_observations;
    }
}

fn bytes_of<T>(entries: &Vec<T>) -> u64 {
    (entries.capacity() * size_of::<T>()) as u64
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
