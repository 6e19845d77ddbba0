//! The job engine: admission, queue, workers, leases, watching and draining, on top of a store and a solver.
//!
//! Knows nothing of transport. Depends on `store`, `solver`, `telemetry` and `domain`; its channels never leave it.

mod admin;
mod drain;
mod error;
mod execution;
mod limits;
mod notifications;
mod notifier;
mod observe;
mod options;
mod running;
mod slot;
mod submit;
mod upload;
mod watch;
mod webhooks;
mod worker;

#[cfg(test)]
mod tests;

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::SystemTime;

use tokio::sync::{Notify, watch as channel};
use tokio_util::sync::CancellationToken;

pub use crate::store::{
    Bound, Clock, EncodedResult, Error as StoreError, InputQuery, JobQuery, NewUpload, Order, Page, QueueBounds,
    QueueReport, QueueStats, StoredInput, TakenId, TenantQueue, TenantShares, UploadBounds, UploadStatus,
};
pub use crate::telemetry::metrics::GivenUp;
pub use drain::Drained;
pub use error::Error;
pub use options::Options;
pub use submit::{Deadline, JobDescription, JobInput, NewJob};
pub use upload::{Begun, Upload, UploadOptions};
pub use watch::Watch;
pub use webhooks::{JobEncoder, Options as WebhookOptions, Secrets as WebhookSecrets};

use crate::domain::job::{Job, JobName, JobState};
use crate::domain::{FEW_OBSERVATIONS, Input, Observer, Quota, Solution, SolveSettings, StopToken};
use crate::parallel::Threads;
use crate::solver;
use crate::store::{self, Store};

/// What workers run; [`solver_on`] in earnest, a stand-in in tests.
pub type Solver =
    Arc<dyn Fn(&Input, &SolveSettings, &mut dyn Observer, &StopToken) -> Result<Solution, solver::Error> + Send + Sync>;

/// How a result is encoded, once, for all who read it: what it means is theirs to know.
pub type ResultEncoder = fn(&JobName, &Solution) -> Vec<u8>;

/// The real solver, each job on its worker's thread and those that help it. What it finds is the same.
pub fn solver_on(threads: Threads) -> Solver {
    Arc::new(move |input: &Input, settings: &SolveSettings, observer: &mut dyn Observer, stop: &StopToken| {
        solver::solve_on(threads, input, settings, observer, stop)
    })
}

/// Views, tracks and observations of a small job: a server that must refuse it is of little use.
const SMALL_JOB: [u32; 3] = [10, 1_000, 10_000];

/// A handle on a running engine; clones are the same engine.
///
/// Jobs are stored before [`Engine::submit_batch`] returns, and go on after a restart. End it with [`Engine::drain`]; one
/// that is merely dropped with its runtime leaves its running jobs to the next start, as a crash would.
#[derive(Clone)]
pub struct Engine {
    inner: Arc<Inner>,
}

/// What can be done with the store.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StoreState {
    Healthy,
    /// It can be read, and what was begun ends; there is no room to begin anything.
    Full,
    /// It is out of reach: the server can neither take on nor report anything.
    Unavailable,
}

/// Whether new work is taken on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Phase {
    Open,
    /// Nothing is admitted or claimed, what runs may finish.
    Draining,
    /// Nothing runs.
    Closed,
}

struct Inner {
    options: Options,
    store: Arc<Store>,
    notifier: Arc<notifier::Notifier>,
    /// Attempts that run in this process or are prefetched, for a cancel to reach them at once.
    running: Mutex<running::RunningAttempts>,
    limits: limits::AttemptLimits,
    /// Counts the reasons to look for a job to claim; slots wait for a change.
    work: channel::Sender<u64>,
    /// Wakes the task that counts the queue.
    queue_changed: Notify,
    /// Wakes the task that delivers webhooks.
    webhook_due: Notify,
    phase: channel::Sender<Phase>,
    /// Cancelled once what runs is to go back to the queue: at the end of a drain's bound, or before by
    /// [`Engine::interrupt_running`].
    interrupted: CancellationToken,
    /// Cancelled once this server was asked to drain, which is for whoever runs the engine to do.
    drain_asked: CancellationToken,
    /// What the last sweep found.
    store_state: channel::Sender<StoreState>,
    pool: Mutex<drain::WorkerPool>,
    /// Jobs that dead processes had left and the start took back.
    recovered_jobs: usize,
}

impl Engine {
    /// Takes back the jobs of dead processes, starts the workers and takes up what is queued. To be called within a
    /// tokio runtime, which must outlive the engine.
    ///
    /// # Errors
    /// [`Error::Internal`] when the store or a thread refuses.
    pub async fn start(
        options: Options,
        store: Arc<Store>,
        solver: Solver,
        encode: ResultEncoder,
    ) -> Result<Self, Error> {
        let threads = drain::Threads::start(options.workers.max(1), &solver, encode)?;
        Self::start_with(options, store, threads).await
    }

    async fn start_with(mut options: Options, store: Arc<Store>, threads: drain::Threads) -> Result<Self, Error> {
        options.lease = options.lease.clamp(Options::MIN_LEASE, Options::MAX_LEASE);
        let recovered = store.recover(options.clock.now(), options.max_attempts).await?;
        let inner = Arc::new(Inner {
            store,
            notifier: Arc::default(),
            running: Mutex::default(),
            limits: limits::AttemptLimits::new(options.max_solver_bytes),
            work: channel::Sender::new(0),
            queue_changed: Notify::new(),
            webhook_due: Notify::new(),
            phase: channel::Sender::new(Phase::Open),
            interrupted: CancellationToken::new(),
            drain_asked: CancellationToken::new(),
            store_state: channel::Sender::new(StoreState::Healthy),
            pool: Mutex::default(),
            recovered_jobs: recovered.len(),
            options,
        });
        observe::engine_size(inner.options.queue.max_jobs, inner.options.workers, inner.options.max_solver_bytes);
        observe::store_state(StoreState::Healthy);
        let max_solver_bytes = inner.options.max_solver_bytes;
        let [views, tracks, observations] = SMALL_JOB;
        let small_job_bytes = solver::estimated_bytes(views, tracks, observations);
        if max_solver_bytes < small_job_bytes {
            let key = Quota::SolverBytes.key();
            tracing::warn!(
                max_solver_bytes,
                small_job_bytes,
                "small jobs are refused too: {key} is less than they take"
            );
        }
        inner.taken_back(&recovered);
        inner.start_workers(threads)?;
        inner.queue_changed();
        Ok(Self { inner })
    }

    /// One job.
    ///
    /// # Errors
    /// [`StoreError::NotFound`].
    pub async fn job(&self, name: &JobName) -> Result<Job, Error> {
        Ok(self.inner.dated(self.inner.store.job(name).await?))
    }

    /// One page of a tenant's jobs.
    ///
    /// # Errors
    /// [`StoreError::PageToken`].
    pub async fn list(&self, query: &JobQuery) -> Result<Page<Job>, Error> {
        let page = self.inner.store.jobs(query).await?;
        let jobs = page.items.into_iter().map(|job| self.inner.dated(job)).collect();
        Ok(Page { items: jobs, ..page })
    }

    /// Ends a queued job, asks a running one to stop, leaves an ended one as it is; with an etag, only where it is the
    /// job's. Returns the job as it stands then: a running one ends soon after, which its events tell.
    ///
    /// # Errors
    /// [`StoreError::NotFound`], [`StoreError::EtagMismatch`].
    pub async fn cancel(&self, name: &JobName, etag: Option<String>) -> Result<Job, Error> {
        let (inner, name) = (self.inner.clone(), name.clone());
        let cancel = async move {
            let reply = inner.store.request_cancel(&name, etag.as_deref(), inner.now()).await?;
            inner.stop_attempts(&name);
            if reply.by_this_call {
                inner.ended(&reply.job);
            }
            Ok::<_, Error>(inner.dated(reply.job))
        };
        // On its own task: a caller that goes away must not leave a stored cancel untold.
        finished(tokio::spawn(cancel)).await
    }

    /// Counts that a call was disconnected whose submission had `cancel_on_disconnect`; `created` is the job's time of
    /// creation. Whether the job goes on without it is the caller's to decide, by [`Job::attached_calls`].
    ///
    /// # Errors
    /// [`StoreError::NotFound`].
    pub async fn detach(&self, name: &JobName, created: SystemTime) -> Result<Job, Error> {
        Ok(self.inner.store.detach(name, created).await?)
    }

    /// Removes an ended job with its events, input, result, request ids and webhook; with an etag, only where it is the
    /// job's.
    ///
    /// # Errors
    /// [`StoreError::NotFound`], [`StoreError::NotEnded`], [`StoreError::EtagMismatch`].
    pub async fn delete(&self, name: &JobName, etag: Option<&str>) -> Result<(), Error> {
        self.inner.store.delete_job(name, etag).await?;
        observe::jobs_deleted(observe::Deletion::Requested, 1);
        Ok(())
    }

    /// Jobs that dead processes had left running, which the start took back.
    pub fn recovered_jobs(&self) -> usize {
        self.inner.recovered_jobs
    }

    /// How this engine works.
    pub fn options(&self) -> &Options {
        &self.inner.options
    }

    /// The encoded result of a job, as it was read before: it must have succeeded then.
    ///
    /// # Errors
    /// [`StoreError::NotFound`], [`Error::NotReady`] for a job in any other state, [`StoreError::Corrupt`] for a result
    /// that is not what was stored.
    pub async fn result(&self, job: &Job) -> Result<EncodedResult, Error> {
        let name = &job.name;
        if job.state != JobState::Succeeded {
            return Err(Error::NotReady(job.state));
        }
        let result = self.inner.store.result(name, job.observation_count).await?;
        let result = result.ok_or_else(|| StoreError::NotFound(name.clone()))?;
        let corrupt = store::Error::Corrupt(format!("the result of {name} is not what was stored"));
        let checked = move || if result.is_intact() { Ok(result) } else { Err(corrupt) };
        if job.observation_count <= FEW_OBSERVATIONS {
            return Ok(checked()?);
        }
        // Megabytes to hash: not on a thread that serves others.
        finished(tokio::task::spawn_blocking(checked)).await
    }

    /// What waits in the queue.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn queue_stats(&self) -> Result<QueueStats, Error> {
        Ok(self.inner.store.queue_stats().await?)
    }

    /// What can be done with the store, as of a look a second.
    pub fn store_state(&self) -> channel::Receiver<StoreState> {
        self.inner.store_state.subscribe()
    }

    /// Ends the wait of a drain, also of one that is still to come: what runs goes back to the queue now.
    pub fn interrupt_running(&self) {
        self.inner.interrupted.cancel();
    }
}

impl std::fmt::Debug for Engine {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Engine").field("options", &self.inner.options).field("phase", &self.inner.phase()).finish()
    }
}

impl Inner {
    fn phase(&self) -> Phase {
        *self.phase.borrow()
    }

    /// Refuses what is new while the server drains.
    ///
    /// # Errors
    /// [`Error::Draining`].
    fn check_open(&self) -> Result<(), Error> {
        if self.phase() == Phase::Open { Ok(()) } else { Err(Error::Draining) }
    }

    fn now(&self) -> SystemTime {
        self.options.clock.now()
    }

    /// Tells the slots that a job may be waiting.
    fn work_waits(&self) {
        self.work.send_modify(|count| *count = count.wrapping_add(1));
    }

    /// Has the queue counted anew.
    fn queue_changed(&self) {
        self.queue_changed.notify_one();
    }

    /// A job as it is answered: with the time of its removal.
    fn dated(&self, job: Job) -> Job {
        let expire_time = job.end_time.zip(self.options.retention).and_then(|(end, kept)| end.checked_add(kept));
        Job { expire_time, ..job }
    }

    /// Tells everyone that a job ended; called once a job, by whoever committed its end.
    fn ended(&self, job: &Job) {
        observe::job_ended(job);
        self.notifier.wake(&job.name);
        self.queue_changed();
        if job.webhook.is_some() {
            self.webhook_due.notify_one();
        }
        if self.options.shares.max_running.is_some() {
            // Its tenant may begin another one.
            self.work_waits();
        }
    }

    /// Tells everyone of jobs whose workers vanished.
    fn taken_back(&self, jobs: &[Job]) {
        for job in jobs {
            tracing::warn!(job = %job.name, attempt = job.attempt, state = job.state.name(), "worker vanished");
            observe::attempt_lost(observe::AttemptLost::LeaseExpired);
            if job.state.is_terminal() {
                self.ended(job);
            } else {
                self.notifier.wake(&job.name);
            }
        }
        if !jobs.is_empty() {
            self.work_waits();
            self.queue_changed();
        }
    }
}

/// Locks; a panic elsewhere while it was held left no half-done change, since all changes are single map operations.
fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// What a task of ours came to.
async fn finished<T, E: Into<Error>>(task: tokio::task::JoinHandle<Result<T, E>>) -> Result<T, Error> {
    match task.await {
        Ok(result) => result.map_err(Into::into),
        Err(error) => Err(Error::Internal(format!("a task of the engine broke off: {error}"))),
    }
}
