//! What is taken on and what is refused.

use super::*;
use crate::domain::job::DEFAULT_TENANT;
use crate::engine::{Error, JobQuery, StoreError};
use crate::store::TakenId;

fn of_default() -> JobQuery {
    JobQuery { tenant: DEFAULT_TENANT.into(), ..JobQuery::default() }
}

#[tokio::test]
async fn a_full_queue_refuses_at_once_and_takes_on_again() {
    let mut options = workers(1);
    options.queue.max_jobs = 1;
    let test = TestEngine::start(options).await;
    test.submit(Behavior::Wait).await;
    test.solver.until_waiting(1).await;
    let waiting = test.submit(Behavior::Wait).await;
    match test.engine.submit(new_job(Behavior::Wait)).await {
        Err(Error::Store(StoreError::QueueFull(bound))) => {
            assert_eq!(bound.to_string(), "the queue is full: jobs waiting: 1, asked for: 1, allowed: 1");
        }
        other => panic!("{other:?}"),
    }
    test.engine.cancel(&waiting, None).await.expect("exists");
    test.submit(Behavior::Wait).await;
}

#[tokio::test]
async fn one_request_is_one_job_however_often_it_is_sent() {
    let test = TestEngine::start(workers(1)).await;
    let description = |behavior| JobDescription { request_id: Some("r-1".into()), ..behaving(behavior) };
    let request = |behavior| described(description(behavior));
    let calls = (0..20).map(|_| test.engine.submit(request(Behavior::Succeed)));
    let jobs = futures_util::future::join_all(calls).await;
    let name = jobs[0].as_ref().expect("admitted").name.clone();
    for job in jobs {
        assert_eq!(job.expect("the same request").name, name);
    }
    test.ended(&name).await;
    let late = test.engine.submit(request(Behavior::Succeed)).await.expect("the same request");
    assert_eq!((&late.name, late.state), (&name, JobState::Succeeded));
    let traced = NewJob { trace_parent: Some("another call".into()), ..request(Behavior::Succeed) };
    assert_eq!(test.engine.submit(traced).await.expect("the same request").name, name);
    for other in [
        request(Behavior::Wait),
        described(JobDescription { priority: 1, ..description(Behavior::Succeed) }),
        described(JobDescription { job_id: Some("mine".into()), ..description(Behavior::Succeed) }),
        described(JobDescription {
            deadline: Some(crate::engine::Deadline::After(Duration::from_secs(1))),
            ..description(Behavior::Succeed)
        }),
    ] {
        assert!(matches!(test.engine.submit(other).await, Err(Error::Store(StoreError::AlreadyExists(_)))));
    }
    assert_eq!(test.solver.calls.load(Ordering::SeqCst), 1);
    assert_eq!(test.engine.list(&of_default()).await.expect("lists").items.len(), 1);
}

#[tokio::test]
async fn bad_arguments_name_their_field() {
    let test = TestEngine::start(workers(1)).await;
    let fields = |error: Error| match error {
        Error::InvalidArgument(invalid) => {
            invalid.violations().iter().map(|violation| violation.field.clone()).collect::<Vec<_>>()
        }
        other => panic!("{other:?}"),
    };
    let mut bad = new_job(Behavior::Succeed);
    bad.tenant = "A".into();
    bad.description.job_id = Some("-".into());
    let error = test.engine.submit(bad).await.expect_err("refused");
    assert_eq!(fields(error), ["tenant", "job_id"]);
    let mut bad = new_job(Behavior::Succeed);
    bad.description.settings.alpha = f64::NAN;
    assert_eq!(fields(test.engine.submit(bad).await.expect_err("refused")), ["job.settings.alpha"]);
    let name = test.submit(Behavior::Succeed).await;
    let last = test.ended(&name).await.last_sequence;
    assert_eq!(fields(test.engine.watch(&name, last + 1).await.expect_err("refused")), ["after_sequence"]);
}

#[tokio::test]
async fn a_page_token_of_no_page_is_refused() {
    let test = TestEngine::start(workers(1)).await;
    let query = JobQuery { page_token: Some("x".into()), ..of_default() };
    assert_eq!(test.engine.list(&query).await, Err(StoreError::PageToken.into()));
}

#[tokio::test]
async fn job_ids_are_the_callers_or_made() {
    let test = TestEngine::start(workers(1)).await;
    let mine = || described(JobDescription { job_id: Some("mine".into()), ..behaving(Behavior::Succeed) });
    let job = test.engine.submit(mine()).await.expect("admitted");
    assert_eq!(job.name.to_string(), "tenants/default/jobs/mine");
    let taken = test.engine.submit(mine()).await.expect_err("taken");
    assert_eq!(
        taken,
        StoreError::AlreadyExists(TakenId::Job(JobName { tenant: "default".into(), job: "mine".into() })).into()
    );
    let made = test.submit(Behavior::Succeed).await;
    assert!(JobName::parse(&made.to_string()).is_some(), "{made}");
    let missing = JobName { tenant: "other".into(), job: "mine".into() };
    assert_eq!(test.engine.job(&missing).await, Err(StoreError::NotFound(missing.clone()).into()));
    assert_eq!(test.engine.cancel(&missing, None).await, Err(StoreError::NotFound(missing.clone()).into()));
    assert_eq!(test.engine.watch(&missing, 0).await.map(|_| ()), Err(StoreError::NotFound(missing).into()));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_hundred_jobs_of_twenty_callers_on_two_workers_all_end() {
    let test = TestEngine::start(workers(2)).await;
    let callers = (0..20).map(|_| {
        let engine = test.engine.clone();
        tokio::spawn(async move {
            let mut names = Vec::new();
            for _ in 0..5 {
                names.push(engine.submit(new_job(Behavior::Succeed)).await.expect("admitted").name);
            }
            for name in &names {
                let mut watch = engine.watch(name, 0).await.expect("exists");
                let events = rest(&mut watch).await;
                assert_contiguous(&events, 1);
                assert_eq!(events.last().and_then(terminal), Some(JobState::Succeeded));
                let running = EventBody::State { state: JobState::Running, failure: None };
                assert_eq!(events.iter().filter(|event| event.body == running).count(), 1);
            }
            names
        })
    });
    let mut names = Vec::new();
    for caller in futures_util::future::join_all(callers).await {
        names.extend(caller.expect("no panic"));
    }
    names.sort();
    names.dedup();
    assert_eq!(names.len(), 100);
    // One that is prefetched while another slot begins it may be begun for nothing.
    assert!(test.solver.calls.load(Ordering::SeqCst) >= 100);
    assert_eq!(test.engine.queue_stats().await.expect("counts"), crate::engine::QueueStats::default());
    eventually(|| async { (test.engine.inner.notifier.channel_count() == 0).then_some(()) }).await;
}
