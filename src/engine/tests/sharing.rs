//! Two engines on one PostgreSQL without notifications of each other: polls and heartbeats alone carry everything.

use super::*;
use crate::store::postgres::Postgres;
use crate::store::postgres::tests::cluster;

#[tokio::test]
async fn without_notifications_a_job_is_watched_and_cancelled_from_elsewhere() {
    let Some(cluster) = cluster::shared("engines that share a store") else { return };
    let url = cluster.database().await.parse().expect("an address");
    let solver = Arc::new(FakeSolver::default());
    let options = Options { lease: Duration::from_secs(3), max_attempts: u32::MAX, ..workers(1) };
    let mut engines = Vec::new();
    for _ in 0..2 {
        let mut store = Postgres::open(&url).await.expect("opens");
        store.deaf = true;
        engines
            .push(Engine::start(options.clone(), Arc::new(store), solver.solver_fn(), encode).await.expect("starts"));
    }
    let name = engines[0].submit(new_job(Behavior::Wait)).await.expect("admitted").name;
    solver.until_waiting(1).await;
    let other = engines.iter().find(|engine| super::super::locked(&engine.inner.running).is_empty());
    let mut watch = other.expect("one of them idles").watch(&name, 0).await.expect("exists");
    other.expect("one of them idles").cancel(&name, None).await.expect("flags");
    let events = rest(&mut watch).await;
    assert_contiguous(&events, 1);
    assert_eq!(events.last().and_then(terminal), Some(JobState::Cancelled));
    for engine in engines {
        engine.drain(Duration::ZERO).await;
    }
}
