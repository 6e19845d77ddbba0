//! Removing ended jobs: one that its owner names, or those that have been kept long enough.

use std::time::SystemTime;

use super::Size::{Payload, Small};
use super::WriteIntent::Ends;
use super::operation::{ANY_BYTES, bounded, measured, writes};
use super::rows::micros;
use super::{Connection, Database, Statement};
use crate::domain::job::JobName;
use crate::store::Error;
use crate::telemetry::metrics::store_operation;

impl dyn Database {
    /// Removes an ended job with its events, attempts, input, result, request ids and webhook. With an `etag`, only
    /// where it is the job's.
    ///
    /// # Errors
    /// [`Error::NotFound`], [`Error::EtagMismatch`], [`Error::NotEnded`].
    pub async fn delete_job(&self, name: &JobName, etag: Option<&str>) -> Result<(), Error> {
        let etag = etag.map(str::to_owned);
        writes!(self, "delete_job", Payload, Ends(ANY_BYTES), [name, etag], |connection| {
            let job = connection.locked_job(&name, etag.as_deref()).await?;
            if !job.state.is_terminal() {
                return Err(Error::NotEnded(name, job.state));
            }
            connection.remove_job(job.id).await
        })
    }

    /// Removes at most `limit` of the jobs that ended at that time or before, the oldest first. Returns how many.
    pub async fn purge(&self, ended_by: SystemTime, limit: u32) -> Result<u32, Error> {
        let _timer = store_operation("purge");
        let select = "SELECT EXISTS (SELECT 1 FROM jobs WHERE end_time IS NOT NULL AND end_time <= $1) AS found";
        if !self.finds(Statement::new(select).bind(micros(ended_by))).await? {
            return Ok(0);
        }
        writes!(self, Payload, Ends(ANY_BYTES), [], |connection| {
            let select = Statement::new(
                "SELECT id FROM jobs WHERE end_time IS NOT NULL AND end_time <= $1 ORDER BY end_time, id LIMIT $2",
            )
            .bind(micros(ended_by))
            .bind(limit)
            .then(connection.skip_locked());
            let mut removed = 0;
            for row in connection.rows(select).await? {
                connection.remove_job(row.integer("id")?).await?;
                removed += 1;
            }
            Ok(removed)
        })
    }

    /// Gives some of the space that removed jobs took back to the file system, where the database does not do so by
    /// itself.
    pub async fn reclaim(&self) -> Result<(), Error> {
        measured("reclaim", bounded(self, Small, self.vacuum())).await
    }
}

impl dyn Connection + '_ {
    /// Removes a job's row, and with it events, attempts, labels, result, request ids and webhook; and its input,
    /// unless that was uploaded by itself.
    async fn remove_job(&mut self, id: i64) -> Result<(), Error> {
        let delete = Statement::new("DELETE FROM jobs WHERE id = $1 RETURNING input_id").bind(id);
        let input = self.row(delete).await?.integer("input_id")?;
        self.remove_orphan_input(input).await
    }
}
