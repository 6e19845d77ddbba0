//! Showing how far a job is: a bar on a terminal, a few plain lines elsewhere. Always on stderr.

use std::cell::Cell;
use std::io::IsTerminal;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

use crate::domain::words::counted;
use crate::domain::{Observer, Progress, ReconstructionProgress, Stage, Step, Task};

/// Steps of the bar: finer than any terminal is wide.
const BAR_STEPS: u64 = 1_000;
/// Plain lines appear at a change of stage, after this share of the work, ...
const LINE_EVERY_SHARE: f64 = 0.1;
/// ... or after this many seconds, ...
const LINE_EVERY_SECONDS: f64 = 0.2;
/// ... but not before this share of the time already spent: short jobs show that they live, hour-long ones fill no log.
const LINE_EVERY_SPENT: f64 = 0.1;

/// How often the bar of an evaluation shows that something still runs.
const TICK: Duration = Duration::from_millis(200);

/// Between two lines of an evaluation: runs of milliseconds fill no log.
const LINE_EVERY: Duration = Duration::from_secs(1);

/// Shows progress; nothing when quiet.
pub struct ProgressView {
    shown: Shown,
}

enum Shown {
    Nothing,
    Bar(ProgressBar),
    Lines { last: Option<Progress> },
}

impl ProgressView {
    /// A bar when stderr is a terminal, lines when it is not, nothing when `quiet`.
    pub fn new(quiet: bool) -> Self {
        let shown = if quiet {
            Shown::Nothing
        } else if std::io::stderr().is_terminal() {
            let bar = ProgressBar::new(BAR_STEPS);
            if let Ok(style) = ProgressStyle::with_template("{prefix:>9} [{bar:24}] {percent:>3}% {wide_msg}") {
                bar.set_style(style.progress_chars("=> "));
            }
            Shown::Bar(bar)
        } else {
            Shown::Lines { last: None }
        };
        Self { shown }
    }

    /// Shows a state that is no progress: `queued`, `connected to ...`.
    pub fn state(&mut self, text: &str) {
        match &self.shown {
            Shown::Nothing => {}
            Shown::Bar(bar) => bar.println(text),
            Shown::Lines { .. } => tell!("{text}"),
        }
    }

    /// Shows progress.
    pub fn show(&mut self, progress: &Progress) {
        match &mut self.shown {
            Shown::Nothing => {}
            Shown::Bar(bar) => {
                bar.set_prefix(progress.stage.name());
                bar.set_position((progress.fraction.clamp(0.0, 1.0) * BAR_STEPS as f64) as u64);
                bar.set_message(describe(progress));
            }
            Shown::Lines { last } => {
                if last.is_none_or(|last| is_line_due(&last, progress)) {
                    *last = Some(*progress);
                    let percent = progress.fraction * 100.0;
                    tell!("{:>9} {percent:3.0}% {}", progress.stage.name(), describe(progress));
                }
            }
        }
    }

    /// Shows one of several pieces of work: a share of the whole that is done now, or one that begins.
    pub fn part(&mut self, done: Option<f64>, text: &str) {
        match &self.shown {
            Shown::Nothing => {}
            Shown::Bar(bar) => {
                if let Some(share) = done {
                    bar.inc((share * BAR_STEPS as f64) as u64);
                    bar.println(text);
                } else {
                    bar.set_message(text.to_owned());
                }
            }
            Shown::Lines { .. } => tell!("{text}"),
        }
    }

    /// Takes the bar away.
    pub fn finish(&mut self) {
        if let Shown::Bar(bar) = &self.shown {
            bar.finish_and_clear();
        }
    }
}

/// Shows how many bytes of a transfer are done.
pub struct TransferView {
    is_shown: bool,
    bar: Mutex<Option<ProgressBar>>,
}

impl TransferView {
    /// A bar when stderr is a terminal, nothing elsewhere: a transfer is short, and its end says that it was done.
    pub fn new(quiet: bool) -> Self {
        Self { is_shown: !quiet && std::io::stderr().is_terminal(), bar: Mutex::default() }
    }

    /// So many bytes of the total are done.
    pub fn show(&self, bytes: u64, total: u64) {
        if self.is_shown && bytes < total {
            self.bar().get_or_insert_with(|| transfer_bar(total)).set_position(bytes);
        } else {
            self.finish();
        }
    }

    /// Takes the bar away.
    pub fn finish(&self) {
        if let Some(bar) = self.bar().take() {
            bar.finish_and_clear();
        }
    }

    fn bar(&self) -> MutexGuard<'_, Option<ProgressBar>> {
        self.bar.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn transfer_bar(total: u64) -> ProgressBar {
    let bar = ProgressBar::new(total);
    if let Ok(style) =
        ProgressStyle::with_template("{bytes:>10} of {total_bytes} [{bar:24}] {percent:>3}% {bytes_per_sec}, {eta}")
    {
        bar.set_style(style.progress_chars("=> "));
    }
    bar
}

impl Drop for TransferView {
    fn drop(&mut self) {
        self.finish();
    }
}

/// Shows how many runs are done: a bar on a terminal; elsewhere a line a second at most, and one for the last run.
pub struct RunsView {
    bar: ProgressBar,
    has_lines: bool,
    last_line: Cell<Option<Instant>>,
}

impl RunsView {
    pub fn new(quiet: bool, total: usize, done: usize) -> Self {
        let has_bar = !quiet && std::io::stderr().is_terminal();
        let bar = if has_bar { ProgressBar::new(total as u64) } else { ProgressBar::hidden() };
        bar.set_length(total as u64);
        if let Ok(style) = ProgressStyle::with_template("[{bar:24}] {pos}/{len} runs, {eta} left  {wide_msg}") {
            bar.set_style(style.progress_chars("=> "));
        }
        bar.set_position(done as u64);
        bar.reset_eta();
        if has_bar {
            bar.enable_steady_tick(TICK);
        }
        Self { bar, has_lines: !quiet && !has_bar, last_line: Cell::new(None) }
    }

    /// Names the run that is shown.
    pub fn show(&self, what: String) {
        self.bar.set_message(what);
    }

    /// One more run is done.
    pub fn finished(&self) {
        self.bar.inc(1);
        let (done, total) = (self.bar.position(), self.bar.length().unwrap_or_default());
        let is_due = done == total || self.last_line.get().is_none_or(|at| at.elapsed() >= LINE_EVERY);
        if self.has_lines && is_due {
            self.last_line.set(Some(Instant::now()));
            let line =
                format!("{done}/{total} runs, {:.0} s  {}", self.bar.elapsed().as_secs_f64(), self.bar.message());
            tell!("{}", line.trim_end());
        }
    }

    /// Takes the bar away.
    pub fn finish(&self) {
        self.bar.finish_and_clear();
    }
}

impl Drop for RunsView {
    fn drop(&mut self) {
        self.finish();
    }
}

impl Drop for ProgressView {
    fn drop(&mut self) {
        self.finish();
    }
}

impl Observer for ProgressView {
    fn progress(&mut self, progress: &Progress) {
        self.show(progress);
    }
}

/// Whether enough has happened since the last line for another.
fn is_line_due(last: &Progress, now: &Progress) -> bool {
    let pause_seconds = LINE_EVERY_SECONDS.max(LINE_EVERY_SPENT * last.elapsed_seconds);
    last.stage != now.stage
        || now.fraction >= last.fraction + LINE_EVERY_SHARE
        || now.elapsed_seconds >= last.elapsed_seconds + pause_seconds
}

/// What a progress record says, in a line.
fn describe(progress: &Progress) -> String {
    let mut text = whereabouts(progress);
    text.push_str(&format!("{} so far", counted(progress.inliers, "inlier")));
    if let Some(focal_px) = progress.focal_px {
        text.push_str(&format!(", focal {focal_px:.1} px"));
    }
    if let Some(cost) = progress.best_cost {
        text.push_str(&format!(", cost {cost:.4}"));
    }
    if let Some(losses) = progress.losses {
        text.push_str(&format!(
            ", iteration {}, L_num {:.2e} L_proj {:.3} L_DAQ {:.3}",
            progress.iteration, losses.num, losses.proj, losses.daq
        ));
    }
    if let Some(head) = progress.head {
        if let Some(phase) = head.phase {
            text.push_str(&format!(", {}", phase.name()));
        }
        text.push_str(&format!(", N {:.1}", head.weight_sum));
        if let Some(tolerance) = head.tolerance {
            text.push_str(&format!(", tau {tolerance:.3}"));
        }
        if let Some(residual) = head.best_daq_residual {
            text.push_str(&format!(", DAQ residual of the best head {residual:.3}"));
        }
    }
    text.push_str(&format!(", {:.1} s", progress.elapsed_seconds));
    text
}

/// Where a solve is, with a comma behind it; nothing where the stage says it all.
fn whereabouts(progress: &Progress) -> String {
    let ReconstructionProgress { block, blocks, part, registered_views, views, step } = progress.reconstruction;
    let of_part = if part > 0 { format!(", part {part}") } else { String::new() };
    match (step, progress.stage) {
        (Some(Step { task: Task::Adjust, step, steps }), _) => format!("adjusting: round {step} of {steps}, "),
        (Some(Step { task: Task::Cameras, step, steps }), _) if steps > 1 => {
            format!("calibrating: {step} of {steps}, ")
        }
        (Some(Step { task: Task::Cameras, .. }), _) => String::new(),
        (Some(Step { task: Task::Windows, step, steps }), _) => format!("comparing: window {step} of {steps}, "),
        (Some(Step { task: Task::Classify, step, steps }), _) => format!("classifying: {step} of {steps} verdicts, "),
        (Some(Step { task: Task::Heads, step, steps }), _) => format!("optimising: head {step} of {steps}, "),
        (None, Stage::Extend) => format!("registering: {registered_views} of {views} views{of_part}, "),
        // Of one block there is nothing to say, unless it is a further part's.
        (None, Stage::Search | Stage::Refine | Stage::Calibrate) if part > 0 => {
            format!("trying a block for part {part}, ")
        }
        (None, Stage::Search | Stage::Refine) if blocks > 1 => format!("block {block} of {blocks}, "),
        _ => String::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{Losses, ReconstructionProgress, Stage};

    fn at(stage: Stage, fraction: f64, elapsed_seconds: f64) -> Progress {
        Progress {
            stage,
            fraction,
            iteration: 0,
            losses: None,
            head: None,
            inliers: 0,
            focal_px: None,
            best_cost: None,
            elapsed_seconds,
            reconstruction: ReconstructionProgress::default(),
        }
    }

    #[test]
    fn lines_are_neither_too_many_nor_too_few() {
        let last = at(Stage::Search, 0.2, 100.0);
        assert!(!is_line_due(&last, &at(Stage::Search, 0.25, 101.0)));
        assert!(is_line_due(&last, &at(Stage::Refine, 0.2, 100.0)));
        assert!(is_line_due(&last, &at(Stage::Search, 0.31, 100.0)));
        assert!(is_line_due(&last, &at(Stage::Search, 0.2, 110.0)));
        assert!(is_line_due(&at(Stage::Search, 0.0, 0.0), &at(Stage::Search, 0.0, 0.5)));
        let mut last = at(Stage::Search, 0.0, 0.0);
        let mut lines = 0;
        for second in 1..=3600 {
            let now = at(Stage::Search, 0.0, f64::from(second));
            if is_line_due(&last, &now) {
                (last, lines) = (now, lines + 1);
            }
        }
        assert!((20..100).contains(&lines), "{lines} lines an hour");
    }

    #[test]
    fn a_line_holds_what_is_known_and_nothing_else() {
        let mut progress = Progress {
            stage: Stage::Search,
            fraction: 0.5,
            iteration: 120,
            losses: None,
            head: None,
            inliers: 19,
            focal_px: None,
            best_cost: None,
            elapsed_seconds: 1.25,
            reconstruction: ReconstructionProgress::default(),
        };
        assert_eq!(describe(&progress), "19 inliers so far, 1.2 s");
        progress.focal_px = Some(1204.26);
        progress.best_cost = Some(0.25);
        progress.losses = Some(Losses { num: 1e-4, proj: 0.5, daq: 2.0 });
        assert_eq!(
            describe(&progress),
            "19 inliers so far, focal 1204.3 px, cost 0.2500, iteration 120, L_num 1.00e-4 L_proj 0.500 \
             L_DAQ 2.000, 1.2 s"
        );
    }

    #[test]
    fn a_line_says_where_a_solve_is() {
        let said = |stage: Stage, reconstruction: ReconstructionProgress| {
            let line = describe(&Progress { reconstruction, ..at(stage, 0.5, 1.25) });
            line.strip_suffix("0 inliers so far, 1.2 s").expect("the rest as ever").to_owned()
        };
        let walk = ReconstructionProgress {
            block: 2,
            blocks: 4,
            registered_views: 120,
            views: 300,
            ..ReconstructionProgress::default()
        };
        assert_eq!(said(Stage::Search, walk), "block 2 of 4, ");
        assert_eq!(said(Stage::Search, ReconstructionProgress { block: 1, blocks: 1, ..walk }), "");
        assert_eq!(said(Stage::Refine, ReconstructionProgress { part: 1, ..walk }), "trying a block for part 1, ");
        assert_eq!(said(Stage::Extend, walk), "registering: 120 of 300 views, ");
        assert_eq!(
            said(Stage::Extend, ReconstructionProgress { part: 1, ..walk }),
            "registering: 120 of 300 views, part 1, "
        );
        let step =
            |task: Task| ReconstructionProgress { part: 1, step: Some(Step { task, step: 3, steps: 7 }), ..walk };
        assert_eq!(said(Stage::Extend, step(Task::Adjust)), "adjusting: round 3 of 7, ");
        assert_eq!(said(Stage::Calibrate, step(Task::Cameras)), "calibrating: 3 of 7, ");
        assert_eq!(said(Stage::Calibrate, step(Task::Windows)), "comparing: window 3 of 7, ");
        assert_eq!(said(Stage::Classify, step(Task::Classify)), "classifying: 3 of 7 verdicts, ");
        assert_eq!(said(Stage::Search, step(Task::Heads)), "optimising: head 3 of 7, ");
        assert_eq!(said(Stage::Calibrate, walk), "");
    }
}
