//! The memory of calls: what their messages, inputs and results take is counted against one budget, whoever calls, and
//! a call that would go beyond it is refused at once. What a job takes later, in the store and in the solver, is
//! bounded there.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tonic::Status;

use super::status;
use crate::telemetry::metrics::{Refusal, inflight_bytes, inflight_capacity, refused};

/// How often an input is in memory while it is checked and stored: as it came, sorted, and encoded. A result likewise
/// while it is read: in the chunks of the store, whole, and in the transport's buffer.
pub const WORKING_COPIES: u64 = 3;

/// The bytes that all calls of a server may hold together.
#[derive(Debug)]
pub struct Budget {
    max_bytes: u64,
    used_bytes: Mutex<u64>,
}

impl Budget {
    pub fn new(max_bytes: u64) -> Arc<Self> {
        inflight_capacity(max_bytes);
        Arc::new(Self { max_bytes, used_bytes: Mutex::new(0) })
    }

    /// Takes `after` bytes in place of `before`, both of one call, if they fit. Fewer always do.
    fn exchange(&self, before: u64, after: u64) -> bool {
        let mut used = locked(&self.used_bytes);
        let others = used.saturating_sub(before);
        if after > before && others.saturating_add(after) > self.max_bytes {
            return false;
        }
        *used = others + after;
        inflight_bytes(*used);
        true
    }
}

/// Locks a number that is whole at every moment: a panic elsewhere under the lock leaves nothing half done.
fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// What one call holds. Dropped with the last clone, which travels with whatever holds the bytes.
#[derive(Debug, Clone)]
pub struct Permit {
    shared: Arc<Shared>,
}

#[derive(Debug)]
struct Shared {
    budget: Arc<Budget>,
    charge: Mutex<Charge>,
}

/// The bytes of one call.
#[derive(Debug, Clone, Copy, Default)]
struct Charge {
    /// Of the message that is on its way in: as it came, decompressed and decoded.
    message: u64,
    /// Of the largest message so far: tonic keeps its buffer for the next one.
    largest_message: u64,
    /// Of everything else, as the call says.
    held: u64,
}

impl Charge {
    fn bytes(self) -> u64 {
        self.largest_message.saturating_add(self.held)
    }
}

impl Permit {
    pub fn new(budget: Arc<Budget>) -> Self {
        Self { shared: Arc::new(Shared { budget, charge: Mutex::default() }) }
    }

    /// The permit of a call that came through the [`CallLayer`](super::call::CallLayer).
    ///
    /// # Errors
    /// `INTERNAL` for one that did not: a service outside of the layer would be bounded by nothing.
    pub fn of<T>(request: &tonic::Request<T>) -> Result<Self, Status> {
        let found = request.extensions().get().cloned();
        found.ok_or_else(|| status::internal(&"a request reached a service without a permit for its bytes"))
    }

    /// The call holds so many bytes from here on, apart from its messages. More than the whole budget counts as the
    /// whole: such a call is served when no other holds anything.
    ///
    /// # Errors
    /// `RESOURCE_EXHAUSTED`, reason `MEMORY`, where they do not fit; the call holds what it held before.
    pub fn hold(&self, bytes: u64) -> Result<(), Status> {
        self.change(|charge| charge.held = bytes)
    }

    /// Whether the whole budget is as much.
    pub fn could_hold(&self, bytes: u64) -> bool {
        bytes <= self.shared.budget.max_bytes
    }

    /// The call holds so many bytes more.
    ///
    /// # Errors
    /// As [`Permit::hold`].
    pub fn hold_more(&self, bytes: u64) -> Result<(), Status> {
        self.change(|charge| charge.held = charge.held.saturating_add(bytes))
    }

    /// A message was taken, and the next one begins.
    pub fn next_message(&self) {
        locked(&self.shared.charge).message = 0;
    }

    /// A message takes so many bytes more.
    ///
    /// # Errors
    /// As [`Permit::hold`].
    pub fn receive(&self, bytes: u64) -> Result<(), Status> {
        self.change(|charge| {
            charge.message = charge.message.saturating_add(bytes);
            charge.largest_message = charge.largest_message.max(charge.message);
        })
    }

    fn change(&self, change: impl FnOnce(&mut Charge)) -> Result<(), Status> {
        let Shared { budget, charge } = &*self.shared;
        let mut charge = locked(charge);
        let mut changed = *charge;
        change(&mut changed);
        let bytes = |charge: Charge| charge.bytes().min(budget.max_bytes);
        if !budget.exchange(bytes(*charge), bytes(changed)) {
            refused(Refusal::Memory);
            return Err(status::memory_full(budget.max_bytes));
        }
        *charge = changed;
        Ok(())
    }
}

impl Drop for Shared {
    fn drop(&mut self) {
        let charge = self.charge.get_mut().unwrap_or_else(PoisonError::into_inner);
        self.budget.exchange(charge.bytes().min(self.budget.max_bytes), 0);
    }
}

#[cfg(test)]
mod tests {
    use tonic_types::StatusExt;

    use super::*;

    impl Budget {
        pub(crate) fn used(&self) -> u64 {
            *locked(&self.used_bytes)
        }
    }

    #[test]
    fn what_does_not_fit_is_refused_and_everything_is_given_back() {
        let budget = Budget::new(100);
        let (first, second) = (Permit::new(Arc::clone(&budget)), Permit::new(Arc::clone(&budget)));
        first.hold(60).expect("fits");
        second.receive(40).expect("fits");
        let status = second.receive(1).expect_err("101 bytes");
        assert_eq!(status.code(), tonic::Code::ResourceExhausted);
        assert_eq!(status.get_details_error_info().expect("an ErrorInfo").reason, "MEMORY");
        assert!(status.get_details_retry_info().is_some_and(|retry| retry.retry_delay.is_some()));
        assert_eq!(budget.used(), 100, "nothing changed");
        first.hold(20).expect("less always fits");
        let clone = first.clone();
        drop(first);
        assert_eq!(budget.used(), 60, "a clone holds it");
        drop((clone, second));
        assert_eq!(budget.used(), 0);
    }

    #[test]
    fn a_stream_is_charged_its_largest_message_and_what_it_holds() {
        let budget = Budget::new(100);
        let permit = Permit::new(Arc::clone(&budget));
        for (message, held) in [(10, 10), (20, 20), (5, 5)] {
            permit.receive(message).expect("fits");
            permit.next_message();
            permit.hold_more(held).expect("fits");
        }
        assert_eq!(budget.used(), 55);
    }

    #[test]
    fn more_than_the_budget_is_served_alone() {
        let budget = Budget::new(100);
        let (large, other) = (Permit::new(Arc::clone(&budget)), Permit::new(Arc::clone(&budget)));
        other.hold(1).expect("fits");
        assert!(large.hold(1_000).is_err());
        drop(other);
        large.hold(1_000).expect("alone");
        assert_eq!(budget.used(), 100);
        large.hold(40).expect("less always fits");
        assert_eq!(budget.used(), 40);
    }
}
