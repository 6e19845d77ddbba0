//! The `scpsfm` program: parse, run, exit code.

use std::process::ExitCode;

/// The networks' arrays live for one iteration each. The system's allocator maps the larger ones anew every time, and
/// the faults that follow were a fifth of the time of an optimisation.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    scpsfm::cli::run(scpsfm::cli::Cli::from_arguments())
}
