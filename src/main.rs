//! The `vpd` binary: see [`vpd::cli`].

use std::process::ExitCode;

/// Memory that connections leave goes back to the system; the allocator of glibc keeps it.
#[cfg(all(feature = "serve", target_os = "linux"))]
#[global_allocator]
static ALLOCATOR: tikv_jemallocator::Jemalloc = tikv_jemallocator::Jemalloc;

fn main() -> ExitCode {
    vpd::cli::main()
}
