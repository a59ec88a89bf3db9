//! The `vpd` binary: see [`vpd::cli`].

use std::process::ExitCode;

/// The usual allocator keeps what thousands of connections took when they are gone: 160 MiB of 8,000 idle ones, where this one
/// goes back to 28 (`tests/trials/load.py`).
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    vpd::cli::main()
}
