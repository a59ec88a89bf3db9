//! Members of an ensemble of one body, side by side.

use std::convert::Infallible;

use super::statistics::Place;
use super::way::Way;
use super::{Crew, Ensemble, Logged, SUCCEEDED};
use crate::assemble::Assembly;
use crate::log::messages::{self, Figures, Member};
use crate::plan::Plan;
use crate::run::advice::{self, Broken, Patience};
use crate::run::summary::EnergySeen;
use crate::run::{Reached, RunError, json, note};
use crate::scenario;
use crate::solve::ensemble;
use crate::solve::lanes::WIDTH;
use crate::solve::state::{Checkpoint, State};
use crate::solve::trajectory::{Ending, Observables, Sample, Trajectory};
use crate::study::spread;

impl<const N: usize> Crew<N> for Assembly<N> {
    const ABREAST: u64 = WIDTH as u64;

    fn start(&self, asked: &scenario::Ensemble, member: u64) -> Place<N> {
        Place::One(spread::start(&self.initial, asked, member))
    }

    fn in_full(
        &mut self,
        ensemble: &Ensemble<'_>,
        logged: &mut Logged<'_>,
    ) -> Result<Option<Vec<Member>>, RunError> {
        let control = ensemble.context.control;
        let numbers = &ensemble.planned.in_full;
        #[cfg(feature = "live")]
        let show = crate::run::show(control, logged.header);
        let record = |m: usize, sample: &Sample<N>| {
            if m == 0 {
                note(logged.course, logged.header.epoch_ns, sample);
                #[cfg(feature = "live")]
                if let Some(show) = &show {
                    show.sample(sample);
                }
            }
            logged.sample(ensemble, |log| log.record_member(numbers[m], sample))
        };
        let go_on = |steps| control.go_on(steps * numbers.len() as u64);
        travel(self, ensemble, numbers, ensemble.plan.observables(), record, go_on)
    }

    fn others(
        &mut self,
        ensemble: &Ensemble<'_>,
        numbers: &[u64],
        go_on: impl FnMut(u64) -> bool,
    ) -> Option<Vec<Member>> {
        // The singular values of a member that is not logged in full are not needed.
        let observables = Observables { sigma_min: false, ..ensemble.plan.observables() };
        let unseen = |_, _: &Sample<N>| Ok::<(), Infallible>(());
        let Ok(ends) = travel(self, ensemble, numbers, observables, unseen, go_on);
        ends
    }

    fn reached(&self, _: &Plan, nominal: Option<&Member>) -> (Reached, Option<EnergySeen>) {
        let reached = reached(&self.initial, nominal);
        let first = nominal.and_then(|end| end.initial.as_ref()?.point());
        let first = first.unwrap_or_else(|| reached.state());
        let energy = EnergySeen::at_the_ends(&self.body, &first, &reached.state());
        (Reached::from(&reached), Some(energy))
    }
}

/// Carries members from start to end, side by side; `None` if that was stopped.
fn travel<const N: usize, E>(
    assembly: &mut Assembly<N>,
    ensemble: &Ensemble<'_>,
    numbers: &[u64],
    observables: Observables,
    mut record: impl FnMut(usize, &Sample<N>) -> Result<(), E>,
    go_on: impl FnMut(u64) -> bool,
) -> Result<Option<Vec<Member>>, E> {
    let Ensemble { plan, asked, planned, context } = *ensemble;
    let nominal = &assembly.initial;
    let starts: Vec<State<N>> = numbers.iter().map(|&m| spread::start(nominal, asked, m)).collect();
    let mut figures = vec![Figures::default(); numbers.len()];
    let per_point = planned.samples_per_waypoint(plan.samples);
    let mut ways = vec![Way::new(per_point); numbers.len()];
    let mut velocities = vec![None; numbers.len()];
    let members = assembly.members.as_mut().expect("the plan of an ensemble has members");
    members.set_numbers(numbers);
    let trajectories = ensemble::integrate(
        &assembly.body,
        members.as_mut(),
        &starts,
        ensemble.schedule(),
        observables,
        |m, sample| {
            figures[m].keep(sample);
            ways[m].keep(sample);
            velocities[m] = sample.angular_velocity;
            record(m, sample)
        },
        go_on,
    )?;
    if trajectories.iter().any(|end| end.ending == Ending::Cancelled) {
        return Ok(None);
    }
    let ends = trajectories.iter().zip(figures).zip(ways).enumerate();
    let ends = ends.map(|(m, ((end, figures), way))| {
        assembly.stepper.set_member(numbers[m]);
        let (outcome, diagnosis) = outcome(assembly, ensemble, &starts[m], end);
        let begun = assembly.body.velocity(&starts[m].momentum);
        let Checkpoint { step, samples, attitude, momentum, iterations, convergence, .. } =
            &end.reached;
        Member {
            member: numbers[m],
            outcome,
            steps: *step,
            initial: Some(messages::State::at(
                0.0,
                Some(&starts[m].attitude),
                &starts[m].momentum,
                Some(&begun),
            )),
            last: Some(messages::State::at(
                end.time_s,
                attitude.as_ref(),
                momentum,
                velocities[m].as_ref(),
            )),
            figures: Some(figures),
            samples: *samples,
            iterations: *iterations,
            solver: convergence.map(Into::into),
            diagnosis,
            way: Some(way.points()),
            stopped_by: match end.ending {
                Ending::Stopped(number) => u32::try_from(number).ok(),
                _ => None,
            },
            bodies: Vec::new(),
        }
    });
    let ends = ends.collect();
    // A search for a smaller step that was stopped has no result.
    let searched = trajectories.iter().any(|end| matches!(end.ending, Ending::Failed(_)));
    Ok(if searched && context.control.stopped() { None } else { Some(ends) })
}

/// Returns how a member ended, and its diagnosis if it failed.
fn outcome<const N: usize>(
    assembly: &mut Assembly<N>,
    ensemble: &Ensemble<'_>,
    initial: &State<N>,
    end: &Trajectory<N>,
) -> (String, String) {
    let Ending::Failed(failure) = &end.ending else {
        return (SUCCEEDED.to_owned(), String::new());
    };
    let Ensemble { plan, planned, context, .. } = *ensemble;
    let schedule = ensemble.schedule();
    let asked = Some(&plan.asked);
    let broken = Broken { initial, reached: &end.reached, schedule, asked, failure };
    let patience = Patience::of(plan, context.control, planned.members);
    let stepper = assembly.stepper.as_mut();
    let own_steps = advice::own_steps(plan, &assembly.body);
    let diagnosis = advice::diagnosis(&assembly.body, stepper, &broken, own_steps, patience);
    (diagnosis.code.clone(), json(&diagnosis))
}

/// Returns the state that member 0 reached, from `initial`.
fn reached<const N: usize>(initial: &State<N>, nominal: Option<&Member>) -> Checkpoint<N> {
    let last = nominal.and_then(|end| end.last.as_ref()?.point());
    Checkpoint {
        step: nominal.map_or(0, |end| end.steps),
        samples: nominal.map_or(0, |end| end.samples),
        iterations: nominal.map_or(0, |end| end.iterations),
        convergence: nominal.and_then(|end| end.solver.as_ref()?.convergence()),
        ..Checkpoint::at_start(last.as_ref().unwrap_or(initial))
    }
}
