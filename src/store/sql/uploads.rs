//! Uploads: begun, continued, made an input of, given up; and the uploaded inputs.

use std::collections::BTreeSet;
use std::time::SystemTime;

use super::rows::{self, integer, micros, number};
use super::{Connection, Lock, Row, Statement, jobs};
use crate::domain::input_name::InputName;
use crate::store::query::Paged;
use crate::store::upload::{BegunUpload, NewInput, NewUpload, PurgedUploads, StoredInput, UploadLease, UploadStatus};
use crate::store::{Error, InputQuery, Page, TakenId, UploadBounds, payload};

/// Rows of parts that one look removes at most, 32 MB of them: writers wait meanwhile.
const PURGE_PARTS: u32 = 128;

/// Rows of parts that one read brings: as much as one append of a caller's chunk writes.
const READ_PARTS: u32 = 4;

/// Inputs that one look removes at most; each may have a hundred megabytes.
const PURGE_INPUTS: u32 = 4;

/// The columns that [`stored_input`] reads.
macro_rules! input_columns {
    () => {
        "id, tenant, input, bytes, create_time, upload_bytes, sha256, view_count, track_count, observation_count"
    };
}

/// `SELECT` of all that [`stored_input`] reads; the clauses follow.
macro_rules! select_inputs {
    ($clauses:literal) => {
        concat!("SELECT ", input_columns!(), " FROM inputs ", $clauses)
    };
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

async fn find(connection: &mut dyn Connection, name: &InputName, lock: bool) -> Result<Option<Upload>, Error> {
    let select = Statement::new(
        "SELECT id, bytes, sha256, committed, writer, input_id FROM uploads WHERE tenant = $1 AND upload = $2",
    )
    .bind(&name.tenant)
    .bind(&name.input)
    .then(if lock { connection.for_update() } else { "" });
    let Some(row) = connection.optional_row(select).await? else { return Ok(None) };
    Ok(Some(Upload {
        id: row.integer("id")?,
        bytes: number(&row, "bytes")?,
        sha256: row.optional_bytes("sha256")?.map(digest).transpose()?,
        committed: number(&row, "committed")?,
        writer: number(&row, "writer")?,
        input_id: row.optional_integer("input_id")?,
    }))
}

fn digest(bytes: &[u8]) -> Result<[u8; 32], Error> {
    bytes.try_into().map_err(|_| Error::Corrupt("a SHA-256 has not 32 bytes".into()))
}

/// The upload that this lease still holds: what every write begins with.
async fn held(connection: &mut dyn Connection, lease: &UploadLease) -> Result<Upload, Error> {
    match find(connection, &lease.name, true).await? {
        Some(upload) if upload.writer == lease.writer && upload.input_id.is_none() => Ok(upload),
        Some(_) => Err(Error::UploadTakenOver(lease.name.clone())),
        None => Err(Error::UploadNotFound(lease.name.clone())),
    }
}

/// Begins an upload, or goes on with one; see `Store::begin_upload`.
pub(super) async fn begin(
    connection: &mut dyn Connection,
    new: &NewUpload,
    bounds: &UploadBounds,
    now: SystemTime,
) -> Result<BegunUpload, Error> {
    // Where an operation needs several of them, an input's row comes first, admission next, an upload's row last: two
    // that took them in different orders would wait for each other.
    if let Some(input) = begun_again(connection, new, now).await? {
        return Ok(BegunUpload::Finished(input));
    }
    // Of two that begin the same one, or that share the last room, one waits for the other.
    connection.take_lock(Lock::Admission).await?;
    let Some(upload) = find(connection, &new.name, true).await? else {
        return open(connection, new, bounds, now).await;
    };
    if let Some(id) = upload.input_id {
        // It was finished since the look above, and so is as good as used now.
        let input = input_by_id(connection, id).await?;
        check_same(new, upload.bytes, Some(input.sha256))?;
        return Ok(BegunUpload::Finished(input));
    }
    check_same(new, upload.bytes, upload.sha256)?;
    let sha256 = upload.sha256.or(new.sha256);
    let update = Statement::new(
        "UPDATE uploads SET writer = writer + 1, update_time = $1, sha256 = $2 WHERE id = $3 RETURNING writer",
    )
    .bind(micros(now))
    .bind(sha256.map(|digest| digest.to_vec()))
    .bind(upload.id);
    let writer = number(&connection.row(update).await?, "writer")?;
    let lease = UploadLease { name: new.name.clone(), writer };
    Ok(BegunUpload::Open { lease, committed: upload.committed, sha256 })
}

/// The input that a finished upload of this name became; whoever asks for it anew is going to use it.
async fn begun_again(
    connection: &mut dyn Connection,
    new: &NewUpload,
    now: SystemTime,
) -> Result<Option<StoredInput>, Error> {
    let update = Statement::new(concat!(
        "UPDATE inputs SET use_time = $1 WHERE tenant = $2 AND input = $3 RETURNING ",
        input_columns!()
    ));
    let update = update.bind(micros(now)).bind(&new.name.tenant).bind(&new.name.input);
    let Some(row) = connection.optional_row(update).await? else { return Ok(None) };
    let input = stored_input(&row)?;
    check_same(new, input.upload_bytes, Some(input.sha256))?;
    Ok(Some(input))
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

async fn open(
    connection: &mut dyn Connection,
    new: &NewUpload,
    bounds: &UploadBounds,
    now: SystemTime,
) -> Result<BegunUpload, Error> {
    if let Some(oversize) = bounds.never_takes(new.bytes) {
        return Err(Error::UploadTooLarge(oversize));
    }
    // All of it in bytes as they were sent, which callers know and are shown. Of what was given up counts what has not
    // been removed yet, and of what was deleted, what jobs still have: it lies on the disk all the same, and could else
    // be uploaded and deleted again and again.
    let taken = Statement::new(
        "SELECT COUNT(upload) AS open, \
         CAST(COALESCE(SUM(CASE WHEN upload IS NULL THEN committed ELSE bytes END), 0) AS BIGINT) AS bytes, \
         (SELECT CAST(COALESCE(SUM(upload_bytes), 0) AS BIGINT) FROM inputs \
         WHERE tenant = $1 AND upload_bytes IS NOT NULL) AS kept \
         FROM uploads WHERE tenant = $1 AND input_id IS NULL",
    );
    let row = connection.row(taken.bind(&new.name.tenant)).await?;
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
    connection.execute(insert).await?;
    let lease = UploadLease { name: new.name.clone(), writer: 1 };
    Ok(BegunUpload::Open { lease, committed: 0, sha256: new.sha256 })
}

/// Adds bytes at the end.
pub(super) async fn append(
    connection: &mut dyn Connection,
    lease: &UploadLease,
    at_byte: u64,
    data: &[u8],
    now: SystemTime,
) -> Result<(), Error> {
    let upload = held(connection, lease).await?;
    let end = at_byte.saturating_add(data.len() as u64);
    if upload.committed != at_byte || end > upload.bytes {
        // A write of this stream that was given up for lost has arrived after all: whoever goes on asks where.
        return Err(Error::UploadTakenOver(lease.name.clone()));
    }
    let mut at = at_byte;
    for part in data.chunks(payload::CHUNK_BYTES) {
        let insert = Statement::new("INSERT INTO upload_parts (upload_id, at_byte, data) VALUES ($1, $2, $3)");
        connection.execute(insert.bind(upload.id).bind(integer(at)).bind(part)).await?;
        at += part.len() as u64;
    }
    let update = Statement::new("UPDATE uploads SET committed = $1, update_time = $2 WHERE id = $3");
    connection.execute(update.bind(integer(end)).bind(micros(now)).bind(upload.id)).await
}

/// Some of the bytes from there on; none at the end.
pub(super) async fn read(connection: &mut dyn Connection, lease: &UploadLease, at_byte: u64) -> Result<Vec<u8>, Error> {
    let upload = match find(connection, &lease.name, false).await? {
        Some(upload) if upload.writer == lease.writer && upload.input_id.is_none() => upload,
        _ => return Err(Error::UploadTakenOver(lease.name.clone())),
    };
    let select = Statement::new(
        "SELECT data FROM upload_parts WHERE upload_id = $1 AND at_byte >= $2 ORDER BY at_byte LIMIT $3",
    );
    let rows = connection.rows(select.bind(upload.id).bind(integer(at_byte)).bind(READ_PARTS)).await?;
    jobs::joined(&rows)
}

/// Makes an input of an upload whose bytes are all there.
pub(super) async fn finish(
    connection: &mut dyn Connection,
    lease: &UploadLease,
    new: &NewInput,
    now: SystemTime,
) -> Result<StoredInput, Error> {
    let upload = held(connection, lease).await?;
    if upload.committed != upload.bytes {
        return Err(Error::Corrupt(format!(
            "{} of {} bytes of an upload are no input",
            upload.committed, upload.bytes
        )));
    }
    let id = jobs::insert_input(connection, &lease.name.tenant, &new.payload, now).await?;
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
    input_by_id(connection, id).await
}

/// Gives an upload up: its id is free again, and its parts are removed by and by.
pub(super) async fn give_up(connection: &mut dyn Connection, lease: &UploadLease) -> Result<(), Error> {
    let upload = held(connection, lease).await?;
    let update = Statement::new("UPDATE uploads SET upload = NULL, leftover = TRUE, writer = writer + 1 WHERE id = $1");
    connection.execute(update.bind(upload.id)).await
}

/// How far an upload has come.
pub(super) async fn status(connection: &mut dyn Connection, name: &InputName) -> Result<UploadStatus, Error> {
    let found = find(connection, name, false).await?;
    let Some(upload) = found else { return Err(Error::UploadNotFound(name.clone())) };
    let input = match upload.input_id {
        Some(id) => Some(input_by_id(connection, id).await?),
        None => None,
    };
    Ok(UploadStatus { bytes: upload.bytes, committed: upload.committed, input })
}

/// An uploaded input.
pub(super) async fn input(connection: &mut dyn Connection, name: &InputName) -> Result<StoredInput, Error> {
    let select =
        Statement::new(select_inputs!("WHERE tenant = $1 AND input = $2")).bind(&name.tenant).bind(&name.input);
    let row = connection.optional_row(select).await?;
    row.as_ref().map_or_else(|| Err(Error::InputNotFound(name.clone())), stored_input)
}

/// One page of a tenant's uploaded inputs, the newest first.
pub(super) async fn list(connection: &mut dyn Connection, query: &InputQuery) -> Result<Page<StoredInput>, Error> {
    let mut select = Statement::new(select_inputs!("WHERE input IS NOT NULL AND tenant = ")).then_bind(&query.tenant);
    if let Some(cursor) = query.cursor()? {
        select = select.then(" AND (create_time, input) < (").then_bind(cursor.create_micros);
        select = select.then(", ").then_bind(&cursor.id).then(")");
    }
    let select = select.then(" ORDER BY create_time DESC, input DESC");
    rows::page(connection, query, select, "input", stored_input).await
}

/// Takes an uploaded input's name away; see `Store::delete_input`.
pub(super) async fn delete(connection: &mut dyn Connection, name: &InputName) -> Result<(), Error> {
    let select = Statement::new("SELECT id FROM inputs WHERE tenant = $1 AND input = $2")
        .bind(&name.tenant)
        .bind(&name.input)
        .then(connection.for_update());
    let row = connection.optional_row(select).await?;
    let id = row.ok_or_else(|| Error::InputNotFound(name.clone()))?.integer("id")?;
    // Those of its upload's parts that are left are removed by and by, as of one that was given up.
    let uploads = [
        "DELETE FROM uploads WHERE input_id = $1 AND NOT leftover",
        "UPDATE uploads SET upload = NULL, input_id = NULL WHERE input_id = $1",
        "UPDATE inputs SET input = NULL WHERE id = $1",
    ];
    connection.batch(uploads.map(|statement| Statement::new(statement).bind(id)).into()).await?;
    remove_orphan(connection, id).await
}

/// Removes an input that has no name, once no job has it.
pub(super) async fn remove_orphan(connection: &mut dyn Connection, id: i64) -> Result<(), Error> {
    // Of two that take away the last uses of it at once, the later one waits, and then sees that the other is gone:
    // what it asks of the row, it asks after the wait.
    let lock = Statement::new("SELECT id FROM inputs WHERE id = $1").bind(id).then(connection.for_update());
    connection.execute(lock).await?;
    let delete = Statement::new(
        "DELETE FROM inputs WHERE id = $1 AND input IS NULL \
         AND NOT EXISTS (SELECT 1 FROM jobs WHERE jobs.input_id = $1)",
    );
    connection.execute(delete.bind(id)).await
}

async fn input_by_id(connection: &mut dyn Connection, id: i64) -> Result<StoredInput, Error> {
    stored_input(&connection.row(Statement::new(select_inputs!("WHERE id = $1")).bind(id)).await?)
}

fn stored_input(row: &Row) -> Result<StoredInput, Error> {
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

/// Locks the rows of these inputs, in one order whoever asks for them; those that are not there are passed over.
pub(super) async fn lock(connection: &mut dyn Connection, names: &BTreeSet<InputName>) -> Result<(), Error> {
    for name in names {
        let select = Statement::new("SELECT id FROM inputs WHERE tenant = $1 AND input = $2")
            .bind(&name.tenant)
            .bind(&name.input)
            .then(connection.for_update());
        connection.execute(select).await?;
    }
    Ok(())
}

/// The row of an uploaded input that a job is about to have; it stays until the transaction ends.
pub(super) async fn use_input(
    connection: &mut dyn Connection,
    name: &InputName,
    now: SystemTime,
) -> Result<i64, Error> {
    let update = Statement::new("UPDATE inputs SET use_time = $1 WHERE tenant = $2 AND input = $3 RETURNING id")
        .bind(micros(now))
        .bind(&name.tenant)
        .bind(&name.input);
    let row = connection.optional_row(update).await?;
    row.ok_or_else(|| Error::InputNotFound(name.clone()))?.integer("id")
}

/// Whether [`purge`] would find anything.
pub(super) async fn needs_purge(
    connection: &mut dyn Connection,
    abandoned_by: Option<SystemTime>,
    unused_since: Option<SystemTime>,
) -> Result<bool, Error> {
    let select = Statement::new(
        "SELECT (EXISTS (SELECT 1 FROM uploads WHERE input_id IS NULL AND upload IS NOT NULL AND update_time <= $1) \
         OR EXISTS (SELECT 1 FROM uploads WHERE leftover) \
         OR EXISTS (SELECT 1 FROM inputs WHERE input IS NOT NULL AND use_time <= $2 \
         AND NOT EXISTS (SELECT 1 FROM jobs WHERE jobs.input_id = inputs.id))) AS found",
    );
    let never = i64::MIN;
    let select = select.bind(abandoned_by.map_or(never, micros)).bind(unused_since.map_or(never, micros));
    connection.row(select).await?.flag("found")
}

/// Gives up what nobody goes on with, and removes some of what is of no use any more.
pub(super) async fn purge(
    connection: &mut dyn Connection,
    abandoned_by: Option<SystemTime>,
    unused_since: Option<SystemTime>,
) -> Result<PurgedUploads, Error> {
    let mut purged = PurgedUploads::default();
    if let Some(time) = abandoned_by {
        let update = Statement::new(
            "UPDATE uploads SET upload = NULL, leftover = TRUE, writer = writer + 1 \
             WHERE input_id IS NULL AND upload IS NOT NULL AND update_time <= $1 RETURNING id",
        );
        purged.abandoned = u32::try_from(connection.rows(update.bind(micros(time))).await?.len()).unwrap_or(u32::MAX);
    }
    purge_parts(connection).await?;
    if let Some(time) = unused_since {
        let select = Statement::new(
            "SELECT id FROM inputs WHERE input IS NOT NULL AND use_time <= $1 \
             AND NOT EXISTS (SELECT 1 FROM jobs WHERE jobs.input_id = inputs.id) ORDER BY use_time, id LIMIT $2",
        );
        for row in connection.rows(select.bind(micros(time)).bind(PURGE_INPUTS).then(connection.skip_locked())).await? {
            let delete = Statement::new("DELETE FROM inputs WHERE id = $1").bind(row.integer("id")?);
            connection.execute(delete).await?;
            purged.inputs += 1;
        }
    }
    Ok(purged)
}

/// Removes some parts of one upload that has no more use for them, and its row with the last of a given up one.
async fn purge_parts(connection: &mut dyn Connection) -> Result<(), Error> {
    let select = Statement::new("SELECT id, upload FROM uploads WHERE leftover ORDER BY id LIMIT 1");
    let Some(row) = connection.optional_row(select.then(connection.skip_locked())).await? else { return Ok(()) };
    let (id, given_up) = (row.integer("id")?, row.optional_text("upload")?.is_none());
    let delete = Statement::new(
        "DELETE FROM upload_parts WHERE upload_id = $1 AND at_byte IN \
         (SELECT at_byte FROM upload_parts WHERE upload_id = $1 ORDER BY at_byte LIMIT $2) RETURNING at_byte",
    );
    let removed = connection.rows(delete.bind(id).bind(PURGE_PARTS)).await?.len();
    if removed == PURGE_PARTS as usize {
        return Ok(());
    }
    let end = match given_up {
        true => "DELETE FROM uploads WHERE id = $1",
        false => "UPDATE uploads SET leftover = FALSE WHERE id = $1",
    };
    connection.execute(Statement::new(end).bind(id)).await
}
