//! One attempt at a job, from its lease to its end: loads the input, hands it to the worker, stores progress, keeps the
//! lease, commits what it came to.
//!
//! A job that is claimed is begun with its lease. One that is prefetched is loaded while the worker solves another one,
//! and begun by the worker itself the moment that it is free: between two short jobs it would else wait for a commit of
//! the store and a dozen wake-ups beside busy solvers, some 3 ms. The store is told meanwhile. Where it says that
//! another worker was first, or that the job was cancelled, the work is stopped, and nothing was written of it.

use std::pin::pin;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use tokio::time::{Instant, Interval, MissedTickBehavior, interval, interval_at, sleep, sleep_until, timeout_at};
use tracing::{Instrument, Span};

use super::limits::{RunPermit, SolverMemory};
use super::observe::{self, Attempt, AttemptLost};
use super::running::Running;
use super::worker::{Assignment, AttemptHandle, AttemptOutcome, Started, Worker, failed, stopped};
use super::{Inner, Phase};
use crate::domain::job::{Job, JobState};
use crate::domain::{Grade, Progress, StopReason, StopToken};
use crate::solver;
use crate::store::{self, Claimed, Claims, Ending, Lease, Outcome};

/// Least time between two stored progress events of a job: twice a second is as fast as people look, and a commit
/// each is cheap for the disk.
const PROGRESS_PERIOD: Duration = Duration::from_millis(500);

/// How long a job has been solved before its progress is stored: nobody watches one that ends at once, and the commit
/// would cost as much as its end. Its last progress is stored with that.
const FIRST_PROGRESS: Duration = Duration::from_millis(100);

/// Heartbeats within the time of a lease: two may be lost.
pub(super) const HEARTBEATS_A_LEASE: u32 = 3;

/// How long a late heartbeat may take: one that finds that the lease has run out asks whether it was taken over.
const LATE_HEARTBEAT: Duration = Duration::from_secs(1);

/// Pause before a write is tried again that the store could not take.
pub(super) const RETRY_PAUSE: Duration = Duration::from_millis(500);

/// How often an attempt that waits for memory looks whether it is to stop: as often as a solver does.
const STOP_LOOK: Duration = Duration::from_millis(50);

/// Waits for the store no longer than the lease holds: a database that hangs must not keep the work going.
pub(super) async fn in_time<T>(
    until: Instant,
    writing: impl Future<Output = Result<T, store::Error>>,
) -> Result<T, store::Error> {
    let late = |_| Err(store::Error::Unavailable("no answer as long as the lease held".into()));
    timeout_at(until, writing).await.unwrap_or_else(late)
}

/// An attempt under way.
pub(super) struct JobExecution {
    inner: Arc<Inner>,
    job: Job,
    lease: Lease,
    trace_parent: Option<String>,
    /// When the job entered the queue.
    queue_time: SystemTime,
    stop: StopToken,
    /// Here unless a worker has it; of a prefetched job there is none.
    attempt: Option<Attempt>,
    /// The attempt's, once it is begun: what is logged within carries the job's name.
    span: Span,
    /// Until then the lease holds for sure.
    leased_until: Instant,
    /// The lease is gone: nothing more is written.
    lost: bool,
    /// The last progress that was stored.
    stored: Option<Progress>,
    running: Running,
    /// Held until it is solved; `None`: not taken yet.
    memory: Option<SolverMemory>,
    /// Held until its end is stored, or given up.
    _permit: RunPermit,
}

/// An attempt in a worker's hands.
pub(super) struct Loaded {
    execution: JobExecution,
    handle: AttemptHandle,
}

/// An attempt that is over, and that the store does not know of yet.
pub(super) struct Finished {
    execution: JobExecution,
    end: AttemptOutcome,
    latest: Option<Progress>,
}

/// How a job is told to stop, which it does by itself at its deadline.
fn stop_token(job: &Job, now: SystemTime) -> StopToken {
    let left = job.deadline.map(|deadline| deadline.duration_since(now).unwrap_or_default());
    // A deadline beyond what the clock can express is none.
    StopToken::with_deadline(left.and_then(|left| std::time::Instant::now().checked_add(left)))
}

impl JobExecution {
    /// Of a job that is leased: claimed, or prefetched for so long.
    pub(super) fn new(inner: Arc<Inner>, claimed: Claimed, lease_for: Duration, permit: RunPermit) -> Self {
        let Claimed { job, lease, trace_parent, queue_time } = claimed;
        let stop = stop_token(&job, inner.now());
        let running = Running::list(inner.clone(), &lease, &stop, job.state == JobState::Running);
        let mut execution = Self {
            inner,
            job,
            lease,
            trace_parent,
            queue_time,
            stop,
            attempt: None,
            span: Span::none(),
            leased_until: Instant::now() + lease_for,
            lost: false,
            stored: None,
            running,
            memory: None,
            _permit: permit,
        };
        if execution.is_begun() {
            let Lease { name, attempt } = &execution.lease;
            let attempt = Attempt::begin(name, *attempt, execution.trace_parent.as_deref());
            let begun = Started { span: attempt.span().clone(), at: Instant::now() };
            execution.attempt = Some(attempt);
            let now = execution.inner.now();
            execution.has_begun(begun, now);
        }
        execution
    }

    /// Whether the store knows it as running; else it is prefetched.
    fn is_begun(&self) -> bool {
        self.job.state == JobState::Running
    }

    fn has_begun(&mut self, begun: Started, now: SystemTime) {
        self.leased_until = begun.at + self.inner.options.lease;
        self.inner.notifier.wake(&self.job.name);
        observe::waited(&self.job.name, self.trace_parent.as_deref(), self.queue_time, now);
        begun.span.in_scope(|| tracing::info!("attempt begins"));
        self.span = begun.span;
    }

    /// Reads the input and hands the job to the worker. Returns the end of the attempt where there is nothing to solve.
    pub(super) async fn load(mut self, worker: &Worker) -> Result<Loaded, Finished> {
        let span = self.span.clone();
        let loading = async {
            let input = match self.take_memory().await {
                Ok(()) => self.read_input().await,
                Err(end) => Err(end),
            };
            let input = match input {
                Ok(input) => input,
                Err(end) => return Err(Finished::new(self, end, None)),
            };
            let subscription = self.inner.notifier.subscribe(&self.job.name);
            // Weights of an earlier attempt are out of date.
            subscription.channel().weights.send_replace(None);
            let assignment = Assignment {
                name: self.job.name.clone(),
                number: self.lease.attempt,
                trace_parent: self.trace_parent.clone(),
                attempt: self.attempt.take(),
                input,
                settings: self.job.settings.clone(),
                stop: self.stop.clone(),
                subscription,
            };
            let handle = worker.assign(assignment).await;
            Ok(Loaded { execution: self, handle })
        };
        loading.instrument(span).await
    }

    /// Takes the memory that the solver is estimated to need. Waits for jobs that have it to end; a prefetched job,
    /// which has no heartbeats, is given up instead.
    async fn take_memory(&mut self) -> Result<(), AttemptOutcome> {
        let Job { view_count, track_count, observation_count, .. } = self.job;
        let bytes = solver::estimated_bytes(view_count, track_count, observation_count);
        let inner = self.inner.clone();
        self.memory = inner.limits.try_acquire_memory(bytes);
        if self.memory.is_some() {
            return Ok(());
        }
        if !self.is_begun() {
            return Err(stopped(StopReason::Interrupted));
        }
        tracing::info!(bytes, "waits for memory that other jobs have");
        let mut taking = pin!(inner.limits.acquire_memory(bytes));
        let mut heartbeats = self.heartbeats();
        let mut looks = interval(STOP_LOOK);
        loop {
            tokio::select! {
                biased;
                memory = &mut taking => {
                    self.memory = memory;
                    return Ok(());
                }
                _ = heartbeats.tick(), if !self.lost => {
                    self.heartbeat().await;
                }
                () = sleep_until(self.leased_until), if !self.lost => self.lapse(),
                _ = looks.tick() => {
                    // A drain lets those finish that are being solved.
                    let drain = (inner.phase() != Phase::Open).then_some(StopReason::Interrupted);
                    if let Some(reason) = self.stop.reason().or(drain) {
                        return Err(stopped(reason));
                    }
                }
            }
        }
    }

    /// Reads the input, and the cancel that may have come before the job was listed as running. A store that is out
    /// of reach is asked again as long as the lease holds, which heartbeats keep while a large input is read. There are
    /// none for a prefetched job.
    async fn read_input(&mut self) -> Result<Vec<u8>, AttemptOutcome> {
        loop {
            let (store, name) = (self.inner.store.clone(), self.job.name.clone());
            let observations = self.job.observation_count;
            let mut reading = pin!(async move { store.job_payload(&name, observations).await });
            let mut heartbeats = self.heartbeats();
            let payload = loop {
                tokio::select! {
                    biased;
                    payload = &mut reading => break payload,
                    _ = heartbeats.tick(), if self.is_begun() && !self.lost => {
                        self.heartbeat().await;
                    }
                }
            };
            match payload {
                Ok(payload) if !self.lost => {
                    if payload.cancel_requested {
                        self.stop.stop(StopReason::Cancelled);
                    }
                    return Ok(payload.input);
                }
                Ok(_) => {}
                Err(error @ store::Error::Unavailable(_)) => self.store_failed(&error),
                Err(error) => return Err(failed(error.to_string())),
            }
            if self.lost {
                return Err(stopped(StopReason::Interrupted));
            }
            sleep(RETRY_PAUSE).await;
        }
    }

    /// Ticks when heartbeats are due, the first one as long after the last as any: at once, if that has passed.
    fn heartbeats(&self) -> Interval {
        let beat = self.inner.options.lease / HEARTBEATS_A_LEASE;
        let last = self.leased_until.checked_sub(self.inner.options.lease).unwrap_or_else(Instant::now);
        let mut heartbeats = interval_at(last + beat, beat);
        heartbeats.set_missed_tick_behavior(MissedTickBehavior::Delay);
        heartbeats
    }

    /// Keeps the lease and stores progress until the worker reports, if it lives to do so.
    async fn attend(mut self, handle: AttemptHandle) -> Finished {
        // Held, so that the worker begins.
        let AttemptHandle { started: _started, progress: mut reported, report: mut answer } = handle;
        let mut heartbeats = self.heartbeats();
        let mut next_store = Instant::now() + FIRST_PROGRESS;
        let mut news = false;
        let report = loop {
            tokio::select! {
                // In this order: a process that slept through its lease asks the store before it gives up.
                biased;
                report = &mut answer => break report.ok(),
                _ = heartbeats.tick(), if !self.lost => {
                    if !self.heartbeat().await {
                        heartbeats.reset_after(RETRY_PAUSE.min(heartbeats.period()));
                    }
                }
                () = sleep_until(self.leased_until), if !self.lost => self.lapse(),
                Ok(()) = reported.changed(), if !news && !self.lost => news = true,
                () = sleep_until(next_store), if news => {
                    let progress = *reported.borrow_and_update();
                    self.store_progress(progress).await;
                    news = false;
                    next_store = Instant::now() + PROGRESS_PERIOD;
                }
            }
        };
        let latest = *reported.borrow();
        let (end, attempt) = report.unzip();
        self.attempt = attempt;
        Finished::new(self, end.flatten(), latest)
    }

    async fn store_progress(&mut self, progress: Option<Progress>) {
        let Some(progress) = progress else { return };
        let written = self.inner.store.record(&self.lease, &progress, self.inner.now());
        match in_time(self.leased_until, written).await {
            Ok(_) => {
                self.stored = Some(progress);
                self.inner.notifier.wake(&self.job.name);
            }
            Err(error) => self.store_failed(&error),
        }
    }

    /// Returns whether the store answered; a store that does not is asked again soon.
    async fn heartbeat(&mut self) -> bool {
        let sent = Instant::now();
        let until = if sent < self.leased_until { self.leased_until } else { sent + LATE_HEARTBEAT };
        let written = self.inner.store.heartbeat(&self.lease, self.inner.now(), self.inner.options.lease);
        match in_time(until, written).await {
            Ok(heartbeat) => {
                self.leased_until = sent + self.inner.options.lease;
                if heartbeat.cancel_requested {
                    self.stop.stop(StopReason::Cancelled);
                }
                // The wall clock is what was promised; the token's own deadline runs on the other one.
                if heartbeat.deadline.is_some_and(|deadline| deadline <= self.inner.now()) {
                    self.stop.stop(StopReason::DeadlineExceeded);
                }
                true
            }
            Err(error) => {
                self.store_failed(&error);
                false
            }
        }
    }

    /// Ends the attempt where the lease is gone, or may be.
    fn store_failed(&mut self, error: &store::Error) {
        let fenced = matches!(error, store::Error::Fenced(_));
        tracing::warn!(%error, "the store fails");
        if fenced || Instant::now() >= self.leased_until {
            self.lapse();
        }
    }

    /// The lease is gone, or may be: stops the work, whose outcome nobody may write.
    fn lapse(&mut self) {
        self.lost = true;
        self.stop.stop(StopReason::Interrupted);
    }

    /// Ends the job or gives it back, trying again as long as the lease holds. `None`: the lease is gone.
    async fn commit(&mut self, ending: Option<&Arc<Ending>>) -> Option<Job> {
        let store = self.inner.store.clone();
        // Of a write that broke off nobody knows whether it was committed.
        let mut unsure = false;
        while !self.lost {
            let written = match ending {
                Some(ending) => store.finish(&self.lease, ending, self.inner.now()).await,
                None => store.release(&self.lease, self.inner.now()).await,
            };
            match written {
                Ok(job) => return Some(job),
                Err(store::Error::Fenced(_))
                    if unsure && let Some(job) = self.committed(ending.map(Arc::as_ref)).await =>
                {
                    return Some(job);
                }
                Err(error) => self.store_failed(&error),
            }
            unsure = true;
            if !self.lost {
                sleep(RETRY_PAUSE).await;
            }
        }
        None
    }

    /// The job, where it stands as this attempt wanted to leave it.
    async fn committed(&self, ending: Option<&Ending>) -> Option<Job> {
        let job = self.inner.store.job(&self.lease.name).await.ok()?;
        let outcome = &ending?.outcome;
        let failure = match outcome {
            Outcome::Failed(failure) => Some(failure),
            _ => None,
        };
        let is_ours = job.attempt == self.lease.attempt && job.state == outcome.state();
        (is_ours && job.failure.as_ref() == failure).then_some(job)
    }

    fn announce(mut self, committed: Option<Job>) {
        let ended_in = committed.as_ref().map(|job| job.state).filter(|state| state.is_terminal());
        if let Some(attempt) = self.attempt.take() {
            attempt.end(ended_in);
        }
        match (committed, ended_in) {
            (Some(job), Some(state)) => {
                let seconds = job.start_time.zip(job.end_time).and_then(|(start, end)| end.duration_since(start).ok());
                let summary = job.summary.as_ref();
                tracing::info!(
                    tenant = job.name.tenant,
                    attempt = job.attempt,
                    state = state.name(),
                    grade = summary.and_then(|summary| summary.grade).map(Grade::name),
                    focal_px = summary.and_then(|summary| summary.focal_px),
                    seconds = seconds.map(|seconds| seconds.as_secs_f64()),
                    "job ended"
                );
                self.inner.ended(&job);
                self.inner.count_drained(|drained| drained.finished += 1);
            }
            (Some(_), None) => {
                tracing::info!("job given back to the queue");
                observe::attempt_lost(AttemptLost::GivenBack);
                self.inner.count_drained(|drained| drained.given_back += 1);
                self.inner.notifier.wake(&self.job.name);
                self.inner.queue_changed();
            }
            (None, _) => {
                tracing::warn!("lease lost, the outcome is dropped");
                observe::attempt_lost(AttemptLost::Fenced);
                // Its end may have been stored all the same, only the answer was lost.
                self.inner.notifier.wake(&self.job.name);
            }
        }
    }
}

impl Loaded {
    /// Waits until the worker begins with a prefetched job, and tells the store. Returns the attempt with the job that
    /// was prefetched in the same commit; `None` where the job is another worker's by now, or nobody's.
    pub(super) async fn begin(self) -> Option<(Self, Option<Claimed>)> {
        let Self { mut execution, mut handle } = self;
        let begun = (&mut handle.started).await.ok()?;
        let prefetched = (execution.lease.clone(), execution.job.create_time);
        let now = execution.inner.now();
        let claims = execution.inner.claim(Some(prefetched), false, now).instrument(begun.span.clone()).await;
        let Ok(Claims { begun: Some(claimed), prefetched: next, .. }) = claims else {
            execution.lapse();
            // Until then the worker is not free. Its outcome is dropped.
            let _ = handle.report.await;
            return None;
        };
        execution.job = claimed.job;
        execution.has_begun(begun, now);
        Some((Self { execution, handle }, next))
    }

    /// Until the worker is done.
    pub(super) async fn run(self) -> Finished {
        let Self { execution, handle } = self;
        let span = execution.span.clone();
        execution.attend(handle).instrument(span).await
    }
}

impl Finished {
    fn new(mut execution: JobExecution, end: AttemptOutcome, latest: Option<Progress>) -> Self {
        execution.running.set_solved();
        drop(execution.memory.take());
        Self { execution, end, latest }
    }

    /// Commits what the attempt came to.
    pub(super) async fn finalise(self) {
        let Self { mut execution, end, latest } = self;
        let span = execution.span.clone();
        let finalising = async {
            let progress = latest.filter(|_| execution.stored != latest);
            let ending = end.map(|outcome| Arc::new(Ending { outcome, progress }));
            let committed = execution.commit(ending.as_ref()).await;
            execution.announce(committed);
        };
        finalising.instrument(span).await;
    }
}
