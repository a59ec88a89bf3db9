//! The record of the jobs, on disk.
//!
//! A job is a prefix: `jobs/<uuid v7>/{key-<uuid v5>, scenario.json, cancel, attempt-1, trace-1,
//! …, giving-up-1, log.mcap, result.json}`.
//!
//! Invariants: a job exists while its `scenario.json` does. `attempt-N` and `result.json` are written
//! put-if-absent: the first counts the runs that never came back, the second lets a job end once. What a call
//! has written is on the disk when the call returns, under a checksum. A file named `log.mcap` is finished, and
//! it is the job's log once `result.json` stands. No name that a client sent becomes part of a path.
//!
//! `index.jsonl` repeats of each result what lists show, so that a start need not read them all. It is no
//! record: what it lacks, or holds damaged, is read from the result.

mod studies;

pub(super) use studies::{FoundStudy, StudyStore};

use std::collections::{BTreeMap, HashMap, HashSet};
use std::fs::{DirBuilder, File, TryLockError};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use axum::body::Bytes;
use chrono::{DateTime, Utc};
use futures_util::{StreamExt, TryStreamExt, stream};
use object_store::local::LocalFileSystem;
use object_store::path::Path as Key;
use object_store::{Error, ObjectStore, ObjectStoreExt, PutMode, PutOptions};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use serde_json::value::RawValue;
use tokio::sync::Semaphore;
use uuid::Uuid;

use super::ServeError;
use super::job::State;
use crate::log::resume::last_checkpoint;

const JOBS: &str = "jobs";
const SCENARIO: &str = "scenario.json";
const RESULT: &str = "result.json";
const CANCEL: &str = "cancel";
const ATTEMPT: &str = "attempt-";
const TRACE: &str = "trace-";
const GIVING_UP: &str = "giving-up-";
const LOG: &str = "log.mcap";
const PART: &str = "log.mcap.part";
const KEY: &str = "key-";
const INDEX: &str = "index.jsonl";

/// Files written at once. A disk is no faster for more, and their threads crowd out those that answer.
const WRITERS: usize = 8;

/// A job that ends its process at the same step so many times in a row is given up.
pub(super) const MAX_DEATHS_AT_ONE_PLACE: u32 = 3;

/// A job of which so many runs in a row came to nothing is given up, wherever they ended.
const MAX_FRUITLESS: u32 = 20;

/// So often it is tried to give the log of a given-up job an end: that may end the process as well.
pub(super) const MAX_GIVING_UP: u32 = 2;

/// What begins the last line of a text that has a checksum.
const SEAL: &str = "crc32 ";

/// How a job ended: the text of `result.json`. Plan, summary and diagnosis stay plain JSON, so that a
/// newer build can show what an older one wrote.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Record {
    pub(super) name: String,
    pub(super) state: State,
    pub(super) attempts: u32,
    pub(super) finished: Option<DateTime<Utc>>,
    pub(super) steps: u64,
    pub(super) steps_done: u64,
    pub(super) has_log: bool,
    pub(super) plan: Option<Box<RawValue>>,
    pub(super) summary: Option<Value>,
    pub(super) diagnosis: Option<Value>,
}

/// What the scan found of one job.
#[derive(Debug)]
pub(super) struct Found {
    pub(super) id: Uuid,
    pub(super) key: Option<Uuid>,
    pub(super) attempts: u32,
    /// How often somebody began to give its log an end, because its runs end their process.
    pub(super) given_up: u32,
    pub(super) cancelled: bool,
    pub(super) ended: bool,
    pub(super) has_log: bool,
    /// How it ended, if the index knows.
    pub(super) ending: Option<Ending>,
}

/// How the processes of a job's last attempts ended, counted backwards from the last attempt.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Deaths {
    /// Attempts after which the job stood where they began.
    pub(super) fruitless: u32,
    /// Those of them that died at the step of the last one.
    pub(super) at_one_place: u32,
}

impl Deaths {
    /// Whether the job itself is to blame. A kill from outside hits a run anywhere; a run that ends its
    /// own process does so at the same step every time, or at least never gets beyond it.
    pub(super) fn convict(self) -> bool {
        self.at_one_place >= MAX_DEATHS_AT_ONE_PLACE || self.fruitless >= MAX_FRUITLESS
    }
}

/// What lists show of a job that ended.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Ending {
    pub(super) id: Uuid,
    pub(super) name: String,
    pub(super) state: State,
    pub(super) attempts: u32,
    pub(super) steps: u64,
    pub(super) steps_done: u64,
    pub(super) has_log: bool,
}

impl Ending {
    pub(super) fn of(id: Uuid, record: &Record) -> Self {
        let Record { state, attempts, steps, steps_done, has_log, .. } = *record;
        Self { id, name: record.name.clone(), state, attempts, steps, steps_done, has_log }
    }
}

/// Reading or writing the record failed.
#[derive(Debug, thiserror::Error)]
#[error("could not {action}")]
pub(super) struct StoreError {
    action: &'static str,
    source: Box<dyn std::error::Error + Send + Sync>,
}

impl StoreError {
    fn new<E: Into<Box<dyn std::error::Error + Send + Sync>>>(
        action: &'static str,
    ) -> impl FnOnce(E) -> Self {
        move |source| Self { action, source: source.into() }
    }

    /// `storage_full` or `storage_error`.
    pub(super) fn code(&self) -> &'static str {
        let mut cause: Option<&(dyn std::error::Error + 'static)> = Some(&*self.source);
        while let Some(error) = cause {
            if let Some(error) = error.downcast_ref::<io::Error>()
                && matches!(error.kind(), io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded)
            {
                return "storage_full";
            }
            cause = error.source();
        }
        "storage_error"
    }
}

/// The data directory is ours while this lives: two services on one record would run each other's jobs.
#[derive(Debug)]
pub(super) struct DataLock {
    _file: File,
}

impl DataLock {
    /// Makes the directory if need be, readable by its owner alone, and locks it.
    pub(super) fn take(data: &Path) -> Result<Self, ServeError> {
        let failed = |source| ServeError::Data { path: data.into(), source };
        if !data.exists() {
            make_directory(data).map_err(failed)?;
        }
        let file = File::options()
            .create(true)
            .truncate(false)
            .write(true)
            .open(data.join("lock"))
            .map_err(failed)?;
        match file.try_lock() {
            Ok(()) => Ok(Self { _file: file }),
            Err(TryLockError::WouldBlock) => Err(ServeError::DataInUse { path: data.into() }),
            Err(TryLockError::Error(source)) => Err(failed(source)),
        }
    }
}

fn make_directory(path: &Path) -> io::Result<()> {
    let mut builder = DirBuilder::new();
    builder.recursive(true);
    #[cfg(unix)]
    std::os::unix::fs::DirBuilderExt::mode(&mut builder, 0o700);
    builder.create(path)?;
    // The new name must survive a power cut as well, or every job below it goes with it.
    path.canonicalize()?.parent().map_or(Ok(()), sync_directory)
}

fn sync_directory(path: &Path) -> io::Result<()> {
    if cfg!(unix) { File::open(path)?.sync_all() } else { Ok(()) }
}

fn remove_if_there(path: &Path) -> io::Result<()> {
    match std::fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}

/// The record; the only code that knows names of files.
#[derive(Debug)]
pub(super) struct Store {
    objects: LocalFileSystem,
    data: PathBuf,
    jobs: PathBuf,
    /// Open for appending.
    index: Mutex<File>,
    writers: Semaphore,
}

impl Store {
    /// Opens the record in a directory that exists and is locked.
    pub(super) fn open(data: &Path) -> Result<Self, ServeError> {
        let failed = |source: io::Error| ServeError::Data { path: data.into(), source };
        let data = data.canonicalize().map_err(failed)?;
        let jobs = data.join(JOBS);
        make_directory(&jobs).map_err(failed)?;
        let index = File::options().create(true).append(true).open(data.join(INDEX));
        let index = Mutex::new(index.map_err(failed)?);
        let writers = Semaphore::new(WRITERS);
        Ok(Self { objects: objects(&data)?, data, jobs, index, writers })
    }

    /// Bytes that may still be written to the disk. Blocking.
    #[cfg(unix)]
    pub(super) fn free_bytes(&self) -> Result<u64, StoreError> {
        let disk = rustix::fs::statvfs(&self.data).map_err(io::Error::from);
        let disk = disk.map_err(StoreError::new("ask the disk for its free space"))?;
        Ok(disk.f_bavail.saturating_mul(disk.f_frsize))
    }

    /// Unknown: a full disk is found by running into it.
    #[cfg(not(unix))]
    pub(super) fn free_bytes(&self) -> Result<u64, StoreError> {
        Ok(u64::MAX)
    }

    /// Keeps a new job, and the key under which the client sent it. The scenario goes last: before it
    /// there is no job.
    pub(super) async fn accept(
        &self,
        id: Uuid,
        key: Option<Uuid>,
        scenario: Vec<u8>,
    ) -> Result<(), StoreError> {
        let failed = "keep the scenario";
        if let Some(key) = key {
            let kept = self.create(id, &format!("{KEY}{key}"), Vec::new()).await;
            kept.map_err(StoreError::new(failed))?;
        }
        self.create(id, SCENARIO, sealed(scenario)).await.map_err(StoreError::new(failed))
    }

    /// The scenario of a job, as accepted.
    pub(super) async fn scenario(&self, id: Uuid) -> Result<Bytes, StoreError> {
        let failed = "read the scenario";
        let text = self.read(id, SCENARIO).await.map_err(StoreError::new(failed))?;
        unsealed(text).map_err(StoreError::new(failed))
    }

    /// Notes that attempt `n` begins, and at which step.
    pub(super) async fn begin_attempt(&self, id: Uuid, n: u32) -> Result<(), StoreError> {
        let failed = "note the attempt";
        let step = self.progress(id)?;
        let note = sealed(step.to_string().into_bytes());
        self.create(id, &format!("{ATTEMPT}{n}"), note).await.map_err(StoreError::new(failed))
    }

    /// Notes that the `n`th attempt begins to give the log of a given-up job an end.
    pub(super) async fn begin_giving_up(&self, id: Uuid, n: u32) -> Result<(), StoreError> {
        let noted = self.create(id, &format!("{GIVING_UP}{n}"), Vec::new()).await;
        noted.map_err(StoreError::new("note that the job is given up"))
    }

    /// Takes that note back: it was interrupted in order.
    pub(super) async fn take_back_giving_up(&self, id: Uuid, n: u32) -> Result<(), StoreError> {
        let failed = StoreError::new("take back the note that the job is given up");
        self.objects.delete(&key(id, &format!("{GIVING_UP}{n}"))).await.map_err(failed)
    }

    /// A file in which attempt `n` leaves how far it came, should its process die. Blocking.
    pub(super) fn trace(&self, id: Uuid, n: u32) -> Option<File> {
        File::create(self.directory(id).join(format!("{TRACE}{n}"))).ok()
    }

    /// What the last of `n` attempts came to, which left the log at step `reached`. Blocking but for the store.
    pub(super) async fn deaths(&self, id: Uuid, n: u32, mut reached: u64) -> Deaths {
        let trace = |n: u32| {
            let trace = std::fs::read(self.directory(id).join(format!("{TRACE}{n}"))).ok()?;
            // Before it makes steps a run is where every other one is: that says nothing.
            let step = u64::from_le_bytes(trace.try_into().ok()?);
            (step > 0).then_some(step)
        };
        let last = trace(n);
        let mut deaths = Deaths::default();
        for n in (1..=n).rev() {
            // One that was taken back, or is torn, began at the start as far as we know.
            let note = self.read(id, &format!("{ATTEMPT}{n}")).await.ok();
            let note = note.and_then(|note| unsealed(note).ok());
            let began = note.and_then(|note| std::str::from_utf8(&note).ok()?.parse().ok());
            let began: u64 = began.unwrap_or(0);
            if began < reached {
                break;
            }
            if deaths.at_one_place == deaths.fruitless && last.is_some() && trace(n) == last {
                deaths.at_one_place += 1;
            }
            (reached, deaths.fruitless) = (began, deaths.fruitless + 1);
        }
        deaths
    }

    /// The step from which a run of the job would go on. Blocking.
    pub(super) fn progress(&self, id: Uuid) -> Result<u64, StoreError> {
        let found = last_checkpoint(&self.log_path(id)).map_err(StoreError::new("read the log"));
        found.map(Option::unwrap_or_default)
    }

    /// Takes back the note of an attempt that was interrupted in order: it must not count as a crash.
    pub(super) async fn take_back_attempt(&self, id: Uuid, n: u32) -> Result<(), StoreError> {
        let failed = StoreError::new("take back the note of the attempt");
        let _ = std::fs::remove_file(self.directory(id).join(format!("{TRACE}{n}")));
        self.objects.delete(&key(id, &format!("{ATTEMPT}{n}"))).await.map_err(failed)
    }

    /// Notes that somebody wants the job stopped, so that it stays stopped if we die before it ends.
    pub(super) async fn note_cancel(&self, id: Uuid) -> Result<(), StoreError> {
        match self.create(id, CANCEL, Vec::new()).await {
            Ok(()) | Err(Error::AlreadyExists { .. }) => Ok(()),
            Err(error) => Err(StoreError::new("note the cancellation")(error)),
        }
    }

    /// Ends a job. The first record wins: the one that stands is returned.
    pub(super) async fn publish(&self, id: Uuid, record: &Record) -> Result<Record, StoreError> {
        let text = serde_json::to_vec(record).map_err(StoreError::new("write the result"))?;
        match self.create(id, RESULT, sealed(text)).await {
            Ok(()) => {
                self.add_to_index(&Ending::of(id, record));
                Ok(record.clone())
            }
            Err(Error::AlreadyExists { .. }) => self.record(id).await,
            Err(error) => Err(StoreError::new("write the result")(error)),
        }
    }

    /// How a job ended.
    pub(super) async fn record(&self, id: Uuid) -> Result<Record, StoreError> {
        let failed = "read the result";
        let text = self.read(id, RESULT).await.map_err(StoreError::new(failed))?;
        let text = unsealed(text).map_err(StoreError::new(failed))?;
        serde_json::from_slice(&text).map_err(StoreError::new(failed))
    }

    /// Where the log of a job stands, or will stand once it is finished.
    pub(super) fn log_path(&self, id: Uuid) -> PathBuf {
        self.directory(id).join(LOG)
    }

    /// Makes a finished log that has no result an unfinished one again: the run goes on from its last
    /// checkpoint and ends once more. Blocking.
    pub(super) fn reopen_log(&self, id: Uuid) -> Result<(), StoreError> {
        let directory = self.directory(id);
        match std::fs::rename(directory.join(LOG), directory.join(PART)) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => {
                Err(StoreError::new("reopen an unpublished log")(error))
            }
            _ => Ok(()),
        }
    }

    /// Removes what a dead attempt left of its log. Blocking.
    pub(super) fn remove_leftovers(&self, id: Uuid) -> Result<(), StoreError> {
        let directory = self.directory(id);
        let removed = remove_if_there(&directory.join(PART))
            .and_then(|()| remove_if_there(&directory.join(LOG)));
        removed.map_err(StoreError::new("remove an unfinished log"))
    }

    /// Forgets a job and its log. The scenario goes first: half of it done, the rest is rubbish that the
    /// next scan removes, not a job to be run again.
    pub(super) async fn forget(&self, id: Uuid) -> Result<(), StoreError> {
        let directory = self.directory(id);
        let removed = tokio::task::spawn_blocking(move || forget_prefix(&directory, SCENARIO));
        let removed = removed.await.map_err(io::Error::other).flatten();
        removed.map_err(StoreError::new("forget the job"))
    }

    /// All jobs, oldest first. Prefixes without a scenario are removed.
    pub(super) async fn scan(&self) -> Result<Vec<Found>, StoreError> {
        let failed = "list the jobs";
        let mut jobs: BTreeMap<Uuid, Vec<String>> = BTreeMap::new();
        let mut entries = self.objects.list(Some(&Key::from(JOBS)));
        while let Some(entry) = entries.try_next().await.map_err(StoreError::new(failed))? {
            let parts: Vec<_> = entry.location.parts().collect();
            if let [_, id, name] = parts.as_slice()
                && let Some(id) = parse_id(id.as_ref())
            {
                jobs.entry(id).or_default().push(name.as_ref().to_owned());
            }
        }
        let (whole, broken): (Vec<_>, Vec<_>) =
            jobs.into_iter().partition(|(_, names)| names.iter().any(|name| name == SCENARIO));
        let removed = stream::iter(broken).map(Ok).try_for_each(|(id, _)| self.forget(id)).await;
        if let Err(error) = removed {
            tracing::warn!(%error, "rubbish stays in the data directory");
        }
        let mut index = self.read_index(&whole);
        let last = |names: &[String], kind: &str| {
            let numbers = names.iter().filter_map(|name| name.strip_prefix(kind)?.parse().ok());
            numbers.max().unwrap_or(0)
        };
        let found = whole.into_iter().map(|(id, names)| Found {
            id,
            key: names.iter().find_map(|name| parse_id(name.strip_prefix(KEY)?)),
            has_log: names.iter().any(|name| name == LOG),
            ending: index.remove(&id),
            attempts: last(&names, ATTEMPT),
            given_up: last(&names, GIVING_UP),
            cancelled: names.iter().any(|name| name == CANCEL),
            ended: names.iter().any(|name| name == RESULT),
        });
        Ok(found.collect())
    }

    /// Adds a line to the index; a lost one costs the next start a look at the result.
    pub(super) fn add_to_index(&self, ending: &Ending) {
        let Ok(line) = index_line(ending) else { return };
        let mut index = self.index.lock().unwrap_or_else(PoisonError::into_inner);
        if let Err(error) = index.write_all(line.as_bytes()) {
            tracing::warn!(%error, "index not written");
        }
    }

    /// The sound lines of the index that belong to a job; without the others, if they became many.
    fn read_index(&self, jobs: &[(Uuid, Vec<String>)]) -> HashMap<Uuid, Ending> {
        let path = self.data.join(INDEX);
        let text = std::fs::read(&path).unwrap_or_default();
        let lines = text.split(|byte| *byte == b'\n').filter(|line| !line.is_empty());
        let count = lines.clone().count();
        let mut index: HashMap<Uuid, Ending> =
            lines.filter_map(index_entry).map(|ending| (ending.id, ending)).collect();
        let known: HashSet<Uuid> = jobs.iter().map(|(id, _)| *id).collect();
        index.retain(|id, _| known.contains(id));
        if count > 2 * index.len() + 100 {
            let text: String =
                index.values().filter_map(|ending| index_line(ending).ok()).collect();
            let mut file = self.index.lock().unwrap_or_else(PoisonError::into_inner);
            // Appending goes on behind what is written here.
            let rewritten = file.set_len(0).and_then(|()| file.write_all(text.as_bytes()));
            if let Err(error) = rewritten {
                tracing::warn!(%error, "index not rewritten");
            }
        }
        index
    }

    fn directory(&self, id: Uuid) -> PathBuf {
        self.jobs.join(id.to_string())
    }

    async fn read(&self, id: Uuid, name: &str) -> Result<Bytes, Error> {
        self.objects.get(&key(id, name)).await?.bytes().await
    }

    async fn create(&self, id: Uuid, name: &str, content: Vec<u8>) -> Result<(), Error> {
        // Never closed.
        let _turn = self.writers.acquire().await;
        create(&self.objects, &key(id, name), content).await
    }
}

/// The files of a directory, each on the disk when it is said to be written.
fn objects(data: &Path) -> Result<LocalFileSystem, ServeError> {
    let failed = |source| ServeError::Data { path: data.into(), source: io::Error::other(source) };
    Ok(LocalFileSystem::new_with_prefix(data).map_err(failed)?.with_fsync(true))
}

/// Writes a file that is not there yet.
async fn create(objects: &LocalFileSystem, place: &Key, content: Vec<u8>) -> Result<(), Error> {
    let options = PutOptions { mode: PutMode::Create, ..PutOptions::default() };
    objects.put_opts(place, content.into(), options).await.map(drop)
}

/// Removes a directory, first of all the file without which the rest is nothing. Blocking.
fn forget_prefix(directory: &Path, first: &str) -> io::Result<()> {
    let removed = remove_if_there(&directory.join(first))
        .and_then(|()| sync_directory(directory))
        .and_then(|()| std::fs::remove_dir_all(directory));
    match removed {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}

/// A line of the index: a checksum and what it covers.
fn index_line(ending: &Ending) -> serde_json::Result<String> {
    let json = serde_json::to_string(ending)?;
    Ok(format!("{:08x} {json}\n", crc32fast::hash(json.as_bytes())))
}

fn index_entry(line: &[u8]) -> Option<Ending> {
    let (sum, json) = std::str::from_utf8(line).ok()?.split_once(' ')?;
    let sum = u32::from_str_radix(sum, 16).ok()?;
    if sum == crc32fast::hash(json.as_bytes()) { serde_json::from_str(json).ok() } else { None }
}

/// A text with its checksum in a last line.
fn sealed(mut text: Vec<u8>) -> Vec<u8> {
    let sum = crc32fast::hash(&text);
    text.extend_from_slice(format!("\n{SEAL}{sum:08x}\n").as_bytes());
    text
}

/// The text above a checksum that is right.
fn unsealed(text: Bytes) -> Result<Bytes, String> {
    // Line end, word, eight digits, line end.
    let end = text.len().checked_sub(SEAL.len() + 10).ok_or("the text breaks off")?;
    let sum = crc32fast::hash(&text[..end]);
    if text[end..] == *format!("\n{SEAL}{sum:08x}\n").as_bytes() {
        Ok(text.slice(..end))
    } else {
        Err("the text is damaged: its checksum is not right".to_owned())
    }
}

/// The one spelling of an id: lower case with hyphens. Anything else is no id.
pub(super) fn parse_id(text: &str) -> Option<Uuid> {
    Uuid::try_parse(text).ok().filter(|id| id.to_string() == text)
}

fn key(id: Uuid, name: &str) -> Key {
    Key::from_iter([JOBS, &id.to_string(), name])
}
