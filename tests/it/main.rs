//! Every integration test in one binary, so that everything links once. One concept a module.

mod abuse;
mod access;
mod api;
mod batch;
mod chaos;
mod chart;
mod cli;
mod colmap;
mod crash;
mod dashboards;
mod disk;
mod formats;
mod http;
mod inputs;
mod load;
mod lost;
mod observations;
mod prior;
mod readme;
mod real;
mod replicas;
mod sequence;
mod silence;
mod support;
mod telemetry;
mod upload;
