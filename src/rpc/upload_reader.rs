//! The bytes of an upload as its decoder wants them: one after the other, from a store that gives them part by part.

use prost::bytes::{Buf, Bytes};
use sha2::{Digest, Sha256};
use tokio::sync::mpsc;

use crate::engine::{Error, Upload};

/// Parts that are read before the decoder asks for them.
const PREFETCHED_PARTS: usize = 2;

/// What stands in for bytes that could not be read, so that whoever reads comes to an end.
const ZEROS: [u8; 4096] = [0; 4096];

/// Reads the whole of an upload, in order, for a [`UploadReader`]; ends early where nobody wants more.
pub async fn feed(upload: &Upload, parts: mpsc::Sender<Result<Bytes, Error>>) {
    let mut at = 0;
    while at < upload.committed {
        let part = match upload.read(at).await {
            Ok(part) if part.is_empty() => Err(Error::Internal("bytes of an upload are missing".into())),
            other => other,
        };
        let failed = part.is_err();
        at += part.as_ref().map_or(0, |part| part.len() as u64);
        if parts.send(part.map(Bytes::from)).await.is_err() || failed {
            return;
        }
    }
}

/// The bytes of an upload, hashed as they go by. Waits for them: not for a thread that serves others.
pub struct UploadReader {
    parts: mpsc::Receiver<Result<Bytes, Error>>,
    current: Bytes,
    remaining: usize,
    hash: Sha256,
    failed: Option<Error>,
}

impl UploadReader {
    /// Of an upload of that length, and where [`feed`] is to put its parts.
    pub fn new(bytes: usize) -> (mpsc::Sender<Result<Bytes, Error>>, Self) {
        let (sender, parts) = mpsc::channel(PREFETCHED_PARTS);
        (sender, Self { parts, current: Bytes::new(), remaining: bytes, hash: Sha256::new(), failed: None })
    }

    /// Has the first bytes at hand: to be called on the thread that reads.
    pub fn begun(mut self) -> Self {
        self.fetch();
        self
    }

    /// Reads what is left.
    ///
    /// # Errors
    /// Why the bytes could not be read; what was decoded is worth nothing then.
    pub fn into_hash(mut self) -> Result<[u8; 32], Error> {
        while self.remaining > 0 && self.failed.is_none() {
            self.fetch();
            self.advance(self.current.len().min(self.remaining));
        }
        match self.failed {
            Some(error) => Err(error),
            None => Ok(self.hash.finalize().into()),
        }
    }

    /// Has the next bytes at hand, if there are any.
    fn fetch(&mut self) {
        if !self.current.is_empty() || self.remaining == 0 || self.failed.is_some() {
            return;
        }
        match self.parts.blocking_recv() {
            Some(Ok(part)) => {
                self.hash.update(&part);
                self.current = part;
            }
            Some(Err(error)) => self.failed = Some(error),
            None => self.failed = Some(Error::Internal("an upload was read to its end too early".into())),
        }
    }
}

impl Buf for UploadReader {
    fn remaining(&self) -> usize {
        self.remaining
    }

    fn chunk(&self) -> &[u8] {
        let bytes = if self.current.is_empty() { &ZEROS[..] } else { &self.current };
        &bytes[..bytes.len().min(self.remaining)]
    }

    fn advance(&mut self, mut count: usize) {
        assert!(count <= self.remaining, "nobody reads beyond the end");
        while count > 0 {
            let step = if self.failed.is_some() { count } else { count.min(self.current.len()) };
            if self.failed.is_none() {
                self.current.advance(step);
            }
            count -= step;
            self.remaining -= step;
            self.fetch();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A reader of these bytes that come in pieces of that length, and where they end.
    fn reader(bytes: &[u8], piece: usize, end: Option<Error>) -> UploadReader {
        let (sender, reader) = UploadReader::new(bytes.len() + usize::from(end.is_some()));
        let pieces: Vec<_> = bytes.chunks(piece).map(|piece| Ok(Bytes::copy_from_slice(piece))).collect();
        std::thread::spawn(move || {
            for piece in pieces.into_iter().chain(end.map(Err)) {
                sender.blocking_send(piece).expect("somebody reads");
            }
        });
        reader.begun()
    }

    #[test]
    fn the_bytes_and_their_hash_are_those_that_were_stored() {
        let bytes: Vec<u8> = (0..10_000_u32).map(|k| (k % 251) as u8).collect();
        for piece in [1, 7, 4096, 20_000] {
            let mut reader = reader(&bytes, piece, None);
            let mut read = vec![0; 5_000];
            reader.copy_to_slice(&mut read);
            assert_eq!(read, bytes[..5_000]);
            assert_eq!((reader.remaining(), reader.get_u8()), (5_000, bytes[5_000]));
            assert_eq!(reader.into_hash(), Ok(Sha256::digest(&bytes).into()), "in pieces of {piece}");
        }
    }

    #[test]
    fn bytes_that_cannot_be_read_end_the_reading() {
        let away = Error::Internal("away".into());
        let mut reader = reader(&[1; 100], 30, Some(away.clone()));
        let mut read = vec![9; 101];
        reader.copy_to_slice(&mut read);
        assert_eq!((read[99], read[100]), (1, 0));
        assert_eq!(reader.into_hash(), Err(away));
    }
}
