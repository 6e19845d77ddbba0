//! The command line: one file a subcommand, plus what they share (arguments, exit codes, progress).
//!
//! May depend on everything. Commands that talk to a server use `client`; few of them see the API's messages.

/// Writes a line to standard error. That its reader has gone ends nothing: what is computed is worth more than its
/// progress.
macro_rules! tell {
    ($($line:tt)*) => {{
        use std::io::Write;
        let _ = writeln!(std::io::stderr(), $($line)*);
    }};
}

pub mod access;
pub mod admin;
pub mod args;
pub mod cancel;
pub mod completions;
pub mod delete;
pub mod demo;
pub mod evaluate;
pub mod evaluate_choices;
pub mod evaluate_long;
pub mod evaluate_observations;
pub mod evaluate_photographed;
mod evaluate_priors;
pub mod evaluate_real;
pub mod evaluate_suite;
pub mod exit;
pub mod export_args;
pub mod get;
pub mod input_args;
pub mod inputs;
pub mod interrupt;
pub mod job_view;
pub mod list;
pub mod man;
pub mod next_steps;
pub mod prior_file;
pub mod priority;
pub mod progress;
pub mod remote;
pub mod result;
pub mod retry;
pub mod scene_args;
pub mod serve;
pub mod service;
pub mod settings_args;
mod shell;
pub mod solve;
pub mod submit;
pub mod summary;
pub mod synth;
pub mod train_prior;
pub mod upload;
pub mod watch;
pub mod windows;

use std::io::Write;
use std::process::ExitCode;

use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};

pub use exit::{Exit, Failure};

/// Name of the program.
const NAME: &str = "scpsfm";

/// Threads of the runtime that drives a command's I/O; solving never runs on them.
const RUNTIME_THREADS: usize = 2;

/// Robust, self-calibrating projective structure from motion: which tracks of uncalibrated images are right, the
/// camera's focal length with its uncertainty, and the projective and metric reconstruction.
#[derive(Debug, Parser)]
#[command(name = NAME, version, after_help = exit::HELP)]
pub struct Cli {
    #[command(subcommand)]
    pub command: Command,
}

/// What to do.
#[derive(Debug, Subcommand)]
pub enum Command {
    Demo(demo::Args),
    Serve(serve::Args),
    Solve(solve::Args),
    Upload(upload::Args),
    Inputs(inputs::Args),
    Submit(submit::Args),
    Watch(watch::Args),
    Get(get::Args),
    List(list::Args),
    Cancel(cancel::Args),
    Retry(retry::Args),
    Priority(priority::Args),
    Delete(delete::Args),
    Result(result::Args),
    Admin(admin::Args),
    Synth(synth::Args),
    Evaluate(evaluate::Args),
    TrainPrior(train_prior::Args),
    Completions(completions::Args),
    Man(man::Args),
}

impl Cli {
    /// Parses this process's arguments; ends the process with help or a complaint where they are none.
    pub fn from_arguments() -> Self {
        Self::from_arg_matches(&command().get_matches()).unwrap_or_else(|error| error.exit())
    }
}

/// The command line. A negative number is a value, out of range perhaps, and no flag with a wrong name.
fn command() -> clap::Command {
    Cli::command().mut_subcommands(|subcommand| subcommand.allow_negative_numbers(true))
}

/// Runs a parsed command line; an error is printed on stderr, once.
pub fn run(cli: Cli) -> ExitCode {
    match dispatch(cli.command) {
        Ok(exit) => exit.into(),
        Err(failure) => {
            tell!("error: {failure}");
            failure.exit.into()
        }
    }
}

fn dispatch(command: Command) -> Result<Exit, Failure> {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(RUNTIME_THREADS)
        .enable_all()
        .build()
        .map_err(|error| Failure::internal(format_args!("cannot start the runtime: {error}")))?;
    match command {
        Command::Demo(args) => runtime.block_on(demo::run(args)),
        Command::Serve(args) => runtime.block_on(serve::run(args)),
        Command::Solve(args) => runtime.block_on(solve::run(args)),
        Command::Upload(args) => runtime.block_on(upload::run(args)),
        Command::Inputs(args) => runtime.block_on(inputs::run(args)),
        Command::Submit(args) => runtime.block_on(submit::run(args)),
        Command::Watch(args) => runtime.block_on(watch::run(args)),
        Command::Get(args) => runtime.block_on(get::run(args)),
        Command::List(args) => runtime.block_on(list::run(args)),
        Command::Cancel(args) => runtime.block_on(cancel::run(args)),
        Command::Retry(args) => runtime.block_on(retry::run(args)),
        Command::Priority(args) => runtime.block_on(priority::run(args)),
        Command::Delete(args) => runtime.block_on(delete::run(args)),
        Command::Result(args) => runtime.block_on(result::run(args)),
        Command::Admin(args) => runtime.block_on(admin::run(args)),
        Command::Synth(args) => synth::run(args),
        Command::Evaluate(args) => runtime.block_on(evaluate::run(args)),
        Command::TrainPrior(args) => runtime.block_on(train_prior::run(args)),
        Command::Completions(args) => completions::run(args),
        Command::Man(args) => man::run(args),
    }
}

/// Writes `text` and a newline to stdout. A reader that went away (`| head`) is no error.
pub(crate) fn print(text: &str) -> Result<(), Failure> {
    let mut stdout = std::io::stdout().lock();
    match writeln!(stdout, "{text}").and_then(|()| stdout.flush()) {
        Err(error) if error.kind() != std::io::ErrorKind::BrokenPipe => {
            Err(Failure::internal(format_args!("cannot write to stdout: {error}")))
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_negative_number_is_told_its_range() {
        for flag in ["--seed", "--width", "--height"] {
            let given = command().try_get_matches_from(["scpsfm", "solve", "x.csv", "--out", "y", flag, "-1"]);
            let complaint =
                given.and_then(|matches| Cli::from_arg_matches(&matches)).expect_err("negative").to_string();
            assert!(complaint.contains(flag) && complaint.contains("invalid value '-1'"), "{complaint}");
        }
    }
}
