//! What the attempts of this process share: places, of which one that is to run alone takes all.

use std::sync::Arc;

use tokio::sync::{OwnedSemaphorePermit, Semaphore};

/// More than attempts that a process has at once: of each worker one that runs, one that is prefetched behind it, and
/// one whose end is on its way to the store. A process has 1,024 workers at most.
const PLACES: u32 = 1 << 16;

/// Lost attempts from which on a job runs alone: one loss is nobody's fault as far as is known, and the jobs that were
/// lost together twice are few enough to run one after the other.
const MOST_LOST_AMONG_OTHERS: u32 = 2;

/// Lost attempts from which on a job is a suspect, which runs alone. Where only two attempts are made, the second is made
/// alone.
pub(super) fn suspect_after(max_attempts: u32) -> u32 {
    max_attempts.saturating_sub(1).clamp(1, MOST_LOST_AMONG_OTHERS)
}

/// A place, or all of them, until it is dropped.
pub(super) type Place = OwnedSemaphorePermit;

/// Room for attempts. Who waits for all places waits for those that run, and everyone who comes later waits behind it.
#[derive(Debug)]
pub(super) struct Room {
    places: Arc<Semaphore>,
}

impl Room {
    pub(super) fn new() -> Self {
        Self { places: Arc::new(Semaphore::new(PLACES as usize)) }
    }

    /// A place among others. Never `None`: nobody closes it.
    pub(super) async fn place(&self) -> Option<Place> {
        self.places.clone().acquire_owned().await.ok()
    }

    /// The same, where nobody waits for all places or has them.
    pub(super) fn place_now(&self) -> Option<Place> {
        self.places.clone().try_acquire_owned().ok()
    }

    /// All places, once everyone else has left.
    pub(super) async fn all_places(&self) -> Option<Place> {
        self.places.clone().acquire_many_owned(PLACES).await.ok()
    }
}

#[cfg(test)]
mod tests {
    use futures_util::FutureExt;

    use super::*;

    #[test]
    fn no_job_makes_its_last_attempt_among_others_but_where_it_is_the_first() {
        let expected = [(0, 1), (1, 1), (2, 1), (3, 2), (4, 2), (u32::MAX, 2)];
        for (max_attempts, lost) in expected {
            assert_eq!(suspect_after(max_attempts), lost, "{max_attempts}");
        }
    }

    #[test]
    fn who_waits_to_be_alone_is_not_passed_by() {
        let room = Room::new();
        let first = room.place_now().expect("there is room");
        let mut alone = Box::pin(room.all_places());
        assert!((&mut alone).now_or_never().is_none(), "another is here");
        assert!(room.place_now().is_none(), "one that comes later waits");
        let mut later = Box::pin(room.place());
        assert!((&mut later).now_or_never().is_none());
        drop(first);
        let alone = alone.now_or_never().expect("nobody else is here").expect("open");
        assert!((&mut later).now_or_never().is_none() && room.place_now().is_none());
        drop(alone);
        assert!(later.now_or_never().is_some());
    }
}
