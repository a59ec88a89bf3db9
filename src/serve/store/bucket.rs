//! The record in a bucket, or in a directory that several machines share.
//!
//! A job is a prefix as on a disk: `jobs/<id>/{sent.json, scenario.json, plan.json, cancel, attempt-1, …, result.json}`.
//! `parts/<uuid>/<build>/<from>-<to>` are the bytes of its unfinished log that are durable, `logs/<uuid>/<sha256>.mcap` is
//! the finished one, and `keys/<uuid v5>` names the job that came under an idempotency key.
//!
//! Invariants: those of the record on a disk, and: a finished log is named by its checksum, and a
//! part by its place and build, so that a worker that was thought dead overwrites no other with
//! something else. `attempt-N` holds the step from which that attempt went on.

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use axum::body::Bytes;
use futures_util::{StreamExt, TryStreamExt, stream};
use object_store::local::LocalFileSystem;
use object_store::path::Path as Key;
use object_store::{
    Error, ObjectStore, ObjectStoreExt, PutMode, PutOptions, PutPayload, WriteMultipart,
};
use serde::de::DeserializeOwned;
use serde_json::value::RawValue;
use tokio::io::{AsyncReadExt, AsyncSeekExt, AsyncWriteExt};
use uuid::Uuid;

use super::{
    ATTEMPT, CANCEL, JOBS, KeptPlan, LogSum, PLAN, RESULT, Record, SCENARIO, SENT, StoreError,
    parse_id, sealed, unsealed,
};
use crate::advise::Settled;

const KEYS: &str = "keys";
const LOGS: &str = "logs";
const PARTS: &str = "parts";
const SWEEPS: &str = "sweeps";
const LINK_KEY: &str = "link-key";

/// Number of bytes of a log that are sent in one piece; a bucket takes ten thousand of them.
const PIECE: usize = 16 << 20;

/// Number of pieces that are sent at once.
const UNDER_WAY: usize = 2;

/// Number of requests at once where many small objects are read.
const WIDTH: usize = 16;

/// The build whose unfinished logs this one resumes.
const BUILD: &str = env!("VPD_BUILD");

/// Reason why a record cannot be opened.
#[derive(Debug, thiserror::Error)]
pub enum BucketError {
    /// The address is not that of a bucket or a directory.
    #[error(
        "the bucket {given:?} cannot be used: {message}; write s3://NAME/PREFIX or file:///DIRECTORY"
    )]
    Address {
        /// The address given.
        given: String,
        /// Description of the error.
        message: String,
    },
    /// The store behind the address cannot be reached or refuses access.
    #[error("the bucket {address} does not answer: {message}")]
    Silent {
        /// The address.
        address: String,
        /// Its answer.
        message: String,
    },
}

/// State of a job in the bucket.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(in crate::serve) struct Held {
    /// Whether there is a job.
    pub(in crate::serve) accepted: bool,
    pub(in crate::serve) ended: bool,
    pub(in crate::serve) cancelled: bool,
    /// Number of runs that have not come back.
    pub(in crate::serve) attempts: u32,
}

impl Held {
    fn note(&mut self, name: &str) {
        match name {
            SCENARIO => self.accepted = true,
            RESULT => (self.accepted, self.ended) = (true, true),
            CANCEL => self.cancelled = true,
            _ => {
                let number = name.strip_prefix(ATTEMPT).and_then(|number| number.parse().ok());
                self.attempts = self.attempts.max(number.unwrap_or(0));
            }
        }
    }
}

/// A handle on the record; copies are the same record.
#[derive(Clone, Debug)]
pub(in crate::serve) struct Bucket(Arc<dyn ObjectStore>);

impl Bucket {
    /// Opens the record at an address, and checks that it answers.
    pub(in crate::serve) async fn open(address: &str) -> Result<Self, BucketError> {
        let wrong = |message: String| BucketError::Address { given: address.to_owned(), message };
        let objects: Arc<dyn ObjectStore> = match address.split_once("://") {
            Some(("file", path)) => {
                std::fs::create_dir_all(path).map_err(|error| wrong(error.to_string()))?;
                let objects = LocalFileSystem::new_with_prefix(path);
                Arc::new(objects.map_err(|error| wrong(error.to_string()))?.with_fsync(true))
            }
            Some(("s3", place)) => s3(address, place).map_err(wrong)?,
            _ => return Err(wrong("this is not such an address".to_owned())),
        };
        let bucket = Self(objects);
        match bucket.0.get(&Key::from(LINK_KEY)).await {
            Ok(_) | Err(Error::NotFound { .. }) => Ok(bucket),
            Err(error) => {
                let message = crate::serve::chain(&error);
                Err(BucketError::Silent { address: address.to_owned(), message })
            }
        }
    }

    /// Returns the bytes that sign links, drawn where there are none: all services of a bucket have
    /// the same.
    pub(in crate::serve) async fn link_key(&self, drawn: Vec<u8>) -> Result<Bytes, StoreError> {
        let failed = "keep the key of links";
        let place = Key::from(LINK_KEY);
        self.create(&place, drawn).await.map(drop).map_err(StoreError::new(failed))?;
        self.read(&place).await.map_err(StoreError::new(failed))
    }

    /// Returns the job that came under a key first: `id` if that was now.
    pub(in crate::serve) async fn claim(&self, key: Uuid, id: Uuid) -> Result<Uuid, StoreError> {
        let failed = "keep the key";
        let place = Key::from_iter([KEYS, &key.to_string()]);
        let text = id.to_string().into_bytes();
        if self.create(&place, text).await.map_err(StoreError::new(failed))? {
            return Ok(id);
        }
        let text = self.read(&place).await.map_err(StoreError::new(failed))?;
        let first = std::str::from_utf8(&text).ok().and_then(parse_id);
        first.ok_or_else(|| StoreError::new(failed)("its object holds no id"))
    }

    /// Keeps a job. Its scenario goes last: before it there is no job.
    pub(in crate::serve) async fn accept(
        &self,
        id: Uuid,
        scenario: Vec<u8>,
        sent: Vec<u8>,
    ) -> Result<(), StoreError> {
        let failed = "keep the scenario";
        if sent != scenario {
            let kept = self.create(&of(id, SENT), sealed(sent)).await;
            kept.map_err(StoreError::new(failed))?;
        }
        let kept = self.create(&of(id, SCENARIO), sealed(scenario)).await;
        kept.map(drop).map_err(StoreError::new(failed))
    }

    /// Returns the scenario of a job, as accepted; `None` if there is no such job.
    pub(in crate::serve) async fn scenario(&self, id: Uuid) -> Result<Option<Bytes>, StoreError> {
        self.text(id, SCENARIO, "read the scenario").await
    }

    /// Returns the scenario of a job as it was sent, if that is another text.
    pub(in crate::serve) async fn sent(&self, id: Uuid) -> Result<Option<Bytes>, StoreError> {
        self.text(id, SENT, "read the scenario").await
    }

    /// Returns the results of runs for a job; `None` if they are not known yet, or this build
    /// cannot use them.
    pub(in crate::serve) async fn settled(&self, id: Uuid) -> Result<Option<Settled>, StoreError> {
        let kept: Option<KeptPlan> = self.found(id, PLAN, "read the plan").await?;
        Ok(kept.map(|kept| kept.settled))
    }

    /// Returns the plan of a job for clients; `None` if there is none yet.
    pub(in crate::serve) async fn plan(
        &self,
        id: Uuid,
    ) -> Result<Option<Box<RawValue>>, StoreError> {
        let kept: Option<KeptPlan> = self.found(id, PLAN, "read the plan").await?;
        Ok(kept.map(|kept| kept.plan))
    }

    /// Keeps the plan of a job, in the place of one that this build cannot use.
    pub(in crate::serve) async fn keep_plan(
        &self,
        id: Uuid,
        plan: &KeptPlan,
    ) -> Result<(), StoreError> {
        let failed = "keep the plan";
        let text = serde_json::to_vec(plan).map_err(StoreError::new(failed))?;
        let kept = self.0.put(&of(id, PLAN), sealed(text).into()).await;
        kept.map(drop).map_err(StoreError::new(failed))
    }

    /// Returns the state of a job in the bucket.
    pub(in crate::serve) async fn look(&self, id: Uuid) -> Result<Held, StoreError> {
        let prefix = Key::from_iter([JOBS, &id.to_string()]);
        let mut held = Held::default();
        let mut names = self.0.list(Some(&prefix));
        while let Some(found) = names.next().await {
            let found = found.map_err(StoreError::new("look for the job"))?;
            held.note(found.location.filename().unwrap_or_default());
        }
        Ok(held)
    }

    /// Returns the states of all jobs from one on.
    pub(in crate::serve) async fn list(
        &self,
        from: Uuid,
    ) -> Result<BTreeMap<Uuid, Held>, StoreError> {
        // Names begin after the offset: some stores take all names below a folder of that name for the folder itself.
        let before = Uuid::from_u128(from.as_u128().saturating_sub(1));
        let (prefix, offset) = (Key::from(JOBS), Key::from_iter([JOBS, &before.to_string()]));
        let mut jobs = BTreeMap::<Uuid, Held>::new();
        let mut names = self.0.list_with_offset(Some(&prefix), &offset);
        while let Some(found) = names.next().await {
            let found = found.map_err(StoreError::new("list the jobs"))?;
            let mut parts = found.location.parts().skip(1);
            let (Some(id), Some(name)) = (parts.next(), parts.next()) else { continue };
            let Some(id) = parse_id(id.as_ref()) else { continue };
            jobs.entry(id).or_default().note(name.as_ref());
        }
        jobs.retain(|_, held| held.accepted);
        Ok(jobs)
    }

    /// Notes that an attempt begins at a step; returns its number.
    pub(in crate::serve) async fn begin_attempt(
        &self,
        id: Uuid,
        before: u32,
        from_step: u64,
    ) -> Result<u32, StoreError> {
        for number in before + 1.. {
            let place = of(id, &format!("{ATTEMPT}{number}"));
            let noted = self.create(&place, from_step.to_string().into_bytes()).await;
            if noted.map_err(StoreError::new("note the attempt"))? {
                return Ok(number);
            }
        }
        Err(StoreError::new("note the attempt")("there are too many"))
    }

    /// Takes back the note of an attempt that came back.
    pub(in crate::serve) async fn take_back_attempt(
        &self,
        id: Uuid,
        number: u32,
    ) -> Result<(), StoreError> {
        match self.0.delete(&of(id, &format!("{ATTEMPT}{number}"))).await {
            Ok(()) | Err(Error::NotFound { .. }) => Ok(()),
            Err(error) => Err(StoreError::new("take back the note of the attempt")(error)),
        }
    }

    /// Returns whether the last `count` attempts all went on from `step`, as this one does.
    pub(in crate::serve) async fn is_stuck(
        &self,
        id: Uuid,
        attempts: u32,
        count: u32,
        step: u64,
    ) -> Result<bool, StoreError> {
        if attempts < count {
            return Ok(false);
        }
        let notes = stream::iter(attempts - count + 1..=attempts).map(|number| async move {
            match self.read(&of(id, &format!("{ATTEMPT}{number}"))).await {
                Ok(text) => Ok(text == step.to_string().as_bytes()),
                Err(Error::NotFound { .. }) => Ok(false),
                Err(error) => Err(StoreError::new("read the attempts")(error)),
            }
        });
        notes.buffered(WIDTH).try_all(async |same| same).await
    }

    /// Notes that the job is to be cancelled.
    pub(in crate::serve) async fn note_cancel(&self, id: Uuid) -> Result<(), StoreError> {
        let noted = self.create(&of(id, CANCEL), Vec::new()).await;
        noted.map(drop).map_err(StoreError::new("note the cancellation"))
    }

    /// Returns whether the job is to be cancelled.
    pub(in crate::serve) async fn is_cancelled(&self, id: Uuid) -> Result<bool, StoreError> {
        match self.0.head(&of(id, CANCEL)).await {
            Ok(_) => Ok(true),
            Err(Error::NotFound { .. }) => Ok(false),
            Err(error) => Err(StoreError::new("look for a cancellation")(error)),
        }
    }

    /// Ends a job. The first record wins: the one that stands is returned.
    pub(in crate::serve) async fn publish(
        &self,
        id: Uuid,
        record: &Record,
    ) -> Result<Record, StoreError> {
        let failed = "write the result";
        let text = serde_json::to_vec(record).map_err(StoreError::new(failed))?;
        let created = self.create(&of(id, RESULT), sealed(text)).await;
        if created.map_err(StoreError::new(failed))? {
            return Ok(record.clone());
        }
        self.record(id).await?.ok_or_else(|| StoreError::new(failed)("the job was forgotten"))
    }

    /// Returns how a job ended; `None` if it has not.
    pub(in crate::serve) async fn record(&self, id: Uuid) -> Result<Option<Record>, StoreError> {
        let failed = "read the result";
        let text = self.text(id, RESULT, failed).await?;
        text.map(|text| serde_json::from_slice(&text).map_err(StoreError::new(failed))).transpose()
    }

    /// Appends the durable part of an unfinished log to the bytes that a file holds; returns how
    /// many it holds then.
    pub(in crate::serve) async fn fetch_part(
        &self,
        id: Uuid,
        path: &Path,
    ) -> Result<u64, StoreError> {
        let failed = "fetch the unfinished log";
        let prefix = Key::from_iter([PARTS, &id.to_string(), BUILD]);
        let mut parts = Vec::new();
        let mut names = self.0.list(Some(&prefix));
        while let Some(found) = names.next().await {
            let found = found.map_err(StoreError::new(failed))?;
            let name = found.location.filename().and_then(|name| name.split_once('-'));
            let place = name.and_then(|(from, to)| Some((from.parse().ok()?, to.parse().ok()?)));
            parts.extend(place.map(|(from, to): (u64, u64)| (from, to, found.location.clone())));
        }
        // Whichever worker wrote a part, its bytes are those of the log at that place.
        parts.sort_by_key(|(from, to, _)| (*from, *to));
        let file = tokio::fs::File::options().create(true).append(true).open(path).await;
        let mut file = file.map_err(StoreError::new(failed))?;
        let mut held = file.metadata().await.map_err(StoreError::new(failed))?.len();
        for (from, to, place) in parts {
            if from > held || to <= held {
                continue;
            }
            let bytes = self.0.get_range(&place, held - from..to - from).await;
            let bytes = bytes.map_err(StoreError::new(failed))?;
            file.write_all(&bytes).await.map_err(StoreError::new(failed))?;
            held += bytes.len() as u64;
        }
        file.flush().await.map_err(StoreError::new(failed))?;
        Ok(held)
    }

    /// Makes bytes of an unfinished log durable.
    pub(in crate::serve) async fn keep_part(
        &self,
        id: Uuid,
        path: &Path,
        place: Range<u64>,
    ) -> Result<(), StoreError> {
        let failed = "keep the unfinished log";
        let file = tokio::fs::File::open(path).await;
        let mut file = file.map_err(StoreError::new(failed))?;
        let mut from = place.start;
        while from < place.end {
            let to = place.end.min(from + PIECE as u64);
            let mut bytes = vec![0; (to - from) as usize];
            let sought = file.seek(std::io::SeekFrom::Start(from)).await;
            sought.map_err(StoreError::new(failed))?;
            file.read_exact(&mut bytes).await.map_err(StoreError::new(failed))?;
            let name = format!("{from:016}-{to:016}");
            let key = Key::from_iter([PARTS, &id.to_string(), BUILD, &name]);
            self.0.put(&key, bytes.into()).await.map_err(StoreError::new(failed))?;
            from = to;
        }
        Ok(())
    }

    /// Uploads a finished log, in parts under checksums; it is there as a whole or not at all.
    pub(in crate::serve) async fn keep_log(
        &self,
        id: Uuid,
        path: &Path,
        sum: &LogSum,
    ) -> Result<(), StoreError> {
        let failed = "upload the log";
        let place = log_key(id, sum);
        let file = tokio::fs::File::open(path).await;
        let mut file = file.map_err(StoreError::new(failed))?;
        if sum.bytes <= PIECE as u64 {
            let mut bytes = Vec::with_capacity(sum.bytes as usize);
            file.read_to_end(&mut bytes).await.map_err(StoreError::new(failed))?;
            self.0.put(&place, bytes.into()).await.map_err(StoreError::new(failed))?;
        } else {
            let upload = self.0.put_multipart(&place).await.map_err(StoreError::new(failed))?;
            let mut upload = WriteMultipart::new_with_chunk_size(upload, PIECE);
            let sent = async {
                loop {
                    upload.wait_for_capacity(UNDER_WAY).await?;
                    let mut bytes = vec![0; 1 << 20];
                    let length = file.read(&mut bytes).await.map_err(io_error)?;
                    if length == 0 {
                        return Ok::<_, Error>(());
                    }
                    bytes.truncate(length);
                    upload.put(bytes.into());
                }
            };
            let sent = sent.await;
            match sent {
                Ok(()) => upload.finish().await.map(drop).map_err(StoreError::new(failed))?,
                Err(error) => {
                    // The remains are for the bucket's own rules to remove.
                    let _ = upload.abort().await;
                    return Err(StoreError::new(failed)(error));
                }
            }
        }
        let stored = self.0.head(&place).await.map_err(StoreError::new(failed))?;
        if stored.size == sum.bytes {
            Ok(())
        } else {
            let why = format!("{} bytes arrived of {}", stored.size, sum.bytes);
            Err(StoreError::new(failed)(why))
        }
    }

    /// Removes a finished log that is not the one of the result.
    pub(in crate::serve) async fn drop_log(&self, id: Uuid, sum: &LogSum) {
        if let Err(error) = self.0.delete(&log_key(id, sum)).await {
            tracing::warn!(job = %id, %error, "a log without a result stays in the bucket");
        }
    }

    /// Returns bytes of a finished log.
    pub(in crate::serve) async fn log_bytes(
        &self,
        id: Uuid,
        sum: &LogSum,
        place: Range<u64>,
    ) -> Result<stream::BoxStream<'static, std::io::Result<Bytes>>, StoreError> {
        let options = object_store::GetOptions { range: Some(place.into()), ..Default::default() };
        let found = self.0.get_opts(&log_key(id, sum), options).await;
        let found = found.map_err(StoreError::new("read the log"))?;
        Ok(found.into_stream().map_err(std::io::Error::other).boxed())
    }

    /// Removes the parts that a finished log makes needless.
    pub(in crate::serve) async fn drop_parts(&self, id: Uuid) -> Result<(), StoreError> {
        self.remove(Key::from_iter([PARTS, &id.to_string()])).await
    }

    /// Forgets a job and its log.
    pub(in crate::serve) async fn forget(&self, id: Uuid) -> Result<(), StoreError> {
        // From here on there is no job.
        for name in [RESULT, SCENARIO] {
            match self.0.delete(&of(id, name)).await {
                Ok(()) | Err(Error::NotFound { .. }) => {}
                Err(error) => return Err(StoreError::new("forget the job")(error)),
            }
        }
        for prefix in [LOGS, PARTS, JOBS] {
            self.remove(Key::from_iter([prefix, &id.to_string()])).await?;
        }
        Ok(())
    }

    /// Keeps an object of this name, unless it exists.
    pub(in crate::serve) async fn keep(
        &self,
        name: &str,
        content: Vec<u8>,
    ) -> Result<(), StoreError> {
        let kept = self.create(&Key::from(name), content).await;
        kept.map(drop).map_err(StoreError::new("keep a part of a sweep"))
    }

    /// Returns the object of a name; `None` if there is none.
    pub(in crate::serve) async fn kept(&self, name: &str) -> Result<Option<Bytes>, StoreError> {
        match self.read(&Key::from(name)).await {
            Ok(content) => Ok(Some(content)),
            Err(Error::NotFound { .. }) => Ok(None),
            Err(error) => Err(StoreError::new("read a part of a sweep")(error)),
        }
    }

    /// Removes a sweep and its parts.
    pub(in crate::serve) async fn drop_sweep(&self, digest: &str) -> Result<(), StoreError> {
        self.remove(Key::from_iter([SWEEPS, digest])).await
    }

    async fn remove(&self, prefix: Key) -> Result<(), StoreError> {
        let names = self.0.list(Some(&prefix)).map_ok(|found| found.location).boxed();
        let removed = self.0.delete_stream(names).try_for_each(async |_| Ok(())).await;
        match removed {
            Ok(()) | Err(Error::NotFound { .. }) => Ok(()),
            Err(error) => Err(StoreError::new("remove what is left of the job")(error)),
        }
    }

    /// Reads an object that can be made again.
    async fn found<T: DeserializeOwned>(
        &self,
        id: Uuid,
        name: &str,
        failed: &'static str,
    ) -> Result<Option<T>, StoreError> {
        let Some(text) = self.text(id, name, failed).await? else { return Ok(None) };
        let unusable =
            |error: &serde_json::Error| tracing::warn!(job = %id, name, %error, "unusable");
        Ok(serde_json::from_slice(&text).inspect_err(unusable).ok())
    }

    /// Returns a text of a job; `None` if there is none.
    async fn text(
        &self,
        id: Uuid,
        name: &str,
        failed: &'static str,
    ) -> Result<Option<Bytes>, StoreError> {
        match self.read(&of(id, name)).await {
            Ok(text) => unsealed(text).map(Some).map_err(StoreError::new(failed)),
            Err(Error::NotFound { .. }) => Ok(None),
            Err(error) => Err(StoreError::new(failed)(error)),
        }
    }

    async fn read(&self, place: &Key) -> Result<Bytes, Error> {
        self.0.get(place).await?.bytes().await
    }

    /// Writes an object that is not there yet; returns whether it was not.
    async fn create(&self, place: &Key, content: Vec<u8>) -> Result<bool, Error> {
        let options = PutOptions { mode: PutMode::Create, ..PutOptions::default() };
        match self.0.put_opts(place, PutPayload::from(content), options).await {
            Ok(_) => Ok(true),
            Err(Error::AlreadyExists { .. } | Error::Precondition { .. }) => Ok(false),
            Err(error) => Err(error),
        }
    }
}

fn of(id: Uuid, name: &str) -> Key {
    Key::from_iter([JOBS, &id.to_string(), name])
}

fn log_key(id: Uuid, sum: &LogSum) -> Key {
    Key::from_iter([LOGS, &id.to_string(), &format!("{}.mcap", sum.sha256)])
}

fn io_error(source: std::io::Error) -> Error {
    Error::Generic { store: "file", source: source.into() }
}

/// Returns the bucket of an address; credentials, region and endpoint are in the usual variables,
/// as AWS_ACCESS_KEY_ID.
#[cfg(feature = "s3")]
fn s3(address: &str, place: &str) -> Result<Arc<dyn ObjectStore>, String> {
    use object_store::aws::{AmazonS3Builder, Checksum};
    use object_store::prefix::PrefixStore;
    let builder = AmazonS3Builder::from_env().with_url(address);
    // Each part is sent with its checksum, which the store compares.
    let objects = builder.with_checksum_algorithm(Checksum::SHA256).build();
    let objects = objects.map_err(|error| error.to_string())?;
    Ok(match place.split_once('/') {
        Some((_, prefix)) if !prefix.is_empty() => Arc::new(PrefixStore::new(objects, prefix)),
        _ => Arc::new(objects),
    })
}

#[cfg(not(feature = "s3"))]
fn s3(_: &str, _: &str) -> Result<Arc<dyn ObjectStore>, String> {
    Err("this program was built without the feature s3".to_owned())
}

/// Returns the path of the copy of a log in a directory.
pub(in crate::serve) fn copy_of(directory: &Path, id: Uuid) -> PathBuf {
    directory.join(format!("{id}.mcap"))
}
