//! How inputs, results and small records become bytes: MessagePack with named fields, so that a newer binary reads
//! what an older one wrote; large payloads are cut into rows.

use serde::Serialize;
use serde::de::DeserializeOwned;

use super::Error;

/// Size of a payload row in bytes. Large enough that a 100 MB input is some 400 rows, small enough that no buffer of
/// the database or of a reader grows with the payload.
pub const CHUNK_BYTES: usize = 256 * 1024;

/// Encodes a value.
///
/// # Errors
/// [`Error::Corrupt`] for a value that the format cannot express.
pub fn encode<T: Serialize>(value: &T) -> Result<Vec<u8>, Error> {
    rmp_serde::to_vec_named(value).map_err(|error| Error::Corrupt(format!("cannot encode a payload: {error}")))
}

/// Decodes what [`encode`] made; `what` names it in the error.
///
/// # Errors
/// [`Error::Corrupt`].
pub fn decode<T: DeserializeOwned>(bytes: &[u8], what: &str) -> Result<T, Error> {
    rmp_serde::from_slice(bytes).map_err(|error| Error::Corrupt(format!("cannot decode {what}: {error}")))
}
