//! Creating, reading and listing jobs.

use std::time::SystemTime;

use sqlx::{QueryBuilder, Row, Sqlite, SqliteConnection};

use super::rows::{self, append, integer, micros, select_jobs, unsigned};
use crate::domain::job::{EventBody, Job, JobEvent, JobName, JobState};
use crate::store::query::Cursor;
use crate::store::record::{Created, Load, NewRecord, QueueBounds, Request};
use crate::store::{Error, JobPage, JobQuery, Order, payload};

/// Stores a job; see [`crate::store::Store::create_job`].
pub(super) async fn create(
    connection: &mut SqliteConnection,
    new: &NewRecord,
    bounds: &QueueBounds,
    now: SystemTime,
) -> Result<Created, Error> {
    if let Some(request) = &new.request
        && let Some(job) = earlier(connection, &new.name.tenant, request).await?
    {
        return Ok(Created { job, new: false });
    }
    let taken: bool = sqlx::query_scalar("SELECT EXISTS (SELECT 1 FROM jobs WHERE tenant = ? AND job = ?)")
        .bind(&new.name.tenant)
        .bind(&new.name.job)
        .fetch_one(&mut *connection)
        .await?;
    if taken {
        return Err(Error::AlreadyExists(format!("{} already exists", new.name)));
    }
    let load = load(connection).await?;
    if let Some(bound) = bounds.refuses(&load, new.input.len() as u64, u64::from(new.observation_count)) {
        return Err(Error::QueueFull(bound));
    }
    let input_id = insert_input(connection, &new.name.tenant, &new.input, now).await?;
    let id = insert_job(connection, new, input_id, now).await?;
    if let Some(request) = &new.request {
        sqlx::query("INSERT INTO request_ids (tenant, request_id, digest, job_id, create_time) VALUES (?, ?, ?, ?, ?)")
            .bind(&new.name.tenant)
            .bind(&request.id)
            .bind(request.digest.as_slice())
            .bind(id)
            .bind(micros(now))
            .execute(&mut *connection)
            .await?;
    }
    append(connection, id, 0, &EventBody::State { state: JobState::Queued, failure: None }, now).await?;
    Ok(Created { job: get(connection, &new.name).await?, new: true })
}

/// The job that this request id made before.
async fn earlier(connection: &mut SqliteConnection, tenant: &str, request: &Request) -> Result<Option<Job>, Error> {
    let known = sqlx::query("SELECT digest, job_id FROM request_ids WHERE tenant = ? AND request_id = ?")
        .bind(tenant)
        .bind(&request.id)
        .fetch_optional(&mut *connection)
        .await?;
    let Some(known) = known else { return Ok(None) };
    if known.try_get::<Vec<u8>, _>("digest")? != request.digest {
        return Err(Error::AlreadyExists(format!(
            "request id {:?} was used before with another body; a new request needs a new id",
            request.id
        )));
    }
    let row = sqlx::query(select_jobs!("WHERE id = ?"))
        .bind(known.try_get::<i64, _>("job_id")?)
        .fetch_one(connection)
        .await?;
    rows::job(&row).map(Some)
}

async fn insert_input(
    connection: &mut SqliteConnection,
    tenant: &str,
    bytes: &[u8],
    now: SystemTime,
) -> Result<i64, Error> {
    let id: i64 = sqlx::query_scalar("INSERT INTO inputs (tenant, bytes, create_time) VALUES (?, ?, ?) RETURNING id")
        .bind(tenant)
        .bind(integer(bytes.len() as u64))
        .bind(micros(now))
        .fetch_one(&mut *connection)
        .await?;
    for (chunk, data) in (0_i64..).zip(bytes.chunks(payload::CHUNK_BYTES)) {
        sqlx::query("INSERT INTO input_chunks (input_id, chunk, data) VALUES (?, ?, ?)")
            .bind(id)
            .bind(chunk)
            .bind(data.to_vec())
            .execute(&mut *connection)
            .await?;
    }
    Ok(id)
}

async fn insert_job(
    connection: &mut SqliteConnection,
    new: &NewRecord,
    input_id: i64,
    now: SystemTime,
) -> Result<i64, Error> {
    let id: i64 = sqlx::query_scalar(
        "INSERT INTO jobs (tenant, job, state, priority, create_time, queue_time, deadline, input_id, input_bytes, view_count, \
         track_count, observation_count, settings, labels, trace_parent) \
         VALUES (?, ?, 'QUEUED', ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?) RETURNING id",
    )
    .bind(&new.name.tenant)
    .bind(&new.name.job)
    .bind(new.priority)
    .bind(micros(now))
    .bind(micros(now))
    .bind(new.deadline.map(micros))
    .bind(input_id)
    .bind(integer(new.input.len() as u64))
    .bind(new.view_count)
    .bind(new.track_count)
    .bind(new.observation_count)
    .bind(payload::encode(&new.settings)?)
    .bind(payload::encode(&new.labels)?)
    .bind(&new.trace_parent)
    .fetch_one(&mut *connection)
    .await?;
    for (key, value) in &new.labels {
        sqlx::query("INSERT INTO job_labels (job_id, key, value) VALUES (?, ?, ?)")
            .bind(id)
            .bind(key)
            .bind(value)
            .execute(&mut *connection)
            .await?;
    }
    Ok(id)
}

/// One job by its name.
pub(super) async fn get(connection: &mut SqliteConnection, name: &JobName) -> Result<Job, Error> {
    let row = sqlx::query(select_jobs!("WHERE tenant = ? AND job = ?"))
        .bind(&name.tenant)
        .bind(&name.job)
        .fetch_optional(connection)
        .await?;
    row.as_ref().map_or_else(|| Err(Error::NotFound(name.clone())), rows::job)
}

/// One page of a listing.
pub(super) async fn list(connection: &mut SqliteConnection, query: &JobQuery) -> Result<JobPage, Error> {
    let cursor = query.cursor()?;
    let size = query.effective_page_size();
    let mut sql = QueryBuilder::<Sqlite>::new(select_jobs!("WHERE tenant = "));
    sql.push_bind(&query.tenant);
    if !query.states.is_empty() {
        sql.push(" AND state IN (");
        let mut states = sql.separated(", ");
        for state in &query.states {
            states.push_bind(state.name());
        }
        sql.push(")");
    }
    for (key, value) in &query.labels {
        sql.push(" AND EXISTS (SELECT 1 FROM job_labels WHERE job_id = jobs.id AND key = ").push_bind(key);
        sql.push(" AND value = ").push_bind(value).push(")");
    }
    let (beyond, direction) = match query.order {
        Order::CreateTimeDescending => ("<", "DESC"),
        Order::CreateTimeAscending => (">", "ASC"),
    };
    if let Some(cursor) = cursor {
        sql.push(" AND (create_time, id) ").push(beyond).push(" (").push_bind(cursor.create_micros);
        sql.push(", ").push_bind(cursor.id).push(")");
    }
    sql.push(" ORDER BY create_time ").push(direction).push(", id ").push(direction);
    // One more than asked for tells whether there is a next page.
    sql.push(" LIMIT ").push_bind(i64::from(size) + 1);
    let mut rows = sql.build().fetch_all(connection).await?;
    let more = rows.len() > size as usize;
    rows.truncate(size as usize);
    let next_page_token = match rows.last() {
        Some(last) if more => {
            let cursor = Cursor { create_micros: last.try_get("create_time")?, id: last.try_get("id")? };
            Some(query.token_after(cursor))
        }
        _ => None,
    };
    Ok(JobPage { jobs: rows.iter().map(rows::job).collect::<Result<_, _>>()?, next_page_token })
}

/// The row of a job.
async fn id(connection: &mut SqliteConnection, name: &JobName) -> Result<i64, Error> {
    let id: Option<i64> = sqlx::query_scalar("SELECT id FROM jobs WHERE tenant = ? AND job = ?")
        .bind(&name.tenant)
        .bind(&name.job)
        .fetch_optional(connection)
        .await?;
    id.ok_or_else(|| Error::NotFound(name.clone()))
}

/// Events of a job with a sequence number above `after`.
pub(super) async fn events_after(
    connection: &mut SqliteConnection,
    name: &JobName,
    after: u64,
    limit: u32,
) -> Result<Vec<JobEvent>, Error> {
    let id = id(connection, name).await?;
    let rows = sqlx::query(
        "SELECT sequence, attempt, time, body FROM events WHERE job_id = ? AND sequence > ? ORDER BY sequence LIMIT ?",
    )
    .bind(id)
    .bind(integer(after))
    .bind(limit)
    .fetch_all(connection)
    .await?;
    rows.iter()
        .map(|row| {
            Ok(JobEvent {
                name: name.clone(),
                attempt: unsigned(row, "attempt")?,
                sequence: Some(unsigned(row, "sequence")?),
                time: rows::time(row.try_get("time")?),
                body: payload::decode(&row.try_get::<Vec<u8>, _>("body")?, "an event")?,
            })
        })
        .collect()
}

/// The encoded input of a job.
pub(super) async fn input(connection: &mut SqliteConnection, name: &JobName) -> Result<Vec<u8>, Error> {
    let id = id(connection, name).await?;
    let chunks = sqlx::query_scalar(
        "SELECT data FROM input_chunks WHERE input_id = (SELECT input_id FROM jobs WHERE id = ?) ORDER BY chunk",
    )
    .bind(id)
    .fetch_all(connection)
    .await?;
    Ok(joined(chunks))
}

/// The encoded result of a job, if it has one.
pub(super) async fn result(connection: &mut SqliteConnection, name: &JobName) -> Result<Option<Vec<u8>>, Error> {
    let id = id(connection, name).await?;
    let chunks: Vec<Vec<u8>> = sqlx::query_scalar("SELECT data FROM result_chunks WHERE job_id = ? ORDER BY chunk")
        .bind(id)
        .fetch_all(connection)
        .await?;
    Ok((!chunks.is_empty()).then(|| joined(chunks)))
}

fn joined(chunks: Vec<Vec<u8>>) -> Vec<u8> {
    chunks.concat()
}

/// What waits and what runs.
pub(super) async fn load(connection: &mut SqliteConnection) -> Result<Load, Error> {
    let row = sqlx::query(
        "SELECT COUNT(*) AS queued, COALESCE(SUM(input_bytes), 0) AS bytes, \
         COALESCE(SUM(observation_count), 0) AS observations, \
         (SELECT COUNT(*) FROM jobs WHERE state = 'RUNNING') AS running FROM jobs WHERE state = 'QUEUED'",
    )
    .fetch_one(connection)
    .await?;
    Ok(Load {
        queued: unsigned(&row, "queued")?,
        queued_bytes: unsigned(&row, "bytes")?,
        queued_observations: unsigned(&row, "observations")?,
        running: unsigned(&row, "running")?,
    })
}
