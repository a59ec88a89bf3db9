//! 3 · The one door: plan → body and stepper → samples → log. [`Recording`] is a door for a system that no scenario
//! describes: system and stepper → samples → log. [`Simulation`] is one for a caller who steps, and applies torques.
//!
//! Invariant: a numerical failure is a [`Summary`] with a [`Diagnosis`] and a finished log; only the log
//! itself can make a run an error.

use std::collections::BTreeMap;
use std::fs::File;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use serde::Serialize;
use thiserror::Error;

use crate::assemble::{Assembly, Task, assembled, assembled_bodies};
#[cfg(feature = "live")]
use crate::live::{Live, Show};
use crate::log::columns::Columns;
use crate::log::course::{Course, LogChart};
use crate::log::messages::{self, Figures};
use crate::log::writer::{LogHeader, LogWriter};
use crate::log::{LogError, log_time};
use crate::plan::Plan;
use crate::solve::bodies::trajectory::Sample as BodiesSample;
use crate::solve::failure::Failure;
use crate::solve::state::{Checkpoint, Derivatives, Pace};
use crate::solve::trajectory::{
    self, Ending, Observables, Origin, Sample, Schedule, Sink, Trajectory,
};
use crate::study::Watch;

mod advice;
mod bodies;
mod end;
pub(crate) mod ensemble;
mod geometry;
mod give_up;
mod potential;
mod record;
mod simulation;
mod summary;

use advice::{Broken, Patience};
use bodies::BodiesRun;
use end::{Asked, End, Reached, finish};
use ensemble::Ensemble;
pub use give_up::{Reason, give_up};
pub use potential::{PotentialError, PotentialOfRows, collect_with, execute_with};
pub use record::Recording;
pub use simulation::{Advanced, Simulation};
use summary::{Advised, EnergySeen};
pub use summary::{
    BodySpread, ControlSummary, CovarianceSummary, DerivativesSummary, Diagnosis, EnergySummary,
    EnsembleSummary, FinalBody, FinalState, MomentumSummary, OrthogonalitySummary, Outcome,
    SolverSummary, Summary,
};

/// Inputs that a run shares with other threads.
#[derive(Clone, Copy, Debug)]
pub struct JobContext<'a> {
    /// Path of the finished log. If an interrupted run of the same job left its log there, this one
    /// goes on from it.
    pub log: &'a Path,
    /// Handle to follow and stop the run.
    pub control: &'a Control,
}

/// Handle to follow and stop a run from other threads.
#[derive(Debug, Default)]
pub struct Control {
    /// Steps done so far, those of interrupted runs included; the run writes it.
    pub steps_done: AtomicU64,
    /// The step at which this run resumed an interrupted one; the run writes it.
    pub resumed_step: AtomicU64,
    /// The step up to which the log is on the disk; the run writes it.
    pub durable_step: AtomicU64,
    /// Bytes of the unfinished log that are on the disk, no fewer than up to `durable_step`; the run writes it.
    pub durable_bytes: AtomicU64,
    /// Whether the run is to end after its current step, with a finished log: see
    /// [`Control::cancel`].
    pub cancelled: AtomicBool,
    /// Whether it is to end there with a log that a later run goes on from: see
    /// [`Control::interrupt`].
    pub interrupted: AtomicBool,
    /// Whether an existing log at the same path stays, and the run is refused; otherwise it is
    /// replaced. The log of a failed run of the same name is replaced in any case.
    pub replaces_nothing: bool,
    /// Handle to stop the search for a method and a step.
    pub settling: Watch,
    /// The run is cancelled at this step, as if `cancelled` had been set there.
    pub cancelled_at: Option<u64>,
    /// File in which the run writes each of its steps, eight bytes: when its process is found dead,
    /// they show whether it always dies at the same place. It costs a system call each, so only
    /// suspects are traced.
    pub trace: Option<File>,
    /// Live view on which viewers follow.
    #[cfg(feature = "live")]
    pub live: Option<Arc<Live>>,
}

impl Control {
    /// Ends the run after its current step, with a finished log.
    pub fn cancel(&self) {
        self.cancelled.store(true, Ordering::Relaxed);
        self.settling.cancelled.store(true, Ordering::Relaxed);
    }

    /// Ends the run after its current step, with a log that a later run goes on from.
    pub fn interrupt(&self) {
        self.interrupted.store(true, Ordering::Relaxed);
        self.settling.cancelled.store(true, Ordering::Relaxed);
    }

    /// Takes note of a step; returns whether there is to be another one.
    fn go_on(&self, steps: u64) -> bool {
        self.steps_done.store(steps, Ordering::Relaxed);
        self.note(steps);
        if self.cancelled_at == Some(steps) {
            self.cancelled.store(true, Ordering::Relaxed);
        }
        !self.stopped()
    }

    /// Takes note of how far the log is on the disk.
    fn note_durable(&self, log: &LogWriter) {
        let step = log.durable_step();
        // A reader of the step finds at least its bytes.
        self.durable_bytes.store(log.durable_bytes(), Ordering::Release);
        self.durable_step.store(step, Ordering::Release);
    }

    /// Leaves a note of how far the run came.
    fn note(&self, steps: u64) {
        #[cfg(unix)]
        if let Some(trace) = &self.trace {
            // A trace that cannot be written is left out.
            let _ = std::os::unix::fs::FileExt::write_all_at(trace, &steps.to_le_bytes(), 0);
        }
    }

    /// Returns whether the run is to end.
    fn stopped(&self) -> bool {
        self.cancelled.load(Ordering::Relaxed) || self.interrupted.load(Ordering::Relaxed)
    }
}

/// Reason why a run has no result.
#[derive(Debug, Error)]
pub enum RunError {
    /// The log could not be written.
    #[error(transparent)]
    Log(LogError),
    /// The start of a [`Recording`] is no state, or its schedule is not valid.
    #[error("{0}")]
    Invalid(String),
    /// It was interrupted; the next run resumes its log.
    #[error("the run was interrupted; the same command resumes it from its log")]
    Interrupted,
}

impl RunError {
    /// Returns the failure code of a job that ends so.
    pub fn code(&self) -> &'static str {
        match self {
            Self::Log(error) => error.code(),
            Self::Invalid(_) => "invalid_input",
            Self::Interrupted => "interrupted",
        }
    }
}

impl From<LogError> for RunError {
    fn from(error: LogError) -> Self {
        match error {
            LogError::Interrupted { .. } => Self::Interrupted,
            error => Self::Log(error),
        }
    }
}

/// Runs a plan to its end and writes its log; the log of a run that was interrupted is resumed where it ended, with the
/// same bytes in the end. Blocks.
///
/// # Errors
/// If the log cannot be written: no log is left then, unless the file system may take it later. If the run is
/// interrupted: then an unfinished one is.
pub fn execute(plan: &Plan, context: &JobContext<'_>) -> Result<Summary, RunError> {
    if !plan.bodies.is_empty() {
        return assembled_bodies(plan, BodiesRun { plan, context, kept: Kept::Log });
    }
    assembled(plan, Run { plan, context, kept: Kept::Log, potential: None })
}

/// Runs a plan to its end and keeps its samples in memory, and writes no log. The states are those of the log, to the bit. Blocks.
///
/// # Errors
/// If the run is interrupted, or a log could not hold its times. An ensemble is refused: its members are read from its log.
pub fn collect(plan: &Plan, control: &Control) -> Result<(Summary, Columns), RunError> {
    if plan.ensemble.is_some() {
        return Err(RunError::Invalid("an ensemble needs a log for its members".to_owned()));
    }
    let mut columns = columns(plan);
    let context = JobContext { log: Path::new(""), control };
    let kept = Kept::Memory(&mut columns);
    let summary = if plan.bodies.is_empty() {
        assembled(plan, Run { plan, context: &context, kept, potential: None })
    } else {
        assembled_bodies(plan, BodiesRun { plan, context: &context, kept })
    }?;
    Ok((summary, columns))
}

fn columns(plan: &Plan) -> Columns {
    let channels = plan.channels.iter().map(|channel| channel.topic).collect();
    Columns::new(channels, plan.asked.epoch_ns(), plan.samples)
}

/// Where the samples of a run are kept.
enum Kept<'a> {
    /// In its log.
    Log,
    /// Here alone.
    Memory(&'a mut Columns),
}

/// A run whose samples are kept.
struct Run<'a> {
    plan: &'a Plan,
    context: &'a JobContext<'a>,
    kept: Kept<'a>,
    /// One of the caller's own, in addition to the terms.
    potential: Option<Arc<dyn PotentialOfRows>>,
}

impl Task for Run<'_> {
    type Output = Result<Summary, RunError>;

    fn perform<const N: usize>(self, assembly: Assembly<N>) -> Self::Output {
        let Self { plan, context, kept, potential } = self;
        match (&plan.asked.ensemble, &plan.ensemble) {
            (Some(asked), Some(planned)) => {
                Ensemble { plan, asked, planned, context }.run(assembly)
            }
            _ => run(plan, assembly, context, kept, potential),
        }
    }
}

fn run<const N: usize>(
    plan: &Plan,
    mut assembly: Assembly<N>,
    context: &JobContext<'_>,
    kept: Kept<'_>,
    potential: Option<Arc<dyn PotentialOfRows>>,
) -> Result<Summary, RunError> {
    let is_own = potential.is_some();
    if let Some(potential) = potential {
        assembly.body = potential::added(assembly.body, potential, &assembly.initial.attitude)?;
    }
    let Assembly { body, stepper, initial, .. } = &mut assembly;
    let begun = Instant::now();
    let schedule = Schedule { step_s: plan.step_s, steps: plan.steps, every: plan.every };
    let control = context.control;
    let (mut recorder, checkpoint) = match kept {
        Kept::Log if is_own => {
            let mut header = header(plan);
            header.scenario_json = None;
            header.job.retain(|key, _| !matches!(key.as_str(), "scenario" | "plan"));
            let writer = begin_log(context, &header)?;
            let (figures, course) = (Figures::default(), Course::default());
            (Recorder::of(writer, figures, course, control, &header), None)
        }
        Kept::Log => Recorder::open(context, &header(plan))?,
        Kept::Memory(columns) => (Recorder::in_memory(plan, columns, control), None),
    };
    let checkpoint = checkpoint.and_then(|found| found.trajectory());
    let resumed_step = checkpoint.as_ref().map_or(0, |checkpoint| checkpoint.step);
    control.resumed_step.store(resumed_step, Ordering::Relaxed);
    let integrating = Instant::now();
    let end = trajectory::integrate(
        body,
        stepper.as_mut(),
        Origin { initial, checkpoint: checkpoint.as_ref() },
        schedule,
        plan.observables(),
        &mut recorder,
        |steps| control.go_on(steps),
    );
    let Trajectory { ending, reached, time_s } = match end {
        Ok(end) => end,
        Err(error) => return Err(recorder.keep.left(error)),
    };
    let inside = integrating.elapsed().saturating_sub(recorder.elsewhere);
    let steps_done = reached.step;
    control.steps_done.store(steps_done, Ordering::Relaxed);
    let ended = outcome(control, &ending, |failure| {
        if is_own {
            // What a law of the caller's own costs is not known.
            let untried = Advised::Untried;
            return summary::diagnosis(failure, None, reached.step, plan.step_s, untried);
        }
        let asked = Some(&plan.asked);
        let broken = Broken { initial, reached: &reached, schedule, asked, failure };
        let patience = Patience::of(plan, control, 1);
        let own_steps = advice::own_steps(plan, body);
        advice::diagnosis(body, stepper.as_mut(), &broken, own_steps, patience)
    });
    let Some((outcome, diagnosis)) = ended else {
        return Err(recorder.keep.left(RunError::Interrupted));
    };
    let Recorder { keep, figures, course, .. } = recorder;
    let energy = Some(EnergySeen::at_the_ends(body, initial, &reached.state()));
    let derivatives = DerivativesSummary::of(&reached, initial);
    let covariance = CovarianceSummary::of(&reached);
    let mut reached = Reached::from(&reached);
    (reached.derivatives, reached.covariance) = (derivatives, covariance);
    let stopped = match ending {
        Ending::Stopped(number) => stopped(plan, number, time_s),
        _ => None,
    };
    let ends_s = Some(time_s);
    let end = End { outcome, reached, ends_s, diagnosis, stopped, ensemble: None, energy };
    let summary = finish(Asked::of(plan), context.log, keep.writer(), (&figures, &course), end)?;
    Ok(Summary {
        resumed_step,
        ns_per_step: ns_per_step(inside, steps_done - resumed_step),
        wall_s: begun.elapsed().as_secs_f64(),
        ..summary
    })
}

/// Returns the time of a step of those that were made, in nanoseconds; 0 where none was.
fn ns_per_step(inside: Duration, made: u64) -> f64 {
    if made == 0 { 0.0 } else { inside.as_nanos() as f64 / made as f64 }
}

/// Returns which condition stopped a run, and when, in words.
fn stopped(plan: &Plan, number: usize, time_s: f64) -> Option<String> {
    let stop = plan.asked.until.get(number)?;
    Some(format!("{stop} at t = {time_s:.9} s (/until/{number})"))
}

/// Returns how a run ended, with the diagnosis of a step that failed; `None` if it was cut off, and goes on later.
fn outcome(
    control: &Control,
    ending: &Ending,
    diagnosis: impl FnOnce(&Failure) -> Diagnosis,
) -> Option<(Outcome, Option<Diagnosis>)> {
    match ending {
        Ending::Completed | Ending::Stopped(_) => Some((Outcome::Succeeded, None)),
        Ending::Cancelled => {
            control.cancelled.load(Ordering::Relaxed).then_some((Outcome::Cancelled, None))
        }
        Ending::Failed(failure) => {
            let diagnosis = diagnosis(failure);
            // Stopping the search for a smaller step stops the run before the step that failed.
            if control.interrupted.load(Ordering::Relaxed) {
                return None;
            }
            let whole = !control.stopped();
            Some(if whole {
                (Outcome::Failed, Some(diagnosis))
            } else {
                (Outcome::Cancelled, None)
            })
        }
    }
}

/// What takes the samples of a run.
enum Keep<'a> {
    Log(Box<LogWriter>),
    Memory {
        columns: &'a mut Columns,
        /// The steps begin anew where a chunk of the log would end, for the same states.
        samples_per_chunk: u64,
        in_chunk: u64,
    },
}

impl Keep<'_> {
    /// Leaves a log to be resumed if the run was interrupted; returns the error with which it ends.
    fn left(self, error: RunError) -> RunError {
        if let (Self::Log(writer), RunError::Interrupted) = (self, &error) {
            writer.leave();
        }
        error
    }

    fn writer(self) -> Option<LogWriter> {
        match self {
            Self::Log(writer) => Some(*writer),
            Self::Memory { .. } => None,
        }
    }
}

/// Passes samples on, keeps their figures, and measures the time that is not the integrator's.
struct Recorder<'a> {
    keep: Keep<'a>,
    figures: Figures,
    /// Data for the charts in the log.
    course: Course,
    epoch_ns: u64,
    elsewhere: Duration,
    control: &'a Control,
    #[cfg(feature = "live")]
    show: Option<Show>,
}

impl<'a> Recorder<'a> {
    /// Resumes the log of an interrupted run, or begins one.
    fn open(
        context: &JobContext<'a>,
        header: &LogHeader,
    ) -> Result<(Self, Option<messages::Checkpoint>), LogError> {
        let JobContext { log, control } = *context;
        let mut course = Course::default();
        let stopped = || control.interrupted.load(Ordering::Relaxed);
        let resumed =
            LogWriter::resume(log, header, &mut |seen| course.note_seen(&seen), &stopped)?;
        let (writer, figures, checkpoint) = match resumed {
            Some((writer, checkpoint)) => {
                (writer, checkpoint.figures.unwrap_or_default(), Some(checkpoint))
            }
            None => {
                course = Course::default();
                (begin_log(context, header)?, Figures::default(), None)
            }
        };
        Ok((Self::of(writer, figures, course, control, header), checkpoint))
    }

    /// Keeps the samples of a run in memory.
    fn in_memory(plan: &Plan, columns: &'a mut Columns, control: &'a Control) -> Self {
        let samples_per_chunk = plan.samples_per_chunk;
        Self {
            keep: Keep::Memory { columns, samples_per_chunk, in_chunk: 0 },
            figures: Figures::default(),
            course: Course::default(),
            epoch_ns: plan.asked.epoch_ns(),
            elsewhere: Duration::ZERO,
            control,
            #[cfg(feature = "live")]
            show: None,
        }
    }

    /// Goes on with a writer, what its samples have shown so far, and the header of its log.
    fn of(
        writer: LogWriter,
        figures: Figures,
        course: Course,
        control: &'a Control,
        header: &LogHeader,
    ) -> Self {
        Self {
            keep: Keep::Log(Box::new(writer)),
            figures,
            course,
            epoch_ns: header.epoch_ns,
            elsewhere: Duration::ZERO,
            control,
            #[cfg(feature = "live")]
            show: show(control, header),
        }
    }
}

impl Recorder<'_> {
    /// Is a checkpoint wanted after the last sample?
    fn is_checkpoint_due(&self) -> bool {
        match &self.keep {
            Keep::Log(writer) => writer.wants_checkpoint(),
            Keep::Memory { samples_per_chunk, in_chunk, .. } => in_chunk == samples_per_chunk,
        }
    }

    /// Keeps a checkpoint, which is made only for a log.
    fn keep_checkpoint(
        &mut self,
        checkpoint: impl FnOnce() -> messages::Checkpoint,
    ) -> Result<(), RunError> {
        match &mut self.keep {
            Keep::Memory { in_chunk, .. } => {
                *in_chunk = 0;
                Ok(())
            }
            Keep::Log(writer) => {
                let begun = Instant::now();
                let result = writer.checkpoint(&checkpoint());
                self.elsewhere += begun.elapsed();
                Ok(result?)
            }
        }
    }
}

impl<const N: usize> Sink<N> for Recorder<'_> {
    type Error = RunError;

    fn record(&mut self, sample: &Sample<N>) -> Result<(), RunError> {
        // The last sample of a run that is cut off here has no place in the log of the whole.
        if self.control.interrupted.load(Ordering::Relaxed) {
            return Err(RunError::Interrupted);
        }
        self.figures.keep(sample);
        let epoch_ns = self.epoch_ns;
        match &mut self.keep {
            Keep::Memory { columns, in_chunk, .. } => {
                *in_chunk += 1;
                let Sample { time_s, .. } = *sample;
                let held = columns.record(sample);
                if held { Ok(()) } else { Err(LogError::Time { time_s, epoch_ns }.into()) }
            }
            Keep::Log(writer) => {
                let begun = Instant::now();
                note(&mut self.course, epoch_ns, sample);
                #[cfg(feature = "live")]
                if let Some(show) = &self.show {
                    show.sample(sample);
                }
                let result = writer.record(sample);
                self.control.note_durable(writer);
                self.elsewhere += begun.elapsed();
                Ok(result?)
            }
        }
    }

    fn wants_checkpoint(&self) -> bool {
        self.is_checkpoint_due()
    }

    fn checkpoint(&mut self, checkpoint: &Checkpoint<N>) -> Result<(), RunError> {
        let figures = self.figures;
        self.keep_checkpoint(|| messages::Checkpoint::of(checkpoint, figures))
    }
}

/// Puts the run on show, if there is a stage.
#[cfg(feature = "live")]
fn show(control: &Control, header: &LogHeader) -> Option<Show> {
    let announce = |live: &Arc<Live>| live.announce(header.epoch_ns, header.scene.clone());
    control.live.as_ref().map(announce)
}

/// Begins a log, over what stands in its place if that may go.
fn begin_log(context: &JobContext<'_>, header: &LogHeader) -> Result<LogWriter, LogError> {
    if context.control.replaces_nothing {
        LogWriter::create_new(context.log, header)
    } else {
        LogWriter::create(context.log, header)
    }
}

/// Takes note of a sample for the charts.
fn note<const N: usize>(course: &mut Course, epoch_ns: u64, sample: &Sample<N>) {
    let errors = [sample.energy_error, sample.orthogonality_error];
    note_errors(course, epoch_ns, sample.time_s, errors, sample.pace);
    if let (Some(pointed), Some(time_ns)) = (sample.pointing, log_time(epoch_ns, sample.time_s)) {
        course.note(time_ns, LogChart::Pointing, pointed.axis_error_rad);
    }
    let spread = sample.derivatives.as_ref().and_then(Derivatives::attitude_spread_rad);
    if let (Some(spread), Some(time_ns)) = (spread, log_time(epoch_ns, sample.time_s)) {
        course.note(time_ns, LogChart::Spread, spread);
    }
}

/// Does the same of several bodies, as far as it is `asked` for: their samples have all.
fn note_bodies<const N: usize>(
    course: &mut Course,
    epoch_ns: u64,
    asked: Observables,
    sample: &BodiesSample<N>,
) {
    let energy = sample.energy_error.filter(|_| asked.energy);
    let orthogonality = sample.orthogonality_error.filter(|_| asked.orthogonality);
    let pace = sample.pace.filter(|_| asked.pace);
    note_errors(course, epoch_ns, sample.time_s, [energy, orthogonality], pace);
}

/// Takes note of the errors of a sample, of energy and orthogonality, and of its pace: of one body or several.
fn note_errors(
    course: &mut Course,
    epoch_ns: u64,
    time_s: f64,
    [energy, orthogonality]: [Option<f64>; 2],
    pace: Option<Pace>,
) {
    // The writer refuses a time that a log cannot hold.
    let Some(time_ns) = log_time(epoch_ns, time_s) else { return };
    for (chart, value) in [
        (LogChart::Energy, energy),
        (LogChart::Orthogonality, orthogonality),
        (LogChart::Pace, pace.map(|pace| 1.0 / pace.least_sigma)),
    ] {
        if let Some(value) = value {
            course.note(time_ns, chart, value);
        }
    }
}

/// Returns the description of the job in the log before its first sample.
fn header(plan: &Plan) -> LogHeader {
    let scenario = &plan.asked;
    let mut job = BTreeMap::from([
        ("vpd_version".to_owned(), env!("CARGO_PKG_VERSION").to_owned()),
        ("vpd_build".to_owned(), env!("VPD_BUILD").to_owned()),
        ("name".to_owned(), scenario.name().to_owned()),
        ("scenario".to_owned(), json(scenario)),
        ("plan".to_owned(), json(&plan.on_a_common_machine())),
    ]);
    // Meaning of the errors in the log, where that is no plain conservation.
    for (key, statement) in [
        ("energy_balance", &plan.balance),
        ("momentum_balance", &plan.momentum_balance),
        ("jacobi_integral", &plan.jacobi_integral),
    ] {
        job.extend(statement.clone().map(|statement| (key.to_owned(), statement)));
    }
    LogHeader {
        dimension: plan.dimension,
        epoch_ns: scenario.epoch_ns(),
        channels: plan.channels.iter().map(|channel| channel.topic).collect(),
        members: plan.ensemble.as_ref().map_or(vec![0], |ensemble| ensemble.in_full.clone()),
        bodies: geometry::bodies(plan),
        compression: scenario.log.compression,
        samples_per_chunk: plan.samples_per_chunk,
        scenario_json: Some(scenario.to_json()),
        job,
        scene: geometry::scene(plan),
    }
}

fn json(value: &impl Serialize) -> String {
    serde_json::to_string(value).expect("figures and names are JSON by construction")
}
