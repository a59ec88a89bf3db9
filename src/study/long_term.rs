//! Energy and distance from the group over a long run, several methods on one axis.

use super::measure::{Probe, measure};
use super::table::{Row, Table};
use super::{Entry, StudyError, Watch, of_each};
use crate::plan::Plan;
use crate::scenario::Scenario;

/// Long runs of a scene.
#[derive(Clone, Debug, PartialEq)]
pub struct LongTerm {
    /// One row per method.
    pub table: Table,
    /// Time, H - H0 and orthogonality error at the samples of each method, as far as it came.
    pub series: Vec<Vec<(f64, f64, f64)>>,
}

/// Largest number of samples of a run.
const SAMPLES: u64 = 100_000;

/// Runs each method with the step and duration of the scenario, on all cores.
///
/// # Errors
/// If the scene cannot be planned, or the study is cancelled.
pub fn long_term(
    scene: &Scenario,
    entries: &[Entry],
    watch: &Watch,
) -> Result<LongTerm, StudyError> {
    let Plan { step_s, steps, .. } = Plan::new(scene)?;
    watch.expect(entries.len() as u64);
    let runs = of_each(entries, watch, |entry| {
        let every = steps.div_ceil(SAMPLES);
        let probe = Probe { every, ..Probe::of(&entry.method, step_s, steps) };
        let run = measure(scene, probe, watch)?;
        watch.advance(1)?;
        Ok((Row::new(entry, step_s, &run, None), run.series))
    })?;
    let (rows, series) = runs.into_iter().unzip();
    Ok(LongTerm { table: Table { rows }, series })
}

/// Returns the change of a quantity over a run by a straight line through means of it, and the
/// standard error that the change would have if the means were independent. Zero with fewer than 20
/// values.
pub fn trend(values: &[f64]) -> (f64, f64) {
    const MEANS: usize = 50;
    let means = MEANS.min(values.len() / 2);
    if means < 10 {
        return (0.0, 0.0);
    }
    let size = values.len() / means;
    let mean = |x: &[f64]| x.iter().sum::<f64>() / x.len() as f64;
    let points: Vec<f64> = values.chunks_exact(size).take(means).map(mean).collect();
    let (centre, level) = (0.5 * (means - 1) as f64, mean(&points));
    let offset = |i: usize| i as f64 - centre;
    let spread: f64 = (0..means).map(|i| offset(i) * offset(i)).sum();
    let slope = (0..means).map(|i| offset(i) * (points[i] - level)).sum::<f64>() / spread;
    let rest: f64 =
        (0..means).map(|i| points[i] - level - slope * offset(i)).map(|rest| rest * rest).sum();
    let deviation = (rest / (means - 2) as f64 / spread).sqrt();
    (slope * means as f64, deviation * means as f64)
}
