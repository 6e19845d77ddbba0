//! One simulated server: an engine on a runtime of its own.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::runtime::{Builder, Runtime};
use tokio::sync::mpsc;
use tokio::task::JoinHandle;
use tokio::time::sleep;

use super::check::result_of;
use super::{MAX_ATTEMPTS, MAX_JOBS, Plan};
use crate::domain::job::JobName;
use crate::engine::drain::Threads;
use crate::engine::tests::{input, progress, solution};
use crate::engine::worker::{Assigned, Worker};
use crate::engine::{Drained, Engine, Error, Options};
use crate::store::TenantShares;
use crate::store::tests::simulated::{Faults, Link, Simulated};

/// What becomes of a job, by its settings' seed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum JobBehavior {
    Succeed,
    Fail,
    /// The process dies of it.
    Kill,
}

impl JobBehavior {
    pub(super) fn of(seed: u64) -> Self {
        match seed % 10 {
            0 => Self::Fail,
            1 => Self::Kill,
            _ => Self::Succeed,
        }
    }

    /// How long a worker is busy with the job.
    pub(super) fn duration(seed: u64) -> Duration {
        // Many that are short, and some that outlast a lease.
        let milliseconds = seed / 10 % 8_000;
        Duration::from_millis(if (seed / 100_000).is_multiple_of(4) { milliseconds } else { milliseconds / 80 })
    }
}

/// The jobs that workers of all servers solve now.
#[derive(Debug, Clone, Default)]
pub(super) struct Solving(Arc<Mutex<Vec<JobName>>>);

impl Solving {
    pub(super) fn jobs(&self) -> Vec<JobName> {
        self.locked().clone()
    }

    /// One more, until the guard is dropped, as it is when its server dies.
    fn begin(&self, name: &JobName) -> Solved {
        self.locked().push(name.clone());
        Solved { name: name.clone(), solving: self.clone() }
    }

    fn locked(&self) -> MutexGuard<'_, Vec<JobName>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Takes a job from what is solved when dropped.
struct Solved {
    name: JobName,
    solving: Solving,
}

impl Drop for Solved {
    fn drop(&mut self) {
        let mut jobs = self.solving.locked();
        if let Some(place) = jobs.iter().position(|name| *name == self.name) {
            jobs.remove(place);
        }
    }
}

pub(super) struct Server {
    runtime: Runtime,
    link: Arc<Mutex<Link>>,
    starting: Option<JoinHandle<Result<Engine, Error>>>,
    engine: Option<Engine>,
    draining: Option<JoinHandle<Drained>>,
    /// A job has ended the process.
    dead: Arc<AtomicBool>,
}

impl Server {
    /// Starts a server, which is up some steps later, or gone.
    pub(super) fn start<const SHARED: bool>(
        number: u64,
        connect: impl FnOnce() -> Simulated<SHARED>,
        plan: Plan,
        solving: Solving,
    ) -> Self {
        let runtime = Builder::new_current_thread().enable_time().start_paused(true).build().expect("a runtime");
        let dead = Arc::new(AtomicBool::new(false));
        let entered = runtime.enter();
        let store = connect();
        let link = store.link();
        let mut options = Options {
            workers: plan.workers,
            lease: plan.lease,
            max_attempts: MAX_ATTEMPTS,
            worker_name: format!("server-{number}"),
            shares: Arc::new(TenantShares { max_running: plan.max_running, ..TenantShares::default() }),
            clock: store.wall_clock(),
            ..Options::default()
        };
        options.queue.max_jobs = MAX_JOBS;
        let (alive, ended) = mpsc::channel(1);
        let workers = (0..plan.workers)
            .map(|_| {
                let (worker, inbox) = Worker::with_inbox();
                let (dead, alive, solving) = (dead.clone(), alive.clone(), solving.clone());
                tokio::spawn(async move {
                    let _alive = alive;
                    work(inbox, dead, solving).await;
                });
                worker
            })
            .collect();
        let threads = Threads { workers, ended };
        let starting = tokio::spawn(Engine::start_with(options, Arc::new(store), threads));
        drop(entered);
        Self { runtime, link, starting: Some(starting), engine: None, draining: None, dead }
    }

    /// Goes on for so long.
    pub(super) fn step(&mut self, time: Duration) {
        self.runtime.block_on(async { sleep(time).await });
        if let Some(starting) = self.starting.take_if(|starting| starting.is_finished()) {
            match self.runtime.block_on(starting) {
                Ok(Ok(engine)) => self.engine = Some(engine),
                // As a process that cannot reach its store ends.
                _ => self.dead.store(true, Ordering::Relaxed),
            }
        }
        if self.draining.as_ref().is_some_and(JoinHandle::is_finished) {
            self.dead.store(true, Ordering::Relaxed);
        }
    }

    /// Whether it takes calls.
    pub(super) fn is_up(&self) -> bool {
        self.engine.is_some() && !self.is_gone()
    }

    /// Whether its process has ended.
    pub(super) fn is_gone(&self) -> bool {
        self.dead.load(Ordering::Relaxed)
    }

    /// Has a call of a client done, by a server that is up.
    pub(super) fn spawn<F: Future<Output = ()> + Send + 'static>(&self, call: impl FnOnce(Engine) -> F) {
        if let Some(engine) = &self.engine {
            self.runtime.spawn(call(engine.clone()));
        }
    }

    /// Ends as on SIGTERM.
    pub(super) fn drain(&mut self, bound: Duration) {
        if let (Some(engine), None) = (self.engine.clone(), &self.draining) {
            self.draining = Some(self.runtime.spawn(async move { engine.drain(bound).await }));
        }
    }

    /// Ends at once.
    pub(super) fn kill(self) {
        drop(self.engine);
        self.runtime.shutdown_background();
    }

    pub(super) fn faults(&self) -> Faults {
        self.link.lock().unwrap_or_else(PoisonError::into_inner).faults()
    }

    pub(super) fn set(&self, faults: Faults) {
        self.link.lock().unwrap_or_else(PoisonError::into_inner).set(faults);
    }
}

/// A worker, which is a thread outside of simulations.
async fn work(mut inbox: mpsc::Receiver<Assigned>, dead: Arc<AtomicBool>, solving: Solving) {
    while let Some(assignment) = inbox.recv().await {
        let seed = assignment.settings().seed;
        let step = JobBehavior::duration(seed) / 4;
        let Some(mut running) = assignment.begin() else { continue };
        let solved = solving.begin(running.name());
        for iteration in 1..=4 {
            sleep(step).await;
            if running.is_stopped() {
                break;
            }
            running.report(&progress(iteration));
        }
        match JobBehavior::of(seed) {
            JobBehavior::Succeed => {
                drop(solved);
                let result = result_of(running.name());
                running.succeed(&solution(&input(), 1), result);
            }
            JobBehavior::Fail => {
                drop(solved);
                running.fail();
            }
            JobBehavior::Kill => {
                dead.store(true, Ordering::Relaxed);
                std::future::pending::<()>().await;
            }
        }
    }
}
