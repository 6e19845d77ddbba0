//! Following a job: replay from the store, then wait for more.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use futures_util::stream::{self, Stream};
use tokio::sync::watch as channel;

use super::notifier::Subscription;
use super::{Engine, Error, Inner, Phase};
use crate::domain::Violation;
use crate::domain::job::{EventBody, JobEvent, JobName};

/// How often a watcher of a shared store looks unasked: the job may run in another process, whose notifications may
/// be lost.
const WATCH_POLL: Duration = Duration::from_secs(1);

/// Events read from the store at once: a job has some dozens; a reader of thousands holds no more than this.
pub(super) const READ_AHEAD: u32 = 128;

/// The events of a job, in order, without gap or repeat, up to the event of its end: the last one where it was retried
/// after an earlier one.
///
/// Durable events are read from the store when they are asked for: a slow watcher holds nothing and delays nobody.
/// Interim weights arrive between them, only the latest.
pub struct Watch {
    inner: Arc<Inner>,
    name: JobName,
    version: channel::Receiver<u64>,
    weights: channel::Receiver<Option<Arc<JobEvent>>>,
    phase: channel::Receiver<Phase>,
    /// Read and not yet handed out.
    buffered: VecDeque<JobEvent>,
    /// Sequence number of the last event that was read.
    after: u64,
    /// Nothing was in the store beyond `after` when this version of the channel was seen.
    caught_up: bool,
    ended: bool,
    /// After the receivers: keeps their senders alive.
    _subscription: Subscription,
}

impl std::fmt::Debug for Watch {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Watch").field("name", &self.name).field("after", &self.after).finish_non_exhaustive()
    }
}

impl Engine {
    /// Replays a job's events after a sequence number (0: all of them), then follows it to its end. See [`Watch`].
    ///
    /// # Errors
    /// [`StoreError::NotFound`](super::StoreError::NotFound); [`Error::InvalidArgument`] for a number beyond the job's
    /// latest event.
    pub async fn watch(&self, name: &JobName, after: u64) -> Result<Watch, Error> {
        let (inner, name) = (self.inner.clone(), name.clone());
        // First listen, then look: what is committed in between is seen either way.
        let subscription = inner.notifier.subscribe(&name);
        let version = subscription.channel().version.subscribe();
        let mut weights = subscription.channel().weights.subscribe();
        if weights.borrow().is_some() {
            weights.mark_changed();
        }
        let phase = inner.phase.subscribe();
        let mut watch = Watch {
            inner,
            name,
            version,
            weights,
            phase,
            buffered: VecDeque::new(),
            after,
            caught_up: false,
            ended: false,
            _subscription: subscription,
        };
        watch.read().await?;
        if watch.buffered.is_empty() {
            let job = watch.inner.store.job(&watch.name).await?;
            if after > job.last_sequence {
                let latest = job.last_sequence;
                let description = format!("{after} is beyond the job's latest event {latest}; start from one received");
                return Err(Error::InvalidArgument(Violation::of("after_sequence", description).into()));
            }
            // An end is the last event as long as the job is not retried: nothing to wait for.
            watch.ended = job.state.is_terminal() && after == job.last_sequence;
        }
        Ok(watch)
    }
}

impl Watch {
    /// The next event; `None` after the job's end. After an error nothing follows.
    ///
    /// Dropping the future loses nothing.
    ///
    /// # Errors
    /// [`Error::Draining`] when the server goes down before the job's end: reconnect with the last sequence number.
    pub async fn next(&mut self) -> Option<Result<JobEvent, Error>> {
        if self.ended {
            return None;
        }
        let event = self.advance().await;
        self.ended = match &event {
            Ok(event) => is_end(event) && self.buffered.is_empty(),
            Err(_) => true,
        };
        Some(event)
    }

    /// The same as a stream.
    pub fn into_stream(self) -> impl Stream<Item = Result<JobEvent, Error>> + Send + 'static {
        stream::unfold(self, |mut watch| async move { watch.next().await.map(|event| (event, watch)) })
    }

    /// Reads what is in the store beyond `after`, or some of it.
    async fn read(&mut self) -> Result<(), Error> {
        self.version.mark_unchanged();
        self.caught_up = false;
        let read = self.inner.store.events_after(&self.name, self.after, READ_AHEAD).await?;
        self.caught_up = read.len() < READ_AHEAD as usize;
        self.buffered.extend(read);
        self.after = self.buffered.back().and_then(|event| event.sequence).unwrap_or(self.after);
        Ok(())
    }

    async fn advance(&mut self) -> Result<JobEvent, Error> {
        loop {
            // Where an end is the last event that was read, and not all were, a retry may follow it.
            let may_go_on = self.buffered.len() == 1 && !self.caught_up && self.buffered.front().is_some_and(is_end);
            if !may_go_on && let Some(event) = self.buffered.pop_front() {
                return Ok(event);
            }
            if !self.caught_up || self.version.has_changed().unwrap_or(true) {
                self.read().await?;
                continue;
            }
            if *self.phase.borrow_and_update() == Phase::Closed {
                return Err(Error::Draining);
            }
            let shared = self.inner.store.is_shared();
            tokio::select! {
                biased;
                // Receivers only fail when their sender is gone, which this watch itself prevents.
                _ = self.version.changed() => self.caught_up = false,
                _ = self.phase.changed() => self.caught_up = false,
                () = tokio::time::sleep(WATCH_POLL), if shared => self.caught_up = false,
                _ = self.weights.changed() => {
                    if let Some(event) = self.weights.borrow_and_update().clone() {
                        return Ok(event.as_ref().clone());
                    }
                }
            }
        }
    }
}

/// Whether an event tells that the job ended.
fn is_end(event: &JobEvent) -> bool {
    matches!(event.body, EventBody::State { state, .. } if state.is_terminal())
}
