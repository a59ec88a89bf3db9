//! Studies over HTTP: one at a time, on a thread of their own, in addition to the jobs.
//!
//! Invariants: all state is behind one std mutex, held for moments; a study runs without it. A
//! request is on the disk before the answer, and results are before they are shown; a study without
//! a result is made again at the next start, in a process of its own if the service ended during
//! it.

mod question;
mod worker;

use std::collections::{BTreeMap, VecDeque};
use std::path::PathBuf;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError, TryLockError};
use std::thread::{self, JoinHandle};

use chrono::{DateTime, Utc};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use tokio::runtime::Handle;
use uuid::Uuid;

use super::ids::{Ids, created};
use super::job::State;
use super::store::{FoundStudy, StoreError, StudyStore};
use super::{Limits, ServeError, chain};
use crate::chart;
use crate::log::part_path;
use crate::run::Control;
use crate::scenario::ScenarioError;
use crate::study::precision::timing;
use crate::study::stability::Border;
use crate::study::table::Row;
use crate::sweep::Sweep;
pub(super) use question::{Answer, Body, Kind, Question, Unanswered};
use question::{PICTURE, TABLE};

/// Studies that may wait.
const QUEUE: usize = 16;
/// Studies that are kept, the oldest ended ones forgotten first.
const KEPT: usize = 64;
/// End of a study: the text of its `result.json`.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Record {
    kind: Kind,
    name: String,
    state: State,
    runs: u64,
    runs_done: u64,
    /// Reason why it has no result.
    error: Option<String>,
    answer: Answer,
}

/// State of a study.
#[derive(Clone, Debug)]
enum Phase {
    Queued,
    Running,
    /// Being written to the store.
    Busy,
    Ended(Arc<Record>),
}

#[derive(Debug)]
struct Study {
    kind: Kind,
    name: String,
    attempts: u32,
    /// Whether the process ended during its last run.
    suspect: bool,
    phase: Phase,
    /// Handle to follow and stop it.
    control: Arc<Control>,
}

#[derive(Debug, Default)]
struct Index {
    studies: BTreeMap<Uuid, Study>,
    queue: VecDeque<Uuid>,
    stopping: bool,
}

#[derive(Debug)]
struct Shared {
    index: Mutex<Index>,
    work: Condvar,
    store: StudyStore,
    ids: Ids,
    limits: Limits,
    /// Held by the request that draws an unfinished sweep.
    drawing: Mutex<()>,
    /// Program that carries out errands in a process of its own.
    program: Option<PathBuf>,
    runtime: Handle,
}

/// Handle on the studies; copies are the same. Calls that write to the store block.
#[derive(Clone, Debug)]
pub(super) struct Studies(Arc<Shared>);

/// A study as a client sees it.
#[derive(Clone, Debug, Serialize, JsonSchema)]
#[schemars(rename = "Study")]
pub(super) struct StudyView {
    /// Its id.
    #[schemars(with = "String")]
    pub(super) id: Uuid,
    /// Kind of the study.
    kind: Kind,
    /// Name of the scenario.
    name: String,
    state: State,
    /// Time when it was taken.
    created: Option<DateTime<Utc>>,
    /// Runs made.
    runs_done: u64,
    /// Runs to be made, as far as that is known.
    runs: u64,
    /// Reason why it has no result.
    #[serde(skip_serializing_if = "Option::is_none")]
    error: Option<String>,
    /// Time in seconds, stated error and cross-check of the reference.
    #[serde(skip_serializing_if = "Option::is_none")]
    reference: Option<[f64; 3]>,
    /// One row a run; not in lists.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[schemars(with = "Vec<Row>", default)]
    rows: Vec<Value>,
    /// How the times in its rows were measured, where they were.
    #[serde(skip_serializing_if = "Option::is_none")]
    timing: Option<String>,
    /// The largest usable steps; not in lists.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[schemars(with = "Vec<Border>", default)]
    borders: Vec<Value>,
    /// Addresses of the table and the charts.
    links: Vec<String>,
}

/// The studies that are kept, newest first.
#[derive(Debug, Default, Serialize, JsonSchema)]
pub(super) struct StudyList {
    studies: Vec<StudyView>,
}

/// Reason why a study is not taken, found or shown.
#[derive(Debug, thiserror::Error)]
pub(super) enum StudyRefusal {
    #[error("{QUEUE} studies are already waiting: try again later")]
    QueueFull,
    #[error("there is no study with this id")]
    Unknown,
    #[error("the study has no such file, or does not have it yet")]
    NoFile,
    #[error("the study is running: cancel it first")]
    Running,
    #[error("the picture of a sweep that has not ended is being drawn: try again later")]
    Drawing,
    #[error("{0}")]
    Member(ScenarioError),
    #[error(
        "the sweep is expected to take {estimate_s:.0} s of computing on one core, more than the {limit_s:.0} s allowed here"
    )]
    TooExpensive { estimate_s: f64, limit_s: f64 },
    #[error("the table is expected to take {estimate} bytes, more than the {limit} allowed here")]
    TableTooLarge { estimate: u64, limit: u64 },
    #[error(transparent)]
    Store(#[from] StoreError),
}

/// The table of a study.
pub(super) enum TableOf {
    Text(String),
    /// Table of a sweep; while it is made, the lines so far, below one that describes them.
    File {
        path: PathBuf,
        finished: bool,
    },
}

impl Studies {
    /// Resumes the studies of the store and starts the thread that makes them; it ends after [`Studies::stop`].
    pub(super) async fn start(
        store: StudyStore,
        limits: Limits,
        program: Option<PathBuf>,
    ) -> Result<(Self, JoinHandle<()>), ServeError> {
        let unreadable = |error: StoreError| ServeError::Record { message: chain(&error) };
        let mut index = Index::default();
        let (found, aside) = store.scan().await.map_err(unreadable)?;
        tracing::info!(studies = found.len(), aside, "record of the studies read");
        for found in found {
            let id = found.id;
            let Some(study) = resume_job(found) else { continue };
            if matches!(study.phase, Phase::Queued) {
                index.queue.push_back(id);
            }
            index.studies.insert(id, study);
        }
        let ids = Ids::after(index.studies.keys().copied());
        let (index, work) = (Mutex::new(index), Condvar::new());
        let runtime = Handle::current();
        let shared = Arc::new(Shared {
            index,
            work,
            store,
            ids,
            limits,
            drawing: Mutex::new(()),
            program,
            runtime,
        });
        let worker = shared.clone();
        let thread = thread::Builder::new().name("studies".to_owned()).spawn(move || {
            super::give_way();
            worker.work();
        })?;
        Ok((Self(shared), thread))
    }

    /// Begins the stop: a study that runs is interrupted, to be made again at the next start.
    pub(super) fn stop(&self) {
        let mut index = self.0.index();
        index.stopping = true;
        for study in index.studies.values().filter(|study| matches!(study.phase, Phase::Running)) {
            study.control.interrupt();
        }
        drop(index);
        self.0.work.notify_all();
    }

    /// Takes a study. Blocking.
    pub(super) fn submit(
        &self,
        question: Question,
        request: &[u8],
    ) -> Result<StudyView, StudyRefusal> {
        if let Question::Sweep(sweep) = &question {
            let (estimate_s, estimate) = sweep.estimate().map_err(StudyRefusal::Member)?;
            let Limits { run_s: limit_s, log_bytes: limit, .. } = self.0.limits;
            if !(estimate_s <= limit_s) {
                return Err(StudyRefusal::TooExpensive { estimate_s, limit_s });
            }
            if estimate > limit {
                return Err(StudyRefusal::TableTooLarge { estimate, limit });
            }
        }
        let id = self.0.ids.next();
        let mut index = self.0.index();
        if index.studies.values().filter(|study| study.waits()).count() >= QUEUE {
            return Err(StudyRefusal::QueueFull);
        }
        let study = Study {
            kind: question.kind(),
            name: question.name().to_owned(),
            attempts: 0,
            suspect: false,
            phase: Phase::Busy,
            control: Arc::default(),
        };
        let view = study.view(id);
        index.studies.insert(id, study);
        drop(index);
        if let Err(error) = self.0.runtime.block_on(self.0.store.keep(id, request)) {
            self.0.index().studies.remove(&id);
            return Err(error.into());
        }
        let mut index = self.0.index();
        if let Some(study) = index.studies.get_mut(&id) {
            study.phase = Phase::Queued;
            index.queue.push_back(id);
        }
        let forgotten = index.forget_oldest();
        drop(index);
        self.0.work.notify_one();
        for id in forgotten {
            if let Err(error) = self.0.store.forget(id) {
                tracing::warn!(study = %id, error = chain(&error), "an old study stays on the disk");
            }
        }
        Ok(view)
    }

    /// Returns all studies, newest first, without their tables.
    pub(super) fn list(&self) -> StudyList {
        let index = self.0.index();
        let brief = |(id, study): (&Uuid, &Study)| study.brief(*id);
        StudyList { studies: index.studies.iter().rev().map(brief).collect() }
    }

    /// Returns one study.
    pub(super) fn get(&self, id: Uuid) -> Result<StudyView, StudyRefusal> {
        let index = self.0.index();
        index.studies.get(&id).map(|study| study.view(id)).ok_or(StudyRefusal::Unknown)
    }

    /// Stops a study. Blocking.
    pub(super) fn cancel(&self, id: Uuid) -> Result<StudyView, StudyRefusal> {
        let mut index = self.0.index();
        index.queue.retain(|queued| *queued != id);
        let study = index.studies.get_mut(&id).ok_or(StudyRefusal::Unknown)?;
        study.control.cancel();
        let waited = matches!(study.phase, Phase::Queued);
        if waited {
            study.phase = Phase::Busy;
        }
        drop(index);
        if waited {
            self.0.end(id, State::Cancelled, None, Answer::default())?;
        }
        self.get(id)
    }

    /// Forgets a study that does not run. Blocking.
    pub(super) fn forget(&self, id: Uuid) -> Result<(), StudyRefusal> {
        let mut index = self.0.index();
        match index.studies.get(&id).map(|study| &study.phase) {
            None => return Err(StudyRefusal::Unknown),
            Some(Phase::Running | Phase::Busy) => return Err(StudyRefusal::Running),
            Some(Phase::Queued | Phase::Ended(_)) => {}
        }
        index.queue.retain(|queued| *queued != id);
        index.studies.remove(&id);
        drop(index);
        Ok(self.0.store.forget(id)?)
    }

    /// Returns the table of a study. Blocking.
    pub(super) fn table(&self, id: Uuid) -> Result<TableOf, StudyRefusal> {
        if self.kind(id)? != Kind::Sweep {
            return self.file(id, TABLE).map(TableOf::Text);
        }
        let path = self.0.store.folder(id).join(TABLE);
        let part = part_path(&path);
        // If it is finished between the first two looks, it is there at the third.
        let there = [(&path, true), (&part, false), (&path, true)];
        let found = there.into_iter().find(|(path, _)| path.is_file());
        let (path, finished) = found.ok_or(StudyRefusal::NoFile)?;
        Ok(TableOf::File { path: path.clone(), finished })
    }

    /// Returns the scenario of a member of a sweep. Blocking.
    pub(super) fn member(&self, id: Uuid, member: u64) -> Result<Vec<u8>, StudyRefusal> {
        let scenario = self.sweep(id)?.scenario(member).map_err(StudyRefusal::Member)?;
        Ok(scenario.to_json())
    }

    /// Returns the request of a sweep.
    fn sweep(&self, id: Uuid) -> Result<Box<Sweep>, StudyRefusal> {
        if self.kind(id)? != Kind::Sweep {
            return Err(StudyRefusal::NoFile);
        }
        let request = self.0.runtime.block_on(self.0.store.request(id))?;
        match Question::from_json(&request) {
            Ok(Question::Sweep(sweep)) => Ok(sweep),
            Ok(Question::Methods(_)) => Err(StudyRefusal::NoFile),
            // This build does not take the request.
            Err(error) => Err(StudyRefusal::Member(error)),
        }
    }

    fn kind(&self, id: Uuid) -> Result<Kind, StudyRefusal> {
        self.0.index().studies.get(&id).map(|study| study.kind).ok_or(StudyRefusal::Unknown)
    }

    /// Returns a table or a chart of a study; the picture of a sweep that has not ended is drawn as
    /// far as it has come. Blocking.
    pub(super) fn file(&self, id: Uuid, name: &str) -> Result<String, StudyRefusal> {
        let index = self.0.index();
        let study = index.studies.get(&id).ok_or(StudyRefusal::Unknown)?;
        if let Phase::Ended(record) = &study.phase
            && let Some((_, text)) = record.answer.files.iter().find(|(file, _)| *file == name)
        {
            return Ok(text.clone());
        }
        let drawn = study.kind == Kind::Sweep && name == PICTURE;
        drop(index);
        if drawn { self.picture(id) } else { Err(StudyRefusal::NoFile) }
    }

    fn picture(&self, id: Uuid) -> Result<String, StudyRefusal> {
        // One at a time, because each reads a whole table; waiting would take a thread from others.
        let _turn = match self.0.drawing.try_lock() {
            Ok(turn) => turn,
            Err(TryLockError::Poisoned(poisoned)) => poisoned.into_inner(),
            Err(TryLockError::WouldBlock) => return Err(StudyRefusal::Drawing),
        };
        let TableOf::File { path, .. } = self.table(id)? else { return Err(StudyRefusal::NoFile) };
        let shown = self.sweep(id)?.shown(&path, None).map_err(|_| StudyRefusal::NoFile)?;
        chart::sweep(&shown).map_err(|_| StudyRefusal::NoFile)
    }
}

/// Returns a study of the store: one that ended, or one to be made (again). `None` if it is unknown
/// what it was.
fn resume_job(found: FoundStudy) -> Option<Study> {
    let FoundStudy { id, attempts, request, result } = found;
    let damaged = |error: &dyn std::error::Error| {
        tracing::error!(study = %id, error = chain(error), "record of a study unreadable");
    };
    let request = request.inspect_err(|error| damaged(error)).ok();
    let failed = |error: String| {
        // As much of the request as this build still understands.
        let request: Value = serde_json::from_slice(request.as_deref()?).ok()?;
        Some(Record {
            kind: Kind::deserialize(&request["kind"]).ok()?,
            name: request["scenario"]["name"].as_str().unwrap_or_default().to_owned(),
            state: State::Failed,
            runs: 0,
            runs_done: 0,
            error: Some(error),
            answer: Answer::default(),
        })
    };
    let record = match result {
        Some(Ok(text)) => match serde_json::from_slice(&text) {
            Ok(record) => Some(record),
            Err(error) => {
                damaged(&error);
                failed("the result cannot be read".to_owned())
            }
        },
        Some(Err(error)) => {
            damaged(&error);
            failed("the result cannot be read".to_owned())
        }
        // It is checked where it is made whether this build takes the request.
        None => {
            let request: Value = serde_json::from_slice(request.as_deref()?).ok()?;
            return Some(Study {
                kind: Kind::deserialize(&request["kind"]).ok()?,
                name: request["scenario"]["name"].as_str().unwrap_or_default().to_owned(),
                attempts,
                suspect: attempts > 0,
                phase: Phase::Queued,
                control: Arc::default(),
            });
        }
    }?;
    let control = Control::default();
    control.settling.total.store(record.runs, Ordering::Relaxed);
    control.settling.done.store(record.runs_done, Ordering::Relaxed);
    let (kind, name, control) = (record.kind, record.name.clone(), Arc::new(control));
    let phase = Phase::Ended(Arc::new(record));
    Some(Study { kind, name, attempts, suspect: false, phase, control })
}

impl Index {
    /// Takes the oldest ended studies out that are too many.
    fn forget_oldest(&mut self) -> Vec<Uuid> {
        let surplus = self.studies.len().saturating_sub(KEPT);
        let ended = self.studies.iter().filter(|(_, study)| study.state().is_final());
        let oldest: Vec<Uuid> = ended.map(|(id, _)| *id).take(surplus).collect();
        for id in &oldest {
            self.studies.remove(id);
        }
        oldest
    }
}

impl Study {
    fn state(&self) -> State {
        match &self.phase {
            Phase::Queued | Phase::Busy => State::Queued,
            Phase::Running => State::Running,
            Phase::Ended(record) => record.state,
        }
    }

    fn waits(&self) -> bool {
        self.state() == State::Queued
    }

    fn view(&self, id: Uuid) -> StudyView {
        let view = self.brief(id);
        match &self.phase {
            Phase::Ended(record) => {
                let Answer { rows, borders, .. } = &record.answer;
                let timed = record.kind == Kind::Precision && !rows.is_empty();
                let timing = timed.then(timing);
                StudyView { rows: rows.clone(), timing, borders: borders.clone(), ..view }
            }
            _ => view,
        }
    }

    /// Returns the study without its rows and borders.
    fn brief(&self, id: Uuid) -> StudyView {
        let record = match &self.phase {
            Phase::Ended(record) => Some(record),
            _ => None,
        };
        let answer = record.map(|record| &record.answer);
        // A sweep has a picture and a table from its beginning on.
        let begun = self.kind == Kind::Sweep && !self.waits();
        let unfinished = begun && answer.is_none_or(|answer| answer.files.is_empty());
        let link = |name: &str| match name.strip_suffix(".svg") {
            Some(_) => format!("/studies/{id}/charts/{name}"),
            None => format!("/studies/{id}/{name}"),
        };
        StudyView {
            id,
            kind: self.kind,
            name: self.name.clone(),
            state: self.state(),
            created: created(id),
            runs_done: self.control.settling.done.load(Ordering::Relaxed),
            runs: self.control.settling.total.load(Ordering::Relaxed),
            error: record.and_then(|record| record.error.clone()),
            reference: answer.and_then(|answer| answer.reference),
            rows: Vec::new(),
            timing: None,
            borders: Vec::new(),
            links: answer
                .into_iter()
                .flat_map(|answer| answer.files.iter().map(|(name, _)| name.as_str()))
                .chain(unfinished.then_some(PICTURE))
                .chain(begun.then_some(TABLE))
                .map(link)
                .collect(),
        }
    }
}

impl Shared {
    fn index(&self) -> MutexGuard<'_, Index> {
        // A panic leaves the index whole: no change of it spans a call that may panic.
        self.index.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
