//! Studies over HTTP: one at a time, on a thread of their own, beside the jobs.
//!
//! A study is a question, not a deed: it is kept in memory, the newest few of them, and gone with the process.
//!
//! Invariant: all state sits behind one std mutex, held for moments; a study runs without it.

use std::collections::{BTreeMap, VecDeque};
use std::sync::atomic::Ordering;
use std::sync::mpsc::{self, RecvTimeoutError};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use uuid::Uuid;

use crate::chart::{self, ChartError};
use crate::scenario::{Method, Scenario, ScenarioError};
use crate::study::long_term::long_term;
use crate::study::precision::precision;
use crate::study::stability::{Border, stability};
use crate::study::table::{Row, Table};
use crate::study::{Entry, StudyError, Watch, all_methods, usual_methods};

/// Longest study: nobody waits longer, and others wait behind it.
const LONGEST: Duration = Duration::from_secs(900);
/// Studies that may wait.
const QUEUE: usize = 16;
/// Studies that are kept, the oldest ended ones forgotten first.
const KEPT: usize = 64;
/// Most methods of a study.
const MAX_METHODS: usize = 40;
/// Most steps of a run of a long-term study: all methods make them.
const MAX_STEPS: u64 = 1_000_000;

/// What is studied.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub(super) enum Kind {
    /// Error against step and work.
    Precision,
    /// Energy and orthogonality over the scenario's run.
    LongTerm,
    /// Where each method fails.
    Stability,
}

/// What a client asks for.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(rename = "StudyRequest")]
pub(super) struct Request {
    /// What is studied.
    kind: Kind,
    /// The scenario, as of a job.
    #[schemars(with = "Scenario")]
    scenario: Value,
    /// The methods, as in a scenario; the usual ones if absent.
    #[serde(default)]
    methods: Vec<Method>,
    /// Precision: compare the errors at this time, in seconds; after about one turn if absent.
    #[serde(default)]
    until_s: Option<f64>,
}

/// A request that can be carried out.
#[derive(Clone, Debug)]
pub(super) struct Question {
    kind: Kind,
    scene: Scenario,
    entries: Vec<Entry>,
    until_s: Option<f64>,
}

impl Question {
    /// Reads and checks a request.
    pub(super) fn from_json(text: &[u8]) -> Result<Self, ScenarioError> {
        let tree = crate::scenario::read_tree(text)?;
        let Request { kind, scenario, methods, until_s } = crate::scenario::from_tree(tree)?;
        let within = |place: String| {
            move |error: ScenarioError| ScenarioError {
                pointer: format!("{place}{}", error.pointer),
                ..error
            }
        };
        let text = scenario.to_string();
        let scene = Scenario::from_json(text.as_bytes()).map_err(within("/scenario".to_owned()))?;
        let refuse = |wrong: bool, pointer: &str, message: String| {
            if wrong { Err(ScenarioError::invalid(pointer, message)) } else { Ok(()) }
        };
        let steps = scene.step_count();
        refuse(
            kind == Kind::LongTerm && !(1..=MAX_STEPS).contains(&steps),
            "/scenario/steps",
            format!("{steps} steps, a long-term study makes 1 to {MAX_STEPS} with each method"),
        )?;
        refuse(
            scene.accuracy.is_some(),
            "/scenario/accuracy",
            "a study is made to choose; give method and step".to_owned(),
        )?;
        refuse(
            methods.len() > MAX_METHODS,
            "/methods",
            format!("{} given, at most {MAX_METHODS} are allowed", methods.len()),
        )?;
        refuse(
            until_s.is_some_and(|until_s| !(until_s > 0.0 && until_s <= 1e9)),
            "/until_s",
            "is not a time above 0 and up to 1e9 s".to_owned(),
        )?;
        let entries = match (methods.is_empty(), kind) {
            (true, Kind::Stability) => all_methods(&scene),
            (true, _) => usual_methods(&scene),
            (false, _) => methods
                .into_iter()
                .enumerate()
                .map(|(at, method)| {
                    Entry::new(&scene, method).map_err(|error| {
                        let pointer =
                            error.pointer.replacen("/method", &format!("/methods/{at}"), 1);
                        ScenarioError { pointer, ..error }
                    })
                })
                .collect::<Result<_, _>>()?,
        };
        Ok(Self { kind, scene, entries, until_s })
    }
}

/// What a study left behind.
#[derive(Clone, Debug, Default)]
struct Answer {
    /// File name and content.
    files: Vec<(&'static str, String)>,
    rows: Vec<Row>,
    borders: Vec<Border>,
    /// Time, stated error and cross-check of the reference.
    reference: Option<[f64; 3]>,
}

/// Where a study stands.
#[derive(Clone, Debug)]
enum Phase {
    Queued(Box<Question>),
    Running,
    Succeeded(Arc<Answer>),
    Failed(String),
    Cancelled,
}

impl Phase {
    fn as_str(&self) -> &'static str {
        match self {
            Self::Queued(_) => "queued",
            Self::Running => "running",
            Self::Succeeded(_) => "succeeded",
            Self::Failed(_) => "failed",
            Self::Cancelled => "cancelled",
        }
    }

    fn has_ended(&self) -> bool {
        !matches!(self, Self::Queued(_) | Self::Running)
    }
}

#[derive(Debug)]
struct Study {
    kind: Kind,
    name: String,
    phase: Phase,
    watch: Arc<Watch>,
}

#[derive(Debug, Default)]
struct Index {
    studies: BTreeMap<Uuid, Study>,
    queue: VecDeque<Uuid>,
}

#[derive(Debug, Default)]
struct Shared {
    index: Mutex<Index>,
    work: Condvar,
}

/// A handle on the studies; copies are the same.
#[derive(Clone, Debug)]
pub(super) struct Studies(Arc<Shared>);

/// A study as a client sees it.
#[derive(Clone, Debug, Serialize, JsonSchema)]
#[schemars(rename = "Study")]
pub(super) struct StudyView {
    /// Its id.
    #[schemars(with = "String")]
    pub(super) id: Uuid,
    /// What is studied.
    kind: Kind,
    /// Name of the scenario.
    name: String,
    /// `queued`, `running`, `succeeded`, `failed` or `cancelled`.
    state: &'static str,
    /// Runs made.
    runs_done: u64,
    /// Runs to be made, as far as that is known.
    runs: u64,
    /// Why it has no result.
    #[serde(skip_serializing_if = "Option::is_none")]
    error: Option<String>,
    /// Time in seconds, stated error and cross-check of the reference.
    #[serde(skip_serializing_if = "Option::is_none")]
    reference: Option<[f64; 3]>,
    /// One row a run.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[schemars(with = "Vec<Value>")]
    rows: Vec<Row>,
    /// The largest usable steps.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[schemars(with = "Vec<Value>")]
    borders: Vec<Border>,
    /// Addresses of the table and the charts.
    links: Vec<String>,
}

/// Why a study is not taken, found or shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub(super) enum StudyRefusal {
    #[error("{QUEUE} studies wait already: try again later")]
    QueueFull,
    #[error("there is no study with this id")]
    Unknown,
    #[error("the study has no such file, or not yet")]
    NoFile,
    #[error("the study is running: cancel it first")]
    Running,
}

impl Studies {
    /// Starts the thread that does the studies.
    pub(super) fn start() -> std::io::Result<Self> {
        let shared = Arc::new(Shared::default());
        let worker = shared.clone();
        thread::Builder::new().name("studies".to_owned()).spawn(move || {
            super::give_way();
            worker.work();
        })?;
        Ok(Self(shared))
    }

    /// Takes a study.
    pub(super) fn submit(&self, question: Question) -> Result<StudyView, StudyRefusal> {
        let id = Uuid::now_v7();
        let mut index = self.0.index();
        if index.queue.len() >= QUEUE {
            return Err(StudyRefusal::QueueFull);
        }
        let study = Study {
            kind: question.kind,
            name: question.scene.name().to_owned(),
            phase: Phase::Queued(Box::new(question)),
            watch: Arc::default(),
        };
        let view = study.view(id);
        index.studies.insert(id, study);
        index.queue.push_back(id);
        while index.studies.len() > KEPT {
            let ended = index.studies.iter().find(|(_, study)| study.phase.has_ended());
            let Some(oldest) = ended.map(|(id, _)| *id) else { break };
            index.studies.remove(&oldest);
        }
        drop(index);
        self.0.work.notify_one();
        Ok(view)
    }

    /// One study.
    pub(super) fn get(&self, id: Uuid) -> Result<StudyView, StudyRefusal> {
        let index = self.0.index();
        index.studies.get(&id).map(|study| study.view(id)).ok_or(StudyRefusal::Unknown)
    }

    /// Stops a study.
    pub(super) fn cancel(&self, id: Uuid) -> Result<StudyView, StudyRefusal> {
        let mut index = self.0.index();
        index.queue.retain(|queued| *queued != id);
        let study = index.studies.get_mut(&id).ok_or(StudyRefusal::Unknown)?;
        study.watch.cancelled.store(true, Ordering::Relaxed);
        if matches!(study.phase, Phase::Queued(_)) {
            study.phase = Phase::Cancelled;
        }
        Ok(study.view(id))
    }

    /// Forgets a study that does not run.
    pub(super) fn forget(&self, id: Uuid) -> Result<(), StudyRefusal> {
        let mut index = self.0.index();
        match index.studies.get(&id).map(|study| &study.phase) {
            None => return Err(StudyRefusal::Unknown),
            Some(Phase::Running) => return Err(StudyRefusal::Running),
            Some(_) => {}
        }
        index.queue.retain(|queued| *queued != id);
        index.studies.remove(&id);
        Ok(())
    }

    /// A table or a chart of a study.
    pub(super) fn file(&self, id: Uuid, name: &str) -> Result<String, StudyRefusal> {
        let index = self.0.index();
        let study = index.studies.get(&id).ok_or(StudyRefusal::Unknown)?;
        let Phase::Succeeded(answer) = &study.phase else { return Err(StudyRefusal::NoFile) };
        let file = answer.files.iter().find(|(file, _)| *file == name);
        file.map(|(_, text)| text.clone()).ok_or(StudyRefusal::NoFile)
    }
}

impl Study {
    fn view(&self, id: Uuid) -> StudyView {
        let answer = match &self.phase {
            Phase::Succeeded(answer) => Answer::clone(answer),
            _ => Answer::default(),
        };
        let link = |name: &str| match name.strip_suffix(".svg") {
            Some(_) => format!("/studies/{id}/charts/{name}"),
            None => format!("/studies/{id}/{name}"),
        };
        StudyView {
            id,
            kind: self.kind,
            name: self.name.clone(),
            state: self.phase.as_str(),
            runs_done: self.watch.done.load(Ordering::Relaxed),
            runs: self.watch.total.load(Ordering::Relaxed),
            error: match &self.phase {
                Phase::Failed(error) => Some(error.clone()),
                _ => None,
            },
            reference: answer.reference,
            rows: answer.rows,
            borders: answer.borders,
            links: answer.files.iter().map(|(name, _)| link(name)).collect(),
        }
    }
}

impl Shared {
    fn index(&self) -> MutexGuard<'_, Index> {
        // A panic leaves the index whole: no change of it spans a call that may panic.
        self.index.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn work(&self) {
        loop {
            let (id, question, watch) = self.next();
            let (ended, late) = limited(&watch);
            let answer = std::panic::catch_unwind(|| answer(&question, &watch));
            drop(ended);
            let late = late.join().unwrap_or_default();
            let phase = match answer {
                Ok(Ok(answer)) => Phase::Succeeded(Arc::new(answer)),
                Ok(Err(Unanswered::Study(StudyError::Cancelled))) if late => {
                    Phase::Failed(format!("took longer than {} s", LONGEST.as_secs()))
                }
                Ok(Err(Unanswered::Study(StudyError::Cancelled))) => Phase::Cancelled,
                Ok(Err(error)) => Phase::Failed(error.to_string()),
                Err(_) => Phase::Failed("the study failed; the service's log says why".to_owned()),
            };
            tracing::info!(study = %id, state = phase.as_str(), "study ended");
            if let Some(study) = self.index().studies.get_mut(&id) {
                study.phase = phase;
            }
        }
    }

    fn next(&self) -> (Uuid, Box<Question>, Arc<Watch>) {
        let mut index = self.index();
        loop {
            if let Some(id) = index.queue.pop_front()
                && let Some(study) = index.studies.get_mut(&id)
                && let Phase::Queued(question) = std::mem::replace(&mut study.phase, Phase::Running)
            {
                return (id, question, study.watch.clone());
            }
            index = self.work.wait(index).unwrap_or_else(PoisonError::into_inner);
        }
    }
}

/// Cancels a study that takes too long, unless the sender is dropped before; tells whether it did.
fn limited(watch: &Arc<Watch>) -> (mpsc::Sender<()>, thread::JoinHandle<bool>) {
    let (ended, end) = mpsc::channel();
    let watch = watch.clone();
    let late = thread::spawn(move || {
        let late = end.recv_timeout(LONGEST) == Err(RecvTimeoutError::Timeout);
        if late {
            watch.cancelled.store(true, Ordering::Relaxed);
        }
        late
    });
    (ended, late)
}

#[derive(Debug, thiserror::Error)]
enum Unanswered {
    #[error(transparent)]
    Study(#[from] StudyError),
    #[error(transparent)]
    Chart(#[from] ChartError),
}

fn answer(question: &Question, watch: &Watch) -> Result<Answer, Unanswered> {
    let Question { kind, scene, entries, until_s } = question;
    let name = scene.name();
    let mut answer = Answer::default();
    let table: Table = match kind {
        Kind::Precision => {
            let study = precision(scene, entries, *until_s, watch)?;
            let known = &study.reference;
            answer.reference = Some([known.time_s, known.error, known.cross_check]);
            answer.files = chart::precision(name, entries, &study)?;
            study.table
        }
        Kind::LongTerm => {
            let study = long_term(scene, entries, watch)?;
            answer.files = chart::long_term(name, entries, &study)?;
            study.table
        }
        Kind::Stability => {
            let map = stability(scene, entries, watch)?;
            answer.files = vec![("stability.svg", chart::stability_map(name, &map)?)];
            answer.borders = map.borders.clone();
            map.table()
        }
    };
    answer.files.push(("table.csv", table.to_csv()));
    answer.rows = table.rows;
    Ok(answer)
}
