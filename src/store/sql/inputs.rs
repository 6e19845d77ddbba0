//! Uploaded inputs: listed, used by jobs, and removed with what is left of their uploads.

use std::time::SystemTime;

use super::Size::{Payload, Small};
use super::WriteIntent::Ends;
use super::operation::{ANY_BYTES, reads, writes};
use super::rows::{self, micros, number};
use super::{Connection, Database, Row, Size, Statement};
use crate::domain::input_name::InputName;
use crate::store::query::Paged;
use crate::store::upload::{PurgedUploads, StoredInput};
use crate::store::{Error, InputQuery, Page};
use crate::telemetry::metrics::store_operation;

/// Rows of parts that one look removes at most, 32 MB of them: writers wait meanwhile.
const PURGE_PARTS: u32 = 128;

/// Inputs that one look removes at most; each may have a hundred megabytes.
const PURGE_INPUTS: u32 = 4;

/// The columns that [`stored_input`] reads.
macro_rules! input_columns {
    () => {
        "id, tenant, input, bytes, create_time, upload_bytes, sha256, view_count, track_count, observation_count"
    };
}
pub(super) use input_columns;

/// `SELECT` of all that [`stored_input`] reads; the clauses follow.
macro_rules! select_inputs {
    ($clauses:literal) => {
        concat!("SELECT ", input_columns!(), " FROM inputs ", $clauses)
    };
}

impl dyn Database {
    /// An uploaded input.
    ///
    /// # Errors
    /// [`Error::InputNotFound`].
    pub async fn uploaded_input(&self, name: &InputName) -> Result<StoredInput, Error> {
        reads!(self, "uploaded_input", Small, |connection| {
            let select =
                Statement::new(select_inputs!("WHERE tenant = $1 AND input = $2")).bind(&name.tenant).bind(&name.input);
            let row = connection.optional_row(select).await?;
            row.as_ref().map_or_else(|| Err(Error::InputNotFound(name.clone())), stored_input)
        })
    }

    /// One page of a tenant's uploaded inputs.
    ///
    /// # Errors
    /// [`Error::PageToken`].
    pub async fn inputs(&self, query: &InputQuery) -> Result<Page<StoredInput>, Error> {
        reads!(self, "inputs", Size::Page, |connection| {
            let select = Statement::new(select_inputs!("WHERE input IS NOT NULL AND tenant = "));
            let mut select = select.then_bind(&query.tenant);
            if let Some(cursor) = query.cursor()? {
                select = select.then(" AND (create_time, input) < (").then_bind(cursor.create_micros);
                select = select.then(", ").then_bind(&cursor.id).then(")");
            }
            let select = select.then(" ORDER BY create_time DESC, input DESC");
            connection.page(query, select, "input", stored_input).await
        })
    }

    /// Takes an uploaded input's name away, which is free again at once. Jobs that were created with it keep it; it is
    /// removed with the last of them, or at once where there is none.
    ///
    /// # Errors
    /// [`Error::InputNotFound`].
    pub async fn delete_input(&self, name: &InputName) -> Result<(), Error> {
        writes!(self, "delete_input", Payload, Ends(ANY_BYTES), [name], |connection| {
            let id = connection.lock_input(&name).await?.ok_or_else(|| Error::InputNotFound(name.clone()))?;
            // Those of its upload's parts that are left are removed by and by, as of one that was given up.
            let uploads = [
                "DELETE FROM uploads WHERE input_id = $1 AND NOT leftover",
                "UPDATE uploads SET upload = NULL, input_id = NULL WHERE input_id = $1",
                "UPDATE inputs SET input = NULL WHERE id = $1",
            ];
            connection.batch(uploads.map(|statement| Statement::new(statement).bind(id)).into()).await?;
            connection.remove_orphan_input(id).await
        })
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
        let select = Statement::new(
            "SELECT (EXISTS \
             (SELECT 1 FROM uploads WHERE input_id IS NULL AND upload IS NOT NULL AND update_time <= $1) \
             OR EXISTS (SELECT 1 FROM uploads WHERE leftover) \
             OR EXISTS (SELECT 1 FROM inputs WHERE input IS NOT NULL AND use_time <= $2 \
             AND NOT EXISTS (SELECT 1 FROM jobs WHERE jobs.input_id = inputs.id))) AS found",
        );
        let never = i64::MIN;
        let select = select.bind(abandoned_by.map_or(never, micros)).bind(unused_since.map_or(never, micros));
        if !self.finds(select).await? {
            return Ok(PurgedUploads::default());
        }
        writes!(self, Payload, Ends(ANY_BYTES), [], |connection| {
            let mut purged = PurgedUploads::default();
            if let Some(time) = abandoned_by {
                let update = Statement::new(
                    "UPDATE uploads SET upload = NULL, leftover = TRUE, writer = writer + 1 \
                     WHERE input_id IS NULL AND upload IS NOT NULL AND update_time <= $1 RETURNING id",
                );
                let abandoned = connection.rows(update.bind(micros(time))).await?;
                purged.abandoned = u32::try_from(abandoned.len()).unwrap_or(u32::MAX);
            }
            connection.purge_parts().await?;
            if let Some(time) = unused_since {
                let select = Statement::new(
                    "SELECT id FROM inputs WHERE input IS NOT NULL AND use_time <= $1 \
                     AND NOT EXISTS (SELECT 1 FROM jobs WHERE jobs.input_id = inputs.id) \
                     ORDER BY use_time, id LIMIT $2",
                );
                let select = select.bind(micros(time)).bind(PURGE_INPUTS).then(connection.skip_locked());
                for row in connection.rows(select).await? {
                    let delete = Statement::new("DELETE FROM inputs WHERE id = $1").bind(row.integer("id")?);
                    connection.execute(delete).await?;
                    purged.inputs += 1;
                }
            }
            Ok(purged)
        })
    }
}

impl dyn Connection + '_ {
    /// Removes an input that has no name, once no job has it.
    pub(super) async fn remove_orphan_input(&mut self, id: i64) -> Result<(), Error> {
        // Of two that take away the last uses of it at once, the later one waits, and then sees that the other is gone:
        // what it asks of the row, it asks after the wait.
        let lock = Statement::new("SELECT id FROM inputs WHERE id = $1").bind(id).then(self.for_update());
        self.execute(lock).await?;
        let delete = Statement::new(
            "DELETE FROM inputs WHERE id = $1 AND input IS NULL \
             AND NOT EXISTS (SELECT 1 FROM jobs WHERE jobs.input_id = $1)",
        );
        self.execute(delete.bind(id)).await
    }

    pub(super) async fn find_input(&mut self, id: i64) -> Result<Option<StoredInput>, Error> {
        let select = Statement::new(select_inputs!("WHERE id = $1")).bind(id);
        self.optional_row(select).await?.as_ref().map(stored_input).transpose()
    }

    /// The same of one that the transaction has locked or written.
    pub(super) async fn input_by_id(&mut self, id: i64) -> Result<StoredInput, Error> {
        let gone = || Error::Corrupt("an input that is held is not there".into());
        self.find_input(id).await?.ok_or_else(gone)
    }

    /// Locks the row of an uploaded input, if there is one.
    pub(super) async fn lock_input(&mut self, name: &InputName) -> Result<Option<i64>, Error> {
        let select = Statement::new("SELECT id FROM inputs WHERE tenant = $1 AND input = $2")
            .bind(&name.tenant)
            .bind(&name.input)
            .then(self.for_update());
        self.optional_row(select).await?.map(|row| row.integer("id")).transpose()
    }

    /// The row of an uploaded input that a job is about to have; it stays until the transaction ends.
    pub(super) async fn use_input(&mut self, name: &InputName, now: SystemTime) -> Result<i64, Error> {
        let update = Statement::new("UPDATE inputs SET use_time = $1 WHERE tenant = $2 AND input = $3 RETURNING id")
            .bind(micros(now))
            .bind(&name.tenant)
            .bind(&name.input);
        let row = self.optional_row(update).await?;
        row.ok_or_else(|| Error::InputNotFound(name.clone()))?.integer("id")
    }

    /// Removes some parts of one upload that has no more use for them, and its row with the last of a given up one.
    async fn purge_parts(&mut self) -> Result<(), Error> {
        let select = Statement::new("SELECT id, upload FROM uploads WHERE leftover ORDER BY id LIMIT 1");
        let Some(row) = self.optional_row(select.then(self.skip_locked())).await? else { return Ok(()) };
        let (id, given_up) = (row.integer("id")?, row.optional_text("upload")?.is_none());
        let delete = Statement::new(
            "DELETE FROM upload_parts WHERE upload_id = $1 AND at_byte IN \
             (SELECT at_byte FROM upload_parts WHERE upload_id = $1 ORDER BY at_byte LIMIT $2) RETURNING at_byte",
        );
        let removed = self.rows(delete.bind(id).bind(PURGE_PARTS)).await?.len();
        if removed == PURGE_PARTS as usize {
            return Ok(());
        }
        let end = match given_up {
            true => "DELETE FROM uploads WHERE id = $1",
            false => "UPDATE uploads SET leftover = FALSE WHERE id = $1",
        };
        self.execute(Statement::new(end).bind(id)).await
    }
}

pub(super) fn stored_input(row: &Row) -> Result<StoredInput, Error> {
    Ok(StoredInput {
        name: InputName { tenant: row.text("tenant")?, input: row.text("input")? },
        create_time: rows::time(row.integer("create_time")?),
        upload_bytes: number(row, "upload_bytes")?,
        sha256: digest(row.bytes("sha256")?)?,
        payload_bytes: number(row, "bytes")?,
        view_count: number(row, "view_count")?,
        track_count: number(row, "track_count")?,
        observation_count: number(row, "observation_count")?,
    })
}

pub(super) fn digest(bytes: &[u8]) -> Result<[u8; 32], Error> {
    bytes.try_into().map_err(|_| Error::Corrupt("a SHA-256 has not 32 bytes".into()))
}
