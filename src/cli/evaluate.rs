//! `scpsfm evaluate`: the paper's evaluation, every method against the oracle; real sequences are in [`evaluate_real`].

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use clap::ValueEnum;
use serde_json::{Value, json};

use super::args::{cores, parse_within};
use super::evaluate_choices::{ContestantArg, DepthsArg, SweepArg};
use super::evaluate_long::{self, LongArgs};
use super::evaluate_observations::{self, ObservationArgs};
use super::evaluate_photographed::{self, PhotographedArgs};
use super::evaluate_priors::{self, PriorArgs};
use super::evaluate_real::{self, RealArgs};
use super::evaluate_suite::{MOST_SEEDS, SceneFilter, SuiteRunner};
use super::exit::{self, Exit, Failure};
use super::prior_file::PriorFileArgs;
use crate::domain::{SolveSettings, counted};
use crate::evaluation::plan::{Contestant, Depths, Plan, Run};
use crate::evaluation::runner::{self, Records};
use crate::evaluation::summary::{self, Cell};
use crate::evaluation::{Sweep, figures, page};
use crate::formats::publish::write_atomically;
use crate::synthetic::SceneOptions;

/// Seeds of a full evaluation and of a quick one.
const SEEDS: u64 = 20;
const QUICK_SEEDS: u64 = 4;
/// Observations of a scene up to which a quick evaluation solves it: a second or two each, with the paper's network
/// too.
const QUICK_OBSERVATIONS: usize = 5_000;

const EXAMPLES: &str = "\
Examples:
  scpsfm evaluate --quick
  scpsfm evaluate --out evaluation --seeds 20 --threads 2
  scpsfm evaluate --sweeps outliers,orbit --depths none --methods oracle,auto,geometry
  scpsfm evaluate --beyond --methods oracle,auto --depths none
  scpsfm evaluate --ablation --sweeps outliers,orbit --out ablation
  scpsfm evaluate --sweeps outliers --depths given,epipolar --methods paper,psfm --paper-width 1
  scpsfm evaluate --priors --seeds 20 --out priors
  scpsfm evaluate --observations --scenes complete --out observations
  scpsfm evaluate --photographed --seeds 40 --scenes fisheye --out photographed
  scpsfm evaluate --long --scenes drive,corridor --out long
  scpsfm evaluate --real sequences --peer 'python peer.py' --out side-by-side

Files in the output directory: runs.jsonl (every run, one a line), summary.csv and summary.json (one entry a cell), \
figure-depths-*.svg (the paper's layout) and index.html, which shows all of it. Stopped by Ctrl-C, a crash or a power \
cut it goes on where it was when called again with the same directory.";

/// What the columns of the tables are, for the long help.
const COLUMNS: &str = "\
Columns of the table, of the cells by seeds and method:
  F1, min F1   of the inlier verdicts, mean and least; what is not verified counts as rejected
  2D px        root mean square distance of the reprojections from the points without noise, of the true inliers that
               were kept; median over the seeds that reconstruct something
  focal %      |log(f / true f)| in per cent, median over the seeds that give a focal length
  seconds      median of a solve; with several threads or other work on the machine it is longer
More, in summary.csv: 3D error, ratio of the focal error to the oracle's, grades; 95 % intervals of F1 and the errors.
Of --priors: AP, the average precision of the ranking by a prior alone; F1 and s after 600, 6,000 and 60,000 samples;
verified, ranked, none: answers of AUTO by kind; AP rank, of the ranked ones.";

/// Run the paper's evaluation: sweeps over points, outliers, noise and views, every method against the oracle
///
/// Scenes are made by the generator of `scpsfm synth`, with projective depths given (as the paper does) and without.
/// The oracle knows the truth: its gate and its bundle adjustment are the best that anyone can do on the same scenes.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES, after_long_help = long_help())]
pub struct Args {
    /// Directory for records and figures; created; runs that it already holds are not repeated
    #[arg(long, value_name = "DIR", default_value = "scpsfm-evaluation")]
    pub out: PathBuf,

    /// Scenes a cell [default: 20, with --quick 4, with --photographed 300 in all, with --long 1]
    #[arg(long, value_name = "N", value_parser = parse_within(1..=MOST_SEEDS))]
    pub seeds: Option<u64>,

    /// A first impression: 4 seeds, and of the sweeps only cells that take less than a few seconds
    #[arg(long)]
    pub quick: bool,

    /// Solves at a time, one thread each [default: one a core]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    pub threads: Option<u16>,

    /// Sweeps to run [default: those of the paper, strong noise and the orbit]
    #[arg(long, value_enum, value_delimiter = ',', value_name = "SWEEP")]
    pub sweeps: Vec<SweepArg>,

    /// All sweeps, those that the paper leaves out included: structured outliers, critical motions, lens terms
    #[arg(long, conflicts_with = "sweeps")]
    pub beyond: bool,

    /// AUTO without one of its parts at a time, instead of all methods
    #[arg(long, conflicts_with = "methods")]
    pub ablation: bool,

    /// How projective depths are given [default: all]; `epipolar` runs paper, scpsfm and psfm only
    #[arg(long, value_enum, value_delimiter = ',', value_name = "DEPTHS")]
    pub depths: Vec<DepthsArg>,

    /// Methods to run [default: all]
    #[arg(long, value_enum, value_delimiter = ',', value_name = "METHOD")]
    pub methods: Vec<ContestantArg>,

    /// Width of the network in `paper` and `scpsfm`, with the DAQ term and without, as a share of the original
    /// PointNet; 1 is the paper's
    #[arg(long, value_name = "SHARE", value_parser = width, default_value_t = SolveSettings::DEFAULT_NETWORK_WIDTH)]
    pub paper_width: f64,

    /// Print summary.json (with --real, real.json) on stdout, instead of a table
    #[arg(long)]
    pub json: bool,

    /// Show no progress
    #[arg(long, short)]
    pub quiet: bool,

    #[command(flatten)]
    pub scenes: SceneFilter,

    #[command(flatten)]
    pub prior: PriorFileArgs,

    #[command(flatten)]
    pub priors: PriorArgs,

    #[command(flatten)]
    pub observations: ObservationArgs,

    #[command(flatten)]
    pub photographed: PhotographedArgs,

    #[command(flatten)]
    pub long: LongArgs,

    #[command(flatten)]
    pub real: RealArgs,
}

fn long_help() -> String {
    [EXAMPLES, COLUMNS, evaluate_real::FORMAT, exit::HELP].join("\n\n")
}

/// A width that the solver accepts.
fn width(text: &str) -> Result<f64, String> {
    let width = text.parse().map_err(|_| "not a number".to_owned())?;
    let settings = SolveSettings { network_width: width, ..SolveSettings::default() };
    settings.validate().map_err(|error| error.to_string())?;
    Ok(width)
}

impl Args {
    fn plan(&self) -> Plan {
        let wanted: BTreeSet<String> = self
            .sweeps
            .iter()
            .filter_map(|sweep| sweep.to_possible_value())
            .map(|value| value.get_name().to_owned())
            .collect();
        let mut sweeps = if wanted.is_empty() && !self.beyond { Sweep::paper() } else { Sweep::all() };
        sweeps.retain(|sweep| self.beyond || wanted.is_empty() || wanted.contains(sweep.name));
        if self.quick {
            sweeps.iter_mut().for_each(|sweep| sweep.cells.retain(|(_, scene)| is_quick(scene.views * scene.tracks)));
        }
        let unique = |mut list: Vec<Contestant>| {
            list.sort_unstable();
            list.dedup();
            list
        };
        let contestants: Vec<Contestant> = self.methods.iter().map(|&method| method.into()).collect();
        let mut depths: Vec<Depths> = self.depths.iter().map(|&depths| depths.into()).collect();
        depths.sort_unstable();
        depths.dedup();
        Plan {
            sweeps,
            depths: if depths.is_empty() { Depths::ALL.to_vec() } else { depths },
            contestants: match contestants.is_empty() {
                true if self.ablation => Contestant::ABLATION.to_vec(),
                true => Contestant::ALL.to_vec(),
                false => unique(contestants),
            },
            seeds: self.seeds.unwrap_or(if self.quick { QUICK_SEEDS } else { SEEDS }),
            paper_width: self.paper_width,
        }
    }
}

/// Observations of a scene up to which a quick evaluation solves it.
fn is_quick(observations: usize) -> bool {
    observations <= QUICK_OBSERVATIONS
}

/// Runs the command.
pub async fn run(args: Args) -> Result<Exit, Failure> {
    if !args.real.real.is_empty() {
        if args.prior.prior.is_some() {
            return Err(Failure::usage("--prior does not reach the programs that --real starts"));
        }
        return evaluate_real::run(&args.real, &args.out, args.json, args.quiet).await;
    }
    args.prior.install()?;
    let threads = args.threads.map_or_else(cores, usize::from);
    let seeds = args.seeds.unwrap_or(SEEDS);
    let suite = SuiteRunner { out: &args.out, threads, quiet: args.quiet, json: args.json };
    let scenes = args.scenes.texts();
    if args.observations.observations {
        return evaluate_observations::run(&scenes, seeds, args.real.peer_words()?, &suite);
    }
    if args.photographed.photographed {
        let seeds = args.seeds.unwrap_or(evaluate_photographed::SEEDS);
        let first = args.photographed.first_seed;
        return evaluate_photographed::run(&scenes, first..first + seeds, args.real.peer_words()?, &suite);
    }
    if args.long.long {
        // One after the other: the memory is that of one solve.
        let seeds = args.seeds.unwrap_or(evaluate_long::SEEDS);
        return evaluate_long::run(&scenes, seeds, &SuiteRunner { threads: 1, ..suite });
    }
    if args.priors.priors {
        return evaluate_priors::run(&args.priors, &scenes, seeds, &suite);
    }
    let plan = args.plan();
    let runs = plan.runs();
    if runs.is_empty() {
        return Err(Failure::usage("no method has anything to say of these sweeps and depths: give others"));
    }
    suite.run_described(runner::RECORDS, &runs, runner::measure, describe, "summary.json", |records, note| {
        let cells = summary::cells(&plan, records);
        Ok((write_summary(&args.out, &plan, records, &cells, note)?, table(&cells)))
    })
}

/// A run in a line.
fn describe(run: &Run) -> String {
    let Run { contestant, scene, .. } = run;
    let SceneOptions { views, tracks, outliers, noise, .. } = scene;
    let (views, tracks) = (counted(*views, "view"), counted(*tracks, "track"));
    format!("{}: {views}, {tracks}, {outliers} outliers, {noise} noise", contestant.name())
}

/// Writes tables and figures; returns the JSON. `note`: what there is to say of runs that are missing.
fn write_summary(
    out: &Path,
    plan: &Plan,
    records: &Records,
    cells: &[Cell],
    note: Option<&str>,
) -> Result<Value, Failure> {
    let coverage: Vec<_> = plan
        .contestants
        .iter()
        .filter(|&&contestant| contestant != Contestant::Oracle)
        .filter_map(|&contestant| summary::coverage(plan, records, contestant))
        .collect();
    write_atomically(out, "summary.csv", summary::csv(cells).as_bytes())?;
    // Cells with names instead of values are in the tables.
    let has_figure = plan.sweeps.iter().any(|sweep| sweep.names.is_empty());
    for &depths in plan.depths.iter().filter(|_| has_figure) {
        let name = format!("figure-depths-{}.svg", depths.name());
        write_atomically(out, &name, figures::svg(plan, cells, depths).as_bytes())?;
    }
    write_atomically(out, "index.html", page::page(plan, cells, &coverage, note).as_bytes())?;
    Ok(json!({ "seeds": plan.seeds, "paper_width": plan.paper_width, "cells": cells, "coverage": coverage }))
}

/// Mean F1 and median focal error of every cell, in words.
fn table(cells: &[Cell]) -> String {
    let mut text = format!(
        "{:<13}{:<19}{:<10}{:<25}{:>6}{:>8}{:>8}{:>10}{:>10}{:>9}\n",
        "sweep", "at", "depths", "method", "seeds", "F1", "min F1", "2D px", "focal %", "seconds"
    );
    let shown =
        |value: Option<f64>, factor: f64| value.map_or_else(|| "-".into(), |value| format!("{:.2}", factor * value));
    for cell in cells {
        text.push_str(&format!(
            "{:<13}{:<19}{:<10}{:<25}{:>6}{:>8.3}{:>8.3}{:>10}{:>10}{:>9.2}\n",
            cell.sweep,
            cell.place,
            cell.depths.name(),
            cell.contestant.name(),
            cell.seeds,
            cell.mean_f1,
            cell.least_f1,
            shown(cell.error_2d_px, 1.0),
            shown(cell.focal_error, 100.0),
            cell.median_seconds
        ));
    }
    text
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    fn parse(arguments: &[&str]) -> Result<Plan, clap::Error> {
        #[derive(clap::Parser)]
        struct Command {
            #[command(flatten)]
            args: Args,
        }
        Command::try_parse_from([&["evaluate"], arguments].concat()).map(|command| command.args.plan())
    }

    #[test]
    fn the_papers_width_and_the_depths_reach_the_plan() {
        let plan = parse(&[]).expect("defaults");
        assert_eq!((plan.paper_width, plan.depths), (SolveSettings::DEFAULT_NETWORK_WIDTH, Depths::ALL.to_vec()));
        let plan = parse(&["--paper-width", "1", "--depths", "epipolar"]).expect("valid");
        assert_eq!((plan.paper_width, plan.depths), (1.0, vec![Depths::Epipolar]));
        for wrong in ["0", "-1", "3", "NaN", "wide"] {
            assert!(parse(&["--paper-width", wrong]).is_err(), "{wrong}");
        }
    }

    #[test]
    fn long_sequences_are_solved_one_after_the_other() {
        assert!(parse(&["--long", "--seeds", "2", "--scenes", "drive"]).is_ok());
        let others: [&[&str]; 4] = [&["--threads", "2"], &["--photographed"], &["--real", "sequences"], &["--quick"]];
        for more in others {
            let error = parse(&[&["--long"], more].concat()).err().unwrap_or_else(|| panic!("{more:?}"));
            assert!(error.to_string().contains("--long"), "{error}");
        }
    }

    #[test]
    fn photographed_scenes_are_a_suite_of_their_own() {
        assert!(parse(&["--photographed", "--seeds", "3", "--scenes", "orbit", "--peer", "peer"]).is_ok());
        assert!(parse(&["--photographed", "--first-seed", "5"]).is_ok());
        assert!(parse(&["--photographed", "--first-seed", &u64::MAX.to_string()]).is_err(), "none would be left");
        assert!(parse(&["--first-seed", "5"]).is_err(), "other suites have seeds of their own");
        for none in ["", ",", ",,"] {
            let error = parse(&["--photographed", "--scenes", none]).err().unwrap_or_else(|| panic!("{none:?}"));
            assert!(error.to_string().contains("names no scene"), "{error}");
        }
        let others: [&[&str]; 5] =
            [&["--observations"], &["--quick"], &["--real", "sequences"], &["--priors"], &["--sweeps", "orbit"]];
        for more in others {
            let error = parse(&[&["--photographed"], more].concat()).err().unwrap_or_else(|| panic!("{more:?}"));
            assert!(error.to_string().contains("--photographed"), "{error}");
        }
    }
}
