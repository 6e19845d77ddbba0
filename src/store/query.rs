//! Listing jobs and uploaded inputs: the queries, a page, and the token that leads to the next one.

use std::collections::BTreeMap;
use std::fmt::Debug;

use sha2::{Digest, Sha256};

use super::Error;
use crate::domain::job::{JobName, JobState};

/// Order of a listing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Order {
    /// Newest first.
    #[default]
    CreateTimeDescending,
    /// Oldest first.
    CreateTimeAscending,
}

/// Which jobs of a tenant to list.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct JobQuery {
    pub tenant: String,
    /// Empty: every state.
    pub states: Vec<JobState>,
    /// All of them must be on the job.
    pub labels: BTreeMap<String, String>,
    pub order: Order,
    /// 0: [`JobQuery::DEFAULT_PAGE_SIZE`]; above [`JobQuery::MAX_PAGE_SIZE`]: that (AIP-158).
    pub page_size: u32,
    /// `None` or empty: the first page.
    pub page_token: Option<String>,
}

impl JobQuery {
    /// A screen of jobs.
    pub const DEFAULT_PAGE_SIZE: u32 = 50;
    /// Keeps an answer well under the message limit.
    pub const MAX_PAGE_SIZE: u32 = 1000;
}

/// Which uploaded inputs of a tenant to list, the newest first.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct InputQuery {
    pub tenant: String,
    /// As in [`JobQuery`].
    pub page_size: u32,
    /// `None` or empty: the first page.
    pub page_token: Option<String>,
}

/// A query that is answered page by page.
pub(super) trait Paged {
    /// The size and the token of the page that is asked for.
    fn asked(&self) -> (u32, Option<&str>);

    /// The token of the page that begins after `cursor`.
    fn token_after(&self, cursor: &Cursor) -> String;

    /// The page size in force.
    fn effective_page_size(&self) -> u32 {
        match self.asked().0 {
            0 => JobQuery::DEFAULT_PAGE_SIZE,
            size => size.min(JobQuery::MAX_PAGE_SIZE),
        }
    }

    /// Where the page begins; `None`: at the first one of all.
    ///
    /// # Errors
    /// [`Error::PageToken`] for a token that was not made for this query (AIP-158: only the page size may change).
    fn cursor(&self) -> Result<Option<Cursor>, Error> {
        let Some(token) = self.asked().1.filter(|token| !token.is_empty()) else { return Ok(None) };
        let cursor = Cursor::parse(token).filter(|cursor| self.token_after(cursor) == token);
        cursor.map(Some).ok_or(Error::PageToken)
    }
}

impl Paged for JobQuery {
    fn asked(&self) -> (u32, Option<&str>) {
        (self.page_size, self.page_token.as_deref())
    }

    fn token_after(&self, cursor: &Cursor) -> String {
        cursor.token(&(&self.tenant, &self.states, &self.labels, self.order))
    }
}

impl Paged for InputQuery {
    fn asked(&self) -> (u32, Option<&str>) {
        (self.page_size, self.page_token.as_deref())
    }

    fn token_after(&self, cursor: &Cursor) -> String {
        cursor.token(&("inputs", &self.tenant))
    }
}

/// One page of a listing.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Page<T> {
    pub items: Vec<T>,
    /// `None` on the last page.
    pub next_page_token: Option<String>,
}

/// The last job or input of a page; those of one microsecond are told apart by their id. Nothing in it is of another
/// tenant.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Cursor {
    pub create_micros: i64,
    pub id: String,
}

impl Cursor {
    fn parse(token: &str) -> Option<Self> {
        let (_, rest) = token.split_once('-')?;
        let (create_micros, id) = rest.split_once('-')?;
        let create_micros = i64::from_str_radix(create_micros, 16).ok()?;
        JobName::is_id(id).then(|| Self { create_micros, id: id.to_owned() })
    }

    /// The token of the page of this query that begins after it. The digest ties it to its query, and its parts to each
    /// other; a slip is to be caught, nothing is to be kept secret, so 64 bits do.
    pub fn token(&self, query: &impl Debug) -> String {
        let digest = Sha256::digest(format!("{:?}", (query, self)));
        let digest = digest.iter().take(8).fold(0_u64, |value, &byte| value << 8 | u64::from(byte));
        format!("{digest:016x}-{:x}-{}", self.create_micros, self.id)
    }
}

#[cfg(test)]
mod tests {
    use super::{Cursor, JobQuery, Order, Paged};
    use crate::store::Error;

    #[test]
    fn a_token_leads_back_into_its_own_query_only() {
        let mut query = JobQuery::default();
        let cursor = Cursor { create_micros: 1_700_000_000_000_001, id: "a-1-b".into() };
        query.page_token = Some(query.token_after(&cursor));
        assert_eq!(query.cursor(), Ok(Some(cursor.clone())));
        query.page_size = 7;
        assert_eq!(query.cursor(), Ok(Some(cursor)), "the page size may change between pages");
        query.order = Order::CreateTimeAscending;
        assert_eq!(query.cursor(), Err(Error::PageToken));
        query.order = Order::default();
        let token = query.page_token.take().expect("a token");
        let wrong = [format!("{token}0"), token[..token.len() - 1].to_owned(), token.replace("-a-1-b", "-a-2-b")];
        for bad in ["x", "-", "0-0-0", "0000000000000000-1-1"].map(str::to_owned).into_iter().chain(wrong) {
            query.page_token = Some(bad.clone());
            assert_eq!(query.cursor(), Err(Error::PageToken), "{bad}");
        }
    }
}
