//! The outbox of webhooks: what is to be sent of jobs that have ended, and what became of it.

use std::sync::Arc;
use std::time::{Duration, SystemTime};

use super::Size::Small;
use super::WriteIntent::{Begins, Ends};
use super::operation::{reads, writes};
use super::rows::{self, integer, micros, number, select_jobs};
use super::{Connection, Database, Row, Size, Statement};
use crate::domain::job::Job;
use crate::domain::{Webhook, WebhookState};
use crate::store::record::{PassedOver, WebhookOutcome, WebhookQueue};
use crate::store::{Error, payload};

impl dyn Database {
    /// What is to be sent to the webhooks of jobs that have ended.
    pub async fn webhook_queue(&self, now: SystemTime) -> Result<WebhookQueue, Error> {
        let due_by = self.lease_clock(now);
        reads!(self, "webhook_queue", Size::Page, |connection| {
            let select =
                "SELECT COUNT(*) AS pending, MIN(due_time) AS first_due FROM webhooks WHERE due_time IS NOT NULL";
            let row = connection.row(Statement::new(select)).await?;
            let is_due = row.optional_integer("first_due")?.is_some_and(|due| due <= micros(due_by));
            Ok(WebhookQueue { pending: number(&row, "pending")?, is_due })
        })
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
        writes!(self, "claim_webhook", Small, Begins(0), [passed], |connection| {
            let mut next = Statement::new("SELECT job_id, webhook FROM webhooks WHERE due_time <= $1");
            next = next.bind(micros(due_by));
            for host in &passed.hosts {
                next = next.then(" AND host <> ").then_bind(host);
            }
            for tenant in &passed.tenants {
                let of_job = " AND (SELECT tenant FROM jobs WHERE jobs.id = webhooks.job_id) <> ";
                next = next.then(of_job).then_bind(tenant);
            }
            let next = next.then(" ORDER BY due_time, job_id LIMIT 1").then(connection.skip_locked());
            let Some(row) = connection.optional_row(next).await? else { return Ok(None) };
            let (id, webhook) = read(&row)?;
            let webhook = Webhook { attempts: webhook.attempts.saturating_add(1), ..webhook };
            connection.execute(update(id, &webhook, Some(due_by + lease_for))?).await?;
            let job = connection.row(Statement::new(select_jobs!("WHERE id = $1")).bind(id)).await?;
            rows::job(&job).map(Some)
        })
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
        writes!(self, "settle_webhook", Small, Ends(0), [claimed, outcome], |connection| {
            let select = Statement::new(
                "SELECT job_id, webhook FROM webhooks \
                 WHERE job_id = (SELECT id FROM jobs \
                                 WHERE tenant = $1 AND job = $2 AND create_time = $3 AND last_sequence = $4)",
            )
            .bind(&claimed.name.tenant)
            .bind(&claimed.name.job)
            .bind(micros(claimed.create_time))
            // A job that was retried has another end since.
            .bind(integer(claimed.last_sequence))
            .then(connection.for_update());
            let Some(row) = connection.optional_row(select).await? else { return Ok(false) };
            let (id, webhook) = read(&row)?;
            // As long as it is pending, the number of attempts is the fencing token.
            if Some(&webhook) != claimed.webhook.as_ref() {
                return Ok(false);
            }
            let (state, last_error, due) = match outcome {
                WebhookOutcome::Delivered => (WebhookState::Delivered, None, None),
                WebhookOutcome::Retry { error, after } => (WebhookState::Pending, Some(error), Some(now + after)),
                WebhookOutcome::GivenUp { error } => (WebhookState::GivenUp, Some(error), None),
            };
            let webhook = Webhook { state, last_error, ..webhook };
            connection.execute(update(id, &webhook, due)?).await?;
            Ok(true)
        })
    }
}

impl dyn Connection + '_ {
    /// Has the end of a job sent that is still to come, as if none had been.
    pub(super) async fn renew_webhook(&mut self, id: i64) -> Result<(), Error> {
        let select =
            Statement::new("SELECT job_id, webhook FROM webhooks WHERE job_id = $1").bind(id).then(self.for_update());
        let Some(row) = self.optional_row(select).await? else { return Ok(()) };
        let (id, webhook) = read(&row)?;
        self.execute(update(id, &Webhook::pending(webhook.url), None)?).await
    }
}

/// Stores the webhook of a job of this row. It is not due before the job ends.
pub(super) fn insert(id: i64, webhook: &Webhook) -> Result<Statement, Error> {
    let insert = Statement::new("INSERT INTO webhooks (job_id, host, webhook) VALUES ($1, $2, $3)").bind(id);
    Ok(insert.bind(&webhook.host()).bind(payload::encode(webhook)?))
}

/// Makes the webhook of a job due that ends now: at once, on whatever clock.
pub(super) fn due(id: i64) -> Statement {
    Statement::new("UPDATE webhooks SET due_time = 0 WHERE job_id = $1").bind(id)
}

fn read(row: &Row) -> Result<(i64, Webhook), Error> {
    Ok((row.integer("job_id")?, payload::decode(row.bytes("webhook")?, "a webhook")?))
}

fn update(id: i64, webhook: &Webhook, due: Option<SystemTime>) -> Result<Statement, Error> {
    let update = Statement::new("UPDATE webhooks SET webhook = $1, due_time = $2 WHERE job_id = $3");
    Ok(update.bind(payload::encode(webhook)?).bind(due.map(micros)).bind(id))
}
