//! The attempts of this process, listed as long as they live.

use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::sync::Arc;

use super::{Inner, locked};
use crate::domain::{StopReason, StopToken};
use crate::store::Lease;

/// The attempts of this process by their leases, prefetched ones too.
pub(super) type RunningAttempts = HashMap<Lease, Listed>;

/// What others need to know of an attempt.
#[derive(Debug)]
pub(super) struct Listed {
    pub stop: StopToken,
    /// The job is solved, and its end on its way to the store.
    is_solved: bool,
}

/// Lists an attempt as long as it lives, and stops what is left of it then.
pub(super) struct Running {
    inner: Arc<Inner>,
    lease: Lease,
    stop: StopToken,
}

impl Running {
    pub(super) fn list(inner: Arc<Inner>, lease: &Lease, stop: &StopToken, is_begun: bool) -> Self {
        let listed = Listed { stop: stop.clone(), is_solved: false };
        match locked(&inner.running).entry(lease.clone()) {
            Entry::Vacant(place) => {
                place.insert(listed);
            }
            // Another slot has prefetched it, and is not the first to begin.
            Entry::Occupied(mut other) if is_begun => other.insert(listed).stop.stop(StopReason::Interrupted),
            Entry::Occupied(_) => stop.stop(StopReason::Interrupted),
        }
        // Claimed while a drain told those that were listed to stop.
        if inner.interrupted.is_cancelled() {
            stop.stop(StopReason::Interrupted);
        }
        Self { inner, lease: lease.clone(), stop: stop.clone() }
    }

    /// The worker is done with it.
    pub(super) fn set_solved(&self) {
        if let Some(listed) =
            locked(&self.inner.running).get_mut(&self.lease).filter(|listed| listed.stop.is(&self.stop))
        {
            listed.is_solved = true;
        }
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        self.stop.stop(StopReason::Interrupted);
        let mut running = locked(&self.inner.running);
        // A slot that begins what this one had only prefetched has its own there.
        if running.get(&self.lease).is_some_and(|listed| listed.stop.is(&self.stop)) {
            running.remove(&self.lease);
        }
    }
}

impl Inner {
    /// Leases of jobs that are solved, and whose end the store does not have yet.
    pub(super) fn solved(&self) -> Vec<Lease> {
        let running = locked(&self.running);
        running.iter().filter(|(_, listed)| listed.is_solved).map(|(lease, _)| lease.clone()).collect()
    }
}
