//! The charts of work-precision and of long runs.

use super::plot::{Axis, Line, Plot, Scale, Style};
use super::{ChartError, ENERGY, ORTHOGONALITY, over_time};
use crate::study::Entry;
use crate::study::long_term::LongTerm;
use crate::study::precision::Precision;
use crate::study::table::Row;

const STEP: Axis<'static> = Axis { label: "step in s", scale: Scale::Log };
/// The sum of two: see [`crate::study::Reference::distance`].
const ERROR: Axis<'static> =
    Axis { label: "error: attitude in rad + momentum, relative", scale: Scale::Log };
const WORK_TIME: Axis<'static> =
    Axis { label: "computing time for a second of motion, in us", scale: Scale::Log };
const WORK_FORCES: Axis<'static> =
    Axis { label: "force evaluations for a second of motion", scale: Scale::Log };

/// Rounds a time to at most four digits.
fn rounded(time_s: f64) -> f64 {
    format!("{time_s:.3e}").parse().unwrap_or(time_s)
}

/// Draws the charts of a work-precision study and returns their file names and SVG. Force
/// evaluations are left out where there is no force.
///
/// # Errors
/// If the drawing fails, which no finite data makes it do.
pub fn precision(
    name: &str,
    entries: &[Entry],
    study: &Precision,
) -> Result<Vec<(&'static str, String)>, ChartError> {
    let styles = styles(entries, true);
    let plot = |title: &str, x, place: &dyn Fn(&Row) -> Option<f64>| {
        let lines = entries.iter().zip(&study.lines).zip(&styles).map(|((entry, range), style)| {
            let rows = study.table.rows[range.clone()].iter();
            let points = rows.filter_map(|row| place(row).zip(row.error));
            // Errors beyond the size of the state show nothing.
            let points = points.filter(|&(_, error)| error < 10.0).collect();
            Line { label: entry.label(), points, style: *style }
        });
        Plot {
            title: format!("{name}: {title} at t = {} s", rounded(study.reference.time_s)),
            x,
            y: ERROR,
            lines: lines.filter(|line| !line.points.is_empty()).collect(),
            points: Vec::new(),
            rings: Vec::new(),
            guides: Vec::new(),
            guide_label: String::new(),
        }
    };
    let per_second = |row: &Row, work: f64| work / (row.steps as f64 * row.step_s);
    let mut order = plot("error against step", STEP, &|row| Some(row.step_s));
    (order.guides, order.guide_label) = slopes(entries, study);
    order.rings = (0..entries.len()).flat_map(|line| study.asymptotic(line)).collect();
    let time = plot("error against time", WORK_TIME, &|row| {
        row.ns_per_step.map(|ns| 1e-3 * per_second(row, ns * row.steps as f64))
    });
    let forces = plot("error against force evaluations", WORK_FORCES, &|row| {
        (row.force_evaluations > 0).then(|| per_second(row, row.force_evaluations as f64))
    });
    let mut drawn = vec![("order.svg", order.draw()?), ("time.svg", time.draw()?)];
    if !forces.lines.is_empty() {
        drawn.push(("forces.svg", forces.draw()?));
    }
    Ok(drawn)
}

/// Returns a line of the slope of each order, next to the first method that shows it, and their
/// name.
fn slopes(entries: &[Entry], study: &Precision) -> (Vec<[(f64, f64); 2]>, String) {
    let mut orders: Vec<u32> = Vec::new();
    let mut guides = Vec::new();
    let floor = 100.0 * study.reference.error.max(1e-15);
    for (entry, range) in entries.iter().zip(&study.lines) {
        let rows = study.table.rows[range.clone()].iter();
        let shown: Vec<_> = rows
            .filter_map(|row| row.error.map(|error| (row.step_s, error)))
            .filter(|&(_, error)| error > floor && error < 0.1)
            .collect();
        let [(h0, _), .., (h1, e1)] = shown.as_slice() else { continue };
        if orders.contains(&entry.order) {
            continue;
        }
        orders.push(entry.order);
        // A little below, so that both can be seen.
        let offset = 0.3 * e1;
        let rise = libm::pow(h0 / h1, f64::from(entry.order));
        guides.push([(*h1, offset), (*h0, offset * rise)]);
    }
    orders.sort_unstable();
    let words: Vec<String> = orders.iter().map(u32::to_string).collect();
    (guides, format!("slope {}", words.join(", ")))
}

/// Draws the charts of long runs and returns their file names and SVG.
///
/// # Errors
/// If the drawing fails, which no finite data makes it do.
pub fn long_term(
    name: &str,
    entries: &[Entry],
    study: &LongTerm,
) -> Result<Vec<(&'static str, String)>, ChartError> {
    let styles = styles(entries, false);
    let step_s = study.table.rows.first().map_or(0.0, |row| row.step_s);
    let step = (step_s * 1e6).round() / 1e6;
    let draw = |title: &str, y, value: &dyn Fn(&(f64, f64, f64)) -> f64| {
        let mut plot = over_time(&format!("{name}: {title}, step {step} s"), y);
        plot.lines = entries
            .iter()
            .zip(&study.series)
            .zip(&styles)
            .map(|((entry, series), &style)| Line {
                label: entry.label(),
                // Nothing is known of the start but zero.
                points: series.iter().skip(1).map(|sample| (sample.0, value(sample))).collect(),
                style,
            })
            .filter(|line| !line.points.is_empty())
            .collect();
        plot.draw()
    };
    Ok(vec![
        ("energy.svg", draw("energy error", ENERGY, &|sample| sample.1)?),
        ("orthogonality.svg", draw("orthogonality error", ORTHOGONALITY, &|sample| sample.2)?),
    ])
}

/// Returns a colour for each family of methods, a lightness, a dash and a mark for each member of it.
fn styles(entries: &[Entry], marked: bool) -> Vec<Style> {
    let colors: Vec<usize> = entries.iter().map(|entry| entry.integrator.facts().family).collect();
    let before = |at: usize| colors[..at].iter().filter(|&&color| color == colors[at]).count();
    let style = |at: usize| {
        let member = before(at);
        Style { color: colors[at], shade: member, member, marked }
    };
    (0..colors.len()).map(style).collect()
}
