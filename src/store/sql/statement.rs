//! A statement with its values, and the rows it gives, in terms that every database has.

use std::sync::Arc;

use sqlx::{
    Column, ColumnIndex, Decode, Encode, Executor, IntoArguments, Row as _, SqlSafeStr, SqlStr, Type, TypeInfo,
    ValueRef,
};

use crate::store::Error;

/// A value of a statement: 64-bit integers, texts, bytes and truths are all that is stored.
#[derive(Debug, Clone)]
pub enum Value {
    Integer(Option<i64>),
    Text(Option<String>),
    Bytes(Option<Vec<u8>>),
}

impl Value {
    /// What it is, for errors; `None`: it is `NULL`.
    fn kind(&self) -> Option<&'static str> {
        match self {
            Self::Integer(value) => value.is_some().then_some("an integer"),
            Self::Text(value) => value.is_some().then_some("a text"),
            Self::Bytes(value) => value.is_some().then_some("bytes"),
        }
    }
}

/// SQL with the values of its parameters `$1`, `$2`, ...
#[derive(Debug, Clone)]
pub struct Statement {
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
) -> Result<Vec<Row>, Error>
where
    D: sqlx::Database,
    D::Arguments: IntoArguments<D>,
    &'c mut D::Connection: Executor<'c, Database = D>,
    usize: ColumnIndex<D::Row>,
    bool: for<'r> Decode<'r, D> + Type<D>,
    i64: for<'r> Decode<'r, D> + Type<D>,
    String: for<'r> Decode<'r, D> + Type<D>,
    Vec<u8>: for<'r> Decode<'r, D> + Type<D>,
    Option<i64>: for<'q> Encode<'q, D> + Type<D>,
    Option<String>: for<'q> Encode<'q, D> + Type<D>,
    Option<Vec<u8>>: for<'q> Encode<'q, D> + Type<D>,
{
    let mut query = sqlx::query::<D>(statement.sql);
    for value in statement.values {
        query = match value {
            Value::Integer(value) => query.bind(value),
            Value::Text(value) => query.bind(value),
            Value::Bytes(value) => query.bind(value),
        };
    }
    let rows = query.fetch_all(connection).await?;
    let Some(first) = rows.first() else { return Ok(Vec::new()) };
    let columns: Arc<[String]> = first.columns().iter().map(|column| column.name().to_owned()).collect();
    let cell = |row: &D::Row, place: usize| {
        let raw = row.try_get_raw(place)?;
        if raw.is_null() {
            return Ok(Value::Integer(None));
        }
        // The names that SQLite and PostgreSQL have for these types.
        match raw.type_info().name() {
            "INTEGER" | "INT8" => Ok(Value::Integer(row.try_get(place)?)),
            "BOOLEAN" | "BOOL" => Ok(Value::Integer(Some(row.try_get::<bool, _>(place)?.into()))),
            "TEXT" => Ok(Value::Text(row.try_get(place)?)),
            "BLOB" | "BYTEA" => Ok(Value::Bytes(row.try_get(place)?)),
            // Of a function that only does something.
            "VOID" => Ok(Value::Integer(None)),
            other => Err(Error::Corrupt(format!("a column of the type {other}"))),
        }
    };
    let read = |row: &D::Row| {
        Ok(Row::new(columns.clone(), (0..row.len()).map(|place| cell(row, place)).collect::<Result<_, Error>>()?))
    };
    rows.iter().map(read).collect()
}

/// A row of an answer, read by the names of its columns.
#[derive(Debug)]
pub struct Row {
    columns: Arc<[String]>,
    cells: Vec<Value>,
}

/// What a column holds as one of these types, by the variant of [`Value`] that it is in.
macro_rules! cell_as {
    ($row:expr, $column:expr, $variant:ident) => {{
        let place = $row.columns.iter().position(|name| name == $column);
        match place.and_then(|place| $row.cells.get(place)) {
            Some(Value::$variant(value)) => Ok(value.as_ref()),
            // The type of what is `NULL` is not known.
            Some(other) => match other.kind() {
                None => Ok(None),
                Some(kind) => Err(Error::Corrupt(format!("{} is {kind}", $column))),
            },
            None => Err(Error::Corrupt(format!("no column {}", $column))),
        }
    }};
}

/// What must not be `NULL`.
fn required<T>(column: &str, value: Option<T>) -> Result<T, Error> {
    value.ok_or_else(|| Error::Corrupt(format!("{column} is NULL")))
}

impl Row {
    pub(in crate::store) fn new(columns: Arc<[String]>, cells: Vec<Value>) -> Self {
        Self { columns, cells }
    }

    pub(in crate::store) fn integer(&self, column: &str) -> Result<i64, Error> {
        required(column, self.optional_integer(column)?)
    }

    pub(in crate::store) fn optional_integer(&self, column: &str) -> Result<Option<i64>, Error> {
        cell_as!(self, column, Integer).map(|value: Option<&i64>| value.copied())
    }

    pub(in crate::store) fn flag(&self, column: &str) -> Result<bool, Error> {
        Ok(self.integer(column)? != 0)
    }

    pub(in crate::store) fn text(&self, column: &str) -> Result<String, Error> {
        required(column, self.optional_text(column)?)
    }

    pub(in crate::store) fn optional_text(&self, column: &str) -> Result<Option<String>, Error> {
        cell_as!(self, column, Text).map(Option::<&String>::cloned)
    }

    pub(in crate::store) fn bytes(&self, column: &str) -> Result<&[u8], Error> {
        required(column, self.optional_bytes(column)?)
    }

    pub(in crate::store) fn optional_bytes(&self, column: &str) -> Result<Option<&[u8]>, Error> {
        cell_as!(self, column, Bytes).map(|value: Option<&Vec<u8>>| value.map(Vec::as_slice))
    }
}
