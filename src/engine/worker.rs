//! Worker threads: one job at a time through the solver, and the next one that was handed over as soon as it is done.
//! The store is the business of the task that feeds them.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Weak};
use std::thread;
use std::time::SystemTime;

use tokio::sync::{mpsc, oneshot, watch};
use tokio::time::Instant;
use tracing::Span;

use super::ahead::Reserved;
use super::hub::Subscription;
use super::observe::Attempt;
use super::{ResultEncoder, Solver};
use crate::domain::job::{EventBody, Job, JobEvent, JobName, Summary};
use crate::domain::{Input, Observer, Progress, Solution, SolveSettings, Stage, StopReason, StopToken};
use crate::solver;
use crate::store::{EncodedResult, payload};

/// Stack of a worker: the numerics recurse little, but keep small matrices on it; the main thread's usual size.
const STACK_BYTES: usize = 8 << 20;

/// One attempt's worth of work.
pub(super) struct Assignment {
    name: JobName,
    number: u32,
    opening: Opening,
    /// Encoded input.
    input: Vec<u8>,
    settings: SolveSettings,
    stop: StopToken,
    progress: watch::Sender<Option<Progress>>,
    subscription: Subscription,
    reply: oneshot::Sender<Report>,
}

/// How an attempt is begun.
pub(super) enum Opening {
    /// It is, and its job is leased.
    Begun(Attempt),
    /// Once the worker is free, if the job is still to be had: the one who assigned it is told, and is to lease it
    /// then.
    Foreseen { reserved: Weak<Reserved>, trace_parent: Option<String>, tell: oneshot::Sender<Began> },
}

/// That a worker began with a job that was foreseen.
pub(super) struct Began {
    /// The attempt's.
    pub span: Span,
    pub at: Instant,
    pub time: SystemTime,
}

/// What the one who assigned an attempt hears of it.
pub(super) struct Heard {
    pub progress: watch::Receiver<Option<Progress>>,
    /// Dropped unanswered where the thread is gone, or the attempt was never begun.
    pub report: oneshot::Receiver<Report>,
}

impl Assignment {
    /// Of this attempt at a job; `stop` ends it early.
    pub(super) fn new(
        job: &Job,
        number: u32,
        opening: Opening,
        input: Vec<u8>,
        stop: StopToken,
        subscription: Subscription,
    ) -> (Self, Heard) {
        let (progress, heard_progress) = watch::channel(None);
        let (reply, report) = oneshot::channel();
        let (name, settings) = (job.name.clone(), job.settings.clone());
        let assignment = Self { name, number, opening, input, settings, stop, progress, subscription, reply };
        (assignment, Heard { progress: heard_progress, report })
    }
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
        result: EncodedResult,
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
        encode: ResultEncoder,
        alive: mpsc::Sender<()>,
    ) -> std::io::Result<(Self, thread::JoinHandle<()>)> {
        let (assignments, mut inbox) = mpsc::channel::<Assignment>(1);
        let handle =
            thread::Builder::new().name(format!("solver-{index}")).stack_size(STACK_BYTES).spawn(move || {
                let _alive = alive;
                while let Some(assignment) = inbox.blocking_recv() {
                    work(assignment, &solver, encode);
                }
            })?;
        Ok((Self { assignments }, handle))
    }

    /// Feeds who reads from the inbox.
    #[cfg(test)]
    pub(super) fn with_inbox() -> (Self, mpsc::Receiver<Assignment>) {
        let (assignments, inbox) = mpsc::channel(1);
        (Self { assignments }, inbox)
    }

    /// Hands over work, which is begun once what was handed over before is done; waits where that is not begun either.
    pub(super) async fn assign(&self, assignment: Assignment) {
        // A send that fails drops the assignment and its reply, which is the answer.
        let _ = self.assignments.send(assignment).await;
    }

    /// Whether the thread has ended: nothing in it should be able to.
    pub(super) fn is_gone(&self) -> bool {
        self.assignments.is_closed()
    }
}

impl Opening {
    /// The attempt that begins now; `None` where nobody wants it any more.
    fn open(self, name: &JobName, number: u32) -> Option<Attempt> {
        match self {
            Self::Begun(attempt) => Some(attempt),
            Self::Foreseen { reserved, trace_parent, tell } => {
                if !reserved.upgrade().is_some_and(|reserved| reserved.holds()) {
                    return None;
                }
                let attempt = Attempt::begin(name, number, trace_parent.as_deref());
                let began = Began { span: attempt.span().clone(), at: Instant::now(), time: SystemTime::now() };
                tell.send(began).is_ok().then_some(attempt)
            }
        }
    }
}

fn work(assignment: Assignment, solver: &Solver, encode: ResultEncoder) {
    let Assignment { name, number, opening, input, settings, stop, progress, subscription, reply } = assignment;
    let Some(mut attempt) = opening.open(&name, number) else { return };
    attempt.at_work();
    let span = attempt.span().clone();
    let _entered = span.enter();
    let mut reporter = Reporter { name, number, progress, subscription, attempt };
    let verdict = catch_unwind(AssertUnwindSafe(|| solve(input, &settings, &mut reporter, &stop, solver, encode)))
        .unwrap_or_else(|panic| Verdict::Broken(format!("the solver panicked: {}", panic_message(panic.as_ref()))));
    reporter.attempt.at_rest();
    // Nobody listens any more when the engine went down with its runtime; the store then tells the next start.
    let _ = reply.send(Report { verdict, attempt: reporter.attempt });
}

fn solve(
    input: Vec<u8>,
    settings: &SolveSettings,
    reporter: &mut Reporter,
    stop: &StopToken,
    solver: &Solver,
    encode: ResultEncoder,
) -> Verdict {
    let decoded: Input = match payload::decode(&input, "the job's input") {
        Ok(decoded) => decoded,
        Err(error) => return Verdict::Broken(error.to_string()),
    };
    drop(input);
    match solver(&decoded, settings, reporter, stop) {
        Ok(solution) => {
            let result = EncodedResult::new(encode(&reporter.name, &solution));
            Verdict::Solved { summary: summarise(&solution, result.bytes.len() as u64), result }
        }
        Err(solver::Error::Stopped(reason)) => Verdict::Stopped(reason),
        Err(solver::Error::Internal(message)) => Verdict::Broken(message),
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
        let topic = self.subscription.topic();
        if topic.weights.receiver_count() == 0 {
            return;
        }
        topic.weights.send_replace(Some(Arc::new(JobEvent {
            job: self.name.clone(),
            attempt: self.number,
            sequence: None,
            time: SystemTime::now(),
            body: EventBody::Weights { iteration, weights: weights.to_vec() },
        })));
    }
}

/// What a worker's thread does, step by step.
#[cfg(test)]
pub(super) struct Simulated {
    reporter: Reporter,
    stop: StopToken,
    reply: oneshot::Sender<Report>,
}

#[cfg(test)]
impl Assignment {
    pub(super) fn settings(&self) -> &SolveSettings {
        &self.settings
    }

    /// Begins with it; `None` where nobody wants it any more.
    pub(super) fn begin(self) -> Option<Simulated> {
        let Self { name, number, opening, stop, progress, subscription, reply, .. } = self;
        let attempt = opening.open(&name, number)?;
        Some(Simulated { reporter: Reporter { name, number, progress, subscription, attempt }, stop, reply })
    }
}

#[cfg(test)]
impl Simulated {
    pub(super) fn name(&self) -> &JobName {
        &self.reporter.name
    }

    pub(super) fn is_stopped(&self) -> bool {
        self.stop.reason().is_some()
    }

    pub(super) fn report(&mut self, progress: &Progress) {
        self.reporter.progress(progress);
    }

    /// Ends with a solution, unless it was stopped.
    pub(super) fn succeed(self, solution: &Solution, result: Vec<u8>) {
        let result = EncodedResult::new(result);
        let summary = summarise(solution, result.bytes.len() as u64);
        self.end(Verdict::Solved { summary, result });
    }

    /// Ends with a defect, unless it was stopped.
    pub(super) fn fail(self) {
        self.end(Verdict::Broken("told to fail".into()));
    }

    fn end(self, verdict: Verdict) {
        let verdict = self.stop.reason().map_or(verdict, Verdict::Stopped);
        // Nobody listens any more where the engine went down.
        let _ = self.reply.send(Report { verdict, attempt: self.reporter.attempt });
    }
}
