//! Error against step and work: which method reaches an accuracy first.

use std::ops::Range;

use super::measure::{self, Probe};
use super::reference::Reference;
use super::table::{Row, Table};
use super::{Entry, Scales, StudyError, Watch, of_each, usual_time};
use crate::scenario::Scenario;

/// Results of the measurements on a scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Precision {
    /// The state at the end of all runs.
    pub reference: Reference,
    /// One row per run: each method with its steps from the largest down.
    pub table: Table,
    /// The rows of each method, in the order of the entries.
    pub lines: Vec<Range<usize>>,
}

/// Largest number of halvings of the step.
const HALVINGS: u32 = 14;
/// Number of turns in which the methods take part when their times are measured.
const REPEATS: u32 = 5;

/// Describes how the times of a study are measured, for its reader.
pub fn timing() -> String {
    format!(
        "the shortest of {REPEATS} rounds; each round makes all runs, one at a time on one thread"
    )
}

/// Runs each method over `until_s` (about one turn if absent) with a step that is halved until the error
/// is that of the reference, and measures errors and work on all cores; then the times of all runs in turns, one at a time.
///
/// # Errors
/// If there is no reference to be trusted, or the study is cancelled.
pub fn precision(
    scene: &Scenario,
    entries: &[Entry],
    until_s: Option<f64>,
    watch: &Watch,
) -> Result<Precision, StudyError> {
    let time_s = until_s.map_or_else(|| usual_time(scene), Ok)?;
    let scales = Scales::of(scene, time_s, watch)?;
    let reference = Reference::at(scene, time_s, &scales, watch)?;
    let floor = reference.error.max(f64::EPSILON);
    // The first step turns the body by about a radian where it is fastest.
    let start = (time_s * scales.fastest_rad_s).ceil().max(1.0) as u64;
    let rows = of_each(entries, watch, |entry| {
        let (mut rows, mut least) = (Vec::new(), f64::INFINITY);
        for halving in 0..HALVINGS {
            let steps = start << halving;
            let step_s = time_s / steps as f64;
            let every = steps.div_ceil(10_000);
            let probe = Probe { every, ..Probe::of(&entry.method, step_s, steps) };
            watch.expect(1);
            let run = measure::measure(scene, probe, watch)?;
            watch.advance(1)?;
            let error = reference.distance(&run.last);
            rows.push(Row::new(entry, step_s, &run, Some(error)));
            if !run.completed() {
                continue;
            }
            // At the reference's own error, or where round-off takes over, a smaller step shows nothing.
            if error <= 3.0 * floor || (error < 1e-11 && error > 0.5 * least) {
                break;
            }
            least = least.min(error);
        }
        Ok(rows)
    })?;
    let (mut table, mut lines) = (Table::default(), Vec::new());
    for rows in rows {
        let first = table.rows.len();
        table.rows.extend(rows);
        lines.push(first..table.rows.len());
    }
    let timed: Vec<(usize, &Entry)> = lines
        .iter()
        .zip(entries)
        .flat_map(|(range, entry)| range.clone().map(move |row| (row, entry)))
        .filter(|&(row, _)| table.rows[row].error.is_some())
        .collect();
    let runs: Vec<_> = timed
        .iter()
        .map(|&(row, entry)| (entry, table.rows[row].step_s, table.rows[row].steps))
        .collect();
    watch.expect(1);
    let times = measure::time(scene, &runs, REPEATS, watch)?;
    watch.advance(1)?;
    for ((row, _), ns) in timed.iter().zip(times) {
        table.rows[*row].ns_per_step = Some(ns).filter(|ns| ns.is_finite());
    }
    Ok(Precision { reference, table, lines })
}

impl Precision {
    /// Returns the steps and errors of a method from which its order is read, the largest step first: those of the
    /// asymptotic range, in which the errors fall by one power of the step, above round-off. Fewer than three are none.
    pub fn asymptotic(&self, line: usize) -> Vec<(f64, f64)> {
        /// Largest difference of the powers of two halvings, in parts of the power.
        const ALIKE: f64 = 0.1;
        let above = 100.0 * self.reference.error.max(1e-15);
        let mut points: Vec<(f64, f64)> = self.table.rows[self.lines[line].clone()]
            .iter()
            .filter_map(|row| row.error.map(|error| (row.step_s, error)))
            .filter(|&(_, error)| error > above && error < 1e-2)
            .collect();
        let power = |pair: &[(f64, f64)]| {
            libm::log(pair[0].1 / pair[1].1) / libm::log(pair[0].0 / pair[1].0)
        };
        // The smallest steps show the order best.
        let Some(last) = points.windows(2).last().map(power) else { return Vec::new() };
        let alike = points.windows(2).rev().map(power);
        let alike = alike.take_while(|power| (power - last).abs() <= ALIKE * last.abs()).count();
        let points = points.split_off(points.len() - (alike + 1));
        if points.len() < 3 { Vec::new() } else { points }
    }

    /// Returns the order that the errors of a method show: the slope of a line through the logarithms of those of the
    /// asymptotic range; `None` if there is no such range.
    pub fn measured_order(&self, line: usize) -> Option<f64> {
        let points: Vec<(f64, f64)> = self
            .asymptotic(line)
            .into_iter()
            .map(|(step_s, error)| (libm::log(step_s), libm::log(error)))
            .collect();
        if points.is_empty() {
            return None;
        }
        let count = points.len() as f64;
        let (x0, y0) = (
            points.iter().map(|p| p.0).sum::<f64>() / count,
            points.iter().map(|p| p.1).sum::<f64>() / count,
        );
        let spread: f64 = points.iter().map(|p| (p.0 - x0) * (p.0 - x0)).sum();
        Some(points.iter().map(|p| (p.0 - x0) * (p.1 - y0)).sum::<f64>() / spread)
    }
}
