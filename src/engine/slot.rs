//! The tasks that run beside the worker threads: one slot a worker, which claims jobs for it, and the sweeper.

use std::pin::pin;
use std::sync::Arc;
use std::time::Duration;

use tokio::task::JoinHandle;
use tokio::time::{Instant, sleep, sleep_until, timeout, timeout_at};

use super::ahead::Ahead;
use super::attempt::{self, Ran, Ready};
use super::worker::Worker;
use super::{Inner, Phase, StoreState, locked, observe};
use crate::store;

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

/// Claims jobs for one worker, one after the other, until the engine drains. While what a job came to is committed, the
/// next one is claimed, so that the worker waits for one commit of the store, not for two, and the store may make one
/// of both. After a short job it waits for none: see [`solve`].
pub(super) async fn run(inner: Arc<Inner>, worker: Worker) {
    let mut work = inner.work.subscribe();
    let mut phase = inner.phase.subscribe();
    let mut committing: Option<Committing> = None;
    let mut ahead: Option<Ahead> = None;
    while *phase.borrow_and_update() == Phase::Open {
        // Before the look, so that a job that is stored during it is not missed.
        work.mark_unchanged();
        let ready = match ahead.take() {
            Some(ahead) => Some(Ready::Foreseen(Box::new(ahead))),
            None => claim(&inner).await,
        };
        let Some(ready) = ready else {
            tokio::select! {
                biased;
                _ = work.changed() => {}
                _ = phase.changed() => {}
                () = sleep(CLAIM_POLL) => {}
            }
            continue;
        };
        let ran;
        (ran, ahead) = solve(&inner, &worker, ready).await;
        match ran {
            Ran::Done(done) => {
                if let Some(mut before) = committing.replace(Committing(done.commit())) {
                    // Results that the store cannot take must not pile up, nor are jobs begun that it may not lease.
                    if timeout(inner.options.short_job, before.done()).await.is_err() {
                        ahead = None;
                        before.done().await;
                    }
                }
            }
            Ran::Gone => {}
            // Where the store takes no writes, the next claim says so, and waits.
            Ran::NotLeased => ahead = None,
        }
        if worker.is_gone() {
            tracing::error!("a worker thread is gone, its slot ends");
            break;
        }
    }
    // Nobody is going to lease it.
    drop(ahead);
    if let Some(mut last) = committing {
        last.done().await;
    }
}

/// The next job, leased; `None` where none waits.
async fn claim(inner: &Arc<Inner>) -> Option<Ready> {
    let options = &inner.options;
    match inner.store.claim(&options.worker_name, inner.now(), options.lease).await {
        Ok(claimed) => {
            let claimed = claimed?;
            // Whoever has foreseen it need not begin it.
            locked(&inner.foreseen).remove(&claimed.job.name);
            inner.queue_changed();
            Some(attempt::begin(inner, claimed).await)
        }
        Err(error) => {
            inner.not_claimed(&error);
            None
        }
    }
}

/// Has a job solved. Returns what it came to; and where it was a short one, the next one, which the worker begins with
/// by itself before it is even leased.
///
/// Not where other processes take jobs from the same store: two would often begin the same one.
async fn solve(inner: &Arc<Inner>, worker: &Worker, ready: Ready) -> (Ran, Option<Ahead>) {
    let mut looks = !inner.store.is_shared();
    let mut ahead = None;
    let too_long = Instant::now() + inner.options.short_job;
    let mut solving = pin!(ready.run(worker));
    // Let go once it takes too long: it holds one of the store's few readers.
    let mut looking = pin!(async { timeout_at(too_long, Ahead::look(inner, worker)).await.ok().flatten() });
    loop {
        tokio::select! {
            biased;
            ran = &mut solving => return (ran, ahead),
            found = &mut looking, if looks => (looks, ahead) = (false, found),
            // By the time that it ends others may have come, or this one gone.
            () = sleep_until(too_long), if ahead.is_some() => ahead = None,
        }
    }
}

/// The end of a job on its way to the store; given up with the slot that waits for it.
struct Committing(JoinHandle<()>);

impl Committing {
    async fn done(&mut self) {
        // It only breaks off by a panic, which has been reported; the lease runs out.
        let _ = (&mut self.0).await;
    }
}

impl Drop for Committing {
    fn drop(&mut self) {
        self.0.abort();
    }
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
                if *inner.store_state.borrow() == StoreState::Away {
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
        match inner.store.load().await {
            Ok(load) => {
                observe::queue_depth(load.queued);
                if std::mem::replace(&mut paused, load.paused) != load.paused {
                    pause_changed(load.paused);
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
    pub(super) fn not_claimed(&self, error: &store::Error) {
        if self.store.has_room() {
            tracing::warn!(%error, "cannot claim a job");
        } else {
            tracing::debug!(%error, "cannot claim a job");
        }
    }

    /// Notes what became of the store, for those who ask whether this server is of any use.
    fn store_is(&self, state: StoreState) {
        let mut before = state;
        // Those who follow it hear of changes alone: each would tell its own followers.
        let changed = self.store_state.send_if_modified(|known| {
            before = std::mem::replace(known, state);
            before != state
        });
        if !changed {
            return;
        }
        observe::store_state(state);
        // Of a full disk the store itself tells.
        if state == StoreState::Away {
            tracing::error!("the store is out of reach, this server is not ready");
        } else if before == StoreState::Away {
            tracing::info!("the store is back, this server is ready again");
        }
    }

    pub(super) async fn sweep(&self) {
        let swept = self.store.sweep(self.now(), self.options.max_attempts).await;
        self.store_is(match &swept {
            Err(store::Error::Unavailable(_)) => StoreState::Away,
            _ if self.store.has_room() => StoreState::Sound,
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
