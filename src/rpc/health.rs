//! What health checks are answered: NOT_SERVING while the store is out of reach, and from a drain on.

use tokio::sync::{Mutex, watch};
use tonic_health::ServingStatus;
use tonic_health::server::HealthReporter;

use crate::engine::StoreState;

/// Services whose health is reported one by one; the empty name is the server's own.
const HEALTH_NAMES: [&str; 5] =
    ["", "scpsfm.v1.CalibrationService", "scpsfm.v1.JobService", "scpsfm.v1.InputService", "scpsfm.v1.AdminService"];

/// What health checks are answered.
#[derive(Debug)]
pub struct Health {
    reporter: HealthReporter,
    /// Held while the statuses change, so that a store that comes back does not undo a drain.
    draining: Mutex<bool>,
}

impl Health {
    pub fn new(reporter: HealthReporter) -> Self {
        Self { reporter, draining: Mutex::new(false) }
    }

    /// Follows the store for as long as it is there.
    pub async fn follow(&self, mut store: watch::Receiver<StoreState>) {
        while store.changed().await.is_ok() {
            let state = *store.borrow_and_update();
            self.set_store(state).await;
        }
    }

    /// Tells whether anyone should call a server whose store is so: on one that is full results are read, and room is
    /// made. While the server drains, nothing changes.
    pub async fn set_store(&self, state: StoreState) {
        let draining = self.draining.lock().await;
        if !*draining {
            let is_of_use = state != StoreState::Unavailable;
            self.set(if is_of_use { ServingStatus::Serving } else { ServingStatus::NotServing }).await;
        }
    }

    /// Tells NOT_SERVING from here on.
    pub async fn drain(&self) {
        let mut draining = self.draining.lock().await;
        *draining = true;
        self.set(ServingStatus::NotServing).await;
    }

    async fn set(&self, status: ServingStatus) {
        for name in HEALTH_NAMES {
            self.reporter.set_service_status(name, status).await;
        }
    }
}
