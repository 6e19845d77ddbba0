//! Removing ended jobs: one that its owner names, or those that have been kept long enough.

use std::time::SystemTime;

use super::rows::{locked_job, micros};
use super::{Connection, Statement, jobs, uploads};
use crate::domain::job::JobName;
use crate::store::Error;

/// Removes an ended job; see `Store::delete_job`.
pub(super) async fn delete(connection: &mut dyn Connection, name: &JobName, etag: Option<&str>) -> Result<(), Error> {
    let job = locked_job(connection, name).await?;
    check_etag(connection, name, etag).await?;
    if !job.state.is_terminal() {
        return Err(Error::NotEnded(name.clone(), job.state));
    }
    remove(connection, job.id).await
}

/// Refuses where the caller saw the job in another shape. To be called when the job's row is locked.
pub(super) async fn check_etag(
    connection: &mut dyn Connection,
    name: &JobName,
    etag: Option<&str>,
) -> Result<(), Error> {
    match etag {
        Some(etag) if jobs::get(connection, name).await?.etag() != etag => Err(Error::EtagMismatch(name.clone())),
        _ => Ok(()),
    }
}

/// Whether any job ended at that time or before.
pub(super) async fn needs_purge(connection: &mut dyn Connection, ended_by: SystemTime) -> Result<bool, Error> {
    let select = "SELECT EXISTS (SELECT 1 FROM jobs WHERE end_time IS NOT NULL AND end_time <= $1) AS found";
    connection.row(Statement::new(select).bind(micros(ended_by))).await?.flag("found")
}

/// Removes at most `limit` jobs that ended at that time or before, the oldest first.
pub(super) async fn purge(connection: &mut dyn Connection, ended_by: SystemTime, limit: u32) -> Result<u32, Error> {
    let select = Statement::new(
        "SELECT id FROM jobs WHERE end_time IS NOT NULL AND end_time <= $1 ORDER BY end_time, id LIMIT $2",
    )
    .bind(micros(ended_by))
    .bind(limit)
    .then(connection.skip_locked());
    let mut removed = 0;
    for row in connection.rows(select).await? {
        remove(connection, row.integer("id")?).await?;
        removed += 1;
    }
    Ok(removed)
}

/// Removes a job's row, and with it events, attempts, labels, result, request ids and webhook; and its input, unless
/// that was uploaded by itself.
async fn remove(connection: &mut dyn Connection, id: i64) -> Result<(), Error> {
    let delete = Statement::new("DELETE FROM jobs WHERE id = $1 RETURNING input_id").bind(id);
    let input = connection.row(delete).await?.integer("input_id")?;
    uploads::remove_orphan(connection, input).await
}
