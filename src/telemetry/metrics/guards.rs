//! What is counted or timed until it ends, whatever way its scope is left.

use std::time::Instant;

use metrics::{counter, gauge, histogram};

use super::catalogue::{RPC_DURATION, RPC_IN_FLIGHT, RPC_REQUESTS, STORE_DURATION};

/// Holds a gauge higher for as long as it lives, whatever way its scope is left.
#[must_use = "the gauge falls when this is dropped"]
#[derive(Debug)]
pub struct Held(metrics::Gauge, f64);

impl Held {
    /// By one.
    pub(super) fn new(gauge: metrics::Gauge) -> Self {
        Self::by(gauge, 1.0)
    }

    pub(super) fn by(gauge: metrics::Gauge, amount: f64) -> Self {
        gauge.increment(amount);
        Self(gauge, amount)
    }
}

impl Drop for Held {
    fn drop(&mut self) {
        self.0.decrement(self.1);
    }
}

/// A gRPC call that has begun. Dropping it without a code counts it as `CANCELLED`: the client went away.
#[must_use = "the call ends when this is dropped"]
pub struct RpcCall {
    pub method: &'static str,
    pub begun: Instant,
    /// The code that it ends with.
    pub code: &'static str,
    _in_flight: Held,
}

impl RpcCall {
    /// A call begins. `method` is `package.Service/Method`, taken from a list that this server knows: the path that
    /// a client sent would let it create series without end.
    pub fn begin(method: &'static str) -> Self {
        Self { method, begun: Instant::now(), code: "CANCELLED", _in_flight: Held::new(gauge!(RPC_IN_FLIGHT.name)) }
    }

    /// The call ended with this status code (`OK`, `NOT_FOUND`, ...).
    pub fn finish(mut self, code: &'static str) {
        self.code = code;
    }
}

impl Drop for RpcCall {
    fn drop(&mut self) {
        let seconds = self.begun.elapsed().as_secs_f64();
        counter!(RPC_REQUESTS.name, "method" => self.method, "code" => self.code).increment(1);
        histogram!(RPC_DURATION.name, "method" => self.method, "code" => self.code).record(seconds);
    }
}

/// Times a store operation from its creation to its drop.
#[must_use = "the operation ends when this is dropped"]
pub struct StoreTimer {
    operation: &'static str,
    begun: Instant,
}

impl StoreTimer {
    pub(super) fn begin(operation: &'static str) -> Self {
        Self { operation, begun: Instant::now() }
    }
}

impl Drop for StoreTimer {
    fn drop(&mut self) {
        histogram!(STORE_DURATION.name, "operation" => self.operation).record(self.begun.elapsed().as_secs_f64());
    }
}
