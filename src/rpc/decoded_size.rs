//! What a message takes in memory once it is decoded, from its encoding.
//!
//! An empty message in a list has two bytes there, and in memory all the fields that it may have.

use std::collections::HashMap;
use std::sync::LazyLock;

use prost::bytes::Buf;
use prost::encoding::{DecodeContext, WireType, decode_key, decode_varint, skip_field};
use prost_reflect::{DescriptorPool, FieldDescriptor, Kind, MessageDescriptor};

use super::proto::FILE_DESCRIPTOR_SET;

/// Of a vector, a string, or a map, without what it holds.
const VECTOR_BYTES: u64 = 24;
/// What says whether a field is there, with what aligns it.
const PRESENCE_BYTES: u64 = 8;
/// What an entry of a list takes for each byte of it: a vector that grows doubles.
const GROWTH: u64 = 2;
/// Messages within messages that are followed, as many as prost follows.
const MOST_DEPTH: u32 = 100;

static TYPES: LazyLock<Types> = LazyLock::new(Types::of_api);

/// The messages of the API.
#[derive(Debug, Default)]
struct Types {
    layouts: Vec<Layout>,
    by_name: HashMap<String, usize>,
    /// What the method at each path takes.
    taken_by: HashMap<String, usize>,
}

/// Of messages of one type.
#[derive(Debug, Default)]
struct Layout {
    /// Of one, without what its lists and strings hold.
    bytes: u64,
    /// By number; those of the API are small.
    fields: Vec<Option<Field>>,
}

#[derive(Debug, Clone, Copy)]
struct Field {
    content: Content,
    /// What an entry adds to that of the message: nothing unless there may be several.
    entry_bytes: u64,
}

#[derive(Debug, Clone, Copy)]
enum Content {
    /// A string or bytes.
    Bytes,
    Numbers {
        in_memory: u64,
        /// Bytes that each has in an encoded list; `None`: as many as it takes.
        encoded: Option<u64>,
    },
    Message(usize),
}

/// A type of message.
#[derive(Debug, Clone, Copy)]
pub struct MessageType(usize);

/// The type of the messages that the method at this path takes; `None` for a method that is not of the API.
pub fn taken_by(path: &str) -> Option<MessageType> {
    TYPES.taken_by.get(path).copied().map(MessageType)
}

impl MessageType {
    /// What a message takes at most once it is decoded, counted until it is more than `most`; `None` for what cannot be
    /// decoded. Prost refuses that, too, but where a message ends beyond the one that holds it only after it has taken
    /// memory for all that it reads there.
    pub fn decoded_bytes(self, encoded: &[u8], most: u64) -> Option<u64> {
        let mut counter = Counter { types: &TYPES, bytes: TYPES.layouts[self.0].bytes, most };
        counter.count(self.0, encoded, MOST_DEPTH)?;
        Some(counter.bytes)
    }
}

impl Types {
    fn of_api() -> Self {
        let mut types = Self::default();
        let pool = DescriptorPool::decode(FILE_DESCRIPTOR_SET).expect("the set is this build's own");
        for service in pool.services() {
            for method in service.methods() {
                let taken = types.add(&method.input());
                types.taken_by.insert(format!("/{}/{}", service.full_name(), method.name()), taken);
            }
        }
        types
    }

    /// The number of a type, with all that it holds.
    fn add(&mut self, descriptor: &MessageDescriptor) -> usize {
        if let Some(&number) = self.by_name.get(descriptor.full_name()) {
            return number;
        }
        let number = self.layouts.len();
        self.layouts.push(Layout::default());
        self.by_name.insert(descriptor.full_name().to_owned(), number);
        let mut layout = Layout::default();
        for field in descriptor.fields() {
            let (content, bytes) = self.content(&field);
            let is_repeated = field.is_list() || field.is_map();
            layout.bytes += if is_repeated { VECTOR_BYTES } else { bytes };
            let entry_bytes = if is_repeated { GROWTH * bytes } else { 0 };
            let place = field.number() as usize;
            layout.fields.resize(layout.fields.len().max(place + 1), None);
            layout.fields[place] = Some(Field { content, entry_bytes });
        }
        self.layouts[number] = layout;
        number
    }

    /// What a field holds, and what one of it takes.
    fn content(&mut self, field: &FieldDescriptor) -> (Content, u64) {
        let presence = if field.supports_presence() { PRESENCE_BYTES } else { 0 };
        let (in_memory, encoded) = match field.kind() {
            Kind::Message(of) => {
                let number = self.add(&of);
                return (Content::Message(number), self.layouts[number].bytes + presence);
            }
            Kind::String | Kind::Bytes => return (Content::Bytes, VECTOR_BYTES + presence),
            Kind::Double | Kind::Fixed64 | Kind::Sfixed64 => (8, Some(8)),
            Kind::Float | Kind::Fixed32 | Kind::Sfixed32 => (4, Some(4)),
            Kind::Int64 | Kind::Uint64 | Kind::Sint64 => (8, None),
            Kind::Int32 | Kind::Uint32 | Kind::Sint32 | Kind::Enum(_) => (4, None),
            Kind::Bool => (1, None),
        };
        (Content::Numbers { in_memory, encoded }, in_memory + presence)
    }
}

struct Counter<'a> {
    types: &'a Types,
    bytes: u64,
    most: u64,
}

impl Counter<'_> {
    /// Adds what the lists and strings of a message hold; `None` where it cannot be decoded.
    fn count(&mut self, of: usize, mut encoded: &[u8], depth: u32) -> Option<()> {
        let depth = depth.checked_sub(1)?;
        let fields = &self.types.layouts[of].fields;
        while !encoded.is_empty() && self.bytes <= self.most {
            let (number, wire_type) = decode_key(&mut encoded).ok()?;
            let field = fields.get(number as usize).copied().flatten();
            self.bytes += field.map_or(0, |field| field.entry_bytes);
            let Some(field) = field.filter(|_| wire_type == WireType::LengthDelimited) else {
                skip_field(wire_type, number, &mut encoded, DecodeContext::default()).ok()?;
                continue;
            };
            let length = usize::try_from(decode_varint(&mut encoded).ok()?).ok()?;
            let held = encoded.get(..length)?;
            encoded.advance(length);
            match field.content {
                Content::Bytes => self.bytes += length as u64,
                Content::Numbers { in_memory, encoded } => {
                    // The last byte of a number has no high bit.
                    let of_varints = || held.iter().filter(|byte| **byte < 0x80).count() as u64;
                    self.bytes += GROWTH * in_memory * encoded.map_or_else(of_varints, |each| length as u64 / each);
                }
                Content::Message(of) => self.count(of, held, depth)?,
            }
        }
        Some(())
    }
}

#[cfg(test)]
mod tests {
    use prost::Message;

    use super::*;
    use crate::rpc::proto::create_job_request::Source;
    use crate::rpc::proto::{CreateJobRequest, FocalPrior, ImageSize, TrackSet, UploadInputRequest, View};

    fn counted(encoded: &[u8], most: u64) -> Option<u64> {
        taken_by("/scpsfm.v1.JobService/CreateJob").expect("a method").decoded_bytes(encoded, most)
    }

    fn encoded(set: TrackSet) -> Vec<u8> {
        CreateJobRequest { source: Some(Source::TrackSet(set)), ..CreateJobRequest::default() }.encode_to_vec()
    }

    fn decoded(set: TrackSet) -> u64 {
        counted(&encoded(set), u64::MAX).expect("well-formed")
    }

    fn of_views(views: Vec<View>) -> TrackSet {
        TrackSet { views, ..TrackSet::default() }
    }

    #[test]
    fn every_method_takes_a_message_that_holds_no_less_than_its_type() {
        assert_eq!(TYPES.taken_by.len(), 21);
        assert!(decoded(TrackSet::default()) >= size_of::<CreateJobRequest>() as u64);
        let upload = taken_by("/scpsfm.v1.InputService/UploadInput").expect("a method");
        assert!(upload.decoded_bytes(&[], u64::MAX).expect("empty") >= size_of::<UploadInputRequest>() as u64);
        assert!(taken_by("/grpc.health.v1.Health/Check").is_none());
    }

    #[test]
    fn entries_count_as_what_they_take_in_memory() {
        let empty = decoded(TrackSet::default());
        let views = |view: View| decoded(of_views(vec![view; 1_000])) - empty;
        let least = 1_000 * GROWTH * size_of::<View>() as u64;
        let added = views(View::default());
        assert!((least..least + least / 4).contains(&added), "{added} for {least}");
        let full = View {
            name: "a".repeat(500),
            size: Some(ImageSize { width_px: 1, height_px: 1 }),
            camera_group: 3,
            focal_prior: Some(FocalPrior { focal_px: 1.0, sigma_log: 1.0 }),
        };
        assert_eq!(views(full), added + 500_000);
        let numbers = TrackSet {
            track_indices: (0..1_000).map(|number| number % 300).collect(),
            xs: vec![1.0; 1_000],
            ..TrackSet::default()
        };
        // The numbers, and an entry of each field.
        let added = decoded(numbers) - empty;
        assert!((GROWTH * 12_000..GROWTH * 12_100).contains(&added), "{added}");
    }

    #[test]
    fn counting_ends_beyond_the_bound() {
        let message = encoded(of_views(vec![View::default(); 100_000]));
        let least = decoded(TrackSet::default());
        let found = counted(&message, 2 * least).expect("well-formed so far");
        assert!((2 * least..3 * least).contains(&found), "{found} of {least}");
    }

    /// A group that is not known, before what is: prost skips it and decodes the rest.
    #[test]
    fn what_prost_skips_is_skipped() {
        let message = encoded(of_views(vec![View::default(); 1_000]));
        let with_group = [&[0x7b, 0x7c][..], &message].concat();
        assert!(CreateJobRequest::decode(with_group.as_slice()).is_ok());
        assert_eq!(counted(&with_group, u64::MAX), counted(&message, u64::MAX));
    }

    /// What is no message to prost is none here, before anything is decoded.
    #[test]
    fn what_cannot_be_decoded_is_refused() {
        let message = encoded(of_views(vec![View::default(); 1_000]));
        // A set of six bytes whose numbers take a thousand: prost reads them all first.
        let overlong = [&[0x2a, 6, 0x2a, 0xe8, 0x07][..], &[0; 1_000]].concat();
        for malformed in [&overlong[..], &[0x0b], &[0x0a, 0xff, 0x01], &[0x08, 0xff], &[0xff; 20]] {
            assert!(CreateJobRequest::decode(malformed).is_err());
            assert_eq!(counted(malformed, u64::MAX), None, "{malformed:?}");
        }
        for length in 0..200 {
            let cut = &message[..length];
            assert_eq!(counted(cut, u64::MAX).is_some(), CreateJobRequest::decode(cut).is_ok(), "{length}");
        }
    }
}
