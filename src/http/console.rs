//! The console: a page for people, which the program carries and which calls the API as any other client.

use axum::http::{HeaderValue, header};
use axum::response::IntoResponse;

use super::answer::Answer;

/// Path, kind and text of each file.
const FILES: [(&str, &str, &str); 3] = [
    ("/", "text/html; charset=utf-8", include_str!("console/index.html")),
    ("/console.css", "text/css; charset=utf-8", include_str!("console/console.css")),
    ("/console.js", "text/javascript; charset=utf-8", include_str!("console/console.js")),
];

/// What the page may do: nothing that is not its own, and be shown in no other page.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; \
                      img-src 'self' data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// The file at this path.
pub fn file(path: &str) -> Option<Answer> {
    let (_, kind, text) = FILES.into_iter().find(|(at, _, _)| *at == path)?;
    let mut answer = ([(header::CONTENT_TYPE, kind)], text).into_response();
    for (name, value) in [
        (header::CONTENT_SECURITY_POLICY, POLICY),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
        // Of another version after an upgrade: asked for anew each time, some kilobytes.
        (header::CACHE_CONTROL, "no-cache"),
    ] {
        answer.headers_mut().insert(name, HeaderValue::from_static(value));
    }
    Some(answer)
}
