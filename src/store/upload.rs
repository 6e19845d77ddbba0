//! Uploads and the inputs that they become, as the store takes and gives them.

use std::fmt;
use std::time::SystemTime;

use crate::domain::input_name::InputName;
use crate::domain::{Oversize, Quota};

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

/// How much one tenant may upload.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct UploadBounds {
    /// Of one upload.
    pub max_bytes: u64,
    /// Uploads that are begun and not finished.
    pub max_tenant_uploads: u64,
    /// Lengths of those as they were declared, and of the uploaded inputs that are kept as they were uploaded, also of
    /// those that were deleted and that jobs still have. What is stored of an input takes about 1.3 times as much.
    pub max_tenant_bytes: u64,
}

impl UploadBounds {
    /// The bound that an upload of so many bytes breaks by itself, however little the tenant has: it never fits.
    pub fn never_takes(&self, bytes: u64) -> Option<Oversize> {
        [(Quota::UploadBytes, self.max_bytes), (Quota::TenantUploadBytes, self.max_tenant_bytes)]
            .into_iter()
            .find(|(_, max)| bytes > *max)
            .map(|(quota, max)| Oversize { quota, asked: bytes, max })
    }

    /// The bound that one more upload would break, where so many are open and so many bytes are taken.
    pub fn refuses(&self, open: u64, taken_bytes: u64, bytes: u64) -> Option<UploadBound> {
        if open >= self.max_tenant_uploads {
            Some(UploadBound::Uploads { open, max: self.max_tenant_uploads })
        } else if taken_bytes.saturating_add(bytes) > self.max_tenant_bytes {
            Some(UploadBound::Bytes { taken: taken_bytes, asked: bytes, max: self.max_tenant_bytes })
        } else {
            None
        }
    }
}

/// The bound that refused an upload.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UploadBound {
    Uploads { open: u64, max: u64 },
    Bytes { taken: u64, asked: u64, max: u64 },
}

impl UploadBound {
    /// What there is too much of.
    pub fn quota(self) -> Quota {
        match self {
            UploadBound::Uploads { .. } => Quota::TenantUploads,
            UploadBound::Bytes { .. } => Quota::TenantUploadBytes,
        }
    }
}

impl fmt::Display for UploadBound {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            UploadBound::Uploads { open, max } => {
                write!(f, "{open} of at most {max} uploads of the tenant are open: finish one, or let it expire")
            }
            UploadBound::Bytes { taken, asked, max } => write!(
                f,
                "{asked} bytes more are too many: the tenant's uploads and uploaded inputs take {taken} of at most {max} \
                 bytes; delete inputs that no job needs any more (`scpsfm inputs`, `scpsfm delete --input`), or have \
                 `upload.tenant_bytes` raised"
            ),
        }
    }
}

/// What was removed of uploads.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct PurgedUploads {
    /// Uploads that nobody went on with.
    pub abandoned: u32,
    /// Uploaded inputs that no job has and none was created with for long.
    pub inputs: u32,
}
