//! The `vpd` binary: see [`vpd::cli`].

use std::process::ExitCode;

fn main() -> ExitCode {
    vpd::cli::main()
}
