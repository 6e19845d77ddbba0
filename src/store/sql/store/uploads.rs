//! Operations on uploads and on what was uploaded.

use std::sync::Arc;
use std::time::SystemTime;

use super::*;
use crate::store::sql::uploads;

impl dyn Database {
    /// Begins an upload, or goes on with one: from here on its earlier streams cannot write.
    ///
    /// # Errors
    /// [`Error::AlreadyExists`] where it was begun with another length or hash, [`Error::UploadsFull`],
    /// [`Error::UploadTooLarge`].
    pub async fn begin_upload(
        &self,
        new: &NewUpload,
        bounds: &UploadBounds,
        now: SystemTime,
    ) -> Result<BegunUpload, Error> {
        let bounds = *bounds;
        writes!(self, "begin_upload", Small, Begins(0), [new], |connection| uploads::begin(
            connection, &new, &bounds, now
        ))
    }

    /// Adds bytes to an upload, at its end.
    ///
    /// # Errors
    /// [`Error::UploadTakenOver`], [`Error::UploadNotFound`] where it was given up.
    pub async fn append_upload(
        &self,
        lease: &UploadLease,
        at_byte: u64,
        data: &[u8],
        now: SystemTime,
    ) -> Result<(), Error> {
        let data: Arc<[u8]> = data.into();
        writes!(self, "append_upload", Payload, Begins(data.len() as u64), [lease, data], |connection| {
            uploads::append(connection, &lease, at_byte, &data, now)
        })
    }

    /// Some of an upload's bytes from there on, which must be where a read before it ended; none at the end.
    ///
    /// # Errors
    /// [`Error::UploadTakenOver`].
    pub async fn read_upload(&self, lease: &UploadLease, at_byte: u64) -> Result<Vec<u8>, Error> {
        reads!(self, "read_upload", Payload, |connection| uploads::read(connection, lease, at_byte))
    }

    /// Makes an input of an upload whose bytes are all there.
    ///
    /// # Errors
    /// [`Error::UploadTakenOver`], [`Error::UploadNotFound`] where it was given up.
    pub async fn finish_upload(
        &self,
        lease: &UploadLease,
        new: &Arc<NewInput>,
        now: SystemTime,
    ) -> Result<StoredInput, Error> {
        let intent = Begins(new.payload.len() as u64);
        writes!(self, "finish_upload", Payload, intent, [lease, new], |connection| {
            uploads::finish(connection, &lease, &new, now)
        })
    }

    /// Gives an upload up: its id is free again.
    ///
    /// # Errors
    /// [`Error::UploadTakenOver`], [`Error::UploadNotFound`].
    pub async fn give_up_upload(&self, lease: &UploadLease) -> Result<(), Error> {
        writes!(self, "give_up_upload", Small, Ends(0), [lease], |connection| uploads::give_up(connection, &lease))
    }

    /// How far an upload has come.
    ///
    /// # Errors
    /// [`Error::UploadNotFound`].
    pub async fn upload(&self, name: &InputName) -> Result<UploadStatus, Error> {
        reads!(self, "upload", Small, |connection| uploads::status(connection, name))
    }

    /// An uploaded input.
    ///
    /// # Errors
    /// [`Error::InputNotFound`].
    pub async fn uploaded_input(&self, name: &InputName) -> Result<StoredInput, Error> {
        reads!(self, "uploaded_input", Small, |connection| uploads::input(connection, name))
    }

    /// One page of a tenant's uploaded inputs.
    ///
    /// # Errors
    /// [`Error::PageToken`].
    pub async fn inputs(&self, query: &InputQuery) -> Result<Page<StoredInput>, Error> {
        reads!(self, "inputs", Small, |connection| uploads::list(connection, query))
    }

    /// Takes an uploaded input's name away, which is free again at once. Jobs that were created with it keep it; it is
    /// removed with the last of them, or at once where there is none.
    ///
    /// # Errors
    /// [`Error::InputNotFound`].
    pub async fn delete_input(&self, name: &InputName) -> Result<(), Error> {
        writes!(self, "delete_input", Payload, Ends(ANY_BYTES), [name], |connection| uploads::delete(connection, &name))
    }

    /// Gives up the uploads to which nothing came since `abandoned_by`, and removes some of the bytes of those that
    /// were given up or finished, and some of the uploaded inputs that no job has and none was created with since
    /// `unused_since`. `None`: none.
    pub async fn purge_uploads(
        &self,
        abandoned_by: Option<SystemTime>,
        unused_since: Option<SystemTime>,
    ) -> Result<PurgedUploads, Error> {
        let _timer = store_operation("purge_uploads");
        if !reads!(self, Small, |connection| uploads::needs_purge(connection, abandoned_by, unused_since))? {
            return Ok(PurgedUploads::default());
        }
        writes!(self, Payload, Ends(ANY_BYTES), [], |connection| {
            uploads::purge(connection, abandoned_by, unused_since)
        })
    }
}
