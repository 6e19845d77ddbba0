//! What a process takes of the machine's memory.

/// Megabytes of a process that are in memory now.
pub fn resident_mb(pid: u32) -> u64 {
    field_mb(pid, "VmRSS:")
}

/// The most that they ever were.
pub fn peak_mb(pid: u32) -> u64 {
    field_mb(pid, "VmHWM:")
}

fn field_mb(pid: u32, field: &str) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).expect("a process");
    let line = status.lines().find_map(|line| line.strip_prefix(field)).expect("its memory").trim();
    line.trim_end_matches(" kB").parse::<u64>().expect("a number") / 1024
}
