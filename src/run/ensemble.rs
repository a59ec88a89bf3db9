//! An ensemble: the members whose samples are logged, side by side, then all others on as many threads as there are
//! cores, then what they are together.
//!
//! Invariant: the log depends neither on the threads nor on who goes beside whom. The end of each member stands in it
//! once, and one whose end is in a whole chunk is not run again.

use std::collections::{BTreeMap, BTreeSet};
use std::convert::Infallible;
use std::num::NonZeroUsize;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, mpsc};
use std::thread;
use std::time::Instant;

use super::advice::{self, Broken};
use super::summary::{Outcome, Summary};
use super::{Control, End, JobContext, RunError, finish, header, json, note, observables};
use crate::assemble::{Assembly, Task, assembled};
use crate::chart::Course;
use crate::live::Live;
use crate::log::LogError;
use crate::log::messages::{self, Figures, Member};
use crate::log::reader::Message;
use crate::log::schema::Channel;
use crate::log::writer::{LogHeader, LogWriter};
use crate::plan::{EnsemblePlan, Plan};
use crate::scenario::{self, Scenario};
use crate::solve::ensemble;
use crate::solve::lanes::WIDTH;
use crate::solve::so::Mat;
use crate::solve::trajectory::{
    Checkpoint, Ending, Observables, Sample, Schedule, Sink, State, Trajectory,
};

mod spread;
mod statistics;

/// A member that made all its steps.
const SUCCEEDED: &str = "succeeded";

/// A run of an ensemble that writes its log.
#[derive(Clone, Copy)]
pub(super) struct Ensemble<'a> {
    pub(super) scenario: &'a Scenario,
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
        let Self { scenario, plan, asked, planned, context } = self;
        let JobContext { log: path, control } = *context;
        let header = header(scenario, plan);
        let (mut log, mut ends, mut course) = open::<N>(context, &header)?;
        let resumed_step = ends.len() as u64 * plan.steps;
        control.resumed_step.store(resumed_step, Ordering::Relaxed);
        control.steps_done.store(resumed_step, Ordering::Relaxed);
        if ends.is_empty() {
            if plan.logs(Channel::EnsembleStatistics) {
                let members = 0..planned.members;
                let starts = members.map(|m| spread::start(&assembly.initial, asked, m));
                log.statistics(&statistics::at_start(starts))?;
            }
            if let Some(members) = self.in_full(&mut assembly, &mut log, &header, &mut course)? {
                for end in members {
                    self.ended(&mut log, &mut ends, end)?;
                }
                self.checkpoint(&mut log, ends.len())?;
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

        let complete = ends.len() as u64 == planned.members;
        let statistics = statistics::at_end::<N>(plan.steps as f64 * plan.step_s, &ends);
        if complete {
            log.statistics(&statistics)?;
        }
        let ensemble = statistics::summary(&statistics, &ends);
        let outcome = match (complete, ensemble.succeeded) {
            (false, _) => Outcome::Cancelled,
            (true, 0) => Outcome::Failed,
            (true, _) => Outcome::Succeeded,
        };
        let nominal = ends.iter().find(|end| end.member == 0);
        let figures = nominal.and_then(|end| end.figures).unwrap_or_default();
        let end = End {
            outcome,
            reached: reached(&assembly.initial, nominal),
            diagnosis: nominal.and_then(|end| serde_json::from_str(&end.diagnosis).ok()),
            ensemble: Some(ensemble),
        };
        let summary = finish(scenario, plan, path, log, (&figures, &course), end)?;
        let steps: u64 = ends.iter().map(|end| end.steps).sum();
        control.steps_done.store(steps, Ordering::Relaxed);
        let made = steps.saturating_sub(resumed_step);
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
        log: &mut LogWriter<N>,
        header: &LogHeader,
        course: &mut Course,
    ) -> Result<Option<Vec<Member>>, RunError> {
        let JobContext { control, .. } = *self.context;
        let numbers = &self.planned.in_full;
        let epoch_ns = header.epoch_ns;
        let announce = |live: &Arc<Live>| live.announce(epoch_ns, header.scene.clone());
        let show = control.live.as_ref().map(announce);
        let record = |m: usize, sample: &Sample<N>| {
            if m == 0 {
                note(course, epoch_ns, sample);
                if let Some(show) = &show {
                    show.sample(sample);
                }
            }
            log.record_member(numbers[m], sample)?;
            if log.wants_checkpoint() {
                // Nobody goes on from here: these members are few, and begin again.
                self.checkpoint(log, 0)?;
            }
            Ok::<(), RunError>(())
        };
        let go_on = |steps| control.go_on(steps * numbers.len() as u64);
        self.travel(assembly, numbers, observables(self.plan), record, go_on)
    }

    /// Runs the members that have not ended yet.
    fn others<const N: usize>(
        &self,
        log: &mut LogWriter<N>,
        ends: &mut Vec<Member>,
    ) -> Result<(), RunError> {
        let known: BTreeSet<u64> = ends.iter().map(|end| end.member).collect();
        let left: Vec<u64> = (0..self.planned.members).filter(|m| !known.contains(m)).collect();
        let queue =
            Queue { members: &left, next: AtomicUsize::new(0), closed: AtomicBool::new(false) };
        let cores = thread::available_parallelism().map_or(1, NonZeroUsize::get);
        thread::scope(|scope| {
            let (send, receive) = mpsc::channel();
            for _ in 0..cores.min(left.len()) {
                let (send, queue) = (send.clone(), &queue);
                scope.spawn(move || assembled(self.plan, Worker { ensemble: self, queue, send }));
            }
            drop(send);
            let written = self.in_order(log, ends, receive.iter());
            queue.closed.store(true, Ordering::Relaxed);
            written
        })
    }

    /// Writes the ends as they come from the threads, in the order of the members.
    fn in_order<const N: usize>(
        &self,
        log: &mut LogWriter<N>,
        ends: &mut Vec<Member>,
        groups: impl Iterator<Item = (usize, Vec<Member>)>,
    ) -> Result<(), RunError> {
        let (mut waiting, mut next) = (BTreeMap::new(), 0);
        let mut open = 0;
        for (place, group) in groups {
            waiting.insert(place, group);
            while let Some(group) = waiting.remove(&next) {
                next += group.len();
                for end in group {
                    self.ended(log, ends, end)?;
                    open += 1;
                    if open == self.planned.members_per_chunk {
                        self.checkpoint(log, ends.len())?;
                        open = 0;
                    }
                }
            }
        }
        Ok(())
    }

    fn ended<const N: usize>(
        &self,
        log: &mut LogWriter<N>,
        ends: &mut Vec<Member>,
        end: Member,
    ) -> Result<(), RunError> {
        log.member(self.plan.steps as f64 * self.plan.step_s, &end)?;
        ends.push(end);
        self.context.control.note(ends.len() as u64 * self.plan.steps);
        Ok(())
    }

    /// Closes the chunk behind so many ends: an interrupted run goes on from there.
    fn checkpoint<const N: usize>(
        &self,
        log: &mut LogWriter<N>,
        ends: usize,
    ) -> Result<(), LogError> {
        let checkpoint = Checkpoint {
            step: ends as u64 * self.plan.steps,
            samples: log.samples(),
            attitude: None,
            momentum: Mat::<N>::zeros(),
            iterations: 0,
            convergence: None,
        };
        log.checkpoint(&checkpoint, Figures::default())?;
        self.context.control.durable_step.store(log.durable_step(), Ordering::Relaxed);
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
        let members = assembly.members.as_mut().expect("the plan of an ensemble has members");
        let trajectories = ensemble::integrate(
            &assembly.body,
            members.as_mut(),
            &starts,
            self.schedule(),
            observables,
            |m, sample| {
                figures[m].keep(sample);
                record(m, sample)
            },
            go_on,
        )?;
        if trajectories.iter().any(|end| end.ending == Ending::Cancelled) {
            return Ok(None);
        }
        let ends = trajectories.iter().zip(figures).enumerate();
        let ends = ends.map(|(m, (end, figures))| {
            let (outcome, diagnosis) = self.outcome(assembly, &starts[m], end);
            let Checkpoint { step, samples, attitude, momentum, iterations, convergence } =
                &end.reached;
            let time_s = *step as f64 * self.plan.step_s;
            Member {
                member: numbers[m],
                outcome,
                steps: *step,
                initial: Some(messages::State::at(
                    0.0,
                    Some(&starts[m].attitude),
                    &starts[m].momentum,
                )),
                last: Some(messages::State::at(time_s, attitude.as_ref(), momentum)),
                figures: Some(figures),
                samples: *samples,
                iterations: *iterations,
                solver: convergence.map(Into::into),
                diagnosis,
            }
        });
        Ok(Some(ends.collect()))
    }

    /// How a member ended, and its diagnosis if it failed.
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
        let broken = Broken { initial, reached: &end.reached, schedule, failure };
        let diagnosis = advice::diagnosis(&assembly.body, assembly.stepper.as_mut(), &broken);
        (diagnosis.code.clone(), json(&diagnosis))
    }
}

/// The members that wait for a thread.
struct Queue<'a> {
    members: &'a [u64],
    next: AtomicUsize,
    /// Nobody takes what the threads make any more.
    closed: AtomicBool,
}

/// A thread that runs members, a few at a time.
struct Worker<'a> {
    ensemble: &'a Ensemble<'a>,
    queue: &'a Queue<'a>,
    send: mpsc::Sender<(usize, Vec<Member>)>,
}

impl Task for Worker<'_> {
    type Output = ();

    fn perform<const N: usize>(self, mut assembly: Assembly<N>) {
        let Self { ensemble, queue, send } = self;
        let control: &Control = ensemble.context.control;
        // Nobody sees the singular values of a member that is not logged in full.
        let observables = Observables { sigma_min: false, ..observables(ensemble.plan) };
        loop {
            let place = queue.next.fetch_add(WIDTH, Ordering::Relaxed);
            let Some(left) = queue.members.get(place..).filter(|left| !left.is_empty()) else {
                return;
            };
            let group = &left[..WIDTH.min(left.len())];
            let travelled = ensemble.travel(
                &mut assembly,
                group,
                observables,
                |_, _| Ok::<(), Infallible>(()),
                |_| {
                    control.steps_done.fetch_add(group.len() as u64, Ordering::Relaxed);
                    !control.stopped() && !queue.closed.load(Ordering::Relaxed)
                },
            );
            let Ok(Some(ends)) = travelled else { return };
            if send.send((place, ends)).is_err() {
                return;
            }
        }
    }
}

/// Takes up the log of an interrupted run with the ends that it holds and what its charts show, or begins one.
fn open<const N: usize>(
    context: &JobContext<'_>,
    header: &LogHeader,
) -> Result<(LogWriter<N>, Vec<Member>, Course), LogError> {
    let mut course = Course::default();
    let seen = |time_ns, message: &Message| course.note_message(time_ns, message);
    if let Some((log, resumed)) = LogWriter::resume(context.log, header, seen)?
        && !resumed.members.is_empty()
    {
        return Ok((log, resumed.members, course));
    }
    Ok((LogWriter::create(context.log, header)?, Vec::new(), Course::default()))
}

/// Where member 0 came to, from `initial`.
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
    }
}
