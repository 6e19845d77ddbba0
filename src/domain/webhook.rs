//! Webhooks: where the end of a job is sent, and how far that has come.

use serde::{Deserialize, Serialize};
use url::Url;

use super::error::quoted;

/// The webhook of a job.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Webhook {
    pub url: String,
    pub state: WebhookState,
    /// Attempts begun so far, and so what tells the present one apart from those before.
    pub attempts: u32,
    /// Why the latest attempt that ended failed, in a sentence.
    pub last_error: Option<String>,
}

scpsfm_core::named! {
    /// How far a delivery has come.
    pub enum WebhookState {
        /// The job has not ended, or the receiver has not accepted its end yet.
        Pending = "PENDING",
        /// The receiver has accepted it.
        Delivered = "DELIVERED",
        /// No further attempt is made.
        GivenUp = "GIVEN_UP",
    }
}

impl Webhook {
    /// Longest URL: what every HTTP server in use accepts, with room for a token in it.
    pub const MAX_URL_BYTES: usize = 2_048;

    /// One that nothing was sent to yet.
    pub fn pending(url: impl Into<String>) -> Self {
        Self { url: url.into(), state: WebhookState::Pending, attempts: 0, last_error: None }
    }

    /// The receiver as it is shown: scheme, host and port of the URL.
    pub fn receiver(&self) -> String {
        Url::parse(&self.url).map_or_else(|_| self.url.clone(), |url| url.origin().ascii_serialization())
    }

    /// The host of the URL, to which attempts are bounded.
    pub fn host(&self) -> String {
        let url = Url::parse(&self.url).ok();
        url.and_then(|url| url.host_str().map(str::to_owned)).unwrap_or_else(|| self.url.clone())
    }

    /// A URL that a job may name.
    ///
    /// # Errors
    /// What is wrong with it, in words that go on after the field's name.
    pub fn parse_url(text: &str) -> Result<Url, String> {
        if text.is_empty() || text.len() > Self::MAX_URL_BYTES {
            return Err(format!("{} bytes are not in 1..={}", text.len(), Self::MAX_URL_BYTES));
        }
        if !text.bytes().all(|byte| byte.is_ascii_graphic()) {
            return Err("has other characters than visible ASCII; percent-encode them".into());
        }
        let url = Url::parse(text).map_err(|error| format!("{} is not a URL: {error}", quoted(text)))?;
        if !matches!(url.scheme(), "http" | "https") {
            return Err(format!("has the scheme {}; right would be https or http", quoted(url.scheme())));
        }
        if !url.username().is_empty() || url.password().is_some() {
            return Err(
                "has a user name or a password, which is not sent; put a token into the path or the query".into()
            );
        }
        if url.fragment().is_some() {
            return Err("has a fragment (#...), which is never sent".into());
        }
        if url.port() == Some(0) {
            return Err("has the port 0, to which nothing can be sent".into());
        }
        // The parser skips slashes: of `http:///x` it makes the host `x`.
        let after_scheme = text.split_once("://").map_or("", |(_, rest)| rest);
        match url.host_str() {
            None | Some("") => Err("has no host".into()),
            Some(_) if after_scheme.starts_with(['/', '\\']) || after_scheme.is_empty() => Err("has no host".into()),
            Some(_) => Ok(url),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn urls_that_can_be_sent_to_are_taken_and_others_are_refused_with_a_reason() {
        for right in ["https://hooks.example/a?token=b", "http://10.0.0.1:8080", "https://[2001:db8::1]/x", "HTTP://a"]
        {
            assert!(Webhook::parse_url(right).is_ok(), "{right}");
        }
        for (wrong, reason) in [
            ("", "0 bytes"),
            (format!("https://a/{}", "b".repeat(2_039)).as_str(), "2049 bytes"),
            ("hooks.example/a", "is not a URL"),
            ("/a", "is not a URL"),
            ("https://", "is not a URL"),
            ("https://a:99999/", "is not a URL"),
            ("https://a:0/", "port 0"),
            ("http:///x", "no host"),
            ("http:////x/y", "no host"),
            ("http:/x", "no host"),
            ("http:x", "no host"),
            ("http://\\x", "no host"),
            ("ftp://a/b", "scheme"),
            ("file:///etc/passwd", "scheme"),
            ("https://user@a/", "user name"),
            ("https://user:pass@a/", "user name"),
            ("https://a/#b", "fragment"),
            ("https://a/\u{e9}", "ASCII"),
            ("https://a/ b", "ASCII"),
            ("https://a/\r\nx: y", "ASCII"),
        ] {
            let error = Webhook::parse_url(wrong).expect_err(wrong);
            assert!(error.contains(reason), "{wrong}: {error}");
        }
        assert!(Webhook::parse_url(&format!("https://a/{}", "b".repeat(2_038))).is_ok(), "the longest");
    }

    #[test]
    fn a_receiver_is_scheme_host_and_port() {
        let receiver = |url: &str| Webhook::pending(url).receiver();
        assert_eq!(receiver("https://Hooks.example:443/a?b=c"), "https://hooks.example");
        assert_eq!(receiver("http://[::1]:81/a"), "http://[::1]:81");
        let host = |url: &str| Webhook::pending(url).host();
        assert_eq!(
            (host("https://Hooks.example:81/a"), host("http://[::1]:81/a")),
            ("hooks.example".into(), "[::1]".into())
        );
    }
}
