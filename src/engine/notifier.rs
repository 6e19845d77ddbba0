//! Who waits for which job: wake-ups and interim weights, kept only while someone subscribes to the job's channel.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

use tokio::sync::watch;

use super::locked;
use crate::domain::job::{JobEvent, JobName};

/// Channels by job.
#[derive(Debug, Default)]
pub(super) struct Notifier {
    channels: Mutex<BTreeMap<JobName, Held>>,
}

/// A channel with the number of its subscriptions, both only touched under the lock.
#[derive(Debug)]
struct Held {
    channel: Arc<JobChannel>,
    subscriptions: usize,
}

/// What the watchers of a job wait on. They read events from the store; a channel only says when to look.
#[derive(Debug)]
pub(super) struct JobChannel {
    /// Counts commits to the job.
    pub version: watch::Sender<u64>,
    /// The latest interim weights; a slow watcher skips the ones before.
    pub weights: watch::Sender<Option<Arc<JobEvent>>>,
}

/// A subscription to a channel, which lives as long as any.
#[derive(Debug)]
pub(super) struct Subscription {
    notifier: Arc<Notifier>,
    name: JobName,
    channel: Arc<JobChannel>,
}

impl Notifier {
    /// Subscribes to a job's channel.
    pub(super) fn subscribe(self: &Arc<Self>, name: &JobName) -> Subscription {
        let mut channels = locked(&self.channels);
        let held = channels.entry(name.clone()).or_insert_with(|| {
            let channel = JobChannel { version: watch::Sender::new(0), weights: watch::Sender::new(None) };
            Held { channel: Arc::new(channel), subscriptions: 0 }
        });
        held.subscriptions += 1;
        Subscription { notifier: self.clone(), name: name.clone(), channel: held.channel.clone() }
    }

    /// Tells the watchers of a job that something was committed.
    pub(super) fn wake(&self, name: &JobName) {
        if let Some(held) = locked(&self.channels).get(name) {
            held.channel.version.send_modify(|version| *version = version.wrapping_add(1));
        }
    }

    /// Has the watchers of all jobs look.
    pub(super) fn wake_all(&self) {
        for held in locked(&self.channels).values() {
            held.channel.version.send_modify(|version| *version = version.wrapping_add(1));
        }
    }
}

impl Subscription {
    pub(super) fn channel(&self) -> &JobChannel {
        &self.channel
    }
}

impl Drop for Subscription {
    fn drop(&mut self) {
        let mut channels = locked(&self.notifier.channels);
        if let Some(held) = channels.get_mut(&self.name) {
            held.subscriptions -= 1;
            if held.subscriptions == 0 {
                channels.remove(&self.name);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Barrier;

    use super::*;

    impl Notifier {
        pub(in crate::engine) fn channel_count(&self) -> usize {
            locked(&self.channels).len()
        }
    }

    #[test]
    fn subscriptions_that_end_together_leave_no_channel_behind() {
        const THREADS: usize = 8;
        let notifier = Arc::new(Notifier::default());
        let name = JobName { tenant: "default".into(), job: "a".into() };
        for _ in 0..200 {
            let together = Barrier::new(THREADS);
            std::thread::scope(|scope| {
                for _ in 0..THREADS {
                    scope.spawn(|| {
                        let subscription = notifier.subscribe(&name);
                        together.wait();
                        drop(subscription);
                    });
                }
            });
            assert_eq!(notifier.channel_count(), 0);
        }
    }
}
