//! One member of a sweep: its scenario, run in memory, and its outcome.
//!
//! Invariant: the run makes the steps of the log that `vpd run` writes of the same scenario, to the
//! bit: the stepper also restarts where a chunk of that log ends.

use std::convert::Infallible;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use super::file::{Measure, Score};
use super::score::{BodiesTally, Shadow, Tally};
use crate::advise::Settled;
use crate::assemble::{Assembly, BodiesAssembly, BodiesTask, Task, assembled, assembled_bodies};
use crate::log::messages::{Figures, quaternion};
use crate::plan::Plan;
use crate::scenario::{Scenario, ScenarioError};
use crate::solve::bodies::trajectory as of_bodies;
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
    /// The attitude, for n = 3 the unit quaternion, else the matrix row by row, which a scheme may not carry; and `vee` of
    /// the body momentum. Of several bodies both of each, with its position and linear momentum.
    pub(super) state: Vec<Option<f64>>,
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
    if scenario.accuracy.is_some() {
        return settled();
    }
    let plan = Plan::new(scenario)?;
    if plan.work_s > LONG_S { settled() } else { Ok(plan) }
}

/// Runs a planned member; `None` if `stop` was set before its end.
pub(super) fn run(plan: &Plan, scores: &[Score], stop: &Arc<AtomicBool>) -> Option<Outcome> {
    let member = Member { plan, scores, stop };
    if plan.bodies.is_empty() { assembled(plan, member) } else { assembled_bodies(plan, member) }
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
        let Ok(Trajectory { ending, reached, time_s }) = trajectory::integrate(
            &body,
            stepper.as_mut(),
            &initial,
            Schedule { step_s, steps, every },
            observables,
            &mut seen,
            |_| !stop.load(Ordering::Relaxed),
        );
        let Checkpoint { attitude, momentum, .. } = reached;
        let completed = matches!(ending, Ending::Completed | Ending::Stopped(_));
        let turned = attitude.as_ref().map_or_else(Vec::new, entries);
        let size = if N == 3 { 4 } else { N * N };
        let turned = (0..size).map(|i| turned.get(i).copied());
        let row = Row {
            time_s,
            state: turned.chain(so::vee(&momentum).into_iter().map(Some)).collect(),
            figures: seen.figures,
            scores: seen.tallies.iter().map(|tally| tally.value(completed)).collect(),
        };
        outcome(&ending, row)
    }
}

fn outcome(ending: &Ending, row: Row) -> Option<Outcome> {
    match ending {
        Ending::Completed | Ending::Stopped(_) => Some(Outcome::Succeeded(row)),
        Ending::Failed(failure) => Some(Outcome::Failed(failure.code.as_str(), row)),
        Ending::Cancelled => None,
    }
}

/// Returns the cells of an attitude.
fn entries<const N: usize>(g: &so::Mat<N>) -> Vec<f64> {
    match quaternion(g) {
        Some(q) => q.to_vec(),
        None => g.transpose().as_slice().to_vec(),
    }
}

impl BodiesTask for Member<'_> {
    type Output = Option<Outcome>;

    fn perform<const N: usize>(self, assembly: BodiesAssembly<N>) -> Option<Outcome> {
        let Self { plan, scores, stop } = self;
        let BodiesAssembly { bodies, mut stepper, initial, .. } = assembly;
        let bodies = bodies.watched(Work::limited(u64::MAX, stop.clone()));
        let scene = plan.settled.bodies();
        let tallies = scene.map(|scene| BodiesTally::<N>::all(scores, scene)).unwrap_or_default();
        let (figures, until_checkpoint) = (Figures::default(), plan.samples_per_chunk);
        let mut seen = SeveralSeen { figures, tallies, until_checkpoint, plan };
        let Plan { step_s, steps, every, .. } = *plan;
        let way = of_bodies::Course { initial: &initial, checkpoint: None, step_s, steps, every };
        let go_on = |_| !stop.load(Ordering::Relaxed);
        let end = of_bodies::integrate(&bodies, stepper.as_mut(), way, &mut seen, go_on);
        let Ok(of_bodies::Trajectory { ending, reached, time_s }) = end;
        let last = initial.with_numbers(&reached.numbers).unwrap_or(initial);
        let of_body = |body: of_bodies::BodySample<N>| {
            let turned = entries(&body.attitude).into_iter().chain(so::vee(&body.momentum));
            let moved = [body.position, body.linear_momentum];
            let moved: Vec<f64> = moved.iter().flatten().copied().collect();
            turned.chain(moved).map(Some).collect::<Vec<_>>()
        };
        let row = Row {
            time_s,
            state: bodies.seen(&last).unwrap_or_default().into_iter().flat_map(of_body).collect(),
            figures: seen.figures,
            scores: seen.tallies.iter().map(BodiesTally::value).collect(),
        };
        outcome(&ending, row)
    }
}

/// Takes the samples of a run of several bodies.
struct SeveralSeen<'a, const N: usize> {
    figures: Figures,
    tallies: Vec<BodiesTally<'a, N>>,
    until_checkpoint: u64,
    plan: &'a Plan,
}

impl<const N: usize> of_bodies::Sink<N> for SeveralSeen<'_, N> {
    type Error = Infallible;

    fn record(&mut self, sample: &of_bodies::Sample<N>) -> Result<(), Infallible> {
        self.figures.keep_bodies(sample);
        self.tallies.iter_mut().for_each(|tally| tally.note(sample));
        self.until_checkpoint = self.until_checkpoint.saturating_sub(1);
        Ok(())
    }

    fn wants_checkpoint(&self) -> bool {
        self.until_checkpoint == 0
    }

    fn checkpoint(&mut self, _: &of_bodies::Checkpoint) -> Result<(), Infallible> {
        self.until_checkpoint = self.plan.samples_per_chunk;
        Ok(())
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
