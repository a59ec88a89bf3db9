//! Members of an ensemble of several bodies.

use std::convert::Infallible;

use super::statistics::Place;
use super::way::Way;
use super::{Crew, Ensemble, Logged, SUCCEEDED};
use crate::assemble::BodiesAssembly;
use crate::log::messages::{self, BodyState, Figures, Member, MemberBody, quaternion};
use crate::plan::Plan;
use crate::run::advice::Patience;
use crate::run::bodies::{advised, energy_at_the_ends, final_state};
use crate::run::summary::{self, EnergySeen};
use crate::run::{Reached, RunError, json, note_bodies};
use crate::scenario;
use crate::solve::bodies::BodiesState;
use crate::solve::bodies::trajectory::{
    BodySample, Checkpoint, Course, Ending, Sample, Trajectory, integrate_members,
};
use crate::solve::trajectory::Schedule;
use crate::study::spread;

impl<const N: usize> Crew<N> for BodiesAssembly<N> {
    const ABREAST: u64 = 1;

    fn start(&self, asked: &scenario::Ensemble, member: u64) -> Place<N> {
        let start = spread::start_of_bodies(&self.bodies, &self.initial, asked, member);
        Place::Several(self.bodies.seen(&start).unwrap_or_default())
    }

    fn in_full(
        &mut self,
        ensemble: &Ensemble<'_>,
        logged: &mut Logged<'_>,
    ) -> Result<Option<Vec<Member>>, RunError> {
        let control = ensemble.context.control;
        let numbers = &ensemble.planned.in_full;
        let observables = ensemble.plan.observables();
        let record = |m: usize, sample: &Sample<N>| {
            if m == 0 {
                note_bodies(logged.course, logged.header.epoch_ns, observables, sample);
            }
            logged.sample(ensemble, |log| log.record_bodies(numbers[m], sample))
        };
        let go_on = |steps| control.go_on(steps * numbers.len() as u64);
        travel(self, ensemble, numbers, record, go_on)
    }

    fn others(
        &mut self,
        ensemble: &Ensemble<'_>,
        numbers: &[u64],
        go_on: impl FnMut(u64) -> bool,
    ) -> Option<Vec<Member>> {
        let unseen = |_, _: &Sample<N>| Ok::<(), Infallible>(());
        let Ok(ends) = travel(self, ensemble, numbers, unseen, go_on);
        ends
    }

    fn reached(&self, plan: &Plan, nominal: Option<&Member>) -> (Reached, Option<EnergySeen>) {
        let Self { bodies, initial, .. } = self;
        let state = |of: fn(&MemberBody) -> Option<&BodyState>| {
            let seen = nominal.into_iter().flat_map(|end| &end.bodies);
            let seen: Option<Vec<BodySample<N>>> = seen.map(|body| of(body)?.body()).collect();
            let whole = seen.filter(|seen| seen.len() == bodies.bodies().len());
            whole.map_or_else(|| initial.clone(), |seen| bodies.state_of(&seen))
        };
        let [first, last] = [state(|body| body.initial.as_ref()), state(|body| body.last.as_ref())];
        let checkpoint = Checkpoint {
            step: nominal.map_or(0, |end| end.steps),
            samples: nominal.map_or(0, |end| end.samples),
            iterations: nominal.map_or(0, |end| end.iterations),
            convergence: nominal.and_then(|end| end.solver.as_ref()?.convergence()),
            ..Checkpoint::default()
        };
        let reached = Reached::of_bodies(&checkpoint, final_state(plan, bodies, &last));
        (reached, energy_at_the_ends(bodies, &first, &last))
    }
}

/// Carries members from start to end, each by a stepper of its own; `None` if that was stopped.
fn travel<const N: usize, E>(
    assembly: &mut BodiesAssembly<N>,
    ensemble: &Ensemble<'_>,
    numbers: &[u64],
    mut record: impl FnMut(usize, &Sample<N>) -> Result<(), E>,
    go_on: impl FnMut(u64) -> bool,
) -> Result<Option<Vec<Member>>, E> {
    let Ensemble { plan, asked, planned, context } = *ensemble;
    let BodiesAssembly { bodies, initial, members, .. } = assembly;
    let starts: Vec<BodiesState<N>> =
        numbers.iter().map(|&m| spread::start_of_bodies(bodies, initial, asked, m)).collect();
    let mut figures = vec![Figures::default(); numbers.len()];
    let per_point = planned.samples_per_waypoint(plan.samples);
    let mut ways = vec![Way::new(per_point); numbers.len()];
    let mut ends_s = vec![0.0; numbers.len()];
    let trajectories = integrate_members(
        bodies,
        members,
        &starts,
        ensemble.schedule(),
        |m, sample| {
            figures[m].keep_bodies(sample);
            ways[m].keep_bodies(sample);
            ends_s[m] = sample.time_s;
            record(m, sample)
        },
        go_on,
    )?;
    if trajectories.iter().any(|end| end.ending == Ending::Cancelled) {
        return Ok(None);
    }
    let ends = trajectories.iter().zip(figures).zip(ways).enumerate();
    let ends = ends.map(|(m, ((end, figures), way))| {
        let (outcome, diagnosis) = outcome(assembly, ensemble, &starts[m], end);
        let Checkpoint { step, samples, iterations, convergence, .. } = end.reached;
        let last = starts[m].with_numbers(&end.reached.numbers);
        let last = last.unwrap_or_else(|| starts[m].clone());
        let seen = |state| assembly.bodies.seen(state).unwrap_or_default();
        let (way, ways) = way.points_of_bodies();
        let message = |time_s: f64, body: &BodySample<N>| {
            Some(BodyState::of(time_s, body, quaternion(&body.attitude)))
        };
        let each = seen(&starts[m]).into_iter().zip(seen(&last));
        let bodies =
            each.zip(&plan.bodies).enumerate().map(|(a, ((first, last), planned))| MemberBody {
                name: planned.name.clone(),
                initial: message(0.0, &first),
                last: message(ends_s[m], &last),
                way: ways.get(a).cloned(),
            });
        Member {
            member: numbers[m],
            outcome,
            steps: step,
            figures: Some(figures),
            samples,
            iterations,
            solver: convergence.map(Into::into),
            diagnosis,
            way: Some(way),
            stopped_by: match end.ending {
                Ending::Stopped(number) => u32::try_from(number).ok(),
                _ => None,
            },
            bodies: bodies.collect(),
            ..messages::Member::default()
        }
    });
    let ends = ends.collect();
    // A search for a smaller step that was stopped has no result.
    let searched = trajectories.iter().any(|end| matches!(end.ending, Ending::Failed(_)));
    Ok(if searched && context.control.stopped() { None } else { Some(ends) })
}

/// Returns how a member ended, and its diagnosis if it failed.
fn outcome<const N: usize>(
    assembly: &mut BodiesAssembly<N>,
    ensemble: &Ensemble<'_>,
    initial: &BodiesState<N>,
    end: &Trajectory,
) -> (String, String) {
    let Ending::Failed(failure) = &end.ending else {
        return (SUCCEEDED.to_owned(), String::new());
    };
    let Ensemble { plan, planned, context, .. } = *ensemble;
    let Schedule { step_s, steps, every } = ensemble.schedule();
    let way = Course { initial, checkpoint: None, step_s, steps, every };
    let work = Patience::of(plan, context.control, planned.members).work();
    let bodies = assembly.bodies.clone().watched(work);
    let stepper = assembly.stepper.as_mut();
    let advised = advised(&bodies, stepper, &way, &end.reached, &plan.asked);
    let diagnosis = summary::diagnosis(failure, None, end.reached.step, step_s, advised);
    (diagnosis.code.clone(), json(&diagnosis))
}
