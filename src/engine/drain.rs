//! Hiring the workers at the start, and letting them go at the end.

use std::sync::Arc;
use std::thread;
use std::time::Duration;

use tokio::sync::mpsc;
use tokio::task::JoinHandle;
use tokio::time::timeout;

use super::worker::Worker;
use super::{Error, Inner, Phase, ResultEncoder, Solver, locked, slot, webhooks};
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
    slots: Vec<JoinHandle<()>>,
    sweeper: Option<JoinHandle<()>>,
    /// Handles the notifications of other processes, where there are any.
    notifications: Option<JoinHandle<()>>,
    /// Delivers webhooks, where they are on.
    webhooks: Option<JoinHandle<()>>,
    threads: Vec<thread::JoinHandle<()>>,
    /// Closes when the last thread has ended.
    threads_ended: Option<mpsc::Receiver<()>>,
    drained: Drained,
}

/// Worker threads that nobody feeds yet.
pub(super) struct Threads {
    pub workers: Vec<Worker>,
    pub threads: Vec<thread::JoinHandle<()>>,
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
        let (workers, threads) = (0..count).map(start).collect::<Result<Vec<_>, _>>()?.into_iter().unzip();
        Ok(Self { workers, threads, ended })
    }
}

impl Inner {
    /// Starts the slots of these workers and the sweeper.
    pub(super) fn hire(self: &Arc<Self>, threads: Threads) -> Result<(), Error> {
        let Threads { workers, threads, ended } = threads;
        let mut pool = WorkerPool { threads, threads_ended: Some(ended), ..WorkerPool::default() };
        pool.slots = workers.into_iter().map(|worker| tokio::spawn(slot::run(self.clone(), worker))).collect();
        pool.sweeper = Some(tokio::spawn(slot::sweep(self.clone())));
        if self.store.is_shared() {
            pool.notifications = Some(tokio::spawn(super::notifications::run(self.clone())));
        }
        if let Some(options) = &self.options.webhooks {
            pool.webhooks = Some(webhooks::start(self, options).map_err(Error::Internal)?);
        }
        *locked(&self.pool) = pool;
        Ok(())
    }

    pub(super) fn attempt_finished(&self) {
        if self.phase() != Phase::Open {
            locked(&self.pool).drained.finished += 1;
        }
    }

    pub(super) fn attempt_given_back(&self) {
        if self.phase() != Phase::Open {
            locked(&self.pool).drained.given_back += 1;
        }
    }

    pub(super) async fn drain(self: Arc<Self>, bound: Duration) -> Drained {
        let begun = self.phase.send_if_modified(|phase| {
            let first = *phase == Phase::Open;
            if first {
                *phase = Phase::Draining;
            }
            first
        });
        if !begun {
            return Drained::default();
        }
        let (mut slots, others, threads, threads_ended) = {
            let mut pool = locked(&self.pool);
            let slots = std::mem::take(&mut pool.slots);
            let others = [pool.sweeper.take(), pool.notifications.take(), pool.webhooks.take()];
            (slots, others, std::mem::take(&mut pool.threads), pool.threads_ended.take())
        };
        let in_time = timeout(bound, all_ended(&mut slots));
        if !matches!(self.interrupted.run_until_cancelled(in_time).await, Some(Ok(()))) {
            // Before the look: whoever is listed after it finds this.
            self.interrupted.cancel();
            for listed in locked(&self.running).values() {
                listed.stop.stop(StopReason::Interrupted);
            }
            if timeout(GIVE_BACK_GRACE, all_ended(&mut slots)).await.is_err() {
                // Their leases run out, or are taken back at the next start.
                tracing::warn!("jobs did not stop within {GIVE_BACK_GRACE:?}, their leases are left behind");
                slots.iter().for_each(JoinHandle::abort);
            }
        }
        self.phase.send_replace(Phase::Closed);
        let mut others: Vec<JoinHandle<()>> = others.into_iter().flatten().collect();
        let (others_ended, ()) =
            tokio::join!(timeout(GIVE_BACK_GRACE, all_ended(&mut others)), join(threads, threads_ended));
        if others_ended.is_err() {
            // They wait for a store or a receiver that hangs, and have nothing that another server or the next start
            // would miss.
            others.iter().for_each(JoinHandle::abort);
        }
        locked(&self.pool).drained
    }
}

/// Waits for the tasks that are left; dropping the future keeps those that have not ended.
async fn all_ended(tasks: &mut Vec<JoinHandle<()>>) {
    while let Some(task) = tasks.last_mut() {
        // One ends early only by a panic, which has been reported; the lease of a slot runs out.
        let _ = task.await;
        tasks.pop();
    }
}

/// Joins the worker threads; one that does not stop is left to the end of the process.
async fn join(threads: Vec<thread::JoinHandle<()>>, ended: Option<mpsc::Receiver<()>>) {
    let Some(mut ended) = ended else { return };
    if timeout(GIVE_BACK_GRACE, ended.recv()).await.is_err() {
        tracing::warn!("a worker thread does not stop");
        return;
    }
    for thread in threads {
        // Panics of the solver are caught inside.
        let _ = thread.join();
    }
}
