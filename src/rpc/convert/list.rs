//! Filter and order of a list: the subset of AIP-160 and AIP-132 that jobs need.

use std::collections::BTreeMap;

use crate::domain::error::quoted;
use crate::domain::job::JobState;
use crate::domain::{InvalidInput, Violation};
use crate::engine::{JobQuery, Order};
use crate::rpc::proto;

/// Longest filter: some two hundred terms, far from what a store can take in one query.
const MAX_FILTER_BYTES: usize = 4_096;

/// Which jobs a filter lets through.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Filter {
    /// `None`: every state. Empty: none, since the terms exclude each other.
    pub states: Option<Vec<JobState>>,
    pub labels: BTreeMap<String, String>,
}

/// The query of a list, `None` where its filter lets nothing through.
///
/// # Errors
/// Violations of `page_size`, `filter` or `order_by`.
pub fn from_wire(tenant: String, request: proto::ListJobsRequest) -> Result<Option<JobQuery>, InvalidInput> {
    if request.page_size < 0 {
        return Err(Violation::of("page_size", format!("{} is negative", request.page_size)).into());
    }
    let order = match request.order_by.split_whitespace().collect::<Vec<_>>().as_slice() {
        [] | ["create_time", "desc"] => Order::CreateTimeDescending,
        ["create_time"] => Order::CreateTimeAscending,
        _ => {
            let text = format!("{} is neither \"create_time\" nor \"create_time desc\"", quoted(&request.order_by));
            return Err(Violation::of("order_by", text).into());
        }
    };
    let Filter { states, labels } = parse_filter(&request.filter)?;
    if states.as_ref().is_some_and(Vec::is_empty) {
        return Ok(None);
    }
    Ok(Some(JobQuery {
        tenant,
        states: states.unwrap_or_default(),
        labels,
        order,
        // Larger wishes are cut (AIP-158).
        page_size: request.page_size.unsigned_abs().min(JobQuery::MAX_PAGE_SIZE),
        page_token: super::given(request.page_token),
    }))
}

/// Parses a filter: terms joined by `AND`, states within a term also by `OR`.
///
/// # Errors
/// A violation of `filter` that says which part was not understood.
pub fn parse_filter(text: &str) -> Result<Filter, Violation> {
    if text.len() > MAX_FILTER_BYTES {
        return Err(Violation::of("filter", format!("{} bytes are above {MAX_FILTER_BYTES}", text.len())));
    }
    let tokens = tokens(text)?;
    let mut filter = Filter::default();
    if tokens.is_empty() {
        return Ok(filter);
    }
    for term in tokens.split(|token| *token == Token::Word("AND")) {
        let mut states = Vec::new();
        for comparison in term.split(|token| *token == Token::Word("OR")) {
            match *comparison {
                [Token::Word("state"), Token::Equals, name @ (Token::Word(_) | Token::Quoted(_))] => {
                    // Once each: a repeated state says nothing more, and a filter has room for hundreds.
                    let state = state(&name.text())?;
                    if !states.contains(&state) {
                        states.push(state);
                    }
                }
                [Token::Word(field), Token::Equals, value @ (Token::Word(_) | Token::Quoted(_))]
                    if field.starts_with("labels.") && !term.contains(&Token::Word("OR")) =>
                {
                    add_label(&mut filter, &field["labels.".len()..], value.text())?;
                }
                _ => return Err(not_understood(text)),
            }
        }
        if !states.is_empty() {
            let others = filter.states.take();
            filter.states = Some(match others {
                Some(others) => others.into_iter().filter(|state| states.contains(state)).collect(),
                None => states,
            });
        }
    }
    Ok(filter)
}

fn state(name: &str) -> Result<JobState, Violation> {
    JobState::from_name(name).ok_or_else(|| {
        let known = JobState::ALL.map(JobState::name).join(", ");
        Violation::of("filter", format!("{} is not a state; states are {known}", quoted(name)))
    })
}

fn add_label(filter: &mut Filter, key: &str, value: String) -> Result<(), Violation> {
    if key.contains('\0') || value.contains('\0') {
        return Err(Violation::of("filter", "a label holds no NUL characters"));
    }
    match filter.labels.get(key) {
        Some(other) if *other != value => {
            let (key, other, value) = (quoted(key), quoted(other), quoted(&value));
            Err(Violation::of("filter", format!("the label {key} cannot be both {other} and {value}")))
        }
        _ => {
            filter.labels.insert(key.to_owned(), value);
            Ok(())
        }
    }
}

fn not_understood(text: &str) -> Violation {
    let example = "state = QUEUED OR state = RUNNING AND labels.site = \"north 3\"";
    Violation::of("filter", format!("{} was not understood; an example: {example}", quoted(text)))
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Token<'a> {
    Word(&'a str),
    /// What is between the quotes, escapes included.
    Quoted(&'a str),
    Equals,
}

impl Token<'_> {
    fn text(self) -> String {
        match self {
            Token::Word(text) => text.to_owned(),
            Token::Quoted(text) => {
                let mut chars = text.chars();
                let unescaped = || chars.next().and_then(|c| if c == '\\' { chars.next() } else { Some(c) });
                std::iter::from_fn(unescaped).collect()
            }
            Token::Equals => "=".to_owned(),
        }
    }
}

fn tokens(text: &str) -> Result<Vec<Token<'_>>, Violation> {
    let mut tokens = Vec::new();
    let mut rest = text.trim_start();
    while let Some(first) = rest.chars().next() {
        let (token, after) = match first {
            '=' => (Token::Equals, &rest[1..]),
            '"' => {
                let end = closing_quote(&rest[1..])?;
                (Token::Quoted(&rest[1..=end]), &rest[end + 2..])
            }
            _ => {
                let end = rest.find(|c: char| c.is_whitespace() || c == '=' || c == '"').unwrap_or(rest.len());
                (Token::Word(&rest[..end]), &rest[end..])
            }
        };
        tokens.push(token);
        rest = after.trim_start();
    }
    Ok(tokens)
}

/// Where the quote is that closes a text; within, a backslash escapes a quote or a backslash (AIP-160).
fn closing_quote(text: &str) -> Result<usize, Violation> {
    let mut chars = text.char_indices();
    while let Some((place, char)) = chars.next() {
        match char {
            '"' => return Ok(place),
            '\\' => match chars.next() {
                Some((_, '"' | '\\')) => {}
                _ => return Err(Violation::of("filter", r#"in quotes \ is written \\ and " is written \""#)),
            },
            _ => {}
        }
    }
    Err(Violation::of("filter", "a quote is not closed"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn filter(states: Option<&[JobState]>, labels: &[(&str, &str)]) -> Filter {
        Filter {
            states: states.map(<[JobState]>::to_vec),
            labels: labels.iter().map(|(key, value)| ((*key).to_owned(), (*value).to_owned())).collect(),
        }
    }

    #[test]
    fn filters_are_understood() {
        use JobState::{Queued, Running};
        let cases = [
            ("", filter(None, &[])),
            ("  ", filter(None, &[])),
            ("state=RUNNING", filter(Some(&[Running]), &[])),
            ("state = \"RUNNING\"", filter(Some(&[Running]), &[])),
            ("state = QUEUED OR state = RUNNING", filter(Some(&[Queued, Running]), &[])),
            ("labels.site = \"north = 3\"", filter(None, &[("site", "north = 3")])),
            ("labels.a=b AND state = QUEUED OR state = RUNNING", filter(Some(&[Queued, Running]), &[("a", "b")])),
            ("state = QUEUED AND state = RUNNING", filter(Some(&[]), &[])),
            ("state = RUNNING OR state = QUEUED OR state = RUNNING", filter(Some(&[Running, Queued]), &[])),
            ("state = QUEUED OR state = QUEUED AND state = QUEUED", filter(Some(&[Queued]), &[])),
            ("labels.a = \"\"", filter(None, &[("a", "")])),
            (r#"labels.a = "say \"é\"""#, filter(None, &[("a", "say \"é\"")])),
            (r#"labels.a = "C:\\" AND labels.b = "\\\"""#, filter(None, &[("a", "C:\\"), ("b", "\\\"")])),
            (r"labels.a = C:\new", filter(None, &[("a", r"C:\new")])),
            (
                r#"state = "RUNNING" AND labels.a = "\" OR state = QUEUED""#,
                filter(Some(&[Running]), &[("a", "\" OR state = QUEUED")]),
            ),
        ];
        for (text, expected) in cases {
            assert_eq!(parse_filter(text), Ok(expected), "{text}");
        }
    }

    #[test]
    fn what_is_not_understood_is_refused() {
        for text in [
            "state",
            "state = ",
            "state = LOST",
            "state > QUEUED",
            "focal = 3",
            "labels.a = b OR labels.c = d",
            "labels.a = b AND labels.a = c",
            "labels.a = \"b",
            r#"labels.a = "b\""#,
            r#"labels.a = "b\"#,
            r#"labels.a = "b\n""#,
            r#"labels.a = "b\\"c""#,
            "AND",
            "state = QUEUED state = RUNNING",
            "é",
        ] {
            assert_eq!(parse_filter(text).map_err(|violation| violation.field), Err("filter".to_owned()), "{text}");
        }
    }

    #[test]
    fn a_filter_is_bounded_and_however_long_asks_for_each_state_once() {
        let term = "state = QUEUED OR ";
        let longest = format!("{}state = RUNNING", term.repeat((MAX_FILTER_BYTES - 15) / term.len()));
        assert!(longest.len() <= MAX_FILTER_BYTES, "{}", longest.len());
        assert_eq!(parse_filter(&longest), Ok(filter(Some(&[JobState::Queued, JobState::Running]), &[])));
        let padded = |bytes: usize| format!("state = QUEUED{}", " ".repeat(bytes - "state = QUEUED".len()));
        assert!(parse_filter(&padded(MAX_FILTER_BYTES)).is_ok());
        let error = parse_filter(&padded(MAX_FILTER_BYTES + 1)).expect_err("one byte too many");
        assert_eq!(error.to_string(), "filter: 4097 bytes are above 4096");
    }

    #[test]
    fn page_sizes_and_tokens_reach_the_query() {
        let list = |page_size, page_token: &str| {
            let request = proto::ListJobsRequest { page_size, page_token: page_token.into(), ..Default::default() };
            let query = from_wire("default".into(), request).expect("valid").expect("some");
            (query.page_size, query.page_token)
        };
        // 0 is the store's default, AIP-158.
        for (asked, given) in [(0, 0), (1, 1), (999, 999), (1_000, 1_000), (1_001, 1_000), (i32::MAX, 1_000)] {
            assert_eq!(list(asked, ""), (given, None), "{asked}");
        }
        assert_eq!(list(1, "t"), (1, Some("t".into())));
        let request = proto::ListJobsRequest { page_size: i32::MIN, ..Default::default() };
        let error = from_wire("default".into(), request).expect_err("negative");
        assert_eq!(error.to_string(), "page_size: -2147483648 is negative");
    }

    #[test]
    fn pages_and_orders_are_checked() {
        let list = |page_size, order_by: &str, filter: &str| {
            let request = proto::ListJobsRequest {
                page_size,
                order_by: order_by.into(),
                filter: filter.into(),
                ..Default::default()
            };
            from_wire("default".into(), request).map_err(|error| error.violations()[0].field.clone())
        };
        assert_eq!(list(-1, "", "").err(), Some("page_size".into()));
        assert_eq!(list(0, "name", "").err(), Some("order_by".into()));
        assert!(list(0, "", "state = QUEUED AND state = RUNNING").expect("valid").is_none());
        let query = list(5_000, "create_time", "").expect("valid").expect("some");
        assert_eq!((query.page_size, query.order), (1_000, Order::CreateTimeAscending));
    }
}
