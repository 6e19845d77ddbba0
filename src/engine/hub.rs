//! Who waits for which job: wake-ups and interim weights, kept only while someone holds on to the job's topic.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};

use tokio::sync::watch;

use super::locked;
use crate::domain::job::{JobEvent, JobName};

/// Topics by job.
#[derive(Debug, Default)]
pub(super) struct Hub {
    topics: Mutex<HashMap<JobName, Arc<Topic>>>,
}

/// What those who follow a job listen to. Watchers read events from the store; a topic only says when to look.
#[derive(Debug)]
pub(super) struct Topic {
    /// Counts commits to the job.
    pub version: watch::Sender<u64>,
    /// The latest interim weights; a slow watcher skips the ones before.
    pub weights: watch::Sender<Option<Arc<JobEvent>>>,
}

/// A hold on a topic, which lives as long as any.
#[derive(Debug)]
pub(super) struct Subscription {
    hub: Arc<Hub>,
    name: JobName,
    topic: Arc<Topic>,
}

impl Hub {
    /// Holds on to a job's topic.
    pub(super) fn subscribe(self: &Arc<Self>, name: &JobName) -> Subscription {
        let mut topics = locked(&self.topics);
        let topic = topics
            .entry(name.clone())
            .or_insert_with(|| Arc::new(Topic { version: watch::Sender::new(0), weights: watch::Sender::new(None) }))
            .clone();
        Subscription { hub: self.clone(), name: name.clone(), topic }
    }

    /// Tells those who follow a job that something was committed.
    pub(super) fn wake(&self, name: &JobName) {
        if let Some(topic) = locked(&self.topics).get(name) {
            topic.version.send_modify(|version| *version = version.wrapping_add(1));
        }
    }

    #[cfg(test)]
    pub(super) fn topic_count(&self) -> usize {
        locked(&self.topics).len()
    }
}

impl Subscription {
    pub(super) fn topic(&self) -> &Topic {
        &self.topic
    }
}

impl Drop for Subscription {
    fn drop(&mut self) {
        let mut topics = locked(&self.hub.topics);
        // The map's and this one: topics are only handed out under the lock, so nobody can join in between.
        const LAST: usize = 2;
        if Arc::strong_count(&self.topic) == LAST {
            topics.remove(&self.name);
        }
    }
}
