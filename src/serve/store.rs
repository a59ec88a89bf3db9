//! The record of the jobs, on disk.
//!
//! A job is a prefix: `jobs/<id>/{key-<uuid v5>, sent.json, scenario.json, plan.json, cancel, attempt-1, …, log.mcap,
//! result.json}`.
//!
//! Invariants: a job exists while its `scenario.json` or its `result.json` does. `attempt-N` and
//! `result.json` are written put-if-absent: the first counts the runs that never came back, the
//! second lets a job end once. Everything that a call has written is on the disk when the call
//! returns, under a checksum. A file named `log.mcap` is finished, and it is the job's log once
//! `result.json` exists, which holds its checksum. No name that a client sent becomes part of a
//! path. Nothing is removed but what a client deleted (`trash`) and the remains of a request that
//! was never answered; anything that is not understood is reported and left alone.
//!
//! `index.jsonl` repeats the fields of each job that lists show, so that a start need not read them
//! all. It is no record: lines that are missing there, or damaged, are read from the job.

#[cfg(feature = "cluster")]
pub(super) mod bucket;
mod directory;
mod studies;

pub(super) use directory::{DataDirectory, DataLock, put_aside};
pub(super) use studies::{FoundStudy, StudyStore};

use std::collections::HashMap;
use std::fs::{self, File};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use axum::body::Bytes;
use chrono::{DateTime, Utc};
use object_store::local::LocalFileSystem;
use object_store::path::Path as Key;
use object_store::{Error, ObjectStore, ObjectStoreExt, PutMode, PutOptions};
use schemars::JsonSchema;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use serde_json::value::RawValue;
use sha2::{Digest, Sha256};
use tokio::sync::Semaphore;
use uuid::Uuid;

use self::directory::{Moved, empty, own_directory, prefixes, throw_away};
use super::job::State;
use super::{ServeError, chain};
use crate::advise::Settled;
use crate::log::is_transient;
use crate::plan::{Advice, Plan};
use crate::scenario::Scenario;

const JOBS: &str = "jobs";
const SCENARIO: &str = "scenario.json";
/// The scenario as the client wrote it, to be edited further; jobs of older builds have none.
const SENT: &str = "sent.json";
const PLAN: &str = "plan.json";
/// Plan of jobs that an older build took.
const CHOSEN: &str = "settled.json";
const RESULT: &str = "result.json";
const CANCEL: &str = "cancel";
const ATTEMPT: &str = "attempt-";
const TRACE: &str = "trace";
const LOG: &str = "log.mcap";
const PART: &str = "log.mcap.part";
const KEY: &str = "key-";
const INDEX: &str = "index.jsonl";
const TRASH: &str = "trash";

/// Number of files written at once. A disk is no faster for more, and their threads crowd out those
/// that answer.
const WRITERS: usize = 8;

/// Beginning of the last line of a text that has a checksum.
const SEAL: &str = "crc32 ";

/// End of a job: the text of `result.json`. Plan, summary and diagnosis stay plain JSON, so that a
/// newer build can show those that an older one wrote.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Record {
    pub(super) name: String,
    pub(super) state: State,
    pub(super) attempts: u32,
    pub(super) finished: Option<DateTime<Utc>>,
    pub(super) steps: u64,
    pub(super) steps_done: u64,
    pub(super) has_log: bool,
    /// Size and checksum of the log; records of older builds have none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) log: Option<LogSum>,
    pub(super) plan: Option<Box<RawValue>>,
    pub(super) summary: Option<Value>,
    pub(super) diagnosis: Option<Value>,
}

/// Size and checksum of a log.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub(super) struct LogSum {
    /// Its size.
    pub(super) bytes: u64,
    /// SHA-256, in hexadecimal digits.
    pub(super) sha256: String,
}

impl LogSum {
    /// Reads a log and returns them; `None` if that was stopped. Blocking.
    pub(super) fn of(path: &Path, stopped: impl Fn() -> bool) -> io::Result<Option<Self>> {
        let (mut file, mut piece) = (File::open(path)?, vec![0; 1 << 20]);
        let (mut sum, mut bytes) = (Sha256::new(), 0);
        loop {
            let length = file.read(&mut piece)?;
            if length == 0 {
                let sha256 = sum.finalize().iter().map(|byte| format!("{byte:02x}")).collect();
                return Ok(Some(Self { bytes, sha256 }));
            }
            sum.update(&piece[..length]);
            bytes += length as u64;
            if stopped() {
                return Ok(None);
            }
        }
    }
}

/// The plan of a job as it is kept: the results of runs, and the text for clients.
#[derive(Serialize, Deserialize)]
pub(super) struct KeptPlan {
    pub(super) settled: Settled,
    plan: Box<RawValue>,
}

impl KeptPlan {
    pub(super) fn new(settled: Settled, plan: &Plan) -> Result<Self, StoreError> {
        let plan = serde_json::value::to_raw_value(plan);
        Ok(Self { settled, plan: plan.map_err(StoreError::new("write the plan"))? })
    }
}

/// Record that an older build kept of an accuracy.
#[derive(Deserialize)]
struct Chosen {
    scenario: Scenario,
    advice: Advice,
}

/// Result of the scan for one job.
#[derive(Debug)]
pub(super) struct Found {
    pub(super) id: Uuid,
    pub(super) key: Option<Uuid>,
    pub(super) attempts: u32,
    pub(super) cancelled: bool,
    pub(super) ended: bool,
    pub(super) has_log: bool,
    /// Size of its unfinished log.
    pub(super) part_bytes: u64,
    /// Its line in the index.
    pub(super) line: Option<Line>,
}

/// Line of the index about a job.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(untagged)]
pub(super) enum Line {
    Ended(Ending),
    Waits(Waiting),
}

impl Line {
    fn id(&self) -> Uuid {
        match self {
            Self::Ended(ending) => ending.id,
            Self::Waits(waiting) => waiting.id,
        }
    }
}

/// Fields of a job that ended, for lists.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Ending {
    pub(super) id: Uuid,
    pub(super) name: String,
    pub(super) state: State,
    pub(super) attempts: u32,
    pub(super) steps: u64,
    pub(super) steps_done: u64,
    pub(super) has_log: bool,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) log: Option<LogSum>,
}

impl Ending {
    pub(super) fn of(id: Uuid, record: &Record) -> Self {
        let Record { state, attempts, steps, steps_done, has_log, .. } = *record;
        let (name, log) = (record.name.clone(), record.log.clone());
        Self { id, name, state, attempts, steps, steps_done, has_log, log }
    }
}

/// Fields of a waiting job, for lists, and its expected size.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Waiting {
    pub(super) id: Uuid,
    pub(super) name: String,
    /// Size of a job whose method and step are settled.
    pub(super) size: Option<Size>,
}

/// Resources that a job is expected to take.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Size {
    pub(super) steps: u64,
    pub(super) log_bytes: u64,
    pub(super) memory_bytes: u64,
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

    /// Returns the error of a log that cannot be read.
    pub(super) fn reading_a_log(source: io::Error) -> Self {
        Self::new("read the log")(source)
    }

    /// Returns `storage_full`, `storage_moved` or `storage_error`.
    pub(super) fn code(&self) -> &'static str {
        let full = |error: &io::Error| {
            matches!(error.kind(), io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded)
        };
        match self.system() {
            _ if self.is_of_the_directory() => "storage_moved",
            Some(error) if full(error) => "storage_full",
            _ => "storage_error",
        }
    }

    /// Returns whether trying again later may succeed.
    pub(super) fn is_transient(&self) -> bool {
        self.is_of_the_directory() || self.system().is_some_and(is_transient)
    }

    /// Returns whether the data directory is not where it was.
    fn is_of_the_directory(&self) -> bool {
        self.cause::<Moved>().is_some()
    }

    /// Returns the error of the system, if there is one.
    fn system(&self) -> Option<&io::Error> {
        self.cause()
    }

    fn cause<E: std::error::Error + 'static>(&self) -> Option<&E> {
        let mut cause: Option<&(dyn std::error::Error + 'static)> = Some(&*self.source);
        while let Some(error) = cause {
            if let Some(error) = error.downcast_ref() {
                return Some(error);
            }
            cause = error.source();
        }
        None
    }
}

/// The record; the only code that knows names of files.
#[derive(Debug)]
pub(super) struct Store {
    objects: LocalFileSystem,
    data: DataDirectory,
    jobs: PathBuf,
    trash: PathBuf,
    /// File open for appending, if it can be.
    index: Mutex<Option<File>>,
    writers: Semaphore,
}

impl Store {
    /// Opens the record in a directory that exists and is locked, and removes what was forgotten.
    pub(super) fn open(data: DataDirectory) -> Result<Self, ServeError> {
        let path = data.path();
        let (jobs, trash) = (own_directory(path, JOBS)?, own_directory(path, TRASH)?);
        empty(&trash);
        let index = Mutex::new(open_index(&path.join(INDEX)));
        let (objects, writers) = (objects(path)?, Semaphore::new(WRITERS));
        Ok(Self { objects, data, jobs, trash, index, writers })
    }

    /// Checks that the data directory is where it was.
    pub(super) fn check(&self) -> Result<(), StoreError> {
        self.data.check()
    }

    /// Returns the bytes that may still be written to the disk. Blocking.
    #[cfg(unix)]
    pub(super) fn free_bytes(&self) -> Result<u64, StoreError> {
        let disk = rustix::fs::statvfs(self.data.path()).map_err(io::Error::from);
        let disk = disk.map_err(StoreError::new("ask the disk for its free space"))?;
        Ok(disk.f_bavail.saturating_mul(disk.f_frsize))
    }

    /// Returns no limit: it is unknown, and a full disk shows when a write fails.
    #[cfg(not(unix))]
    pub(super) fn free_bytes(&self) -> Result<u64, StoreError> {
        Ok(u64::MAX)
    }

    /// Keeps a new job, the text that was sent, and the key under which the client sent it. The
    /// scenario goes last: before it there is no job.
    pub(super) async fn accept(
        &self,
        id: Uuid,
        key: Option<Uuid>,
        scenario: Vec<u8>,
        sent: Vec<u8>,
    ) -> Result<(), StoreError> {
        let failed = "keep the scenario";
        if let Some(key) = key {
            let kept = self.create(id, &format!("{KEY}{key}"), Vec::new()).await;
            kept.map_err(StoreError::new(failed))?;
        }
        if sent != scenario {
            let kept = self.create(id, SENT, sealed(sent)).await;
            kept.map_err(StoreError::new(failed))?;
        }
        self.create(id, SCENARIO, sealed(scenario)).await.map_err(StoreError::new(failed))
    }

    /// Returns the scenario of a job, as accepted.
    pub(super) async fn scenario(&self, id: Uuid) -> Result<Bytes, StoreError> {
        let failed = "read the scenario";
        let text = self.read(id, SCENARIO).await.map_err(StoreError::new(failed))?;
        unsealed(text).map_err(StoreError::new(failed))
    }

    /// Returns the scenario of a job as it was sent; as accepted if that text is not kept.
    pub(super) async fn sent(&self, id: Uuid) -> Result<Bytes, StoreError> {
        let kept = self.read(id, SENT).await.ok().map(unsealed);
        match kept {
            Some(Ok(text)) => Ok(text),
            _ => self.scenario(id).await,
        }
    }

    /// Returns the results of runs for the plan of a job; `None` if they are not known yet, or this
    /// build cannot use them.
    pub(super) async fn settled(&self, id: Uuid) -> Result<Option<Settled>, StoreError> {
        if let Some(KeptPlan { settled, .. }) = self.found(id, PLAN, "read the plan").await? {
            return Ok(Some(settled));
        }
        let Some(Chosen { scenario, advice }) =
            self.found(id, CHOSEN, "read the settled scenario").await?
        else {
            return Ok(None);
        };
        let asked = Scenario::from_json(&self.scenario(id).await?).ok();
        Ok(asked.map(|asked| Settled::chosen(asked, scenario, advice)))
    }

    /// Returns the plan of a job for clients; `None` if there is none yet.
    pub(super) async fn plan(&self, id: Uuid) -> Result<Option<Box<RawValue>>, StoreError> {
        #[derive(Deserialize)]
        struct Shown {
            plan: Box<RawValue>,
        }
        let shown: Option<Shown> = self.found(id, PLAN, "read the plan").await?;
        Ok(shown.map(|shown| shown.plan))
    }

    /// Keeps the plan of a job, in the place of one that this build cannot use.
    pub(super) async fn keep_plan(&self, id: Uuid, plan: &KeptPlan) -> Result<(), StoreError> {
        let failed = "keep the plan";
        let text = serde_json::to_vec(plan).map_err(StoreError::new(failed))?;
        // The semaphore is never closed.
        let _turn = self.writers.acquire().await;
        self.check()?;
        let kept = self.objects.put(&key(id, PLAN), sealed(text).into()).await;
        kept.map(drop).map_err(StoreError::new(failed))
    }

    /// Reads a file of a job that can be made again; `None` if there is none, or none that this
    /// build can use.
    async fn found<T: DeserializeOwned>(
        &self,
        id: Uuid,
        name: &str,
        failed: &'static str,
    ) -> Result<Option<T>, StoreError> {
        match self.read(id, name).await {
            Ok(text) => {
                let found = unsealed(text).and_then(|text| {
                    serde_json::from_slice(&text).map_err(|error| error.to_string())
                });
                let unusable = |error: &String| tracing::warn!(job = %id, name, error, "unusable");
                Ok(found.inspect_err(unusable).ok())
            }
            Err(Error::NotFound { .. }) => Ok(None),
            Err(error) => Err(StoreError::new(failed)(error)),
        }
    }

    /// Notes that attempt `n` begins.
    pub(super) async fn begin_attempt(&self, id: Uuid, n: u32) -> Result<(), StoreError> {
        match self.create(id, &format!("{ATTEMPT}{n}"), Vec::new()).await {
            Ok(()) | Err(Error::AlreadyExists { .. }) => Ok(()),
            Err(error) => Err(StoreError::new("note the attempt")(error)),
        }
    }

    /// Takes back the note of an attempt that came back: it must not count as a death of the process.
    pub(super) async fn take_back_attempt(&self, id: Uuid, n: u32) -> Result<(), StoreError> {
        self.check()?;
        match self.objects.delete(&key(id, &format!("{ATTEMPT}{n}"))).await {
            Ok(()) | Err(Error::NotFound { .. }) => Ok(()),
            Err(error) => Err(StoreError::new("take back the note of the attempt")(error)),
        }
    }

    /// Returns the file in which a run notes its progress, should its process die.
    pub(super) fn trace_path(&self, id: Uuid) -> PathBuf {
        self.directory(id).join(TRACE)
    }

    /// Notes that the job is to be cancelled, so that it stays stopped if the process dies before
    /// it ends.
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
                self.add_to_index(&Line::Ended(Ending::of(id, record)));
                Ok(record.clone())
            }
            Err(Error::AlreadyExists { .. }) => self.record(id).await,
            Err(error) => Err(StoreError::new("write the result")(error)),
        }
    }

    /// Returns how a job ended.
    pub(super) async fn record(&self, id: Uuid) -> Result<Record, StoreError> {
        let failed = "read the result";
        let text = self.read(id, RESULT).await.map_err(StoreError::new(failed))?;
        let text = unsealed(text).map_err(StoreError::new(failed))?;
        serde_json::from_slice(&text).map_err(StoreError::new(failed))
    }

    /// Returns the path of the log of a job once it is finished.
    pub(super) fn log_path(&self, id: Uuid) -> PathBuf {
        self.directory(id).join(LOG)
    }

    /// Returns whether a run of the job has begun its log.
    pub(super) fn has_begun(&self, id: Uuid) -> bool {
        [LOG, PART].iter().any(|name| self.directory(id).join(name).is_file())
    }

    /// Makes a finished log that has no result an unfinished one again: the run goes on from its last
    /// checkpoint and ends once more. Blocking.
    pub(super) fn reopen_log(&self, id: Uuid) -> Result<(), StoreError> {
        self.check()?;
        let directory = self.directory(id);
        if !directory.join(LOG).is_file() {
            return Ok(());
        }
        let renamed = fs::rename(directory.join(LOG), directory.join(PART));
        renamed.map_err(StoreError::new("reopen an unpublished log"))
    }

    /// Forgets a job and its log. A single rename does it; the rest is removed at the next start.
    pub(super) async fn forget(&self, id: Uuid) -> Result<(), StoreError> {
        self.check()?;
        let (from, to) = (self.directory(id), self.trash.join(id.to_string()));
        let removed = tokio::task::spawn_blocking(move || throw_away(&from, &to));
        let removed = removed.await.map_err(io::Error::other).flatten();
        removed.map_err(StoreError::new("forget the job"))
    }

    /// Returns all jobs, oldest first, and how many entries were found that are not jobs. Blocking.
    pub(super) fn scan(&self) -> Result<(Vec<Found>, usize), StoreError> {
        let (prefixes, mut aside) =
            prefixes(&self.jobs).map_err(StoreError::new("list the jobs"))?;
        let (mut index, lines) = self.read_index();
        let mut found = Vec::new();
        for (id, prefix) in prefixes {
            let ended = prefix.stands(RESULT);
            if !ended && !prefix.files.contains(SCENARIO) {
                if prefix.is_unanswered() {
                    let thrown = throw_away(&self.directory(id), &self.trash.join(id.to_string()));
                    if let Err(error) = thrown {
                        tracing::warn!(job = %id, %error, "an unfinished submission stays in the data directory");
                    }
                } else {
                    aside += 1;
                    let names: Vec<_> = prefix.files.iter().chain(&prefix.odd).collect();
                    tracing::error!(job = %id, ?names, "set aside: it has no scenario; nothing is removed");
                }
                continue;
            }
            let numbers = prefix.files.iter().filter_map(|name| name.strip_prefix(ATTEMPT));
            found.push(Found {
                id,
                key: prefix.files.iter().find_map(|name| parse_id(name.strip_prefix(KEY)?)),
                attempts: numbers.filter_map(|number| number.parse().ok()).max().unwrap_or(0),
                cancelled: prefix.stands(CANCEL),
                ended,
                has_log: prefix.files.contains(LOG),
                part_bytes: match prefix.files.contains(PART) {
                    true => self.directory(id).join(PART).metadata().map_or(0, |part| part.len()),
                    false => 0,
                },
                line: index.remove(&id),
            });
        }
        if lines > 3 * found.len() + 100 {
            self.shorten_index(&found);
        }
        Ok((found, aside))
    }

    /// Adds a line to the index; a lost one costs the next start a look at the job.
    pub(super) fn add_to_index(&self, line: &Line) {
        let Ok(line) = index_line(line) else { return };
        let mut index = self.index.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(index) = &mut *index
            && let Err(error) = index.write_all(line.as_bytes())
        {
            tracing::warn!(%error, "index not written");
        }
    }

    /// Returns the last sound line of the index of each job, and how many lines there are.
    fn read_index(&self) -> (HashMap<Uuid, Line>, usize) {
        let index = self.index.lock().unwrap_or_else(PoisonError::into_inner);
        if index.is_none() {
            return (HashMap::new(), 0);
        }
        let text = fs::read(self.data.path().join(INDEX)).unwrap_or_default();
        let lines = text.split(|byte| *byte == b'\n').filter(|line| !line.is_empty());
        let sound = lines.clone().filter_map(index_entry);
        (sound.map(|line| (line.id(), line)).collect(), lines.count())
    }

    /// Writes the index without the lines that are superseded, or of jobs that are gone.
    fn shorten_index(&self, found: &[Found]) {
        let lines = found.iter().filter_map(|found| found.line.as_ref());
        let text: String = lines.filter_map(|line| index_line(line).ok()).collect();
        let mut index = self.index.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(file) = &mut *index else { return };
        // Appending goes on behind what is written here.
        let rewritten = file.set_len(0).and_then(|()| file.write_all(text.as_bytes()));
        if let Err(error) = rewritten {
            tracing::warn!(%error, "index not rewritten");
        }
    }

    fn directory(&self, id: Uuid) -> PathBuf {
        self.jobs.join(id.to_string())
    }

    async fn read(&self, id: Uuid, name: &str) -> Result<Bytes, Error> {
        read(&self.data, &self.objects, &key(id, name)).await
    }

    async fn create(&self, id: Uuid, name: &str, content: Vec<u8>) -> Result<(), Error> {
        // The semaphore is never closed.
        let _turn = self.writers.acquire().await;
        create(&self.data, &self.objects, &key(id, name), content).await
    }
}

/// Returns the files of a directory, each on the disk once it is reported as written.
fn objects(data: &Path) -> Result<LocalFileSystem, ServeError> {
    let failed = |source| ServeError::Data { path: data.into(), source: io::Error::other(source) };
    Ok(LocalFileSystem::new_with_prefix(data).map_err(failed)?.with_fsync(true))
}

/// Reads a file.
async fn read(
    data: &DataDirectory,
    objects: &LocalFileSystem,
    place: &Key,
) -> Result<Bytes, Error> {
    data.check().map_err(refused)?;
    objects.get(place).await?.bytes().await
}

/// Writes a file that is not there yet.
async fn create(
    data: &DataDirectory,
    objects: &LocalFileSystem,
    place: &Key,
    content: Vec<u8>,
) -> Result<(), Error> {
    data.check().map_err(refused)?;
    let options = PutOptions { mode: PutMode::Create, ..PutOptions::default() };
    objects.put_opts(place, content.into(), options).await.map(drop)
}

/// Returns an error of the record as one of the file system.
fn refused(error: StoreError) -> Error {
    Error::Generic { store: "data", source: Box::new(error) }
}

/// Opens the index for appending; `None` if that fails, and the start reads each job.
fn open_index(path: &Path) -> Option<File> {
    // Opening anything but a file may block forever.
    if path.symlink_metadata().is_ok_and(|found| !found.is_file())
        && let Err(error) = put_aside(path)
    {
        tracing::warn!(%error, "there is no index");
        return None;
    }
    let file = File::options().create(true).append(true).read(true).open(path);
    file.inspect_err(|error| tracing::warn!(error = chain(error), "there is no index")).ok()
}

/// Returns a line of the index: a checksum and the text that it covers.
fn index_line(line: &Line) -> serde_json::Result<String> {
    let json = serde_json::to_string(line)?;
    Ok(format!("{:08x} {json}\n", crc32fast::hash(json.as_bytes())))
}

fn index_entry(line: &[u8]) -> Option<Line> {
    let (sum, json) = std::str::from_utf8(line).ok()?.split_once(' ')?;
    let sum = u32::from_str_radix(sum, 16).ok()?;
    if sum == crc32fast::hash(json.as_bytes()) {
        serde_json::from_slice(json.as_bytes()).ok()
    } else {
        None
    }
}

/// Returns a text with its checksum in a last line.
fn sealed(mut text: Vec<u8>) -> Vec<u8> {
    let sum = crc32fast::hash(&text);
    text.extend_from_slice(format!("\n{SEAL}{sum:08x}\n").as_bytes());
    text
}

/// Returns the text above a checksum that is right.
fn unsealed(text: Bytes) -> Result<Bytes, String> {
    // The last line: line end, word, eight digits, line end.
    let end = text.len().checked_sub(SEAL.len() + 10).ok_or("the text breaks off")?;
    let sum = crc32fast::hash(&text[..end]);
    if text[end..] == *format!("\n{SEAL}{sum:08x}\n").as_bytes() {
        Ok(text.slice(..end))
    } else {
        Err("the text is damaged: its checksum is not right".to_owned())
    }
}

/// Parses the one spelling of an id: lower case with hyphens. Anything else is no id.
pub(super) fn parse_id(text: &str) -> Option<Uuid> {
    Uuid::try_parse(text).ok().filter(|id| id.to_string() == text)
}

fn key(id: Uuid, name: &str) -> Key {
    Key::from_iter([JOBS, &id.to_string(), name])
}
