//! Damaged messages: deterministic mutations of good ones, and bytes that never were one.

use prost::encoding::encode_varint;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Mutations of one message at most: the first wrong byte often hides what comes after it.
const MOST_CHANGES: u32 = 4;

/// Bytes of what is made up, at most: room for some nested fields.
const MOST_MADE_UP: usize = 96;

/// Every so manieth case is made up of whole.
const MADE_UP_EVERY: u64 = 8;

/// The bytes of this case: one of the seeds damaged, parts of two, or made up of random fields.
pub fn case(seeds: &[Vec<u8>], number: u64) -> Vec<u8> {
    let mut rng = ChaCha8Rng::seed_from_u64(number);
    if number.is_multiple_of(MADE_UP_EVERY) {
        return made_up(&mut rng);
    }
    let any = |rng: &mut ChaCha8Rng| seeds[rng.random_range(0..seeds.len())].clone();
    let mut bytes = any(&mut rng);
    if rng.random_ratio(1, 8) {
        // A field that comes twice, or one of another message.
        bytes.extend(any(&mut rng));
    }
    for _ in 0..rng.random_range(1..=MOST_CHANGES) {
        change(&mut bytes, &mut rng);
    }
    bytes
}

/// Random bytes, or fields with random numbers, types and lengths.
fn made_up(rng: &mut ChaCha8Rng) -> Vec<u8> {
    let length = rng.random_range(0..MOST_MADE_UP);
    let mut bytes: Vec<u8> = (0..length).map(|_| rng.random()).collect();
    if rng.random_bool(0.5) {
        return bytes;
    }
    bytes.clear();
    while bytes.len() < length {
        bytes.push(rng.random_range(1..9) << 3 | rng.random_range(0..6));
        extreme(rng, &mut bytes);
        bytes.extend((0..rng.random_range(0..12)).map(|_| rng.random::<u8>()));
    }
    bytes
}

/// A varint at the edge of some type.
fn extreme(rng: &mut ChaCha8Rng, bytes: &mut Vec<u8>) {
    let edges = [0, 1, 0x7f, 0x80, 0xffff, i32::MAX as u64, u64::from(u32::MAX), 1 << 32, i64::MAX as u64, u64::MAX];
    encode_varint(edges[rng.random_range(0..edges.len())], bytes);
}

/// Bits and bytes flipped, numbers made extreme, parts cut, doubled or moved, and the end torn off.
fn change(bytes: &mut Vec<u8>, rng: &mut ChaCha8Rng) {
    if bytes.is_empty() {
        bytes.push(rng.random());
        return;
    }
    let at = rng.random_range(0..bytes.len());
    let length = rng.random_range(1..=8.min(bytes.len() - at));
    match rng.random_range(0..9) {
        0 => bytes[at] ^= 1 << rng.random_range(0..8),
        1 => bytes[at] = rng.random(),
        2 => bytes[at..at + length].fill(0xff),
        3 => bytes[at..at + length].fill(0),
        4 => drop(bytes.drain(at..at + length)),
        5 => {
            let part = bytes[at..at + length].to_vec();
            bytes.splice(at..at, part);
        }
        6 => bytes.truncate(at),
        7 => {
            let special = [f64::NAN, f64::INFINITY, -0.0, f64::MAX, f64::MIN_POSITIVE][rng.random_range(0..5)];
            bytes.splice(at..at + length, special.to_le_bytes());
        }
        _ => {
            let mut number = Vec::new();
            extreme(rng, &mut number);
            bytes.splice(at..at + length, number);
        }
    }
}
