//! Reading, listing and counting jobs.

use std::time::SystemTime;

use super::Size::{Page, Small};
use super::WriteIntent::Ends;
use super::operation::{bounded, reads, writes};
use super::rows::{self, integer, micros, number, returning_job, select_jobs};
use super::{Connection, Database, Row, Size, Statement};
use crate::domain::job::{Job, JobEvent, JobName};
use crate::store::query::Paged;
use crate::store::record::{EncodedResult, JobPayload, QueueStats, StoreStats, TenantQueue};
use crate::store::{self, Error, JobQuery, Order, payload};
use crate::telemetry::metrics::store_operation;

impl dyn Database {
    /// # Errors
    /// [`Error::NotFound`].
    pub async fn job(&self, name: &JobName) -> Result<Job, Error> {
        reads!(self, "job", Small, |connection| connection.job(name).await)
    }

    /// One page of a tenant's jobs.
    ///
    /// # Errors
    /// [`Error::PageToken`].
    pub async fn jobs(&self, query: &JobQuery) -> Result<store::Page<Job>, Error> {
        reads!(self, "jobs", Page, |connection| {
            let cursor = query.cursor()?;
            let mut select = Statement::new(select_jobs!("WHERE tenant = ")).then_bind(&query.tenant);
            for (number, state) in query.states.iter().enumerate() {
                select = select.then(if number == 0 { " AND state IN (" } else { ", " }).then_bind(state.name());
            }
            if !query.states.is_empty() {
                select = select.then(")");
            }
            for (key, value) in &query.labels {
                let has_key = " AND EXISTS (SELECT 1 FROM job_labels WHERE job_id = jobs.id AND key = ";
                select = select.then(has_key).then_bind(key).then(" AND value = ").then_bind(value).then(")");
            }
            let (beyond, order) = match query.order {
                Order::CreateTimeDescending => (" AND (create_time, job) < (", " ORDER BY create_time DESC, job DESC"),
                Order::CreateTimeAscending => (" AND (create_time, job) > (", " ORDER BY create_time, job"),
            };
            if let Some(cursor) = cursor {
                select = select.then(beyond).then_bind(cursor.create_micros).then(", ").then_bind(&cursor.id).then(")");
            }
            connection.page(query, select.then(order), "job", rows::job).await
        })
    }

    /// At most `limit` events with a sequence number above `after`, in order.
    ///
    /// # Errors
    /// [`Error::NotFound`].
    pub async fn events_after(&self, name: &JobName, after: u64, limit: u32) -> Result<Vec<JobEvent>, Error> {
        reads!(self, "events_after", Small, |connection| {
            let select = Statement::new(
                "SELECT sequence, attempt, time, body FROM events \
                 WHERE job_id = (SELECT id FROM jobs WHERE tenant = $1 AND job = $2) AND sequence > $3 \
                 ORDER BY sequence LIMIT $4",
            )
            .bind(&name.tenant)
            .bind(&name.job)
            .bind(integer(after))
            .bind(limit);
            let event = |row: &Row| {
                Ok(JobEvent {
                    job: name.clone(),
                    attempt: number(row, "attempt")?,
                    sequence: Some(number(row, "sequence")?),
                    time: rows::time(row.integer("time")?),
                    body: payload::decode(row.bytes("body")?, "an event")?,
                })
            };
            let rows = connection.rows(select).await?;
            if rows.is_empty() {
                // None yet, or of a job that is not there: an error then.
                let select = Statement::new("SELECT id FROM jobs WHERE tenant = $1 AND job = $2");
                let row = connection.optional_row(select.bind(&name.tenant).bind(&name.job)).await?;
                row.ok_or_else(|| Error::NotFound(name.clone()))?;
            }
            rows.iter().map(event).collect()
        })
    }

    /// The encoded input of a job of so many observations, and whether its cancel has been asked for.
    ///
    /// # Errors
    /// [`Error::NotFound`].
    pub async fn job_payload(&self, name: &JobName, observations: u32) -> Result<JobPayload, Error> {
        reads!(self, "work", Size::of_payload(observations), |connection| {
            let select = Statement::new(
                "SELECT data, cancel_requested FROM jobs JOIN input_chunks ON input_chunks.input_id = jobs.input_id \
                 WHERE tenant = $1 AND job = $2 ORDER BY chunk",
            );
            let chunks = connection.rows(select.bind(&name.tenant).bind(&name.job)).await?;
            // An encoded input has a byte at least, and so a chunk.
            let first = chunks.first().ok_or_else(|| Error::NotFound(name.clone()))?;
            Ok(JobPayload { cancel_requested: first.flag("cancel_requested")?, input: joined(&chunks)? })
        })
    }

    /// The encoded result of a job of so many observations; `None` where there is none. Whether it is intact is for the
    /// caller to ask: it takes long.
    ///
    /// # Errors
    /// [`Error::NotFound`].
    pub async fn result(&self, name: &JobName, observations: u32) -> Result<Option<EncodedResult>, Error> {
        reads!(self, "result", Size::of_payload(observations), |connection| {
            // In one look: between two the job may be deleted.
            let select = Statement::new(
                "SELECT result_sha256, data FROM jobs LEFT JOIN result_chunks ON result_chunks.job_id = jobs.id \
                 WHERE tenant = $1 AND job = $2 ORDER BY chunk",
            );
            let chunks = connection.rows(select.bind(&name.tenant).bind(&name.job)).await?;
            let first = chunks.first().ok_or_else(|| Error::NotFound(name.clone()))?;
            let Some(sha256) = first.optional_bytes("result_sha256")? else { return Ok(None) };
            let sha256 =
                sha256.try_into().map_err(|_| Error::Corrupt(format!("the digest of the result of {name}")))?;
            Ok(Some(EncodedResult { bytes: joined(&chunks)?, sha256 }))
        })
    }

    /// Counts that a call was disconnected that had attached to the job, unless it no longer depends on its calls or is
    /// another one of the same name, which was not `created` then. Returns the job as it stands then.
    ///
    /// # Errors
    /// [`Error::NotFound`].
    pub async fn detach(&self, name: &JobName, created: SystemTime) -> Result<Job, Error> {
        writes!(self, "detach", Small, Ends(0), [name], |connection| {
            let update = Statement::new(returning_job!(
                "UPDATE jobs SET detached_calls = detached_calls + 1 \
                 WHERE tenant = $1 AND job = $2 AND create_time = $3 AND attached_calls > detached_calls"
            ));
            let update = update.bind(&name.tenant).bind(&name.job).bind(micros(created));
            match connection.optional_row(update).await? {
                Some(row) => rows::job(&row),
                None => connection.job(&name).await,
            }
        })
    }

    /// What waits in the queue.
    pub async fn queue_stats(&self) -> Result<QueueStats, Error> {
        reads!(self, "load", Page, |connection| connection.queue_stats(None).await)
    }

    /// What operators watch.
    pub async fn stats(&self) -> Result<StoreStats, Error> {
        let _timer = store_operation("stats");
        let (tenants, oldest_queue_time) = reads!(self, Page, |connection| {
            let select = Statement::new(
                "SELECT tenant, COUNT(*) FILTER (WHERE state = 'QUEUED') AS queued, \
                 COUNT(*) FILTER (WHERE state = 'RUNNING') AS running, \
                 MIN(queue_time) FILTER (WHERE state = 'QUEUED') AS oldest \
                 FROM jobs WHERE state IN ('QUEUED', 'RUNNING') GROUP BY tenant",
            );
            let (mut tenants, mut oldest) = (Vec::new(), None::<SystemTime>);
            for row in connection.rows(select).await? {
                let (queued, running) = (number(&row, "queued")?, number(&row, "running")?);
                tenants.push(TenantQueue { tenant: row.text("tenant")?, queued, running });
                if let Some(time) = row.optional_integer("oldest")?.map(rows::time) {
                    oldest = Some(oldest.map_or(time, |oldest| oldest.min(time)));
                }
            }
            Ok((tenants, oldest))
        })?;
        let bytes = bounded(self, Small, self.bytes()).await?;
        Ok(StoreStats { bytes, oldest_queue_time, tenants })
    }
}

impl dyn Connection + '_ {
    /// One job by its name.
    pub(super) async fn job(&mut self, name: &JobName) -> Result<Job, Error> {
        let select = Statement::new(select_jobs!("WHERE tenant = $1 AND job = $2")).bind(&name.tenant).bind(&name.job);
        let row = self.optional_row(select).await?;
        row.as_ref().map_or_else(|| Err(Error::NotFound(name.clone())), rows::job)
    }

    /// What waits in the queue, of one tenant where it is named.
    pub(super) async fn queue_stats(&mut self, tenant: Option<&str>) -> Result<QueueStats, Error> {
        // Sums of 64-bit numbers have a wider type of their own in PostgreSQL.
        let mut select = Statement::new(
            "SELECT COUNT(*) AS queued, CAST(COALESCE(SUM(input_bytes), 0) AS BIGINT) AS bytes, \
             CAST(COALESCE(SUM(observation_count), 0) AS BIGINT) AS observations, \
             (SELECT pause_time IS NOT NULL FROM queue) AS paused FROM jobs WHERE state = 'QUEUED'",
        );
        if let Some(tenant) = tenant {
            select = select.then(" AND tenant = ").then_bind(tenant);
        }
        let row = self.row(select).await?;
        Ok(QueueStats {
            queued: number(&row, "queued")?,
            queued_bytes: number(&row, "bytes")?,
            queued_observations: number(&row, "observations")?,
            paused: row.flag("paused")?,
        })
    }
}

pub(super) fn joined(chunks: &[Row]) -> Result<Vec<u8>, Error> {
    let mut whole = Vec::new();
    for chunk in chunks {
        whole.extend(chunk.bytes("data")?);
    }
    Ok(whole)
}
