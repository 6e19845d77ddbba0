//! `scpsfm train-prior`: trains the network whose scores the search starts from.

use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::Instant;

use indicatif::{ProgressBar, ProgressStyle};

use super::args::{parse_whole, parse_within};
use super::exit::{Exit, Failure};
use super::interrupt::Interrupt;
use crate::domain::counted;
use crate::formats::publish::{create_directory, write_atomically};
use crate::report::chart::{LineChart, Series, standalone};
use crate::training::{Milestone, Objective, Settings, Trainer};
use scpsfm_core::subspace::{PriorFile, Shape};

/// Steps of the shipped network.
const STEPS: u64 = 7_000;
/// Seconds between two writings of the state: what a power cut costs at most.
const SECONDS_PER_STATE: f64 = 10.0;

const EXAMPLES: &str = "\
Examples:
  scpsfm train-prior --out my.prior --seed 1
  scpsfm train-prior --out trial.prior --steps 1000   # a seventh of it, for a look
  scpsfm solve observations.csv --width 1000 --height 1000 --prior my.prior --out answer

Files beside FILE: FILE.svg, the curves of losses and of average precision on scenes that training never sees; and \
until it ends FILE.state, written every ten seconds, from which a training that was stopped (Ctrl-C, a power cut) goes on \
when called again with the same arguments.";

/// Train the network that ranks tracks before the search
///
/// A small set network learns to tell right tracks from wrong ones on scenes that are drawn on the fly: all motions,
/// shapes, kinds of noise and of outliers that the program can make. Everything is counted in steps: one seed gives one
/// file on one machine, whatever else runs on it and however often the training is interrupted. The program carries the
/// network that its own defaults give.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES, after_long_help = format!("{EXAMPLES}\n\n{}", super::exit::HELP))]
pub struct Args {
    /// File for the network; an earlier network there is replaced, another file is not
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,

    /// Seed of the first weights and of all scenes
    #[arg(long, value_name = "SEED", default_value_t = 0, value_parser = parse_whole::<u64>)]
    pub seed: u64,

    /// Steps, each on two batches of 2 to 24 scenes; the learning rate falls with the share that is done
    #[arg(long, value_name = "N", default_value_t = STEPS, value_parser = parse_within(1..=10_000_000))]
    pub steps: u64,

    /// Learn from the paper's losses L_num and L_proj instead of labels, for comparison: such a network ranks tracks
    /// only, and worse
    #[arg(long)]
    pub unlabelled: bool,

    /// Train a network that also asks neighbouring pairs of views for their epipolar geometry
    #[arg(long)]
    pub pairs: bool,

    /// Show no progress
    #[arg(long, short)]
    pub quiet: bool,
}

/// Runs the command.
pub async fn run(args: Args) -> Result<Exit, Failure> {
    let interrupt = Interrupt::listen()?;
    let stopped = interrupt.token();
    let work = tokio::task::spawn_blocking(move || train(&args, &|| stopped.is_cancelled()));
    work.await.map_err(|error| Failure::internal(format_args!("the training failed: {error}")))?
}

/// Where a training's files are.
struct Files {
    directory: PathBuf,
    name: String,
}

impl Files {
    fn new(out: &Path) -> Result<Self, Failure> {
        let name = out.file_name().and_then(|name| name.to_str());
        let name = name.ok_or_else(|| Failure::usage(format_args!("--out {}: not a file's name", out.display())))?;
        if let Ok(there) = fs::symlink_metadata(out) {
            check_replaceable(out, &there)?;
        }
        let directory = match out.parent() {
            Some(parent) if !parent.as_os_str().is_empty() => parent.to_owned(),
            _ => PathBuf::from("."),
        };
        create_directory(&directory)?;
        Ok(Self { directory, name: name.to_owned() })
    }

    fn state_name(&self) -> String {
        format!("{}.state", self.name)
    }

    fn state(&self) -> PathBuf {
        self.directory.join(self.state_name())
    }
}

fn train(args: &Args, is_stopped: &dyn Fn() -> bool) -> Result<Exit, Failure> {
    let files = Files::new(&args.out)?;
    let objective = if args.unlabelled { Objective::PaperLosses } else { Objective::Labels };
    let shape = if args.pairs { Shape::with_pairs() } else { Shape::default() };
    let settings = Settings { seed: args.seed, steps: args.steps, shape, objective };
    let mut trainer = take_up(&files, settings)?;
    let view = View::new(args, objective, trainer.step());
    // At once, too: a folder that cannot be written to is better known before the work.
    write_state(&files, &trainer)?;
    let mut written = Instant::now();
    while !trainer.is_finished() {
        let milestone = trainer.advance().map_err(Failure::internal)?;
        view.step(trainer.step());
        if let Some(milestone) = milestone {
            view.milestone(&milestone);
            write_curves(&files, objective, trainer.milestones())?;
        }
        let stopped = is_stopped() && !trainer.is_finished();
        if stopped || written.elapsed().as_secs_f64() > SECONDS_PER_STATE {
            write_state(&files, &trainer)?;
            written = Instant::now();
        }
        if stopped {
            view.note(&format!("stopped after step {}; the same command goes on from there", trainer.step()));
            return Ok(Exit::Interrupted);
        }
    }
    let command = format!("scpsfm train-prior {} --out FILE", settings.arguments());
    let file = trainer.file(command);
    write_atomically(&files.directory, &files.name, &file.bytes())?;
    write_curves(&files, objective, trainer.milestones())?;
    if let Err(error) = fs::remove_file(files.state())
        && error.kind() != ErrorKind::NotFound
    {
        return Err(Failure::internal(format_args!("cannot remove {}: {error}", files.state().display())));
    }
    view.note(&format!("{}: a network with sha256 {}, by which results name it", args.out.display(), file.sha256()));
    Ok(Exit::Done)
}

/// Whether what is there may be replaced: a network may, anything else was not meant.
fn check_replaceable(out: &Path, there: &fs::Metadata) -> Result<(), Failure> {
    let refused = |what: &str| Err(Failure::usage(format_args!("--out {}: {what}", out.display())));
    if there.is_dir() {
        return refused("a directory, give a file");
    }
    if !there.is_file() {
        return refused("a link or a device, which would be replaced by a file: give a file of its own");
    }
    match PriorFile::open(out) {
        Ok(_) => Ok(()),
        Err(_) if there.len() == 0 => Ok(()),
        Err(_) => refused("there is a file that is no trained network, and it would be replaced: give another name"),
    }
}

/// A new training, or the one that was stopped.
fn take_up(files: &Files, settings: Settings) -> Result<Trainer, Failure> {
    let path = files.state();
    match fs::read(&path) {
        Ok(state) => Trainer::resume(&state, settings)
            .map_err(|error| Failure::bad_input(format_args!("{}: {error}; remove it to start anew", path.display()))),
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(Trainer::new(settings)),
        Err(error) => Err(Failure::internal(format_args!("cannot read {}: {error}", path.display()))),
    }
}

fn write_state(files: &Files, trainer: &Trainer) -> Result<(), Failure> {
    let state = trainer.state().map_err(Failure::internal)?;
    Ok(write_atomically(&files.directory, &files.state_name(), &state)?)
}

fn write_curves(files: &Files, objective: Objective, milestones: &[Milestone]) -> Result<(), Failure> {
    let curve = |name, value: &dyn Fn(&Milestone) -> f64| Series {
        name,
        points: milestones.iter().map(|milestone| (milestone.step as f64, value(milestone))).collect(),
    };
    let chart = |title, series| {
        LineChart { title, x_label: "step", series, logarithmic: false, clip: None, marks: Vec::new() }.svg()
    };
    let [first, second] = objective.parts();
    let losses = vec![curve(first, &|milestone| milestone.parts[0]), curve(second, &|milestone| milestone.parts[1])];
    let charts = [
        chart("Losses in training", losses),
        chart("Average precision on unseen scenes", vec![curve("", &|milestone| milestone.precision)]),
    ];
    write_atomically(&files.directory, &format!("{}.svg", files.name), standalone(&charts).as_bytes())?;
    Ok(())
}

/// Progress on stderr: a bar on a terminal, a line a milestone elsewhere.
struct View {
    quiet: bool,
    objective: Objective,
    bar: ProgressBar,
}

impl View {
    fn new(args: &Args, objective: Objective, step: u64) -> Self {
        let bar = if args.quiet { ProgressBar::hidden() } else { ProgressBar::new(args.steps) };
        if let Ok(style) = ProgressStyle::with_template("[{bar:24}] {pos}/{len} steps, {eta} left {wide_msg}") {
            bar.set_style(style.progress_chars("=> "));
        }
        bar.set_position(step);
        bar.reset_eta();
        let view = Self { quiet: args.quiet, objective, bar };
        if step > 0 {
            view.note(&format!("going on after step {step}"));
        }
        view
    }

    fn step(&self, step: u64) {
        self.bar.set_position(step);
    }

    fn milestone(&self, milestone: &Milestone) {
        let Milestone { step, scenes, loss, parts: [first, second], precision } = milestone;
        let [first_name, second_name] = self.objective.parts();
        let line = format!(
            "step {step}, {}: loss {loss:.4} ({first_name} {first:.4}, {second_name} {second:.4}), average \
             precision {precision:.4}",
            counted(*scenes, "scene")
        );
        self.bar.set_message(format!("AP {precision:.4}"));
        self.note(&line);
    }

    fn note(&self, line: &str) {
        if !self.quiet {
            self.bar.suspend(|| tell!("{line}"));
        }
    }
}
