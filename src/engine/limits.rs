//! What limits the attempts of this process: memory for the solver, and permits to run, of which a suspect takes all.
//!
//! An attempt that holds memory waits for nothing else until its job is solved: the memory is always given back.

use std::path::Path;
use std::sync::Arc;

use tokio::sync::{OwnedSemaphorePermit, Semaphore, SemaphorePermit};

use super::observe::{self, Held};

/// What memory is counted in: estimates are no finer.
const MEMORY_UNIT_BYTES: u64 = 1 << 20;

/// More memory than any machine has, which a semaphore can still count where numbers have 32 bits: 256 TiB.
const MOST_MEMORY_UNITS: u32 = 1 << 28;

/// More than attempts that a process has at once: of each worker one that runs, one that is prefetched behind it, and
/// one whose end is on its way to the store. A process has 1,024 workers at most.
const RUN_PERMITS: u32 = 1 << 16;

/// Lost attempts from which on a job runs alone. One loss does not tell which job of the process caused it, and the
/// jobs that were lost together twice are few enough to run one after the other.
const MOST_LOST_AMONG_OTHERS: u32 = 2;

/// Lost attempts from which on a job is a suspect, which runs alone. Where only two attempts are made, the second is
/// made alone.
pub(super) fn suspect_after(max_attempts: u32) -> u32 {
    max_attempts.saturating_sub(1).clamp(1, MOST_LOST_AMONG_OTHERS)
}

/// The right to run among others, or alone, until it is dropped.
pub(super) type RunPermit = OwnedSemaphorePermit;

/// Memory for the solver, until it is dropped.
pub(super) struct SolverMemory {
    _permit: OwnedSemaphorePermit,
    _counted: Held,
}

/// A suspect waits for all attempts that run, and every attempt that comes later waits behind it. The same holds for a
/// job that waits for memory.
#[derive(Debug)]
pub(super) struct AttemptLimits {
    run: Arc<Semaphore>,
    /// Held by the slot whose suspect waits.
    suspect: Semaphore,
    memory: Arc<Semaphore>,
    memory_units: u32,
}

impl AttemptLimits {
    /// * `max_solver_bytes`: what all jobs may take together
    pub(super) fn new(max_solver_bytes: u64) -> Self {
        let units = u32::try_from(max_solver_bytes / MEMORY_UNIT_BYTES).unwrap_or(u32::MAX);
        let memory_units = units.clamp(1, MOST_MEMORY_UNITS);
        Self {
            run: Arc::new(Semaphore::new(RUN_PERMITS as usize)),
            suspect: Semaphore::new(1),
            memory: Arc::new(Semaphore::new(memory_units as usize)),
            memory_units,
        }
    }

    /// So much memory, or all of it where that is less, once others have given it back. Never `None`: nobody closes it.
    pub(super) async fn acquire_memory(&self, bytes: u64) -> Option<SolverMemory> {
        let permit = self.memory.clone().acquire_many_owned(self.units(bytes)).await.ok()?;
        Some(SolverMemory { _permit: permit, _counted: observe::solver_bytes(bytes) })
    }

    /// The same, where it is free and nobody waits for it.
    pub(super) fn try_acquire_memory(&self, bytes: u64) -> Option<SolverMemory> {
        let permit = self.memory.clone().try_acquire_many_owned(self.units(bytes)).ok()?;
        Some(SolverMemory { _permit: permit, _counted: observe::solver_bytes(bytes) })
    }

    /// What is counted for so many bytes: never more than there is, or it would wait for good.
    fn units(&self, bytes: u64) -> u32 {
        u32::try_from(bytes.div_ceil(MEMORY_UNIT_BYTES)).unwrap_or(u32::MAX).min(self.memory_units)
    }

    /// A permit to claim a job and run it among others, once some memory is free and no job waits for it: a claimed job
    /// is `RUNNING`, and one that waits for memory keeps other servers from it. Jobs that are claimed at the same
    /// moment may still wait for each other's memory. Never `None`: nobody closes it.
    pub(super) async fn acquire(&self) -> Option<RunPermit> {
        drop(self.memory.acquire().await.ok()?);
        self.run.clone().acquire_owned().await.ok()
    }

    /// A permit to run among others, where no attempt runs alone or waits for that.
    pub(super) fn try_acquire(&self) -> Option<RunPermit> {
        self.run.clone().try_acquire_owned().ok()
    }

    /// The right to wait for [`AttemptLimits::acquire_exclusive`]; `None` where another slot has it.
    pub(super) fn try_acquire_suspect(&self) -> Option<SemaphorePermit<'_>> {
        self.suspect.try_acquire().ok()
    }

    /// A permit to run alone, once all others are dropped.
    pub(super) async fn acquire_exclusive(&self) -> Option<RunPermit> {
        self.run.clone().acquire_many_owned(RUN_PERMITS).await.ok()
    }
}

/// Where systems mount their control groups.
const CONTROL_GROUPS: &str = "/sys/fs/cgroup";

/// Bytes of memory of this machine, or of the control groups that this process is in where one has less. `None` where
/// the system does not tell.
pub(super) fn memory_bytes() -> Option<u64> {
    let read = |path: &str| std::fs::read_to_string(path).ok();
    let machine = read("/proc/meminfo").and_then(|text| total_bytes(&text));
    let group = read("/proc/self/cgroup").and_then(|text| group_bytes(Path::new(CONTROL_GROUPS), &text));
    machine.into_iter().chain(group).min()
}

/// The least bound on memory of a process's control group and of those above it.
///
/// * `groups`: what the system's table says of the process's groups
fn group_bytes(root: &Path, groups: &str) -> Option<u64> {
    // Of version 2: one line, with the path from the root. A container may see the root alone.
    let group = groups.lines().find_map(|line| line.strip_prefix("0::/")).unwrap_or_default();
    let path = root.join(group);
    let bounds = path.ancestors().take_while(|folder| folder.starts_with(root)).map(|folder| folder.join("memory.max"));
    // Of version 1, where a container sees its own group as the root.
    let bounds = bounds.chain([root.join("memory/memory.limit_in_bytes")]);
    // Without a bound they say `max`, or more than any machine has.
    bounds.filter_map(|file| std::fs::read_to_string(file).ok()?.trim().parse().ok()).min()
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
        let limits = AttemptLimits::new(100 * MIB);
        let first = limits.try_acquire_memory(60 * MIB - 1).expect("it is free");
        assert!(limits.try_acquire_memory(41 * MIB).is_none(), "together they would be too much");
        let small = limits.try_acquire_memory(10 * MIB).expect("together they fit");
        let mut large = Box::pin(limits.acquire_memory(90 * MIB));
        assert!((&mut large).now_or_never().is_none());
        assert!(limits.try_acquire_memory(1).is_none(), "one that comes later waits");
        let mut claim = Box::pin(limits.acquire());
        assert!((&mut claim).now_or_never().is_none(), "nothing is claimed while a job waits");
        drop(first);
        let large = large.now_or_never().expect("the small one may stay").expect("open");
        assert!((&mut claim).now_or_never().is_none(), "nor while all is taken");
        drop((small, large));
        assert!(claim.now_or_never().is_some());
        assert!(limits.try_acquire_memory(u64::MAX).is_some(), "more than there is gets all");
    }

    #[test]
    fn a_bound_may_be_as_small_or_as_large_as_numbers_are() {
        for bytes in [0, 1, u64::MAX] {
            assert!(AttemptLimits::new(bytes).try_acquire_memory(bytes).is_some(), "{bytes}");
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
    fn the_least_bound_of_the_control_groups_above_a_process_counts() {
        let root = tempfile::tempdir().expect("a temporary directory");
        let bound = |folder: &str, file: &str, text: &str| {
            let folder = root.path().join(folder);
            std::fs::create_dir_all(&folder).expect("folders");
            std::fs::write(folder.join(file), text).expect("a file");
        };
        let of = |groups: &str| group_bytes(root.path(), groups);
        assert_eq!(of("0::/system.slice/scpsfm.service\n"), None);
        bound("system.slice/scpsfm.service", "memory.max", "max\n");
        bound("system.slice", "memory.max", "3000\n");
        assert_eq!(of("0::/system.slice/scpsfm.service\n"), Some(3000), "of the group above");
        bound("system.slice/scpsfm.service", "memory.max", "2000\n");
        bound("system.slice/other.service", "memory.max", "1000\n");
        assert_eq!(of("1:name=systemd:/x\n0::/system.slice/scpsfm.service\n"), Some(2000));
        assert_eq!(of("0::/\n"), None, "a root without a bound");
        bound("", "memory.max", "500\n");
        assert_eq!((of("0::/\n"), of("0::/hidden/from/containers\n")), (Some(500), Some(500)));
        bound("memory", "memory.limit_in_bytes", "400\n");
        assert_eq!(of("4:memory:/docker/x\n"), Some(400), "version 1");
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
        let limits = AttemptLimits::new(0);
        let first = limits.try_acquire().expect("nobody is alone");
        let mut alone = Box::pin(limits.acquire_exclusive());
        assert!((&mut alone).now_or_never().is_none(), "another is here");
        assert!(limits.try_acquire().is_none(), "one that comes later waits");
        let mut later = Box::pin(limits.acquire());
        assert!((&mut later).now_or_never().is_none());
        drop(first);
        let alone = alone.now_or_never().expect("nobody else is here").expect("open");
        assert!((&mut later).now_or_never().is_none() && limits.try_acquire().is_none());
        drop(alone);
        assert!(later.now_or_never().is_some());
    }
}
