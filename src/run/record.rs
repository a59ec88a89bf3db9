//! A user-defined system, a stepper for it and a start → samples → log.
//!
//! Invariant: such a log is as sound as that of a scenario; only that it cannot be run again from itself, and that a run
//! that is cut off does not resume, for the law may have changed.

use std::collections::BTreeMap;
use std::sync::atomic::Ordering;
use std::time::Instant;

use super::end::{Asked, End, Reached, finish};
use super::summary::{self, Advised};
use super::{JobContext, Outcome, Recorder, RunError, Summary, begin_log, ns_per_step};
use crate::log::course::Course;
use crate::log::messages::Figures;
use crate::log::scene::SceneGeometry;
use crate::log::schema::{Channel, Compression};
use crate::log::writer::LogHeader;
use crate::plan::MOST_DEFECT;
use crate::scenario::Scenario;
use crate::solve::state::State;
use crate::solve::stepper::Stepper;
use crate::solve::system::System;
use crate::solve::trajectory::{self, Ending, Schedule, Trajectory};

/// A chunk of the log is closed, and so is safe from a kill, after this many samples.
const SAMPLES_PER_CHUNK: u64 = 1000;

/// Description of a user-defined system in its log, and options of the log.
///
/// ```
/// # fn main() -> Result<(), Box<dyn std::error::Error>> {
/// use std::sync::Arc;
/// use vpd::run::{Control, JobContext, Recording};
/// use vpd::solve::hamiltonian::{Kinetic, Potential, RigidBody};
/// use vpd::solve::nonlinear::StopRule;
/// use vpd::solve::so::{self, Mat};
/// use vpd::solve::stepper::vpd_so3::VpdSo3;
/// use vpd::solve::tableau::Tableau;
/// use vpd::solve::state::State;
/// use vpd::solve::trajectory::Schedule;
///
/// /// `U = g_33^2 / 2`
/// #[derive(Debug)]
/// struct Hinge;
/// impl Potential<3> for Hinge {
///     fn energy(&self, g: &Mat<3>) -> f64 {
///         0.5 * g[(2, 2)] * g[(2, 2)]
///     }
///     fn gradient(&self, g: &Mat<3>) -> Mat<3> {
///         let mut slope = Mat::zeros();
///         slope[(2, 2)] = g[(2, 2)];
///         so::asym(&(g.transpose() * slope))
///     }
/// }
///
/// let body = RigidBody::new(Kinetic::of_moments([1.0; 3]), Vec::new(), 0.0)
///     .with_potential(Arc::new(Hinge));
/// let tableau = Tableau::gauss(2).ok_or("1 to 8 stages")?;
/// let mut stepper = VpdSo3::new(tableau, StopRule::default()).ok_or("at most 8 stages")?;
/// let start = State { attitude: Mat::identity(), momentum: so::hat(&[0.3, 0.0, 1.0]) };
/// let schedule = Schedule { step_s: 0.05, steps: 200, every: 1 };
///
/// let folder = tempfile::tempdir()?;
/// let log = folder.path().join("hinge.mcap");
/// let context = JobContext { log: &log, control: &Control::default() };
/// let summary =
///     Recording::new("hinge").run(&body, &mut stepper, &start, schedule, &context)?;
/// assert!(summary.energy.is_some_and(|energy| energy.max_abs_error < 1e-4));
/// # Ok(())
/// # }
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct Recording {
    /// A short name.
    pub name: String,
    /// Further entries of the record `vpd.job` about the system. Those that this program writes
    /// itself (`name`, `vpd_version`, `vpd_build`, `dimension`, `order`, `step_s`, `steps`,
    /// `every`) are not replaced.
    pub notes: BTreeMap<String, String>,
    /// The channels to log, and what is computed for them; by default all of a single run.
    pub channels: Vec<Channel>,
    /// Log time of t = 0, in nanoseconds since 1970. At first that of a scenario.
    pub epoch_ns: u64,
    /// Compression of chunks.
    pub compression: Compression,
    /// Objects that viewers draw; by default only the axes of the body. n = 3.
    pub scene: SceneGeometry,
}

impl Recording {
    /// Creates a recording of all channels under a name.
    pub fn new(name: impl Into<String>) -> Self {
        let single = |channel: &Channel| !channel.needs_ensemble();
        Self {
            name: name.into(),
            notes: BTreeMap::new(),
            channels: Channel::all().into_iter().filter(single).collect(),
            epoch_ns: Scenario::default_epoch_ns(),
            compression: Compression::default(),
            scene: SceneGeometry::default(),
        }
    }

    /// Carries `initial` along `schedule` by `stepper` and writes the log, with charts of the energy and of the distance
    /// from the group in it. Blocks; [`super::Control`] follows and stops it. A log that is there already is replaced, unless
    /// [`super::Control::replaces_nothing`].
    ///
    /// A step that fails is no error but a finished log, an [`Outcome::Failed`] and a diagnosis,
    /// which advises no step. Momentum drift is given as far as the system tells
    /// what is conserved. A warning that the run means little is not given: it is not known how
    /// much of the energy of the system moves.
    ///
    /// # Errors
    /// If the start is more than 1e-8 away from a state, or the step is not a number above zero: nothing is written then. If
    /// the log cannot be written, or the run is interrupted: no log is left then, unless the file system may take it later.
    pub fn run<const N: usize, Y: System<N> + ?Sized>(
        &self,
        system: &Y,
        stepper: &mut dyn Stepper<N, Y>,
        initial: &State<N>,
        schedule: Schedule,
        context: &JobContext<'_>,
    ) -> Result<Summary, RunError> {
        let begun = Instant::now();
        let JobContext { log, control } = *context;
        let defect = initial.defect();
        if !(defect <= MOST_DEFECT) {
            return Err(RunError::Invalid(format!(
                "the start is not a valid state: g^T g - I or the symmetric part of the momentum is {defect:.1e}, at most {MOST_DEFECT:e} is allowed"
            )));
        }
        if !(schedule.step_s > 0.0 && schedule.step_s.is_finite()) {
            let step_s = schedule.step_s;
            return Err(RunError::Invalid(format!(
                "{step_s:?} s given, a step must be longer than zero"
            )));
        }
        let header = self.header::<N>(schedule, stepper.order());
        let writer = begin_log(context, &header)?;
        let (figures, course) = (Figures::default(), Course::default());
        let mut recorder = Recorder::of(writer, figures, course, control, &header);
        let integrating = Instant::now();
        let Trajectory { ending, reached, time_s } = trajectory::integrate(
            system,
            stepper,
            initial,
            schedule,
            Channel::observables(self.channels.iter().copied()),
            &mut recorder,
            |steps| control.go_on(steps),
        )?;
        let inside = integrating.elapsed().saturating_sub(recorder.elsewhere);
        control.steps_done.store(reached.step, Ordering::Relaxed);
        let Schedule { step_s, steps, .. } = schedule;
        let (outcome, diagnosis) = match &ending {
            Ending::Completed | Ending::Stopped(_) => (Outcome::Succeeded, None),
            Ending::Cancelled if !control.cancelled.load(Ordering::Relaxed) => {
                return Err(RunError::Interrupted);
            }
            Ending::Cancelled => (Outcome::Cancelled, None),
            Ending::Failed(failure) => {
                let advised = Advised::Untried;
                let reported = summary::diagnosis(failure, None, reached.step, step_s, advised);
                (Outcome::Failed, Some(reported))
            }
        };
        let steps_done = reached.step;
        let Recorder { keep, figures, course, .. } = recorder;
        let reached = Reached::from(&reached);
        let stopped = match ending {
            Ending::Stopped(number) => {
                Some(format!("condition {number} of the system at t = {time_s} s"))
            }
            _ => None,
        };
        let ends_s = Some(time_s);
        let end =
            End { outcome, reached, ends_s, diagnosis, stopped, ensemble: None, energy: None };
        let asked = Asked::steps(step_s, steps);
        let summary = finish(asked, log, keep.writer(), (&figures, &course), end)?;
        Ok(Summary {
            ns_per_step: ns_per_step(inside, steps_done),
            wall_s: begun.elapsed().as_secs_f64(),
            ..summary
        })
    }

    fn header<const N: usize>(&self, schedule: Schedule, order: u32) -> LogHeader {
        let Schedule { step_s, steps, every } = schedule;
        let mut job = self.notes.clone();
        job.extend([
            ("vpd_version".to_owned(), env!("CARGO_PKG_VERSION").to_owned()),
            ("vpd_build".to_owned(), env!("VPD_BUILD").to_owned()),
            ("name".to_owned(), self.name.clone()),
            ("dimension".to_owned(), N.to_string()),
            ("order".to_owned(), order.to_string()),
            ("step_s".to_owned(), super::json(&step_s)),
            ("steps".to_owned(), steps.to_string()),
            ("every".to_owned(), every.to_string()),
        ]);
        LogHeader {
            dimension: N,
            epoch_ns: self.epoch_ns,
            channels: self.channels.clone(),
            members: vec![0],
            bodies: Vec::new(),
            compression: self.compression,
            samples_per_chunk: SAMPLES_PER_CHUNK,
            scenario_json: None,
            job,
            scene: self.scene.clone(),
        }
    }
}
