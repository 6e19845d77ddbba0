//! What the one writer commits together, what by itself, and what becomes of each.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use futures_util::FutureExt;
use futures_util::future::join_all;

use super::tests::Fixture;
use super::*;
use crate::store::{NewRecord, contract};

type Count = Arc<AtomicUsize>;

fn value(count: &Count) -> usize {
    count.load(Ordering::SeqCst)
}

/// An operation that writes nothing and counts how often it was run.
fn counting(runs: &Count) -> Operation<SqliteConnection, ()> {
    let runs = runs.clone();
    sql::operation(move |_: &mut SqliteConnection| {
        runs.fetch_add(1, Ordering::SeqCst);
        async { Ok(()) }.boxed()
    })
}

/// Counts the commits of the writer's connection from here on, this one's too.
async fn commits(store: &Sqlite) -> Count {
    let commits = Count::default();
    let counted = commits.clone();
    let hook = sql::operation(move |connection: &mut SqliteConnection| {
        let counted = counted.clone();
        async move {
            // `false`: not to be rolled back.
            let count = move || {
                counted.fetch_add(1, Ordering::SeqCst);
                false
            };
            connection.inner().commit_hook(Some(count))?;
            Ok(())
        }
        .boxed()
    });
    store.writer.write(WriteIntent::Little, hook).await.expect("hooked");
    commits
}

/// As SQLite does by itself where the disk is full: everything is rolled back, not only the statement.
async fn break_inputs_of(store: &Sqlite, trigger: &'static str) {
    store.execute(trigger).await;
}

#[tokio::test]
async fn what_waits_together_is_committed_together_and_each_is_told_what_became_of_it() {
    let fixture = Fixture::open_patient().await;
    fixture.create_job(contract::record("taken"), &contract::ROOM, contract::time(0)).await.expect("created");
    let commits = commits(&fixture).await;
    let before = value(&commits);
    let (go, held) = fixture.hold().await;
    let names: Vec<String> = (0..20).map(|number| format!("job-{number}")).chain(["taken".into()]).collect();
    let creations = names
        .iter()
        .map(|name| async { fixture.create_job(contract::record(name), &contract::ROOM, contract::time(1)).await });
    // All of them are on their way before the writer is let go.
    let (outcomes, ()) = tokio::join!(join_all(creations), async { drop(go) });
    assert_eq!(held.await.expect("no panic"), Ok(()));
    assert_eq!(value(&commits) - before, 1);
    for (name, outcome) in names.iter().zip(outcomes) {
        match (name.as_str(), outcome) {
            ("taken", Err(Error::AlreadyExists(_))) => {}
            (_, Ok(created)) => assert_eq!(fixture.job(&created.job.name).await, Ok(created.job), "{name}"),
            (_, other) => panic!("{name}: {other:?}"),
        }
    }
}

#[tokio::test]
async fn one_that_breaks_the_transaction_of_all_costs_only_itself() {
    let fixture = Fixture::open_patient().await;
    break_inputs_of(
        &fixture,
        "CREATE TRIGGER breaks BEFORE INSERT ON inputs WHEN NEW.bytes = 13 BEGIN SELECT RAISE(ROLLBACK, 'broken'); END",
    )
    .await;
    let (go, held) = fixture.hold().await;
    let runs = Count::default();
    let counted = fixture.writer.write(WriteIntent::Little, counting(&runs));
    let creations = ["a", "b", "bad", "c"].map(|name| {
        let bytes = if name == "bad" { 13 } else { 14 };
        let new = NewRecord { input: vec![1; bytes].into(), ..contract::record(name) };
        fixture.create_job(new, &contract::ROOM, contract::time(1))
    });
    let (counted, outcomes, ()) = tokio::join!(counted, join_all(creations), async { drop(go) });
    assert_eq!((held.await.expect("no panic"), counted), (Ok(()), Ok(())));
    assert_eq!(value(&runs), 2, "once in the group that was broken, once alone");
    for (name, outcome) in ["a", "b", "bad", "c"].iter().zip(outcomes) {
        let stored = fixture.job(&contract::record(name).name).await;
        assert_eq!((outcome.is_ok(), stored.is_ok()), (*name != "bad", *name != "bad"), "{name}: {outcome:?}");
    }
}

#[tokio::test]
async fn what_is_large_is_committed_by_itself_and_costs_the_others_nothing() {
    let fixture = Fixture::open_patient().await;
    // One byte beyond what is large.
    break_inputs_of(
        &fixture,
        "CREATE TRIGGER breaks BEFORE INSERT ON inputs WHEN NEW.bytes = 1048578 \
         BEGIN SELECT RAISE(ROLLBACK, 'broken'); END",
    )
    .await;
    let large = |name, more: usize| {
        let bytes = writer::LARGE_BYTES as usize + more;
        let new = NewRecord { input: vec![1; bytes].into(), ..contract::record(name) };
        fixture.create_job(new, &contract::ROOM, contract::time(1))
    };
    let commits = commits(&fixture).await;
    let before = value(&commits);
    let (go, held) = fixture.hold().await;
    let (first, second) = (Count::default(), Count::default());
    let calls = async {
        tokio::join!(
            fixture.writer.write(WriteIntent::Little, counting(&first)),
            large("large", 1),
            fixture.writer.write(WriteIntent::Little, counting(&second)),
            large("broken", 2),
        )
    };
    let ((a, whole, b, broken), ()) = tokio::join!(calls, async { drop(go) });
    assert_eq!((held.await.expect("no panic"), a, b), (Ok(()), Ok(()), Ok(())));
    assert!(whole.is_ok() && broken.is_err(), "{whole:?} {broken:?}");
    assert_eq!((value(&first), value(&second)), (1, 1), "neither was run again");
    // Of those that waited before the large one, its own, and of those after it.
    assert_eq!(value(&commits) - before, 3);
}

#[tokio::test]
async fn an_operation_that_panics_costs_only_itself() {
    let fixture = Fixture::open().await.expect("opens");
    let called = sql::operation(|_: &mut SqliteConnection| panic!("in the call"));
    let awaited = sql::operation(|_: &mut SqliteConnection| async { panic!("in what it awaits") }.boxed());
    for operation in [called, awaited] {
        let outcome: Result<(), Error> = fixture.writer.write(WriteIntent::Little, operation).await;
        assert!(matches!(outcome, Err(Error::Corrupt(_))), "{outcome:?}");
    }
    fixture.create_job(contract::record("a"), &contract::ROOM, contract::time(1)).await.expect("goes on");
}

#[tokio::test]
async fn of_a_caller_that_went_away_before_its_turn_nothing_is_written() {
    let fixture = Fixture::open().await.expect("opens");
    let (go, held) = fixture.hold().await;
    // On its way with its first poll, and behind one that waits for the other side.
    let creating = fixture.create_job(contract::record("gone"), &contract::ROOM, contract::time(1));
    assert!(creating.now_or_never().is_none());
    drop(go);
    held.await.expect("no panic").expect("held");
    fixture.create_job(contract::record("here"), &contract::ROOM, contract::time(1)).await.expect("created");
    assert!(matches!(fixture.job(&contract::record("gone").name).await, Err(Error::NotFound(_))));
}

#[tokio::test]
async fn what_is_told_not_to_have_had_its_turn_is_not_run() {
    let fixture = Fixture::open().await.expect("opens");
    let (go, held) = fixture.hold().await;
    let mut impatient = fixture.writer.clone();
    impatient.turn_timeout = Duration::from_millis(1);
    let runs = Count::default();
    let outcome = impatient.write(WriteIntent::Little, counting(&runs)).await;
    assert!(matches!(&outcome, Err(Error::Unavailable(text)) if text.contains("no turn")), "{outcome:?}");
    drop(go);
    held.await.expect("no panic").expect("held");
    // Behind it in the queue.
    fixture.create_job(contract::record("here"), &contract::ROOM, contract::time(1)).await.expect("created");
    assert_eq!(value(&runs), 0);
}

#[tokio::test]
async fn what_can_be_done_another_time_does_not_wait_for_a_writer_that_hangs() {
    let fixture = Fixture::open().await.expect("opens");
    let (go, held) = fixture.hold().await;
    let mut impatient = fixture.writer.clone();
    impatient.turn_timeout = Duration::from_millis(1);
    for outcome in [impatient.shorten().await, impatient.vacuum_pays().await.map(|_| ())] {
        assert!(matches!(&outcome, Err(Error::Unavailable(text)) if text.contains("no turn")), "{outcome:?}");
    }
    drop(go);
    held.await.expect("no panic").expect("held");
    fixture.writer.shorten().await.expect("its turn came");
}
