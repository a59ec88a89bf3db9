//! 3 · The one door: scenario → plan → body and stepper → samples → log.
//!
//! Invariant: a numerical failure is a [`Summary`] with a [`Diagnosis`] and a finished log; only the log
//! itself can make a run an error.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use serde::Serialize;
use thiserror::Error;

use crate::advise;
use crate::assemble::{Assembly, Task, assembled};
use crate::log::LogError;
use crate::log::schema::Channel;
use crate::log::writer::{Level, LogHeader, LogWriter, Outcome as LogOutcome};
use crate::plan::Plan;
use crate::scenario::{Scenario, ScenarioError};
use crate::solve::trajectory::{self, Ending, Observables, Sample, Schedule, Sink, State};

mod advice;
mod geometry;
mod summary;

pub use summary::{
    Diagnosis, EnergySummary, FinalState, MomentumSummary, OrthogonalitySummary, Outcome,
    SolverSummary, Summary,
};

/// What a run shares with those who wait for it.
#[derive(Clone, Copy, Debug)]
pub struct JobContext<'a> {
    /// Where the finished log goes.
    pub log: &'a Path,
    /// Steps done so far; the run writes it.
    pub steps_done: &'a AtomicU64,
    /// Set it to stop the run after its current step.
    pub cancelled: &'a AtomicBool,
}

/// Why a run has no result.
#[derive(Debug, Error)]
pub enum RunError {
    /// The scenario cannot be planned.
    #[error(transparent)]
    Scenario(#[from] ScenarioError),
    /// The log could not be written.
    #[error(transparent)]
    Log(#[from] LogError),
}

impl RunError {
    /// The failure code of a job that ends so.
    pub fn code(&self) -> &'static str {
        match self {
            Self::Scenario(_) => "invalid_input",
            Self::Log(error) => error.code(),
        }
    }
}

/// Runs a scenario to its end and writes its log. Blocks.
///
/// # Errors
/// If the scenario cannot be planned or the log cannot be written; no log is left then.
pub fn execute(scenario: &Scenario, context: &JobContext<'_>) -> Result<Summary, RunError> {
    let plan = advise::plan(scenario)?;
    assembled(&plan, Run { scenario, plan: &plan, context })
}

/// A run that writes its log.
struct Run<'a> {
    scenario: &'a Scenario,
    plan: &'a Plan,
    context: &'a JobContext<'a>,
}

impl Task for Run<'_> {
    type Output = Result<Summary, RunError>;

    fn perform<const N: usize>(self, assembly: Assembly<N>) -> Self::Output {
        run(self.scenario, self.plan, assembly, self.context)
    }
}

fn run<const N: usize>(
    scenario: &Scenario,
    plan: &Plan,
    mut assembly: Assembly<N>,
    context: &JobContext<'_>,
) -> Result<Summary, RunError> {
    let Assembly { body, stepper, initial } = &mut assembly;
    let begun = Instant::now();
    let schedule = Schedule { step_s: plan.step_s, steps: plan.steps, every: plan.every };
    let writer = LogWriter::<N>::create(context.log, header(scenario, plan))?;
    let mut recorder =
        Recorder { writer, extremes: Extremes::default(), elsewhere: Duration::ZERO };
    recorder.writer.message(Level::Info, 0.0, &format!("started: {}", scenario.name()))?;
    let integrating = Instant::now();
    let end = trajectory::integrate(
        body,
        stepper.as_mut(),
        initial,
        schedule,
        observables(plan),
        &mut recorder,
        |steps| {
            context.steps_done.store(steps, Ordering::Relaxed);
            !context.cancelled.load(Ordering::Relaxed)
        },
    )?;
    let inside = integrating.elapsed().saturating_sub(recorder.elsewhere);
    context.steps_done.store(end.steps, Ordering::Relaxed);
    let time_s = end.steps as f64 * plan.step_s;
    let (outcome, diagnosis) = match &end.ending {
        Ending::Completed => (Outcome::Succeeded, None),
        Ending::Cancelled => (Outcome::Cancelled, None),
        Ending::Failed(failure) => {
            let last = State {
                attitude: end.attitude.unwrap_or(initial.attitude),
                momentum: end.momentum,
            };
            let advised =
                advice::advised_step(&mut assembly, &last, end.steps, plan.step_s, failure);
            let diagnosis = summary::diagnosis(failure, end.steps, plan.step_s, advised);
            (Outcome::Failed, Some(diagnosis))
        }
    };
    let Recorder { mut writer, extremes, .. } = recorder;
    match &diagnosis {
        Some(diagnosis) => writer.message(Level::Error, time_s, &diagnosis.to_string())?,
        None => writer.message(
            Level::Info,
            time_s,
            &format!("{}: step {}", outcome.as_str(), end.steps),
        )?,
    }
    let mut summary = Summary {
        outcome,
        steps: end.steps,
        time_s,
        samples: end.samples,
        last: summary::final_state(&end),
        error: None,
        energy: extremes.energy,
        orthogonality: extremes
            .orthogonality
            .map(|(max, sum)| OrthogonalitySummary { max, mean: sum / end.samples as f64 }),
        momentum: extremes.drift.map(|max_drift| MomentumSummary { max_drift }),
        solver: SolverSummary {
            iterations_per_step: end.iterations as f64 / end.steps.max(1) as f64,
            kind: end.convergence.map(|solved| solved.rung.as_str().to_owned()),
        },
        wall_s: 0.0,
        ns_per_step: inside.as_nanos() as f64 / end.steps.max(1) as f64,
        log: context.log.display().to_string(),
        diagnosis,
        unmet: Vec::new(),
    };
    if let Some(expect) = &scenario.expect {
        summary.unmet = summary::unmet(expect, &summary);
    }
    writer.finish(log_outcome(&summary))?;
    summary.wall_s = begun.elapsed().as_secs_f64();
    Ok(summary)
}

/// What the asked channels need at a sample.
fn observables(plan: &Plan) -> Observables {
    Observables {
        energy: plan.logs(Channel::Energy),
        orthogonality: plan.logs(Channel::Orthogonality),
        momentum: plan.logs(Channel::Momentum),
        sigma_min: plan.logs(Channel::Solver),
    }
}

/// Passes samples to the log, keeps their extremes, and measures the time that is not the integrator's.
struct Recorder<const N: usize> {
    writer: LogWriter<N>,
    extremes: Extremes,
    elsewhere: Duration,
}

/// The figures of a summary, as samples come in.
#[derive(Default)]
struct Extremes {
    energy: Option<EnergySummary>,
    /// Largest and sum.
    orthogonality: Option<(f64, f64)>,
    drift: Option<f64>,
}

impl<const N: usize> Sink<N> for Recorder<N> {
    type Error = LogError;

    fn record(&mut self, sample: &Sample<N>) -> Result<(), LogError> {
        let begun = Instant::now();
        if let Some((energy, error)) = sample.energy.zip(sample.energy_error) {
            let (initial, before) = self
                .extremes
                .energy
                .map_or((energy.total(), 0.0), |e| (e.initial, e.max_abs_error));
            let max_abs_error = error.abs().max(before);
            self.extremes.energy =
                Some(EnergySummary { initial, max_abs_error, final_error: error });
        }
        if let Some(error) = sample.orthogonality_error {
            let (max, sum) = self.extremes.orthogonality.unwrap_or_default();
            self.extremes.orthogonality = Some((error.max(max), sum + error));
        }
        if let Some(drift) = sample.momentum_drift {
            self.extremes.drift = Some(drift.max(self.extremes.drift.unwrap_or_default()));
        }
        let result = self.writer.record(sample);
        self.elsewhere += begun.elapsed();
        result
    }
}

/// What the log says of the job before its first sample.
fn header(scenario: &Scenario, plan: &Plan) -> LogHeader {
    let job = BTreeMap::from([
        ("vpd_version".to_owned(), env!("CARGO_PKG_VERSION").to_owned()),
        ("name".to_owned(), scenario.name().to_owned()),
        ("scenario".to_owned(), json(scenario)),
        ("plan".to_owned(), json(plan)),
    ]);
    LogHeader {
        epoch_ns: scenario.epoch_ns(),
        channels: plan.channels.iter().map(|channel| channel.topic).collect(),
        compression: scenario.log.compression,
        samples_per_chunk: plan.samples_per_chunk,
        scenario_json: scenario.to_json(),
        job,
        scene: geometry::scene(plan),
    }
}

/// What the log says of the job after its last sample: figures of the run, none of the clock.
fn log_outcome(summary: &Summary) -> LogOutcome {
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
    if let Some(diagnosis) = &summary.diagnosis {
        entries.insert("code".to_owned(), diagnosis.code.clone());
        entries.insert("diagnosis".to_owned(), json(diagnosis));
    }
    LogOutcome { state: summary.outcome.as_str().to_owned(), entries }
}

fn json(value: &impl Serialize) -> String {
    serde_json::to_string(value).expect("figures and names are JSON by construction")
}
