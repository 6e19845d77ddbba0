//! The job that a slot is to begin with next, read while another one is solved.
//!
//! It is begun the moment that the worker is free, and leased while it is solved: between two short jobs a worker would
//! else wait for a commit of the store and a dozen wake-ups beside busy solvers, some 3 ms. Until it is begun nothing is
//! written of it: it stays in the queue, and whoever takes it first has it.

use std::collections::hash_map::Entry;
use std::sync::Arc;
use std::time::SystemTime;

use super::{Inner, locked};
use crate::domain::job::JobName;
use crate::store::Claimed;

/// Observations of a job beyond which its input is not read ahead, some 2 MB of it: none that large is solved in the time
/// that reading ahead is for.
const MOST_AHEAD: u32 = 100_000;

/// A job that is foreseen to be the next, with its input. No other slot foresees it while it is
/// reserved.
pub(super) struct Ahead {
    pub claimed: Claimed,
    pub input: Vec<u8>,
    pub reserved: Reserved,
}

impl Ahead {
    /// `None` where none waits, or the store does not answer, which the claim will tell.
    pub(super) async fn look(inner: &Arc<Inner>) -> Option<Self> {
        let passed: Vec<JobName> = locked(&inner.foreseen).keys().cloned().collect();
        let claimed = inner.store.foresee(&passed, SystemTime::now()).await.ok()??;
        if claimed.job.observation_count > MOST_AHEAD {
            return None;
        }
        let reserved = Reserved::new(inner.clone(), &claimed.job.name)?;
        let work = inner.store.work(&claimed.job.name).await.ok()?;
        Some(Self { claimed, input: work.input, reserved })
    }

    pub(super) fn inner(&self) -> &Arc<Inner> {
        &self.reserved.inner
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

    /// Whether it is still listed: nobody here has claimed or cancelled it.
    pub(super) fn holds(&self) -> bool {
        locked(&self.inner.foreseen).get(&self.name).is_some_and(|token| Arc::ptr_eq(token, &self.token))
    }
}

impl Drop for Reserved {
    fn drop(&mut self) {
        if self.holds() {
            locked(&self.inner.foreseen).remove(&self.name);
        }
    }
}
