//! 7 · Pictures, as SVG: of logs, and of studies.
//!
//! One chart code for the command line, the service, the logs themselves and the documentation. Colours are those of
//! Okabe and Ito (2008), which colour-blind people tell apart; what a colour tells, a dash, a mark or a hatch tells too.
//!
//! Invariant: a chart shows every extreme of its data; where many samples fall on one pixel, the largest.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use plotters::coord::Shift;
use plotters::prelude::*;
use thiserror::Error;

use crate::log::LogError;
use crate::log::reader::{Message, read_samples};
use crate::log::resume::Seen;

mod map;
mod plot;
mod studies;

pub use map::stability_map;
pub use plot::{Axis, Line, Plot, Scale, Style};
pub use studies::{long_term, precision};

/// Why a chart could not be drawn.
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
        /// The system's answer.
        source: io::Error,
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
const ENERGY: Axis<'static> = Axis { label: "|H - H(0)| in J", scale: Scale::Log };
const ORTHOGONALITY: Axis<'static> =
    Axis { label: "spectral norm of g g^T - I", scale: Scale::Log };
const MOMENTUM: Axis<'static> = Axis { label: "drift in kg m^2/s", scale: Scale::Log };

/// Draws `energy.svg`, `orthogonality.svg` and `momentum.svg` from logs into `directory`, one line a log
/// and named after its file, as far as a log has the channels. Returns the paths of the charts.
///
/// # Errors
/// If a log cannot be read, none has any of the channels, or a file cannot be written.
pub fn draw_logs(logs: &[PathBuf], directory: &Path) -> Result<Vec<PathBuf>, ChartError> {
    let mut charts = LogChart::ALL.map(|which| (which.file(), which.empty()));
    for (color, log) in logs.iter().enumerate() {
        let label = log.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let style = Style { color, member: color, marked: false };
        for ((_, chart), series) in charts.iter_mut().zip(Course::of(log)?.series) {
            let points = series.points;
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

/// What is drawn of a log over time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LogChart {
    /// The error of the energy.
    Energy,
    /// The distance of the attitude from the group.
    Orthogonality,
    /// The drift of the momentum that the scene conserves.
    Momentum,
}

impl LogChart {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Energy, Self::Orthogonality, Self::Momentum];

    /// The name of its file.
    pub const fn file(self) -> &'static str {
        match self {
            Self::Energy => "energy.svg",
            Self::Orthogonality => "orthogonality.svg",
            Self::Momentum => "momentum.svg",
        }
    }

    fn empty(self) -> Plot<'static> {
        match self {
            Self::Energy => over_time("Energy error", ENERGY),
            Self::Orthogonality => over_time("Orthogonality error", ORTHOGONALITY),
            Self::Momentum => over_time("Drift of the conserved spatial momentum", MOMENTUM),
        }
    }
}

/// Draws one chart of one log.
///
/// # Errors
/// If the log cannot be read, or does not hold what the chart shows.
pub fn draw_log(log: &Path, which: LogChart) -> Result<String, ChartError> {
    Course::of(log)?.draw(which)
}

/// What the charts of a log are drawn from, gathered in bounded memory: from the log, or while it is written. Both
/// give the same charts to the byte.
#[derive(Clone, Debug, Default)]
pub struct Course {
    start_ns: Option<u64>,
    /// In the order of [`LogChart::ALL`].
    series: [Series; 3],
}

impl Course {
    /// Reads it from a log.
    ///
    /// # Errors
    /// If the log cannot be read.
    pub fn of(log: &Path) -> Result<Self, LogError> {
        let mut course = Self::default();
        read_samples(log, |time_ns, message| course.note_message(time_ns, &message))?;
        Ok(course)
    }

    /// Takes note of what a log that is taken up held.
    pub fn note_seen(&mut self, seen: &Seen<'_>) {
        if let Seen::Message(time_ns, message) = seen {
            self.note_message(*time_ns, message);
        }
    }

    /// Takes note of a message of the log.
    pub fn note_message(&mut self, time_ns: u64, message: &Message) {
        match message {
            Message::Energy(message) => self.note(time_ns, LogChart::Energy, message.error),
            Message::Orthogonality(message) => {
                self.note(time_ns, LogChart::Orthogonality, message.error);
            }
            Message::Momentum(message) => {
                if let Some(drift) = message.drift {
                    self.note(time_ns, LogChart::Momentum, drift);
                }
            }
            _ => {}
        }
    }

    /// Takes note of what a chart shows at a log time; the first time is its zero.
    pub fn note(&mut self, time_ns: u64, which: LogChart, value: f64) {
        let since_ns = time_ns.saturating_sub(*self.start_ns.get_or_insert(time_ns));
        self.series[which as usize].push((since_ns as f64 * 1e-9, value));
    }

    /// Whether a chart would show a line.
    pub fn has_line(&self, which: LogChart) -> bool {
        let points = &self.series[which as usize].points;
        points.first().zip(points.last()).is_some_and(|(first, last)| first.0 < last.0)
    }

    /// Draws a chart.
    ///
    /// # Errors
    /// If there is nothing that it shows.
    pub fn draw(&self, which: LogChart) -> Result<String, ChartError> {
        let points = self.series[which as usize].points.clone();
        if points.is_empty() {
            return Err(ChartError::Empty);
        }
        let style = Style { color: 0, member: 0, marked: false };
        let mut chart = which.empty();
        chart.lines.push(Line { label: String::new(), points, style });
        chart.draw()
    }
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
            fs::write(&path, text).map_err(failed(&path)).map(|()| path)
        })
        .collect()
}

/// An empty chart of sizes over time.
fn over_time<'a>(title: &str, y: Axis<'a>) -> Plot<'a> {
    Plot {
        title: title.to_owned(),
        x: TIME,
        y,
        lines: Vec::new(),
        guides: Vec::new(),
        guide_label: String::new(),
    }
}

/// Points over time in bounded memory: once there are too many, the larger of two neighbours stays.
#[derive(Clone, Debug)]
struct Series {
    points: Vec<(f64, f64)>,
    /// Samples behind a point.
    each: usize,
    /// Samples behind the last point.
    held: usize,
}

impl Default for Series {
    fn default() -> Self {
        Self { points: Vec::new(), each: 1, held: 1 }
    }
}

impl Series {
    const LIMIT: usize = 1 << 16;

    fn push(&mut self, point: (f64, f64)) {
        if self.held < self.each {
            self.held += 1;
            if let Some(last) = self.points.last_mut() {
                *last = larger(*last, point);
            }
            return;
        }
        if self.points.len() == Self::LIMIT {
            self.points = self.points.chunks(2).map(|pair| larger(pair[0], pair[1])).collect();
            self.each *= 2;
        }
        self.held = 1;
        self.points.push(point);
    }
}

/// The point with the larger size.
fn larger(a: (f64, f64), b: (f64, f64)) -> (f64, f64) {
    if b.1.abs() > a.1.abs() { b } else { a }
}

#[cfg(test)]
mod tests {
    use super::Series;

    #[test]
    fn a_long_series_keeps_its_extremes_in_bounded_memory() {
        let mut series = Series::default();
        let value = |k: usize| if k == 777_777 { -5.0 } else { (k % 7) as f64 * 1e-3 };
        for k in 0..1_000_000 {
            series.push((k as f64, value(k)));
        }
        let points = &series.points;
        assert!(points.len() <= Series::LIMIT && points.len() > Series::LIMIT / 2);
        assert!(points.contains(&(777_777.0, -5.0)));
        assert!(points.windows(2).all(|pair| pair[0].0 < pair[1].0));
        // What a point stands for is never far away.
        assert!(points.windows(2).all(|pair| pair[1].0 - pair[0].0 <= 2.0 * series.each as f64));
        assert!(points.last().is_some_and(|point| point.0 >= 1e6 - 2.0 * series.each as f64));
    }
}
