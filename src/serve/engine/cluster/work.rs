//! A worker: Temporal gives it jobs, it runs them in a directory of its own, and the bucket gets
//! the results.
//!
//! ```text
//! look → fetch what is durable of the log → note the attempt → run, and meanwhile keep the log → upload → publish
//! ```
//!
//! Invariants: a worker keeps nothing that another one needs. Everything that it reports as durable
//! is in the bucket. It stops when it is cancelled, and ends a job as cancelled only if the bucket
//! says that a client asked for that; its result counts only if it is the first.

// The items that the macros generate for a workflow and its activity have to be as open as these.
#![allow(unreachable_pub)]

use std::collections::HashMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};
use temporalio_client::RetryPolicy;
use temporalio_macros::{activities, workflow, workflow_methods};
use temporalio_sdk::activities::{ActivityContext, ActivityError};
use temporalio_sdk::runtime::PollerBehavior;
use temporalio_sdk::runtime::worker_tuner::{FixedSizeSlotSupplier, TunerHolder};
use temporalio_sdk::{
    ActivityCancellationType, ActivityOptions, Runtime, Worker, WorkerOptions,
    WorkflowCancellationToken, WorkflowContext, WorkflowResult,
};
use tokio::sync::oneshot;
use uuid::Uuid;

use super::sweeps::{self, PartTask, sweep_object};
use super::{ClusterConfig, ClusterError, LOOK, connect, lock};
use crate::advise::Settled;
use crate::log::part_path;
use crate::log::resume::last_checkpoint;
use crate::run::Control;
use crate::scenario::Scenario;
use crate::serve::apart::{self, MAX_FRUITLESS};
use crate::serve::errand::{Broken, Done, Errand};
use crate::serve::job::{Fault, Job, State};
use crate::serve::store::bucket::{Bucket, Held};
use crate::serve::store::{DataLock, KeptPlan, LogSum, Record, StoreError};
use crate::serve::{Limits, ServeError, chain, give_way, shortened};
use crate::study::Watch;

/// Number of signs of life in the time of a lease.
const BEATS_IN_A_LEASE: u32 = 4;

/// Part of a lease without a sign of life after which a job goes to another worker. A process that
/// is frozen, but not dead, may be handed its job once more, by the one request that it left open:
/// twice this time, the pauses after it, and the half second by which Temporal is late each time
/// stay below two leases.
const SILENCE: f64 = 0.7;

/// Longest pause before a job is given to a worker again, in leases.
const PAUSE: f64 = 0.1;

/// The first pause before a job is given to a worker again; the next ones are twice as long each.
const FIRST_PAUSE: Duration = Duration::from_millis(100);

/// The longest time between two pieces of an unfinished log that go to the bucket.
const LONGEST_PACE: Duration = Duration::from_secs(5);

/// The shortest time between two signs of life that are sent: less than a quarter of any lease.
const THROTTLE: Duration = Duration::from_millis(500);

/// The longest pause before a part of a sweep is given to a worker again: it is given up after some
/// attempts, which are to take longer than what is wrong for a moment.
const LONGEST_PAUSE: Duration = Duration::from_secs(10);

/// Limit that no job reaches.
const EVER: Duration = Duration::from_secs(90 * 86_400);

/// Time that a worker that stops waits for its jobs.
const DRAIN: Duration = Duration::from_secs(9);

/// Longest text of an error that is sent to Temporal, bytes. It keeps the text, passes it on with each
/// attempt, and refuses what is very long; the worker's own log has all of it.
const MAX_TOLD: usize = 1024;

/// Largest number of own processes that may end while the log of an abandoned job is ended.
const MAX_GIVING_UP: u32 = 3;

/// Configuration of a worker.
#[derive(Clone, Debug)]
pub struct WorkConfig {
    /// Addresses of record and queue.
    pub cluster: ClusterConfig,
    /// A directory for the logs that are being written; of this worker alone, and emptied at its start.
    pub scratch: PathBuf,
    /// Number of jobs that run at once, at least 1.
    pub workers: usize,
    /// Limits of a job whose method and step this worker settles.
    pub limits: Limits,
    /// The `vpd` program, which runs jobs that may have ended a worker in a process of their own.
    pub program: Option<PathBuf>,
}

/// Input of a workflow.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Task {
    pub(super) id: Uuid,
    pub(super) lease_s: f64,
}

/// Contents of a sign of life.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub(in crate::serve) struct Beat {
    pub(super) steps_done: u64,
    /// The step up to which the log is in the bucket.
    pub(super) durable_step: u64,
    pub(super) eta_s: Option<f64>,
}

/// Returns how work is handed out: how long a worker may be silent, and the pauses before the work
/// is tried again, at most `attempts` times, or without a limit if that is 0.
fn handed_out(lease_s: f64, longest_pause: Duration, attempts: u32) -> (Duration, RetryPolicy) {
    let pauses = RetryPolicy::builder()
        .initial_interval(FIRST_PAUSE.min(longest_pause))
        .backoff_coefficient(2.0)
        .maximum_interval(longest_pause)
        .maximum_attempts(attempts)
        .build();
    (Duration::from_secs_f64(lease_s * SILENCE), pauses)
}

/// Returns the time in which a worker has to say what the next activity of a workflow is, which
/// takes it milliseconds: a frozen one does not hold up a new job for longer.
pub(super) fn task_timeout(lease: Duration) -> Duration {
    // 10 s is Temporal's own timeout.
    Duration::from_secs((lease / BEATS_IN_A_LEASE).as_secs().clamp(1, 10))
}

/// The workflow of a job: one activity.
#[workflow]
#[derive(Default)]
pub struct Flow;

#[workflow_methods]
impl Flow {
    /// Gives the job to workers until one brings it to its end.
    #[run]
    pub async fn run(ctx: &mut WorkflowContext<Self>, task: Task) -> WorkflowResult<()> {
        let asked = || {
            let longest_pause = Duration::from_secs_f64(task.lease_s * PAUSE);
            let (silence, pauses) = handed_out(task.lease_s, longest_pause, 0);
            ActivityOptions::with_start_to_close_timeout(EVER)
                .heartbeat_timeout(silence)
                // A job that was cancelled still ends in order.
                .cancellation_type(ActivityCancellationType::WaitCancellationCompleted)
                .retry_policy(pauses)
        };
        let turn = ctx.execute_activity(Hands::turn, task.clone(), asked().build()).await;
        if turn.is_err() {
            // The job was cancelled before its worker could end it: another one does.
            let apart = asked().cancellation_token(WorkflowCancellationToken::new()).build();
            ctx.execute_activity(Hands::turn, task, apart).await?;
        }
        Ok(())
    }
}

/// Returns the name of the workflow of a part of a sweep.
pub(super) fn part_flow_id(task: &PartTask) -> String {
    format!("sweep-{}-{}-{}", task.digest, task.build, task.part)
}

/// The workflow of a part of a sweep: one activity.
#[workflow]
#[derive(Default)]
pub struct Part;

#[workflow_methods]
impl Part {
    /// Gives the part to workers until one has made it, or the allowed number has failed.
    #[run]
    pub async fn run(ctx: &mut WorkflowContext<Self>, task: PartTask) -> WorkflowResult<()> {
        let (silence, pauses) = handed_out(task.lease_s, LONGEST_PAUSE, MAX_FRUITLESS);
        let options = ActivityOptions::with_start_to_close_timeout(EVER)
            .heartbeat_timeout(silence)
            .retry_policy(pauses)
            .build();
        ctx.execute_activity(Hands::part, task, options).await?;
        Ok(())
    }
}

/// Reason why a turn is to be tried again.
#[derive(Debug, thiserror::Error)]
enum Later {
    #[error("the worker stops")]
    Stopping,
    #[error(transparent)]
    Store(#[from] StoreError),
    #[error("the worker could not use its disk")]
    Disk(#[from] std::io::Error),
    #[error("{0}")]
    Trouble(String),
}

/// An error as it is sent to Temporal.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
struct Told(String);

impl Told {
    fn of(error: &dyn std::error::Error) -> Self {
        Self(shortened(chain(error), MAX_TOLD))
    }
}

/// State of a worker; copies are the same worker.
#[derive(Clone)]
pub struct Hands(Arc<Inner>);

struct Inner {
    bucket: Bucket,
    scratch: PathBuf,
    limits: Limits,
    program: Option<PathBuf>,
    stopping: AtomicBool,
    /// Jobs that run at this moment.
    running: Mutex<HashMap<Uuid, Arc<Control>>>,
}

/// A job in the hands of a worker.
struct Turn {
    id: Uuid,
    control: Arc<Control>,
    /// The step up to which the log is in the bucket.
    kept_step: AtomicU64,
    /// Interval at which pieces of the log go there.
    pace: Duration,
    begun: Instant,
}

impl Turn {
    fn beat(&self) -> Beat {
        let control = &self.control;
        let steps_done = control.steps_done.load(Ordering::Relaxed);
        // What was resumed came from the bucket.
        let resumed_step = control.resumed_step.load(Ordering::Relaxed);
        let durable_step = self.kept_step.load(Ordering::Relaxed).max(resumed_step);
        Beat { steps_done, durable_step, eta_s: None }
    }
}

#[activities]
impl Hands {
    /// Works on a job until it has a result.
    #[activity]
    pub async fn turn(
        self: Arc<Self>,
        ctx: ActivityContext,
        task: Task,
    ) -> Result<(), ActivityError> {
        let lease = Duration::from_secs_f64(task.lease_s);
        let turn = Arc::new(Turn {
            id: task.id,
            control: Arc::default(),
            kept_step: AtomicU64::new(0),
            pace: (lease / 2).min(LONGEST_PACE),
            begun: Instant::now(),
        });
        let mine = self.0.clone();
        lock(&mine.running).insert(turn.id, turn.control.clone());
        if mine.stopping.load(Ordering::Relaxed) {
            turn.control.interrupt();
        }
        let (working, worked) = (mine.clone(), turn.clone());
        let mut work = tokio::spawn(async move { working.carry_out(&worked).await });
        let mut notified = false;
        let done = loop {
            tokio::select! {
                done = &mut work => break done,
                () = tokio::time::sleep(lease / BEATS_IN_A_LEASE) => {
                    ctx.record_heartbeat(turn.beat()).await?;
                }
                () = ctx.cancelled(), if !notified => {
                    notified = true;
                    mine.told_to_stop(&turn).await;
                }
            }
        };
        lock(&mine.running).remove(&turn.id);
        match done {
            Ok(Ok(())) => Ok(()),
            Ok(Err(later)) => {
                tracing::warn!(job = %turn.id, error = chain(&later), "job goes back");
                Err(Told::of(&later).into())
            }
            Err(broken) => {
                tracing::error!(job = %turn.id, error = chain(&broken), "job goes back");
                Err(Told::of(&broken).into())
            }
        }
    }

    /// Makes a part of a sweep.
    #[activity]
    pub async fn part(
        self: Arc<Self>,
        ctx: ActivityContext,
        task: PartTask,
    ) -> Result<(), ActivityError> {
        let lease = Duration::from_secs_f64(task.lease_s);
        let watch = Arc::<Watch>::default();
        let name = task.part.clone();
        let mine = self.0.clone();
        let (working, watched) = (mine.clone(), watch.clone());
        let mut work = tokio::spawn(async move { working.make_part(&task, &watched).await });
        let done = loop {
            tokio::select! {
                done = &mut work => break done,
                () = tokio::time::sleep((lease / BEATS_IN_A_LEASE).min(LOOK)) => {
                    ctx.record_heartbeat(watch.done.load(Ordering::Relaxed)).await?;
                    if ctx.is_cancelled() || mine.stopping.load(Ordering::Relaxed) {
                        watch.cancelled.store(true, Ordering::Relaxed);
                    }
                }
            }
        };
        match done {
            Ok(Ok(())) => Ok(()),
            Ok(Err(later)) => {
                tracing::warn!(part = name, error = chain(&later), "part goes back");
                Err(Told::of(&later).into())
            }
            Err(broken) => {
                tracing::error!(part = name, error = chain(&broken), "part goes back");
                Err(Told::of(&broken).into())
            }
        }
    }
}

impl Hands {
    /// Interrupts everything that runs.
    fn stop(&self) {
        self.0.stopping.store(true, Ordering::Relaxed);
        lock(&self.0.running).values().for_each(|control| control.interrupt());
    }
}

impl Inner {
    /// Stops a run: for good if the job was cancelled, else so that another worker goes on.
    async fn told_to_stop(&self, turn: &Turn) {
        let wanted = self.bucket.is_cancelled(turn.id).await;
        match wanted {
            Ok(true) => turn.control.cancel(),
            _ => turn.control.interrupt(),
        }
    }

    async fn make_part(&self, task: &PartTask, watch: &Arc<Watch>) -> Result<(), Later> {
        if task.build != env!("VPD_BUILD") {
            return Err(Later::Trouble("this worker is another build of vpd".to_owned()));
        }
        let object = task.object();
        if self.bucket.kept(&object).await?.is_some() {
            return Ok(());
        }
        let Some(text) = self.bucket.kept(&sweep_object(&task.digest)).await? else {
            return Err(Later::Trouble("the bucket does not hold the sweep".to_owned()));
        };
        let (answer, answered) = oneshot::channel();
        let (part, scratch, watch) = (task.part.clone(), self.scratch.clone(), watch.clone());
        std::thread::Builder::new().name("part".to_owned()).spawn(move || {
            give_way();
            let _ = answer.send(sweeps::make(&text, &part, &scratch, &watch));
        })?;
        let made = answered.await.map_err(|_| Later::Trouble("the part panicked".to_owned()))?;
        let made = made.map_err(|error| Later::Trouble(error.to_string()))?;
        self.bucket.keep(&object, made).await?;
        tracing::info!(part = task.part, sweep = task.digest, "part of a sweep made");
        Ok(())
    }

    async fn carry_out(self: &Arc<Self>, turn: &Turn) -> Result<(), Later> {
        let id = turn.id;
        let held = self.bucket.look(id).await?;
        if !held.accepted || held.ended {
            return Ok(());
        }
        let folder = tempfile::tempdir_in(&self.scratch)?;
        let log = folder.path().join("log.mcap");
        let kept_bytes = self.bucket.fetch_part(id, &part_path(&log)).await?;
        let from_step = {
            let log = log.clone();
            let found = tokio::task::spawn_blocking(move || last_checkpoint(&log).ok().flatten());
            found.await.ok().flatten().unwrap_or(0)
        };
        if held.cancelled {
            turn.control.cancel();
        }
        let attempt = self.bucket.begin_attempt(id, held.attempts, from_step).await?;
        turn.kept_step.store(from_step, Ordering::Relaxed);
        tracing::info!(job = %id, attempt, from_step, "job runs");
        let done = self.attempt(turn, &held, attempt, (&log, kept_bytes, from_step)).await;
        if done.is_err() {
            let taken_back = self.bucket.take_back_attempt(id, attempt).await;
            if let Err(error) = taken_back {
                tracing::warn!(job = %id, error = chain(&error), "attempt cannot be taken back");
            }
        }
        done
    }

    /// Makes one run of a job, from the durable part of its log.
    async fn attempt(
        self: &Arc<Self>,
        turn: &Turn,
        held: &Held,
        attempt: u32,
        (log, kept_bytes, from_step): (&Path, u64, u64),
    ) -> Result<(), Later> {
        let (id, suspect) = (turn.id, attempt > 1);
        let Some(text) = self.bucket.scenario(id).await? else { return Ok(()) };
        let scenario = match Scenario::from_json(&text) {
            Ok(scenario) => scenario,
            Err(error) => {
                let job = Job::new("", attempt);
                return self.fail(turn, &job, &Fault::rejected(&error)).await;
            }
        };
        let job = Job::new(scenario.name(), attempt);
        if held.cancelled && kept_bytes == 0 {
            return self.publish(turn, job.record(State::Cancelled, None), None).await;
        }
        let (settled, is_new) = match self.bucket.settled(id).await? {
            Some(settled) => (Box::new(settled), false),
            None => {
                let settle = Errand::Settle { scenario: Box::new(scenario) };
                match self.errand(turn, settle, suspect).await {
                    Ok(Done::Settled(settled)) => (settled, true),
                    Ok(_) => return self.fail(turn, &job, &Fault::panicked()).await,
                    Err(broken) => return self.broken(turn, &job, broken).await,
                }
            }
        };
        let plan = match settled.plan() {
            Ok(plan) => plan,
            Err(error) => return self.fail(turn, &job, &Fault::rejected(&error)).await,
        };
        let job = job.planned(&plan);
        if let Err(refusal) = self.limits.admit(&plan) {
            return self.fail(turn, &job, &Fault::beyond(&refusal)).await;
        }
        if is_new {
            self.bucket.keep_plan(id, &KeptPlan::new(Settled::clone(&settled), &plan)?).await?;
        }
        let log_path = log.to_owned();
        if self.bucket.is_stuck(id, held.attempts, MAX_FRUITLESS, from_step).await? {
            return self.give_up(turn, &job, settled, log_path, Fault::worker_crashed()).await;
        }
        let trace = suspect.then(|| log.with_extension("trace"));
        let run = Errand::Run { settled: settled.clone(), log: log_path.clone(), trace };
        let mut run = std::pin::pin!(self.errand(turn, run, suspect));
        let mut kept_bytes = kept_bytes;
        let ran = loop {
            tokio::select! {
                ran = &mut run => break ran,
                () = tokio::time::sleep(turn.pace) => {
                    self.keep(turn, log, from_step, &mut kept_bytes).await;
                }
            }
        };
        match ran {
            Ok(Done::Ran(summary)) => {
                self.publish(turn, job.record_of(&summary), Some((log, kept_bytes > 0))).await
            }
            Ok(_) => self.fail(turn, &job, &Fault::panicked()).await,
            Err(Broken::Fault(fault)) if fault.is_of_the_process() => {
                self.give_up(turn, &job, settled, log_path, fault).await
            }
            Err(broken) => {
                self.keep(turn, log, from_step, &mut kept_bytes).await;
                self.broken(turn, &job, broken).await
            }
        }
    }

    /// Sends the new part of an unfinished log to the bucket; anything that cannot be sent now goes
    /// with the next piece.
    async fn keep(&self, turn: &Turn, log: &Path, from_step: u64, kept_bytes: &mut u64) {
        let control = &turn.control;
        // Loaded before its bytes, of which there are then enough.
        let step = control.durable_step.load(Ordering::Acquire);
        let bytes = control.durable_bytes.load(Ordering::Acquire);
        if step <= turn.kept_step.load(Ordering::Relaxed) {
            return;
        }
        let resumed = control.resumed_step.load(Ordering::Relaxed);
        let kept = async {
            if resumed < from_step && *kept_bytes > 0 {
                // The earlier parts were not resumed: this is another log.
                self.bucket.drop_parts(turn.id).await?;
                *kept_bytes = 0;
            }
            if bytes > *kept_bytes {
                self.bucket.keep_part(turn.id, &part_path(log), *kept_bytes..bytes).await?;
                *kept_bytes = bytes;
            }
            Ok::<_, StoreError>(())
        };
        match kept.await {
            Ok(()) => turn.kept_step.store(step, Ordering::Relaxed),
            Err(error) if part_path(log).exists() => {
                tracing::warn!(job = %turn.id, error = chain(&error), "log not kept; trying again");
            }
            // The log is finished by now.
            Err(_) => {}
        }
    }

    /// Carries out an errand for a job on a thread of its own, in a process of its own if the last
    /// run did not return.
    async fn errand(
        self: &Arc<Self>,
        turn: &Turn,
        errand: Errand,
        suspect: bool,
    ) -> Result<Done, Broken> {
        let max_deaths = matches!(errand, Errand::GiveUp { .. }).then_some(MAX_GIVING_UP);
        let (mine, control) = (self.clone(), turn.control.clone());
        let (answer, answered) = oneshot::channel();
        let work = move || {
            give_way();
            let done = catch_unwind(AssertUnwindSafe(|| {
                match mine.program.as_ref().filter(|_| suspect) {
                    Some(program) => apart::carry_out(program, &errand, &control, max_deaths),
                    None => errand.carry_out(&control),
                }
            }));
            let _ = answer.send(done.unwrap_or_else(|_| Err(Fault::panicked().into())));
        };
        let thread = std::thread::Builder::new().name("run".to_owned()).spawn(work);
        if thread.is_err() {
            return Err(Broken::Stopped);
        }
        answered.await.unwrap_or_else(|_| Err(Fault::panicked().into()))
    }

    /// Ends the log of a job that ends its processes.
    async fn give_up(
        self: &Arc<Self>,
        turn: &Turn,
        job: &Job,
        settled: Box<Settled>,
        log: PathBuf,
        fault: Fault,
    ) -> Result<(), Later> {
        tracing::warn!(job = %turn.id, "job abandoned: its runs crash the process");
        let errand = Errand::GiveUp { settled, log: log.clone(), fault: fault.clone() };
        match self.errand(turn, errand, true).await {
            Ok(Done::Ran(summary)) => {
                turn.control.steps_done.store(summary.steps, Ordering::Relaxed);
                self.publish(turn, job.record_of(&summary), Some((&log, true))).await
            }
            Ok(_) | Err(Broken::Fault(_) | Broken::Unanswered(_)) => {
                tracing::error!(job = %turn.id, "the log of the job cannot be finished");
                self.fail(turn, job, &fault).await
            }
            Err(broken) => self.broken(turn, job, broken).await,
        }
    }

    async fn fail(&self, turn: &Turn, job: &Job, fault: &Fault) -> Result<(), Later> {
        self.publish(turn, job.record(State::Failed, Some(fault)), None).await
    }

    /// Handles a job whose run has no result.
    async fn broken(&self, turn: &Turn, job: &Job, broken: Broken) -> Result<(), Later> {
        match broken {
            Broken::Fault(fault) => self.fail(turn, job, &fault).await,
            Broken::Unanswered(_) => self.fail(turn, job, &Fault::panicked()).await,
            Broken::Stopped if turn.control.interrupted.load(Ordering::Relaxed) => {
                Err(Later::Stopping)
            }
            // Its search was stopped, and it has no log.
            Broken::Stopped => self.publish(turn, job.record(State::Cancelled, None), None).await,
            Broken::Trouble(trouble) => Err(Later::Trouble(format!("{trouble:?}"))),
            Broken::Aside(fault) => Err(Later::Trouble(fault.to_string())),
        }
    }

    /// Uploads the log, whose parts may be in the bucket, and ends the job. The first result counts.
    async fn publish(
        &self,
        turn: &Turn,
        mut record: Record,
        log: Option<(&Path, bool)>,
    ) -> Result<(), Later> {
        let id = turn.id;
        record.steps_done = turn.control.steps_done.load(Ordering::Relaxed);
        if let Some((path, _)) = log {
            let of = path.to_owned();
            let sum = tokio::task::spawn_blocking(move || LogSum::of(&of, || false)).await;
            let sum = sum.map_err(|_| Later::Stopping)??.ok_or(Later::Stopping)?;
            self.bucket.keep_log(id, path, &sum).await?;
            record.log = Some(sum);
        }
        let stands = self.bucket.publish(id, &record).await?;
        if stands.log != record.log
            && let Some(sum) = &record.log
        {
            self.bucket.drop_log(id, sum).await;
        }
        if log.is_none_or(|(_, has_parts)| has_parts)
            && let Err(error) = self.bucket.drop_parts(id).await
        {
            tracing::warn!(job = %id, error = chain(&error), "parts of a finished log stay");
        }
        let (steps, seconds) = (stands.steps_done, turn.begun.elapsed().as_secs_f64());
        tracing::info!(job = %id, state = ?stands.state, steps, seconds, "job ended");
        Ok(())
    }
}

/// Works on the jobs of a queue until `shutdown` completes; then running jobs are interrupted, kept
/// and left to others. Returns within ten seconds of that.
///
/// # Errors
/// If the scratch directory is in use, or bucket or Temporal do not answer at the start.
pub async fn work(
    config: WorkConfig,
    shutdown: impl Future<Output = ()> + Send + 'static,
) -> Result<(), ServeError> {
    let _lock = DataLock::take(&config.scratch)?;
    let scratch = config.scratch.join("jobs");
    let failed = |source| ServeError::Data { path: scratch.clone(), source };
    match std::fs::remove_dir_all(&scratch) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => return Err(failed(error)),
        _ => {}
    }
    std::fs::create_dir_all(&scratch).map_err(failed)?;
    let bucket = Bucket::open(&config.cluster.bucket).await.map_err(ClusterError::from)?;
    let client = connect(&config.cluster).await?;
    let hands = Hands(Arc::new(Inner {
        bucket,
        scratch,
        limits: config.limits,
        program: config.program,
        stopping: AtomicBool::new(false),
        running: Mutex::default(),
    }));
    let broke = |message: String| ClusterError::Worker { message };
    let slots = |number: usize| FixedSizeSlotSupplier::new(number);
    let tuner = TunerHolder::builder()
        .workflow_task_slot_supplier(slots(100))
        .activity_task_slot_supplier(slots(config.workers.max(1)))
        .local_activity_task_slot_supplier(slots(1))
        .nexus_task_slot_supplier(slots(1))
        .build();
    let options = WorkerOptions::new(config.cluster.queue.clone())
        .tuner(tuner)
        // One open request of each kind: a process that is frozen, but not dead, cannot answer what
        // Temporal hands out to it. Without a cache of workflows there is no third one, for those.
        .activity_task_poller_behavior(PollerBehavior::SimpleMaximum(1))
        .workflow_task_poller_behavior(PollerBehavior::SimpleMaximum(1))
        .max_cached_workflows(0)
        .max_heartbeat_throttle_interval(THROTTLE)
        .graceful_shutdown_period(DRAIN)
        .register_activities(hands.clone())
        .register_workflow::<Flow>()
        .and_then(|options| options.register_workflow::<Part>())
        .map_err(|error| broke(chain(&error)))?
        .build();
    let runtime = Runtime::from_current_tokio(Default::default());
    let runtime = runtime.map_err(|error| broke(chain(&error)))?;
    let worker = Worker::new(&runtime, client, options);
    let mut worker = worker.map_err(|error| broke(error.to_string()))?;
    let stop = worker.shutdown_handle();
    tokio::spawn(async move {
        shutdown.await;
        tracing::info!("stopping");
        hands.stop();
        stop();
    });
    let (queue, jobs) = (&config.cluster.queue, config.workers);
    tracing::info!(queue, jobs, "works");
    worker.run().await.map_err(|error| broke(chain(&error)))?;
    tracing::info!("stopped");
    Ok(())
}

#[cfg(test)]
mod tests {
    use prost::Message;
    use temporalio_common::data_converters::{
        ActivitySerializationContext, DataConverter, SerializationContextData,
    };
    use temporalio_common::error::{OutgoingActivityError, OutgoingError};
    use temporalio_sdk::activities::ActivityError;
    use uuid::Uuid;

    use super::{Beat, Later, PartTask, StoreError, Task, Told};

    /// Temporal refuses 2 MB, and repeats each attempt whose result it refused.
    const FAR_BELOW: usize = 64 << 10;

    /// Returns the number of bytes that Temporal is sent for a failed attempt.
    fn sent(told: Told) -> usize {
        let ActivityError::Application(error) = ActivityError::from(told) else {
            panic!("an attempt that fails is tried again");
        };
        let of = SerializationContextData::Activity(ActivitySerializationContext::new());
        let error = OutgoingError::Activity(OutgoingActivityError::Application(error));
        DataConverter::default().to_failure(&of, error).encoded_len()
    }

    #[tokio::test]
    async fn what_temporal_is_told_stays_far_below_what_it_refuses() {
        // A server that answers with a page, a scratch folder with a long name, a field that echoes its value.
        let long = || "é€".repeat(1 << 20);
        let words: Box<String> = Box::new(long());
        let panicked: Result<(), _> =
            tokio::spawn(async move { std::panic::resume_unwind(words) }).await;
        let other = || std::io::Error::other(long());
        for told in [
            Told::of(&Later::Trouble(long())),
            Told::of(&Later::Disk(other())),
            Told::of(&Later::Store(StoreError::reading_a_log(other()))),
            Told::of(&panicked.expect_err("it panicked")),
        ] {
            assert!(told.0.len() > 30, "it says what is wrong: {told}");
            let bytes = sent(told);
            assert!(bytes < FAR_BELOW, "{bytes} bytes");
        }
    }

    #[test]
    fn tasks_and_signs_of_life_are_small() {
        let lease_s = -f64::MAX / 3.0;
        let task = Task { id: Uuid::max(), lease_s };
        let (most, eta_s) = (u64::MAX, Some(lease_s));
        let beat = Beat { steps_done: most, durable_step: most, eta_s };
        let part = PartTask {
            digest: "f".repeat(64),
            build: env!("VPD_BUILD").to_owned(),
            part: format!("{most}/{most}"),
            lease_s,
        };
        let written = [
            serde_json::to_vec(&task).expect("JSON"),
            serde_json::to_vec(&beat).expect("JSON"),
            serde_json::to_vec(&part).expect("JSON"),
        ];
        for text in written {
            assert!(text.len() < FAR_BELOW / 16, "{} bytes", text.len());
        }
    }
}
