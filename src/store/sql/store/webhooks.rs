//! Operations on what is to be sent to webhooks.

use super::*;
use crate::store::sql::webhooks;

impl dyn Database {
    /// What is to be sent to the webhooks of jobs that have ended.
    pub async fn webhook_queue(&self, now: SystemTime) -> Result<WebhookQueue, Error> {
        let due_by = self.lease_clock(now);
        reads!(self, "webhook_queue", Small, |connection| webhooks::queue(connection, due_by))
    }

    /// Leases the delivery of a job's end that is due, passing over some hosts and tenants, and counts an attempt at
    /// it: first attempts in the order of the jobs, then what is due the longest. Returns the job as it stands then;
    /// `None` where nothing is due. A delivery whose lease runs out is due again.
    pub async fn claim_webhook(
        &self,
        passed: &PassedOver,
        now: SystemTime,
        lease_for: Duration,
    ) -> Result<Option<Job>, Error> {
        let due_by = self.lease_clock(now);
        writes!(self, "claim_webhook", Small, Begins(0), [passed], |connection| webhooks::claim(
            connection,
            &passed,
            due_by,
            due_by + lease_for
        ))
    }

    /// Notes what the attempt at the delivery of a `claimed` job came to. `false` where the job is gone, or another
    /// attempt has begun since: nothing is noted then.
    pub async fn settle_webhook(
        &self,
        claimed: &Job,
        outcome: &WebhookOutcome,
        now: SystemTime,
    ) -> Result<bool, Error> {
        let now = self.lease_clock(now);
        let claimed = Arc::new(claimed.clone());
        writes!(self, "settle_webhook", Small, Ends(0), [claimed, outcome], |connection| webhooks::settle(
            connection, &claimed, &outcome, now
        ))
    }
}
