//! Worker threads: one job at a time through the solver. They compute and nothing else; the store is the business of
//! the task that feeds them.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::thread;
use std::time::SystemTime;

use tokio::sync::{mpsc, oneshot, watch};

use super::Solver;
use super::hub::Subscription;
use super::observe::Attempt;
use crate::domain::job::{EventBody, JobEvent, JobName, Summary};
use crate::domain::{Input, Observer, Progress, Solution, SolveSettings, Stage, StopReason, StopToken};
use crate::solver;
use crate::store::payload;

/// Stack of a worker: the numerics recurse little, but keep small matrices on it; the main thread's usual size.
const STACK_BYTES: usize = 8 << 20;

/// One attempt's worth of work.
pub(super) struct Assignment {
    pub name: JobName,
    pub number: u32,
    /// Encoded input.
    pub input: Vec<u8>,
    pub settings: SolveSettings,
    pub stop: StopToken,
    pub progress: watch::Sender<Option<Progress>>,
    pub subscription: Subscription,
    pub attempt: Attempt,
    pub reply: oneshot::Sender<Report>,
}

/// What an attempt came to.
pub(super) struct Report {
    pub verdict: Verdict,
    pub attempt: Attempt,
}

/// How the solver ended.
#[derive(Debug)]
pub(super) enum Verdict {
    Solved {
        summary: Summary,
        /// Encoded solution.
        result: Vec<u8>,
    },
    Stopped(StopReason),
    /// A defect: the solver's error, a panic, an input that cannot be read.
    Broken(String),
}

/// Feeds one worker thread; the thread ends when it is dropped.
#[derive(Debug)]
pub(super) struct Worker {
    assignments: mpsc::Sender<Assignment>,
}

impl Worker {
    /// Starts a thread. `alive` is dropped when the thread ends.
    ///
    /// # Errors
    /// When the system has no thread to give.
    pub(super) fn start(
        index: usize,
        solver: Solver,
        alive: mpsc::Sender<()>,
    ) -> std::io::Result<(Self, thread::JoinHandle<()>)> {
        let (assignments, mut inbox) = mpsc::channel::<Assignment>(1);
        let handle =
            thread::Builder::new().name(format!("solver-{index}")).stack_size(STACK_BYTES).spawn(move || {
                let _alive = alive;
                while let Some(assignment) = inbox.blocking_recv() {
                    work(assignment, &solver);
                }
            })?;
        Ok((Self { assignments }, handle))
    }

    /// Hands over work; the report comes through the assignment's `reply`, which is dropped if the thread is gone.
    pub(super) async fn assign(&self, assignment: Assignment) {
        // A send that fails drops the assignment and its reply, which is the answer.
        let _ = self.assignments.send(assignment).await;
    }

    /// Whether the thread has ended: nothing in it should be able to.
    pub(super) fn is_gone(&self) -> bool {
        self.assignments.is_closed()
    }
}

fn work(assignment: Assignment, solver: &Solver) {
    let Assignment { name, number, input, settings, stop, progress, subscription, attempt, reply } = assignment;
    let span = attempt.span().clone();
    let _entered = span.enter();
    let mut reporter = Reporter { name, number, progress, subscription, attempt };
    let verdict = catch_unwind(AssertUnwindSafe(|| solve(input, &settings, &mut reporter, &stop, solver)))
        .unwrap_or_else(|panic| Verdict::Broken(format!("the solver panicked: {}", panic_message(panic.as_ref()))));
    // Nobody listens any more when the engine went down with its runtime; the store then tells the next start.
    let _ = reply.send(Report { verdict, attempt: reporter.attempt });
}

fn solve(
    input: Vec<u8>,
    settings: &SolveSettings,
    reporter: &mut Reporter,
    stop: &StopToken,
    solver: &Solver,
) -> Verdict {
    let decoded: Input = match payload::decode(&input, "the job's input") {
        Ok(decoded) => decoded,
        Err(error) => return Verdict::Broken(error.to_string()),
    };
    drop(input);
    match solver(&decoded, settings, reporter, stop) {
        Ok(solution) => match payload::encode(&solution) {
            Ok(result) => Verdict::Solved { summary: summarise(&solution, result.len() as u64), result },
            Err(error) => Verdict::Broken(error.to_string()),
        },
        Err(solver::Error::Stopped(reason)) => Verdict::Stopped(reason),
        Err(solver::Error::Internal(message)) => Verdict::Broken(message),
    }
}

fn summarise(solution: &Solution, result_bytes: u64) -> Summary {
    let calibration = solution.calibrations.first();
    let count = |number: usize| u32::try_from(number).unwrap_or(u32::MAX);
    Summary {
        status: solution.status,
        grade: solution.grade,
        focal_px: calibration.map(|calibration| calibration.focal_px),
        sigma_log_focal: calibration.and_then(|calibration| calibration.sigma_log_focal),
        inlier_tracks: count(solution.inlier_track_count()),
        registered_views: count(solution.registered_views().len()),
        reprojection_rms_px: solution.reprojection_rms_px,
        winning_prior: solution.winning_prior,
        iterations: solution.iterations,
        seconds: solution.seconds,
        result_bytes,
        warnings: Summary::warnings_of(&solution.warnings),
    }
}

fn panic_message(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<&str>().copied();
    text.or_else(|| panic.downcast_ref::<String>().map(String::as_str)).unwrap_or("no message")
}

/// Passes on what the solver tells: the latest progress to the task that stores it, weights to whoever watches.
struct Reporter {
    name: JobName,
    number: u32,
    progress: watch::Sender<Option<Progress>>,
    subscription: Subscription,
    attempt: Attempt,
}

impl Observer for Reporter {
    fn stage(&mut self, stage: Stage) {
        self.attempt.stage(stage);
    }

    fn progress(&mut self, progress: &Progress) {
        self.progress.send_replace(Some(*progress));
    }

    fn weights(&mut self, iteration: u32, weights: &[f32]) {
        let topic = self.subscription.topic();
        if topic.weights.receiver_count() == 0 {
            return;
        }
        topic.weights.send_replace(Some(Arc::new(JobEvent {
            name: self.name.clone(),
            attempt: self.number,
            sequence: None,
            time: SystemTime::now(),
            body: EventBody::Weights { iteration, weights: weights.to_vec() },
        })));
    }
}
