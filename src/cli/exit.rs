//! How a command ends: a code for scripts, and one sentence when it failed.

use std::fmt;
use std::process::ExitCode;

use crate::domain::{InvalidInput, Solution, Status, Violation};
use crate::formats;

/// The codes, as `scpsfm --help` shows them, and every command that solves or talks to a server.
pub const HELP: &str = "\
Exit codes:
    0  done; of a solve: solved (the grade may still be PROJECTIVE_ONLY: see result.json)
    1  internal or I/O error, or a job that failed or exceeded its deadline
    2  wrong usage
    3  no reconstruction: the result files were written and say why
   64  bad configuration
   65  bad input data, or more than the server ever takes; no such job, or one whose state does not allow the call,
       such as `result` before it has ended
   69  server unavailable or its queue full: try again
   77  not let in: no API key, an unknown one, one whose scope does not allow the call, or a certificate that one side
       does not trust
  130  interrupted or cancelled";

/// How a command ended. 2 is clap's own; 64, 65, 69 and 77 are `EX_USAGE`, `EX_DATAERR`, `EX_UNAVAILABLE`
/// and `EX_NOPERM` of sysexits.h; 130 is what a shell reports of a program ended by Ctrl-C.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Exit {
    Done = 0,
    Internal = 1,
    Usage = 2,
    NoReconstruction = 3,
    BadConfig = 64,
    BadInput = 65,
    Unavailable = 69,
    NotLetIn = 77,
    Interrupted = 130,
}

impl Exit {
    /// How a solve that ended with this solution ends its command.
    pub fn of(solution: &Solution) -> Self {
        Self::of_status(solution.status)
    }

    /// The same where only the status is at hand.
    pub fn of_status(status: Status) -> Self {
        match status {
            Status::Solved => Exit::Done,
            Status::NoReconstruction => Exit::NoReconstruction,
        }
    }
}

impl From<Exit> for ExitCode {
    fn from(exit: Exit) -> Self {
        ExitCode::from(exit as u8)
    }
}

/// Why a command failed. `message` is printed once, on stderr, by [`run`](super::run).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Failure {
    pub exit: Exit,
    pub message: String,
}

/// The flag with the name of a field: `--noise-px` of `job.settings.noise_px`.
pub fn flag_named(field: &str) -> String {
    format!("--{}", field.rsplit('.').next().unwrap_or_default().replace('_', "-"))
}

impl Failure {
    fn new(exit: Exit, message: impl fmt::Display) -> Self {
        Self { exit, message: message.to_string() }
    }

    pub fn internal(message: impl fmt::Display) -> Self {
        Self::new(Exit::Internal, message)
    }

    pub fn usage(message: impl fmt::Display) -> Self {
        Self::new(Exit::Usage, message)
    }

    /// Options out of range, by the flags that have their names: `--noise-px: ...`.
    pub fn of_flags(invalid: &InvalidInput) -> Self {
        let of_flag = |violation: &Violation| format!("{}: {}", flag_named(&violation.field), violation.description);
        Self::usage(invalid.violations().iter().map(of_flag).collect::<Vec<_>>().join("; "))
    }

    pub fn bad_config(message: impl fmt::Display) -> Self {
        Self::new(Exit::BadConfig, message)
    }

    pub fn bad_input(message: impl fmt::Display) -> Self {
        Self::new(Exit::BadInput, message)
    }

    pub fn unavailable(message: impl fmt::Display) -> Self {
        Self::new(Exit::Unavailable, message)
    }

    pub fn interrupted() -> Self {
        Self::interrupted_with("interrupted; no result was written")
    }

    /// Interrupted, with what is left of the work.
    pub fn interrupted_with(message: impl fmt::Display) -> Self {
        Self::new(Exit::Interrupted, message)
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.message)
    }
}

impl From<std::io::Error> for Failure {
    fn from(error: std::io::Error) -> Self {
        Self::internal(error)
    }
}

impl From<InvalidInput> for Failure {
    fn from(error: InvalidInput) -> Self {
        Self::bad_input(error)
    }
}

impl From<formats::Error> for Failure {
    fn from(error: formats::Error) -> Self {
        Self::bad_input(error)
    }
}
