//! A run of several bodies: plan → bodies and stepper → samples → log.
//!
//! Invariant: that of [`super`]: a numerical failure is a summary with a diagnosis and a finished log.

use std::collections::BTreeMap;
use std::sync::atomic::Ordering;
use std::time::Instant;

use super::summary::{self, Advised, EnergySeen, FinalBody, FinalState, Tried};
use super::{
    Asked, End, Ensemble, JobContext, Keep, Kept, Patience, Reached, Recorder, RunError, Summary,
    finish, header, note_bodies, ns_per_step, outcome, stopped,
};
use crate::assemble::{BodiesAssembly, BodiesTask};
use crate::log::LogError;
use crate::log::messages;
use crate::log::schema::BodyName;
use crate::plan::Plan;
use crate::scenario::{SMALLEST_STEP_S, Scenario};
use crate::solve::bodies::trajectory::{
    self, BodiesStepper, BodySample, Checkpoint, Course, Ending, Sample, Sink, Trajectory,
};
use crate::solve::bodies::{Bodies, BodiesState};
use crate::solve::failure::{Failure, two_digits};
use crate::solve::trajectory::Observables;
use crate::solve::work::Work;

/// A run whose samples go to its log.
pub(super) struct BodiesRun<'a> {
    pub(super) plan: &'a Plan,
    pub(super) context: &'a JobContext<'a>,
    pub(super) kept: Kept<'a>,
}

impl BodiesTask for BodiesRun<'_> {
    type Output = Result<Summary, RunError>;

    fn perform<const N: usize>(self, assembly: BodiesAssembly<N>) -> Self::Output {
        let Self { plan, context, kept } = self;
        if let (Some(asked), Some(planned)) = (&plan.asked.ensemble, &plan.ensemble) {
            return Ensemble { plan, asked, planned, context }.run(assembly);
        }
        let BodiesAssembly { bodies, mut stepper, initial, .. } = assembly;
        let control = context.control;
        let begun = Instant::now();
        let (recorder, checkpoint) = match kept {
            Kept::Log => Recorder::open(context, &header(plan))?,
            Kept::Memory(columns) => (Recorder::in_memory(plan, columns, control), None),
        };
        let checkpoint = checkpoint.and_then(|found| found.bodies());
        let resumed_step = checkpoint.as_ref().map_or(0, |found| found.step);
        control.resumed_step.store(resumed_step, Ordering::Relaxed);
        let names = plan.bodies.iter().filter_map(|body| BodyName::of(&body.name)).collect();
        let mut sink = Several { recorder, names, observables: plan.observables() };
        let Plan { step_s, steps, every, .. } = *plan;
        let way =
            Course { initial: &initial, checkpoint: checkpoint.as_ref(), step_s, steps, every };
        let integrating = Instant::now();
        let end = trajectory::integrate(&bodies, stepper.as_mut(), way, &mut sink, |steps| {
            control.go_on(steps)
        });
        let Several { recorder, .. } = sink;
        let Trajectory { ending, reached, time_s } = match end {
            Ok(end) => end,
            Err(error) => return Err(recorder.keep.left(error)),
        };
        let inside = integrating.elapsed().saturating_sub(recorder.elsewhere);
        control.steps_done.store(reached.step, Ordering::Relaxed);
        let ended = outcome(control, &ending, |failure| {
            let bodies = bodies.clone().watched(Patience::of(plan, control, 1).work());
            let advised = advised(&bodies, stepper.as_mut(), &way, &reached, &plan.asked);
            summary::diagnosis(failure, None, reached.step, step_s, advised)
        });
        let Some((outcome, diagnosis)) = ended else {
            return Err(recorder.keep.left(RunError::Interrupted));
        };
        let last = initial.with_numbers(&reached.numbers).unwrap_or_else(|| initial.clone());
        let energy = energy_at_the_ends(&bodies, &initial, &last);
        let reached = Reached::of_bodies(&reached, final_state(plan, &bodies, &last));
        let stopped = match ending {
            Ending::Stopped(number) => stopped(plan, number, time_s),
            _ => None,
        };
        let end = End {
            outcome,
            reached,
            ends_s: Some(time_s),
            diagnosis,
            stopped,
            ensemble: None,
            energy,
        };
        let Recorder { keep, figures, course, .. } = recorder;
        let steps_done = end.reached.step;
        let summary =
            finish(Asked::of(plan), context.log, keep.writer(), (&figures, &course), end)?;
        Ok(Summary {
            resumed_step,
            ns_per_step: ns_per_step(inside, steps_done - resumed_step),
            wall_s: begun.elapsed().as_secs_f64(),
            ..summary
        })
    }
}

/// What interrupted runs of several bodies left.
pub(super) struct LeftBodies<'a> {
    pub(super) plan: &'a Plan,
    /// The last checkpoint; `None` if there is none.
    pub(super) checkpoint: Option<&'a messages::Checkpoint>,
}

impl BodiesTask for LeftBodies<'_> {
    type Output = (Reached, Option<EnergySeen>);

    fn perform<const N: usize>(self, assembly: BodiesAssembly<N>) -> Self::Output {
        let BodiesAssembly { bodies, initial, .. } = assembly;
        let found = self.checkpoint.and_then(messages::Checkpoint::bodies).unwrap_or_default();
        let last = initial.with_numbers(&found.numbers).unwrap_or_else(|| initial.clone());
        let energy = energy_at_the_ends(&bodies, &initial, &last);
        (Reached::of_bodies(&found, final_state(self.plan, &bodies, &last)), energy)
    }
}

/// Returns the last state of each body, by name.
pub(super) fn final_state<const N: usize>(
    plan: &Plan,
    bodies: &Bodies<N>,
    state: &BodiesState<N>,
) -> FinalState {
    let of = |body: &BodySample<N>| FinalBody {
        attitude: summary::rows(&body.attitude),
        body_momentum: summary::momentum(&body.momentum),
        position: body.position.as_slice().to_vec(),
        linear_momentum: body.linear_momentum.as_slice().to_vec(),
    };
    let seen = bodies.seen(state).unwrap_or_default();
    let named = plan.bodies.iter().zip(&seen).map(|(body, seen)| (body.name.clone(), of(seen)));
    FinalState { bodies: named.collect::<BTreeMap<_, _>>(), ..FinalState::default() }
}

/// Returns the energy at the start and at the end, where it is not logged.
pub(super) fn energy_at_the_ends<const N: usize>(
    bodies: &Bodies<N>,
    start: &BodiesState<N>,
    end: &BodiesState<N>,
) -> Option<EnergySeen> {
    let at = |state| Some(bodies.energy(state, &bodies.seen(state)?));
    Some(EnergySeen::between(at(start)?, at(end)?))
}

/// Passes the samples of several bodies on.
struct Several<'a> {
    recorder: Recorder<'a>,
    names: Vec<BodyName>,
    /// What the log holds.
    observables: Observables,
}

impl<const N: usize> Sink<N> for Several<'_> {
    type Error = RunError;

    fn record(&mut self, sample: &Sample<N>) -> Result<(), RunError> {
        let Self { recorder, names, observables } = self;
        // The last sample of a run that is cut off here has no place in the log of the whole.
        if recorder.control.interrupted.load(Ordering::Relaxed) {
            return Err(RunError::Interrupted);
        }
        let begun = Instant::now();
        recorder.figures.keep_bodies(sample);
        let epoch_ns = recorder.epoch_ns;
        let result = match &mut recorder.keep {
            Keep::Memory { columns, in_chunk, .. } => {
                *in_chunk += 1;
                let Sample { time_s, .. } = *sample;
                let held = columns.record_bodies(names, sample);
                if held { Ok(()) } else { Err(LogError::Time { time_s, epoch_ns }) }
            }
            Keep::Log(writer) => {
                note_bodies(&mut recorder.course, epoch_ns, *observables, sample);
                let result = writer.record_bodies(0, sample);
                recorder.control.note_durable(writer);
                result
            }
        };
        recorder.elsewhere += begun.elapsed();
        Ok(result?)
    }

    fn wants_checkpoint(&self) -> bool {
        self.recorder.is_checkpoint_due()
    }

    fn checkpoint(&mut self, checkpoint: &Checkpoint) -> Result<(), RunError> {
        let figures = self.recorder.figures;
        self.recorder.keep_checkpoint(|| messages::Checkpoint::of_bodies(checkpoint, figures))
    }
}

/// Returns a smaller step that was tried from the start past the time at which a step failed: halved until one works, and then
/// longer again as far as it still does. Of steps that adapt it is the longest.
pub(super) fn advised<const N: usize>(
    bodies: &Bodies<N>,
    stepper: &mut dyn BodiesStepper<N>,
    way: &Course<'_, N>,
    reached: &Checkpoint,
    asked: &Scenario,
) -> Advised {
    /// What failed and what did not are brought as near as this.
    const NEAR: f64 = 1.2;
    let longest_s = stepper.own_step_s().map(|longest| *longest);
    // Two steps at least, of steps that adapt as of others.
    let failed_s = way.step_s * (reached.step as f64 + 2.0);
    let failed_s = failed_s.max(2.0 * longest_s.unwrap_or_default());
    let time_s = failed_s.min(way.step_s * way.steps as f64);
    let is_whole = failed_s >= way.step_s * way.steps as f64;
    let short = |step_s: f64| {
        if longest_s.is_some() {
            return two_digits(step_s);
        }
        let few = (0..20).map(|percent| two_digits(step_s * (1.0 - 0.01 * f64::from(percent))));
        let part = way.step_s / (way.step_s / step_s).ceil();
        few.into_iter().find(|&less| asked.fits(less)).unwrap_or(part)
    };
    let mut went = |step_s: f64| -> Result<(), Failure> {
        let of_loop_s = longest_s.map_or(step_s, |_| way.step_s);
        if let Some(longest) = stepper.own_step_s() {
            *longest = step_s;
        }
        stepper.start(way.initial);
        for _ in 0..(time_s / of_loop_s).ceil() as u64 {
            stepper.step(bodies, of_loop_s)?;
            stepper.synchronise(bodies, of_loop_s)?;
        }
        Ok(())
    };
    let tried = if is_whole { Tried::Throughout } else { Tried::For { time_s } };
    let begun_s = longest_s.unwrap_or(way.step_s);
    let (mut failed, mut step_s) = (begun_s, short(0.5 * begun_s));
    let none = loop {
        if step_s < SMALLEST_STEP_S {
            break Some(Advised::NoneWorks);
        }
        match went(step_s) {
            Ok(()) => break None,
            Err(_) if bodies.work().is_spent() => {
                break Some(Advised::NotFound { tried_s: failed });
            }
            Err(_) => (failed, step_s) = (step_s, short(0.5 * step_s)),
        }
    };
    if let Some(none) = none {
        restore(stepper, longest_s);
        return none;
    }
    while failed > NEAR * step_s {
        let between = short((failed * step_s).sqrt());
        if between <= step_s || between >= failed {
            break;
        }
        match went(between) {
            Ok(()) => step_s = between,
            Err(_) if bodies.work().is_spent() => break,
            Err(_) => failed = between,
        }
    }
    restore(stepper, longest_s);
    let advised = Advised::Step { step_s, tried };
    if longest_s.is_some() { advised.of_own_steps() } else { advised }
}

/// Sets the longest step of steps that adapt back.
fn restore<const N: usize>(stepper: &mut dyn BodiesStepper<N>, longest_s: Option<f64>) {
    if let (Some(own), Some(longest_s)) = (stepper.own_step_s(), longest_s) {
        *own = longest_s;
    }
}

impl Patience {
    /// Returns counts that end where the limits are.
    pub(super) fn work(&self) -> Work {
        Work::limited(self.most_sweeps, self.stop.clone())
    }
}
