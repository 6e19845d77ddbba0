//! Creating, reading and listing jobs.

use std::collections::{BTreeSet, HashMap, HashSet};
use std::time::SystemTime;

use super::rows::{self, integer, micros, number, returning_job, select_jobs};
use super::{Connection, Lock, Row, Statement, fairness, uploads, webhooks};
use crate::domain::job::{EventBody, Job, JobEvent, JobName, JobState};
use crate::domain::{InputName, Webhook};
use crate::store::query::Paged;
use crate::store::record::{
    ChangeReply, EncodedResult, JobInput, JobPayload, NewRecord, QueueStats, Request, TenantQueue,
};
use crate::store::{Error, JobQuery, Notification, Order, Page, QueueBounds, TakenId, payload};

/// Number of a job's first event, which its row counts.
const FIRST_EVENT: u64 = 1;

/// Stores jobs, all or none; see `Store::create_jobs`.
pub(super) async fn create(
    connection: &mut dyn Connection,
    news: &[NewRecord],
    bounds: &QueueBounds,
    now: SystemTime,
) -> Result<Vec<ChangeReply>, Error> {
    check_size(connection, news, bounds).await?;
    let mut stats = AdmissionStats::default();
    let mut inputs = vec![None; news.len()];
    if !connection.writes_alone() {
        // Before anything else, and each name once: two batches of the same inputs in other orders would wait for each
        // other.
        uploads::lock(connection, &news.iter().filter_map(uploaded).collect()).await?;
        for (new, input) in news.iter().zip(&mut inputs) {
            // Payloads take long: nobody else's admission waits for them.
            let admitted = admit(connection, new, bounds, &mut stats).await;
            if admitted.map_err(|error| of_batch(error, &[], news))?.is_none() {
                *input = Some(input_of(connection, new, now).await?);
            }
        }
        connection.take_lock(Lock::Admission).await?;
        // Looked over again below: others may have come in between.
        stats = AdmissionStats::default();
    }
    let (mut created, mut stored) = (Vec::new(), Vec::new());
    for (place, (new, input)) in news.iter().zip(inputs).enumerate() {
        let admitted = admit(connection, new, bounds, &mut stats).await;
        match admitted.map_err(|error| of_batch(error, &stored, &news[place..]))? {
            Some(job) => {
                if let Some(input) = input {
                    let delete = Statement::new("DELETE FROM inputs WHERE id = $1 AND input IS NULL");
                    connection.execute(delete.bind(input)).await?;
                }
                created.push(ChangeReply {
                    job: attach(connection, job, new.cancel_on_disconnect).await?,
                    by_this_call: false,
                });
            }
            None => {
                let input = match input {
                    Some(input) => input,
                    None => input_of(connection, new, now).await?,
                };
                created.push(ChangeReply { job: enqueue(connection, new, input, now).await?, by_this_call: true });
                stats.add(new);
                stored.push(new);
            }
        }
    }
    let fresh = created.iter().filter(|created| created.by_this_call).map(|created| created.job.name.tenant.as_str());
    for tenant in fresh.collect::<BTreeSet<_>>() {
        fairness::register(connection, tenant).await?;
    }
    Ok(created)
}

/// Counts the whole batch where one of its jobs was refused; see [`crate::store::Bound::of_batch`].
fn of_batch(error: Error, stored: &[&NewRecord], rest: &[NewRecord]) -> Error {
    match error {
        Error::QueueFull(bound) => Error::QueueFull(bound.of_batch(stored, rest)),
        other => other,
    }
}

/// Refuses jobs that are more by themselves than may ever wait: told to come back, their caller would do so for ever.
async fn check_size(connection: &mut dyn Connection, news: &[NewRecord], bounds: &QueueBounds) -> Result<(), Error> {
    if bounds.never_takes(&news.iter().collect::<Vec<_>>()).is_none() {
        return Ok(());
    }
    // Those that an earlier call has created are not created again, and one that comes twice is one.
    let (mut fresh, mut requests) = (Vec::new(), HashSet::new());
    for new in news {
        let known = match &new.request {
            Some(request) => {
                !requests.insert((&new.name.tenant, &request.id))
                    || earlier(connection, &new.name.tenant, request).await?.is_some()
            }
            None => false,
        };
        if !known {
            fresh.push(new);
        }
    }
    bounds.never_takes(&fresh).map_or(Ok(()), |oversize| Err(Error::BatchTooLarge(oversize)))
}

/// What waits, as admission needs it: summed up once a batch, since a sum goes through the whole queue.
#[derive(Default)]
pub(super) struct AdmissionStats {
    whole: Option<QueueStats>,
    tenants: HashMap<String, QueueStats>,
}

impl AdmissionStats {
    /// What waits of all tenants, and of this one where it has bounds of its own.
    pub(super) async fn look(
        &mut self,
        connection: &mut dyn Connection,
        tenant: &str,
        bounds: &QueueBounds,
    ) -> Result<(QueueStats, QueueStats), Error> {
        let whole = match self.whole {
            Some(whole) => whole,
            None => queue_stats(connection).await?,
        };
        self.whole = Some(whole);
        if !bounds.has_tenant_bounds() {
            return Ok((whole, QueueStats::default()));
        }
        if let Some(known) = self.tenants.get(tenant) {
            return Ok((whole, *known));
        }
        let of_tenant = tenant_queue_stats(connection, tenant).await?;
        self.tenants.insert(tenant.to_owned(), of_tenant);
        Ok((whole, of_tenant))
    }

    /// One more job is stored.
    fn add(&mut self, new: &NewRecord) {
        for stats in self.whole.iter_mut().chain(self.tenants.get_mut(&new.name.tenant)) {
            stats.add(new);
        }
    }
}

/// Stores a job that was admitted, its labels, its request id and its first event.
async fn enqueue(
    connection: &mut dyn Connection,
    new: &NewRecord,
    input_id: i64,
    now: SystemTime,
) -> Result<Job, Error> {
    let row = connection.row(insert_job(new, input_id, now)?).await?;
    let id = row.integer("id")?;
    for (key, value) in &new.labels {
        let insert = Statement::new("INSERT INTO job_labels (job_id, key, value) VALUES ($1, $2, $3)");
        connection.execute(insert.bind(id).bind(key).bind(value)).await?;
    }
    if let Some(request) = &new.request {
        let insert = Statement::new(
            "INSERT INTO request_ids (job_id, tenant, request_id, digest, create_time) VALUES ($1, $2, $3, $4, $5)",
        )
        .bind(id)
        .bind(&new.name.tenant)
        .bind(&request.id)
        .bind(request.digest.as_slice())
        .bind(micros(now));
        connection.execute(insert).await?;
    }
    let event = EventBody::State { state: JobState::Queued, failure: None };
    connection.execute(rows::insert_event(id, FIRST_EVENT, 0, &event, now)?).await?;
    let mut job = rows::job(&row)?;
    if let Some(url) = &new.webhook_url {
        let webhook = Webhook::pending(url);
        connection.execute(webhooks::insert(id, &webhook)?).await?;
        job.webhook = Some(webhook);
    }
    connection.notify(Notification::Events(new.name.clone())).await?;
    connection.notify(Notification::Queued).await?;
    Ok(job)
}

/// Whether a job may be stored: `Ok(None)`; or the job that the same request made before.
async fn admit(
    connection: &mut dyn Connection,
    new: &NewRecord,
    bounds: &QueueBounds,
    stats: &mut AdmissionStats,
) -> Result<Option<Job>, Error> {
    if let Some(request) = &new.request
        && let Some(job) = earlier(connection, &new.name.tenant, request).await?
    {
        return Ok(Some(job));
    }
    let taken = Statement::new("SELECT EXISTS (SELECT 1 FROM jobs WHERE tenant = $1 AND job = $2) AS taken")
        .bind(&new.name.tenant)
        .bind(&new.name.job);
    if connection.row(taken).await?.flag("taken")? {
        return Err(Error::AlreadyExists(TakenId::Job(new.name.clone())));
    }
    let (whole, tenant) = stats.look(connection, &new.name.tenant, bounds).await?;
    match bounds.refuses(&whole, &tenant, &QueueStats::of([new])) {
        Some(bound) => Err(Error::QueueFull(bound)),
        None => Ok(None),
    }
}

/// The job that this request id made before.
pub(super) async fn earlier(
    connection: &mut dyn Connection,
    tenant: &str,
    request: &Request,
) -> Result<Option<Job>, Error> {
    let select = Statement::new("SELECT digest, job_id FROM request_ids WHERE tenant = $1 AND request_id = $2")
        .bind(tenant)
        .bind(&request.id);
    let Some(known) = connection.optional_row(select).await? else { return Ok(None) };
    if known.bytes("digest")? != request.digest {
        return Err(Error::AlreadyExists(TakenId::Request(request.id.clone())));
    }
    let select = Statement::new(select_jobs!("WHERE id = $1")).bind(known.integer("job_id")?);
    // None where the job was deleted between the two looks: its request id is free again.
    connection.optional_row(select).await?.as_ref().map(rows::job).transpose()
}

/// What becomes of a job whose request came again: a call that is to cancel it on disconnect attaches, as far as the
/// job depends on its calls at all; after any other one it depends on none.
async fn attach(connection: &mut dyn Connection, job: Job, cancel_on_disconnect: bool) -> Result<Job, Error> {
    if job.attached_calls.is_none() || job.state.is_terminal() {
        return Ok(job);
    }
    let update = if cancel_on_disconnect {
        returning_job!("UPDATE jobs SET attached_calls = attached_calls + 1 WHERE tenant = $1 AND job = $2")
    } else {
        returning_job!("UPDATE jobs SET attached_calls = NULL, detached_calls = 0 WHERE tenant = $1 AND job = $2")
    };
    let row = connection.row(Statement::new(update).bind(&job.name.tenant).bind(&job.name.job)).await?;
    rows::job(&row)
}

/// One of the calls that a job depends on was disconnected; see `Store::detach`.
pub(super) async fn detach(connection: &mut dyn Connection, name: &JobName, created: SystemTime) -> Result<Job, Error> {
    let update = Statement::new(returning_job!(
        "UPDATE jobs SET detached_calls = detached_calls + 1 \
         WHERE tenant = $1 AND job = $2 AND create_time = $3 AND attached_calls > detached_calls"
    ));
    let update = update.bind(&name.tenant).bind(&name.job).bind(micros(created));
    match connection.optional_row(update).await? {
        Some(row) => rows::job(&row),
        None => get(connection, name).await,
    }
}

/// The row of a job's input: one that is stored now, or that of an uploaded one.
async fn input_of(connection: &mut dyn Connection, new: &NewRecord, now: SystemTime) -> Result<i64, Error> {
    match &new.input {
        JobInput::Inline(bytes) => insert_input(connection, &new.name.tenant, bytes, now).await,
        JobInput::Uploaded { input, .. } => uploads::use_input(connection, &named(new, input), now).await,
    }
}

/// The uploaded input of a job, where it has one.
fn uploaded(new: &NewRecord) -> Option<InputName> {
    new.input.uploaded().map(|input| named(new, input))
}

fn named(new: &NewRecord, input: &str) -> InputName {
    InputName { tenant: new.name.tenant.clone(), input: input.to_owned() }
}

/// Stores an encoded input; returns its row.
pub(super) async fn insert_input(
    connection: &mut dyn Connection,
    tenant: &str,
    bytes: &[u8],
    now: SystemTime,
) -> Result<i64, Error> {
    let insert = Statement::new("INSERT INTO inputs (tenant, bytes, create_time) VALUES ($1, $2, $3) RETURNING id")
        .bind(tenant)
        .bind(integer(bytes.len() as u64))
        .bind(micros(now));
    let id = connection.row(insert).await?.integer("id")?;
    for (chunk, data) in (0_i64..).zip(bytes.chunks(payload::CHUNK_BYTES)) {
        let insert = Statement::new("INSERT INTO input_chunks (input_id, chunk, data) VALUES ($1, $2, $3)");
        connection.execute(insert.bind(id).bind(chunk).bind(data)).await?;
    }
    Ok(id)
}

/// The row of a job, whose first event has the number 1.
fn insert_job(new: &NewRecord, input_id: i64, now: SystemTime) -> Result<Statement, Error> {
    let insert = Statement::new(returning_job!(
        "INSERT INTO jobs (tenant, job, state, priority, create_time, queue_time, deadline, input_id, input_bytes, \
         view_count, track_count, observation_count, settings, labels, trace_parent, uploaded_input, attached_calls, \
         last_sequence) VALUES ($1, $2, 'QUEUED', $3, $4, $4, $5, $6, $7, $8, $9, $10, $11, $12, $13, $14, $15, 1)"
    ));
    Ok(insert
        .bind(&new.name.tenant)
        .bind(&new.name.job)
        .bind(new.priority)
        .bind(micros(now))
        .bind(new.deadline.map(micros))
        .bind(input_id)
        .bind(integer(new.input.bytes()))
        .bind(new.view_count)
        .bind(new.track_count)
        .bind(new.observation_count)
        .bind(payload::encode(&new.settings)?)
        .bind(payload::encode(&new.labels)?)
        .bind(new.trace_parent.as_deref())
        .bind(new.input.uploaded())
        .bind(new.cancel_on_disconnect.then_some(1_i64)))
}

/// One job by its name.
pub(super) async fn get(connection: &mut dyn Connection, name: &JobName) -> Result<Job, Error> {
    let select = Statement::new(select_jobs!("WHERE tenant = $1 AND job = $2")).bind(&name.tenant).bind(&name.job);
    let row = connection.optional_row(select).await?;
    row.as_ref().map_or_else(|| Err(Error::NotFound(name.clone())), rows::job)
}

/// One page of a listing.
pub(super) async fn list(connection: &mut dyn Connection, query: &JobQuery) -> Result<Page<Job>, Error> {
    let cursor = query.cursor()?;
    let mut select = Statement::new(select_jobs!("WHERE tenant = ")).then_bind(&query.tenant);
    for (number, state) in query.states.iter().enumerate() {
        select = select.then(if number == 0 { " AND state IN (" } else { ", " }).then_bind(state.name());
    }
    if !query.states.is_empty() {
        select = select.then(")");
    }
    for (key, value) in &query.labels {
        select = select.then(" AND EXISTS (SELECT 1 FROM job_labels WHERE job_id = jobs.id AND key = ").then_bind(key);
        select = select.then(" AND value = ").then_bind(value).then(")");
    }
    let (beyond, order) = match query.order {
        Order::CreateTimeDescending => (" AND (create_time, job) < (", " ORDER BY create_time DESC, job DESC"),
        Order::CreateTimeAscending => (" AND (create_time, job) > (", " ORDER BY create_time, job"),
    };
    if let Some(cursor) = cursor {
        select = select.then(beyond).then_bind(cursor.create_micros).then(", ").then_bind(&cursor.id).then(")");
    }
    rows::page(connection, query, select.then(order), "job", rows::job).await
}

/// The row of a job.
async fn id(connection: &mut dyn Connection, name: &JobName) -> Result<i64, Error> {
    let select =
        Statement::new("SELECT id FROM jobs WHERE tenant = $1 AND job = $2").bind(&name.tenant).bind(&name.job);
    let row = connection.optional_row(select).await?;
    row.ok_or_else(|| Error::NotFound(name.clone()))?.integer("id")
}

/// Events of a job with a sequence number above `after`.
pub(super) async fn events_after(
    connection: &mut dyn Connection,
    name: &JobName,
    after: u64,
    limit: u32,
) -> Result<Vec<JobEvent>, Error> {
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
        id(connection, name).await?;
    }
    rows.iter().map(event).collect()
}

/// The encoded input of a job, and whether its cancel was asked for.
pub(super) async fn job_payload(connection: &mut dyn Connection, name: &JobName) -> Result<JobPayload, Error> {
    let select = Statement::new(
        "SELECT data, cancel_requested FROM jobs JOIN input_chunks ON input_chunks.input_id = jobs.input_id \
         WHERE tenant = $1 AND job = $2 ORDER BY chunk",
    );
    let chunks = connection.rows(select.bind(&name.tenant).bind(&name.job)).await?;
    // An encoded input has a byte at least, and so a chunk.
    let first = chunks.first().ok_or_else(|| Error::NotFound(name.clone()))?;
    Ok(JobPayload { cancel_requested: first.flag("cancel_requested")?, input: joined(&chunks)? })
}

/// The encoded result of a job, if it has one.
pub(super) async fn result(connection: &mut dyn Connection, name: &JobName) -> Result<Option<EncodedResult>, Error> {
    // In one look: between two the job may be deleted.
    let select = Statement::new(
        "SELECT result_sha256, data FROM jobs LEFT JOIN result_chunks ON result_chunks.job_id = jobs.id \
         WHERE tenant = $1 AND job = $2 ORDER BY chunk",
    );
    let chunks = connection.rows(select.bind(&name.tenant).bind(&name.job)).await?;
    let first = chunks.first().ok_or_else(|| Error::NotFound(name.clone()))?;
    let Some(sha256) = first.optional_bytes("result_sha256")? else { return Ok(None) };
    let sha256 = sha256.try_into().map_err(|_| Error::Corrupt(format!("the digest of the result of {name}")))?;
    Ok(Some(EncodedResult { bytes: joined(&chunks)?, sha256 }))
}

pub(super) fn joined(chunks: &[Row]) -> Result<Vec<u8>, Error> {
    let mut whole = Vec::new();
    for chunk in chunks {
        whole.extend(chunk.bytes("data")?);
    }
    Ok(whole)
}

/// What waits and what runs.
pub(super) async fn queue_stats(connection: &mut dyn Connection) -> Result<QueueStats, Error> {
    // Sums of 64-bit numbers have a wider type of their own in PostgreSQL.
    let select = Statement::new(
        "SELECT COUNT(*) AS queued, CAST(COALESCE(SUM(input_bytes), 0) AS BIGINT) AS bytes, \
         CAST(COALESCE(SUM(observation_count), 0) AS BIGINT) AS observations, \
         (SELECT COUNT(*) FROM jobs WHERE state = 'RUNNING') AS running, \
         (SELECT pause_time IS NOT NULL FROM queue) AS paused FROM jobs WHERE state = 'QUEUED'",
    );
    measured(&connection.row(select).await?)
}

/// What waits and runs of each tenant that has such jobs, and since when the oldest job waits.
pub(super) async fn by_tenant(
    connection: &mut dyn Connection,
) -> Result<(Vec<TenantQueue>, Option<SystemTime>), Error> {
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
}

/// What waits of one tenant; what runs is not counted.
async fn tenant_queue_stats(connection: &mut dyn Connection, tenant: &str) -> Result<QueueStats, Error> {
    let select = Statement::new(
        "SELECT COUNT(*) AS queued, CAST(COALESCE(SUM(input_bytes), 0) AS BIGINT) AS bytes, \
         CAST(COALESCE(SUM(observation_count), 0) AS BIGINT) AS observations, CAST(0 AS BIGINT) AS running, \
         FALSE AS paused FROM jobs WHERE state = 'QUEUED' AND tenant = $1",
    );
    measured(&connection.row(select.bind(tenant)).await?)
}

fn measured(row: &Row) -> Result<QueueStats, Error> {
    Ok(QueueStats {
        queued: number(row, "queued")?,
        queued_bytes: number(row, "bytes")?,
        queued_observations: number(row, "observations")?,
        running: number(row, "running")?,
        paused: row.flag("paused")?,
    })
}
