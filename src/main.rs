//! The `scpsfm` program: parse, run, exit code.

use std::process::ExitCode;

use clap::Parser;

fn main() -> ExitCode {
    scpsfm::cli::run(scpsfm::cli::Cli::parse())
}
