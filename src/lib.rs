//! Rotating bodies on SO(n), integrated by the variational polar decomposition, logged as MCAP.
pub mod plan;
pub mod scenario;
pub mod solve;
