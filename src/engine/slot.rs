//! The tasks that run beside the worker threads: one slot a worker, which claims jobs for it, and the sweeper.

use std::pin::pin;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use tokio::sync::watch as channel;
use tokio::time::{Instant, sleep, sleep_until, timeout};
use tokio_util::task::AbortOnDropHandle;

use super::execution::{Finished, HEARTBEATS_A_LEASE, JobExecution, Loaded, RETRY_PAUSE, in_time};
use super::limits::suspect_after;
use super::worker::Worker;
use super::{Inner, Options, Phase, StoreState, observe};
use crate::store::{self, Claim, Claimed, Claims, Lease, Prefetch};

/// How often a slot looks for work unasked: jobs of other processes and of a store that failed come without a wake-up.
const CLAIM_POLL: Duration = Duration::from_secs(1);

/// How often leases and deadlines are looked over: a queued job expires at most this late.
const SWEEP_PERIOD: Duration = Duration::from_secs(1);

/// Least time between two counts of the queue: each goes through all of it, and dashboards look every few seconds.
const COUNT_PERIOD: Duration = Duration::from_millis(200);

/// How often operators are told what takes longer to count, such as each tenant's jobs: three times a usual scrape.
const STATS_PERIOD: Duration = Duration::from_secs(5);

/// Jobs that one sweep removes at most, in one transaction: at one sweep a second more than any server solves, and
/// writers wait for some hundred megabytes at worst.
const PURGE_BATCH: u32 = 32;

/// Observations of a job beyond which it is not prefetched, some 2 MB of input: none that large is solved in the time
/// that prefetching is for.
const MAX_PREFETCH_OBSERVATIONS: u32 = 100_000;

/// Claims jobs for one worker, one after the other, until the engine drains. While what a job came to is committed, the
/// next one is claimed, so that the worker waits for one commit of the store, not for two, and the store may make one
/// of both. After a short job it waits for none: the next one is prefetched.
pub(super) async fn run(inner: Arc<Inner>, worker: Worker) {
    let mut work = inner.work.subscribe();
    let mut phase = inner.phase.subscribe();
    // Aborted with the slot, like the prefetched job.
    let mut committing: Option<AbortOnDropHandle<()>> = None;
    let mut prefetched: Option<Prefetched> = None;
    while *phase.borrow_and_update() == Phase::Open {
        // Before the look, so that a job that is stored during it is not missed.
        work.mark_unchanged();
        let (loaded, next) = match prefetched.take() {
            Some(loading) => match begin(loading).await {
                Some((loaded, next)) => (Ok(loaded), next),
                None => continue,
            },
            None => match claim(&inner, &mut phase).await {
                Some((execution, next)) => (execution.load(&worker).await, next),
                None if inner.phase() == Phase::Open => {
                    tokio::select! {
                        biased;
                        _ = work.changed() => {}
                        _ = phase.changed() => {}
                        () = sleep(CLAIM_POLL) => {}
                    }
                    continue;
                }
                None => continue,
            },
        };
        prefetched = next.and_then(|next| prefetch(&inner, &worker, next));
        let finished = match loaded {
            Ok(loaded) => solve(loaded, inner.options.short_job, &mut prefetched).await,
            Err(finished) => finished,
        };
        if let Some(mut before) = committing.replace(AbortOnDropHandle::new(tokio::spawn(finished.finalise()))) {
            // Results that the store cannot take must not pile up, nor are jobs begun that it may not lease.
            // The task fails only by a panic, which has been reported; its lease runs out.
            if timeout(inner.options.short_job, &mut before).await.is_err() {
                prefetched = None;
                let _ = before.await;
            }
        }
        if worker.is_gone() {
            tracing::error!("a worker thread is gone, its slot ends");
            break;
        }
    }
    // Nobody is going to begin it.
    drop(prefetched);
    if let Some(last) = committing {
        let _ = last.await;
    }
}

/// Claims the next job, and the one after it. Waits as long as a suspect runs in this process or waits for that, or a
/// job waits for memory. `None`: there is none to begin, or the engine drains.
async fn claim(inner: &Arc<Inner>, phase: &mut channel::Receiver<Phase>) -> Option<(JobExecution, Option<Claimed>)> {
    let permit = tokio::select! {
        biased;
        _ = phase.changed() => return None,
        permit = inner.limits.acquire() => permit?,
    };
    let claims = inner.claim(None, false, inner.now()).await.ok()?;
    if let Some(suspect) = claims.suspect {
        drop(permit);
        return Some((begin_suspect(inner, &suspect, phase).await?, None));
    }
    Some((JobExecution::new(inner.clone(), claims.begun?, inner.options.lease, permit), claims.prefetched))
}

/// Begins a suspect once nothing else runs in this process. Until then it is queued and leased: an attempt that waits
/// would be lost with those that run. A store that fails is asked again as long as the lease holds. `None`: the suspect
/// is left to others, because it is another's by now or nobody's, another suspect waits here, or the engine drains.
async fn begin_suspect(
    inner: &Arc<Inner>,
    suspect: &Claimed,
    phase: &mut channel::Receiver<Phase>,
) -> Option<JobExecution> {
    let begin = (suspect.lease.clone(), suspect.job.create_time);
    let Some(_waits) = inner.limits.try_acquire_suspect() else {
        inner.give_back(begin).await;
        return None;
    };
    tracing::warn!(job = %suspect.job.name, attempts = suspect.job.attempt, "job lost attempts; it runs alone");
    let lease = inner.options.lease;
    let heartbeat = lease / HEARTBEATS_A_LEASE;
    let (mut leased_until, mut pause) = (Instant::now() + lease, heartbeat);
    let mut waiting = pin!(inner.limits.acquire_exclusive());
    let mut permit = None;
    while Instant::now() < leased_until {
        tokio::select! {
            biased;
            _ = phase.changed() => {
                inner.give_back(begin).await;
                return None;
            }
            alone = &mut waiting, if permit.is_none() => permit = Some(alone?),
            () = sleep(pause) => {}
        }
        let asked = Instant::now();
        match in_time(leased_until, inner.claim(Some(begin.clone()), permit.is_some(), inner.now())).await {
            Ok(Claims { begun: Some(claimed), .. }) => {
                return Some(JobExecution::new(inner.clone(), claimed, lease, permit?));
            }
            Ok(Claims { suspect: Some(_), .. }) => (leased_until, pause) = (asked + lease, heartbeat),
            Ok(_) => return None,
            Err(_) => pause = heartbeat.min(RETRY_PAUSE),
        }
    }
    None
}

/// A job on its way into the worker's hands. Dropped, it is not begun, and its lease lapses.
type Prefetched = AbortOnDropHandle<Option<Loaded>>;

/// Loads a prefetched job, unless a suspect waits for those that run.
fn prefetch(inner: &Arc<Inner>, worker: &Worker, claimed: Claimed) -> Option<Prefetched> {
    let execution = JobExecution::new(inner.clone(), claimed, inner.prefetch_lease(), inner.limits.try_acquire()?);
    let worker = worker.clone();
    // One that cannot be read is told of when it is claimed.
    Some(AbortOnDropHandle::new(tokio::spawn(async move { execution.load(&worker).await.ok() })))
}

/// Begins with a prefetched job; `None` where it is not to be had any more.
async fn begin(loading: Prefetched) -> Option<(Loaded, Option<Claimed>)> {
    loading.await.ok()??.begin().await
}

/// Has a job solved. Where it is no short one, what is prefetched behind it is left to others.
async fn solve(loaded: Loaded, short_job: Duration, prefetched: &mut Option<Prefetched>) -> Finished {
    let mut solving = pin!(loaded.run());
    if let Ok(finished) = timeout(short_job, &mut solving).await {
        return finished;
    }
    *prefetched = None;
    solving.await
}

/// Ends what waited too long, takes back what was left lying, and counts the queue whenever it changed.
pub(super) async fn sweep(inner: Arc<Inner>) {
    let mut phase = inner.phase.subscribe();
    let mut ticks = tokio::time::interval(SWEEP_PERIOD);
    let mut counted = Instant::now();
    let mut paused = false;
    let mut stats_due = Instant::now();
    ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    while *phase.borrow_and_update() != Phase::Closed {
        tokio::select! {
            biased;
            _ = phase.changed() => {}
            () = due(&inner, counted) => {}
            _ = ticks.tick() => {
                inner.sweep().await;
                if *inner.store_state.borrow() == StoreState::Unavailable {
                    // Each further question would take its time to come to nothing, and the next look is due.
                    continue;
                }
                inner.tidy().await;
                if stats_due <= Instant::now() {
                    stats_due = Instant::now() + STATS_PERIOD;
                    match inner.store.stats().await {
                        Ok(stats) => observe::store_stats(stats, inner.now()),
                        Err(error) => tracing::warn!(%error, "cannot count the jobs of tenants"),
                    }
                }
            }
        }
        counted = Instant::now();
        match inner.store.queue_stats().await {
            Ok(stats) => {
                observe::queue_depth(stats.queued);
                if std::mem::replace(&mut paused, stats.paused) != stats.paused {
                    pause_changed(stats.paused);
                }
            }
            Err(error) => tracing::warn!(%error, "cannot count the queue"),
        }
    }
}

/// Says that the queue was paused or resumed, on whichever server, or is paused at the start.
fn pause_changed(paused: bool) {
    observe::queue_paused(paused);
    if paused {
        tracing::warn!("the queue is paused: no server of the store begins a job until it is resumed");
    } else {
        tracing::info!("the queue is resumed");
    }
}

/// Waits until the queue is to be counted: it changed, and the last count is old enough.
async fn due(inner: &Inner, counted: Instant) {
    inner.queue_changed.notified().await;
    sleep_until(counted + COUNT_PERIOD).await;
}

impl Inner {
    /// Begins with the next job in the queue, or with one that was prefetched, and prefetches the one after it.
    /// `alone`: nothing else runs in this process, nor is anything to be prefetched; else a suspect is only leased.
    /// Errors are logged.
    pub(super) async fn claim(
        &self,
        begin: Option<(Lease, SystemTime)>,
        alone: bool,
        now: SystemTime,
    ) -> Result<Claims, store::Error> {
        let claim = self.terms(begin, alone);
        let claims = self.store.claim(&claim, now).await.inspect_err(|error| self.not_claimed(error))?;
        if claims.begun.is_some() {
            self.queue_changed();
        }
        Ok(claims)
    }

    /// Leaves a suspect to other processes before its lease runs out.
    async fn give_back(&self, suspect: (Lease, SystemTime)) {
        let claim = Claim { lease_for: Duration::ZERO, ..self.terms(Some(suspect), false) };
        if let Err(error) = self.store.claim(&claim, self.now()).await {
            self.not_claimed(&error);
        }
    }

    /// What [`Inner::claim`] asks the store for.
    fn terms(&self, begin: Option<(Lease, SystemTime)>, alone: bool) -> Claim {
        let Options { worker_name, lease, shares, short_job, max_attempts, .. } = &self.options;
        let prefetch = Prefetch { lease_for: self.prefetch_lease(), max_observations: MAX_PREFETCH_OBSERVATIONS };
        Claim {
            worker: worker_name.clone(),
            lease_for: *lease,
            begin,
            prefetch: (!alone && !short_job.is_zero()).then_some(prefetch),
            shares: shares.clone(),
            solved: if shares.max_running.is_some() { self.solved() } else { Vec::new() },
            suspect_after: (!alone).then(|| suspect_after(*max_attempts)),
        }
    }

    /// How long a prefetched job is kept for its worker: until that has been at the job before it for too long to be
    /// waited for, and has told the store of its begin.
    fn prefetch_lease(&self) -> Duration {
        self.options.short_job.saturating_mul(2)
    }

    /// Removes jobs that have been kept long enough, and gives back the space of what was removed.
    async fn tidy(&self) {
        if let Some(ended_by) = self.options.retention.and_then(|kept| self.now().checked_sub(kept)) {
            match self.store.purge(ended_by, PURGE_BATCH).await {
                Ok(0) => {}
                Ok(removed) => {
                    tracing::info!(removed, "removed jobs that were kept long enough");
                    observe::jobs_deleted(observe::Deletion::Retention, removed);
                }
                Err(error) => tracing::warn!(%error, "cannot remove old jobs"),
            }
        }
        self.tidy_uploads().await;
        if let Err(error) = self.store.reclaim().await {
            tracing::warn!(%error, "cannot give back the space of removed jobs");
        }
    }

    /// Says why no job is begun. Of a full disk the store has told, once: here it would be told every second.
    fn not_claimed(&self, error: &store::Error) {
        if self.store.has_room() {
            tracing::warn!(%error, "cannot claim a job");
        } else {
            tracing::debug!(%error, "cannot claim a job");
        }
    }

    /// Notes what became of the store, for those who ask whether this server is of any use.
    fn store_is(&self, state: StoreState) {
        let mut before = state;
        // Subscribers get changes alone: each passes them on to subscribers of its own.
        let changed = self.store_state.send_if_modified(|known| {
            before = std::mem::replace(known, state);
            before != state
        });
        if !changed {
            return;
        }
        observe::store_state(state);
        // Of a full disk the store itself logs.
        if state == StoreState::Unavailable {
            tracing::error!("the store is out of reach, this server is not ready");
        } else if before == StoreState::Unavailable {
            tracing::info!("the store is back, this server is ready again");
        }
    }

    pub(super) async fn sweep(&self) {
        let swept = self.store.sweep(self.now(), self.options.max_attempts).await;
        self.store_is(match &swept {
            Err(store::Error::Unavailable(_)) => StoreState::Unavailable,
            _ if self.store.has_room() => StoreState::Healthy,
            _ => StoreState::Full,
        });
        match swept {
            Ok(swept) => {
                self.taken_back(&swept.lost);
                for job in &swept.expired {
                    tracing::info!(job = %job.name, "expired while queued");
                    self.ended(job);
                }
            }
            Err(error) => tracing::warn!(%error, "cannot sweep the queue"),
        }
    }
}
