//! The end of a log, and the report on the whole run: there, and to the caller.
//!
//! Invariant: every log that is finished is finished here, with the figures of its summary and none
//! of the clock.

use std::collections::BTreeMap;
use std::path::Path;

use super::summary::{
    self, ControlSummary, CovarianceSummary, DerivativesSummary, Diagnosis, EnergySeen,
    EnsembleSummary, FinalState, MomentumSummary, Outcome, SolverSummary, Summary,
};
use super::{RunError, json};
#[cfg(feature = "chart")]
use crate::chart::draw_course;
use crate::log::course::Course;
#[cfg(feature = "chart")]
use crate::log::course::LogChart;
use crate::log::messages::Figures;
use crate::log::writer::{Level, LogWriter, Outcome as LogOutcome};
use crate::plan::Plan;
use crate::scenario::Expect;
use crate::solve::bodies::trajectory as bodies;
use crate::solve::nonlinear::Convergence;
use crate::solve::state::Checkpoint;

/// State that a run reached.
pub(super) struct Reached {
    pub(super) step: u64,
    samples: u64,
    iterations: u64,
    convergence: Option<Convergence>,
    last: FinalState,
    pub(super) derivatives: Option<DerivativesSummary>,
    pub(super) covariance: Option<CovarianceSummary>,
}

impl<const N: usize> From<&Checkpoint<N>> for Reached {
    fn from(checkpoint: &Checkpoint<N>) -> Self {
        let &Checkpoint { step, samples, iterations, convergence, .. } = checkpoint;
        let last = summary::final_state(checkpoint.attitude.as_ref(), &checkpoint.momentum);
        Self { step, samples, iterations, convergence, last, derivatives: None, covariance: None }
    }
}

impl Reached {
    /// Returns the end of a run of several bodies.
    pub(super) fn of_bodies(checkpoint: &bodies::Checkpoint, last: FinalState) -> Self {
        let &bodies::Checkpoint { step, samples, iterations, convergence, .. } = checkpoint;
        Self { step, samples, iterations, convergence, last, derivatives: None, covariance: None }
    }
}

/// End of a run.
pub(super) struct End {
    pub(super) outcome: Outcome,
    /// State that it reached; for an ensemble, that of member 0.
    pub(super) reached: Reached,
    /// When, in s; at the end of its last step if absent.
    pub(super) ends_s: Option<f64>,
    pub(super) diagnosis: Option<Diagnosis>,
    /// The condition that ended it before its time, in words.
    pub(super) stopped: Option<String>,
    pub(super) ensemble: Option<EnsembleSummary>,
    /// Energy of a run whose log does not show it; `None` if it is unknown how much of the energy
    /// moves.
    pub(super) energy: Option<EnergySeen>,
}

/// The run that was asked for.
#[derive(Clone, Copy)]
pub(super) struct Asked<'a> {
    step_s: f64,
    steps: u64,
    /// Number of members of an ensemble.
    members: Option<u64>,
    expect: Option<&'a Expect>,
    /// Warnings of the plan.
    warnings: &'a [String],
    /// Whether trial runs have found its error at the end: then an energy that the steps do not resolve is no sign of a loss.
    is_known: bool,
}

impl<'a> Asked<'a> {
    /// Returns the run that a plan asks for.
    pub(super) fn of(plan: &'a Plan) -> Self {
        let members = plan.ensemble.as_ref().map(|planned| planned.members);
        let Plan { step_s, steps, .. } = *plan;
        let (expect, warnings) = (plan.asked.expect.as_ref(), plan.warnings.as_slice());
        Self { step_s, steps, members, expect, warnings, is_known: plan.advice.is_some() }
    }

    /// Returns a run of `steps` steps of one trajectory.
    pub(super) fn steps(step_s: f64, steps: u64) -> Self {
        Self { step_s, steps, members: None, expect: None, warnings: &[], is_known: false }
    }
}

/// Gives a log its end, if there is one, and sums up the run. Figures of the clock are left to the caller.
pub(super) fn finish(
    asked: Asked<'_>,
    log: &Path,
    mut writer: Option<LogWriter>,
    (figures, course): (&Figures, &Course),
    end: End,
) -> Result<Summary, RunError> {
    let End { outcome, reached, ends_s, diagnosis, stopped, ensemble, energy } = end;
    let time_s = ends_s.unwrap_or(reached.step as f64 * asked.step_s);
    // Member 0 may have failed long before the others came to the end.
    let last_s = if ensemble.is_some() { asked.steps as f64 * asked.step_s } else { time_s };
    let mut say = |level, text: &str| match &mut writer {
        Some(writer) => writer.message(level, last_s, text),
        None => Ok(()),
    };
    for warning in asked.warnings {
        say(Level::Warning, warning)?;
    }
    let seen = energy.map(|ends| EnergySeen::at_samples(figures, ends.is_driven).unwrap_or(ends));
    let warning = seen.filter(|_| !asked.is_known).and_then(summary::warning);
    if let Some(warning) = &warning {
        say(Level::Warning, warning)?;
    }
    let word = outcome.as_str();
    let (level, text) = match (asked.members.zip(ensemble.as_ref()), &diagnosis) {
        (Some((members, ends)), _) => (
            if ends.failed.is_empty() { Level::Info } else { Level::Warning },
            format!("{word}: {} of {members} members succeeded", ends.succeeded),
        ),
        (None, Some(diagnosis)) => (Level::Error, diagnosis.to_string()),
        (None, None) => {
            let stopped = stopped.as_ref().map_or_else(String::new, |why| format!(", {why}"));
            (Level::Info, format!("{word}: step {}{stopped}", reached.step))
        }
    };
    say(level, &text)?;
    let mut summary = Summary {
        outcome,
        steps: reached.step,
        time_s,
        samples: reached.samples,
        resumed_step: 0,
        last: reached.last,
        error: None,
        error_below: None,
        energy: summary::energy(figures),
        orthogonality: summary::orthogonality(figures, reached.samples),
        momentum: figures.momentum_max_drift.map(|max_drift| MomentumSummary { max_drift }),
        table_impulse_max_error: figures.table_impulse_max_error,
        control: ControlSummary::of(figures),
        solver: SolverSummary {
            iterations_per_step: reached.iterations as f64 / reached.step.max(1) as f64,
            kind: reached.convergence.map(|solved| solved.rung.as_str().to_owned()),
        },
        wall_s: 0.0,
        ns_per_step: 0.0,
        log: log.display().to_string(),
        derivatives: reached.derivatives,
        covariance: reached.covariance,
        diagnosis,
        stopped,
        ensemble,
        warning,
        unmet: Vec::new(),
    };
    if let Some(expect) = asked.expect {
        summary.unmet = summary::unmet(expect, &summary);
    }
    if let Some(writer) = writer {
        writer.finish(log_outcome(&summary, course))?;
    }
    Ok(summary)
}

/// Returns the description of the job in the log after its last sample: figures and charts of the
/// run, none of the clock.
fn log_outcome(summary: &Summary, course: &Course) -> LogOutcome {
    let mut entries = BTreeMap::from([
        ("steps".to_owned(), summary.steps.to_string()),
        ("samples".to_owned(), summary.samples.to_string()),
        ("time_s".to_owned(), json(&summary.time_s)),
        ("final".to_owned(), json(&summary.last)),
        ("iterations_per_step".to_owned(), json(&summary.solver.iterations_per_step)),
    ]);
    let mut figure = |name: &str, value: Option<f64>| {
        if let Some(value) = value {
            entries.insert(name.to_owned(), json(&value));
        }
    };
    figure("energy_max_abs_error", summary.energy.map(|energy| energy.max_abs_error));
    figure("orthogonality_max", summary.orthogonality.map(|orthogonality| orthogonality.max));
    figure("momentum_max_drift", summary.momentum.map(|momentum| momentum.max_drift));
    figure("table_impulse_max_error", summary.table_impulse_max_error);
    if let Some(derivatives) = &summary.derivatives {
        entries.insert("derivatives".to_owned(), json(derivatives));
    }
    if let Some(covariance) = &summary.covariance {
        entries.insert("covariance".to_owned(), json(covariance));
    }
    if let Some(ensemble) = &summary.ensemble {
        entries.insert("ensemble".to_owned(), json(ensemble));
    }
    if let Some(diagnosis) = &summary.diagnosis {
        entries.insert("code".to_owned(), diagnosis.code.clone());
        entries.insert("diagnosis".to_owned(), json(diagnosis));
    }
    if let Some(stopped) = &summary.stopped {
        entries.insert("stopped".to_owned(), stopped.clone());
    }
    if let Some(warning) = &summary.warning {
        entries.insert("warning".to_owned(), warning.clone());
    }
    LogOutcome { state: summary.outcome.as_str().to_owned(), entries, charts: charts(course) }
}

/// Draws the pictures in the log: file names and SVG.
#[cfg(feature = "chart")]
fn charts(course: &Course) -> Vec<(&'static str, String)> {
    let charts = [
        LogChart::Energy,
        LogChart::Orthogonality,
        LogChart::Pace,
        LogChart::Pointing,
        LogChart::Spread,
    ];
    let charts = charts.into_iter().filter(|which| course.has_line(*which));
    // One that could not be drawn would be missing; the log is good without.
    charts.filter_map(|which| Some((which.file(), draw_course(course, which).ok()?))).collect()
}

#[cfg(not(feature = "chart"))]
fn charts(_: &Course) -> Vec<(&'static str, String)> {
    Vec::new()
}
