//! Worker threads: one job at a time through the solver, and the next one that was handed over as soon as it is done.
//! The store is the business of the task that feeds them.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::thread;
use std::time::SystemTime;

use tokio::sync::{mpsc, oneshot, watch};
use tokio::time::Instant;
use tracing::Span;

use super::notifier::Subscription;
use super::observe::Attempt;
use super::{ResultEncoder, Solver};
use crate::domain::job::{EventBody, Failure, JobEvent, JobName, Summary};
use crate::domain::{Input, Observer, Progress, Solution, SolveSettings, Stage, StopReason, StopToken};
use crate::solver;
use crate::store::{EncodedResult, Outcome, payload};

/// Stack of a worker: the numerics recurse little, but keep small matrices on it; the main thread's usual size.
const STACK_BYTES: usize = 8 << 20;

/// `Failure::reason` of a defect of ours.
const INTERNAL: &str = "INTERNAL";

/// One attempt's worth of work.
pub(super) struct Assignment {
    pub name: JobName,
    pub number: u32,
    pub trace_parent: Option<String>,
    /// Of a job that is begun; that of a prefetched one begins with the work.
    pub attempt: Option<Attempt>,
    /// Encoded input.
    pub input: Vec<u8>,
    pub settings: SolveSettings,
    /// Stopped before it is begun, it is not begun.
    pub stop: StopToken,
    pub subscription: Subscription,
}

/// The worker began.
pub(super) struct Started {
    /// The attempt's.
    pub span: Span,
    pub at: Instant,
}

/// What is heard of an attempt in a worker's hands. Dropped before the work is begun, it is not begun.
pub(super) struct AttemptHandle {
    /// Dropped unanswered where the work is not begun.
    pub started: oneshot::Receiver<Started>,
    pub progress: watch::Receiver<Option<Progress>>,
    /// Dropped unanswered where the thread is gone, or a prefetched job was not begun.
    pub report: oneshot::Receiver<(AttemptOutcome, Attempt)>,
}

/// An assignment on its way to the thread, with where it answers.
pub(super) struct Assigned {
    assignment: Assignment,
    started: oneshot::Sender<Started>,
    progress: watch::Sender<Option<Progress>>,
    reply: oneshot::Sender<(AttemptOutcome, Attempt)>,
}

/// What an attempt came to; `None`: it was interrupted, and its job goes back to the queue.
pub(super) type AttemptOutcome = Option<Outcome>;

/// Of an attempt that was told to stop.
pub(super) fn stopped(reason: StopReason) -> AttemptOutcome {
    match reason {
        StopReason::Cancelled => Some(Outcome::Cancelled),
        StopReason::DeadlineExceeded => Some(Outcome::DeadlineExceeded),
        StopReason::Interrupted => None,
    }
}

/// Of a defect: the solver's error, a panic, an input that cannot be read.
pub(super) fn failed(message: impl Into<String>) -> AttemptOutcome {
    Some(Outcome::Failed(Failure::new(INTERNAL, message)))
}

/// Feeds one worker thread; the thread ends when the last of its feeders is dropped.
#[derive(Debug, Clone)]
pub(super) struct Worker {
    assignments: mpsc::Sender<Assigned>,
}

impl Worker {
    /// Starts a thread. `alive` is dropped once the thread has dropped its solver.
    ///
    /// # Errors
    /// When the system has no thread to give.
    pub(super) fn start(
        index: usize,
        solver: Solver,
        encode: ResultEncoder,
        alive: mpsc::Sender<()>,
    ) -> std::io::Result<Self> {
        let (assignments, inbox) = mpsc::channel::<Assigned>(1);
        thread::Builder::new().name(format!("solver-{index}")).stack_size(STACK_BYTES).spawn(move || {
            // Dropped in reverse order.
            let _alive = alive;
            let (solver, mut inbox) = (solver, inbox);
            while let Some(assigned) = inbox.blocking_recv() {
                work(assigned, &solver, encode);
            }
        })?;
        Ok(Self { assignments })
    }

    /// Hands over work, which is begun once what was handed over before is done; waits where that is not begun either.
    pub(super) async fn assign(&self, assignment: Assignment) -> AttemptHandle {
        let (started, heard_started) = oneshot::channel();
        let (progress, heard_progress) = watch::channel(None);
        let (reply, report) = oneshot::channel();
        // A send that fails drops the assignment and its reply, which is the answer.
        let _ = self.assignments.send(Assigned { assignment, started, progress, reply }).await;
        AttemptHandle { started: heard_started, progress: heard_progress, report }
    }

    /// Whether the thread has ended: nothing in it should be able to.
    pub(super) fn is_gone(&self) -> bool {
        self.assignments.is_closed()
    }
}

/// An attempt whose work begins.
struct Opened {
    input: Vec<u8>,
    settings: SolveSettings,
    stop: StopToken,
    reporter: Reporter,
    reply: oneshot::Sender<(AttemptOutcome, Attempt)>,
}

impl Assigned {
    /// Begins with the work; `None` where it was stopped before, or nobody wants it any more.
    fn open(self) -> Option<Opened> {
        let Self { assignment, started, progress, reply } = self;
        let Assignment { name, number, trace_parent, attempt, input, settings, stop, subscription } = assignment;
        if let Some(reason) = stop.reason() {
            if let Some(attempt) = attempt {
                // As below, nobody may be listening.
                let _ = reply.send((stopped(reason), attempt));
            }
            return None;
        }
        let attempt = attempt.unwrap_or_else(|| Attempt::begin(&name, number, trace_parent.as_deref()));
        started.send(Started { span: attempt.span().clone(), at: Instant::now() }).ok()?;
        let reporter = Reporter { name, number, progress, subscription, attempt };
        Some(Opened { input, settings, stop, reporter, reply })
    }
}

fn work(assigned: Assigned, solver: &Solver, encode: ResultEncoder) {
    let Some(Opened { input, settings, stop, mut reporter, reply }) = assigned.open() else { return };
    reporter.attempt.at_work();
    let span = reporter.attempt.span().clone();
    let _entered = span.enter();
    let end = catch_unwind(AssertUnwindSafe(|| solve(input, &settings, &mut reporter, &stop, solver, encode)))
        .unwrap_or_else(|panic| failed(format!("the solver panicked: {}", panic_message(panic.as_ref()))));
    reporter.attempt.at_rest();
    // Nobody listens any more when the engine went down with its runtime; the store then tells the next start.
    let _ = reply.send((end, reporter.attempt));
}

fn solve(
    input: Vec<u8>,
    settings: &SolveSettings,
    reporter: &mut Reporter,
    stop: &StopToken,
    solver: &Solver,
    encode: ResultEncoder,
) -> AttemptOutcome {
    let decoded: Input = match payload::decode(&input, "the job's input") {
        Ok(decoded) => decoded,
        Err(error) => return failed(error.to_string()),
    };
    drop(input);
    match solver(&decoded, settings, reporter, stop) {
        Ok(solution) => {
            let result = EncodedResult::new(encode(&reporter.name, &solution));
            Some(Outcome::Succeeded { summary: summarise(&solution, result.bytes.len() as u64), result })
        }
        Err(solver::Error::Stopped(reason)) => stopped(reason),
        Err(solver::Error::Internal(message)) => failed(message),
    }
}

fn summarise(solution: &Solution, result_size_bytes: u64) -> Summary {
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
        winning_proposal: solution.winning_proposal,
        iterations: solution.iterations,
        seconds: solution.seconds,
        result_size_bytes,
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
        let channel = self.subscription.channel();
        if channel.weights.receiver_count() == 0 {
            return;
        }
        channel.weights.send_replace(Some(Arc::new(JobEvent {
            job: self.name.clone(),
            attempt: self.number,
            sequence: None,
            time: SystemTime::now(),
            body: EventBody::Weights { iteration, weights: weights.to_vec() },
        })));
    }
}

#[cfg(test)]
#[path = "tests/simulation/worker.rs"]
mod simulated;
