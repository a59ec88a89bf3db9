//! The mathematics, one binary: laws of the group and the step, every method in one table, and references.

// A test may say what it measured.
#![allow(clippy::print_stdout)]

mod adaptive;
mod bodies;
mod bodies_adaptive;
mod control;
mod counts;
mod driven;
mod encounters;
mod examples;
mod forms;
mod given;
mod growth;
mod knots;
mod lanes;
mod laws;
mod literal;
mod methods;
mod open;
mod pointing;
mod published;
mod tangent;
mod verification;
mod vrkmk;
