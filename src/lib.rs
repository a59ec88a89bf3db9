//! Rotating bodies on SO(n).
pub mod solve;
