//! Jobs by tenant. The recorder keeps every series for good, and tenants come and go: these series are written on the
//! page, and exported, as they are now, so that there are never more than a few.

use std::fmt::Write;
use std::sync::{Mutex, PoisonError};

use super::catalogue::TENANT_JOBS;

/// Tenants that have series of their own: what a graph can show.
const MAX_TENANTS: usize = 20;

/// Label of all others: no id of a tenant has capitals.
const OTHER: &str = "OTHER";

/// States of the counts, in their order.
const STATES: [&str; 2] = ["QUEUED", "RUNNING"];

/// A tenant and its jobs by state.
type OfTenant = (String, [u64; 2]);

static LATEST: Mutex<Vec<OfTenant>> = Mutex::new(Vec::new());

/// Tells how many jobs of each tenant wait and how many run; the last call wins.
pub fn tenant_jobs(tenants: Vec<OfTenant>) {
    *LATEST.lock().unwrap_or_else(PoisonError::into_inner) = bounded(tenants);
}

/// What stands on the page.
pub(super) fn page() -> String {
    text(&LATEST.lock().unwrap_or_else(PoisonError::into_inner))
}

/// Calls `visit` with the labels and the value of every series.
pub(super) fn for_each(visit: impl FnMut([(&'static str, &str); 2], u64)) {
    visit_all(&LATEST.lock().unwrap_or_else(PoisonError::into_inner), visit);
}

/// The tenants that have most jobs.
fn bounded(mut tenants: Vec<OfTenant>) -> Vec<OfTenant> {
    tenants.sort_by_key(|(tenant, jobs)| (std::cmp::Reverse(jobs[0] + jobs[1]), tenant.clone()));
    let others = tenants.split_off(tenants.len().min(MAX_TENANTS));
    let sum = others.iter().fold([0, 0], |sum, (_, jobs)| [sum[0] + jobs[0], sum[1] + jobs[1]]);
    tenants.push((OTHER.to_owned(), sum));
    tenants
}

fn text(tenants: &[OfTenant]) -> String {
    let name = TENANT_JOBS.name;
    let mut text = format!("# HELP {name} {}\n# TYPE {name} gauge\n", TENANT_JOBS.help);
    visit_all(tenants, |[(_, tenant), (_, state)], count| {
        // Never fails: it is a text in memory.
        let _ = writeln!(text, "{name}{{tenant=\"{tenant}\",state=\"{state}\"}} {count}");
    });
    text
}

fn visit_all(tenants: &[OfTenant], mut visit: impl FnMut([(&'static str, &str); 2], u64)) {
    for (tenant, jobs) in tenants {
        for (state, count) in STATES.into_iter().zip(jobs) {
            visit([("tenant", tenant), ("state", state)], *count);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_tenants_that_have_most_are_shown_and_the_others_summed() {
        let tenants = (0..30_u64).map(|k| (format!("tenant-{k:02}"), [k, 1])).collect();
        let bounded = bounded(tenants);
        assert_eq!(bounded.len(), MAX_TENANTS + 1);
        assert_eq!(bounded[0], ("tenant-29".to_owned(), [29, 1]));
        assert_eq!(bounded[MAX_TENANTS], (OTHER.to_owned(), [45, 10]), "0 + 1 + ... + 9");
        let text = text(&bounded);
        assert!(text.contains("\nscpsfm_tenant_jobs{tenant=\"tenant-29\",state=\"QUEUED\"} 29\n"), "{text}");
        assert!(text.ends_with("scpsfm_tenant_jobs{tenant=\"OTHER\",state=\"RUNNING\"} 10\n"), "{text}");
        assert_eq!(text.lines().count(), 2 + 2 * (MAX_TENANTS + 1));
    }

    #[test]
    fn a_tenant_without_jobs_leaves_no_series() {
        assert_eq!(bounded(vec![]), [(OTHER.to_owned(), [0, 0])]);
    }
}
