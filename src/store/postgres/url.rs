//! Where the database is, with a password that is never shown.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Deserializer, Serialize, Serializer};
use sqlx::postgres::PgConnectOptions;
use url::Url;

/// What stands in for the password wherever the address is shown.
const HIDDEN: &str = "***";

/// Parameters that may follow the `?`; all that the driver understands but the password, whose place is before the `@`,
/// where it is found and hidden.
const PARAMETERS: [&str; 12] = [
    "sslmode",
    "sslrootcert",
    "sslcert",
    "sslkey",
    "statement-cache-capacity",
    "host",
    "hostaddr",
    "port",
    "dbname",
    "user",
    "application_name",
    "options",
];

/// Address of a PostgreSQL database: `postgres://user:password@host:port/database?sslmode=verify-full`.
///
/// Shown, logged and written to files, it has no password.
#[derive(Clone)]
pub struct DatabaseUrl {
    options: PgConnectOptions,
    /// Without the password.
    shown: Url,
    /// As it was given, to tell two apart.
    given: String,
}

/// An address that is none; it says nothing of what was given, which may hold a password.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("not the address of a PostgreSQL database ({0}); right would be postgres://USER:PASSWORD@HOST:PORT/DATABASE")]
pub struct UrlError(&'static str);

impl DatabaseUrl {
    /// How to connect, password included.
    pub(super) fn options(&self) -> &PgConnectOptions {
        &self.options
    }

    /// Whether it has a password, which is not shown.
    pub fn has_password(&self) -> bool {
        self.shown.password().is_some()
    }

    /// As it was given, password included: for whoever hands it on.
    pub fn reveal(&self) -> &str {
        &self.given
    }
}

impl FromStr for DatabaseUrl {
    type Err = UrlError;

    fn from_str(given: &str) -> Result<Self, UrlError> {
        let (scheme, rest) = given.split_once("://").ok_or(UrlError("it has no scheme"))?;
        if !matches!(scheme, "postgres" | "postgresql") {
            return Err(UrlError("its scheme is not postgres"));
        }
        // Before it is parsed: what a password holds would be taken for the port or the path.
        if rest[rest.find(['/', '?', '#']).unwrap_or(rest.len())..].contains(['@', '#']) {
            return Err(UrlError(
                "there is a `/`, `?` or `#` before the `@`, or a `#`: write them as %2F, %3F and %23",
            ));
        }
        let mut url = Url::parse(given).map_err(|_| UrlError("it cannot be parsed"))?;
        if url.query_pairs().any(|(name, _)| !PARAMETERS.contains(&&*name) && !name.starts_with("options[")) {
            return Err(UrlError("it has a parameter that is not known, or a password that is not before the `@`"));
        }
        if url.password() == Some(HIDDEN) {
            return Err(UrlError(
                "its password is ***, which stands for one that is not shown: put the password in its place, or \
                 the whole address into SCPSFM_STORE__URL",
            ));
        }
        let options = given.parse().map_err(|_| UrlError("it cannot be parsed"))?;
        if url.password().is_some() {
            url.set_password(Some(HIDDEN)).map_err(|()| UrlError("it has a password and no host"))?;
        }
        Ok(Self { options, shown: url, given: given.to_owned() })
    }
}

impl fmt::Display for DatabaseUrl {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.shown.as_str())
    }
}

impl fmt::Debug for DatabaseUrl {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "DatabaseUrl({})", self.shown)
    }
}

impl PartialEq for DatabaseUrl {
    fn eq(&self, other: &Self) -> bool {
        self.given == other.given
    }
}

impl Serialize for DatabaseUrl {
    /// Without the password.
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.shown.as_str())
    }
}

impl<'de> Deserialize<'de> for DatabaseUrl {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        String::deserialize(deserializer)?.parse().map_err(serde::de::Error::custom)
    }
}

#[cfg(test)]
mod tests {
    use super::DatabaseUrl;

    #[test]
    fn the_password_is_shown_nowhere() {
        for given in [
            "postgres://me:hunter2@db.example:5432/scpsfm",
            "postgresql://me:hunter2@db.example/scpsfm?sslmode=require",
            "postgres://me:hunter2%40x@[::1]:5432/scpsfm",
            "postgres://me:a:hunter2@host/scpsfm",
        ] {
            let url: DatabaseUrl = given.parse().expect(given);
            assert_eq!(url.reveal(), given);
            let toml = toml::to_string(&std::collections::BTreeMap::from([("url", &url)])).expect("TOML");
            for shown in [url.to_string(), format!("{url:?}"), toml] {
                assert!(!shown.contains("hunter2") && shown.contains("me:***@"), "{shown}");
            }
        }
        let without: DatabaseUrl = "postgres://me@host/scpsfm".parse().expect("valid");
        assert_eq!(without.to_string(), "postgres://me@host/scpsfm");
    }

    #[test]
    fn what_is_wrong_is_told_without_what_was_given() {
        for (given, reason) in [
            ("hunter2", "no scheme"),
            ("postgres:hunter2", "no scheme"),
            ("postgres:me:hunter2/db", "no scheme"),
            ("mysql://me:hunter2@host/db", "scheme is not postgres"),
            ("postgres://me:hunter2/@host/db", "%2F"),
            ("postgres://me:1/hunter2@host/db", "%2F"),
            ("postgres://me:hunter2?@host/db", "%3F"),
            ("postgres://me:hunter2@host:port/db", "cannot be parsed"),
            ("postgres://me@host/db?password=hunter2", "parameter"),
            ("postgres://me@host/db?hunter2", "parameter"),
            ("postgres://me@host/db?sslmode=hunter2", "cannot be parsed"),
        ] {
            let error = given.parse::<DatabaseUrl>().expect_err(given).to_string();
            assert!(!error.contains("hunter2") && error.contains("postgres://USER:PASSWORD@HOST"), "{error}");
            assert!(error.contains(reason), "{given}: {error}");
        }
    }
}
