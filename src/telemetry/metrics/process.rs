//! What the process takes of the machine, as Linux tells it.

use std::sync::{Mutex, PoisonError};

use super::catalogue::{Metric, PROCESS_CPU, PROCESS_FILES, PROCESS_MEMORY};

/// Ticks a second in which Linux tells processor time to programs, on every architecture that it still runs on
/// (`USER_HZ`).
const TICKS_A_SECOND: u64 = 100;

/// What the process takes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Usage {
    pub memory_bytes: u64,
    pub cpu_seconds: u64,
    pub open_files: u64,
}

impl Usage {
    /// As of now, or when it was last read: processor time must not fall to 0 where files cannot be opened. `None`
    /// where it never was, on another system.
    pub(super) fn latest() -> Option<Self> {
        static LATEST: Mutex<Option<Usage>> = Mutex::new(None);
        let mut latest = LATEST.lock().unwrap_or_else(PoisonError::into_inner);
        *latest = Self::read().or(*latest);
        *latest
    }

    /// As of now; `None` where files cannot be opened, and where the system is another.
    fn read() -> Option<Self> {
        let file = |name: &str| std::fs::read_to_string(format!("/proc/self/{name}")).ok();
        Some(Self {
            memory_bytes: memory_bytes(&file("status")?)?,
            cpu_seconds: cpu_seconds(&file("stat")?)?,
            open_files: std::fs::read_dir("/proc/self/fd").ok()?.count() as u64,
        })
    }
}

/// Which part of the usage a metric is; `None` for one that is not of the process.
pub(super) fn reading(metric: &Metric) -> Option<fn(Usage) -> u64> {
    if metric.name == PROCESS_MEMORY.name {
        Some(|usage| usage.memory_bytes)
    } else if metric.name == PROCESS_CPU.name {
        Some(|usage| usage.cpu_seconds)
    } else if metric.name == PROCESS_FILES.name {
        Some(|usage| usage.open_files)
    } else {
        None
    }
}

/// Of `/proc/self/status`, which has `VmRSS:  1234 kB`.
fn memory_bytes(status: &str) -> Option<u64> {
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
    let kilobytes: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(1024 * kilobytes)
}

/// Of `/proc/self/stat` (proc(5)): user and system time are fields 14 and 15. The second is the program's name in
/// brackets, which may hold anything, so that they are counted from the last bracket on.
fn cpu_seconds(stat: &str) -> Option<u64> {
    let (_, fields) = stat.rsplit_once(')')?;
    let mut times = fields.split_whitespace().skip(11).map(str::parse::<u64>);
    let ticks = times.next()?.ok()? + times.next()?.ok()?;
    Some(ticks / TICKS_A_SECOND)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_systems_files_are_understood() {
        assert_eq!(memory_bytes("Name:\tscpsfm\nVmRSS:\t   12340 kB\nThreads:\t4\n"), Some(12_340 * 1024));
        let stat = "17 (a (b) c) S 1 17 17 0 -1 4194560 900 0 0 0 1234 567 0 0 20 0 9 0 100 1000 200";
        assert_eq!(cpu_seconds(stat), Some(18));
        assert_eq!((memory_bytes(""), cpu_seconds("17 (a")), (None, None));
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn a_process_takes_memory_and_files() {
        let usage = Usage::read().expect("read");
        assert!(usage.memory_bytes > 1 << 20 && usage.open_files > 0);
    }
}
