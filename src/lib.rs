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
//! [`scenario`] and [`solve`] do not know each other; [`run`] introduces them. See ARCHITECTURE.md.

pub mod method;
pub mod scenario;
pub mod plan;
mod assemble;
pub mod run;
pub use vpd_solve as solve;
pub mod study;
pub mod advise;
pub mod log;
#[cfg(feature = "live")]
pub mod live;
pub mod verify;
#[cfg(feature = "chart")]
pub mod chart;
#[cfg(feature = "serve")]
pub mod serve;
pub mod cli;
