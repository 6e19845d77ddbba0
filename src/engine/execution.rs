//! One attempt at a job, from its claim to its end: reads the input, feeds the worker, stores progress, keeps the
//! lease, commits what it came to.

use std::collections::hash_map::Entry;
use std::pin::pin;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use tokio::time::{Instant, Interval, MissedTickBehavior, interval_at, sleep, sleep_until, timeout_at};

use super::ahead::Reserved;
use super::observe::{self, Attempt, AttemptLost};
use super::worker::{Assignment, Heard, Opening, Report, Verdict, Worker};
use super::{Inner, Options, locked};
use crate::domain::job::{Failure, Job, JobName, JobState};
use crate::domain::{Grade, Progress, StopReason, StopToken};
use crate::store::{self, Ending, Lease, Outcome, Store};

/// Least time between two stored progress events of a job: twice a second is as fast as people look, and a commit
/// each is cheap for the disk.
const PROGRESS_PERIOD: Duration = Duration::from_millis(500);

/// How long a job has been solved before its progress is stored: nobody watches one that ends at once, and the commit
/// would cost as much as its end. Its last progress is stored with that.
const FIRST_PROGRESS: Duration = Duration::from_millis(100);

/// Heartbeats within the time of a lease: two may be lost.
const HEARTBEATS_A_LEASE: u32 = 3;

/// How long a late heartbeat may take: one that finds that the lease has run out asks whether it was taken over.
const LATE_HEARTBEAT: Duration = Duration::from_secs(1);

/// Pause before a write is tried again that the store could not take.
const RETRY_PAUSE: Duration = Duration::from_millis(500);

/// `Failure::reason` of a defect of ours.
const INTERNAL: &str = "INTERNAL";

/// Waits for the store no longer than the lease holds: a database that hangs must not keep the work going.
async fn in_time<T>(until: Instant, writing: impl Future<Output = Result<T, store::Error>>) -> Result<T, store::Error> {
    let late = |_| Err(store::Error::Unavailable("no answer as long as the lease held".into()));
    timeout_at(until, writing).await.unwrap_or_else(late)
}

/// The input of a job, with the cancel that may have come before the job was listed as running.
async fn read(store: Arc<dyn Store>, name: JobName, stop: StopToken) -> Result<Vec<u8>, store::Error> {
    let work = store.work(&name).await?;
    if work.cancel_requested {
        stop.stop(StopReason::Cancelled);
    }
    Ok(work.input)
}

/// What an attempt came to, to be committed.
pub(super) struct End {
    pub verdict: Verdict,
    pub latest: Option<Progress>,
    pub attempt: Option<Attempt>,
}

/// What came of the claim of a job that a worker has begun.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Leasing {
    Leased,
    /// It is another's by now, or nobody's.
    Gone,
    /// The store did not take it.
    Failed,
}

/// What a job had behind it when it was claimed.
pub(super) struct Wait {
    pub trace_parent: Option<String>,
    /// When it entered the queue.
    pub queue_time: SystemTime,
}

/// An attempt under way.
pub(super) struct JobExecution {
    inner: Arc<Inner>,
    job: Job,
    lease: Lease,
    wait: Wait,
    stop: StopToken,
    /// Until it is leased.
    reserved: Option<Arc<Reserved>>,
    /// Until then the lease holds for sure.
    leased_until: Instant,
    /// The lease is gone: nothing more is written.
    lost: bool,
    /// The last progress that was stored.
    stored: Option<Progress>,
    _running: Running,
}

/// Lists an attempt among the running ones as long as it lives.
struct Running {
    inner: Arc<Inner>,
    lease: Lease,
    stop: StopToken,
}

impl Running {
    fn list(inner: Arc<Inner>, lease: &Lease, stop: &StopToken) -> Self {
        locked(&inner.running).insert(lease.clone(), stop.clone());
        Self { inner, lease: lease.clone(), stop: stop.clone() }.unless_recalled()
    }

    /// The same, unless another slot has it.
    fn list_new(inner: Arc<Inner>, lease: &Lease, stop: &StopToken) -> Option<Self> {
        if let Entry::Vacant(place) = locked(&inner.running).entry(lease.clone()) {
            place.insert(stop.clone());
        } else {
            return None;
        }
        Some(Self { inner, lease: lease.clone(), stop: stop.clone() }.unless_recalled())
    }

    /// Stops what was claimed while a drain told those that were listed to stop.
    fn unless_recalled(self) -> Self {
        if self.inner.hurried.is_cancelled() {
            self.stop.stop(StopReason::Interrupted);
        }
        self
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let mut running = locked(&self.inner.running);
        // A slot that claimed what this one had only foreseen has its own there.
        if running.get(&self.lease).is_some_and(|listed| listed.is(&self.stop)) {
            running.remove(&self.lease);
        }
    }
}

/// How a job is told to stop, which it does by itself at its deadline.
pub(super) fn stop_token(job: &Job, now: SystemTime) -> StopToken {
    let left = job.deadline.map(|deadline| deadline.duration_since(now).unwrap_or_default());
    // A deadline beyond what the clock can express is none.
    StopToken::with_deadline(left.and_then(|left| std::time::Instant::now().checked_add(left)))
}

impl JobExecution {
    /// Of a job that is leased.
    pub(super) fn begin(inner: Arc<Inner>, job: Job, lease: Lease, wait: Wait) -> Self {
        let stop = stop_token(&job, inner.now());
        let running = Running::list(inner.clone(), &lease, &stop);
        let mut execution = Self::new(inner, job, lease, wait, stop, running);
        let now = execution.inner.now();
        execution.is_leased(Instant::now(), now);
        execution
    }

    /// Of a job that a worker has begun and that is to be leased; `None` where another slot has it.
    ///
    /// * `stop`: ends what the worker has begun
    pub(super) fn foreseen(
        job: Job,
        lease: Lease,
        wait: Wait,
        stop: StopToken,
        reserved: Arc<Reserved>,
    ) -> Option<Self> {
        let inner = reserved.inner().clone();
        let running = Running::list_new(inner.clone(), &lease, &stop)?;
        Some(Self { reserved: Some(reserved), ..Self::new(inner, job, lease, wait, stop, running) })
    }

    fn new(inner: Arc<Inner>, job: Job, lease: Lease, wait: Wait, stop: StopToken, running: Running) -> Self {
        let leased_until = Instant::now();
        Self {
            inner,
            job,
            lease,
            wait,
            stop,
            reserved: None,
            leased_until,
            lost: false,
            stored: None,
            _running: running,
        }
    }

    /// The job was leased, for work that began at this time.
    fn is_leased(&mut self, at: Instant, time: SystemTime) {
        self.leased_until = at + self.inner.options.lease;
        self.inner.hub.wake(&self.job.name);
        observe::waited(&self.job.name, self.wait.trace_parent.as_deref(), self.wait.queue_time, time);
        tracing::info!("attempt begins");
    }

    /// Leases a job that a worker began with at this time; where that fails, nothing of this attempt is written.
    async fn claim(&mut self, at: Instant, time: SystemTime) -> Leasing {
        let Options { worker_name, lease, .. } = &self.inner.options;
        let claimed =
            self.inner.store.claim_foreseen(&self.lease, self.job.create_time, worker_name, time, *lease).await;
        let leasing = match claimed {
            Ok(Some(_)) => Leasing::Leased,
            Ok(None) => Leasing::Gone,
            Err(error) => {
                self.inner.not_claimed(&error);
                Leasing::Failed
            }
        };
        if leasing == Leasing::Leased {
            self.inner.queue_changed();
            self.is_leased(at, time);
        } else {
            self.lapse();
        }
        self.reserved = None;
        leasing
    }

    /// Has the worker solve the job, and keeps the lease meanwhile.
    pub(super) async fn run(&mut self, worker: &Worker, attempt: Attempt, input: Vec<u8>) -> End {
        let subscription = self.inner.hub.subscribe(&self.job.name);
        // Weights of an attempt before this one are nobody's any more.
        subscription.topic().weights.send_replace(None);
        let opening = Opening::Begun(attempt);
        let (assignment, heard) =
            Assignment::new(&self.job, self.lease.attempt, opening, input, self.stop.clone(), subscription);
        worker.assign(assignment).await;
        self.attend(heard).await
    }

    /// Leases a job that a worker began with at this time, and keeps the lease until it is solved.
    pub(super) async fn run_foreseen(&mut self, at: Instant, time: SystemTime, heard: Heard) -> (Leasing, End) {
        let leasing = self.claim(at, time).await;
        (leasing, self.attend(heard).await)
    }

    /// Reads the input, and the cancel that may have come before the job was listed as running. A store that is out
    /// of reach is asked again as long as the lease holds, which heartbeats keep while a large input is read.
    pub(super) async fn prepare(&mut self) -> Result<Vec<u8>, Verdict> {
        loop {
            let mut reading = pin!(read(self.inner.store.clone(), self.job.name.clone(), self.stop.clone()));
            let mut heartbeats = self.heartbeats();
            let input = loop {
                tokio::select! {
                    biased;
                    input = &mut reading => break input,
                    _ = heartbeats.tick(), if !self.lost => {
                        self.heartbeat().await;
                    }
                }
            };
            match input {
                Ok(input) if !self.lost => return Ok(input),
                Ok(_) => {}
                Err(error @ store::Error::Unavailable(_)) => self.store_failed(&error),
                Err(error) => return Err(Verdict::Broken(error.to_string())),
            }
            if self.lost {
                return Err(Verdict::Stopped(StopReason::Interrupted));
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
    async fn attend(&mut self, heard: Heard) -> End {
        let Heard { progress: mut reported, report: mut answer } = heard;
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
        match report {
            Some(Report { verdict, attempt }) => End { verdict, latest, attempt: Some(attempt) },
            None => End { verdict: Verdict::Stopped(StopReason::Interrupted), latest, attempt: None },
        }
    }

    async fn store_progress(&mut self, progress: Option<Progress>) {
        let Some(progress) = progress else { return };
        let written = self.inner.store.record(&self.lease, &progress, self.inner.now());
        match in_time(self.leased_until, written).await {
            Ok(_) => {
                self.stored = Some(progress);
                self.inner.hub.wake(&self.job.name);
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

    /// Commits what the attempt came to.
    pub(super) async fn conclude(mut self, end: End) {
        let End { verdict, latest, attempt } = end;
        let outcome = match verdict {
            Verdict::Solved { summary, result } => Some(Outcome::Succeeded { summary, result }),
            Verdict::Broken(message) => Some(Outcome::Failed(Failure::new(INTERNAL, message))),
            Verdict::Stopped(StopReason::Cancelled) => Some(Outcome::Cancelled),
            Verdict::Stopped(StopReason::DeadlineExceeded) => Some(Outcome::DeadlineExceeded),
            Verdict::Stopped(StopReason::Interrupted) => None,
        };
        let progress = latest.filter(|_| self.stored != latest);
        let ending = outcome.map(|outcome| Arc::new(Ending { outcome, progress }));
        let committed = self.commit(ending.as_ref()).await;
        self.announce(committed, attempt);
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
        let (state, failure) = match &ending?.outcome {
            Outcome::Succeeded { .. } => (JobState::Succeeded, None),
            Outcome::Failed(failure) => (JobState::Failed, Some(failure)),
            Outcome::Cancelled => (JobState::Cancelled, None),
            Outcome::DeadlineExceeded => (JobState::DeadlineExceeded, None),
        };
        let ours = job.attempt == self.lease.attempt && job.state == state && job.failure.as_ref() == failure;
        ours.then_some(job)
    }

    fn announce(self, committed: Option<Job>, attempt: Option<Attempt>) {
        let ended_in = committed.as_ref().map(|job| job.state).filter(|state| state.is_terminal());
        if let Some(attempt) = attempt {
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
                self.inner.crew_finished_one();
            }
            (Some(_), None) => {
                tracing::info!("job given back to the queue");
                observe::attempt_lost(AttemptLost::GivenBack);
                self.inner.crew_gave_one_back();
                self.inner.hub.wake(&self.job.name);
                self.inner.queue_changed();
            }
            (None, _) => {
                tracing::warn!("lease lost, the outcome is dropped");
                observe::attempt_lost(AttemptLost::Fenced);
            }
        }
    }
}
