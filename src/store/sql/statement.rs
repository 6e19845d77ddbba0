//! A statement with its values, and the rows it gives, in terms that every database has.

use sqlx::{Decode, Encode, Executor, IntoArguments, SqlSafeStr, SqlStr, Type};

use crate::store::Error;

/// A value of a statement: 64-bit integers, texts, bytes and truths are all that is stored.
#[derive(Debug, Clone)]
pub(in crate::store) enum Value {
    Integer(Option<i64>),
    Text(Option<String>),
    Bytes(Option<Vec<u8>>),
}

/// SQL with the values of its parameters `$1`, `$2`, ...
#[derive(Debug, Clone)]
pub(in crate::store) struct Statement {
    sql: SqlStr,
    values: Vec<Value>,
}

impl Statement {
    pub(in crate::store) fn new(sql: &'static str) -> Self {
        Self { sql: sql.into_sql_str(), values: Vec::new() }
    }

    pub(in crate::store) fn sql(&self) -> &str {
        self.sql.as_str()
    }

    /// Of its parameters, in their order.
    pub(in crate::store) fn values(&self) -> &[Value] {
        &self.values
    }

    /// Gives the next parameter its value.
    pub(in crate::store) fn bind(mut self, value: impl Into<Value>) -> Self {
        self.values.push(value.into());
        self
    }

    /// More SQL at the end.
    pub(in crate::store) fn then(self, sql: &'static str) -> Self {
        if sql.is_empty() {
            return self;
        }
        let text = [self.sql.as_str(), sql].concat();
        // Only constants come together here.
        Self { sql: sqlx::AssertSqlSafe(text).into_sql_str(), ..self }
    }

    /// The same with other words in it, as a defect would have it.
    #[cfg(test)]
    pub(in crate::store) fn replaced(self, from: &str, to: &str) -> Self {
        Self { sql: sqlx::AssertSqlSafe(self.sql.as_str().replace(from, to)).into_sql_str(), ..self }
    }

    /// A parameter at the end of the SQL, with its value.
    pub(in crate::store) fn then_bind(self, value: impl Into<Value>) -> Self {
        let mut statement = self.bind(value);
        let text = format!("{}${}", statement.sql.as_str(), statement.values.len());
        statement.sql = sqlx::AssertSqlSafe(text).into_sql_str();
        statement
    }
}

macro_rules! value_from {
    ($($from:ty => $variant:ident: $convert:expr,)*) => {
        $(impl From<$from> for Value {
            fn from(value: $from) -> Self {
                Value::$variant(($convert)(value))
            }
        })*
    };
}

value_from! {
    i64 => Integer: Some,
    i32 => Integer: |value| Some(i64::from(value)),
    u32 => Integer: |value| Some(i64::from(value)),
    Option<i64> => Integer: std::convert::identity,
    &str => Text: |value: &str| Some(value.to_owned()),
    &String => Text: |value: &String| Some(value.clone()),
    Option<&str> => Text: |value: Option<&str>| value.map(str::to_owned),
    Vec<u8> => Bytes: Some,
    &[u8] => Bytes: |value: &[u8]| Some(value.to_vec()),
    Option<Vec<u8>> => Bytes: std::convert::identity,
}

/// Runs a statement on a connection of sqlx.
pub(in crate::store) async fn run<'c, D>(
    connection: &'c mut D::Connection,
    statement: Statement,
) -> Result<Vec<D::Row>, Error>
where
    D: sqlx::Database,
    D::Arguments: IntoArguments<D>,
    &'c mut D::Connection: Executor<'c, Database = D>,
    for<'q> Option<i64>: Encode<'q, D> + Type<D>,
    for<'q> Option<String>: Encode<'q, D> + Type<D>,
    for<'q> Option<Vec<u8>>: Encode<'q, D> + Type<D>,
{
    let mut query = sqlx::query::<D>(statement.sql);
    for value in statement.values {
        query = match value {
            Value::Integer(value) => query.bind(value),
            Value::Text(value) => query.bind(value),
            Value::Bytes(value) => query.bind(value),
        };
    }
    Ok(query.fetch_all(connection).await?)
}

/// A row of an answer, read by the names of its columns.
pub(in crate::store) trait Row: Send + Sync {
    fn integer(&self, column: &str) -> Result<i64, Error>;
    fn optional_integer(&self, column: &str) -> Result<Option<i64>, Error>;
    fn flag(&self, column: &str) -> Result<bool, Error>;
    fn text(&self, column: &str) -> Result<String, Error>;
    fn optional_text(&self, column: &str) -> Result<Option<String>, Error>;
    fn bytes(&self, column: &str) -> Result<Vec<u8>, Error>;
    fn optional_bytes(&self, column: &str) -> Result<Option<Vec<u8>>, Error>;
}

impl<R> Row for R
where
    R: sqlx::Row,
    for<'n> &'n str: sqlx::ColumnIndex<R>,
    for<'r> i64: Decode<'r, R::Database> + Type<R::Database>,
    for<'r> bool: Decode<'r, R::Database> + Type<R::Database>,
    for<'r> String: Decode<'r, R::Database> + Type<R::Database>,
    for<'r> Vec<u8>: Decode<'r, R::Database> + Type<R::Database>,
{
    fn integer(&self, column: &str) -> Result<i64, Error> {
        Ok(self.try_get(column)?)
    }

    fn optional_integer(&self, column: &str) -> Result<Option<i64>, Error> {
        Ok(self.try_get(column)?)
    }

    fn flag(&self, column: &str) -> Result<bool, Error> {
        Ok(self.try_get(column)?)
    }

    fn text(&self, column: &str) -> Result<String, Error> {
        Ok(self.try_get(column)?)
    }

    fn optional_text(&self, column: &str) -> Result<Option<String>, Error> {
        Ok(self.try_get(column)?)
    }

    fn bytes(&self, column: &str) -> Result<Vec<u8>, Error> {
        Ok(self.try_get(column)?)
    }

    fn optional_bytes(&self, column: &str) -> Result<Option<Vec<u8>>, Error> {
        Ok(self.try_get(column)?)
    }
}
