//! What several servers do to one input at once: nobody waits for ever, and nothing is left behind.

use std::sync::Arc;

use futures_util::future::join_all;

use super::tests::Fixture;
use super::*;
use crate::domain::job::JobName;
use crate::store::contract::uploads::{ROOMY, finished, name, new};
use crate::store::contract::{ROOM, record, time};
use crate::store::record::{JobInput, NewRecord, Prefetch, TenantShares};
use crate::store::{BegunUpload, Claim};

/// Enough for orders of locks that differ to meet: without the one order, each of these tests fails within a few.
const ROUNDS: u32 = 40;

fn job(id: &str, input: &str) -> NewRecord {
    NewRecord { input: JobInput::Uploaded { input: input.into(), bytes: 50 }, ..record(id) }
}

#[tokio::test]
async fn a_finished_upload_is_begun_again_beside_jobs_that_are_created_with_it() {
    let Some(fixture) = Fixture::open().await else { return };
    finished(&*fixture, "a", vec![7; 10], 0).await;
    for round in 0..ROUNDS {
        let begins = (0..3).map(|_| async { fixture.begin_upload(&new("a", 4), &ROOMY, time(1)).await.map(drop) });
        let creates = (0..2).map(|number| {
            let new = job(&format!("job-{round}-{number}"), "a");
            async { fixture.create_job(new, &ROOM, time(1)).await.map(drop) }
        });
        let (begun, created) = tokio::join!(join_all(begins), join_all(creates));
        assert!(begun.iter().chain(&created).all(Result::is_ok), "round {round}: {begun:?} {created:?}");
    }
}

#[tokio::test]
async fn batches_name_the_same_inputs_in_any_order() {
    let Some(fixture) = Fixture::open().await else { return };
    for input in ["a", "b"] {
        finished(&*fixture, input, vec![7; 10], 0).await;
    }
    for round in 0..ROUNDS {
        let batches = [["a", "b"], ["b", "a"]].map(|inputs| {
            let id = |input: &str| format!("job-{round}-{}-{input}", inputs[0]);
            let news = inputs.map(|input| job(&id(input), input)).to_vec();
            async { fixture.create_jobs(news, &ROOM, time(1)).await.map(drop) }
        });
        let created = join_all(batches).await;
        assert!(created.iter().all(Result::is_ok), "round {round}: {created:?}");
    }
}

#[tokio::test]
async fn an_input_is_deleted_beside_those_who_begin_it_again() {
    let Some(fixture) = Fixture::open().await else { return };
    for round in 0..ROUNDS {
        let id = format!("input-{round}");
        finished(&*fixture, &id, vec![7; 10], 0).await;
        let upload = new(&id, 4);
        let begins = (0..3).map(|_| fixture.begin_upload(&upload, &ROOMY, time(1)));
        let named = name(&id);
        let (begun, deleted) = tokio::join!(join_all(begins), fixture.delete_input(&named));
        assert_eq!(deleted, Ok(()), "round {round}");
        for begun in begun {
            // Before it was deleted, or after: a new upload of nothing yet.
            let known = matches!(begun, Ok(BegunUpload::Finished(_) | BegunUpload::Open { committed: 0, .. }));
            assert!(known, "round {round}: {begun:?}");
        }
    }
}

#[tokio::test]
async fn of_an_input_that_loses_its_name_and_its_last_job_at_once_nothing_is_left() {
    let Some(fixture) = Fixture::open().await else { return };
    for round in 0..ROUNDS {
        let id = format!("input-{round}");
        finished(&*fixture, &id, vec![7; 10], 0).await;
        let jobs = ["x", "y"].map(|job| format!("job-{round}-{job}"));
        for id_of_job in &jobs {
            fixture.create_job(job(id_of_job, &id), &ROOM, time(1)).await.expect("created");
            fixture.request_cancel(&record(id_of_job).name, None, time(2)).await.expect("ended");
        }
        let named = name(&id);
        let removals = jobs.iter().map(|job| async {
            let job = record(job).name;
            fixture.delete_job(&job, None).await
        });
        let (removed, deleted) = tokio::join!(join_all(removals), fixture.delete_input(&named));
        assert!(removed.iter().chain([&deleted]).all(Result::is_ok), "round {round}: {removed:?} {deleted:?}");
        let left = Statement::new("SELECT COUNT(*) AS count FROM inputs");
        let rows = fixture.reader(Size::Small).await.expect("a connection").rows(left).await.expect("counts");
        assert_eq!(rows[0].integer("count"), Ok(0), "round {round}");
    }
}

#[tokio::test]
async fn claims_of_several_tenants_meet_creations_and_cancels() {
    let Some(fixture) = Fixture::open().await else { return };
    let of = |tenant: &str, id: String| NewRecord { name: JobName { tenant: tenant.into(), job: id }, ..record("") };
    let prefetch = Some(Prefetch { lease_for: Duration::from_secs(1), max_observations: u32::MAX });
    for round in 0..ROUNDS {
        // With a bound and without one.
        let shares =
            Arc::new(TenantShares { max_running: (round % 2 == 0).then_some(1_000), ..TenantShares::default() });
        let claim = Claim { prefetch, shares, ..Claim::one("w", Duration::from_secs(30)) };
        let creates = ["a", "b"].map(|tenant| {
            let news = (0..3).map(|number| of(tenant, format!("{round}-{number}"))).collect();
            async { fixture.create_jobs(news, &ROOM, time(1)).await.map(drop) }
        });
        assert!(join_all(creates).await.iter().all(Result::is_ok), "round {round}");
        let claims = (0..3).map(|_| async {
            let prefetched = fixture.claim(&claim, time(1)).await?.prefetched;
            let begin = prefetched.map(|prefetched| (prefetched.lease, prefetched.job.create_time));
            fixture.claim(&Claim { begin, ..claim.clone() }, time(1)).await.map(drop)
        });
        let cancels = ["a", "b"].map(|tenant| {
            let name = of(tenant, format!("{round}-1")).name;
            async { fixture.request_cancel(&{ name }, None, time(1)).await.map(drop) }
        });
        let more = async { fixture.create_job(of("c", round.to_string()), &ROOM, time(1)).await.map(drop) };
        let (claimed, cancelled, created) = tokio::join!(join_all(claims), join_all(cancels), more);
        assert!(claimed.iter().chain(&cancelled).chain([&created]).all(Result::is_ok), "round {round}: {claimed:?}");
    }
}
