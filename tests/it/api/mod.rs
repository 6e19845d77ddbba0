//! The API over a real connection, with stand-ins for the solver.

mod bad_input;
mod client;
mod discovery;
mod jobs;
mod removal;
mod retry;
mod solve;
mod uploads;
