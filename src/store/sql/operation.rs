//! What every operation of the store is: one transaction, within a bound of time, and measured.

use std::future::Future;
use std::sync::{Arc, Mutex, PoisonError};

use futures_util::FutureExt;

use super::{Connection, Database, Operation, Size, Statement, WriteIntent, operation};
use crate::store::Error;
use crate::telemetry::metrics::{store_operation, write_fenced};

/// Waits for an operation as long as the database allows it. One that is broken off changed nothing, or all that it was
/// to change: a commit may have been on its way.
pub(super) async fn bounded<T>(
    database: &dyn Database,
    size: Size,
    operation: impl Future<Output = Result<T, Error>> + Send,
) -> Result<T, Error> {
    let Some(bound) = database.bound(size) else { return operation.await };
    match tokio::time::timeout(bound, operation).await {
        Ok(result) => result,
        Err(_) => Err(Error::Unavailable(format!("no answer within {} s", bound.as_secs_f64()))),
    }
}

/// Times an operation, failed ones too: a slow failure is still slow. Counts the writes whose lease was gone.
pub(super) async fn measured<T>(
    operation: &'static str,
    run: impl Future<Output = Result<T, Error>> + Send,
) -> Result<T, Error> {
    let _timer = store_operation(operation);
    let result = run.await;
    if let Err(Error::Fenced(_)) = &result {
        write_fenced(operation);
    }
    result
}

/// Reads outside a transaction; measured where the operation is named. `return` leaves the operation: its body
/// is an asynchronous block.
macro_rules! reads {
    ($database:expr, $operation:literal, $size:expr, |$connection:ident| $body:expr) => {
        $crate::store::sql::operation::measured($operation, async { reads!($database, $size, |$connection| $body) })
            .await
    };
    ($database:expr, $size:expr, |$connection:ident| $body:expr) => {
        $crate::store::sql::operation::bounded($database, $size, async {
            let mut reader = $database.reader($size).await?;
            let $connection = &mut *reader;
            $body
        })
        .await
    };
}
pub(super) use reads;

/// What an operation gave in the transaction that was committed.
pub(super) async fn written<T: Send + 'static>(
    database: &dyn Database,
    size: Size,
    intent: WriteIntent,
    run: Operation<dyn Connection, T>,
) -> Result<T, Error> {
    let latest = Arc::new(Mutex::new(None));
    let keep = latest.clone();
    let run_and_keep = operation::<dyn Connection, _>(move |connection| {
        let (running, keep) = (run(connection), keep.clone());
        async move {
            let value = running.await?;
            *keep.lock().unwrap_or_else(PoisonError::into_inner) = Some(value);
            Ok(())
        }
        .boxed()
    });
    database.write(size, intent, run_and_keep).await?;
    let value = latest.lock().unwrap_or_else(PoisonError::into_inner).take();
    value.ok_or_else(|| Error::Corrupt("an operation was committed without an answer".into()))
}

/// Bytes of what removes as much as there is.
pub(super) const ANY_BYTES: u64 = u64::MAX;

/// Writes in one transaction, which has the values in brackets to itself: a caller that goes away leaves it whole. They
/// are cloned for each run of it; what is large is in an [`Arc`]. Measured where the operation is named.
macro_rules! writes {
    ($database:expr, $operation:literal, $size:expr, $intent:expr, $owned:tt, |$connection:ident| $body:expr) => {
        $crate::store::sql::operation::measured($operation, async {
            writes!($database, $size, $intent, $owned, |$connection| $body)
        })
        .await
    };
    ($database:expr, $size:expr, $intent:expr, [$($owned:ident),*], |$connection:ident| $body:expr) => {{
        use $crate::store::sql::{self, operation::{bounded, written}};
        let intent: sql::WriteIntent = $intent;
        $(let $owned = $owned.clone();)*
        let run = sql::operation::<dyn sql::Connection, _>(move |$connection| {
            $(let $owned = $owned.clone();)*
            Box::pin(async move { $body })
        });
        bounded($database, $size, written($database, $size, intent, run)).await
    }};
}
pub(super) use writes;

impl dyn Database {
    /// Whether a look finds what an operation is for: it spares the writer, and the disk, a transaction.
    pub(super) async fn finds(&self, select: Statement) -> Result<bool, Error> {
        reads!(self, Size::Page, |connection| connection.row(select).await?.flag("found"))
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use crate::store::sqlite::Sqlite;
    use crate::store::{Claim, contract};
    use crate::telemetry::metrics::tests::page_after;
    use crate::telemetry::scrape::Page;

    #[test]
    fn writes_that_come_too_late_are_counted() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
        let late = async {
            let directory = tempfile::tempdir().expect("a temporary directory");
            let store = Sqlite::open(directory.path()).expect("opens");
            store.create_job(contract::record("a"), &contract::ROOM, contract::time(0)).await.expect("created");
            let claim = Claim::one("w", Duration::from_secs(1));
            let claims = store.claim(&claim, contract::time(0)).await.expect("claims");
            let lease = claims.begun.expect("a job").lease;
            store.heartbeat(&lease, contract::time(0), Duration::from_secs(1)).await.expect("holds");
            store.sweep(contract::time(2), 3).await.expect("takes it back");
            store.heartbeat(&lease, contract::time(3), Duration::from_secs(1)).await.expect_err("too late");
            store.release(&lease, contract::time(3)).await.expect_err("too late");
        };
        let page = Page::parse(&page_after(|| runtime.block_on(late)));
        for (operation, count) in [("heartbeat", 1.0), ("release", 1.0), ("finish", 0.0), ("record", 0.0)] {
            let series = format!("scpsfm_fenced_writes_total{{operation=\"{operation}\"}}");
            assert_eq!(page.value(&series), count, "{operation}");
        }
    }
}
