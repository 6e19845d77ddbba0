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
    counts: Mutex<HashMap<JobName, Count>>,
}

/// The followers of one job.
#[derive(Default)]
struct Count {
    followers: usize,
    /// How often the last follower has left: a grace period that began earlier than the latest is void.
    departures: u64,
}

impl Shared {
    fn counts(&self) -> MutexGuard<'_, HashMap<JobName, Count>> {
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
        self.shared.counts().entry(job.clone()).or_default().followers += 1;
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
        let Some(count) = counts.get_mut(&self.job) else { return };
        count.followers = count.followers.saturating_sub(1);
        if count.followers > 0 {
            return;
        }
        if self.released {
            counts.remove(&self.job);
            return;
        }
        count.departures += 1;
        let departure = count.departures;
        drop(counts);
        let (shared, job) = (Arc::clone(&self.shared), self.job.clone());
        self.runtime.spawn(async move {
            tokio::time::sleep(shared.grace).await;
            let abandoned = {
                let mut counts = shared.counts();
                let abandoned =
                    counts.get(&job).is_some_and(|count| count.followers == 0 && count.departures == departure);
                if abandoned {
                    counts.remove(&job);
                }
                abandoned
            };
            if !abandoned {
                return;
            }
            tracing::info!(%job, "cancelling a job whose caller went away");
            if let Err(error) = shared.engine.cancel(&job).await {
                tracing::warn!(%job, %error, "cannot cancel a job whose caller went away");
            }
        });
    }
}
