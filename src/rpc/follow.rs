//! Jobs that live only as long as someone waits for them: the callers of `Solve`.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::runtime::Handle;

use crate::domain::job::JobName;
use crate::engine::{self, Engine, Watch};

/// Counts the followers of each job, so that one of several may go.
#[derive(Clone)]
pub struct Followers {
    shared: Arc<Shared>,
}

struct Shared {
    engine: Engine,
    grace: Duration,
    ledger: Mutex<Ledger>,
}

/// Who follows which job, and which jobs are in their grace period. Knows nothing of time: its owner says when a
/// period is over.
#[derive(Debug, Default)]
struct Ledger {
    jobs: HashMap<JobName, Count>,
    /// Departures so far, of all jobs: a job that is forgotten and followed again must not be given the number of a
    /// grace period that still runs.
    departures: u64,
}

/// The followers of one job.
#[derive(Debug, Default)]
struct Count {
    followers: usize,
    /// The latest departure of a last follower: a grace period that began with an earlier one is void.
    departure: Option<Departure>,
}

/// A last follower's going; no two are the same.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Departure(u64);

impl Ledger {
    fn follow(&mut self, job: &JobName) {
        self.jobs.entry(job.clone()).or_default().followers += 1;
    }

    /// One follower goes. A departure where it was the last: the job's grace period begins. None begins when the job
    /// was `released`.
    fn leave(&mut self, job: &JobName, released: bool) -> Option<Departure> {
        let count = self.jobs.get_mut(job)?;
        count.followers = count.followers.saturating_sub(1);
        if count.followers > 0 {
            return None;
        }
        if released {
            self.jobs.remove(job);
            return None;
        }
        self.departures += 1;
        count.departure = Some(Departure(self.departures));
        count.departure
    }

    /// Whether nobody came back in the grace period that began with this departure; if so, the job is forgotten.
    fn is_abandoned(&mut self, job: &JobName, departure: Departure) -> bool {
        let abandoned =
            self.jobs.get(job).is_some_and(|count| count.followers == 0 && count.departure == Some(departure));
        if abandoned {
            self.jobs.remove(job);
        }
        abandoned
    }
}

impl Shared {
    fn ledger(&self) -> MutexGuard<'_, Ledger> {
        // A count is whole at every moment: a panic elsewhere under the lock leaves nothing half done.
        self.ledger.lock().unwrap_or_else(PoisonError::into_inner)
    }

    async fn cancel_if_abandoned(&self, job: &JobName, departure: Departure) {
        if !self.ledger().is_abandoned(job, departure) {
            return;
        }
        if self.engine.job(job).await.is_ok_and(|job| job.state.is_terminal()) {
            return;
        }
        tracing::info!(%job, "cancelling a job whose caller went away");
        if let Err(error) = self.engine.cancel(job).await {
            tracing::warn!(%job, %error, "cannot cancel a job whose caller went away");
        }
    }
}

impl Followers {
    /// A job without followers for `grace` is cancelled.
    pub fn new(engine: Engine, grace: Duration) -> Self {
        Self { shared: Arc::new(Shared { engine, grace, ledger: Mutex::default() }) }
    }

    /// Follows a job. Must be called within a tokio runtime.
    pub fn follow(&self, job: JobName) -> Follower {
        self.shared.ledger().follow(&job);
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

    /// The job's events from the first on. Where they cannot be had, the job is released: that is ours to answer for,
    /// not the caller's, who may come again with the same request id.
    ///
    /// # Errors
    /// See [`Engine::watch`].
    pub async fn watch(&mut self) -> Result<Watch, engine::Error> {
        self.shared.engine.watch(&self.job, 0).await.inspect_err(|_| self.released = true)
    }

    /// Lets go of the job without cancelling it.
    pub fn release(&mut self) {
        self.released = true;
    }
}

impl Drop for Follower {
    fn drop(&mut self) {
        let Some(departure) = self.shared.ledger().leave(&self.job, self.released) else { return };
        let (shared, job) = (Arc::clone(&self.shared), self.job.clone());
        self.runtime.spawn(async move {
            tokio::time::sleep(shared.grace).await;
            shared.cancel_if_abandoned(&job, departure).await;
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::sqlite::Sqlite;

    fn job(id: &str) -> JobName {
        JobName { tenant: "default".into(), job: id.into() }
    }

    #[test]
    fn a_job_is_abandoned_once_its_last_follower_stayed_away() {
        let (mut ledger, job) = (Ledger::default(), job("a"));
        ledger.follow(&job);
        ledger.follow(&job);
        assert_eq!(ledger.leave(&job, false), None, "one of two may go");
        let departure = ledger.leave(&job, false).expect("the last one went");
        assert!(ledger.is_abandoned(&job, departure));
        assert!(!ledger.is_abandoned(&job, departure), "cancelled once");
        assert!(ledger.jobs.is_empty(), "{ledger:?}");
    }

    #[test]
    fn a_follower_that_comes_back_voids_the_grace_period_it_ends() {
        let (mut ledger, job) = (Ledger::default(), job("a"));
        ledger.follow(&job);
        let first = ledger.leave(&job, false).expect("the last one went");
        ledger.follow(&job);
        assert!(!ledger.is_abandoned(&job, first), "someone is there");
        let second = ledger.leave(&job, false).expect("the last one went again");
        assert!(!ledger.is_abandoned(&job, first), "its period is void, though nobody is there");
        assert!(ledger.is_abandoned(&job, second));
    }

    #[test]
    fn a_grace_period_from_before_a_release_is_void_after_it() {
        let (mut ledger, job) = (Ledger::default(), job("a"));
        ledger.follow(&job);
        let old = ledger.leave(&job, false).expect("the last one went");
        ledger.follow(&job);
        assert_eq!(ledger.leave(&job, true), None, "released, so forgotten");
        ledger.follow(&job);
        let new = ledger.leave(&job, false).expect("the last one went again");
        assert!(!ledger.is_abandoned(&job, old), "the old timer must not cut the new period short");
        assert!(ledger.is_abandoned(&job, new));
    }

    #[test]
    fn jobs_do_not_disturb_each_other() {
        let (mut ledger, a, b) = (Ledger::default(), job("a"), job("b"));
        ledger.follow(&a);
        ledger.follow(&b);
        let left = ledger.leave(&a, false).expect("the last one of a");
        assert!(!ledger.is_abandoned(&b, left));
        assert!(ledger.is_abandoned(&a, left));
        assert!(ledger.leave(&a, false).is_none(), "nobody follows a");
        assert!(ledger.leave(&b, false).is_some());
    }

    #[tokio::test]
    async fn a_job_whose_events_cannot_be_had_is_released() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let store = Sqlite::open(directory.path()).await.expect("a store");
        let options = engine::Options { workers: 1, ..engine::Options::default() };
        let engine = Engine::start(options, Arc::new(store), engine::default_solver()).await.expect("an engine");
        // Long enough that the timer, were one started, would hold on to the job for the whole of the test.
        let followers = Followers::new(engine, Duration::from_secs(3_600));
        let mut follower = followers.follow(job("unknown"));
        assert!(matches!(follower.watch().await, Err(engine::Error::NotFound(_))));
        drop(follower);
        assert!(followers.shared.ledger().jobs.is_empty(), "a grace period began");
        drop(followers.follow(job("unknown")));
        assert_eq!(followers.shared.ledger().jobs.len(), 1, "one that is merely dropped begins one");
    }
}
