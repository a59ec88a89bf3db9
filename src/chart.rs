//! 7 · Log → SVG: what a run kept, over time, on a logarithmic axis.
//!
//! One chart code for the command line, the service and the documentation. Colours are those of Okabe and
//! Ito (2008), which colour-blind people tell apart.
//!
//! Invariant: a chart shows every extreme of its data; where many samples fall on one pixel, the largest.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use thiserror::Error;

use crate::log::LogError;
use crate::log::reader::{Message, read_samples};

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

/// A line of a chart.
#[derive(Clone, Debug, PartialEq)]
pub struct Line {
    /// What it is, for the legend; not shown for a single line.
    pub label: String,
    /// Time in seconds and value; only the size of the value is drawn, zeros at the axis.
    pub points: Vec<(f64, f64)>,
}

const SIZE: (u32, u32) = (960, 420);
const PALETTE: [RGBColor; 6] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(230, 159, 0),
    RGBColor(86, 180, 233),
];
/// Values below this are drawn at it: a tenth of the spacing of the numbers below one.
const FLOOR: f64 = 1e-17;
/// As many points as the plot is wide in pixels, and no more.
const MAX_POINTS: usize = 800;

/// Draws `energy.svg`, `orthogonality.svg` and `momentum.svg` from logs into `directory`, one line a log
/// and named after its file, as far as a log has the channels. Returns the paths of the charts.
///
/// # Errors
/// If a log cannot be read, none has any of the channels, or a file cannot be written.
pub fn draw_logs(logs: &[PathBuf], directory: &Path) -> Result<Vec<PathBuf>, ChartError> {
    let mut charts = [
        ("energy.svg", "Energy error |H - H(0)| in J", Vec::new()),
        ("orthogonality.svg", "Orthogonality error, spectral norm of g g^T - I", Vec::new()),
        ("momentum.svg", "Drift of the conserved spatial momentum in kg m^2/s", Vec::new()),
    ];
    for log in logs {
        let label = log.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        for (chart, points) in charts.iter_mut().zip(series(log)?) {
            if !points.is_empty() {
                chart.2.push(Line { label: label.clone(), points });
            }
        }
    }
    fs::create_dir_all(directory)
        .map_err(|source| ChartError::Write { path: directory.to_owned(), source })?;
    let mut written = Vec::new();
    for (name, title, lines) in charts.iter().filter(|(_, _, lines)| !lines.is_empty()) {
        let path = directory.join(name);
        fs::write(&path, over_time(title, lines)?)
            .map_err(|source| ChartError::Write { path: path.clone(), source })?;
        written.push(path);
    }
    if written.is_empty() { Err(ChartError::Empty) } else { Ok(written) }
}

/// Energy error, orthogonality error and momentum drift of a log, each over time in seconds.
fn series(log: &Path) -> Result<[Vec<(f64, f64)>; 3], ChartError> {
    let [mut energy, mut orthogonality, mut momentum] = [const { Vec::new() }; 3];
    let mut start_ns = None;
    read_samples(log, |time_ns, message| {
        let time_s = (time_ns - *start_ns.get_or_insert(time_ns)) as f64 * 1e-9;
        match message {
            Message::Energy(message) => energy.push((time_s, message.error)),
            Message::Orthogonality(message) => orthogonality.push((time_s, message.error)),
            Message::Momentum(message) => {
                momentum.extend(message.drift.map(|drift| (time_s, drift)));
            }
            _ => {}
        }
    })?;
    Ok([energy, orthogonality, momentum])
}

/// Draws lines over time with a logarithmic axis for their sizes.
///
/// # Errors
/// If the drawing fails, which no finite data makes it do.
pub fn over_time(title: &str, lines: &[Line]) -> Result<String, ChartError> {
    let lines: Vec<Line> = lines.iter().map(envelope).collect();
    let all = || lines.iter().flat_map(|line| &line.points);
    let end_s = all().map(|&(time_s, _)| time_s).fold(0.0, f64::max).max(f64::MIN_POSITIVE);
    let largest = all().map(|&(_, size)| size).fold(FLOOR, f64::max);
    let smallest = all().map(|&(_, size)| size).fold(largest, f64::min);
    let decade = |x: f64, round: fn(f64) -> f64| libm::pow(10.0, round(libm::log10(x)));
    let high = decade(largest * 1.01, f64::ceil);
    // Two decades at least, so that the axis has a scale.
    let low = decade(smallest, f64::floor).min(high * 1e-2);
    let mut svg = String::new();
    draw(&mut svg, title, &lines, end_s, low..high)
        .map_err(|error| ChartError::Draw(error.to_string()))?;
    Ok(svg)
}

/// The sizes of a line, the largest of each of at most [`MAX_POINTS`] intervals.
fn envelope(line: &Line) -> Line {
    let width = line.points.len().div_ceil(MAX_POINTS).max(1);
    let points = line
        .points
        .chunks(width)
        .map(|chunk| {
            let largest = chunk.iter().map(|&(_, value)| value.abs()).fold(FLOOR, f64::max);
            (chunk[0].0, largest)
        })
        .collect();
    Line { label: line.label.clone(), points }
}

fn draw(
    svg: &mut String,
    title: &str,
    lines: &[Line],
    end_s: f64,
    sizes: std::ops::Range<f64>,
) -> Result<(), Box<dyn std::error::Error>> {
    let root = SVGBackend::with_string(svg, SIZE).into_drawing_area();
    root.fill(&WHITE)?;
    let (head, body) = root.split_vertically(48);
    head.draw(&Text::new(title.to_owned(), (20, 12), ("sans-serif", 20).into_font()))?;
    legend(&head, lines)?;
    let mut chart = ChartBuilder::on(&body)
        .margin(12)
        .margin_right(28)
        .x_label_area_size(44)
        .y_label_area_size(72)
        .build_cartesian_2d(0.0..end_s, sizes.log_scale())?;
    chart
        .configure_mesh()
        .light_line_style(TRANSPARENT)
        .bold_line_style(RGBColor(225, 225, 225))
        .x_desc("time in s")
        .y_label_formatter(&|y| format!("1e{}", libm::log10(*y).round()))
        .x_label_formatter(&|x| format!("{x}"))
        .label_style(("sans-serif", 15))
        .axis_desc_style(("sans-serif", 16))
        .y_labels(9)
        .draw()?;
    for (line, color) in lines.iter().zip(PALETTE.iter().cycle()) {
        chart.draw_series(LineSeries::new(line.points.iter().copied(), color.stroke_width(2)))?;
    }
    root.present()?;
    Ok(())
}

/// A row of names beside the title, off the data, if there is more than one line.
fn legend<B: DrawingBackend>(
    head: &DrawingArea<B, plotters::coord::Shift>,
    lines: &[Line],
) -> Result<(), Box<dyn std::error::Error>>
where
    B::ErrorType: 'static,
{
    if lines.len() < 2 {
        return Ok(());
    }
    let mut right = SIZE.0 as i32 - 28;
    let named: Vec<_> = lines.iter().zip(PALETTE.iter().cycle()).collect();
    for (line, color) in named.into_iter().rev() {
        let style =
            ("sans-serif", 15).into_font().color(color).pos(Pos::new(HPos::Right, VPos::Top));
        head.draw(&Text::new(line.label.clone(), (right, 16), style))?;
        right -= 9 * line.label.len() as i32 + 24;
    }
    Ok(())
}
