//! Jobs that live only as long as someone waits for them: the callers of `Solve`.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::runtime::Handle;

use crate::domain::job::JobName;
use crate::engine::Engine;

/// Counts the followers of each job, so that one of several may go.
#[derive(Clone)]
pub struct Followers {
    shared: Arc<Shared>,
}

struct Shared {
    engine: Engine,
    grace: Duration,
    counts: Mutex<HashMap<JobName, usize>>,
}

impl Shared {
    fn counts(&self) -> MutexGuard<'_, HashMap<JobName, usize>> {
        // A count is whole at every moment: a panic elsewhere under the lock leaves nothing half done.
        self.counts.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Followers {
    /// A job without followers for `grace` is cancelled.
    pub fn new(engine: Engine, grace: Duration) -> Self {
        Self { shared: Arc::new(Shared { engine, grace, counts: Mutex::default() }) }
    }

    /// Follows a job. Must be called within a tokio runtime.
    pub fn follow(&self, job: JobName) -> Follower {
        *self.shared.counts().entry(job.clone()).or_default() += 1;
        Follower { shared: Arc::clone(&self.shared), job, released: false, runtime: Handle::current() }
    }
}

/// One caller that waits for a job. Dropping it, which is what a lost connection does, cancels the job after the grace
/// period unless another follower is there by then.
pub struct Follower {
    shared: Arc<Shared>,
    job: JobName,
    released: bool,
    runtime: Handle,
}

impl Follower {
    pub fn job(&self) -> &JobName {
        &self.job
    }

    /// Lets go of the job without cancelling it.
    pub fn release(&mut self) {
        self.released = true;
    }
}

impl Drop for Follower {
    fn drop(&mut self) {
        let mut counts = self.shared.counts();
        let left = counts.get_mut(&self.job).map_or(0, |count| {
            *count -= 1;
            *count
        });
        if left == 0 {
            counts.remove(&self.job);
        }
        drop(counts);
        if self.released || left > 0 {
            return;
        }
        let (shared, job) = (Arc::clone(&self.shared), self.job.clone());
        self.runtime.spawn(async move {
            tokio::time::sleep(shared.grace).await;
            if shared.counts().contains_key(&job) {
                return;
            }
            tracing::info!(%job, "cancelling a job whose caller went away");
            if let Err(error) = shared.engine.cancel(&job).await {
                tracing::warn!(%job, %error, "cannot cancel a job whose caller went away");
            }
        });
    }
}
