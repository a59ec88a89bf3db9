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
mod fit;
mod map;
mod plot;
mod report;
mod studies;
mod sweep;

pub use diff::differences;
pub use fit::residuals;
pub use map::stability_map;
pub use plot::{Axis, Line, Plot, Scale, Style};
pub use report::report;
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
const POINTING: Axis<'static> = Axis { label: "angle of the axis in rad", scale: Scale::Log };
const SPREAD: Axis<'static> = Axis { label: "root mean square angle in rad", scale: Scale::Log };
const MOMENTUM: Axis<'static> = Axis { label: "drift in kg m^2/s", scale: Scale::Log };

/// Draws the charts of [`LogChart`] from logs into `directory`, one line a log and named after its file, as far as a log has
/// the channels. Returns the paths of the charts.
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
        LogChart::Pointing => over_time("Pointing error", POINTING),
        LogChart::Spread => over_time("Spread of the attitude", SPREAD),
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::study::stability::{self, Border, Class, Map};
    use crate::study::table::Row;
    use crate::sweep::{Cell, Kind, Shown, Side};

    /// The place of a text: left, top, right, bottom, in pixels.
    #[derive(Clone, Debug)]
    struct Words {
        text: String,
        /// Whether it ends at its place, as the numbers of a vertical axis do.
        ends: bool,
        edges: [f64; 4],
    }

    /// Returns the number in an attribute of a tag.
    fn number(tag: &str, name: &str) -> Option<f64> {
        attribute(tag, name)?.parse().ok()
    }

    fn attribute<'a>(tag: &'a str, name: &str) -> Option<&'a str> {
        tag.split_once(&format!(" {name}=\""))?.1.split('"').next()
    }

    /// Returns where the texts of a picture are: letters are at most 0.6 of their height wide on average.
    fn texts(svg: &str) -> Vec<Words> {
        svg.split("<text")
            .skip(1)
            .map(|part| {
                let (tag, rest) = part.split_once('>').expect("an end of the tag");
                let text = rest.split('<').next().unwrap_or_default().trim().to_owned();
                let [x, y, size] =
                    ["x", "y", "font-size"].map(|name| number(tag, name).expect("a number"));
                let wide = 0.6 * size * text.chars().count() as f64;
                let left = match attribute(tag, "text-anchor") {
                    Some("end") => x - wide,
                    Some("middle") => x - 0.5 * wide,
                    _ => x,
                };
                let top = match attribute(tag, "dy") {
                    Some("0.76em") => y,
                    Some("-0.5ex") => y - size,
                    _ => y - 0.5 * size,
                };
                // The name of the vertical axis is turned about its place.
                let edges = if tag.contains("rotate(") {
                    [x, y - 0.5 * wide, x + size, y + 0.5 * wide]
                } else {
                    [left, top, left + wide, top + size]
                };
                Words { text, ends: attribute(tag, "text-anchor") == Some("end"), edges }
            })
            .collect()
    }

    /// Panics if texts of a picture lie on each other, or beyond its edge.
    fn check(what: &str, svg: &str) {
        let [width, height] =
            ["width", "height"].map(|name| number(svg, name).expect("the size of the picture"));
        let words = texts(svg);
        assert!(words.len() > 2, "{what}: {words:?}");
        for (k, one) in words.iter().enumerate() {
            let [left, top, right, bottom] = one.edges;
            let inside = left >= 0.0 && top >= 0.0 && right <= width && bottom <= height;
            assert!(inside, "{what}: {one:?} is beyond {width} x {height}");
            for other in &words[k + 1..] {
                let [l, t, r, b] = other.edges;
                let apart = right <= l || r <= left || bottom <= t || b <= top;
                assert!(apart, "{what}: {one:?} lies on {other:?}");
            }
        }
    }

    const LONG: &str = "a name of a scene that is much longer than anybody would write, but that is allowed, because it has \
                        fewer than two hundred letters, and that therefore has to have its place";

    fn plot(scale: Scale, lines: usize, label: &str, points: &[(f64, f64)]) -> Plot<'static> {
        let line = |k: usize| Line {
            label: format!("{label} {k}"),
            points: points.to_vec(),
            style: Style { color: k % 7, shade: k / 7, member: k, marked: true },
        };
        Plot {
            title: format!("{label}: error against step"),
            x: Axis { label: "step in s", scale: Scale::Linear },
            y: Axis { label: "error: attitude in rad + momentum, relative", scale },
            lines: (0..lines).map(line).collect(),
            points: Vec::new(),
            rings: points.to_vec(),
            guides: vec![[(0.1, 1.0), (1.0, 2.0)]],
            guide_label: "slope 2, 4, 6".to_owned(),
        }
    }

    #[test]
    fn texts_of_a_chart_lie_apart_whatever_it_shows() {
        let shapes: [(&str, &[(f64, f64)]); 7] = [
            ("usual", &[(0.1, 1e-9), (0.2, 1e-7), (0.4, 1e-5)]),
            ("one step", &[(0.1, 1e-9)]),
            ("all equal", &[(0.1, 5.0), (0.2, 5.0), (0.3, 5.0)]),
            ("all zero", &[(0.0, 0.0), (0.0, 0.0)]),
            ("tiny", &[(1e-300, 1e-300), (2e-300, 3e-300)]),
            ("huge", &[(1e9, 1e300), (2e9, 2e300)]),
            ("close together", &[(1e-8, 1.000_000_1), (3e-8, 1.000_000_4)]),
        ];
        for (what, points) in shapes {
            for scale in [Scale::Linear, Scale::Log] {
                for (lines, label) in [(1, "vpd gauss2"), (9, LONG), (60, "rk_projected rk8")] {
                    let svg = plot(scale, lines, label, points).draw().expect("drawn");
                    check(&format!("{what}, {scale:?}, {lines} lines"), &svg);
                }
            }
        }
    }

    #[test]
    fn the_numbers_of_an_axis_differ() {
        for points in [
            [(0.0, 0.0), (1.0, 3e-8)],
            [(0.0, 1.000_000_1), (1.0, 1.000_000_4)],
            [(0.0, -2e-300), (1.0, 3e-300)],
            [(0.0, 0.0), (1.0, 123_456_789.0)],
            [(0.0, 5.0), (1.0, 5.0)],
        ] {
            let svg = plot(Scale::Linear, 1, "vpd", &points).draw().expect("drawn");
            let labels: Vec<_> = texts(&svg).into_iter().filter(|words| words.ends).collect();
            assert!(labels.len() > 2, "{points:?}: {labels:?}");
            for (k, one) in labels.iter().enumerate() {
                let again = labels[k + 1..].iter().any(|other| other.text == one.text);
                assert!(!again, "{points:?}: {labels:?}");
            }
        }
    }

    fn map(methods: usize, steps: usize, label: &str, classes: &[Class]) -> Map {
        let row = Row {
            method: "vpd".to_owned(),
            tableau: "gauss2".to_owned(),
            order: 4,
            solver: "auto".to_owned(),
            step_s: 0.1,
            steps: 4000,
            error: None,
            energy_error: Some(1e-9),
            orthogonality_error: None,
            iterations_per_step: None,
            force_evaluations: 0,
            ns_per_step: None,
            outcome: "succeeded".to_owned(),
            failed_step: None,
        };
        let cell = |k: usize| stability::Cell {
            class: classes[k % classes.len()],
            row: row.clone(),
            swing_rad: None,
        };
        let border = |k: usize| Border {
            label: format!("{label} {k}"),
            usable_step_s: Some(0.1),
            turn_rad: Some(0.1),
            broken_step_s: None,
            broken: None,
            resonances: Vec::new(),
        };
        Map {
            steps_s: (0..steps).map(|k| 0.012 * libm::pow(1.26, k as f64)).collect(),
            cells: (0..methods).map(|_| (0..steps).map(cell).collect()).collect(),
            borders: (0..methods).map(border).collect(),
            energy_scale: 1.0,
            fastest_rad_s: 2.5,
        }
    }

    #[test]
    fn texts_of_a_map_lie_apart_whatever_it_shows() {
        let classes = [
            Class::Stable,
            Class::EnergyDrifts,
            Class::BlewUp,
            Class::LeftGroup,
            Class::WrongBranch,
        ];
        for (methods, steps) in [(1, 1), (3, 24), (60, 24), (3, 4)] {
            for label in ["vpd gauss2", LONG] {
                for classes in [&classes[..1], &classes] {
                    let svg = stability_map(label, &map(methods, steps, label, classes));
                    check(&format!("{methods} methods, {steps} steps"), &svg.expect("drawn"));
                }
            }
        }
    }

    #[test]
    fn texts_of_a_sweep_lie_apart_whatever_it_shows() {
        let words: [&[&str]; 4] = [
            &["0.1", "0.2", "0.3"],
            &["vpd gauss2", "splitting 2", "rk_projected rk8"],
            &["-1.23e-300"],
            &["0.123"; 31],
        ];
        for x in words {
            for y in words {
                for name in ["/step_s", LONG] {
                    let side = |values: &[&str]| Side {
                        name: name.to_owned(),
                        values: values.iter().map(|&value| value.to_owned()).collect(),
                        per_cell: 1,
                    };
                    let cell = |k: usize| match k % 5 {
                        0 => Cell::Failed,
                        1 => Cell::Refused,
                        2 => Cell::Empty,
                        3 => Cell::Waiting,
                        _ => Cell::Value(1e-300 * k as f64),
                    };
                    let cells = (0..x.len() * y.len()).map(cell).collect();
                    let kind = Kind::Map { x: side(x), y: side(y), cells };
                    let (scene, column) = (name.to_owned(), "energy_error_max".to_owned());
                    let svg = sweep(&Shown { name: scene, column, kind, without: 3 });
                    let svg = svg.expect("drawn");
                    check(&format!("{x:?}, {y:?}, {name}"), &svg);
                    let all = texts(&svg);
                    let named = |word: &str| all.iter().any(|words| words.text == word);
                    assert!(x.len() > 3 || x.iter().all(|&word| word.len() > 12 || named(word)));
                }
            }
        }
    }

    #[test]
    fn members_of_a_family_differ_in_grey() {
        // The light that each of five reflects, by the weights of ITU-R BT.709, lies apart from that of the others.
        let light = |RGBColor(r, g, b): RGBColor| {
            0.2126 * f64::from(r) + 0.7152 * f64::from(g) + 0.0722 * f64::from(b)
        };
        let blue = PALETTE[0];
        let mut lights: Vec<f64> = (0..5).map(|shade| light(plot::of_shade(blue, shade))).collect();
        lights.sort_by(f64::total_cmp);
        assert!(lights.windows(2).all(|pair| pair[1] - pair[0] > 15.0), "{lights:?}");
    }
}
