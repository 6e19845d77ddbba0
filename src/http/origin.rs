//! Pages of other sites: which may call the API, and what their browsers are told (Fetch standard, "CORS protocol").

use std::collections::BTreeSet;

use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header};
use axum::response::IntoResponse;

use super::answer::Answer;
use super::route::Route;

/// What such a page may send: JSON, a key, where a result goes on, and what clients of gRPC-Web add.
const REQUEST_HEADERS: &str = "authorization, content-type, grpc-timeout, if-range, last-event-id, range, traceparent, \
                               tracestate, x-grpc-web, x-user-agent";
/// What it may read: how a call of gRPC ended, which part of which result came, and when to come back.
const ANSWER_HEADERS: &str = "accept-ranges, content-range, etag, grpc-message, grpc-status, grpc-status-details-bin, \
                              retry-after";
/// Seconds that a browser remembers the permission: Chromium remembers none for longer.
const REMEMBERED_SECONDS: &str = "7200";

/// Where a request comes from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Origin {
    /// A page of this port, or no page.
    Own,
    /// A page of a site that may call.
    Allowed(HeaderValue),
    /// Another one: it must not use what its browser's machine may reach.
    Other,
}

impl Origin {
    /// The origin of a request with these headers. A page whose name was made to point here is refused by its host.
    ///
    /// * `allowed`: origins of pages that may call, such as `https://app.example`
    pub fn of(headers: &HeaderMap, allowed: &[String]) -> Self {
        let Some(value) = headers.get(header::ORIGIN) else { return Origin::Own };
        let Ok(text) = value.to_str() else { return Origin::Other };
        let host = headers.get(header::HOST).and_then(|host| host.to_str().ok());
        if text.split_once("://").is_some_and(|(_, authority)| Some(authority) == host) {
            Origin::Own
        } else if allowed.iter().any(|origin| origin.eq_ignore_ascii_case(text)) {
            Origin::Allowed(value.clone())
        } else {
            Origin::Other
        }
    }
}

/// The answer to a browser that asks whether a page of an allowed origin may call: by the methods that any route has.
pub fn preflight(routes: &[Route]) -> Answer {
    let methods: BTreeSet<&str> = routes.iter().map(|route| route.verb.as_str()).collect();
    let permission = [
        (header::ACCESS_CONTROL_ALLOW_METHODS, methods.into_iter().collect::<Vec<_>>().join(", ")),
        (header::ACCESS_CONTROL_ALLOW_HEADERS, REQUEST_HEADERS.to_owned()),
        (header::ACCESS_CONTROL_MAX_AGE, REMEMBERED_SECONDS.to_owned()),
    ];
    (StatusCode::NO_CONTENT, permission).into_response()
}

/// Lets a page of this origin read an answer.
pub fn admit(answer: &mut Answer, origin: HeaderValue) {
    let headers = answer.headers_mut();
    let mut set = |name: HeaderName, value| headers.insert(name, value);
    set(header::ACCESS_CONTROL_ALLOW_ORIGIN, origin);
    set(header::ACCESS_CONTROL_EXPOSE_HEADERS, HeaderValue::from_static(ANSWER_HEADERS));
    set(header::VARY, HeaderValue::from_static("origin"));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn own_pages_and_those_that_are_named_may_call() {
        let of = |origin: Option<&'static str>| {
            let mut headers = HeaderMap::new();
            headers.insert(header::HOST, HeaderValue::from_static("127.0.0.1:8080"));
            headers.extend(origin.map(|origin| (header::ORIGIN, HeaderValue::from_static(origin))));
            Origin::of(&headers, &["https://app.example".to_owned()])
        };
        assert_eq!(of(None), Origin::Own);
        assert_eq!(of(Some("http://127.0.0.1:8080")), Origin::Own);
        assert_eq!(of(Some("https://app.example")), Origin::Allowed(HeaderValue::from_static("https://app.example")));
        let others = ["null", "http://app.example", "https://app.example:444", "https://app.example.evil.example", ""];
        for other in others.into_iter().chain(["http://127.0.0.1:8081"]) {
            assert_eq!(of(Some(other)), Origin::Other, "{other:?}");
        }
    }
}
