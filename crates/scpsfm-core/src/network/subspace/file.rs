//! The file that a trained network lives in: a line that says what it is, a line of JSON that says where it comes from,
//! then the numbers, little-endian f32, array by array in the order of [`SubspaceNet::map`].

use std::fs;
use std::path::Path;

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::arrays::{Shape, SubspaceNet};
use crate::domain::Sha256Digest;

/// First line of the format, which ends with the version of its layout.
const MAGIC: &str = "scpsfm-prior 1";
/// Longest header: a training command with room to spare. What has no line end by then is no such file.
const MOST_HEADER: usize = 64 << 10;
/// Bytes of a number.
const NUMBER: usize = size_of::<f32>();

/// How a network was made.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Origin {
    /// Version of the program that trained it.
    pub version: String,
    /// The command that makes the same file again.
    pub command: String,
    pub seed: u64,
    /// Steps that its training took.
    pub steps: u64,
}

#[derive(Serialize, Deserialize)]
struct Header {
    #[serde(flatten)]
    origin: Origin,
    shape: Shape,
    /// Of this header with nothing here, a line end and the numbers, in hexadecimal digits.
    sha256: String,
}

impl Header {
    /// The same with the checksum of itself and the numbers.
    fn sealed(mut self, numbers: &[u8]) -> Self {
        self.sha256 = self.digest(numbers).to_string();
        self
    }

    fn digest(&mut self, numbers: &[u8]) -> Sha256Digest {
        self.sha256.clear();
        let hash = Sha256::new_with_prefix(self.line()).chain_update(b"\n").chain_update(numbers);
        Sha256Digest(hash.finalize().into())
    }

    fn line(&self) -> String {
        // Plain numbers and strings: nothing of it can fail to be JSON.
        serde_json::to_string(self).unwrap_or_default()
    }
}

/// A trained network and where it comes from.
#[derive(Debug, Clone, PartialEq)]
pub struct PriorFile {
    pub origin: Origin,
    pub shape: Shape,
    pub network: SubspaceNet<Vec<f32>>,
}

/// Why bytes are not a trained network.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum FileError {
    #[error("it does not begin with the line `{MAGIC}`")]
    Foreign,
    #[error("its second line, a header in JSON, cannot be read: {0}")]
    Header(String),
    #[error("its header's {0}")]
    Shape(String),
    #[error("it holds {found} bytes of numbers, its shape has {expected}")]
    Length { found: usize, expected: usize },
    #[error("it does not have the checksum of its header: the file is damaged")]
    Checksum,
    #[error("number {0} is not finite")]
    NotFinite(usize),
}

/// Bytes that a file may have: the largest [`Shape`] has fewer.
const MOST_BYTES: u64 = 64 << 20;

impl PriorFile {
    /// Reads the file at a path, if it is a regular one of a network's size.
    ///
    /// # Errors
    /// What is wrong with it, in words without its name.
    pub fn open(path: &Path) -> Result<Self, String> {
        let there = fs::metadata(path).map_err(|error| error.to_string())?;
        if !there.is_file() || there.len() > MOST_BYTES {
            return Err(format!("not a trained network: not a regular file of {MOST_BYTES} bytes or fewer"));
        }
        let bytes = fs::read(path).map_err(|error| error.to_string())?;
        Self::read(&bytes).map_err(|error| format!("not a trained network: {error}"))
    }

    /// Reads a file; nothing of its header is believed before it is checked.
    ///
    /// # Errors
    /// [`FileError`] for what no training wrote.
    pub fn read(bytes: &[u8]) -> Result<Self, FileError> {
        let rest = bytes.strip_prefix(MAGIC.as_bytes()).and_then(|rest| rest.strip_prefix(b"\n"));
        let rest = rest.ok_or(FileError::Foreign)?;
        let end = rest.iter().take(MOST_HEADER).position(|&byte| byte == b'\n');
        let end = end.ok_or_else(|| FileError::Header("it has no end".into()))?;
        let (header, numbers) = (&rest[..end], &rest[end + 1..]);
        let header: Header = serde_json::from_slice(header).map_err(|error| FileError::Header(error.to_string()))?;
        if let Some(defect) = header.shape.defect() {
            return Err(FileError::Shape(defect));
        }
        let shapes = header.shape.arrays();
        let expected = NUMBER * shapes.arrays().iter().map(|[rows, columns]| rows * columns).sum::<usize>();
        if numbers.len() != expected {
            return Err(FileError::Length { found: numbers.len(), expected });
        }
        let claimed = header.sha256.clone();
        let header = header.sealed(numbers);
        if claimed != header.sha256 {
            return Err(FileError::Checksum);
        }
        let values: Vec<f32> = numbers.as_chunks::<NUMBER>().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
        if let Some(place) = values.iter().position(|value| !value.is_finite()) {
            return Err(FileError::NotFinite(place));
        }
        let mut rest = &values[..];
        let network = shapes.map(|[rows, columns]| {
            let (array, after) = rest.split_at(rows * columns);
            rest = after;
            array.to_vec()
        });
        Ok(Self { origin: header.origin, shape: header.shape, network })
    }

    /// The file's bytes.
    pub fn bytes(&self) -> Vec<u8> {
        let numbers = self.numbers();
        [MAGIC.as_bytes(), b"\n", self.header().sealed(&numbers).line().as_bytes(), b"\n", &numbers].concat()
    }

    /// The checksum that the file's header carries: what tells one network from another.
    pub fn sha256(&self) -> Sha256Digest {
        self.header().digest(&self.numbers())
    }

    fn numbers(&self) -> Vec<u8> {
        self.network.arrays().into_iter().flatten().flat_map(|value| value.to_le_bytes()).collect()
    }

    fn header(&self) -> Header {
        Header { origin: self.origin.clone(), shape: self.shape, sha256: String::new() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file() -> PriorFile {
        file_of(Shape { state: 3, selections: 2, blocks: 2, encoding: 2, strides: 0 })
    }

    fn file_of(shape: Shape) -> PriorFile {
        let mut next = 0.0;
        let network = shape.arrays().map(|[rows, columns]| {
            next += 1.0;
            vec![next; rows * columns]
        });
        let origin = Origin { version: "0.1.0".into(), command: "scpsfm train-prior".into(), seed: 7, steps: 9 };
        PriorFile { origin, shape, network }
    }

    #[test]
    fn a_file_reads_as_what_was_written() {
        for file in [file(), file_of(Shape { strides: 1, ..file().shape })] {
            assert_eq!(PriorFile::read(&file.bytes()), Ok(file));
        }
    }

    #[test]
    fn what_no_training_wrote_is_refused() {
        let bytes = file().bytes();
        let replaced = |from: &str, to: &str| {
            let place = bytes.windows(from.len()).position(|window| window == from.as_bytes()).expect("in the header");
            [&bytes[..place], to.as_bytes(), &bytes[place + from.len()..]].concat()
        };
        assert_eq!(PriorFile::read(b""), Err(FileError::Foreign));
        assert_eq!(PriorFile::read(b"scpsfm-prior 10\n{}\n"), Err(FileError::Foreign));
        assert!(matches!(PriorFile::read(b"scpsfm-prior 1\n{}\n"), Err(FileError::Header(_))));
        assert!(matches!(PriorFile::read(b"scpsfm-prior 1\n{}"), Err(FileError::Header(_))));
        let giant = replaced("\"blocks\":2", "\"blocks\":18446744073709551615");
        assert!(matches!(PriorFile::read(&giant), Err(FileError::Shape(_))));
        assert!(matches!(PriorFile::read(&bytes[..bytes.len() - 1]), Err(FileError::Length { .. })));
        let mut damaged = bytes.clone();
        *damaged.last_mut().expect("numbers") ^= 1;
        assert_eq!(PriorFile::read(&damaged), Err(FileError::Checksum));
        let forged = replaced("\"seed\":7", "\"seed\":8");
        assert_eq!(PriorFile::read(&forged), Err(FileError::Checksum), "the origin is under the checksum, too");
        assert!(String::from_utf8_lossy(&bytes).contains(&format!("{:?}", file().sha256().to_string())));
        let mut infinite = file();
        infinite.network.first_encoder.bias[0] = f32::INFINITY;
        assert!(matches!(PriorFile::read(&infinite.bytes()), Err(FileError::NotFinite(_))));
    }
}
