//! Where traces and metrics are sent, with a password that is never shown.

use std::fmt;
use std::str::FromStr;

use axum::http::Uri;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// What stands in for the password wherever the address is shown.
const HIDDEN: &str = "***";

/// Address of a collector, `http://HOST:PORT` or `https://HOST:PORT`. Shown, logged and written to files, it has no
/// password.
#[derive(Clone, PartialEq, Eq)]
pub struct Endpoint {
    given: String,
    /// Without the password.
    shown: String,
}

impl Endpoint {
    /// Whether it has a password, which is not shown.
    pub fn has_password(&self) -> bool {
        self.shown != self.given
    }

    /// As it was given, password included: for whoever connects.
    pub fn reveal(&self) -> &str {
        &self.given
    }
}

impl FromStr for Endpoint {
    type Err = String;

    /// The error says nothing of what was given, which may hold a password.
    fn from_str(given: &str) -> Result<Self, String> {
        let wrong = |what: &str| {
            format!("{what}; right would be a collector's http:// or https:// address, such as http://127.0.0.1:4317")
        };
        let uri: Uri = given.parse().map_err(|_| wrong("not an address"))?;
        let (Some("http" | "https"), Some(authority), Some((scheme, rest))) =
            (uri.scheme_str(), uri.authority(), given.split_once("://"))
        else {
            return Err(wrong("not an address with http:// or https:// and a host"));
        };
        let shown = match authority
            .as_str()
            .rsplit_once('@')
            .and_then(|(user, host)| Some((user.split_once(':')?, host)))
        {
            Some(((_, HIDDEN), _)) => {
                return Err(wrong(
                    "its password is ***, which stands for one that is not shown: put the password in its place, or the \
                     whole address into SCPSFM_OTLP__ENDPOINT",
                ));
            }
            Some(((user, _), host)) => {
                let path = rest.get(authority.as_str().len()..).unwrap_or_default();
                format!("{scheme}://{user}:{HIDDEN}@{host}{path}")
            }
            None => given.to_owned(),
        };
        Ok(Self { given: given.to_owned(), shown })
    }
}

impl fmt::Debug for Endpoint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Endpoint({})", self.shown)
    }
}

impl Serialize for Endpoint {
    /// Without the password.
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(&self.shown)
    }
}

impl<'de> Deserialize<'de> for Endpoint {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        String::deserialize(deserializer)?.parse().map_err(serde::de::Error::custom)
    }
}
