//! Admission: from what a caller wants to a stored job, or a refusal.

use std::collections::BTreeMap;
use std::time::{Duration, SystemTime};

use sha2::{Digest, Sha256};

use super::{Engine, Error, Inner, StoreError, WebhookOptions, finished, observe, webhooks};
use crate::domain::error::{Violation, Violations, quoted};
use crate::domain::job::{Job, JobName};
use crate::domain::{Backend, FEW_OBSERVATIONS, Input, InputName, Oversize, Quota, SolveSettings};
use crate::solver;
use crate::store::{self, NewRecord, Request, StoredInput, payload};

/// When a job without a result expires.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Deadline {
    At(SystemTime),
    /// After its creation.
    After(Duration),
}

/// What a job works on.
#[derive(Debug, Clone)]
pub enum JobInput {
    Inline(Input),
    /// An uploaded input of the job's tenant.
    Uploaded(InputName),
}

/// What a caller says of a job beside its tenant and its input.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct JobDescription {
    /// Last part of the job's name; `None`: made here.
    pub job_id: Option<String>,
    /// Makes creation idempotent; scoped to the tenant. Whoever reads it from a caller checks its form.
    pub request_id: Option<String>,
    pub settings: SolveSettings,
    pub deadline: Option<Deadline>,
    /// Larger is sooner; 0 is the default.
    pub priority: i32,
    pub labels: BTreeMap<String, String>,
    /// Where the job's end is to be sent.
    pub webhook_url: Option<String>,
}

impl JobDescription {
    /// What two requests must share to be the same: all that the caller stated but the trace, which tells the calls
    /// apart. A relative deadline counts as stated, so that a retry is the same request.
    fn digest(&self, input: &[u8]) -> Result<[u8; 32], Error> {
        let deadline = match self.deadline {
            None => None,
            Some(Deadline::At(time)) => Some(("at", time.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default())),
            Some(Deadline::After(duration)) => Some(("after", duration)),
        };
        let rest = (&self.job_id, &self.settings, deadline, self.priority, &self.labels, &self.webhook_url);
        let rest = payload::encode(&rest)?;
        let mut hash = Sha256::new();
        hash.update((rest.len() as u64).to_le_bytes());
        hash.update(rest);
        hash.update(input);
        Ok(hash.finalize().into())
    }
}

/// A job that is to be stored.
#[derive(Debug, Clone)]
pub struct NewJob {
    pub tenant: String,
    pub description: JobDescription,
    pub input: JobInput,
    /// W3C `traceparent` of the call.
    pub trace_parent: Option<String>,
    /// Whether the call attaches to the job, see [`Engine::detach`]. No part of what makes two requests the same.
    pub cancel_on_disconnect: bool,
}

impl NewJob {
    fn validate(&self, webhooks: Option<&WebhookOptions>) -> Result<(), Error> {
        let mut found = Violations::default();
        let id_rule = "1 to 63 of a-z, 0-9 and -, not beginning or ending with -";
        if !JobName::is_id(&self.tenant) {
            found.push(Violation::of("tenant", format!("{} is not an id: {id_rule}", quoted(&self.tenant))));
        }
        if let Some(id) = self.description.job_id.as_ref().filter(|id| !JobName::is_id(id)) {
            found.push(Violation::of("job_id", format!("{} is not an id: {id_rule}", quoted(id))));
        }
        if let JobInput::Uploaded(name) = &self.input
            && name.tenant != self.tenant
        {
            return Err(StoreError::InputNotFound(name.clone()).into());
        }
        found.into_result()?;
        if let Some(url) = &self.description.webhook_url {
            webhooks::check(webhooks, &self.tenant, url)?;
        }
        Ok(self.description.settings.validate()?)
    }

    /// What is stored; `uploaded` is the input that it names, where it names one. Encodes and, for a request id, hashes
    /// the whole input: not for an async thread where that is large.
    fn into_record(self, uploaded: Option<StoredInput>, now: SystemTime, backend: Backend) -> Result<NewRecord, Error> {
        // Bounded by the limits on inputs, which are far below what a u32 holds.
        let count = |number: usize| u32::try_from(number).unwrap_or(u32::MAX);
        let mut named = Vec::new();
        let (input, [view_count, track_count, observation_count]) = match (&self.input, uploaded) {
            (JobInput::Inline(input), _) => {
                let counts = [input.view_count(), input.track_count(), input.observation_count()].map(count);
                (store::JobInput::Inline(payload::encode(input)?), counts)
            }
            (JobInput::Uploaded(_), Some(found)) => {
                let counts = [found.view_count, found.track_count, found.observation_count];
                // An encoded input begins as a map does, and a name as text: neither is ever taken for the other.
                named = payload::encode(&found.name.to_string())?;
                (store::JobInput::Uploaded { input: found.name.input, bytes: found.payload_bytes }, counts)
            }
            (JobInput::Uploaded(name), None) => return Err(StoreError::InputNotFound(name.clone()).into()),
        };
        let digested = match &input {
            store::JobInput::Inline(bytes) => bytes.as_slice(),
            store::JobInput::Uploaded { .. } => &named,
        };
        let has_id = self.description.request_id.is_some();
        let digest = has_id.then(|| self.description.digest(digested)).transpose()?;
        let JobDescription { job_id, request_id, settings, deadline, priority, labels, webhook_url } = self.description;
        let deadline = match deadline {
            None => None,
            Some(Deadline::At(time)) => Some(time),
            Some(Deadline::After(duration)) => Some(now.checked_add(duration).ok_or_else(|| {
                Error::InvalidArgument(Violation::of("deadline", "lies beyond the end of time").into())
            })?),
        };
        let job = job_id.unwrap_or_else(|| uuid::Uuid::now_v7().to_string());
        Ok(NewRecord {
            name: JobName { tenant: self.tenant, job },
            request: request_id.zip(digest).map(|(id, digest)| Request { id, digest }),
            view_count,
            track_count,
            observation_count,
            input,
            settings: SolveSettings { backend: Some(settings.backend.unwrap_or(backend)), ..settings },
            deadline,
            priority,
            labels,
            trace_parent: self.trace_parent,
            cancel_on_disconnect: self.cancel_on_disconnect,
            webhook_url,
        })
    }
}

impl Engine {
    /// Admits and stores jobs, all or none; the answers are in their order. A repeated request id with the same body
    /// gives the job that the first call made.
    ///
    /// # Errors
    /// Of the first job that is refused: [`StoreError::QueueFull`] at once when too much waits,
    /// [`StoreError::BatchTooLarge`], [`Error::JobTooLarge`], [`StoreError::AlreadyExists`] for a taken job id or a
    /// request id with another body, [`Error::InvalidArgument`], [`Error::Draining`].
    pub async fn submit_batch(&self, news: Vec<NewJob>) -> Result<Vec<Job>, Error> {
        let inner = self.inner.clone();
        news.iter().try_for_each(|new| new.validate(inner.options.webhooks.as_ref()))?;
        inner.check_open().inspect_err(|_| observe::refused(observe::Refusal::Draining))?;
        let now = inner.now();
        let backend = inner.options.backend;
        let mut observations = 0;
        let mut uploaded = Vec::new();
        for new in &news {
            uploaded.push(match &new.input {
                JobInput::Inline(input) => {
                    observations += input.observation_count();
                    None
                }
                JobInput::Uploaded(name) => Some(inner.store.uploaded_input(name).await?),
            });
        }
        let encode = move || {
            let each = news.into_iter().zip(uploaded);
            each.map(|(new, uploaded)| new.into_record(uploaded, now, backend)).collect::<Result<Vec<_>, _>>()
        };
        let records = if observations <= FEW_OBSERVATIONS as usize {
            encode()?
        } else {
            finished(tokio::task::spawn_blocking(encode)).await?
        };
        let max = inner.options.max_solver_bytes;
        for (index, new) in records.iter().enumerate() {
            let asked = solver::estimated_bytes(new.view_count, new.track_count, new.observation_count);
            // A repeated request gets its job, which may have been created under a larger bound.
            if asked > max && !inner.is_created(new).await? {
                observe::refused(observe::Refusal::JobTooLarge);
                return Err(Error::JobTooLarge { index, oversize: Oversize { quota: Quota::SolverBytes, asked, max } });
            }
        }
        // On its own task: a caller that goes away must not leave a stored job untold.
        finished(tokio::spawn(async move { inner.store_jobs(records, now).await })).await
    }
}

impl Inner {
    /// Whether an earlier call with the same request id has created the job.
    async fn is_created(&self, new: &NewRecord) -> Result<bool, Error> {
        let Some(request) = &new.request else { return Ok(false) };
        Ok(self.store.requested_job(&new.name.tenant, request).await?.is_some())
    }

    async fn store_jobs(&self, records: Vec<NewRecord>, now: SystemTime) -> Result<Vec<Job>, Error> {
        let created = self.store.create_jobs(records, &self.options.queue, now).await;
        let created = created.inspect_err(observe::refused_by_store)?;
        let new = created.iter().filter(|created| created.by_this_call).count();
        (0..new).for_each(|_| observe::job_created());
        if new > 0 {
            self.work_waits();
            self.queue_changed();
        }
        Ok(created.into_iter().map(|created| self.dated(created.job)).collect())
    }
}
