//! Uploads and the inputs that they become, as the store takes and gives them.

use std::time::SystemTime;

use crate::domain::input_name::InputName;

/// The first word of an upload, new or resumed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NewUpload {
    /// The name of the input that it is to become; its id is the upload's.
    pub name: InputName,
    /// Length that the caller declares.
    pub bytes: u64,
    /// SHA-256 of the whole, where the caller knows it beforehand.
    pub sha256: Option<[u8; 32]>,
}

/// The right to write to an upload. `writer` is the fencing token: a later stream has a larger one.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UploadLease {
    pub name: InputName,
    pub writer: u64,
}

/// What the first word of an upload came to.
#[derive(Debug, Clone, PartialEq)]
pub enum BegunUpload {
    /// It may go on from there.
    Open { lease: UploadLease, committed: u64, sha256: Option<[u8; 32]> },
    /// It was finished before.
    Finished(StoredInput),
}

/// How far an upload has come.
#[derive(Debug, Clone, PartialEq)]
pub struct UploadStatus {
    /// Length that was declared.
    pub bytes: u64,
    /// Bytes that are stored.
    pub committed: u64,
    /// What it became.
    pub input: Option<StoredInput>,
}

/// What an upload becomes.
#[derive(Debug, Clone)]
pub struct NewInput {
    /// Encoded [`crate::domain::Input`], see [`super::payload`].
    pub payload: Vec<u8>,
    /// SHA-256 of the bytes that were uploaded.
    pub sha256: [u8; 32],
    pub view_count: u32,
    pub track_count: u32,
    pub observation_count: u32,
}

/// An uploaded input.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StoredInput {
    pub name: InputName,
    pub create_time: SystemTime,
    /// Length of what was uploaded.
    pub upload_bytes: u64,
    pub sha256: [u8; 32],
    /// Length of the payload that was made of it.
    pub payload_bytes: u64,
    pub view_count: u32,
    pub track_count: u32,
    pub observation_count: u32,
}

/// What was removed of uploads.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct PurgedUploads {
    /// Uploads that nobody went on with.
    pub abandoned: u32,
    /// Uploaded inputs that no job has and none was created with for long.
    pub inputs: u32,
}
