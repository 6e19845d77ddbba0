//! Listing uploaded inputs: the query and the page.

use super::query::{Cursor, cursor_of, effective};
use super::{Error, StoredInput};

/// Which uploaded inputs of a tenant to list, the newest first.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct InputQuery {
    pub tenant: String,
    /// As in [`JobQuery`].
    pub page_size: u32,
    /// `None` or empty: the first page.
    pub page_token: Option<String>,
}

impl InputQuery {
    pub(super) fn effective_page_size(&self) -> u32 {
        effective(self.page_size)
    }

    /// See [`JobQuery::cursor`].
    pub(super) fn cursor(&self) -> Result<Option<Cursor>, Error> {
        cursor_of(self.page_token.as_deref(), |cursor| self.token_after(cursor))
    }

    /// The token of the page that begins after `cursor`.
    pub(super) fn token_after(&self, cursor: &Cursor) -> String {
        cursor.token(&("inputs", &self.tenant))
    }
}

/// One page of uploaded inputs.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct InputPage {
    pub inputs: Vec<StoredInput>,
    /// `None` on the last page.
    pub next_page_token: Option<String>,
}
