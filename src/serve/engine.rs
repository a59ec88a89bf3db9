//! The engine: an index of all jobs, a bounded queue, worker threads.
//!
//! Invariants: all state sits behind one std mutex, held for moments and never over an `.await`. A job runs on
//! an OS thread of its own, and what it costs is seen through two atomics. A state is shown only after the
//! store holds what it says; an operation once begun goes on to its end, whether or not the client waits.

mod worker;

use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::ops::Bound;
use std::path::PathBuf;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

use futures_util::{StreamExt, TryStreamExt, stream};
use tokio::sync::mpsc;
use uuid::Uuid;

use super::job::{Fault, Job, Phase, State, View};
use super::metrics::Metrics;
use super::store::{Ending, Found, MAX_GIVING_UP, Record, Store, StoreError};
use super::{Limits, ServeError, chain, give_way};
use crate::advise;
use crate::live::Live;
use crate::plan::Plan;
use crate::scenario::Scenario;

/// How many records the start reads at a time.
const SCAN_WIDTH: usize = 16;

/// Why the engine does not do what it was asked for.
#[derive(Debug, thiserror::Error)]
pub(super) enum Refusal {
    #[error("{limit} jobs wait already: try again later")]
    QueueFull { limit: usize },
    #[error("the service is stopping: try again once it is back")]
    Stopping,
    #[error(
        "the run is expected to take {estimate_s:.0} s of computing, more than the {limit_s:.0} s allowed here"
    )]
    TooExpensive { estimate_s: f64, limit_s: f64 },
    #[error(
        "the log is expected to take {estimate} bytes, more than the {limit} allowed here: log every {every} steps, or fewer channels"
    )]
    LogTooLarge { estimate: u64, limit: u64, every: u64 },
    #[error("the disk has no room for the log of this job beside those that were accepted before")]
    DiskFull,
    #[error("this Idempotency-Key came with another scenario before")]
    KeyReused,
    #[error("the request with this Idempotency-Key is still being answered")]
    KeyBusy,
    #[error("there is no job with this id")]
    UnknownJob,
    #[error("the job is running: cancel it first")]
    JobRunning,
    #[error("the job has ended already")]
    JobEnded,
    #[error("the log can be read once the job has ended")]
    LogUnfinished { eta_s: Option<f64> },
    #[error("the job ended before it began a log")]
    NoLog,
    #[error(transparent)]
    Store(#[from] StoreError),
}

#[derive(Debug)]
struct Index {
    jobs: BTreeMap<Uuid, Job>,
    queue: VecDeque<Uuid>,
    /// Those in the hands of workers.
    running: BTreeSet<Uuid>,
    /// The job that came under each idempotency key.
    keys: HashMap<Uuid, Uuid>,
    /// Bytes that the logs of jobs which have not ended are expected to take.
    promised_bytes: u64,
    /// Places kept for jobs that are being written to the store.
    reserved: usize,
    /// Who holds a copy has something to finish before a stop is complete; gone once the stop has begun.
    alive: Option<mpsc::Sender<()>>,
}

impl Index {
    /// Takes note of how a job ended.
    fn end(&mut self, ending: Ending) {
        let id = ending.id;
        let key = self.remove(id).and_then(|job| job.key);
        self.jobs.insert(id, Job { key, ..Job::ended(ending) });
        if let Some(key) = key {
            self.keys.insert(key, id);
        }
    }

    /// Forgets a job, and the key under which it came.
    fn remove(&mut self, id: Uuid) -> Option<Job> {
        let job = self.jobs.remove(&id)?;
        self.running.remove(&id);
        self.promised_bytes -= job.log_bytes;
        if let Some(key) = job.key {
            self.keys.remove(&key);
        }
        Some(job)
    }

    fn running(&self) -> impl Iterator<Item = &Job> {
        self.running.iter().filter_map(|id| self.jobs.get(id))
    }

    /// Bytes that logs will still take of the disk.
    fn bytes_to_come(&self) -> u64 {
        let written = self.running().map(Job::bytes_written).sum();
        self.promised_bytes.saturating_sub(written)
    }
}

#[derive(Debug)]
struct Shared {
    store: Store,
    metrics: Metrics,
    limits: Limits,
    live: Option<Arc<Live>>,
    index: Mutex<Index>,
    /// There is work in the queue, or no more to come.
    work: Condvar,
    /// The stop has begun.
    halt: Condvar,
    runtime: tokio::runtime::Handle,
}

impl Shared {
    fn index(&self) -> MutexGuard<'_, Index> {
        // A panic leaves the index whole: no change of it spans a call that may panic.
        self.index.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A handle on the engine; copies are the same engine.
#[derive(Clone, Debug)]
pub(super) struct Engine(Arc<Shared>);

/// Tells when everything that was going on at the stop has come to its end.
#[derive(Debug)]
pub(super) struct Drained(mpsc::Receiver<()>);

impl Drained {
    pub(super) async fn wait(mut self) {
        // Nobody sends: this returns when the last holder of a sender is gone.
        let _ = self.0.recv().await;
    }
}

/// What is kept for a job that is being written to the store; given back when dropped.
struct Place {
    shared: Arc<Shared>,
    key: Option<Uuid>,
    log_bytes: u64,
    _alive: mpsc::Sender<()>,
}

impl Place {
    /// The job stands: it has its place in the queue.
    fn fill(mut self, id: Uuid, job: Job) {
        self.key = None;
        let mut index = self.shared.index();
        index.promised_bytes += job.log_bytes;
        index.jobs.insert(id, job);
        index.queue.push_back(id);
        drop(index);
        self.shared.work.notify_one();
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut index = self.shared.index();
        index.reserved -= 1;
        index.promised_bytes -= self.log_bytes;
        if let Some(key) = self.key {
            index.keys.remove(&key);
        }
    }
}

impl Engine {
    /// Takes up the jobs of the store and starts the workers.
    pub(super) async fn start(
        store: Store,
        workers: usize,
        limits: Limits,
        live: Option<Arc<Live>>,
    ) -> Result<(Self, Drained), ServeError> {
        let unreadable = |error: StoreError| ServeError::Record { message: chain(&error) };
        let found = store.scan().await.map_err(unreadable)?;
        let jobs: BTreeMap<_, _> = stream::iter(found)
            .map(|found| take_up(&store, found))
            .buffered(SCAN_WIDTH)
            .try_collect()
            .await
            .map_err(unreadable)?;
        let queue: VecDeque<_> = jobs
            .iter()
            .filter(|(_, job)| matches!(job.phase, Phase::Queued))
            .map(|(id, _)| *id)
            .collect();
        let keys = jobs.iter().filter_map(|(id, job)| Some((job.key?, *id))).collect();
        let promised_bytes = jobs.values().map(|job| job.log_bytes).sum();
        tracing::info!(jobs = jobs.len(), queued = queue.len(), "record read");

        let (alive, gone) = mpsc::channel(1);
        let shared = Arc::new(Shared {
            store,
            metrics: Metrics::new(),
            limits,
            live,
            index: Mutex::new(Index {
                jobs,
                queue,
                running: BTreeSet::new(),
                keys,
                promised_bytes,
                reserved: 0,
                alive: Some(alive.clone()),
            }),
            work: Condvar::new(),
            halt: Condvar::new(),
            runtime: tokio::runtime::Handle::current(),
        });
        for number in 1..=workers.max(1) {
            let (shared, alive) = (shared.clone(), alive.clone());
            std::thread::Builder::new().name(format!("worker-{number}")).spawn(move || {
                give_way();
                shared.work();
                drop(alive);
            })?;
        }
        Ok((Self(shared), Drained(gone)))
    }

    /// Takes a job. When this returns the job is on the disk. A key that came before, with the same
    /// scenario, gives the job of that time.
    pub(super) async fn submit(
        &self,
        scenario: Scenario,
        plan: Plan,
        key: Option<Uuid>,
    ) -> Result<View, Refusal> {
        self.0.limits.admit(&plan)?;
        let shared = self.0.clone();
        let free_bytes = tokio::task::spawn_blocking(move || shared.store.free_bytes()).await;
        // A runtime that goes down takes no jobs.
        let free_bytes = free_bytes.map_err(|_| Refusal::Stopping)??;
        let id = Uuid::now_v7();
        let text = scenario.to_json();
        let place = match self.reserve(id, key, plan.log_bytes, free_bytes)? {
            Ok(place) => place,
            Err(earlier) => return self.submitted_before(earlier, &text).await,
        };
        to_the_end(async move {
            let job = Job { key, ..Job::new(&scenario, &plan, 0) };
            place.shared.store.accept(id, key, text).await?;
            tracing::info!(job = %id, name = job.name, steps = job.steps, "job accepted");
            let view = job.view(id);
            place.shared.metrics.accept();
            place.fill(id, job);
            Ok(view)
        })
        .await
    }

    /// A place for a job, or the job that came under its key before.
    fn reserve(
        &self,
        id: Uuid,
        key: Option<Uuid>,
        log_bytes: u64,
        free_bytes: u64,
    ) -> Result<Result<Place, Uuid>, Refusal> {
        let mut index = self.0.index();
        let alive = index.alive.clone().ok_or(Refusal::Stopping)?;
        if let Some(earlier) = key.and_then(|key| index.keys.get(&key)) {
            return Ok(Err(*earlier));
        }
        let Limits { queue, reserve_bytes, .. } = self.0.limits;
        if index.queue.len() + index.reserved >= queue {
            return Err(Refusal::QueueFull { limit: queue });
        }
        if index.bytes_to_come().saturating_add(log_bytes).saturating_add(reserve_bytes)
            > free_bytes
        {
            return Err(Refusal::DiskFull);
        }
        index.reserved += 1;
        index.promised_bytes += log_bytes;
        if let Some(key) = key {
            index.keys.insert(key, id);
        }
        Ok(Ok(Place { shared: self.0.clone(), key, log_bytes, _alive: alive }))
    }

    /// The job that came under a key before, if it came with the same scenario.
    async fn submitted_before(&self, id: Uuid, text: &[u8]) -> Result<View, Refusal> {
        self.brief(id).map_err(|_| Refusal::KeyBusy)?;
        if self.0.store.scenario(id).await?[..] != *text {
            return Err(Refusal::KeyReused);
        }
        self.get(id).await
    }

    /// One job, with how it ended.
    pub(super) async fn get(&self, id: Uuid) -> Result<View, Refusal> {
        let mut view = self.brief(id)?;
        if view.state.is_final() {
            let record = self.0.store.record(id).await.or_else(|error| {
                tracing::error!(job = %id, error = chain(&error), "result unreadable");
                let index = self.0.index();
                let job = index.jobs.get(&id).ok_or(Refusal::UnknownJob)?;
                let record = job.record(view.state, Some(&Fault::damaged()));
                Ok::<_, Refusal>(Record { finished: None, ..record })
            })?;
            let Record { plan, .. } = &record;
            view.plan.clone_from(plan);
            view.record = Some(record);
        }
        Ok(view)
    }

    /// One job, without a look at the disk.
    pub(super) fn brief(&self, id: Uuid) -> Result<View, Refusal> {
        self.0.index().jobs.get(&id).map(|job| job.view(id)).ok_or(Refusal::UnknownJob)
    }

    /// Jobs newest first, older than `cursor`; and the cursor for more of them, if there are more.
    pub(super) fn list(
        &self,
        state: Option<State>,
        limit: usize,
        cursor: Option<Uuid>,
    ) -> (Vec<View>, Option<Uuid>) {
        let index = self.0.index();
        let older =
            index.jobs.range((Bound::Unbounded, cursor.map_or(Bound::Unbounded, Bound::Excluded)));
        let wanted = older.rev().filter(|(_, job)| state.is_none_or(|state| job.state() == state));
        let mut page: Vec<_> = wanted.take(limit + 1).map(|(id, job)| job.view(*id)).collect();
        let more = page.len() > limit;
        page.truncate(limit);
        let next = page.last().filter(|_| more).map(|view| view.id);
        (page, next)
    }

    /// Where the log of a job stands, or will stand.
    pub(super) fn log_path(&self, id: Uuid) -> PathBuf {
        self.0.store.log_path(id)
    }

    /// The figures of the service as text. Blocking.
    pub(super) fn metrics(&self) -> String {
        let free_bytes = self.0.store.free_bytes().unwrap_or_default();
        let (counts, queue) = {
            let index = self.0.index();
            let count = |state| index.jobs.values().filter(|job| job.state() == state).count();
            (State::ALL.map(|state| (state, count(state))), index.queue.len())
        };
        self.0.metrics.text(&counts, queue, free_bytes)
    }

    /// The finished log of a job.
    pub(super) fn log(&self, id: Uuid) -> Result<PathBuf, Refusal> {
        let view = self.brief(id)?;
        match (view.state.is_final(), view.has_log) {
            (true, true) => Ok(self.0.store.log_path(id)),
            (true, false) => Err(Refusal::NoLog),
            (false, _) => Err(Refusal::LogUnfinished { eta_s: view.eta_s }),
        }
    }

    /// The scenario of a job, as accepted.
    pub(super) async fn scenario(&self, id: Uuid) -> Result<axum::body::Bytes, Refusal> {
        self.brief(id)?;
        Ok(self.0.store.scenario(id).await?)
    }

    /// Stops a job: a waiting one has ended when this returns, a running one ends at its next step.
    pub(super) async fn cancel(&self, id: Uuid) -> Result<View, Refusal> {
        let shared = self.0.clone();
        let alive = self.alive()?;
        to_the_end(async move {
            let record = {
                let mut index = shared.index();
                let Index { jobs, queue, .. } = &mut *index;
                let job = jobs.get_mut(&id).ok_or(Refusal::UnknownJob)?;
                match &mut job.phase {
                    Phase::Ended { .. } => return Err(Refusal::JobEnded),
                    Phase::Leaving => None,
                    Phase::Running { control, .. } => {
                        control.cancelled.store(true, Ordering::Relaxed);
                        None
                    }
                    Phase::Queued => {
                        job.phase = Phase::Leaving;
                        queue.retain(|waiting| *waiting != id);
                        Some(job.record(State::Cancelled, None))
                    }
                }
            };
            tracing::info!(job = %id, "job to be cancelled");
            match record {
                Some(record) => shared.end_waiting(id, &record).await?,
                None => {
                    if let Err(error) = shared.store.note_cancel(id).await {
                        tracing::warn!(job = %id, error = chain(&error), "cancellation not on disk");
                    }
                }
            }
            drop(alive);
            Engine(shared).brief(id)
        })
        .await
    }

    /// Forgets a job that does not run, and its log.
    pub(super) async fn forget(&self, id: Uuid) -> Result<(), Refusal> {
        let shared = self.0.clone();
        let alive = self.alive()?;
        to_the_end(async move {
            {
                let mut index = shared.index();
                let Index { jobs, queue, .. } = &mut *index;
                let job = jobs.get_mut(&id).ok_or(Refusal::UnknownJob)?;
                match job.phase {
                    Phase::Running { .. } | Phase::Leaving => return Err(Refusal::JobRunning),
                    Phase::Ended { .. } => {}
                    Phase::Queued => {
                        job.phase = Phase::Leaving;
                        queue.retain(|waiting| *waiting != id);
                    }
                }
            }
            if let Err(error) = shared.store.forget(id).await {
                shared.back_to_queue(id);
                return Err(error.into());
            }
            shared.index().remove(id);
            tracing::info!(job = %id, "job forgotten");
            drop(alive);
            Ok(())
        })
        .await
    }

    /// Begins the stop: no new jobs, and running ones are interrupted.
    pub(super) fn stop(&self) {
        let mut index = self.0.index();
        index.alive = None;
        for job in index.running() {
            if let Phase::Running { control, .. } = &job.phase {
                control.interrupted.store(true, Ordering::Relaxed);
            }
        }
        drop(index);
        self.0.work.notify_all();
        self.0.halt.notify_all();
    }

    /// Whether jobs are taken.
    pub(super) fn is_ready(&self) -> bool {
        self.0.index().alive.is_some()
    }

    fn alive(&self) -> Result<mpsc::Sender<()>, Refusal> {
        self.0.index().alive.clone().ok_or(Refusal::Stopping)
    }
}

impl Shared {
    async fn end_waiting(&self, id: Uuid, record: &Record) -> Result<(), StoreError> {
        match self.store.publish(id, record).await {
            Ok(record) => {
                self.metrics.end(&record, 0);
                self.index().end(Ending::of(id, &record));
                tracing::info!(job = %id, "job cancelled");
                Ok(())
            }
            Err(error) => {
                self.back_to_queue(id);
                Err(error)
            }
        }
    }

    /// Puts a job whose departure failed to the front of the queue.
    fn back_to_queue(&self, id: Uuid) {
        let mut index = self.index();
        let Index { jobs, queue, .. } = &mut *index;
        if let Some(job) = jobs.get_mut(&id)
            && matches!(job.phase, Phase::Leaving)
        {
            job.phase = Phase::Queued;
            queue.push_front(id);
            self.work.notify_one();
        }
    }
}

/// A job of the store: one that ended, one that must end now, or one to run (again).
async fn take_up(store: &Store, found: Found) -> Result<(Uuid, Job), StoreError> {
    let id = found.id;
    if found.ended {
        let ending = match found.ending {
            Some(ending) => ending,
            None => unindexed(store, &found).await,
        };
        return Ok((id, Job { key: found.key, ..Job::ended(ending) }));
    }
    let came_to = store.progress(id)?;
    let deaths = store.deaths(id, found.attempts, came_to).await;
    let given_up = (found.given_up > 0 || deaths.convict()).then_some(found.given_up);
    let planned = store.scenario(id).await.map_err(|error| Fault::storage(&error));
    let planned = planned.and_then(|text| {
        let scenario = Scenario::from_json(&text).map_err(|error| Fault::rejected(&error))?;
        let plan = advise::plan(&scenario).map_err(|error| Fault::rejected(&error))?;
        let job = Job::new(&scenario, &plan, found.attempts);
        // Nothing of a job that is given up is computed: it harms no other.
        let suspect = deaths.fruitless > 0 && given_up.is_none();
        Ok(Job { suspect, given_up, cancelled: found.cancelled, ..job.come_to(came_to) })
    });
    let (job, fault) = match planned {
        Ok(job) => (job, None),
        Err(fault) => (Job::unnamed(found.attempts), Some(fault)),
    };
    let job = Job { key: found.key, ..job };
    let record = match fault {
        // What ran before goes to its worker, who gives its log an end.
        _ if found.cancelled && found.attempts == 0 => job.record(State::Cancelled, None),
        Some(fault) => job.record(State::Failed, Some(&fault)),
        None if found.given_up >= MAX_GIVING_UP => {
            job.record(State::Failed, Some(&Fault::worker_crashed()))
        }
        None => return Ok((id, job)),
    };
    tracing::warn!(job = %id, attempts = found.attempts, state = ?record.state, "job ended at the start");
    store.remove_leftovers(id)?;
    let ending = Ending::of(id, &store.publish(id, &record).await?);
    Ok((id, Job { key: found.key, ..Job::ended(ending) }))
}

/// How a job ended that the index does not know.
async fn unindexed(store: &Store, found: &Found) -> Ending {
    let id = found.id;
    let ending = match store.record(id).await {
        Ok(record) => Ending::of(id, &record),
        Err(error) => {
            tracing::error!(job = %id, error = chain(&error), "result unreadable");
            let record = Job::unnamed(found.attempts).record(State::Failed, None);
            return Ending { has_log: found.has_log, ..Ending::of(id, &record) };
        }
    };
    store.add_to_index(&ending);
    ending
}

/// Runs a task to its end even if the caller, a request whose client has left, is dropped.
async fn to_the_end<T: Send + 'static>(task: impl Future<Output = T> + Send + 'static) -> T {
    match tokio::spawn(task).await {
        Ok(value) => value,
        Err(error) => match error.try_into_panic() {
            Ok(panic) => std::panic::resume_unwind(panic),
            // Only a runtime that goes down aborts a task, and it drops us next.
            Err(_) => std::future::pending().await,
        },
    }
}
