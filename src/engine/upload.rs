//! Uploads: streams of bytes that become inputs, kept where the jobs are.

use std::sync::Arc;
use std::time::Duration;

use super::{Engine, Error, Inner, finished, observe};
use crate::domain::{Input, InputName};
use crate::store::{
    self, BegunUpload, InputQuery, NewInput, NewUpload, Page, StoredInput, UploadBounds, UploadLease, UploadStatus,
    payload,
};

/// How much may be uploaded, and how long the unfinished is kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct UploadOptions {
    pub bounds: UploadBounds,
    /// How long an upload may lie without a new byte; `None`: for good.
    pub abandoned_after: Option<Duration>,
}

impl UploadOptions {
    /// Six times the largest input that the default limits let through, so that limits may grow and a writer's encoding
    /// need not be the shortest.
    pub const DEFAULT_MAX_BYTES: u64 = 1 << 30;
    /// As many as a tenant's machines may upload side by side.
    pub const DEFAULT_TENANT_UPLOADS: u64 = 16;
    /// Eight of the largest, on a disk that should not fill up unseen.
    pub const DEFAULT_TENANT_BYTES: u64 = 8 << 30;
    /// A night, and a day to notice.
    pub const DEFAULT_ABANDONED_AFTER: Duration = Duration::from_secs(24 * 60 * 60);
}

impl Default for UploadOptions {
    fn default() -> Self {
        Self {
            bounds: UploadBounds {
                max_bytes: Self::DEFAULT_MAX_BYTES,
                max_tenant_uploads: Self::DEFAULT_TENANT_UPLOADS,
                max_tenant_bytes: Self::DEFAULT_TENANT_BYTES,
            },
            abandoned_after: Some(Self::DEFAULT_ABANDONED_AFTER),
        }
    }
}

/// What the first word of an upload came to.
#[derive(Debug)]
pub enum Begun {
    Open(Upload),
    /// It was finished before.
    Finished(StoredInput),
}

/// An upload in the hands of one stream.
#[derive(Debug, Clone)]
pub struct Upload {
    engine: Engine,
    lease: UploadLease,
    /// Bytes that are stored.
    pub committed: u64,
    /// Bytes that were declared.
    pub bytes: u64,
    /// SHA-256 that was declared, if any was.
    pub sha256: Option<[u8; 32]>,
}

impl Engine {
    /// Begins an upload, or goes on with one; its earlier streams end with [`StoreError::UploadTakenOver`].
    ///
    /// # Errors
    /// [`StoreError::AlreadyExists`] where it was begun with another length or hash, [`StoreError::UploadsFull`],
    /// [`StoreError::UploadTooLarge`], [`Error::Draining`].
    pub async fn begin_upload(&self, new: NewUpload) -> Result<Begun, Error> {
        self.inner.check_open()?;
        let bounds = &self.inner.options.uploads.bounds;
        let begun = self.inner.store.begin_upload(&new, bounds, self.inner.now()).await;
        match begun.inspect_err(observe::refused_by_store)? {
            BegunUpload::Finished(input) => Ok(Begun::Finished(input)),
            BegunUpload::Open { lease, committed, sha256 } => {
                Ok(Begun::Open(Upload { engine: self.clone(), lease, committed, bytes: new.bytes, sha256 }))
            }
        }
    }

    /// How far an upload has come.
    ///
    /// # Errors
    /// [`StoreError::UploadNotFound`].
    pub async fn upload_status(&self, name: &InputName) -> Result<UploadStatus, Error> {
        Ok(self.inner.store.upload(name).await?)
    }

    /// One page of a tenant's uploaded inputs.
    ///
    /// # Errors
    /// [`StoreError::PageToken`].
    pub async fn list_inputs(&self, query: &InputQuery) -> Result<Page<StoredInput>, Error> {
        Ok(self.inner.store.inputs(query).await?)
    }

    /// Deletes an uploaded input; jobs that were created with it keep it to their end.
    ///
    /// # Errors
    /// [`StoreError::InputNotFound`].
    pub async fn delete_input(&self, name: &InputName) -> Result<(), Error> {
        self.inner.store.delete_input(name).await?;
        tracing::info!(input = %name, "input deleted");
        Ok(())
    }
}

impl Inner {
    /// Gives up what nobody goes on with, and removes what is of no use any more.
    pub(super) async fn tidy_uploads(&self) {
        let before = |kept: Option<Duration>| kept.and_then(|kept| self.now().checked_sub(kept));
        let abandoned_by = before(self.options.uploads.abandoned_after);
        match self.store.purge_uploads(abandoned_by, before(self.options.retention)).await {
            Ok(purged) => {
                if purged.abandoned > 0 {
                    tracing::info!(abandoned = purged.abandoned, "gave up uploads that nobody went on with");
                    observe::uploads_given_up(observe::GivenUp::Abandoned, purged.abandoned);
                }
                if purged.inputs > 0 {
                    tracing::info!(removed = purged.inputs, "removed uploaded inputs that no job has any more");
                }
            }
            Err(error) => tracing::warn!(%error, "cannot remove what is left of uploads"),
        }
    }
}

impl Upload {
    /// Stores bytes at the end.
    ///
    /// # Errors
    /// [`StoreError::UploadTakenOver`] where another stream goes on with the upload, [`StoreError::UploadNotFound`]
    /// where it was given up, [`Error::Draining`] once they are stored.
    pub async fn append(&mut self, data: &[u8]) -> Result<(), Error> {
        let store = &self.engine.inner.store;
        store.append_upload(&self.lease, self.committed, data, self.engine.inner.now()).await?;
        self.committed += data.len() as u64;
        observe::uploaded(data.len() as u64);
        self.engine.inner.check_open()
    }

    /// Some of the stored bytes from there on; none at the end.
    ///
    /// # Errors
    /// [`StoreError::UploadTakenOver`].
    pub async fn read(&self, at_byte: u64) -> Result<Vec<u8>, Error> {
        Ok(self.engine.inner.store.read_upload(&self.lease, at_byte).await?)
    }

    /// Makes an input of the upload.
    ///
    /// # Errors
    /// [`StoreError::UploadTakenOver`], [`StoreError::UploadNotFound`].
    pub async fn finish(self, input: Input, sha256: [u8; 32]) -> Result<StoredInput, Error> {
        // Megabytes of arrays: not on a thread that serves others.
        let encode = move || {
            let count = |number: usize| u32::try_from(number).unwrap_or(u32::MAX);
            Ok::<_, store::Error>(NewInput {
                payload: payload::encode(&input)?,
                sha256,
                view_count: count(input.view_count()),
                track_count: count(input.track_count()),
                observation_count: count(input.observation_count()),
            })
        };
        let new = Arc::new(finished(tokio::task::spawn_blocking(encode)).await?);
        let store = Arc::clone(&self.engine.inner.store);
        let input = store.finish_upload(&self.lease, &new, self.engine.inner.now()).await?;
        observe::input_created();
        tracing::info!(input = %input.name, bytes = input.upload_bytes, "input uploaded");
        Ok(input)
    }

    /// Gives the upload up: its bytes are no input.
    ///
    /// # Errors
    /// [`StoreError::UploadTakenOver`], [`StoreError::UploadNotFound`].
    pub async fn give_up(self, reason: observe::GivenUp) -> Result<(), Error> {
        self.engine.inner.store.give_up_upload(&self.lease).await?;
        observe::uploads_given_up(reason, 1);
        Ok(())
    }
}
