//! A connection to PostgreSQL: how it runs a statement, and what its errors are.

use std::borrow::Cow;
use std::sync::Arc;

use sqlx::pool::PoolConnection;
use sqlx::postgres::{PgConnection, PgRow};
use sqlx::{AssertSqlSafe, Column, Row as _, SqlSafeStr, TypeInfo, ValueRef};

use super::listener;
use crate::store::sql::{Connection, Lock, Row, Statement, Value};
use crate::store::{Error, Notification};

/// Key of the advisory lock under which jobs are admitted: any constant does that others do not use, `scpsfm` in ASCII.
const ADMISSION_LOCK: i64 = 0x7363_7073_666d;
/// The same for claims that must not pass a bound together.
const CLAIMS_LOCK: i64 = ADMISSION_LOCK + 1;

#[async_trait::async_trait]
impl Connection for PgConnection {
    fn writes_alone(&self) -> bool {
        false
    }

    async fn rows(&mut self, statement: Statement) -> Result<Vec<Row>, Error> {
        let (sql, values) = statement.into_parts();
        let sql = match sql {
            Cow::Borrowed(sql) => sql.into_sql_str(),
            Cow::Owned(sql) => AssertSqlSafe(sql).into_sql_str(),
        };
        let mut query = sqlx::query(sql);
        for value in values {
            query = match value {
                Value::Integer(value) => query.bind(value),
                Value::Text(value) => query.bind(value),
                Value::Bytes(value) => query.bind(value),
            };
        }
        let rows = query.fetch_all(self).await?;
        let Some(first) = rows.first() else { return Ok(Vec::new()) };
        let columns: Arc<[String]> = first.columns().iter().map(|column| column.name().to_owned()).collect();
        let cells = |row: &PgRow| (0..row.len()).map(|place| cell(row, place)).collect::<Result<_, _>>();
        rows.iter().map(|row| Ok(Row::new(columns.clone(), cells(row)?))).collect()
    }

    async fn take_lock(&mut self, lock: Lock) -> Result<(), Error> {
        let key = match lock {
            Lock::Admission => ADMISSION_LOCK,
            Lock::Claims => CLAIMS_LOCK,
        };
        self.rows(Statement::new("SELECT pg_advisory_xact_lock($1)").bind(key)).await.map(drop)
    }

    async fn notify(&mut self, notification: Notification) -> Result<(), Error> {
        let Some((channel, payload)) = listener::message(&notification) else { return Ok(()) };
        let notify = Statement::new("SELECT pg_notify($1, $2)").bind(channel).bind(&payload);
        self.rows(notify).await.map(drop)
    }
}

fn cell(row: &PgRow, place: usize) -> Result<Value, Error> {
    let raw = row.try_get_raw(place)?;
    if raw.is_null() {
        return Ok(Value::Integer(None));
    }
    match raw.type_info().name() {
        "INT8" => Ok(Value::Integer(row.try_get(place)?)),
        "BOOL" => Ok(Value::Integer(Some(row.try_get::<bool, _>(place)?.into()))),
        "TEXT" => Ok(Value::Text(row.try_get(place)?)),
        "BYTEA" => Ok(Value::Bytes(row.try_get(place)?)),
        // Of a function that only does something.
        "VOID" => Ok(Value::Integer(None)),
        other => Err(Error::Corrupt(format!("a column of the type {other}"))),
    }
}

/// One of the pool.
#[async_trait::async_trait]
impl Connection for PoolConnection<sqlx::Postgres> {
    fn writes_alone(&self) -> bool {
        (**self).writes_alone()
    }

    async fn rows(&mut self, statement: Statement) -> Result<Vec<Row>, Error> {
        (**self).rows(statement).await
    }

    async fn take_lock(&mut self, lock: Lock) -> Result<(), Error> {
        (**self).take_lock(lock).await
    }

    async fn notify(&mut self, notification: Notification) -> Result<(), Error> {
        (**self).notify(notification).await
    }
}

/// What an SQLSTATE says (PostgreSQL, appendix A): `disk_full`; damaged files or indices; and what waiting does not
/// mend, by its class: data (22), integrity (23), syntax or access (42).
fn of_code(code: &str) -> fn(String) -> Error {
    match code {
        "53100" => Error::NoSpace,
        "XX001" | "XX002" => Error::Corrupt,
        _ if ["22", "23", "42"].iter().any(|class| code.starts_with(class)) => Error::Corrupt,
        _ => Error::Unavailable,
    }
}

impl From<sqlx::Error> for Error {
    fn from(error: sqlx::Error) -> Self {
        let text = error.to_string();
        match error {
            sqlx::Error::Database(cause) => of_code(&cause.code().unwrap_or_default())(text),
            sqlx::Error::ColumnDecode { .. } | sqlx::Error::ColumnNotFound(_) | sqlx::Error::Decode(_) => {
                Self::Corrupt(text)
            }
            _ => Self::Unavailable(text),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_tell_a_full_disk_and_a_damaged_file() {
        let of = |code| of_code(code)(String::new());
        assert!(matches!(of("53100"), Error::NoSpace(_)));
        assert!(["XX001", "23505", "42P01"].map(of).iter().all(|error| matches!(error, Error::Corrupt(_))));
        // Too many connections, a serialization failure; no code at all.
        assert!(["53300", "40001", ""].map(of).iter().all(|error| matches!(error, Error::Unavailable(_))));
    }
}
