//! A worker without a thread: what its thread does, step by step. A part of `engine/worker.rs`, whose fields it sees.

use super::*;

impl Worker {
    /// Feeds who reads from the inbox.
    pub(in crate::engine) fn with_inbox() -> (Self, mpsc::Receiver<Assigned>) {
        let (assignments, inbox) = mpsc::channel(1);
        (Self { assignments }, inbox)
    }
}

impl Assigned {
    pub(in crate::engine) fn settings(&self) -> &SolveSettings {
        &self.assignment.settings
    }

    /// Begins with it; `None` where nobody wants it any more.
    pub(in crate::engine) fn begin(self) -> Option<Simulated> {
        let Opened { reporter, stop, reply, .. } = self.open()?;
        Some(Simulated { reporter, stop, reply })
    }
}

/// An attempt whose work has begun.
pub(in crate::engine) struct Simulated {
    reporter: Reporter,
    stop: StopToken,
    reply: oneshot::Sender<(AttemptOutcome, Attempt)>,
}

impl Simulated {
    pub(in crate::engine) fn name(&self) -> &JobName {
        &self.reporter.name
    }

    pub(in crate::engine) fn is_stopped(&self) -> bool {
        self.stop.reason().is_some()
    }

    pub(in crate::engine) fn report(&mut self, progress: &Progress) {
        self.reporter.progress(progress);
    }

    /// Ends with a solution, unless it was stopped.
    pub(in crate::engine) fn succeed(self, solution: &Solution, result: Vec<u8>) {
        let result = EncodedResult::new(result);
        let summary = summarise(solution, result.bytes.len() as u64);
        self.end(Some(Outcome::Succeeded { summary, result }));
    }

    /// Ends with a defect, unless it was stopped.
    pub(in crate::engine) fn fail(self) {
        self.end(failed("told to fail"));
    }

    fn end(self, end: AttemptOutcome) {
        let end = self.stop.reason().map_or(end, stopped);
        // Nobody listens any more where the engine went down.
        let _ = self.reply.send((end, self.reporter.attempt));
    }
}
