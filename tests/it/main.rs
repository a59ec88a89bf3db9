//! The program, one binary: its entry points (scenario, run, command line, log, HTTP) and its
//! documentation.

// A test may print its measurements.
#![allow(clippy::print_stdout)]

mod adaptive;
mod advise;
mod bad_scenarios;
mod bodies_ensemble;
mod bodies_log;
mod bodies_run;
mod bodies_scenes;
mod cases;
mod cli;
mod control;
mod derivatives;
mod ensemble;
mod extreme;
mod failing;
mod faults;
#[cfg(feature = "chart")]
mod fit;
mod http;
mod inputs;
mod gallery;
/// Shared with the tests of the mathematics.
#[allow(dead_code)]
#[path = "../../solve/tests/it/given.rs"]
mod given;
mod log;
mod memory;
mod open;
mod orbit;
mod plan_sees;
#[cfg(feature = "chart")]
mod report;
mod resume;
mod scenarios;
mod stability;
mod start;
mod study;
mod sweep;
mod tools;
mod verify;
mod architecture;
