//! Starting the workers, and ending them in a drain.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio::time::timeout;

use super::worker::Worker;
use super::{Engine, Error, Inner, Phase, ResultEncoder, Solver, locked, slot, webhooks};
use crate::domain::StopReason;

/// How long a job that was asked to stop may take to do so: ten times the solver's promise of 200 ms, and a slow disk.
const GIVE_BACK_GRACE: Duration = Duration::from_secs(5);

/// What a drain came to.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Drained {
    /// Jobs that ran when the drain began and reached their end.
    pub finished: usize,
    /// Jobs that returned to the queue.
    pub given_back: usize,
}

/// Those who work for an engine, and what they did since its drain began.
#[derive(Debug, Default)]
pub(super) struct WorkerPool {
    /// The slots of the workers.
    slots: JoinSet<()>,
    /// What else runs beside them: the sweeper, the handler of notifications, the sender of webhooks.
    others: JoinSet<()>,
    /// Closes when the last thread has ended.
    threads_ended: Option<mpsc::Receiver<()>>,
    drained: Drained,
}

/// Worker threads that nobody feeds yet.
pub(super) struct Threads {
    pub workers: Vec<Worker>,
    /// Closes when the last thread has ended.
    pub ended: mpsc::Receiver<()>,
}

impl Threads {
    /// So many, each with the solver.
    pub(super) fn start(count: usize, solver: &Solver, encode: ResultEncoder) -> Result<Self, Error> {
        let (alive, ended) = mpsc::channel(1);
        let start = |index| {
            Worker::start(index, solver.clone(), encode, alive.clone())
                .map_err(|error| Error::Internal(format!("cannot start worker thread {index}: {error}")))
        };
        Ok(Self { workers: (0..count).map(start).collect::<Result<_, _>>()?, ended })
    }
}

impl Inner {
    /// Starts the slots of these workers and the sweeper.
    pub(super) fn start_workers(self: &Arc<Self>, threads: Threads) -> Result<(), Error> {
        let mut pool = WorkerPool { threads_ended: Some(threads.ended), ..WorkerPool::default() };
        for worker in threads.workers {
            pool.slots.spawn(slot::run(self.clone(), worker));
        }
        pool.others.spawn(slot::sweep(self.clone()));
        if self.store.is_shared() {
            pool.others.spawn(super::notifications::run(self.clone()));
        }
        if let Some(options) = &self.options.webhooks {
            let sender = webhooks::Sender::new(options.clone()).map_err(Error::Internal)?;
            pool.others.spawn(webhooks::run(self.clone(), Arc::new(sender)));
        }
        *locked(&self.pool) = pool;
        Ok(())
    }

    /// Counts an attempt that is over, where a drain has begun.
    pub(super) fn count_drained(&self, count: impl FnOnce(&mut Drained)) {
        if self.phase() != Phase::Open {
            count(&mut locked(&self.pool).drained);
        }
    }
}

impl Engine {
    /// Stops claiming, lets what runs finish within `bound`, gives the rest back to the queue, ends the workers and
    /// the watchers. A second call returns at once with nothing done.
    pub async fn drain(&self, bound: Duration) -> Drained {
        let inner = &self.inner;
        let begun = inner.phase.send_if_modified(|phase| {
            let first = *phase == Phase::Open;
            if first {
                *phase = Phase::Draining;
            }
            first
        });
        if !begun {
            return Drained::default();
        }
        let (mut slots, mut others, threads_ended) = {
            let mut pool = locked(&inner.pool);
            (std::mem::take(&mut pool.slots), std::mem::take(&mut pool.others), pool.threads_ended.take())
        };
        let in_time = timeout(bound, all_ended(&mut slots));
        if !matches!(inner.interrupted.run_until_cancelled(in_time).await, Some(Ok(()))) {
            // Before the look: whoever is listed after it finds this.
            inner.interrupted.cancel();
            for listed in locked(&inner.running).values() {
                listed.stop.stop(StopReason::Interrupted);
            }
            if timeout(GIVE_BACK_GRACE, all_ended(&mut slots)).await.is_err() {
                // Their leases run out, or are taken back at the next start.
                tracing::warn!("jobs did not stop within {GIVE_BACK_GRACE:?}, their leases are left behind");
                slots.abort_all();
            }
        }
        inner.phase.send_replace(Phase::Closed);
        // Those that do not end in time wait for a store or a receiver that hangs. Dropping the set aborts them: neither
        // another server nor the next start needs them.
        let others_ended = timeout(GIVE_BACK_GRACE, all_ended(&mut others));
        let _ = tokio::join!(others_ended, threads_end(threads_ended));
        locked(&inner.pool).drained
    }
}

/// Waits for the tasks that are left; dropping the future keeps those that have not ended.
async fn all_ended(tasks: &mut JoinSet<()>) {
    // One ends early only by a panic, which has been reported; the lease of a slot runs out.
    while tasks.join_next().await.is_some() {}
}

/// Waits for the worker threads; one that does not stop is left to the end of the process.
async fn threads_end(ended: Option<mpsc::Receiver<()>>) {
    let Some(mut ended) = ended else { return };
    if timeout(GIVE_BACK_GRACE, ended.recv()).await.is_err() {
        tracing::warn!("a worker thread does not stop");
    }
}
