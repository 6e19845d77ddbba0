//! Who waits for which job: wake-ups and interim weights, kept only while someone holds on to the job's topic.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

use tokio::sync::watch;

use super::locked;
use crate::domain::job::{JobEvent, JobName};

/// Topics by job.
#[derive(Debug, Default)]
pub(super) struct Hub {
    topics: Mutex<BTreeMap<JobName, Held>>,
}

/// A topic with the number of its subscriptions, both only touched under the lock.
#[derive(Debug)]
struct Held {
    topic: Arc<Topic>,
    subscriptions: usize,
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
        let held = topics.entry(name.clone()).or_insert_with(|| {
            let topic = Topic { version: watch::Sender::new(0), weights: watch::Sender::new(None) };
            Held { topic: Arc::new(topic), subscriptions: 0 }
        });
        held.subscriptions += 1;
        Subscription { hub: self.clone(), name: name.clone(), topic: held.topic.clone() }
    }

    /// Tells those who follow a job that something was committed.
    pub(super) fn wake(&self, name: &JobName) {
        if let Some(held) = locked(&self.topics).get(name) {
            held.topic.version.send_modify(|version| *version = version.wrapping_add(1));
        }
    }

    /// Has everyone who follows any job look.
    pub(super) fn wake_all(&self) {
        for held in locked(&self.topics).values() {
            held.topic.version.send_modify(|version| *version = version.wrapping_add(1));
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
        if let Some(held) = topics.get_mut(&self.name) {
            held.subscriptions -= 1;
            if held.subscriptions == 0 {
                topics.remove(&self.name);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Barrier;

    use super::*;

    #[test]
    fn subscriptions_that_end_together_leave_no_topic_behind() {
        const THREADS: usize = 8;
        let hub = Arc::new(Hub::default());
        let name = JobName { tenant: "default".into(), job: "a".into() };
        for _ in 0..200 {
            let together = Barrier::new(THREADS);
            std::thread::scope(|scope| {
                for _ in 0..THREADS {
                    scope.spawn(|| {
                        let subscription = hub.subscribe(&name);
                        together.wait();
                        drop(subscription);
                    });
                }
            });
            assert_eq!(hub.topic_count(), 0);
        }
    }
}
