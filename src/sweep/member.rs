//! One member of a sweep: its scenario, run in memory, and its outcome.
//!
//! Invariant: the run makes the steps of the log that `vpd run` writes of the same scenario, to the
//! bit: the stepper also restarts where a chunk of that log ends.

use std::convert::Infallible;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use super::file::{Measure, Score};
use super::score::{Shadow, Tally};
use crate::advise::Settled;
use crate::assemble::{Assembly, Task, assembled};
use crate::log::messages::{Figures, quaternion};
use crate::plan::Plan;
use crate::scenario::{Scenario, ScenarioError};
use crate::solve::hamiltonian::RigidBody;
use crate::solve::so;
use crate::solve::state::Checkpoint;
use crate::solve::trajectory::{self, Ending, Observables, Sample, Schedule, Sink, Trajectory};
use crate::solve::work::Work;
use crate::study::Watch;
use crate::study::measure::rate_at;

/// Outcome of a member.
pub(super) enum Outcome {
    /// All steps were made.
    Succeeded(Row),
    /// A step could not be made; holds the figures before it.
    Failed(&'static str, Row),
    /// Its scenario is not valid.
    Refused(ScenarioError),
}

/// The figures of a run that began.
pub(super) struct Row {
    pub(super) time_s: f64,
    /// For n = 3 the unit quaternion, else the matrix row by row; `None` from a scheme that carries no attitude.
    pub(super) attitude: Option<Vec<f64>>,
    /// `vee` of the body momentum.
    pub(super) momentum: Vec<f64>,
    pub(super) figures: Figures,
    pub(super) scores: Vec<Option<f64>>,
}

/// Returns the plan of a member: that of `vpd run`. A member that `stop` ends is refused at its
/// accuracy.
pub(super) fn plan(scenario: &Scenario, stop: &Arc<AtomicBool>) -> Result<Plan, ScenarioError> {
    /// The plan of `vpd run` counts the work of the first steps, and where a step takes long makes its chunks shorter than
    /// half a mebibyte. That is looked up only where a run takes so long that it can matter.
    const LONG_S: f64 = 0.1;
    let settled = || {
        let watch = Watch { cancelled: stop.clone(), ..Watch::default() };
        Settled::new(scenario, &watch).map_err(ScenarioError::from)?.plan()
    };
    scenario.one_body()?;
    if scenario.accuracy.is_some() {
        return settled();
    }
    let plan = Plan::new(scenario)?;
    if plan.work_s > LONG_S { settled() } else { Ok(plan) }
}

/// Runs a planned member; `None` if `stop` was set before its end.
pub(super) fn run(plan: &Plan, scores: &[Score], stop: &Arc<AtomicBool>) -> Option<Outcome> {
    assembled(plan, Member { plan, scores, stop })
}

struct Member<'a> {
    plan: &'a Plan,
    scores: &'a [Score],
    stop: &'a Arc<AtomicBool>,
}

impl Task for Member<'_> {
    type Output = Option<Outcome>;

    fn has_shadow(&self) -> bool {
        self.scores.iter().any(|score| matches!(score.measure, Measure::LyapunovExponent(_)))
    }

    fn perform<const N: usize>(self, assembly: Assembly<N>) -> Option<Outcome> {
        let Self { plan, scores, stop } = self;
        let Assembly { body, mut stepper, initial, shadow, .. } = assembly;
        let body = body.with_work(Work::limited(u64::MAX, stop.clone()));
        let exponent = scores.iter().find_map(|score| match &score.measure {
            Measure::LyapunovExponent(asked) => Some(asked),
            _ => None,
        });
        let shadow = shadow.zip(exponent).map(|(stepper, asked)| {
            Shadow::new(stepper, asked, plan.step_s, rate_at(&body, &initial))
        });
        let mut seen = Seen {
            body: &body,
            figures: Figures::default(),
            tallies: Tally::all(scores, shadow),
            until_checkpoint: plan.samples_per_chunk,
            samples_per_chunk: plan.samples_per_chunk,
        };
        let Plan { step_s, steps, every, .. } = *plan;
        let observables = Observables {
            energy: true,
            orthogonality: true,
            momentum: true,
            sigma_min: false,
            pace: false,
            control: false,
            pointing: scores.iter().any(|score| score.measure.needs_pointing()),
            derivatives: false,
        };
        let Ok(Trajectory { ending, reached }) = trajectory::integrate(
            &body,
            stepper.as_mut(),
            &initial,
            Schedule { step_s, steps, every },
            observables,
            &mut seen,
            |_| !stop.load(Ordering::Relaxed),
        );
        let Checkpoint { step, attitude, momentum, .. } = reached;
        let completed = matches!(ending, Ending::Completed | Ending::Stopped(_));
        let entries = |g: &so::Mat<N>| match quaternion(g) {
            Some(q) => q.to_vec(),
            None => g.transpose().as_slice().to_vec(),
        };
        let row = Row {
            time_s: step as f64 * step_s,
            attitude: attitude.as_ref().map(entries),
            momentum: so::vee(&momentum),
            figures: seen.figures,
            scores: seen.tallies.iter().map(|tally| tally.value(completed)).collect(),
        };
        match ending {
            Ending::Completed | Ending::Stopped(_) => Some(Outcome::Succeeded(row)),
            Ending::Failed(failure) => Some(Outcome::Failed(failure.code.as_str(), row)),
            Ending::Cancelled => None,
        }
    }
}

/// Takes the samples of a run.
struct Seen<'a, const N: usize> {
    body: &'a RigidBody<N>,
    figures: Figures,
    tallies: Vec<Tally<'a, N>>,
    until_checkpoint: u64,
    samples_per_chunk: u64,
}

impl<const N: usize> Sink<N> for Seen<'_, N> {
    type Error = Infallible;

    fn record(&mut self, sample: &Sample<N>) -> Result<(), Infallible> {
        self.figures.keep(sample);
        self.tallies.iter_mut().for_each(|tally| tally.note(self.body, sample));
        self.until_checkpoint = self.until_checkpoint.saturating_sub(1);
        Ok(())
    }

    fn wants_checkpoint(&self) -> bool {
        self.until_checkpoint == 0
    }

    fn checkpoint(&mut self, _: &Checkpoint<N>) -> Result<(), Infallible> {
        self.until_checkpoint = self.samples_per_chunk;
        Ok(())
    }
}
