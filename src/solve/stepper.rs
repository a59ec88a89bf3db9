//! One-step schemes, one a file.

pub mod vpd;
