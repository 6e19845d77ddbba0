//! Running a program to its end, and measuring what it takes.
//!
//! On Linux from `/proc`: a child that has ended keeps its CPU time there until it is waited for, and the high-water
//! mark of its memory until it ends. `wait4` would give both too, but its peak counts the memory of the process that
//! started the child. Elsewhere CPU time and memory are not measured.

use std::fs::{self, File};
use std::io;
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

use serde::Serialize;

use crate::domain::StopToken;

/// How often a child is looked at: what its memory grows by within the last of these is missed, and wall times are too
/// long by half of it.
const POLL: Duration = Duration::from_millis(5);
/// Looks between two searches for what the child has started: each reads every process of the machine.
const LOOKS_A_SEARCH: u32 = 20;
/// Unit of the times in `/proc/PID/stat`: `USER_HZ` is 100 a second wherever Linux runs but on Alpha.
const TICKS_A_SECOND: f64 = 100.0;
/// Characters of a child's last words that are kept.
const COMPLAINT_CHARS: usize = 300;
const COMPLAINTS: &str = "stderr.txt";

/// What a program took.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct Usage {
    pub wall_seconds: f64,
    /// User and system time of all its threads, and of the programs that it started and waited for; steps of .01 s.
    /// `None`: not measured.
    pub cpu_seconds: Option<f64>,
    /// Most memory resident at a time, in 10⁶ bytes, that of the programs it started included (as found every tenth of
    /// a second, the sum of their peaks). `None`: not measured.
    pub peak_memory_mb: Option<f64>,
}

/// CPU time that the calling thread has taken; `None`: not measured.
pub fn thread_cpu_seconds() -> Option<f64> {
    // proc_pid_schedstat(5): nanoseconds on a CPU come first.
    let text = fs::read_to_string("/proc/thread-self/schedstat").ok()?;
    Some(text.split_whitespace().next()?.parse::<u64>().ok()? as f64 * 1e-9)
}

/// How a program ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ended {
    Exited(ExitStatus),
    TimedOut,
    Stopped,
}

/// What came of a program.
#[derive(Debug, Clone)]
pub struct Outcome {
    pub ended: Ended,
    pub usage: Usage,
    /// Last line that it wrote to stderr; empty where there is none.
    pub complaint: String,
}

/// When to end a program that does not end by itself.
#[derive(Debug, Clone, Copy)]
pub struct Limits<'a> {
    pub wall: Option<Duration>,
    pub stop: &'a StopToken,
}

/// Runs `command` without input, its output thrown away; a file in `scratch` takes what it complains of. A program that
/// is ended takes with it what it has started.
///
/// # Errors
/// The program cannot be started or waited for.
pub fn run(command: &mut Command, limits: &Limits, scratch: &Path) -> io::Result<Outcome> {
    let complaints = scratch.join(COMPLAINTS);
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(File::create(&complaints)?);
    #[cfg(unix)]
    std::os::unix::process::CommandExt::process_group(command, 0);
    let begin = Instant::now();
    let mut child = Group(command.spawn()?);
    let mut meter = Meter::new(child.0.id());
    let ended = loop {
        // Once waited for, a child is gone from /proc: waiting comes after the look that saw its end.
        if meter.look() == Look::MayBeOver
            && let Some(status) = child.0.try_wait()?
        {
            break Ended::Exited(status);
        }
        let elapsed = begin.elapsed();
        if limits.stop.is_stopped() || limits.wall.is_some_and(|most| elapsed >= most) {
            child.end();
            break if limits.stop.is_stopped() { Ended::Stopped } else { Ended::TimedOut };
        }
        sleep(POLL);
    };
    let usage = Usage { wall_seconds: begin.elapsed().as_secs_f64(), ..meter.usage() };
    Ok(Outcome { ended, usage, complaint: last_line(&complaints) })
}

/// A child and all that it started; ended when dropped.
struct Group(Child);

impl Group {
    fn end(&mut self) {
        #[cfg(unix)]
        {
            // The group may outlive its leader; that there is none left is no error.
            let group = rustix::process::Pid::from_child(&self.0);
            let _ = rustix::process::kill_process_group(group, rustix::process::Signal::KILL);
        }
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

impl Drop for Group {
    fn drop(&mut self) {
        // A child that was waited for may have passed its number on to another process.
        if matches!(self.0.try_wait(), Ok(None)) {
            self.end();
        }
    }
}

#[derive(Debug, PartialEq, Eq)]
enum Look {
    Running,
    MayBeOver,
}

/// What has been seen of a child.
struct Meter {
    pid: u32,
    looks: u32,
    cpu_seconds: Option<f64>,
    /// Peak of the child itself, and the most that its descendants had.
    own_kb: u64,
    others_kb: u64,
}

impl Meter {
    fn new(pid: u32) -> Self {
        Self { pid, looks: 0, cpu_seconds: None, own_kb: 0, others_kb: 0 }
    }

    fn look(&mut self) -> Look {
        let Some(stat) = Stat::read(self.pid) else { return Look::MayBeOver };
        self.cpu_seconds = Some(stat.ticks as f64 / TICKS_A_SECOND);
        self.own_kb = self.own_kb.max(peak_kb(self.pid).unwrap_or(0));
        if self.looks.is_multiple_of(LOOKS_A_SEARCH) {
            let others = processes().filter(|&pid| pid != self.pid && in_group(pid, self.pid));
            self.others_kb = self.others_kb.max(others.filter_map(peak_kb).sum());
        }
        self.looks = self.looks.wrapping_add(1);
        if stat.is_over { Look::MayBeOver } else { Look::Running }
    }

    fn usage(&self) -> Usage {
        let kb = self.own_kb + self.others_kb;
        Usage {
            wall_seconds: 0.0,
            cpu_seconds: self.cpu_seconds,
            peak_memory_mb: (kb > 0).then_some(kb as f64 * 1024.0 / 1e6),
        }
    }
}

/// The parts of `/proc/PID/stat` (proc_pid_stat(5)) that are used.
#[derive(Debug, PartialEq, Eq)]
struct Stat {
    is_over: bool,
    group: u32,
    /// User and system time, that of the children that were waited for included.
    ticks: u64,
}

impl Stat {
    fn read(pid: u32) -> Option<Self> {
        Self::parse(&fs::read_to_string(format!("/proc/{pid}/stat")).ok()?)
    }

    /// The second field is the program's name in parentheses, with whatever it holds; fields are counted from 1.
    fn parse(text: &str) -> Option<Self> {
        let fields: Vec<&str> = text.get(text.rfind(')')? + 1..)?.split_whitespace().collect();
        let field = |number: usize| fields.get(number - 3).copied();
        // The times of children are signed in the kernel.
        let ticks: i64 = (14..=17).map(|number| field(number)?.parse::<i64>().ok()).sum::<Option<i64>>()?;
        Some(Self {
            is_over: matches!(field(3)?, "Z" | "X"),
            group: field(5)?.parse().ok()?,
            ticks: u64::try_from(ticks).ok()?,
        })
    }
}

fn processes() -> impl Iterator<Item = u32> {
    let entries = fs::read_dir("/proc").into_iter().flatten().flatten();
    entries.filter_map(|entry| entry.file_name().to_str()?.parse().ok())
}

fn in_group(pid: u32, group: u32) -> bool {
    Stat::read(pid).is_some_and(|stat| stat.group == group)
}

/// Sets the high-water mark of this process's memory back to what it holds; `false` where the system does not do that.
pub fn forget_peak_memory() -> bool {
    fs::write("/proc/self/clear_refs", "5").is_ok()
}

/// High-water mark of this process's memory in bytes; `None` where the system does not tell.
pub fn peak_memory() -> Option<u64> {
    Some(1024 * peak_kb(std::process::id())?)
}

/// High-water mark of the resident memory; `None` of a process that has ended.
fn peak_kb(pid: u32) -> Option<u64> {
    let status = fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    line.trim().strip_suffix("kB")?.trim().parse().ok()
}

/// Last line with something on it, cut to a length.
fn last_line(file: &Path) -> String {
    let text = fs::read(file).map(|bytes| String::from_utf8_lossy(&bytes).into_owned()).unwrap_or_default();
    let line = text.lines().map(str::trim).rfind(|line| !line.is_empty()).unwrap_or_default();
    line.chars().filter(|character| !character.is_control()).take(COMPLAINT_CHARS).collect()
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::*;

    fn shell(script: &str, wall: Option<Duration>) -> Outcome {
        let scratch = tempfile::tempdir().expect("a directory");
        let limits = Limits { wall, stop: &StopToken::default() };
        run(Command::new("sh").args(["-c", script]), &limits, scratch.path()).expect("a shell")
    }

    #[test]
    fn the_parts_of_a_stat_line_are_found_whatever_the_programs_name() {
        let line = "32 (a ) b) Z 31 30 29 0 -1 4227084 825 0 0 0 11 4 3 2 20 0 1 0 1960073 0 0";
        assert_eq!(Stat::parse(line), Some(Stat { is_over: true, group: 30, ticks: 20 }));
        assert_eq!(Stat::parse("32 (sh) Z 31"), None);
        assert_eq!(Stat::parse(""), None);
    }

    #[test]
    fn a_program_that_fails_leaves_its_last_words() {
        let outcome = shell("echo first >&2; echo 'no such table' >&2; echo >&2; exit 7", None);
        let Ended::Exited(status) = outcome.ended else { panic!("{outcome:?}") };
        assert_eq!(status.code(), Some(7));
        assert_eq!(outcome.complaint, "no such table");
    }

    #[test]
    fn work_and_memory_are_counted_with_what_the_program_starts() {
        // The inner shell counts, the outer one waits for it: its own time is next to nothing.
        let outcome = shell("sh -c 'i=0; while [ $i -lt 300000 ]; do i=$((i+1)); done'; true", None);
        let cpu_seconds = outcome.usage.cpu_seconds.expect("measured on Linux");
        assert!(cpu_seconds >= 0.02, "{outcome:?}");
        assert!(cpu_seconds <= outcome.usage.wall_seconds + 0.05, "{outcome:?}");
        let memory = outcome.usage.peak_memory_mb.expect("measured on Linux");
        assert!(memory > 0.1 && memory < 100.0, "{outcome:?}");
    }

    #[test]
    fn a_program_past_its_time_is_ended_with_what_it_started() {
        let scratch = tempfile::tempdir().expect("a directory");
        let pid_file = scratch.path().join("pid");
        let script = format!("sleep 600 & echo $! > {}; wait", pid_file.display());
        let stop = StopToken::default();
        // Ended when the shell has said what it started, however long that takes here.
        let outcome = std::thread::scope(|scope| {
            scope.spawn(|| {
                while !fs::read_to_string(&pid_file).is_ok_and(|text| text.ends_with('\n')) {
                    sleep(POLL);
                }
                stop.stop(crate::domain::StopReason::Cancelled);
            });
            let limits = Limits { wall: None, stop: &stop };
            run(Command::new("sh").args(["-c", &script]), &limits, scratch.path()).expect("a shell")
        });
        assert_eq!(outcome.ended, Ended::Stopped);
        let pid: u32 = fs::read_to_string(&pid_file).expect("written").trim().parse().expect("a number");
        // Killed, though perhaps not yet taken off the list by init.
        while Stat::read(pid).is_some_and(|stat| !stat.is_over) {
            sleep(POLL);
        }
        assert_eq!(shell("sleep 600", Some(Duration::from_millis(20))).ended, Ended::TimedOut);
    }
}
