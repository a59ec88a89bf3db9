//! Ends the log of a job that is run no more, for a reason outside its steps.
//!
//! Invariant: nothing is computed of the run that brought its process down: no step is made and no sample taken.

use std::path::Path;

use super::summary::EnergySeen;
use super::{Asked, Diagnosis, End, Outcome, RunError, Summary, finish, header};
use crate::assemble::{Assembly, Task, assembled};
use crate::log::course::Course;
use crate::log::messages::Figures;
use crate::log::resume::Resumed;
use crate::log::resume::Seen;
use crate::log::writer::LogWriter;
use crate::plan::Plan;
use crate::solve::so::Mat;
use crate::solve::trajectory::Checkpoint;

/// Why a job is run no more.
#[derive(Clone, Copy, Debug)]
pub struct Reason<'a> {
    /// The failure code.
    pub code: &'a str,
    /// What happened, for a person.
    pub cause: &'a str,
    /// What to do about it, for a person.
    pub advice: &'a str,
}

/// Ends the log of `log` as failed: what interrupted runs left in whole chunks, or no sample at all, and why.
///
/// # Errors
/// If the log cannot be written.
pub fn give_up(plan: &Plan, log: &Path, reason: Reason<'_>) -> Result<Summary, RunError> {
    assembled(plan, GiveUp { plan, log, reason })
}

struct GiveUp<'a> {
    plan: &'a Plan,
    log: &'a Path,
    reason: Reason<'a>,
}

impl Task for GiveUp<'_> {
    type Output = Result<Summary, RunError>;

    fn perform<const N: usize>(self, assembly: Assembly<N>) -> Self::Output {
        let Self { plan, log, reason } = self;
        let header = header(plan);
        let mut course = Course::default();
        let seen = |seen: Seen<'_>| course.note_seen(&seen);
        let (writer, figures, reached) = match LogWriter::<N>::resume(log, &header, seen, || false)?
        {
            Some((writer, Resumed { mut checkpoint, figures, .. })) => {
                // Of an ensemble all members are counted; the log says where member 0 came to.
                checkpoint.step = checkpoint.step.min(plan.steps);
                (writer, figures, checkpoint)
            }
            None => {
                course = Course::default();
                let start = Checkpoint {
                    step: 0,
                    samples: 0,
                    attitude: plan
                        .formulation
                        .carries_attitude
                        .then_some(assembly.initial.attitude),
                    momentum: assembly.initial.momentum,
                    iterations: 0,
                    convergence: None,
                    work: 0.0,
                    impulse: Mat::zeros(),
                    own_time: None,
                };
                (LogWriter::create(log, &header)?, Figures::default(), start)
            }
        };
        let diagnosis = Diagnosis {
            code: reason.code.to_owned(),
            step: reached.step + 1,
            time_s: reached.step as f64 * plan.step_s,
            step_s: plan.step_s,
            stage: None,
            measured: None,
            limit: None,
            iterations: 0,
            increments: Vec::new(),
            cause: reason.cause.to_owned(),
            advice: reason.advice.to_owned(),
            advised_step_s: None,
            advised_largest_step_s: None,
        };
        let resumed_step = reached.step;
        let diagnosis = Some(diagnosis);
        let energy = EnergySeen::at_the_ends(&assembly.body, &assembly.initial, &reached.state());
        let energy = Some(energy);
        let end = End { outcome: Outcome::Failed, reached, diagnosis, ensemble: None, energy };
        let summary = finish(Asked::of(plan), log, writer, (&figures, &course), end)?;
        Ok(Summary { resumed_step, ..summary })
    }
}
