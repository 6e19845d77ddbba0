//! Many clients, jobs and watchers at once, and what the service costs beside the solve.

mod clients;
mod throughput;
mod watchers;
