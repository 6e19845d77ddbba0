//! Admission: what a caller wants becomes a job in the queue, or is refused.

use std::collections::{BTreeSet, HashMap, HashSet};
use std::sync::Arc;
use std::time::SystemTime;

use super::Size::{Payload, Small};
use super::WriteIntent::Begins;
use super::operation::{reads, writes};
use super::rows::{self, integer, micros, returning_job, select_jobs};
use super::{Connection, Database, Lock, Statement, webhooks};
use crate::domain::job::{EventBody, Job, JobState};
use crate::domain::{InputName, Webhook};
use crate::store::record::{ChangeReply, JobInput, NewRecord, QueueStats, Request};
use crate::store::{Error, Notification, QueueBounds, TakenId, payload};

/// Number of a job's first event, which its row counts.
const FIRST_EVENT: u64 = 1;

impl dyn Database {
    /// Stores queued jobs with their inputs and their first events, all or none, unless the request id of one is known
    /// or admission refuses; the answers are in their order. A request id that comes twice with the same body is one
    /// job: with [`NewRecord::cancel_on_disconnect`] the call attaches to it, as far as it depends on its calls
    /// ([`Job::attached_calls`]), and without it does not depend on any from then on.
    ///
    /// # Errors
    /// [`Error::AlreadyExists`], [`Error::QueueFull`], [`Error::BatchTooLarge`], of the first job that is refused.
    pub async fn create_jobs(
        &self,
        news: Vec<NewRecord>,
        bounds: &QueueBounds,
        now: SystemTime,
    ) -> Result<Vec<ChangeReply>, Error> {
        let news: Arc<[NewRecord]> = news.into();
        let stored = news.iter().map(|new| match &new.input {
            JobInput::Inline(bytes) => bytes.len() as u64,
            JobInput::Uploaded { .. } => 0,
        });
        writes!(self, "create_jobs", Payload, Begins(stored.sum()), [news, bounds], |connection| {
            connection.check_size(&news, &bounds).await?;
            let mut stats = AdmissionStats::default();
            let mut inputs = vec![None; news.len()];
            if !connection.writes_alone() {
                // Before anything else, and in one order: two batches of the same inputs in other orders would wait for
                // each other.
                for name in news.iter().filter_map(uploaded).collect::<BTreeSet<_>>() {
                    connection.lock_input(&name).await?;
                }
                for (new, input) in news.iter().zip(&mut inputs) {
                    // Payloads take long: nobody else's admission waits for them.
                    let admitted = connection.admit(new, &bounds, &mut stats).await;
                    if admitted.map_err(|error| of_batch(error, &[], &news))?.is_none() {
                        *input = Some(connection.input_of(new, now).await?);
                    }
                }
                connection.take_lock(Lock::Admission).await?;
                // Looked over again below: others may have come in between.
                stats = AdmissionStats::default();
            }
            let (mut created, mut stored) = (Vec::new(), Vec::new());
            for (place, (new, input)) in news.iter().zip(inputs).enumerate() {
                let admitted = connection.admit(new, &bounds, &mut stats).await;
                match admitted.map_err(|error| of_batch(error, &stored, &news[place..]))? {
                    Some(job) => {
                        if let Some(input) = input {
                            let delete = Statement::new("DELETE FROM inputs WHERE id = $1 AND input IS NULL");
                            connection.execute(delete.bind(input)).await?;
                        }
                        created.push(ChangeReply {
                            job: connection.attach(job, new.cancel_on_disconnect).await?,
                            by_this_call: false,
                        });
                    }
                    None => {
                        let input = match input {
                            Some(input) => input,
                            None => connection.input_of(new, now).await?,
                        };
                        created
                            .push(ChangeReply { job: connection.enqueue(new, input, now).await?, by_this_call: true });
                        stats.add(new);
                        stored.push(new);
                    }
                }
            }
            for tenant in stored.iter().map(|new| new.name.tenant.as_str()).collect::<BTreeSet<_>>() {
                connection.register_tenant(tenant).await?;
            }
            Ok(created)
        })
    }

    /// The job that a tenant's request made before; `None` where it made none, or the job is gone.
    ///
    /// # Errors
    /// [`Error::AlreadyExists`] for a request id with another body.
    pub async fn requested_job(&self, tenant: &str, request: &Request) -> Result<Option<Job>, Error> {
        reads!(self, "requested_job", Small, |connection| connection.requested_job(tenant, request).await)
    }
}

impl dyn Connection + '_ {
    /// Refuses jobs that are more by themselves than may ever wait: told to come back, their caller would do so for
    /// ever.
    async fn check_size(&mut self, news: &[NewRecord], bounds: &QueueBounds) -> Result<(), Error> {
        if bounds.never_takes(&news.iter().collect::<Vec<_>>()).is_none() {
            return Ok(());
        }
        // Those that an earlier call has created are not created again, and one that comes twice is one.
        let (mut fresh, mut requests) = (Vec::new(), HashSet::new());
        for new in news {
            let known = match &new.request {
                Some(request) => {
                    !requests.insert((&new.name.tenant, &request.id))
                        || self.requested_job(&new.name.tenant, request).await?.is_some()
                }
                None => false,
            };
            if !known {
                fresh.push(new);
            }
        }
        bounds.never_takes(&fresh).map_or(Ok(()), |oversize| Err(Error::BatchTooLarge(oversize)))
    }

    /// Whether a job may be stored: `Ok(None)`; or the job that the same request made before.
    async fn admit(
        &mut self,
        new: &NewRecord,
        bounds: &QueueBounds,
        stats: &mut AdmissionStats,
    ) -> Result<Option<Job>, Error> {
        if let Some(request) = &new.request
            && let Some(job) = self.requested_job(&new.name.tenant, request).await?
        {
            return Ok(Some(job));
        }
        let taken = Statement::new("SELECT EXISTS (SELECT 1 FROM jobs WHERE tenant = $1 AND job = $2) AS taken")
            .bind(&new.name.tenant)
            .bind(&new.name.job);
        if self.row(taken).await?.flag("taken")? {
            return Err(Error::AlreadyExists(TakenId::Job(new.name.clone())));
        }
        let (whole, tenant) = stats.look(self, &new.name.tenant, bounds).await?;
        match bounds.refuses(&whole, &tenant, &QueueStats::of([new])) {
            Some(bound) => Err(Error::QueueFull(bound)),
            None => Ok(None),
        }
    }

    /// Stores a job that was admitted, its labels, its request id and its first event.
    async fn enqueue(&mut self, new: &NewRecord, input_id: i64, now: SystemTime) -> Result<Job, Error> {
        let row = self.row(insert_job(new, input_id, now)?).await?;
        let id = row.integer("id")?;
        for (key, value) in &new.labels {
            let insert = Statement::new("INSERT INTO job_labels (job_id, key, value) VALUES ($1, $2, $3)");
            self.execute(insert.bind(id).bind(key).bind(value)).await?;
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
            self.execute(insert).await?;
        }
        let event = EventBody::State { state: JobState::Queued, failure: None };
        self.execute(rows::insert_event(id, FIRST_EVENT, 0, &event, now)?).await?;
        let mut job = rows::job(&row)?;
        if let Some(url) = &new.webhook_url {
            let webhook = Webhook::pending(url);
            self.execute(webhooks::insert(id, &webhook)?).await?;
            job.webhook = Some(webhook);
        }
        self.notify(Notification::Events(new.name.clone())).await?;
        self.notify(Notification::Queued).await?;
        Ok(job)
    }

    /// The job that this request id made before.
    async fn requested_job(&mut self, tenant: &str, request: &Request) -> Result<Option<Job>, Error> {
        let select = Statement::new("SELECT digest, job_id FROM request_ids WHERE tenant = $1 AND request_id = $2")
            .bind(tenant)
            .bind(&request.id);
        let Some(known) = self.optional_row(select).await? else { return Ok(None) };
        if known.bytes("digest")? != request.digest {
            return Err(Error::AlreadyExists(TakenId::Request(request.id.clone())));
        }
        let select = Statement::new(select_jobs!("WHERE id = $1")).bind(known.integer("job_id")?);
        // None where the job was deleted between the two looks: its request id is free again.
        self.optional_row(select).await?.as_ref().map(rows::job).transpose()
    }

    /// What becomes of a job whose request came again: a call that is to cancel it on disconnect attaches, as far as
    /// the job depends on its calls at all; after any other one it depends on none.
    async fn attach(&mut self, job: Job, cancel_on_disconnect: bool) -> Result<Job, Error> {
        if job.attached_calls.is_none() || job.state.is_terminal() {
            return Ok(job);
        }
        let update = if cancel_on_disconnect {
            returning_job!("UPDATE jobs SET attached_calls = attached_calls + 1 WHERE tenant = $1 AND job = $2")
        } else {
            returning_job!("UPDATE jobs SET attached_calls = NULL, detached_calls = 0 WHERE tenant = $1 AND job = $2")
        };
        let row = self.row(Statement::new(update).bind(&job.name.tenant).bind(&job.name.job)).await?;
        rows::job(&row)
    }

    /// The row of a job's input: one that is stored now, or that of an uploaded one.
    async fn input_of(&mut self, new: &NewRecord, now: SystemTime) -> Result<i64, Error> {
        match &new.input {
            JobInput::Inline(bytes) => self.insert_input(&new.name.tenant, bytes, now).await,
            JobInput::Uploaded { input, .. } => self.use_input(&named(new, input), now).await,
        }
    }

    /// Stores an encoded input; returns its row.
    pub(super) async fn insert_input(&mut self, tenant: &str, bytes: &[u8], now: SystemTime) -> Result<i64, Error> {
        let insert = Statement::new("INSERT INTO inputs (tenant, bytes, create_time) VALUES ($1, $2, $3) RETURNING id")
            .bind(tenant)
            .bind(integer(bytes.len() as u64))
            .bind(micros(now));
        let id = self.row(insert).await?.integer("id")?;
        for (chunk, data) in (0_i64..).zip(bytes.chunks(payload::CHUNK_BYTES)) {
            let insert = Statement::new("INSERT INTO input_chunks (input_id, chunk, data) VALUES ($1, $2, $3)");
            self.execute(insert.bind(id).bind(chunk).bind(data)).await?;
        }
        Ok(id)
    }
}

/// Counts the whole batch where one of its jobs was refused; see [`crate::store::Bound::of_batch`].
fn of_batch(error: Error, stored: &[&NewRecord], rest: &[NewRecord]) -> Error {
    match error {
        Error::QueueFull(bound) => Error::QueueFull(bound.of_batch(stored, rest)),
        other => other,
    }
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
            None => connection.queue_stats(None).await?,
        };
        self.whole = Some(whole);
        if !bounds.has_tenant_bounds() {
            return Ok((whole, QueueStats::default()));
        }
        if let Some(known) = self.tenants.get(tenant) {
            return Ok((whole, *known));
        }
        let of_tenant = connection.queue_stats(Some(tenant)).await?;
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

/// The uploaded input of a job, where it has one.
fn uploaded(new: &NewRecord) -> Option<InputName> {
    new.input.uploaded().map(|input| named(new, input))
}

fn named(new: &NewRecord, input: &str) -> InputName {
    InputName { tenant: new.name.tenant.clone(), input: input.to_owned() }
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
