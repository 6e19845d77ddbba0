//! Uploads: begun, continued, made an input of, given up.

use std::sync::Arc;
use std::time::SystemTime;

use super::Size::{Payload, Small};
use super::WriteIntent::{Begins, Ends};
use super::inputs::{digest, input_columns, stored_input};
use super::operation::{reads, writes};
use super::rows::{integer, micros, number};
use super::{Connection, Database, Lock, Statement, jobs};
use crate::domain::input_name::InputName;
use crate::store::upload::{BegunUpload, NewInput, NewUpload, StoredInput, UploadLease, UploadStatus};
use crate::store::{Error, TakenId, UploadBounds, payload};

/// Rows of parts that one read brings: as much as one append of a caller's chunk writes.
const READ_PARTS: u32 = 4;

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
        writes!(self, "begin_upload", Small, Begins(0), [new], |connection| {
            // Where an operation needs several of them, an input's row comes first, admission next, an upload's row
            // last: two that took them in different orders would wait for each other.
            if let Some(input) = connection.begun_again(&new, now).await? {
                return Ok(BegunUpload::Finished(input));
            }
            // Of two that begin the same one, or that share the last room, one waits for the other.
            connection.take_lock(Lock::Admission).await?;
            let Some(upload) = connection.find_upload(&new.name, true).await? else {
                return connection.open_upload(&new, &bounds, now).await;
            };
            if let Some(id) = upload.input_id {
                // It was finished since the look above, and so is as good as used now.
                let input = connection.input_by_id(id).await?;
                check_same(&new, upload.bytes, Some(input.sha256))?;
                return Ok(BegunUpload::Finished(input));
            }
            check_same(&new, upload.bytes, upload.sha256)?;
            let sha256 = upload.sha256.or(new.sha256);
            let update = Statement::new(
                "UPDATE uploads SET writer = writer + 1, update_time = $1, sha256 = $2 WHERE id = $3 RETURNING writer",
            )
            .bind(micros(now))
            .bind(sha256.map(|digest| digest.to_vec()))
            .bind(upload.id);
            let writer = number(&connection.row(update).await?, "writer")?;
            let lease = UploadLease { name: new.name, writer };
            Ok(BegunUpload::Open { lease, committed: upload.committed, sha256 })
        })
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
            let upload = connection.held_upload(&lease).await?;
            let end = at_byte.saturating_add(data.len() as u64);
            if upload.committed != at_byte || end > upload.bytes {
                // A write of this stream that was given up for lost has arrived after all: whoever goes on asks where.
                return Err(Error::UploadTakenOver(lease.name));
            }
            let mut at = at_byte;
            for part in data.chunks(payload::CHUNK_BYTES) {
                let insert = Statement::new("INSERT INTO upload_parts (upload_id, at_byte, data) VALUES ($1, $2, $3)");
                connection.execute(insert.bind(upload.id).bind(integer(at)).bind(part)).await?;
                at += part.len() as u64;
            }
            let update = Statement::new("UPDATE uploads SET committed = $1, update_time = $2 WHERE id = $3");
            connection.execute(update.bind(integer(end)).bind(micros(now)).bind(upload.id)).await
        })
    }

    /// Some of an upload's bytes from there on, which must be where a read before it ended; none at the end.
    ///
    /// # Errors
    /// [`Error::UploadTakenOver`].
    pub async fn read_upload(&self, lease: &UploadLease, at_byte: u64) -> Result<Vec<u8>, Error> {
        reads!(self, "read_upload", Payload, |connection| {
            let upload = match connection.find_upload(&lease.name, false).await? {
                Some(upload) if upload.writer == lease.writer && upload.input_id.is_none() => upload,
                _ => return Err(Error::UploadTakenOver(lease.name.clone())),
            };
            let select = Statement::new(
                "SELECT data FROM upload_parts WHERE upload_id = $1 AND at_byte >= $2 ORDER BY at_byte LIMIT $3",
            );
            let rows = connection.rows(select.bind(upload.id).bind(integer(at_byte)).bind(READ_PARTS)).await?;
            jobs::joined(&rows)
        })
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
            let upload = connection.held_upload(&lease).await?;
            if upload.committed != upload.bytes {
                return Err(Error::Corrupt(format!(
                    "{} of {} bytes of an upload are no input",
                    upload.committed, upload.bytes
                )));
            }
            let id = connection.insert_input(&lease.name.tenant, &new.payload, now).await?;
            let describe = Statement::new(
                "UPDATE inputs SET input = $1, upload_bytes = $2, sha256 = $3, view_count = $4, track_count = $5, \
                 observation_count = $6, use_time = $7 WHERE id = $8",
            )
            .bind(&lease.name.input)
            .bind(integer(upload.bytes))
            .bind(new.sha256.as_slice())
            .bind(new.view_count)
            .bind(new.track_count)
            .bind(new.observation_count)
            .bind(micros(now))
            .bind(id);
            connection.execute(describe).await?;
            let update = Statement::new("UPDATE uploads SET input_id = $1, leftover = TRUE WHERE id = $2");
            connection.execute(update.bind(id).bind(upload.id)).await?;
            connection.input_by_id(id).await
        })
    }

    /// Gives an upload up: its id is free again.
    ///
    /// # Errors
    /// [`Error::UploadTakenOver`], [`Error::UploadNotFound`].
    pub async fn give_up_upload(&self, lease: &UploadLease) -> Result<(), Error> {
        writes!(self, "give_up_upload", Small, Ends(0), [lease], |connection| {
            let upload = connection.held_upload(&lease).await?;
            let update = "UPDATE uploads SET upload = NULL, leftover = TRUE, writer = writer + 1 WHERE id = $1";
            connection.execute(Statement::new(update).bind(upload.id)).await
        })
    }

    /// How far an upload has come.
    ///
    /// # Errors
    /// [`Error::UploadNotFound`].
    pub async fn upload(&self, name: &InputName) -> Result<UploadStatus, Error> {
        reads!(self, "upload", Small, |connection| {
            let found = connection.find_upload(name, false).await?;
            let Some(upload) = found else { return Err(Error::UploadNotFound(name.clone())) };
            let input = match upload.input_id {
                Some(id) => {
                    // None where it was deleted between the two looks, and the upload with it.
                    let input = connection.find_input(id).await?;
                    Some(input.ok_or_else(|| Error::UploadNotFound(name.clone()))?)
                }
                None => None,
            };
            Ok(UploadStatus { bytes: upload.bytes, committed: upload.committed, input })
        })
    }
}

impl dyn Connection + '_ {
    async fn find_upload(&mut self, name: &InputName, lock: bool) -> Result<Option<Upload>, Error> {
        let select = Statement::new(
            "SELECT id, bytes, sha256, committed, writer, input_id FROM uploads WHERE tenant = $1 AND upload = $2",
        )
        .bind(&name.tenant)
        .bind(&name.input)
        .then(if lock { self.for_update() } else { "" });
        let Some(row) = self.optional_row(select).await? else { return Ok(None) };
        Ok(Some(Upload {
            id: row.integer("id")?,
            bytes: number(&row, "bytes")?,
            sha256: row.optional_bytes("sha256")?.map(digest).transpose()?,
            committed: number(&row, "committed")?,
            writer: number(&row, "writer")?,
            input_id: row.optional_integer("input_id")?,
        }))
    }

    /// The upload that this lease still holds: what every write begins with.
    async fn held_upload(&mut self, lease: &UploadLease) -> Result<Upload, Error> {
        match self.find_upload(&lease.name, true).await? {
            Some(upload) if upload.writer == lease.writer && upload.input_id.is_none() => Ok(upload),
            Some(_) => Err(Error::UploadTakenOver(lease.name.clone())),
            None => Err(Error::UploadNotFound(lease.name.clone())),
        }
    }

    /// The input that a finished upload of this name became; whoever asks for it anew is going to use it.
    async fn begun_again(&mut self, new: &NewUpload, now: SystemTime) -> Result<Option<StoredInput>, Error> {
        let update = Statement::new(concat!(
            "UPDATE inputs SET use_time = $1 WHERE tenant = $2 AND input = $3 RETURNING ",
            input_columns!()
        ));
        let update = update.bind(micros(now)).bind(&new.name.tenant).bind(&new.name.input);
        let Some(row) = self.optional_row(update).await? else { return Ok(None) };
        let input = stored_input(&row)?;
        check_same(new, input.upload_bytes, Some(input.sha256))?;
        Ok(Some(input))
    }

    async fn open_upload(
        &mut self,
        new: &NewUpload,
        bounds: &UploadBounds,
        now: SystemTime,
    ) -> Result<BegunUpload, Error> {
        if let Some(oversize) = bounds.never_takes(new.bytes) {
            return Err(Error::UploadTooLarge(oversize));
        }
        // All of it in bytes as they were sent, which callers know and are shown. Of what was given up counts what has
        // not been removed yet, and of what was deleted, what jobs still have: it lies on the disk all the same, and
        // could else be uploaded and deleted again and again.
        let taken = Statement::new(
            "SELECT COUNT(upload) AS open, \
             CAST(COALESCE(SUM(CASE WHEN upload IS NULL THEN committed ELSE bytes END), 0) AS BIGINT) AS bytes, \
             (SELECT CAST(COALESCE(SUM(upload_bytes), 0) AS BIGINT) FROM inputs \
             WHERE tenant = $1 AND upload_bytes IS NOT NULL) AS kept \
             FROM uploads WHERE tenant = $1 AND input_id IS NULL",
        );
        let row = self.row(taken.bind(&new.name.tenant)).await?;
        let taken: u64 = number::<u64>(&row, "bytes")?.saturating_add(number(&row, "kept")?);
        if let Some(bound) = bounds.refuses(number(&row, "open")?, taken, new.bytes) {
            return Err(Error::UploadsFull(bound));
        }
        let insert = Statement::new(
            "INSERT INTO uploads (tenant, upload, bytes, sha256, writer, update_time) VALUES ($1, $2, $3, $4, 1, $5)",
        )
        .bind(&new.name.tenant)
        .bind(&new.name.input)
        .bind(integer(new.bytes))
        .bind(new.sha256.map(|digest| digest.to_vec()))
        .bind(micros(now));
        self.execute(insert).await?;
        let lease = UploadLease { name: new.name.clone(), writer: 1 };
        Ok(BegunUpload::Open { lease, committed: 0, sha256: new.sha256 })
    }
}

/// An upload's row.
struct Upload {
    id: i64,
    bytes: u64,
    sha256: Option<[u8; 32]>,
    committed: u64,
    writer: u64,
    input_id: Option<i64>,
}

/// Refuses other bytes than those that the upload was begun with.
fn check_same(new: &NewUpload, bytes: u64, sha256: Option<[u8; 32]>) -> Result<(), Error> {
    let other_hash = new.sha256.zip(sha256).is_some_and(|(declared, known)| declared != known);
    if bytes == new.bytes && !other_hash {
        return Ok(());
    }
    let what = if other_hash { "SHA-256" } else { "length" };
    Err(Error::AlreadyExists(TakenId::Upload(new.name.clone(), what)))
}
