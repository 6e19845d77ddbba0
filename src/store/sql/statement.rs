//! A statement with its values, and the rows it gives, in terms that every database has.

use std::borrow::Cow;
use std::sync::Arc;

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
    sql: Cow<'static, str>,
    values: Vec<Value>,
}

impl Statement {
    pub(in crate::store) fn new(sql: &'static str) -> Self {
        Self { sql: sql.into(), values: Vec::new() }
    }

    pub(in crate::store) fn sql(&self) -> &str {
        &self.sql
    }

    /// Its SQL, which is made of constants alone, and its values.
    pub(in crate::store) fn into_parts(self) -> (Cow<'static, str>, Vec<Value>) {
        (self.sql, self.values)
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
    pub(in crate::store) fn then(mut self, sql: &'static str) -> Self {
        if !sql.is_empty() {
            self.sql.to_mut().push_str(sql);
        }
        self
    }

    /// A parameter at the end of the SQL, with its value.
    pub(in crate::store) fn then_bind(self, value: impl Into<Value>) -> Self {
        let mut statement = self.bind(value);
        let parameter = format!("${}", statement.values.len());
        statement.sql.to_mut().push_str(&parameter);
        statement
    }

    /// The same with other words in it, as a defect would have it.
    #[cfg(test)]
    pub(in crate::store) fn replaced(self, from: &str, to: &str) -> Self {
        Self { sql: self.sql.replace(from, to).into(), ..self }
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
