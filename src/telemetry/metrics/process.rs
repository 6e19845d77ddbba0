//! What the process takes of the machine, as Linux tells it.

/// Ticks a second in which Linux tells processor time to programs, on every architecture that it still runs on
/// (`USER_HZ`).
const TICKS_A_SECOND: u64 = 100;

/// What the process takes.
pub(super) struct Usage {
    pub memory_bytes: u64,
    pub cpu_seconds: u64,
    pub open_files: u64,
}

impl Usage {
    /// As of now; `None` where the system is another.
    pub(super) fn read() -> Option<Self> {
        let file = |name: &str| std::fs::read_to_string(format!("/proc/self/{name}")).ok();
        Some(Self {
            memory_bytes: memory_bytes(&file("status")?)?,
            cpu_seconds: cpu_seconds(&file("stat")?)?,
            open_files: std::fs::read_dir("/proc/self/fd").ok()?.count() as u64,
        })
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
