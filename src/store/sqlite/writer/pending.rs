//! An operation that waits for its turn, until its caller is answered or gives it up.

use std::panic::AssertUnwindSafe;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use futures_util::FutureExt;
use tokio::sync::oneshot;

use super::{LARGE_BYTES, SqliteConnection};
use crate::store::Error;
use crate::store::sql::{Operation, WriteIntent};

/// What the writer takes to begin an operation, or its caller to give it up: whichever comes first.
#[derive(Debug, Default)]
pub(super) struct BeginFlag(AtomicBool);

impl BeginFlag {
    /// `false` where the other one has it.
    pub(super) fn take(&self) -> bool {
        !self.0.swap(true, Ordering::AcqRel)
    }
}

/// An operation that waits for its turn.
pub(super) struct Pending {
    operation: Operation<SqliteConnection, ()>,
    pub(super) intent: WriteIntent,
    begin: Arc<BeginFlag>,
    reply: oneshot::Sender<Result<(), Error>>,
}

impl Pending {
    /// With the flag by which its caller may give it up, and where its answer comes.
    pub(super) fn new(
        intent: WriteIntent,
        operation: Operation<SqliteConnection, ()>,
    ) -> (Self, Arc<BeginFlag>, oneshot::Receiver<Result<(), Error>>) {
        let begin = Arc::new(BeginFlag::default());
        let (reply, answer) = oneshot::channel();
        (Self { operation, intent, begin: begin.clone(), reply }, begin, answer)
    }

    /// Marks it as begun; `false` where its caller is gone, and nobody wants it any more.
    pub(super) fn begins(&self) -> bool {
        self.begin.take() && !self.reply.is_closed()
    }

    /// Whether it is to have a commit of its own.
    pub(super) fn is_large(&self) -> bool {
        self.intent.bytes() > LARGE_BYTES
    }

    /// Runs it within the transaction. It may be run again where the transaction came to nothing.
    pub(super) async fn run(&self, connection: &mut SqliteConnection) -> Result<(), Error> {
        // A defect in one operation must not cost the others their writer, be it in its call or in what it awaits.
        let run = async { (self.operation)(connection).await };
        let outcome = AssertUnwindSafe(run).catch_unwind().await;
        outcome.unwrap_or_else(|_| Err(Error::Corrupt("an operation of the store panicked".into())))
    }

    /// Answers its caller: what it wrote is on the disk, or why nothing was written.
    pub(super) fn answer(self, committed: Result<(), Error>) {
        // A caller that went away does not need to know.
        let _ = self.reply.send(committed);
    }
}

#[cfg(test)]
mod tests {
    use std::thread;

    use super::*;

    #[test]
    fn of_a_writer_and_a_caller_one_has_the_turn() {
        for round in 0..1_000 {
            let (turn, both) = (Arc::new(BeginFlag::default()), Arc::new(std::sync::Barrier::new(2)));
            let begins = thread::spawn({
                let (turn, both) = (turn.clone(), both.clone());
                move || {
                    both.wait();
                    turn.take()
                }
            });
            both.wait();
            let given_up = turn.take();
            assert_ne!(begins.join().expect("no panic"), given_up, "round {round}");
        }
    }
}
