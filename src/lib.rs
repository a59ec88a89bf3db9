//! `vpd` simulates rotating bodies on SO(n) with variational polar decomposition integrators and writes
//! MCAP logs.
//!
//! The modules stand in the order in which data flows:
//!
//! ```text
//! scenario.json → Scenario → Plan → RigidBody + Vpd → Sample → LogWriter → log.mcap → chart.svg
//! POST /jobs → store (durable) → engine → worker thread → run → store (finished log) → GET /jobs/{id}/log.mcap
//! ```
//!
//! A scenario is run to a log, and the log is read:
//!
//! ```
//! use vpd::advise;
//! use vpd::log::reader::{Message, read_samples};
//! use vpd::run::{Control, JobContext, Outcome, execute};
//! use vpd::scenario::{Entry, Framed, Inertia, Scenario, Scene};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! // A scenario as JSON: Scenario::from_json(text).
//! let mut scene = Scene::free(Inertia::Principal([1.0, 2.0, 3.0]));
//! let momentum = [0.01, 2.0, 0.01].map(Entry::Number).to_vec();
//! scene.initial.momentum = Some(Framed::Body(momentum));
//! let scenario = Scenario::of("free-body", scene, 0.01, 1000)?;
//! let folder = tempfile::tempdir()?;
//! let log = folder.path().join("free-body.mcap");
//! // Method and step are as given, or chosen for an accuracy.
//! let plan = advise::plan(&scenario)?;
//! let summary = execute(&plan, &JobContext { log: &log, control: &Control::default() })?;
//! assert_eq!(summary.outcome, Outcome::Succeeded);
//!
//! let mut largest = 0.0_f64;
//! read_samples(&log, |_time_ns, message| {
//!     if let Message::Energy(energy) = message {
//!         largest = largest.max(energy.error.abs());
//!     }
//! })?;
//! assert!(largest < 1e-8);
//! # Ok(())
//! # }
//! ```
//!
//! | what you have | where it goes in |
//! |---|---|
//! | a scenario, as JSON or made in Rust | [`scenario::Scenario`], [`advise::plan`], [`run::execute`] |
//! | a potential, a Hamiltonian or a Lagrangian of your own | [`solve`], [`run::Recording`], [`study::own`] |
//! | a log | [`log::reader`], [`log::columns`], [`log::inspect`], [`export`], [`diff`], `chart`, [`verify`] |
//! | torques that your program chooses as it goes | [`run::Simulation`] |
//! | an accuracy instead of a method | [`advise`] |
//! | many values of a field | [`sweep`] |
//! | attitudes that were seen | [`mod@fit`] |
//!
//! The features `serve` (the service, the page), `chart` (pictures) and `live` (viewers of a running job) are on by default; without
//! them (`default-features = false`) a scenario still runs to a log.
//!
//! [`scenario`] and [`solve`] do not know each other; [`run`] introduces them. See ARCHITECTURE.md.

pub mod method;
pub mod scenario;
pub mod plan;
mod assemble;
mod in_order;
pub mod run;
pub use vpd_solve as solve;
pub mod study;
pub mod advise;
pub mod sweep;
pub mod fit;
pub mod log;
#[cfg(feature = "live")]
pub mod live;
pub mod verify;
pub mod export;
pub mod diff;
#[cfg(feature = "chart")]
pub mod chart;
#[cfg(feature = "serve")]
pub mod serve;
#[cfg(feature = "serve")]
pub mod client;
pub mod cli;
