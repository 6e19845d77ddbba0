//! What the attempts of this process share: memory for the solver, and places, of which one that is to run alone takes
//! all.
//!
//! Who has memory never waits for a place or for more memory before its job is solved, so that everyone's turn comes.

use std::sync::Arc;

use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::observe::{self, Held};

/// What memory is counted in: estimates are no finer.
const MEMORY_UNIT_BYTES: u64 = 1 << 20;

/// More memory than any machine has, which a semaphore can still count where numbers have 32 bits: 256 TiB.
const MOST_MEMORY_UNITS: u32 = 1 << 28;

/// More than attempts that a process has at once: of each worker one that runs, one that is prefetched behind it, and
/// one whose end is on its way to the store. A process has 1,024 workers at most.
const PLACES: u32 = 1 << 16;

/// Lost attempts from which on a job runs alone: one loss is nobody's fault as far as is known, and the jobs that were
/// lost together twice are few enough to run one after the other.
const MOST_LOST_AMONG_OTHERS: u32 = 2;

/// Lost attempts from which on a job is a suspect, which runs alone. Where only two attempts are made, the second is
/// made alone.
pub(super) fn suspect_after(max_attempts: u32) -> u32 {
    max_attempts.saturating_sub(1).clamp(1, MOST_LOST_AMONG_OTHERS)
}

/// A place, or all of them, until it is dropped.
pub(super) type Place = OwnedSemaphorePermit;

/// Memory for the solver, until it is dropped.
pub(super) struct SolverMemory {
    _permit: OwnedSemaphorePermit,
    _counted: Held,
}

/// Room for attempts. Who waits for all places waits for those that run, and everyone who comes later waits behind it;
/// the same holds for a job that waits for much memory.
#[derive(Debug)]
pub(super) struct Room {
    places: Arc<Semaphore>,
    memory: Arc<Semaphore>,
    memory_units: u32,
}

impl Room {
    /// * `max_solver_bytes`: what all jobs may take together
    pub(super) fn new(max_solver_bytes: u64) -> Self {
        let units = u32::try_from(max_solver_bytes / MEMORY_UNIT_BYTES).unwrap_or(u32::MAX);
        let memory_units = units.clamp(1, MOST_MEMORY_UNITS);
        Self {
            places: Arc::new(Semaphore::new(PLACES as usize)),
            memory: Arc::new(Semaphore::new(memory_units as usize)),
            memory_units,
        }
    }

    /// So much memory, or all of it where that is less, once others have left it. Never `None`: nobody closes it.
    pub(super) async fn memory(&self, bytes: u64) -> Option<SolverMemory> {
        let permit = self.memory.clone().acquire_many_owned(self.units(bytes)).await.ok()?;
        Some(SolverMemory { _permit: permit, _counted: observe::solver_bytes(bytes) })
    }

    /// The same, where it is free and nobody waits for it.
    pub(super) fn memory_now(&self, bytes: u64) -> Option<SolverMemory> {
        let permit = self.memory.clone().try_acquire_many_owned(self.units(bytes)).ok()?;
        Some(SolverMemory { _permit: permit, _counted: observe::solver_bytes(bytes) })
    }

    /// What is counted for so many bytes: never more than there is, or it would wait for good.
    fn units(&self, bytes: u64) -> u32 {
        u32::try_from(bytes.div_ceil(MEMORY_UNIT_BYTES)).unwrap_or(u32::MAX).min(self.memory_units)
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

/// Bytes of memory of this machine, or of the control group of this process where that has less. `None` where the
/// system does not tell.
pub(super) fn memory_bytes() -> Option<u64> {
    let read = |path: &str| std::fs::read_to_string(path).ok();
    let machine = read("/proc/meminfo").and_then(|text| total_bytes(&text));
    // As containers see their own: of version 2, and of version 1.
    let groups = ["/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"];
    // Without a bound they say `max`, or more than any machine has.
    let groups = groups.into_iter().filter_map(|path| read(path)?.trim().parse().ok());
    groups.chain(machine).min()
}

/// What the system's table says of the whole.
fn total_bytes(table: &str) -> Option<u64> {
    let kilobytes = table.lines().find_map(|line| line.strip_prefix("MemTotal:"))?.trim().strip_suffix("kB")?;
    Some(kilobytes.trim().parse::<u64>().ok()?.saturating_mul(1024))
}

#[cfg(test)]
mod tests {
    use futures_util::FutureExt;

    use super::*;

    const MIB: u64 = 1 << 20;

    #[test]
    fn memory_is_bounded_and_who_waits_for_much_is_not_passed_by() {
        let room = Room::new(100 * MIB);
        let first = room.memory_now(60 * MIB - 1).expect("it is free");
        assert!(room.memory_now(41 * MIB).is_none(), "together they would be too much");
        let small = room.memory_now(10 * MIB).expect("together they fit");
        let mut large = Box::pin(room.memory(90 * MIB));
        assert!((&mut large).now_or_never().is_none());
        assert!(room.memory_now(1).is_none(), "one that comes later waits");
        drop(first);
        let large = large.now_or_never().expect("the small one may stay").expect("open");
        drop((small, large));
        assert!(room.memory_now(u64::MAX).is_some(), "more than there is gets all");
    }

    #[test]
    fn a_bound_may_be_as_small_or_as_large_as_numbers_are() {
        for bytes in [0, 1, u64::MAX] {
            assert!(Room::new(bytes).memory_now(bytes).is_some(), "{bytes}");
        }
    }

    #[test]
    fn the_memory_of_the_machine_is_read() {
        assert_eq!(total_bytes("MemTotal:       16316412 kB\nMemFree: 1 kB\n"), Some(16_316_412 * 1024));
        assert_eq!((total_bytes(""), total_bytes("MemTotal: x kB")), (None, None));
        // None, or more than a process needs.
        assert!(memory_bytes().is_none_or(|bytes| bytes > 1 << 26));
    }

    #[test]
    fn no_job_makes_its_last_attempt_among_others_but_where_it_is_the_first() {
        let expected = [(0, 1), (1, 1), (2, 1), (3, 2), (4, 2), (u32::MAX, 2)];
        for (max_attempts, lost) in expected {
            assert_eq!(suspect_after(max_attempts), lost, "{max_attempts}");
        }
    }

    #[test]
    fn who_waits_to_be_alone_is_not_passed_by() {
        let room = Room::new(0);
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
