//! The integration tests, one binary: laws and verification of the mathematics, then the doors of the
//! program (scenario, run, command line, log, HTTP).

// A test may say what it measured.
#![allow(clippy::print_stdout)]

mod advise;
mod bad_scenarios;
mod cli;
mod ensemble;
mod extreme;
mod failing;
mod faults;
mod http;
mod forms;
mod gallery;
mod growth;
mod lanes;
mod laws;
mod log;
mod methods;
mod plan_sees;
mod resume;
mod scenarios;
mod stability;
mod study;
mod verification;
mod verify;
mod architecture;
mod vrkmk;
