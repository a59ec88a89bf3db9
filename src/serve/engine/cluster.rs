//! The engine of many machines: the record is in a bucket, and Temporal hands each job to one of the workers.
//!
//! ```text
//! POST /jobs → bucket (durable) → Temporal: workflow job-<id> → activity → worker (work) → bucket (log, result)
//! ```
//!
//! Invariants: the bucket is the record. Whether a job waits, runs or has ended is read from the names that stand there, so that
//! any number of services give the same answers; Temporal is asked only how far a run has come. A job without a result
//! whose workflow is gone gets another one: what Temporal loses is late and not lost.

mod copies;
mod served;
pub(in crate::serve) mod sweeps;
pub(in crate::serve) mod work;

use std::collections::{BTreeMap, HashMap, HashSet};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use axum::body::Bytes;
use chrono::{DateTime, Utc};
use futures_util::{StreamExt, stream};
use temporalio_client::envconfig::LoadClientConfigProfileOptions;
use temporalio_client::errors::{WorkflowInteractionError, WorkflowStartError};
use temporalio_client::{
    Client, ClientOptions, Connection, WorkflowCancelOptions, WorkflowDescribeOptions,
    WorkflowExecutionStatus, WorkflowIdConflictPolicy, WorkflowListOptions, WorkflowStartOptions,
};
use uuid::Uuid;

use super::Refusal;
use crate::advise::Settled;
use crate::plan::Plan;
use crate::scenario::Scenario;
use crate::serve::ids::{Ids, now};
use crate::serve::job::{Job, State, View};
use crate::serve::metrics::Metrics;
use crate::serve::store::bucket::{Bucket, BucketError, Held};
use crate::serve::store::{Ending, KeptPlan, LogSum, Size, Waiting, parse_id};
use crate::serve::{Limits, ServeError, chain};

use copies::Copies;
pub(in crate::serve) use served::Served;
use work::{Beat, Flow, Task, task_timeout};

/// Time for which the last view of a job serves repeated requests.
const LOOK: Duration = Duration::from_millis(500);

/// Time for which the list of all jobs serves repeated requests.
const LOOK_AT_ALL: Duration = Duration::from_secs(1);

/// Interval at which all names are read, and not only those of jobs that may have changed.
const LOOK_AT_OLD: Duration = Duration::from_secs(60);

/// Interval at which workflows that could not be started are tried again.
const START_AGAIN: Duration = Duration::from_secs(2);

/// Interval of the search for jobs that Temporal has forgotten.
const LOOK_FOR_LOST: Duration = Duration::from_secs(20);

/// Time that an answer waits for Temporal: the job is kept by then.
const HAND_OVER: Duration = Duration::from_secs(1);

/// Prefix of the name of the workflow of a job.
const FLOW: &str = "job-";

/// Number of requests at once where many jobs are looked at.
const WIDTH: usize = 16;

/// Addresses by which a service and its workers find each other.
#[derive(Clone, Debug)]
pub struct ClusterConfig {
    /// The address of the record: `s3://NAME/PREFIX`, or `file:///DIRECTORY` on a file system that all machines share.
    pub bucket: String,
    /// The address of Temporal, as `127.0.0.1:7233`. Namespace, key and certificates are in its usual variables.
    pub temporal: String,
    /// The name of the queue, which service and workers share.
    pub queue: String,
    /// Time within which a worker gives a sign of life, or its job goes to another one (after seven
    /// tenths of it).
    pub lease: Duration,
}

/// Reason why the other machines cannot be reached.
#[derive(Debug, thiserror::Error)]
pub enum ClusterError {
    /// The address of Temporal is not valid, or its variables cannot be used.
    #[error("the address of Temporal {given:?} cannot be used: {message}; write HOST:PORT")]
    Address {
        /// The address.
        given: String,
        /// Description of the error.
        message: String,
    },
    /// Temporal does not answer.
    #[error("Temporal at {address} does not answer: {message}")]
    Silent {
        /// The address.
        address: String,
        /// Error of the connection.
        message: String,
    },
    /// The record cannot be opened.
    #[error(transparent)]
    Bucket(#[from] BucketError),
    /// A worker could not start, or broke off.
    #[error("the worker broke off: {message}")]
    Worker {
        /// Reason for that.
        message: String,
    },
}

impl ClusterError {
    /// Returns whether the configuration is wrong, so that trying again is of no use.
    pub(crate) fn is_bad_input(&self) -> bool {
        matches!(self, Self::Address { .. } | Self::Bucket(BucketError::Address { .. }))
    }
}

/// Connects to Temporal.
async fn connect(config: &ClusterConfig) -> Result<Client, ClusterError> {
    let wrong = |message: String| ClusterError::Address { given: config.temporal.clone(), message };
    let silent =
        |message: String| ClusterError::Silent { address: config.temporal.clone(), message };
    let loaded = ClientOptions::load_from_config(LoadClientConfigProfileOptions::default());
    let (mut connection, options) = loaded.map_err(|error| wrong(chain(&error)))?;
    let encrypted = connection.tls_options.is_some() || connection.api_key.is_some();
    let address = match config.temporal.contains("://") {
        true => config.temporal.clone(),
        false if encrypted => format!("https://{}", config.temporal),
        false => format!("http://{}", config.temporal),
    };
    connection.target = address.parse().map_err(|_| wrong("this is not an address".to_owned()))?;
    connection.connect_timeout = Some(Duration::from_secs(10));
    let connected = Connection::connect(connection).await;
    let connection = connected.map_err(|error| silent(chain(&error)))?;
    Client::new(connection, options).map_err(|error| silent(error.to_string()))
}

/// A handle on the engine; copies are the same engine.
#[derive(Clone, Debug)]
pub(in crate::serve) struct Cluster(Arc<Inner>);

struct Inner {
    bucket: Bucket,
    client: Client,
    queue: String,
    lease: Duration,
    limits: Limits,
    copies: Copies,
    metrics: Metrics,
    begun: DateTime<Utc>,
    ids: Ids,
    is_ready: AtomicBool,
    /// Ends of jobs, which do not change any more.
    ended: Mutex<HashMap<Uuid, Ending>>,
    /// Names and sizes of jobs that have not ended.
    waiting: Mutex<HashMap<Uuid, Waiting>>,
    /// Recent views of jobs.
    seen: Mutex<HashMap<Uuid, (Instant, View)>>,
    listing: tokio::sync::Mutex<Listing>,
    /// Jobs that have no workflow yet.
    unstarted: Mutex<HashSet<Uuid>>,
}

impl std::fmt::Debug for Inner {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "the cluster of the queue {}", self.queue)
    }
}

/// All jobs, as they were a moment ago.
#[derive(Default)]
struct Listing {
    jobs: BTreeMap<Uuid, Held>,
    at: Option<Instant>,
    whole_at: Option<Instant>,
}

fn lock<T>(of: &Mutex<T>) -> MutexGuard<'_, T> {
    // A panic leaves the maps whole.
    of.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Returns the name of the workflow of a job.
fn flow_id(id: Uuid) -> String {
    format!("{FLOW}{id}")
}

impl Cluster {
    /// Opens the record and the connection to the workers; jobs without a result are handed to
    /// them.
    pub(in crate::serve) async fn start(
        config: &ClusterConfig,
        bucket: Bucket,
        data: &std::path::Path,
        limits: Limits,
    ) -> Result<Self, ServeError> {
        let client = connect(config).await?;
        let cluster = Self(Arc::new(Inner {
            bucket,
            client,
            queue: config.queue.clone(),
            lease: config.lease,
            limits,
            copies: Copies::open(data, limits.log_bytes)?,
            metrics: Metrics::new(0),
            begun: now(),
            ids: Ids::after([]),
            is_ready: AtomicBool::new(true),
            ended: Mutex::default(),
            waiting: Mutex::default(),
            seen: Mutex::default(),
            listing: tokio::sync::Mutex::default(),
            unstarted: Mutex::default(),
        }));
        let unreadable = |error: Refusal| ServeError::Record { message: chain(&error) };
        let jobs = cluster.all().await.map_err(unreadable)?;
        let open = jobs.iter().filter(|(_, held)| !held.ended).map(|(id, _)| *id);
        lock(&cluster.0.unstarted).extend(open);
        tracing::info!(
            jobs = jobs.len(),
            unended = lock(&cluster.0.unstarted).len(),
            "record read"
        );
        tokio::spawn(cluster.clone().start_again());
        Ok(cluster)
    }

    /// Starts workflows that could not be started, for as long as the service lives.
    async fn start_again(self) {
        let mut looked = Instant::now();
        while self.check().is_ok() {
            if looked.elapsed() > LOOK_FOR_LOST {
                looked = Instant::now();
                if let Err(error) = self.find_lost().await {
                    tracing::warn!(error = chain(&*error), "not known whether a job is lost");
                }
            }
            let unstarted: Vec<_> = lock(&self.0.unstarted).iter().copied().collect();
            for id in unstarted {
                if !self.hand_over(id).await {
                    break;
                }
            }
            tokio::time::sleep(START_AGAIN).await;
        }
    }

    /// Finds jobs without a result whose workflow Temporal does not know.
    async fn find_lost(&self) -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
        // Recent jobs may not be in Temporal's list yet.
        let before = minute_ago();
        let all = self.all().await?;
        let mut lost: HashSet<_> =
            all.iter().filter(|(_, held)| !held.ended).map(|(id, _)| *id).collect();
        lost.retain(|id| *id < before);
        if lost.is_empty() {
            return Ok(());
        }
        let query = format!("TaskQueue = '{}' AND ExecutionStatus = 'Running'", self.0.queue);
        let mut known = self.0.client.list_workflows(query, WorkflowListOptions::default());
        while let Some(flow) = known.next().await {
            if let Some(id) = flow?.id().strip_prefix(FLOW).and_then(parse_id) {
                lost.remove(&id);
            }
        }
        lock(&self.0.unstarted).extend(lost);
        Ok(())
    }

    /// Hands a job to the workers; returns whether that succeeded.
    async fn hand_over(&self, id: Uuid) -> bool {
        let task = Task { id, lease_s: self.0.lease.as_secs_f64() };
        let options = WorkflowStartOptions::new(self.0.queue.clone(), flow_id(id))
            .task_timeout(task_timeout(self.0.lease))
            .id_conflict_policy(WorkflowIdConflictPolicy::UseExisting)
            .build();
        match self.0.client.start_workflow(Flow::run, task, options).await {
            Ok(_) | Err(WorkflowStartError::AlreadyStarted { .. }) => {
                lock(&self.0.unstarted).remove(&id);
                true
            }
            Err(error) => {
                tracing::warn!(job = %id, error = chain(&error), "job not handed over; trying again");
                lock(&self.0.unstarted).insert(id);
                false
            }
        }
    }

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
        self.check()?;
        let waiting =
            self.all().await?.values().filter(|held| !held.ended && held.attempts == 0).count();
        if waiting >= self.0.limits.queue {
            return Err(Refusal::QueueFull { limit: self.0.limits.queue });
        }
        let (id, text) = (self.0.ids.next(), scenario.to_json());
        let id = match key {
            None => id,
            // A submission that died between the key and the scenario left an id that this job
            // takes.
            Some(key) => {
                let first = self.0.bucket.claim(key, id).await?;
                match self.0.bucket.scenario(first).await? {
                    Some(earlier) if earlier[..] != *text => return Err(Refusal::KeyReused),
                    Some(_) => return self.get(first).await,
                    None => first,
                }
            }
        };
        let cluster = self.clone();
        super::to_the_end(async move {
            let bucket = &cluster.0.bucket;
            let job = Job { key, ..Job::new(scenario.name(), 0) };
            // Its plan goes first: a job on record has it.
            let job = match planned {
                Some((settled, plan)) => {
                    bucket.keep_plan(id, &KeptPlan::new(settled, &plan)?).await?;
                    job.planned(&plan)
                }
                None => job,
            };
            bucket.accept(id, text, sent).await?;
            let (name, size) = (job.name.clone(), job.size);
            lock(&cluster.0.waiting).insert(id, Waiting { id, name, size });
            cluster
                .0
                .listing
                .lock()
                .await
                .jobs
                .insert(id, Held { accepted: true, ..Held::default() });
            lock(&cluster.0.unstarted).insert(id);
            let _ = tokio::time::timeout(HAND_OVER, cluster.hand_over(id)).await;
            tracing::info!(job = %id, name = job.name, "job accepted");
            cluster.0.metrics.accept();
            Ok(job.view(id))
        })
        .await
    }

    pub(in crate::serve) async fn get(&self, id: Uuid) -> Result<View, Refusal> {
        let mut view = self.brief(id).await?;
        if !view.state.is_final() {
            view.plan = self.0.bucket.plan(id).await?;
            return Ok(view);
        }
        let Some(record) = self.0.bucket.record(id).await? else {
            // The job was forgotten by another service.
            lock(&self.0.ended).remove(&id);
            return Err(Refusal::UnknownJob);
        };
        view.plan.clone_from(&record.plan);
        view.record = Some(record);
        Ok(view)
    }

    pub(in crate::serve) async fn brief(&self, id: Uuid) -> Result<View, Refusal> {
        if let Some(ending) = lock(&self.0.ended).get(&id) {
            return Ok(Job::ended(ending.clone()).view(id));
        }
        if let Some((at, view)) = lock(&self.0.seen).get(&id)
            && at.elapsed() < LOOK
        {
            return Ok(view.clone());
        }
        let held = self.0.bucket.look(id).await?;
        if !held.accepted {
            return Err(Refusal::UnknownJob);
        }
        self.view(id, held).await
    }

    /// Returns the view of a job from its state in the bucket.
    async fn view(&self, id: Uuid, held: Held) -> Result<View, Refusal> {
        if held.ended {
            let ending = self.ending(id).await?;
            return Ok(Job::ended(ending).view(id));
        }
        let waiting = self.waiting(id).await?;
        let job = Job { size: waiting.size, ..Job::new(&waiting.name, held.attempts) };
        let mut view = job.view(id);
        if held.attempts > 0 {
            view.state = State::Running;
            let beat = self.beat(id).await;
            view.steps_done = beat.steps_done;
            view.durable_step = beat.durable_step;
            view.eta_s = beat.eta_s;
        }
        let mut seen = lock(&self.0.seen);
        seen.retain(|_, (at, _)| at.elapsed() < LOOK);
        seen.insert(id, (Instant::now(), view.clone()));
        Ok(view)
    }

    /// Returns how a job ended.
    async fn ending(&self, id: Uuid) -> Result<Ending, Refusal> {
        if let Some(ending) = lock(&self.0.ended).get(&id) {
            return Ok(ending.clone());
        }
        let record = self.0.bucket.record(id).await?.ok_or(Refusal::UnknownJob)?;
        let ending = Ending::of(id, &record);
        let is_new = lock(&self.0.ended).insert(id, ending.clone()).is_none();
        if is_new && record.finished.is_some_and(|finished| finished >= self.0.begun) {
            self.0.metrics.end(&record, record.log.as_ref().map_or(0, |log| log.bytes));
        }
        lock(&self.0.waiting).remove(&id);
        Ok(ending)
    }

    /// Returns name and size of a job that has not ended.
    async fn waiting(&self, id: Uuid) -> Result<Waiting, Refusal> {
        let known = lock(&self.0.waiting).get(&id).cloned();
        if let Some(waiting) = known.filter(|waiting| waiting.size.is_some()) {
            return Ok(waiting);
        }
        let text = self.0.bucket.scenario(id).await?.ok_or(Refusal::UnknownJob)?;
        let settled = self.0.bucket.settled(id).await?;
        let read = move || {
            let name = Scenario::from_json(&text).map(|scenario| scenario.name().to_owned());
            let plan = settled.and_then(|settled| settled.plan().ok());
            Waiting { id, name: name.unwrap_or_default(), size: plan.as_ref().map(Size::of) }
        };
        let waiting = tokio::task::spawn_blocking(read).await.map_err(|_| Refusal::Stopping)?;
        lock(&self.0.waiting).insert(id, waiting.clone());
        Ok(waiting)
    }

    /// Returns the progress of the run of a job, as its worker reports it.
    async fn beat(&self, id: Uuid) -> Beat {
        let handle = self.0.client.get_workflow_handle::<Flow>(flow_id(id));
        match handle.describe(WorkflowDescribeOptions::default()).await {
            Ok(found) if found.status() == WorkflowExecutionStatus::Running => {
                let details = found
                    .raw()
                    .pending_activities
                    .first()
                    .and_then(|one| one.heartbeat_details.as_ref());
                let payload = details.and_then(|details| details.payloads.first());
                payload
                    .and_then(|payload| serde_json::from_slice(&payload.data).ok())
                    .unwrap_or_default()
            }
            // It has no result, or had none a moment ago.
            Ok(_) | Err(WorkflowInteractionError::NotFound(_)) => {
                lock(&self.0.unstarted).insert(id);
                Beat::default()
            }
            Err(error) => {
                tracing::warn!(job = %id, error = chain(&error), "progress unknown");
                Beat::default()
            }
        }
    }

    /// Returns all jobs.
    async fn all(&self) -> Result<BTreeMap<Uuid, Held>, Refusal> {
        let fresh = |at: Option<Instant>, time| at.is_some_and(|at| at.elapsed() < time);
        let mut listing = self.0.listing.lock().await;
        if !fresh(listing.at, LOOK_AT_ALL) {
            let whole = !fresh(listing.whole_at, LOOK_AT_OLD);
            let oldest = listing.jobs.iter().find(|(_, held)| !held.ended);
            let lately = minute_ago();
            let from = match oldest {
                _ if whole => Uuid::nil(),
                Some((id, _)) => lately.min(*id),
                None => lately,
            };
            let found = self.0.bucket.list(from).await?;
            listing.jobs.split_off(&from);
            listing.jobs.extend(found);
            listing.at = Some(Instant::now());
            if whole {
                listing.whole_at = listing.at;
            }
        }
        Ok(listing.jobs.clone())
    }

    pub(in crate::serve) async fn list(
        &self,
        state: Option<State>,
        name: Option<&str>,
        limit: usize,
        cursor: Option<Uuid>,
    ) -> Result<(Vec<View>, Option<Uuid>), Refusal> {
        let all = self.all().await?;
        let name = name.map(str::to_lowercase);
        let older = all.into_iter().rev().filter(|(id, held)| {
            let stands = match state {
                None => true,
                Some(State::Queued) => !held.ended && held.attempts == 0,
                Some(State::Running) => !held.ended && held.attempts > 0,
                Some(_) => held.ended,
            };
            stands && cursor.is_none_or(|cursor| *id < cursor)
        });
        let views = stream::iter(older).map(|(id, held)| self.view(id, held)).buffered(WIDTH);
        let mut views = std::pin::pin!(views);
        let mut page = Vec::new();
        while page.len() <= limit
            && let Some(view) = views.next().await
        {
            let view = match view {
                // The job was forgotten since.
                Err(Refusal::UnknownJob) => continue,
                view => view?,
            };
            let named = |name: &String| view.name.to_lowercase().contains(name.as_str());
            if state.is_none_or(|state| view.state == state) && name.as_ref().is_none_or(named) {
                page.push(view);
            }
        }
        let more = page.len() > limit;
        page.truncate(limit);
        let next = page.last().filter(|_| more).map(|view| view.id);
        Ok((page, next))
    }

    pub(in crate::serve) async fn metrics(&self) -> Result<String, Refusal> {
        let all = self.all().await?;
        let queue = all.values().filter(|held| !held.ended && held.attempts == 0).count();
        let running = all.values().filter(|held| !held.ended && held.attempts > 0).count();
        let mut counts = State::ALL.map(|state| (state, 0));
        let ended: Vec<_> = all.into_iter().filter(|(_, held)| held.ended).collect();
        let mut endings = stream::iter(ended).map(|(id, _)| self.ending(id)).buffered(WIDTH);
        while let Some(ending) = endings.next().await {
            let Ok(ending) = ending else { continue };
            for (state, count) in &mut counts {
                *count += usize::from(*state == ending.state);
            }
        }
        for (state, count) in &mut counts {
            match state {
                State::Queued => *count = queue,
                State::Running => *count = running,
                _ => {}
            }
        }
        Ok(self.0.metrics.text(&counts, queue, self.0.copies.free_bytes()))
    }

    /// Returns size and checksum of the finished log of a job.
    async fn log_sum(&self, id: Uuid) -> Result<LogSum, Refusal> {
        let view = self.brief(id).await?;
        match (view.state.is_final(), view.log) {
            (true, Some(sum)) => Ok(sum),
            (true, None) => Err(Refusal::NoLog),
            (false, _) => Err(Refusal::LogUnfinished { eta_s: view.eta_s }),
        }
    }

    pub(in crate::serve) async fn log(&self, id: Uuid) -> Result<PathBuf, Refusal> {
        let sum = self.log_sum(id).await?;
        self.0.copies.whole(&self.0.bucket, id, &sum).await
    }

    pub(in crate::serve) async fn log_so_far(&self, view: &View) -> Result<PathBuf, Refusal> {
        match (view.state.is_final(), view.has_log) {
            (true, true) => self.log(view.id).await,
            _ => self.0.copies.grown(&self.0.bucket, view.id).await,
        }
    }

    /// Returns the finished log of a job, to be read from the bucket.
    pub(in crate::serve) async fn served(&self, id: Uuid) -> Result<Served, Refusal> {
        let sum = self.log_sum(id).await?;
        let record = self.0.bucket.record(id).await?.ok_or(Refusal::UnknownJob)?;
        Ok(Served::new(self.0.bucket.clone(), id, sum, record.finished))
    }

    pub(in crate::serve) async fn scenario(&self, id: Uuid) -> Result<Bytes, Refusal> {
        self.0.bucket.scenario(id).await?.ok_or(Refusal::UnknownJob)
    }

    pub(in crate::serve) async fn settled(&self, id: Uuid) -> Result<Option<Settled>, Refusal> {
        Ok(self.0.bucket.settled(id).await?)
    }

    pub(in crate::serve) async fn sent(&self, id: Uuid) -> Result<Bytes, Refusal> {
        match self.0.bucket.sent(id).await? {
            Some(sent) => Ok(sent),
            None => self.scenario(id).await,
        }
    }

    pub(in crate::serve) async fn cancel(&self, id: Uuid) -> Result<View, Refusal> {
        let cluster = self.clone();
        super::to_the_end(async move {
            let bucket = &cluster.0.bucket;
            let held = bucket.look(id).await?;
            match (held.accepted, held.ended) {
                (false, _) => return Err(Refusal::UnknownJob),
                (true, true) => return Err(Refusal::JobEnded),
                (true, false) => {}
            }
            // This is first: a worker that is cancelled checks here whether a client asked for it.
            bucket.note_cancel(id).await?;
            tracing::info!(job = %id, "job to be cancelled");
            if held.attempts == 0 {
                let waiting = cluster.waiting(id).await?;
                let plan = bucket.plan(id).await?;
                let job = Job { size: waiting.size, plan, ..Job::new(&waiting.name, 0) };
                bucket.publish(id, &job.record(State::Cancelled, None)).await?;
            }
            let handle = cluster.0.client.get_workflow_handle::<Flow>(flow_id(id));
            if let Err(error) = handle.cancel(WorkflowCancelOptions::default()).await {
                // Its next worker finds the note.
                tracing::warn!(job = %id, error = chain(&error), "worker not notified");
            }
            lock(&cluster.0.seen).remove(&id);
            cluster.brief(id).await
        })
        .await
    }

    pub(in crate::serve) async fn forget(&self, id: Uuid) -> Result<(), Refusal> {
        let cluster = self.clone();
        super::to_the_end(async move {
            let held = cluster.0.bucket.look(id).await?;
            match (held.accepted, held.ended, held.attempts) {
                (false, ..) => return Err(Refusal::UnknownJob),
                (true, false, 1..) => return Err(Refusal::JobRunning),
                _ => {}
            }
            cluster.0.bucket.forget(id).await?;
            lock(&cluster.0.ended).remove(&id);
            lock(&cluster.0.waiting).remove(&id);
            lock(&cluster.0.seen).remove(&id);
            lock(&cluster.0.unstarted).remove(&id);
            cluster.0.listing.lock().await.jobs.remove(&id);
            cluster.0.copies.forget(id).await;
            tracing::info!(job = %id, "job forgotten");
            Ok(())
        })
        .await
    }

    pub(in crate::serve) fn stop(&self) {
        self.0.is_ready.store(false, Ordering::Relaxed);
    }

    /// Checks whether jobs are taken.
    pub(in crate::serve) fn check(&self) -> Result<(), Refusal> {
        if self.0.is_ready.load(Ordering::Relaxed) { Ok(()) } else { Err(Refusal::Stopping) }
    }
}

/// Returns the id of a job that would have been taken a minute ago: clocks of services differ by
/// less.
fn minute_ago() -> Uuid {
    let since = now().timestamp().saturating_sub(60);
    let time = uuid::Timestamp::from_unix(uuid::NoContext, u64::try_from(since).unwrap_or(0), 0);
    Uuid::new_v7(time)
}
