//! An ensemble: the members whose samples are logged, side by side, then all others on as many
//! threads as there are cores, then their statistics.
//!
//! Invariant: the log depends neither on the threads nor on which members run together. The end of each member stands in it
//! once, and one whose end is in a whole chunk is not run again.

use std::sync::atomic::Ordering;
use std::time::Instant;

use super::summary::{EnergySeen, Outcome, Summary};
use super::{
    Asked, Control, End, JobContext, Reached, RunError, begin_log, finish, header, ns_per_step,
};
use crate::assemble::{Assembly, BodiesAssembly, BodiesTask, Task, assembled, assembled_bodies};
use crate::in_order::{Turns, cores, in_order};
use crate::log::LogError;
use crate::log::course::Course;
use crate::log::messages::{self, Figures, Member};
use crate::log::resume::Seen;
use crate::log::schema::Channel;
use crate::log::writer::{LogHeader, LogWriter};
use crate::plan::{EnsemblePlan, Plan};
use crate::scenario;
use crate::solve::trajectory::Schedule;

mod one;
mod several;
mod statistics;
mod way;

use statistics::{Ends, Place, Spreads};

/// Outcome of a member that made all its steps, or was stopped by a condition.
const SUCCEEDED: &str = "succeeded";

/// What carries members: a body, or several, with their steppers.
pub(super) trait Crew<const N: usize> {
    /// Members that it carries side by side, if they are not logged.
    const ABREAST: u64;

    /// Returns where a member starts.
    fn start(&self, asked: &scenario::Ensemble, member: u64) -> Place<N>;

    /// Carries the members whose samples are logged from start to end; `None` if that was stopped.
    fn in_full(
        &mut self,
        ensemble: &Ensemble<'_>,
        logged: &mut Logged<'_>,
    ) -> Result<Option<Vec<Member>>, RunError>;

    /// Carries other members from start to end, at most [`Self::ABREAST`]; `None` if that was stopped. `go_on` is asked before
    /// each step.
    fn others(
        &mut self,
        ensemble: &Ensemble<'_>,
        numbers: &[u64],
        go_on: impl FnMut(u64) -> bool,
    ) -> Option<Vec<Member>>;

    /// Returns what member 0 reached, and its energy at the start and at the end.
    fn reached(&self, plan: &Plan, nominal: Option<&Member>) -> (Reached, Option<EnergySeen>);
}

/// Where the samples of members go.
pub(super) struct Logged<'a> {
    log: &'a mut LogWriter,
    /// Chart data of member 0.
    course: &'a mut Course,
    header: &'a LogHeader,
}

impl Logged<'_> {
    /// Takes a sample by `write`.
    fn sample(
        &mut self,
        ensemble: &Ensemble<'_>,
        write: impl FnOnce(&mut LogWriter) -> Result<(), LogError>,
    ) -> Result<(), RunError> {
        write(self.log)?;
        if self.log.wants_checkpoint() {
            // No run resumes from here: these members are few, and begin again.
            ensemble.checkpoint(self.log, 0)?;
        }
        Ok(())
    }
}

/// A run of an ensemble that writes its log.
#[derive(Clone, Copy)]
pub(super) struct Ensemble<'a> {
    pub(super) plan: &'a Plan,
    pub(super) asked: &'a scenario::Ensemble,
    pub(super) planned: &'a EnsemblePlan,
    pub(super) context: &'a JobContext<'a>,
}

impl Ensemble<'_> {
    pub(super) fn run<const N: usize, C: Crew<N>>(self, mut crew: C) -> Result<Summary, RunError> {
        let begun = Instant::now();
        let Self { plan, asked, planned, context } = self;
        let JobContext { log: path, control } = *context;
        let header = header(plan);
        let bodies: Vec<String> = plan.bodies.iter().map(|body| body.name.clone()).collect();
        let (mut log, mut ends, mut course) = open::<N>(context, &header, &bodies)?;
        let resumed_step = ends.count() * plan.steps;
        control.resumed_step.store(resumed_step, Ordering::Relaxed);
        control.steps_done.store(resumed_step, Ordering::Relaxed);
        if ends.count() == 0 {
            if plan.logs(Channel::EnsembleStatistics) {
                let mut starts = Spreads::<N>::default();
                for m in 0..planned.members {
                    starts.add(&crew.start(asked, m));
                }
                log.statistics(&starts.statistics(&bodies))?;
            }
            let mut logged = Logged { log: &mut log, course: &mut course, header: &header };
            if let Some(members) = crew.in_full(&self, &mut logged)? {
                for end in members {
                    self.ended(&mut log, &mut ends, end)?;
                }
                self.checkpoint(&mut log, ends.count())?;
            }
        }
        if !control.stopped() {
            self.others::<N>(C::ABREAST, &mut log, &mut ends)?;
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
        let (reached, energy) = crew.reached(plan, nominal);
        let ends_s = nominal.and_then(Member::end_s);
        let stopped =
            nominal.and_then(|end| super::stopped(plan, end.stopped_by? as usize, ends_s?));
        let end = End {
            stopped,
            ends_s,
            outcome,
            energy,
            reached,
            diagnosis: nominal
                .and_then(|end| serde_json::from_slice(end.diagnosis.as_bytes()).ok()),
            ensemble: Some(ensemble),
        };
        let summary = finish(Asked::of(plan), path, Some(log), (&figures, &course), end)?;
        control.steps_done.store(ends.steps(), Ordering::Relaxed);
        let made = ends.steps().saturating_sub(resumed_step);
        Ok(Summary {
            resumed_step,
            ns_per_step: ns_per_step(integrated, made),
            wall_s: begun.elapsed().as_secs_f64(),
            ..summary
        })
    }

    fn schedule(&self) -> Schedule {
        let Plan { step_s, steps, every, .. } = *self.plan;
        Schedule { step_s, steps, every }
    }

    /// Runs the members that have not ended yet, and writes their ends in their order.
    fn others<const N: usize>(
        &self,
        abreast: u64,
        log: &mut LogWriter,
        ends: &mut Ends<N>,
    ) -> Result<(), RunError> {
        let left: Vec<u64> = (0..self.planned.members).filter(|&m| !ends.contains(m)).collect();
        let mut open = 0;
        in_order(
            0..left.len() as u64,
            abreast,
            cores(),
            |turns| {
                let worker = Worker { ensemble: self, left: &left, turns };
                if self.plan.bodies.is_empty() {
                    assembled(self.plan, worker)
                } else {
                    assembled_bodies(self.plan, worker)
                }
            },
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
        let zeros = vec![0.0; self.plan.dimension.pow(2)];
        // A log takes checkpoints that could be of its bodies.
        let (body_momentum, numbers) =
            if self.plan.bodies.is_empty() { (zeros, Vec::new()) } else { (Vec::new(), zeros) };
        let checkpoint = messages::Checkpoint {
            step: ends * self.plan.steps,
            samples: log.samples(),
            body_momentum,
            numbers,
            figures: Some(Figures::default()),
            ..messages::Checkpoint::default()
        };
        log.checkpoint(&checkpoint)?;
        self.context.control.note_durable(log);
        Ok(())
    }
}

/// A thread that runs members, a few at a time.
struct Worker<'a> {
    ensemble: &'a Ensemble<'a>,
    /// Members that have not ended.
    left: &'a [u64],
    turns: &'a Turns<'a, Vec<Member>>,
}

impl Worker<'_> {
    fn work<const N: usize>(self, mut crew: impl Crew<N>) -> Option<()> {
        let Self { ensemble, left, turns } = self;
        let control: &Control = ensemble.context.control;
        while let Some(places) = turns.take() {
            let group = &left[places.start as usize..places.end as usize];
            let ends = crew.others(ensemble, group, |_| {
                control.steps_done.fetch_add(group.len() as u64, Ordering::Relaxed);
                !control.stopped() && !turns.is_closed()
            });
            turns.give(places, ends?)?;
        }
        Some(())
    }
}

impl Task for Worker<'_> {
    type Output = Option<()>;

    fn perform<const N: usize>(self, assembly: Assembly<N>) -> Option<()> {
        self.work(assembly)
    }
}

impl BodiesTask for Worker<'_> {
    type Output = Option<()>;

    fn perform<const N: usize>(self, assembly: BodiesAssembly<N>) -> Option<()> {
        self.work(assembly)
    }
}

/// Resumes the log of an interrupted run with the ends that it holds and its chart data, or begins
/// one.
fn open<const N: usize>(
    context: &JobContext<'_>,
    header: &LogHeader,
    bodies: &[String],
) -> Result<(LogWriter, Ends<N>, Course), LogError> {
    let (mut course, mut ends) = (Course::default(), Ends::none(bodies));
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
    Ok((begin_log(context, header)?, Ends::none(bodies), Course::default()))
}
