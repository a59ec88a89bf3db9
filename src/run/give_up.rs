//! Ends the log of a job that is run no more, for a reason outside its steps.
//!
//! Invariant: nothing of the run that brought its process down is computed: no step is made and no
//! sample taken.

use std::path::Path;

use super::bodies::LeftBodies;
use super::summary::EnergySeen;
use super::{Asked, Diagnosis, End, Outcome, Reached, RunError, Summary, finish, header};
use crate::assemble::{Assembly, Task, assembled, assembled_bodies};
use crate::log::course::Course;
use crate::log::messages;
use crate::log::writer::LogWriter;
use crate::plan::Plan;
use crate::solve::state::Checkpoint;

/// Reason why a job is run no more.
#[derive(Clone, Copy, Debug)]
pub struct Reason<'a> {
    /// The failure code.
    pub code: &'a str,
    /// Description of what happened, for a person.
    pub cause: &'a str,
    /// Advice, for a person.
    pub advice: &'a str,
}

/// Ends the log of `log` as failed, with the whole chunks that interrupted runs left, or no sample
/// at all, and the reason.
///
/// # Errors
/// If the log cannot be written.
pub fn give_up(plan: &Plan, log: &Path, reason: Reason<'_>) -> Result<Summary, RunError> {
    let header = header(plan);
    let mut course = Course::default();
    let resumed = LogWriter::resume(log, &header, &mut |seen| course.note_seen(&seen), &|| false)?;
    let (writer, checkpoint) = match resumed {
        Some((writer, mut checkpoint)) => {
            // All members of an ensemble are counted; the log says how far member 0 came.
            checkpoint.step = checkpoint.step.min(plan.steps);
            (writer, Some(checkpoint))
        }
        None => {
            course = Course::default();
            (LogWriter::create(log, &header)?, None)
        }
    };
    let found = checkpoint.as_ref();
    let (reached, energy) = if plan.bodies.is_empty() {
        let (reached, energy) = assembled(plan, Left { plan, checkpoint: found });
        (reached, Some(energy))
    } else {
        assembled_bodies(plan, LeftBodies { plan, checkpoint: found })
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
    let figures = checkpoint.and_then(|found| found.figures).unwrap_or_default();
    let end = End {
        stopped: None,
        outcome: Outcome::Failed,
        reached,
        ends_s: None,
        diagnosis: Some(diagnosis),
        ensemble: None,
        energy,
    };
    let summary = finish(Asked::of(plan), log, Some(writer), (&figures, &course), end)?;
    Ok(Summary { resumed_step, ..summary })
}

/// Results that interrupted runs left.
struct Left<'a> {
    plan: &'a Plan,
    /// The last checkpoint; `None` if there is none.
    checkpoint: Option<&'a messages::Checkpoint>,
}

impl Task for Left<'_> {
    type Output = (Reached, EnergySeen);

    fn perform<const N: usize>(self, assembly: Assembly<N>) -> Self::Output {
        let Assembly { body, initial, .. } = &assembly;
        let found = self.checkpoint.and_then(messages::Checkpoint::trajectory);
        let reached = found.unwrap_or_else(|| {
            let start = Checkpoint::at_start(initial);
            let carried = self.plan.formulation.carries_attitude;
            Checkpoint { attitude: start.attitude.filter(|_| carried), ..start }
        });
        let energy = EnergySeen::at_the_ends(body, initial, &reached.state());
        (Reached::from(&reached), energy)
    }
}
