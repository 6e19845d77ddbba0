//! What tests share: a server on a free port with a store of its own, and stand-ins for the solver.

pub mod certificates;
pub mod collector;
pub mod connections;
pub mod http;
pub mod keys;
pub mod live;
pub mod memory;
pub mod mutation;
pub mod postgres;
pub mod program;
pub mod python;
pub mod scrape;
pub mod server;
pub mod solvers;
pub mod uploads;
pub mod wire;
