//! Rotating bodies on SO(n).
pub mod log;
pub mod solve;
