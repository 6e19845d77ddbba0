//! How tenants share the workers.

use super::*;
use crate::store::{Claims, Prefetch, TenantShares};

/// Stores so many jobs of a tenant, all at that time.
async fn create_of(store: &Store, tenant: &str, jobs: std::ops::Range<u32>, seconds: u64) {
    for number in jobs {
        let name = JobName { tenant: tenant.into(), job: format!("{tenant}-{number}") };
        create(store, NewRecord { name, ..record("") }, seconds).await;
    }
}

async fn claim_with(store: &Store, shares: &TenantShares, prefetch: Option<Prefetch>) -> Claims {
    let claim = Claim { shares: Arc::new(shares.clone()), prefetch, ..Claim::one("worker", LEASE) };
    store.claim(&claim, time(100)).await.expect("claims")
}

/// The ids of the next so many jobs that are begun.
async fn begun(store: &Store, shares: &TenantShares, count: usize) -> Vec<String> {
    let mut ids = Vec::new();
    for _ in 0..count {
        ids.push(claim_with(store, shares, None).await.begun.expect("a job").job.name.job);
    }
    ids
}

/// The tenants of the next so many jobs that are begun, one letter each.
async fn turns(store: &Store, shares: &TenantShares, count: usize) -> String {
    begun(store, shares, count).await.iter().map(|id| &id[..1]).collect()
}

pub(in crate::store) async fn tenants_take_turns_and_priority_counts_within_one(store: &Store) {
    create_of(store, "a", 0..3, 0).await;
    let urgent = JobName { tenant: "a".into(), job: "a-urgent".into() };
    create(store, NewRecord { name: urgent, priority: 9, ..record("") }, 1).await;
    create_of(store, "c", 0..1, 1).await;
    create_of(store, "b", 0..2, 2).await;
    let equal = TenantShares::default();
    let expected = ["a-urgent", "b-0", "c-0", "a-0", "b-1", "a-1", "a-2"];
    assert_eq!(begun(store, &equal, expected.len()).await, expected);
    assert_eq!(claim_with(store, &equal, None).await, Claims::default());
}

pub(in crate::store) async fn weights_are_shares(store: &Store) {
    let shares = TenantShares { weights: BTreeMap::from([("b".into(), 3)]), ..TenantShares::default() };
    create_of(store, "a", 0..9, 0).await;
    create_of(store, "b", 0..9, 0).await;
    for round in 0..3 {
        let turns = turns(store, &shares, 4).await;
        assert_eq!(turns.matches('b').count(), 3, "round {round}: {turns}");
    }
    assert_eq!(turns(store, &shares, 6).await, "aaaaaa", "who is alone has all");
}

pub(in crate::store) async fn weights_are_shares_where_jobs_are_prefetched(store: &Store) {
    let shares = TenantShares { weights: BTreeMap::from([("b".into(), 3)]), ..TenantShares::default() };
    let prefetch = Some(Prefetch { lease_for: LEASE, max_observations: u32::MAX });
    create_of(store, "a", 0..20, 0).await;
    create_of(store, "b", 0..60, 0).await;
    // Six workers, each of which has a job before it and one after it.
    let mut prefetched = std::collections::VecDeque::new();
    let mut begun = String::new();
    for turn in 0..40 {
        let next: Option<Claimed> = if turn < 6 { None } else { prefetched.pop_front() };
        let begin = next.map(|next| (next.lease, next.job.create_time));
        let claim = Claim { begin, prefetch, shares: Arc::new(shares.clone()), ..Claim::one("worker", LEASE) };
        let claims = store.claim(&claim, time(100)).await.expect("claims");
        begun.push_str(&claims.begun.expect("a job").job.name.job[..1]);
        prefetched.push_back(claims.prefetched.expect("another"));
    }
    assert_eq!((begun.matches('a').count(), begun.matches('b').count()), (10, 30), "{begun}");
}

pub(in crate::store) async fn an_idle_tenant_saves_nothing_up(store: &Store) {
    let equal = TenantShares::default();
    create_of(store, "a", 0..12, 0).await;
    assert_eq!(turns(store, &equal, 5).await, "aaaaa");
    create_of(store, "b", 0..2, 1).await;
    assert_eq!(turns(store, &equal, 5).await, "babaa", "next, and then in turn");
    create_of(store, "b", 2..4, 2).await;
    assert_eq!(turns(store, &equal, 4).await, "baba");
}

pub(in crate::store) async fn the_running_jobs_of_a_tenant_are_bounded(store: &Store) {
    let shares = TenantShares { max_running: Some(2), ..TenantShares::default() };
    let prefetch = Some(Prefetch { lease_for: LEASE, max_observations: u32::MAX });
    create_of(store, "a", 0..5, 0).await;
    let claims = claim_with(store, &shares, prefetch).await;
    let (first, second) = (claims.begun.expect("a job"), claims.prefetched.expect("another"));
    create_of(store, "b", 0..1, 0).await;
    assert_eq!(begun(store, &shares, 1).await, ["b-0"], "one runs and one is to");
    let begin = Some((second.lease.clone(), second.job.create_time));
    let late = Claim { begin, shares: Arc::new(shares.clone()), ..Claim::one("worker", LEASE) };
    let expired = time(100 + LEASE.as_secs());
    assert_eq!(store.claim(&late, expired).await, Ok(Claims::default()), "others may have begun in its place");
    let claims = claim_with(store, &shares, prefetch).await;
    assert_eq!(claims.begun.expect("is idle").lease, second.lease);
    assert_eq!(claims.prefetched, None);
    assert_eq!(claim_with(store, &shares, prefetch).await, Claims::default(), "two run");
    store.finish(&first.lease, &success(vec![1]), time(101)).await.expect("holds");
    assert_eq!(begun(store, &shares, 1).await, ["a-2"]);
    assert_eq!(claim_with(store, &shares, None).await, Claims::default());
    assert_eq!(begun(store, &TenantShares::default(), 1).await, ["a-3"], "without a bound");
}

pub(in crate::store) async fn a_job_that_is_solved_leaves_its_place_before_its_end_is_stored(store: &Store) {
    let shares = TenantShares { max_running: Some(1), ..TenantShares::default() };
    create_of(store, "a", 0..3, 0).await;
    let first = claim_with(store, &shares, None).await.begun.expect("a job");
    assert_eq!(claim_with(store, &shares, None).await, Claims::default(), "one runs");
    let claim = Claim { shares: Arc::new(shares), solved: vec![first.lease], ..Claim::one("worker", LEASE) };
    assert_eq!(store.claim(&claim, time(100)).await.expect("claims").begun.expect("a job").job.name.job, "a-1");
    assert_eq!(store.claim(&claim, time(100)).await, Ok(Claims::default()), "the second one runs");
}

pub(in crate::store) async fn a_bound_holds_however_many_claim_at_once(store: &Store) {
    let shares = TenantShares { max_running: Some(3), ..TenantShares::default() };
    create_of(store, "a", 0..12, 0).await;
    let claims = futures_util::future::join_all((0..12).map(|_| claim_with(store, &shares, None))).await;
    assert_eq!(claims.iter().filter(|claims| claims.begun.is_some()).count(), 3);
}
