//! Whose turn it is: tenants share the workers by start-time fair queueing (Goyal, Vin, Cheng: Start-time Fair
//! Queueing, 1996).
//!
//! Each tenant has a virtual time, at which its latest job had its turn: was begun, or prefetched. Its next one has its
//! turn a step later, and the tenant whose next one is first is served. A step is shorter the larger the tenant's
//! weight. The virtual time of all is that of the latest turn of any: a tenant that had nothing to do goes on from
//! there, so that it saves nothing up. All of it is in the tables: it holds over all servers of a store, and after a
//! restart.
//!
//! Servers that begin jobs of one tenant at the same moment do not wait for each other. A job then may go uncounted,
//! and the tenant be served once more than its share.

use std::collections::HashSet;
use std::time::SystemTime;

use super::rows::micros;
use super::{Connection, Statement};
use crate::store::Error;
use crate::store::record::{Claim, Lease, TenantShares};

/// Virtual time between two jobs of a tenant of weight 1: a multiple of small weights, so that shares are exact.
const STEP: i64 = 1_000_000;

fn step(shares: &TenantShares, tenant: &str) -> i64 {
    STEP / i64::from(shares.weight(tenant))
}

impl dyn Connection + '_ {
    /// Notes a tenant that has a job. By one transaction at a time: who admits jobs has the lock.
    pub(super) async fn register_tenant(&mut self, tenant: &str) -> Result<(), Error> {
        let insert =
            "INSERT INTO tenants (tenant) SELECT $1 WHERE NOT EXISTS (SELECT 1 FROM tenants WHERE tenant = $1)";
        self.execute(Statement::new(insert).bind(tenant)).await
    }

    /// Tenants that have jobs waiting and may begin one, in the order of their turns; none while the queue is paused.
    ///
    /// * `lease_now`: now, on the clock of leases
    pub(super) async fn turns(&mut self, claim: &Claim, lease_now: SystemTime) -> Result<Vec<String>, Error> {
        // One step through the index for each tenant that waits, not for each job.
        let select = Statement::new(
            "WITH RECURSIVE waiting (tenant) AS ( \
                 SELECT (SELECT tenant FROM jobs WHERE state = 'QUEUED' ORDER BY tenant LIMIT 1) \
                 UNION ALL \
                 SELECT (SELECT jobs.tenant FROM jobs WHERE state = 'QUEUED' AND jobs.tenant > waiting.tenant \
                         ORDER BY jobs.tenant LIMIT 1) \
                 FROM waiting WHERE waiting.tenant IS NOT NULL) \
             SELECT waiting.tenant AS tenant, COALESCE(tenants.virtual_start, 0) AS virtual_start \
             FROM waiting LEFT JOIN tenants ON tenants.tenant = waiting.tenant \
             WHERE waiting.tenant IS NOT NULL AND (SELECT pause_time FROM queue) IS NULL",
        );
        let full = self.full_tenants(claim, lease_now).await?;
        let mut turns = Vec::new();
        for row in self.rows(select).await? {
            let tenant = row.text("tenant")?;
            if !full.contains(&tenant) {
                turns.push((row.integer("virtual_start")?.saturating_add(step(&claim.shares, &tenant)), tenant));
            }
        }
        turns.sort_unstable();
        Ok(turns.into_iter().map(|(_, tenant)| tenant).collect())
    }

    /// Tenants with as many jobs running or prefetched as may run at once.
    async fn full_tenants(&mut self, claim: &Claim, lease_now: SystemTime) -> Result<HashSet<String>, Error> {
        let Some(max_running) = claim.shares.max_running else { return Ok(HashSet::new()) };
        let mut select = Statement::new(
            "SELECT tenant FROM ( \
                 SELECT tenant FROM jobs WHERE state = 'QUEUED' AND lease_expires > $1 \
                 UNION ALL SELECT tenant FROM jobs WHERE state = 'RUNNING' AND lease_expires IS NOT NULL",
        )
        .bind(micros(lease_now));
        for Lease { name, attempt } in &claim.solved {
            select = select.then(" AND NOT (tenant = ").then_bind(&name.tenant);
            select = select.then(" AND job = ").then_bind(&name.job);
            select = select.then(" AND attempt = ").then_bind(*attempt).then(")");
        }
        let select = select.then(") AS leased GROUP BY tenant HAVING COUNT(*) >= ").then_bind(max_running);
        let rows = self.rows(select).await?;
        rows.iter().map(|row| row.text("tenant")).collect()
    }

    /// Counts a turn of a tenant, unless another transaction is counting one of it.
    pub(super) async fn count_turn(&mut self, shares: &TenantShares, tenant: &str) -> Result<(), Error> {
        let update = Statement::new(
            "UPDATE tenants SET virtual_start = CASE \
                 WHEN virtual_start + $1 > (SELECT MAX(virtual_start) FROM tenants) THEN virtual_start + $1 \
                 ELSE (SELECT MAX(virtual_start) FROM tenants) END \
             WHERE tenant = (SELECT tenant FROM tenants WHERE tenant = $2",
        )
        .bind(step(shares, tenant))
        .bind(tenant)
        .then(self.skip_locked())
        .then(")");
        self.execute(update).await
    }
}
