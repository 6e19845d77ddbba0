//! Damaged files for tests of readers: deterministic mutations of good ones.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Inputs of a reader in a normal run; `SCPSFM_MUTATIONS` says another number.
const DEFAULT_COUNT: u64 = 2_000;
/// Mutations of one input at most: the first wrong byte often hides what comes after it.
const MOST_CHANGES: u32 = 4;

/// How many inputs a test of mutations tries.
pub(crate) fn count() -> u64 {
    std::env::var("SCPSFM_MUTATIONS").ok().and_then(|text| text.parse().ok()).unwrap_or(DEFAULT_COUNT)
}

/// The mutated input of this number.
pub(crate) fn mutated(seeds: &[Vec<u8>], number: u64) -> Vec<u8> {
    let mut rng = ChaCha8Rng::seed_from_u64(number);
    let mut bytes = seeds[(number % seeds.len() as u64) as usize].clone();
    for _ in 0..rng.random_range(1..=MOST_CHANGES) {
        change(&mut bytes, &mut rng);
    }
    bytes
}

/// Bits and bytes flipped, numbers made extreme, parts cut, doubled or moved, and the end torn off.
fn change(bytes: &mut Vec<u8>, rng: &mut ChaCha8Rng) {
    if bytes.is_empty() {
        bytes.push(rng.random());
        return;
    }
    let at = rng.random_range(0..bytes.len());
    let length = rng.random_range(1..=8.min(bytes.len() - at));
    match rng.random_range(0..8) {
        0 => bytes[at] ^= 1 << rng.random_range(0..8),
        1 => bytes[at] = rng.random(),
        2 => bytes[at..at + length].fill(0xFF),
        3 => bytes[at..at + length].fill(0),
        4 => drop(bytes.drain(at..at + length)),
        5 => {
            let part = bytes[at..at + length].to_vec();
            bytes.splice(at..at, part);
        }
        6 => bytes.truncate(at),
        _ => {
            let extremes: [&[u8]; 6] = [b"-", b"9999999999999999999", b"1e308", b"nan", b"\t,\n \r", b"\xF0\x9F"];
            bytes.splice(at..at + length, extremes[rng.random_range(0..extremes.len())].iter().copied());
        }
    }
}

/// Gives a reader every mutated input; an error must have words. Returns how many were accepted.
///
/// # Panics
/// When the reader does, naming the number of the input.
pub(crate) fn survives(seeds: &[Vec<u8>], read: impl Fn(&[u8]) -> Result<(), String>) -> u64 {
    let mut accepted = 0;
    for number in 0..count() {
        let bytes = mutated(seeds, number);
        let outcome = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| read(&bytes)));
        match outcome.unwrap_or_else(|_| panic!("mutation {number} made the reader panic")) {
            Ok(()) => accepted += 1,
            Err(words) => assert!(!words.is_empty(), "mutation {number} was refused without a word"),
        }
    }
    accepted
}
