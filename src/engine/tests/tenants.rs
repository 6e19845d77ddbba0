//! Tenants that share the workers.

use super::*;
use crate::store::TenantShares;

fn of(tenant: &str, behavior: Behavior) -> NewJob {
    NewJob { tenant: tenant.into(), ..new_job(behavior) }
}

/// The place of tenant `b`'s single job among those that one worker solves, the first of tenant `a`'s five being solved
/// when it comes. `second_in_hand`: the second of them is prefetched then.
async fn place_of_the_single_job(short_job: Duration, second_in_hand: bool) -> u32 {
    let test = TestEngine::start(Options { short_job, ..workers(1) }).await;
    let mut many = vec![of("a", Behavior::Wait)];
    many.extend((0..4).map(|_| NewJob {
        tenant: "a".into(),
        ..described(JobDescription { priority: 9, ..behaving(Behavior::Succeed) })
    }));
    many[0].description.priority = 10;
    let many = test.engine.submit_batch(many).await.expect("admitted");
    test.solver.until_waiting(1).await;
    if second_in_hand {
        eventually(|| async { (test.engine.inner.notifier.channel_count() == 2).then_some(()) }).await;
    }
    let single = test.engine.submit(of("b", Behavior::Succeed)).await.expect("admitted").name;
    test.solver.release();
    for job in &many {
        test.ended(&job.name).await;
    }
    test.ended(&single).await;
    call_of(&test.engine, &single).await
}

#[tokio::test]
async fn a_single_job_waits_for_the_one_that_runs_and_a_prefetched_one() {
    assert_eq!(place_of_the_single_job(Duration::ZERO, false).await, 2);
    assert_eq!(place_of_the_single_job(Duration::from_secs(3_600), true).await, 3);
}

#[tokio::test]
async fn of_a_tenant_no_more_jobs_run_than_it_may() {
    let shares = Arc::new(TenantShares { max_running: Some(1), ..TenantShares::default() });
    let test = TestEngine::start(Options { shares, ..workers(2) }).await;
    let both =
        test.engine.submit_batch(vec![of("a", Behavior::Wait), of("a", Behavior::Wait)]).await.expect("admitted");
    test.solver.until_waiting(1).await;
    // The other worker looks for work, and finds another tenant's.
    for _ in 0..3 {
        let other = test.engine.submit(of("b", Behavior::Succeed)).await.expect("admitted").name;
        assert_eq!(test.ended(&other).await.state, JobState::Succeeded);
    }
    assert_eq!(test.engine.job(&both[1].name).await.expect("exists").state, JobState::Queued);
    test.engine.cancel(&both[0].name, None).await.expect("exists");
    eventually(|| async {
        let job = test.engine.job(&both[1].name).await.expect("exists");
        (job.state == JobState::Running).then_some(())
    })
    .await;
    test.solver.release();
    assert_eq!(test.ended(&both[1].name).await.state, JobState::Succeeded);
}
