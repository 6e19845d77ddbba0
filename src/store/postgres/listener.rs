//! The connection that listens for what other servers changed.

use std::time::Duration;

use sqlx::postgres::{PgConnectOptions, PgListener, PgNotification, PgPool, PgPoolOptions};

use crate::domain::job::JobName;
use crate::store::{Error, Notification};

/// Pause before the next try to listen, while the database is away; polls go on meanwhile.
const RETRY_PAUSE: Duration = Duration::from_secs(1);

/// How long a connection may take.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(3);

const EVENTS: &str = "scpsfm_events";
const QUEUED: &str = "scpsfm_queued";
const CANCEL: &str = "scpsfm_cancel";

/// The channel of a notification, and its payload: the job's name, where it is of one. `None`: nobody sends it.
pub(super) fn message(notification: &Notification) -> Option<(&'static str, String)> {
    match notification {
        Notification::Events(job) => Some((EVENTS, job.to_string())),
        Notification::Queued => Some((QUEUED, String::new())),
        Notification::Cancel(job) => Some((CANCEL, job.to_string())),
        Notification::Missed => None,
    }
}

/// Listens, and comes back after the connection broke.
pub(super) struct Listener {
    options: PgConnectOptions,
    current: Option<(PgPool, PgListener)>,
}

impl std::fmt::Debug for Listener {
    /// Without the options: they hold the password.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Listener").field("listening", &self.current.is_some()).finish_non_exhaustive()
    }
}

impl Listener {
    pub(super) fn new(options: PgConnectOptions) -> Self {
        Self { options, current: None }
    }

    /// The next notification. The first one after a connection, and after one that broke, is [`Notification::Missed`].
    pub(super) async fn next(&mut self) -> Notification {
        loop {
            let Some((_, listener)) = &mut self.current else {
                match listen(&self.options).await {
                    Ok(listening) => {
                        self.current = Some(listening);
                        return Notification::Missed;
                    }
                    Err(error) => {
                        tracing::debug!(%error, "cannot listen for other servers");
                        tokio::time::sleep(RETRY_PAUSE).await;
                        continue;
                    }
                }
            };
            match listener.try_recv().await {
                Ok(Some(received)) => {
                    if let Some(notification) = parse(&received) {
                        return notification;
                    }
                }
                Ok(None) => self.current = None,
                Err(error) => {
                    tracing::debug!(%error, "no longer listening for other servers");
                    self.current = None;
                }
            }
        }
    }

    pub(super) async fn close(&mut self) {
        if let Some((pool, listener)) = self.current.take() {
            drop(listener);
            pool.close().await;
        }
    }
}

/// Listens on a connection of its own: it is never free for anything else.
async fn listen(options: &PgConnectOptions) -> Result<(PgPool, PgListener), Error> {
    let pool = PgPoolOptions::new()
        .max_connections(1)
        .acquire_timeout(CONNECT_TIMEOUT)
        .idle_timeout(None)
        .max_lifetime(None)
        .connect_with(options.clone())
        .await?;
    let mut listener = PgListener::connect_with(&pool).await?;
    listener.eager_reconnect(false);
    listener.listen_all([EVENTS, QUEUED, CANCEL]).await?;
    Ok((pool, listener))
}

/// What a notification says; `None` for one that is not ours.
fn parse(received: &PgNotification) -> Option<Notification> {
    let job = || JobName::parse(received.payload());
    match received.channel() {
        EVENTS => job().map(Notification::Events),
        CANCEL => job().map(Notification::Cancel),
        QUEUED => Some(Notification::Queued),
        _ => None,
    }
}
