//! The section `[webhooks]`.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::{Error, Retention};
use crate::engine::{self, WebhookSecrets};

/// Delivery of the ends of jobs to the URLs that they name. Off without a secret.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Webhooks {
    /// What deliveries are signed with, `whsec_` and the base64 of 24 to 64 random bytes; or `TENANT:SECRET` for one
    /// tenant. Several are separated by commas. For the environment; shown nowhere.
    #[serde(skip_serializing)]
    pub secret: Option<WebhookSecrets>,
    /// File of more of them, one a line; `#` begins a comment. Read at the start.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub secret_file: Option<PathBuf>,
    /// How long after a job's end failed attempts are repeated: `24h`, `90m`, `45s` (1000 years at most), or `forever`:
    /// as long as the job is kept.
    pub retry_for: Retention,
    /// Whether receivers may have private, loopback, link-local and other special addresses. Off, because whoever may
    /// create jobs could reach with it what only this machine should reach.
    pub allow_private_addresses: bool,
}

impl Default for Webhooks {
    fn default() -> Self {
        Self {
            secret: None,
            secret_file: None,
            retry_for: Retention(Some(engine::WebhookOptions::DEFAULT_RETRY_FOR)),
            allow_private_addresses: false,
        }
    }
}

impl Webhooks {
    /// The options of the engine; `None`: webhooks are off.
    ///
    /// # Errors
    /// What is wrong with the file of secrets, which is named; nothing of what it holds.
    pub fn options(&self, encode: engine::JobEncoder) -> Result<Option<engine::WebhookOptions>, Error> {
        let wrong = |path: &PathBuf, what: &str| Error::Value {
            key: "webhooks.secret_file",
            found: format!("{}: {what}", path.display()),
            right: "a file with lines SECRET or TENANT:SECRET, such as whsec_ and `openssl rand -base64 32`",
        };
        let read = |path: &PathBuf| {
            let text = std::fs::read_to_string(path).map_err(|error| wrong(path, &error.to_string()))?;
            text.parse::<WebhookSecrets>().map_err(|error| wrong(path, &error))
        };
        let from_file = self.secret_file.as_ref().map(read).transpose()?;
        let secrets = match (&self.secret, from_file) {
            (Some(given), Some(read)) => read.with(given),
            (given, read) => match read.or_else(|| given.clone()) {
                Some(secrets) => secrets,
                None => return Ok(None),
            },
        };
        Ok(Some(engine::WebhookOptions {
            secrets,
            retry_for: self.retry_for.0,
            allow_private_addresses: self.allow_private_addresses,
            encode,
        }))
    }
}
