//! An ensemble: the members whose samples are logged, side by side, then all others on as many
//! threads as there are cores, then their statistics.
//!
//! Invariant: the log depends neither on the threads nor on which members run together. The end of each member stands in it
//! once, and one whose end is in a whole chunk is not run again.

use std::convert::Infallible;
use std::sync::atomic::Ordering;
use std::time::Instant;

use super::advice::{self, Broken, Patience};
use super::summary::{EnergySeen, Outcome, Summary};
use super::{
    Asked, Control, End, JobContext, Reached, RunError, begin_log, finish, header, json, note,
};
use crate::assemble::{Assembly, Task, assembled};
use crate::in_order::{Turns, cores, in_order};
use crate::log::LogError;
use crate::log::course::Course;
use crate::log::messages::{self, Figures, Member};
use crate::log::resume::Seen;
use crate::log::schema::Channel;
use crate::log::writer::{LogHeader, LogWriter};
use crate::plan::{EnsemblePlan, Plan};
use crate::scenario;
use crate::solve::ensemble;
use crate::solve::lanes::WIDTH;
use crate::solve::so::Mat;
use crate::solve::state::{Checkpoint, State};
use crate::solve::trajectory::{Ending, Observables, Sample, Schedule, Trajectory};
use crate::study::spread;

mod statistics;
mod way;

use statistics::{Ends, Spread};
use way::Way;

/// Outcome of a member that made all its steps, or was stopped by a condition.
const SUCCEEDED: &str = "succeeded";

/// A run of an ensemble that writes its log.
#[derive(Clone, Copy)]
pub(super) struct Ensemble<'a> {
    pub(super) plan: &'a Plan,
    pub(super) asked: &'a scenario::Ensemble,
    pub(super) planned: &'a EnsemblePlan,
    pub(super) context: &'a JobContext<'a>,
}

impl Ensemble<'_> {
    pub(super) fn run<const N: usize>(
        self,
        mut assembly: Assembly<N>,
    ) -> Result<Summary, RunError> {
        let begun = Instant::now();
        let Self { plan, asked, planned, context } = self;
        let JobContext { log: path, control } = *context;
        let header = header(plan);
        let (mut log, mut ends, mut course) = open::<N>(context, &header)?;
        let resumed_step = ends.count() * plan.steps;
        control.resumed_step.store(resumed_step, Ordering::Relaxed);
        control.steps_done.store(resumed_step, Ordering::Relaxed);
        if ends.count() == 0 {
            if plan.logs(Channel::EnsembleStatistics) {
                let mut starts = Spread::default();
                for m in 0..planned.members {
                    starts.add(&spread::start(&assembly.initial, asked, m));
                }
                log.statistics(&starts.statistics())?;
            }
            if let Some(members) = self.in_full(&mut assembly, &mut log, &header, &mut course)? {
                for end in members {
                    self.ended(&mut log, &mut ends, end)?;
                }
                self.checkpoint(&mut log, ends.count())?;
            }
        }
        if !control.stopped() {
            self.others(&mut log, &mut ends)?;
        }
        if control.interrupted.load(Ordering::Relaxed) {
            log.leave();
            return Err(RunError::Interrupted);
        }
        let integrated = begun.elapsed();

        let complete = ends.count() == planned.members;
        let statistics = ends.statistics(plan.steps as f64 * plan.step_s);
        if complete {
            log.statistics(&statistics)?;
        }
        let ensemble = ends.summary(&statistics);
        let outcome = match (complete, ensemble.succeeded) {
            (false, _) => Outcome::Cancelled,
            (true, 0) => Outcome::Failed,
            (true, _) => Outcome::Succeeded,
        };
        let nominal = ends.nominal();
        let figures = nominal.and_then(|end| end.figures).unwrap_or_default();
        let reached = reached(&assembly.initial, nominal);
        let first = nominal.and_then(|end| end.initial.as_ref()?.point());
        let first = first.unwrap_or_else(|| reached.state());
        let ends_s = nominal.and_then(|end| Some(end.last.as_ref()?.time_s));
        let stopped =
            nominal.and_then(|end| super::stopped(plan, end.stopped_by? as usize, ends_s?));
        let end = End {
            stopped,
            ends_s,
            outcome,
            energy: Some(EnergySeen::at_the_ends(&assembly.body, &first, &reached.state())),
            reached: Reached::from(&reached),
            diagnosis: nominal
                .and_then(|end| serde_json::from_slice(end.diagnosis.as_bytes()).ok()),
            ensemble: Some(ensemble),
        };
        let summary = finish(Asked::of(plan), path, Some(log), (&figures, &course), end)?;
        control.steps_done.store(ends.steps(), Ordering::Relaxed);
        let made = ends.steps().saturating_sub(resumed_step);
        Ok(Summary {
            resumed_step,
            ns_per_step: integrated.as_nanos() as f64 / made.max(1) as f64,
            wall_s: begun.elapsed().as_secs_f64(),
            ..summary
        })
    }

    fn schedule(&self) -> Schedule {
        let Plan { step_s, steps, every, .. } = *self.plan;
        Schedule { step_s, steps, every }
    }

    /// Runs the members whose samples are logged; `None` if that was stopped.
    fn in_full<const N: usize>(
        &self,
        assembly: &mut Assembly<N>,
        log: &mut LogWriter,
        header: &LogHeader,
        course: &mut Course,
    ) -> Result<Option<Vec<Member>>, RunError> {
        let JobContext { control, .. } = *self.context;
        let numbers = &self.planned.in_full;
        let epoch_ns = header.epoch_ns;
        #[cfg(feature = "live")]
        let show = super::show(control, header);
        let record = |m: usize, sample: &Sample<N>| {
            if m == 0 {
                note(course, epoch_ns, sample);
                #[cfg(feature = "live")]
                if let Some(show) = &show {
                    show.sample(sample);
                }
            }
            log.record_member(numbers[m], sample)?;
            if log.wants_checkpoint() {
                // No run resumes from here: these members are few, and begin again.
                self.checkpoint(log, 0)?;
            }
            Ok::<(), RunError>(())
        };
        let go_on = |steps| control.go_on(steps * numbers.len() as u64);
        self.travel(assembly, numbers, self.plan.observables(), record, go_on)
    }

    /// Runs the members that have not ended yet, and writes their ends in their order.
    fn others<const N: usize>(
        &self,
        log: &mut LogWriter,
        ends: &mut Ends<N>,
    ) -> Result<(), RunError> {
        let left: Vec<u64> = (0..self.planned.members).filter(|&m| !ends.contains(m)).collect();
        let mut open = 0;
        in_order(
            0..left.len() as u64,
            WIDTH as u64,
            cores(),
            |turns| assembled(self.plan, Worker { ensemble: self, left: &left, turns }),
            |group: Vec<Member>| {
                for end in group {
                    self.ended(log, ends, end)?;
                    open += 1;
                    if open == self.planned.members_per_chunk {
                        self.checkpoint(log, ends.count())?;
                        open = 0;
                    }
                }
                Ok(())
            },
        )
    }

    fn ended<const N: usize>(
        &self,
        log: &mut LogWriter,
        ends: &mut Ends<N>,
        end: Member,
    ) -> Result<(), RunError> {
        log.member(self.plan.steps as f64 * self.plan.step_s, &end)?;
        ends.add(end);
        self.context.control.note(ends.count() * self.plan.steps);
        Ok(())
    }

    /// Closes the chunk after `ends` ends: an interrupted run resumes from there.
    fn checkpoint(&self, log: &mut LogWriter, ends: u64) -> Result<(), LogError> {
        let checkpoint = messages::Checkpoint {
            step: ends * self.plan.steps,
            samples: log.samples(),
            body_momentum: vec![0.0; self.plan.dimension.pow(2)],
            figures: Some(Figures::default()),
            ..messages::Checkpoint::default()
        };
        log.checkpoint(&checkpoint)?;
        self.context.control.note_durable(log);
        Ok(())
    }

    /// Carries members from start to end, side by side; `None` if that was stopped.
    fn travel<const N: usize, E>(
        &self,
        assembly: &mut Assembly<N>,
        numbers: &[u64],
        observables: Observables,
        mut record: impl FnMut(usize, &Sample<N>) -> Result<(), E>,
        go_on: impl FnMut(u64) -> bool,
    ) -> Result<Option<Vec<Member>>, E> {
        let nominal = &assembly.initial;
        let starts: Vec<State<N>> =
            numbers.iter().map(|&m| spread::start(nominal, self.asked, m)).collect();
        let mut figures = vec![Figures::default(); numbers.len()];
        let per_point = self.planned.samples_per_waypoint(self.plan.samples);
        let mut ways = vec![Way::new(per_point); numbers.len()];
        let mut velocities = vec![None; numbers.len()];
        let members = assembly.members.as_mut().expect("the plan of an ensemble has members");
        members.set_numbers(numbers);
        let trajectories = ensemble::integrate(
            &assembly.body,
            members.as_mut(),
            &starts,
            self.schedule(),
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
            let (outcome, diagnosis) = self.outcome(assembly, &starts[m], end);
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
            }
        });
        let ends = ends.collect();
        // A search for a smaller step that was stopped has no result.
        let searched = trajectories.iter().any(|end| matches!(end.ending, Ending::Failed(_)));
        Ok(if searched && self.context.control.stopped() { None } else { Some(ends) })
    }

    /// Returns how a member ended, and its diagnosis if it failed.
    fn outcome<const N: usize>(
        &self,
        assembly: &mut Assembly<N>,
        initial: &State<N>,
        end: &Trajectory<N>,
    ) -> (String, String) {
        let Ending::Failed(failure) = &end.ending else {
            return (SUCCEEDED.to_owned(), String::new());
        };
        let schedule = self.schedule();
        let asked = Some(&self.plan.asked);
        let broken = Broken { initial, reached: &end.reached, schedule, asked, failure };
        let patience = Patience::of(self.plan, self.context.control, self.planned.members);
        let stepper = assembly.stepper.as_mut();
        let own_steps = advice::own_steps(self.plan, &assembly.body);
        let diagnosis = advice::diagnosis(&assembly.body, stepper, &broken, own_steps, patience);
        (diagnosis.code.clone(), json(&diagnosis))
    }
}

/// A thread that runs members, a few at a time.
struct Worker<'a> {
    ensemble: &'a Ensemble<'a>,
    /// Members that have not ended.
    left: &'a [u64],
    turns: &'a Turns<'a, Vec<Member>>,
}

impl Task for Worker<'_> {
    type Output = Option<()>;

    fn perform<const N: usize>(self, mut assembly: Assembly<N>) -> Option<()> {
        let Self { ensemble, left, turns } = self;
        let control: &Control = ensemble.context.control;
        // The singular values of a member that is not logged in full are not needed.
        let observables = Observables { sigma_min: false, ..ensemble.plan.observables() };
        while let Some(places) = turns.take() {
            let group = &left[places.start as usize..places.end as usize];
            let travelled = ensemble.travel(
                &mut assembly,
                group,
                observables,
                |_, _| Ok::<(), Infallible>(()),
                |_| {
                    control.steps_done.fetch_add(group.len() as u64, Ordering::Relaxed);
                    !control.stopped() && !turns.is_closed()
                },
            );
            let Ok(ends) = travelled;
            turns.give(places, ends?)?;
        }
        Some(())
    }
}

/// Resumes the log of an interrupted run with the ends that it holds and its chart data, or begins
/// one.
fn open<const N: usize>(
    context: &JobContext<'_>,
    header: &LogHeader,
) -> Result<(LogWriter, Ends<N>, Course), LogError> {
    let (mut course, mut ends) = (Course::default(), Ends::default());
    let mut seen = |seen: Seen<'_>| match seen {
        Seen::Member(end) => ends.add(*end),
        seen => course.note_seen(&seen),
    };
    let stopped = || context.control.interrupted.load(Ordering::Relaxed);
    if let Some((log, _)) = LogWriter::resume(context.log, header, &mut seen, &stopped)?
        && ends.count() > 0
    {
        return Ok((log, ends, course));
    }
    Ok((begin_log(context, header)?, Ends::default(), Course::default()))
}

/// Returns the state that member 0 reached, from `initial`.
fn reached<const N: usize>(initial: &State<N>, nominal: Option<&Member>) -> Checkpoint<N> {
    let last = nominal.and_then(|end| end.last.as_ref()?.point());
    let State { attitude, momentum } = last.unwrap_or_else(|| initial.clone());
    Checkpoint {
        step: nominal.map_or(0, |end| end.steps),
        samples: nominal.map_or(0, |end| end.samples),
        attitude: Some(attitude),
        momentum,
        iterations: nominal.map_or(0, |end| end.iterations),
        convergence: nominal.and_then(|end| end.solver.as_ref()?.convergence()),
        work: 0.0,
        impulse: Mat::zeros(),
        table_impulse: 0.0,
        own_time: None,
        control: None,
        holds_since_s: Vec::new(),
        derivatives: None,
    }
}
