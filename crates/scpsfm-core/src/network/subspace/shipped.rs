//! The network that the program asks: the one that it carries, unless another was given.

use std::sync::{LazyLock, OnceLock};

use super::PriorFile;
use crate::domain::Sha256Digest;

/// Made by `scpsfm train-prior`; its header has the command.
static SHIPPED: &[u8] = include_bytes!("shipped.prior");

/// The network given in its place.
static INSTALLED: OnceLock<PriorFile> = OnceLock::new();

/// The network that this process asks.
pub fn current() -> &'static PriorFile {
    INSTALLED.get().unwrap_or_else(|| shipped())
}

/// [`PriorFile::sha256`] of the network that this process asks, summed up once: every result has it.
pub fn current_sha256() -> Sha256Digest {
    static OF_INSTALLED: OnceLock<Sha256Digest> = OnceLock::new();
    static OF_SHIPPED: LazyLock<Sha256Digest> = LazyLock::new(|| shipped().sha256());
    match INSTALLED.get() {
        Some(installed) => *OF_INSTALLED.get_or_init(|| installed.sha256()),
        None => *OF_SHIPPED,
    }
}

/// Puts another network in place of the shipped one, for as long as the process lives. The first one given stays: one
/// process gives one answer.
///
/// # Errors
/// The file, where another one was given before.
pub fn install(file: PriorFile) -> Result<(), Box<PriorFile>> {
    INSTALLED.set(file).map_err(Box::new)
}

/// The network that the program carries.
///
/// # Panics
/// Never in a build whose tests passed: the bytes are part of it.
pub fn shipped() -> &'static PriorFile {
    static FILE: LazyLock<PriorFile> =
        LazyLock::new(|| PriorFile::read(SHIPPED).expect("the shipped prior is read by a test"));
    &FILE
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_shipped_network_is_written_as_it_was_read() {
        assert!(shipped().bytes() == SHIPPED, "the layout of files without pairs has changed");
    }

    #[test]
    fn the_shipped_network_says_how_it_was_made() {
        let origin = &shipped().origin;
        assert!(origin.command.starts_with("scpsfm train-prior "), "{origin:?}");
        assert!(origin.command.contains(&format!("--seed {}", origin.seed)), "{origin:?}");
        assert!(SHIPPED.len() < 200_000, "{} bytes in every binary", SHIPPED.len());
    }
}
