//! `scpsfm solve --window`: windows of consecutive views, each solved alone, several at a time.

use std::ops::Range;
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc;

use super::exit::{Exit, Failure};
use super::interrupt::Interrupt;
use super::print;
use super::progress::ProgressView;
use crate::domain::{Limits, Silent, SolveSettings, StopReason, StopToken};
use crate::formats::LabelledInput;
use crate::formats::publish::{Draft, pretty};
use crate::formats::windows::{self, Row, Table};
use crate::parallel::Threads;
use crate::solver;

/// Views that a reconstruction needs at least.
const LEAST_VIEWS: i64 = 3;
/// Heading of the flags.
const HEADING: &str = "Windows of views";

/// Windows instead of the whole.
#[derive(Debug, Clone, clap::Args)]
pub struct WindowArgs {
    /// Solve windows of N consecutive views (in the order of their ids or names), each alone, and write windows.csv and
    /// windows.json instead of the other files
    ///
    /// As the paper does with its image sequences, every N views make one input (11 of KITTI, 10 of the others) and no
    /// view is in two; --step 1 less than N lets neighbours share a view. Views at the end that fill no window are left
    /// out. A window has the tracks that two of its views see or more.
    #[arg(long, help_heading = HEADING, value_name = "N", value_parser = clap::value_parser!(u32).range(LEAST_VIEWS..),
        conflicts_with_all = ["server", "export"])]
    pub window: Option<u32>,

    /// Views from the beginning of a window to that of the next [default: N, so that no view is in two windows]
    #[arg(long, help_heading = HEADING, value_name = "VIEWS", value_parser = clap::value_parser!(u32).range(1..), requires = "window")]
    pub step: Option<u32>,
}

/// How to show what comes.
#[derive(Debug, Clone, Copy)]
pub struct Show {
    pub json: bool,
    pub quiet: bool,
}

/// Solves the windows, writes the table and tells it.
pub fn run(
    args: &WindowArgs,
    length: u32,
    threads: Threads,
    input: &LabelledInput,
    settings: &SolveSettings,
    out: &Path,
    show: Show,
) -> Result<Exit, Failure> {
    let (views, length) = (input.raw.views.len(), length as usize);
    let step = args.step.map_or(length, |step| step as usize);
    let ranges = windows::ranges(views, length, step);
    if ranges.is_empty() {
        return Err(Failure::usage(format!("--window {length} is more than the {views} views of the input")));
    }
    let mut progress = ProgressView::new(show.quiet);
    let stop = StopToken::default();
    let interrupt = Interrupt::listen()?;
    let relay = interrupt.stops(&stop);
    let rows = tokio::task::block_in_place(|| {
        let solve = |index: usize| solve(index, &windows::cut(input, &ranges[index]), settings, &stop);
        on_threads(ranges.len(), threads.count(), &stop, &solve, &mut |event| {
            report_progress(&mut progress, event, &ranges, input)
        })
    });
    relay.abort();
    progress.finish();
    let table = Table::new(views, length, step, rows?);
    let json = pretty(&table)?;
    let mut draft = Draft::new(out, Some(&input.path))?;
    draft.add(windows::CSV, table.csv().as_bytes())?;
    draft.publish(windows::JSON, json.as_bytes())?;
    if show.json {
        print(json.trim_end())?;
    } else if !show.quiet {
        print(table.text().trim_end())?;
        print(&format!("  files  {}", out.display()))?;
    }
    Ok(if table.solved > 0 { Exit::Done } else { Exit::NoReconstruction })
}

fn solve(
    index: usize,
    window: &LabelledInput,
    settings: &SolveSettings,
    stop: &StopToken,
) -> Result<Row, solver::Error> {
    // What is wrong with a window alone, such as two views that see nothing, is said in its row.
    let checked = match window.check(&Limits::default()) {
        Ok(checked) => checked,
        Err(error) => return Ok(Row::unsolved(index, window, error.to_string().replace('\n', "; "))),
    };
    let solution = solver::solve(&checked, settings, &mut Silent, stop)?;
    Ok(Row::solved(index, window, &solution))
}

/// What a thread tells.
enum Event {
    Begun(usize),
    Ended(Box<Row>),
}

/// Shows which window is at work, and what came of those that are done.
fn report_progress(progress: &mut ProgressView, event: &Event, ranges: &[Range<usize>], input: &LabelledInput) {
    let count = ranges.len();
    match event {
        Event::Begun(index) => {
            let label = |view: usize| input.view_labels.get(view).map_or_else(String::new, |label| label.shown());
            let range = &ranges[*index];
            let views = format!("views {} to {}", label(range.start), label(range.end - 1));
            progress.part(None, &format!("window {} of {count}: {views}", index + 1));
        }
        Event::Ended(row) => {
            let error = row.reprojection_mean_px.map_or_else(String::new, |px| format!(", {px:.3} px"));
            let seconds = row.seconds.map_or_else(String::new, |seconds| format!(", {seconds:.1} s"));
            let text = format!("window {} of {count}: {}{error}{seconds}", row.window, row.grade);
            progress.part(Some(1.0 / count as f64), &text);
        }
    }
}

/// Solves `count` windows on several threads; the rows are in the order of the windows, whoever solved them.
fn on_threads(
    count: usize,
    threads: usize,
    stop: &StopToken,
    solve: &(dyn Fn(usize) -> Result<Row, solver::Error> + Sync),
    report: &mut dyn FnMut(&Event),
) -> Result<Vec<Row>, Failure> {
    let next = AtomicUsize::new(0);
    let (sender, receiver) = mpsc::channel();
    let mut rows: Vec<Row> = std::thread::scope(|scope| {
        for _ in 0..threads.clamp(1, count) {
            let (sender, next) = (sender.clone(), &next);
            scope.spawn(move || {
                while !stop.is_stopped() {
                    let index = next.fetch_add(1, Ordering::Relaxed);
                    if index >= count || sender.send(Ok(Event::Begun(index))).is_err() {
                        break;
                    }
                    if sender.send(solve(index).map(|row| Event::Ended(Box::new(row)))).is_err() {
                        break;
                    }
                }
            });
        }
        drop(sender);
        let mut rows = Vec::new();
        let mut failure = None;
        for event in receiver {
            match event {
                Ok(event) => {
                    report(&event);
                    if let Event::Ended(row) = event {
                        rows.push(*row);
                    }
                }
                Err(error) => {
                    // Ends the other threads too.
                    stop.stop(StopReason::Cancelled);
                    failure.get_or_insert(error);
                }
            }
        }
        match failure {
            Some(solver::Error::Internal(what)) => Err(Failure::internal(solver::Error::Internal(what))),
            Some(solver::Error::Stopped(_)) => Err(Failure::interrupted()),
            None if rows.len() < count => Err(Failure::interrupted()),
            None => Ok(rows),
        }
    })?;
    rows.sort_by_key(|row| row.window);
    Ok(rows)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::formats::fixture;

    fn rows(threads: usize, solve: &(dyn Fn(usize) -> Result<Row, solver::Error> + Sync)) -> Result<Vec<Row>, Failure> {
        on_threads(9, threads, &StopToken::default(), solve, &mut |_| {})
    }

    #[test]
    fn rows_are_in_order_whatever_the_threads() {
        let (input, _) = fixture::solved();
        let solve = |index: usize| Ok(Row::unsolved(index, &input, index.to_string()));
        let alone = rows(1, &solve).expect("solved");
        assert_eq!(alone.iter().map(|row| row.window).collect::<Vec<_>>(), (1..=9).collect::<Vec<_>>());
        assert_eq!(rows(4, &solve).expect("solved"), alone);
        assert_eq!(rows(100, &solve).expect("solved"), alone);
    }

    #[test]
    fn a_defect_in_one_window_ends_all() {
        let (input, _) = fixture::solved();
        let solve = |index: usize| match index {
            4 => Err(solver::Error::Internal("a defect".into())),
            _ => Ok(Row::unsolved(index, &input, String::new())),
        };
        let failure = rows(2, &solve).expect_err("a defect");
        assert!(failure.exit == Exit::Internal && failure.message.contains("a defect"), "{failure}");
    }
}
