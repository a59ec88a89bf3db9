//! 7 · Pictures, as SVG: of logs, and of studies.
//!
//! One chart code for the command line, the service, the logs themselves and the documentation. Colours are those of
//! Okabe and Ito (2008), which colour-blind people can distinguish; what a colour shows, a dash, a mark or a hatch shows too.
//!
//! Invariant: a chart shows every extreme of its data; where many samples fall on one pixel, the largest.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use plotters::coord::Shift;
use plotters::prelude::*;
use thiserror::Error;

use crate::log::LogError;
use crate::log::course::{Course, LogChart};
use crate::log::part::irreplaceable;

mod diff;
mod map;
mod plot;
mod studies;
mod sweep;

pub use diff::differences;
pub use map::stability_map;
pub use plot::{Axis, Line, Plot, Scale, Style};
pub use studies::{long_term, precision};
pub(crate) use sweep::sweep;

/// Reason why a chart could not be drawn.
#[derive(Debug, Error)]
pub enum ChartError {
    /// The log could not be read.
    #[error(transparent)]
    Log(#[from] LogError),
    /// No log holds any of the channels that are charted.
    #[error("there are no samples of /energy, /orthogonality or /momentum to draw")]
    Empty,
    /// A file could not be written.
    #[error("{}: {source}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// Error of the system.
        source: io::Error,
    },
    /// What is at the place of a file is no regular file.
    #[error("cannot write {}: it is {kind}, which nothing replaces", path.display())]
    NoFile {
        /// The place.
        path: PathBuf,
        /// What is there: "a device", "a pipe", ...
        kind: &'static str,
    },
    /// The drawing itself failed.
    #[error("the chart could not be drawn: {0}")]
    Draw(String),
}

type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;
type Drawn = Result<(), Box<dyn std::error::Error>>;

const INK: RGBColor = RGBColor(40, 40, 40);
const PALE: RGBColor = RGBColor(225, 225, 225);
const PALETTE: [RGBColor; 7] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(230, 159, 0),
    RGBColor(86, 180, 233),
    RGBColor(0, 0, 0),
];

const TIME: Axis<'static> = Axis { label: "time in s", scale: Scale::Linear };
const ENERGY: Axis<'static> = Axis { label: "energy error in J", scale: Scale::Log };
const ORTHOGONALITY: Axis<'static> =
    Axis { label: "spectral norm of g g^T - I", scale: Scale::Log };
const PACE: Axis<'static> = Axis { label: "1 / sigma = dtau / dt", scale: Scale::Log };
const MOMENTUM: Axis<'static> = Axis { label: "drift in kg m^2/s", scale: Scale::Log };

/// Draws `energy.svg`, `orthogonality.svg` and `momentum.svg` from logs into `directory`, one line a log
/// and named after its file, as far as a log has the channels. Returns the paths of the charts.
///
/// # Errors
/// If a log cannot be read, none has any of the channels, or a file cannot be written.
pub fn draw_logs(logs: &[PathBuf], directory: &Path) -> Result<Vec<PathBuf>, ChartError> {
    let mut charts = LogChart::ALL.map(|which| (which.file(), empty(which)));
    for (color, log) in logs.iter().enumerate() {
        let label = log.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let style = Style { color, shade: color / PALETTE.len(), member: color, marked: false };
        let course = Course::of(log)?;
        for ((_, chart), which) in charts.iter_mut().zip(LogChart::ALL) {
            let points = course.points(which).to_vec();
            if !points.is_empty() {
                chart.lines.push(Line { label: label.clone(), points, style });
            }
        }
    }
    let drawn = charts.iter().filter(|(_, chart)| !chart.lines.is_empty());
    let drawn: Vec<_> =
        drawn.map(|(name, chart)| Ok((*name, chart.draw()?))).collect::<Result<_, ChartError>>()?;
    if drawn.is_empty() {
        return Err(ChartError::Empty);
    }
    write(directory, &drawn)
}

/// Draws one chart of one log.
///
/// # Errors
/// If the log cannot be read, or does not hold what the chart shows.
pub fn draw_log(log: &Path, which: LogChart) -> Result<String, ChartError> {
    draw_course(&Course::of(log)?, which)
}

/// Returns a chart of a log without its lines.
fn empty(which: LogChart) -> Plot<'static> {
    match which {
        LogChart::Energy => over_time("Energy error", ENERGY),
        LogChart::Orthogonality => over_time("Orthogonality error", ORTHOGONALITY),
        LogChart::Momentum => over_time("Drift of the conserved spatial momentum", MOMENTUM),
        LogChart::Pace => over_time("How much the steps shorten", PACE),
    }
}

/// Draws a chart from the course of a log.
///
/// # Errors
/// If there is nothing to show.
pub fn draw_course(course: &Course, which: LogChart) -> Result<String, ChartError> {
    let points = course.points(which).to_vec();
    if points.is_empty() {
        return Err(ChartError::Empty);
    }
    let style = Style { color: 0, shade: 0, member: 0, marked: false };
    let mut chart = empty(which);
    chart.lines.push(Line { label: String::new(), points, style });
    chart.draw()
}

/// Writes files into a directory that is made if it is not there; returns their paths.
///
/// # Errors
/// If one cannot be written.
pub fn write<N: AsRef<Path>>(
    directory: &Path,
    files: &[(N, String)],
) -> Result<Vec<PathBuf>, ChartError> {
    let failed = |path: &Path| {
        let path = path.to_owned();
        |source| ChartError::Write { path, source }
    };
    fs::create_dir_all(directory).map_err(failed(directory))?;
    files
        .iter()
        .map(|(name, text)| {
            let path = directory.join(name);
            if let Some(kind) = irreplaceable(&path) {
                return Err(ChartError::NoFile { path, kind });
            }
            fs::write(&path, text).map_err(failed(&path)).map(|()| path)
        })
        .collect()
}

/// Returns an empty chart of sizes over time.
fn over_time<'a>(title: &str, y: Axis<'a>) -> Plot<'a> {
    Plot {
        title: title.to_owned(),
        x: TIME,
        y,
        lines: Vec::new(),
        points: Vec::new(),
        rings: Vec::new(),
        guides: Vec::new(),
        guide_label: String::new(),
    }
}
