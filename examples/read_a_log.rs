//! Reads a log back: how it ended, and its contents.
//!
//!     cargo run --release --example read_a_log -- dipole.mcap

use std::error::Error;
use std::io::Write;
use std::path::Path;

use vpd::log::inspect::inspect;
use vpd::log::reader::{Message, read_samples};

/// Returns the number of samples with an attitude, and the largest error of the energy in J.
pub(crate) fn read(log: &Path) -> Result<(u64, f64), Box<dyn Error>> {
    let (mut states, mut energy) = (0, 0.0_f64);
    let ending = read_samples(log, |_time_ns, message| match message {
        // The matrix is row by row, body to space.
        Message::State(state) if !state.attitude.is_empty() => states += 1,
        Message::Energy(message) => energy = energy.max(message.error.abs()),
        _ => {}
    })?;
    match ending.damage {
        Some(damage) => Err(damage.into()),
        None => Ok((states, energy)),
    }
}

#[allow(dead_code)]
fn main() -> Result<(), Box<dyn Error>> {
    let log = std::env::args().nth(1).ok_or("the path of a log is missing")?;
    let log = Path::new(&log);
    let (states, energy) = read(log)?;
    let mut out = std::io::stdout();
    writeln!(out, "{states} attitudes, energy off by at most {energy:.1e} J")?;
    // The same and more, as `vpd inspect` prints it.
    write!(out, "{}", inspect(log)?)?;
    Ok(())
}
