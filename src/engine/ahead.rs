//! The job that a slot is to begin with next: read and handed to the worker while that solves another one.
//!
//! The worker begins it the moment that it is free, and it is leased while it is solved: between two short jobs a
//! worker would else wait for a commit of the store and a dozen wake-ups beside busy solvers, some 3 ms, or for the
//! slot to wake up at least. Until it is begun nothing is written of it: it stays in the queue, and whoever takes it
//! first has it.

use std::collections::hash_map::Entry;
use std::sync::Arc;

use tokio::sync::oneshot;

use super::execution::{Wait, stop_token};
use super::worker::{Assignment, Began, Heard, Opening, Worker};
use super::{Inner, Phase, locked};
use crate::domain::job::{Job, JobName};
use crate::domain::{StopReason, StopToken};
use crate::store::{Claimed, Lease};

/// Observations of a job beyond which its input is not read ahead, some 2 MB of it: none that large is solved in the
/// time that reading ahead is for.
const MOST_AHEAD: u32 = 100_000;

/// A job that is foreseen to be the next and in the hands of a worker. No other slot foresees it meanwhile. Dropped, it
/// is not begun any more, or stopped, and nothing is written of it.
pub(super) struct Ahead {
    pub job: Job,
    pub lease: Lease,
    pub wait: Wait,
    pub reserved: Arc<Reserved>,
    pub stop: Revocable,
    /// Told once the worker begins; dropped where it finds that the job is another's by now, or nobody's.
    pub begun: oneshot::Receiver<Began>,
    pub heard: Heard,
}

impl Ahead {
    /// Foresees the next job and hands it to the worker; `None` where none waits, or the store does not answer, which
    /// the claim will tell.
    pub(super) async fn look(inner: &Arc<Inner>, worker: &Worker) -> Option<Self> {
        let passed: Vec<JobName> = locked(&inner.foreseen).keys().cloned().collect();
        let Claimed { job, lease, trace_parent, queue_time } =
            inner.store.foresee(&passed, inner.now()).await.ok()??;
        if job.observation_count > MOST_AHEAD {
            return None;
        }
        let reserved = Arc::new(Reserved::new(inner.clone(), &job.name)?);
        let work = inner.store.work(&job.name).await.ok()?;
        let (tell, begun) = oneshot::channel();
        let opening =
            Opening::Foreseen { reserved: Arc::downgrade(&reserved), trace_parent: trace_parent.clone(), tell };
        let stop = stop_token(&job, inner.now());
        let subscription = inner.hub.subscribe(&job.name);
        let (assignment, heard) = Assignment::new(&job, lease.attempt, opening, work.input, stop.clone(), subscription);
        worker.assign(assignment).await;
        let wait = Wait { trace_parent, queue_time };
        Some(Self { job, lease, wait, reserved, stop: Revocable::new(stop), begun, heard })
    }
}

/// How an attempt is told to stop, which it is unless it is kept.
pub(super) struct Revocable {
    stop: StopToken,
    kept: bool,
}

impl Revocable {
    fn new(stop: StopToken) -> Self {
        Self { stop, kept: false }
    }

    pub(super) fn token(&self) -> &StopToken {
        &self.stop
    }

    /// The attempt goes on.
    pub(super) fn keep(mut self) {
        self.kept = true;
    }
}

impl Drop for Revocable {
    fn drop(&mut self) {
        if !self.kept {
            self.stop.stop(StopReason::Interrupted);
        }
    }
}

/// Lists a job among those that are foreseen as long as it lives.
pub(super) struct Reserved {
    inner: Arc<Inner>,
    name: JobName,
    /// Tells it from a later one of the same job.
    token: Arc<()>,
}

impl Reserved {
    /// `None` where it is listed.
    fn new(inner: Arc<Inner>, name: &JobName) -> Option<Self> {
        let token = Arc::new(());
        if let Entry::Vacant(place) = locked(&inner.foreseen).entry(name.clone()) {
            place.insert(token.clone());
        } else {
            return None;
        }
        Some(Self { inner, name: name.clone(), token })
    }

    pub(super) fn inner(&self) -> &Arc<Inner> {
        &self.inner
    }

    /// Whether it may be begun: nobody here has claimed or cancelled it, and the engine takes on new work.
    pub(super) fn holds(&self) -> bool {
        self.is_listed() && self.inner.phase() == Phase::Open
    }

    fn is_listed(&self) -> bool {
        locked(&self.inner.foreseen).get(&self.name).is_some_and(|token| Arc::ptr_eq(token, &self.token))
    }
}

impl Drop for Reserved {
    fn drop(&mut self) {
        if self.is_listed() {
            locked(&self.inner.foreseen).remove(&self.name);
        }
    }
}
