//! The engine of one machine: an index of all jobs, a bounded queue, worker threads.
//!
//! Invariants: all state is behind one std mutex, held for moments and never over an `.await`. A
//! job runs on an OS thread of its own, and its progress is read from two atomics. A state is shown
//! only after the store holds it; an operation once begun goes on to its end, whether or not the
//! client waits. A start computes nothing and ends no job: that is left to the workers.

mod worker;

use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::fs::Metadata;
use std::io;
use std::ops::Bound;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use futures_util::{StreamExt, stream};
use tokio::sync::Semaphore;
use tokio::sync::mpsc;
use uuid::Uuid;

use super::Refusal;
use super::to_the_end;
use crate::advise::Settled;
use crate::live::Live;
use crate::plan::Plan;
use crate::scenario::Scenario;
use crate::serve::ids::Ids;
use crate::serve::job::{Fault, Job, Phase, State, View};
use crate::serve::metrics::Metrics;
use crate::serve::store::{
    Ending, Found, KeptPlan, Line, LogSum, Record, Size, Store, StoreError, Waiting,
};
use crate::serve::{Limits, ServeError, chain, give_way};

/// Number of records that the start reads at a time.
const SCAN_WIDTH: usize = 16;

#[derive(Debug)]
struct Index {
    jobs: BTreeMap<Uuid, Job>,
    queue: VecDeque<Uuid>,
    /// Jobs that wait for the store, with the time until which they wait.
    resting: BTreeSet<(Instant, Uuid)>,
    /// Jobs in the hands of workers.
    running: BTreeSet<Uuid>,
    /// The job that came under each idempotency key.
    keys: HashMap<Uuid, Uuid>,
    /// Bytes that the logs of jobs which have not ended are expected to take.
    promised_bytes: u64,
    /// Places kept for jobs that are being written to the store.
    reserved: usize,
    /// Sender whose copies are held by tasks to finish before a stop is complete; `None` once the
    /// stop has begun.
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
        self.promised_bytes -= job.owed_bytes;
        if let Some(key) = job.key {
            self.keys.remove(&key);
        }
        Some(job)
    }

    /// Takes back a job that could not be forgotten.
    fn restore(&mut self, id: Uuid, job: Job) {
        self.promised_bytes += job.owed_bytes;
        if let Some(key) = job.key {
            self.keys.insert(key, id);
        }
        self.jobs.insert(id, job);
        self.back_to_queue(id);
    }

    fn running(&self) -> impl Iterator<Item = &Job> {
        self.running.iter().filter_map(|id| self.jobs.get(id))
    }

    /// Returns the bytes that logs will still take of the disk.
    fn bytes_to_come(&self) -> u64 {
        let written = self.running().map(Job::bytes_written).sum();
        self.promised_bytes.saturating_sub(written)
    }

    /// Records what a job is expected to take; `written_bytes` of its log are on the disk.
    fn owe(&mut self, id: Uuid, size: Size, written_bytes: u64) {
        let Some(job) = self.jobs.get_mut(&id) else { return };
        let owed_bytes = size.log_bytes.saturating_sub(written_bytes);
        self.promised_bytes = self.promised_bytes - job.owed_bytes + owed_bytes;
        (job.size, job.owed_bytes) = (Some(size), owed_bytes);
    }

    /// Takes a waiting job out of the queue.
    fn leave(&mut self, id: Uuid) {
        if let Some(job) = self.jobs.get_mut(&id) {
            job.phase = Phase::Leaving;
        }
        self.queue.retain(|waiting| *waiting != id);
        self.resting.retain(|(_, waiting)| *waiting != id);
    }

    /// Puts a job back to where it was before it left the queue, or was in the hands of a worker.
    fn back_to_queue(&mut self, id: Uuid) {
        self.running.remove(&id);
        if let Some(job) = self.jobs.get_mut(&id)
            && matches!(job.phase, Phase::Leaving | Phase::Running { .. })
        {
            job.phase = Phase::Queued;
            self.queue.push_front(id);
        }
    }
}

/// Identity of a file, to tell it from one that was changed since.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Identity {
    bytes: u64,
    place: (u64, u64),
    changed: (i64, i64),
}

impl Identity {
    fn of(found: &Metadata) -> Self {
        #[cfg(unix)]
        {
            use std::os::unix::fs::MetadataExt;
            Self {
                bytes: found.len(),
                place: (found.dev(), found.ino()),
                changed: (found.ctime(), found.ctime_nsec()),
            }
        }
        #[cfg(not(unix))]
        {
            let since = found.modified().ok().and_then(|time| time.elapsed().ok());
            let changed = since.map_or(0, |since| since.as_secs().cast_signed());
            Self { bytes: found.len(), place: (0, 0), changed: (changed, 0) }
        }
    }
}

#[derive(Debug)]
struct Shared {
    store: Arc<Store>,
    ids: Ids,
    metrics: Metrics,
    limits: Limits,
    live: Option<Arc<Live>>,
    /// Program that carries out errands in a process of its own.
    program: Option<PathBuf>,
    index: Mutex<Index>,
    /// Logs that were found to be what their jobs wrote.
    sound: Mutex<HashMap<Uuid, Identity>>,
    /// Logs are read through one at a time.
    summing: Semaphore,
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
pub(in crate::serve) struct Local(Arc<Shared>);

/// Reports when everything that was going on at the stop has ended.
#[derive(Debug)]
pub(in crate::serve) struct Drained(mpsc::Receiver<()>);

impl Drained {
    pub(in crate::serve) async fn wait(mut self) {
        // Nothing is sent: this returns when the last sender is gone.
        let _ = self.0.recv().await;
    }
}

/// Resources kept for a job that is being written to the store; given back when dropped.
struct Place {
    shared: Arc<Shared>,
    key: Option<Uuid>,
    log_bytes: u64,
    _alive: mpsc::Sender<()>,
}

impl Place {
    /// Puts the job, which is on record, into the queue.
    fn fill(mut self, id: Uuid, job: Job) {
        self.key = None;
        let mut index = self.shared.index();
        let size = job.size;
        index.jobs.insert(id, job);
        if let Some(size) = size {
            index.owe(id, size, 0);
        }
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

impl Local {
    /// Resumes the jobs of the store and starts the workers.
    pub(in crate::serve) async fn start(
        store: Store,
        workers: usize,
        limits: Limits,
        live: Option<Arc<Live>>,
        program: Option<PathBuf>,
    ) -> Result<(Self, Drained), ServeError> {
        let unreadable = |error: StoreError| ServeError::Record { message: chain(&error) };
        let store = Arc::new(store);
        let scanned = {
            let store = store.clone();
            tokio::task::spawn_blocking(move || store.scan()).await.map_err(io::Error::other)?
        };
        let (found, aside) = scanned.map_err(unreadable)?;
        let jobs: BTreeMap<_, _> = stream::iter(found)
            .map(|found| resume_job(&store, found))
            .buffered(SCAN_WIDTH)
            .collect()
            .await;
        let queue: VecDeque<_> = jobs
            .iter()
            .filter(|(_, job)| matches!(job.phase, Phase::Queued))
            .map(|(id, _)| *id)
            .collect();
        let keys = jobs.iter().filter_map(|(id, job)| Some((job.key?, *id))).collect();
        let promised_bytes = jobs.values().map(|job| job.owed_bytes).sum();
        let unknown: Vec<Uuid> =
            queue.iter().filter(|id| jobs[*id].size.is_none()).copied().collect();
        tracing::info!(jobs = jobs.len(), queued = queue.len(), aside, "record read");

        let (alive, gone) = mpsc::channel(1);
        let shared = Arc::new(Shared {
            store,
            ids: Ids::after(jobs.keys().copied()),
            metrics: Metrics::new(aside),
            limits,
            live,
            program,
            sound: Mutex::default(),
            summing: Semaphore::new(1),
            index: Mutex::new(Index {
                jobs,
                queue,
                resting: BTreeSet::new(),
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
        let engine = Self(shared);
        tokio::spawn(engine.clone().read_names(unknown));
        Ok((engine, Drained(gone)))
    }

    /// Reads the names of jobs that the index does not know, one after the other.
    async fn read_names(self, unknown: Vec<Uuid>) {
        for id in unknown {
            let Ok(text) = self.0.store.scenario(id).await else { continue };
            let Ok(Ok(scenario)) =
                tokio::task::spawn_blocking(move || Scenario::from_json(&text)).await
            else {
                continue;
            };
            if let Some(job) = self.0.index().jobs.get_mut(&id)
                && job.name.is_empty()
            {
                scenario.name().clone_into(&mut job.name);
            }
        }
    }

    /// Takes a job, with its plan unless its accuracy is yet to be settled. When this returns the
    /// job is on the disk. A key that was used before, with the same scenario, returns the job of
    /// that time.
    pub(in crate::serve) async fn submit(
        &self,
        scenario: Scenario,
        planned: Option<(Settled, Plan)>,
        key: Option<Uuid>,
        sent: Vec<u8>,
    ) -> Result<View, Refusal> {
        if let Some((_, plan)) = &planned {
            self.0.limits.admit(plan)?;
        }
        let shared = self.0.clone();
        let free_bytes = tokio::task::spawn_blocking(move || shared.store.free_bytes()).await;
        // A runtime that is shutting down takes no jobs.
        let free_bytes = free_bytes.map_err(|_| Refusal::Stopping)??;
        let id = self.0.ids.next();
        let text = scenario.to_json();
        let log_bytes = planned.as_ref().map_or(0, |(_, plan)| plan.log_bytes);
        let place = match self.reserve(id, key, log_bytes, free_bytes)? {
            Ok(place) => place,
            Err(earlier) => return self.submitted_before(earlier, &text).await,
        };
        to_the_end(async move {
            let job = Job { key, ..Job::new(scenario.name(), 0) };
            let (job, kept) = match planned {
                Some((settled, plan)) => (job.planned(&plan), Some(KeptPlan::new(settled, &plan)?)),
                None => (job, None),
            };
            let store = &place.shared.store;
            store.accept(id, key, text, sent).await?;
            // From here on there is a job. Without its plan on the disk a worker makes it again.
            if let Some(kept) = kept
                && let Err(error) = store.keep_plan(id, &kept).await
            {
                tracing::warn!(job = %id, error = chain(&error), "plan not kept");
            }
            store.add_to_index(&Line::Waits(Waiting {
                id,
                name: job.name.clone(),
                size: job.size,
            }));
            tracing::info!(job = %id, name = job.name, "job accepted");
            let view = job.view(id);
            place.shared.metrics.accept();
            place.fill(id, job);
            Ok(view)
        })
        .await
    }

    /// Returns a place for a job, or the job that came under its key before.
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

    /// Returns the job that came under a key before, if it came with the same scenario.
    async fn submitted_before(&self, id: Uuid, text: &[u8]) -> Result<View, Refusal> {
        self.brief(id).map_err(|_| Refusal::KeyBusy)?;
        if self.0.store.scenario(id).await?[..] != *text {
            return Err(Refusal::KeyReused);
        }
        self.get(id).await
    }

    /// Returns one job, with its end or its plan.
    pub(in crate::serve) async fn get(&self, id: Uuid) -> Result<View, Refusal> {
        let mut view = self.brief(id)?;
        if view.record.is_some() {
            return Ok(view);
        }
        if view.state.is_final() {
            let record = self.0.store.record(id).await.or_else(|error| {
                tracing::error!(job = %id, error = chain(&error), "result unreadable");
                let index = self.0.index();
                let job = index.jobs.get(&id).ok_or(Refusal::UnknownJob)?;
                let record = job.record(view.state, Some(&Fault::damaged(Some(&error))));
                Ok::<_, Refusal>(Record { finished: None, ..record })
            })?;
            let Record { plan, .. } = &record;
            view.plan.clone_from(plan);
            view.record = Some(record);
        } else if view.plan.is_none() {
            view.plan = self.0.store.plan(id).await.ok().flatten();
            if let Some(job) = self.0.index().jobs.get_mut(&id)
                && job.plan.is_none()
            {
                job.plan.clone_from(&view.plan);
            }
        }
        Ok(view)
    }

    /// Returns one job, without a look at the disk.
    pub(in crate::serve) fn brief(&self, id: Uuid) -> Result<View, Refusal> {
        self.0.index().jobs.get(&id).map(|job| job.view(id)).ok_or(Refusal::UnknownJob)
    }

    /// Returns jobs newest first, older than `cursor`, with `name` in their names in any case; and
    /// the cursor for more of them, if there are more.
    pub(in crate::serve) fn list(
        &self,
        state: Option<State>,
        name: Option<&str>,
        limit: usize,
        cursor: Option<Uuid>,
    ) -> (Vec<View>, Option<Uuid>) {
        let index = self.0.index();
        let older =
            index.jobs.range((Bound::Unbounded, cursor.map_or(Bound::Unbounded, Bound::Excluded)));
        let name = name.map(str::to_lowercase);
        let named = |job: &Job| {
            name.as_ref().is_none_or(|name| job.name.to_lowercase().contains(name.as_str()))
        };
        let wanted = older
            .rev()
            .filter(|(_, job)| state.is_none_or(|state| job.state() == state) && named(job));
        let mut page: Vec<_> = wanted.take(limit + 1).map(|(id, job)| job.view(*id)).collect();
        let more = page.len() > limit;
        page.truncate(limit);
        let next = page.last().filter(|_| more).map(|view| view.id);
        (page, next)
    }

    /// Returns the path of the log of a job, even before it exists.
    pub(in crate::serve) fn log_path(&self, id: Uuid) -> PathBuf {
        self.0.store.log_path(id)
    }

    /// Returns the figures of the service as text. Blocking.
    pub(in crate::serve) fn metrics(&self) -> String {
        let free_bytes = self.0.store.free_bytes().unwrap_or_default();
        let (counts, queue) = {
            let index = self.0.index();
            let count = |state| index.jobs.values().filter(|job| job.state() == state).count();
            (State::ALL.map(|state| (state, count(state))), index.queue.len())
        };
        self.0.metrics.text(&counts, queue, free_bytes)
    }

    /// Returns the finished log of a job, checked to be what the job wrote: read through once after
    /// each start, and whenever the file has changed.
    pub(in crate::serve) async fn log(&self, id: Uuid) -> Result<PathBuf, Refusal> {
        let view = self.brief(id)?;
        match (view.state.is_final(), view.has_log) {
            (true, true) => {}
            (true, false) => return Err(Refusal::NoLog),
            (false, _) => return Err(Refusal::LogUnfinished { eta_s: view.eta_s }),
        }
        self.0.store.check()?;
        let path = self.0.store.log_path(id);
        // An older build kept no checksum.
        let Some(known) = view.log else { return Ok(path) };
        if self.0.is_known(id, &path) {
            return Ok(path);
        }
        // The semaphore is never closed.
        let _turn = self.0.summing.acquire().await;
        if self.0.is_known(id, &path) {
            return Ok(path);
        }
        let shared = self.0.clone();
        let checked = tokio::task::spawn_blocking(move || {
            let failed = StoreError::reading_a_log;
            let found = match path.symlink_metadata() {
                Err(error) if error.kind() == io::ErrorKind::NotFound => None,
                found => Some(found.map_err(failed)?),
            };
            // A link planted in the data directory must not lead out of it.
            let Some(found) = found.filter(Metadata::is_file) else {
                // The job was forgotten since it was looked up.
                if !shared.index().jobs.contains_key(&id) {
                    return Err(Refusal::UnknownJob);
                }
                tracing::error!(job = %id, "log missing");
                return Err(Refusal::LogDamaged);
            };
            let identity = Identity::of(&found);
            let stopped = || shared.index().alive.is_none();
            let sum = LogSum::of(&path, stopped).map_err(failed)?.ok_or(Refusal::Stopping)?;
            if sum != known {
                tracing::error!(job = %id, bytes = sum.bytes, sha256 = sum.sha256, "log damaged");
                return Err(Refusal::LogDamaged);
            }
            shared.sound().insert(id, identity);
            Ok(path)
        });
        checked.await.map_err(|_| Refusal::Stopping)?
    }

    /// Returns the scenario of a job, as accepted.
    pub(in crate::serve) async fn scenario(&self, id: Uuid) -> Result<axum::body::Bytes, Refusal> {
        self.brief(id)?;
        Ok(self.0.store.scenario(id).await?)
    }

    /// Returns the results of the runs that settled a job; `None` if they are not known yet.
    pub(in crate::serve) async fn settled(&self, id: Uuid) -> Result<Option<Settled>, Refusal> {
        Ok(self.0.store.settled(id).await?)
    }

    /// Returns the scenario of a job, as it was sent.
    pub(in crate::serve) async fn sent(&self, id: Uuid) -> Result<axum::body::Bytes, Refusal> {
        self.brief(id)?;
        Ok(self.0.store.sent(id).await?)
    }

    /// Stops a job: a waiting one has ended when this returns, a running one ends at its next step.
    pub(in crate::serve) async fn cancel(&self, id: Uuid) -> Result<View, Refusal> {
        let shared = self.0.clone();
        let alive = self.alive()?;
        to_the_end(async move {
            let record = {
                // A log that was begun gets its end from a worker.
                let begun = shared.store.has_begun(id);
                let mut index = shared.index();
                let job = index.jobs.get_mut(&id).ok_or(Refusal::UnknownJob)?;
                match &mut job.phase {
                    Phase::Ended { .. } | Phase::Aside(_) => return Err(Refusal::JobEnded),
                    Phase::Leaving => None,
                    Phase::Running { control, .. } => {
                        control.cancel();
                        None
                    }
                    Phase::Queued if begun => {
                        job.cancelled = true;
                        index.leave(id);
                        index.back_to_queue(id);
                        shared.work.notify_one();
                        None
                    }
                    Phase::Queued => {
                        let record = job.record(State::Cancelled, None);
                        index.leave(id);
                        Some(record)
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
            Local(shared).brief(id)
        })
        .await
    }

    /// Forgets a job that does not run, and its log.
    pub(in crate::serve) async fn forget(&self, id: Uuid) -> Result<(), Refusal> {
        let shared = self.0.clone();
        let alive = self.alive()?;
        to_the_end(async move {
            // Clients stop seeing it before its files are removed.
            let job = {
                let mut index = shared.index();
                let job = index.jobs.get(&id).ok_or(Refusal::UnknownJob)?;
                match job.phase {
                    Phase::Running { .. } | Phase::Leaving => return Err(Refusal::JobRunning),
                    Phase::Ended { .. } | Phase::Aside(_) => {}
                    Phase::Queued => index.leave(id),
                }
                index.remove(id).ok_or(Refusal::UnknownJob)?
            };
            if let Err(error) = shared.store.forget(id).await {
                shared.index().restore(id, job);
                shared.work.notify_one();
                return Err(error.into());
            }
            shared.sound().remove(&id);
            tracing::info!(job = %id, "job forgotten");
            drop(alive);
            Ok(())
        })
        .await
    }

    /// Begins the stop: no new jobs, and running ones are interrupted.
    pub(in crate::serve) fn stop(&self) {
        let mut index = self.0.index();
        index.alive = None;
        for job in index.running() {
            if let Phase::Running { control, .. } = &job.phase {
                control.interrupt();
            }
        }
        drop(index);
        self.0.work.notify_all();
        self.0.halt.notify_all();
    }

    /// Checks whether jobs are taken.
    pub(in crate::serve) fn check(&self) -> Result<(), Refusal> {
        self.alive()?;
        Ok(self.0.store.check()?)
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
                self.index().back_to_queue(id);
                self.work.notify_one();
                Err(error)
            }
        }
    }

    fn sound(&self) -> MutexGuard<'_, HashMap<Uuid, Identity>> {
        self.sound.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns whether a log is the file that was found sound before.
    fn is_known(&self, id: Uuid, path: &Path) -> bool {
        let found = path.symlink_metadata().ok().map(|found| Identity::of(&found));
        found.is_some() && self.sound().get(&id).copied() == found
    }
}

/// Returns a job of the store: one that ended, or one that waits.
async fn resume_job(store: &Store, found: Found) -> (Uuid, Job) {
    let Found { id, key, attempts, cancelled, ended, .. } = found;
    if ended {
        let job = match found.line {
            Some(Line::Ended(ending)) => Job::ended(ending),
            _ => unindexed(store, &found).await,
        };
        return (id, Job { key, ..job });
    }
    let job = match found.line {
        Some(Line::Waits(waiting)) => {
            let owed_bytes = waiting.size.map_or(0, |size| size.log_bytes);
            let owed_bytes = owed_bytes.saturating_sub(found.part_bytes);
            Job { size: waiting.size, owed_bytes, ..Job::new(&waiting.name, attempts) }
        }
        _ => Job::new("", attempts),
    };
    (id, Job { key, cancelled, suspect: attempts > 0, ..job })
}

/// Returns a job that has ended and is not in the index.
async fn unindexed(store: &Store, found: &Found) -> Job {
    match store.record(found.id).await {
        Ok(record) => {
            let ending = Ending::of(found.id, &record);
            store.add_to_index(&Line::Ended(ending.clone()));
            Job::ended(ending)
        }
        Err(error) => {
            tracing::error!(job = %found.id, error = chain(&error), "result unreadable");
            let record = Job::new("", found.attempts).record(State::Failed, None);
            Job::ended(Ending { has_log: found.has_log, ..Ending::of(found.id, &record) })
        }
    }
}
