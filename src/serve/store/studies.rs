//! The record of the studies, on disk, next to that of the jobs and under the same rules.
//!
//! A study is a prefix: `studies/<id>/{request.json, attempt-1, …, result.json}`.
//!
//! Invariants: a study exists while its `request.json` does. `attempt-N` counts the runs that never came back,
//! and `result.json` is written put-if-absent: a study ends once.

use std::path::PathBuf;

use axum::body::Bytes;
use object_store::local::LocalFileSystem;
use object_store::path::Path as Key;
use object_store::{Error, ObjectStoreExt};
use uuid::Uuid;

use super::directory::{DataDirectory, own_directory, prefixes, throw_away};
use super::{
    ATTEMPT, RESULT, ServeError, StoreError, TRASH, chain, create, objects, read, sealed, unsealed,
};

const STUDIES: &str = "studies";
const REQUEST: &str = "request.json";

/// Result of the scan for one study.
#[derive(Debug)]
pub(in crate::serve) struct FoundStudy {
    pub(in crate::serve) id: Uuid,
    pub(in crate::serve) attempts: u32,
    pub(in crate::serve) request: Result<Bytes, StoreError>,
    /// Result; `None` if it has not ended.
    pub(in crate::serve) result: Option<Result<Bytes, StoreError>>,
}

/// The record of the studies.
#[derive(Debug)]
pub(in crate::serve) struct StudyStore {
    objects: LocalFileSystem,
    data: DataDirectory,
    studies: PathBuf,
    trash: PathBuf,
}

impl StudyStore {
    /// Opens the record in a directory that exists and is locked.
    pub(in crate::serve) fn open(data: DataDirectory) -> Result<Self, ServeError> {
        let path = data.path();
        let (studies, trash) = (own_directory(path, STUDIES)?, own_directory(path, TRASH)?);
        Ok(Self { objects: objects(path)?, data, studies, trash })
    }

    /// Checks that the data directory is where it was.
    pub(in crate::serve) fn check(&self) -> Result<(), StoreError> {
        self.data.check()
    }

    /// Keeps the request of a study.
    pub(in crate::serve) async fn keep(&self, id: Uuid, request: &[u8]) -> Result<(), StoreError> {
        let failed = StoreError::new("keep the study");
        self.create(id, REQUEST, sealed(request.to_vec())).await.map_err(failed)
    }

    /// Returns the folder with the files of a study.
    pub(in crate::serve) fn folder(&self, id: Uuid) -> PathBuf {
        self.studies.join(id.to_string())
    }

    /// Returns the request of a study.
    pub(in crate::serve) async fn request(&self, id: Uuid) -> Result<Bytes, StoreError> {
        self.read(id, REQUEST).await
    }

    /// Notes that attempt `n` begins.
    pub(in crate::serve) async fn begin_attempt(&self, id: Uuid, n: u32) -> Result<(), StoreError> {
        match self.create(id, &format!("{ATTEMPT}{n}"), Vec::new()).await {
            Ok(()) | Err(Error::AlreadyExists { .. }) => Ok(()),
            Err(error) => Err(StoreError::new("note the attempt")(error)),
        }
    }

    /// Takes back the note of an attempt that was interrupted in order.
    pub(in crate::serve) async fn take_back_attempt(
        &self,
        id: Uuid,
        n: u32,
    ) -> Result<(), StoreError> {
        let failed = StoreError::new("take back the note of the attempt");
        self.check()?;
        self.objects.delete(&key(id, &format!("{ATTEMPT}{n}"))).await.map_err(failed)
    }

    /// Ends a study; the first record stands.
    pub(in crate::serve) async fn publish(
        &self,
        id: Uuid,
        record: &impl serde::Serialize,
    ) -> Result<(), StoreError> {
        let failed = "write the result of the study";
        let result = serde_json::to_vec(record).map_err(StoreError::new(failed))?;
        match self.create(id, RESULT, sealed(result)).await {
            Ok(()) | Err(Error::AlreadyExists { .. }) => Ok(()),
            Err(error) => Err(StoreError::new(failed)(error)),
        }
    }

    /// Forgets a study. Blocking.
    pub(in crate::serve) fn forget(&self, id: Uuid) -> Result<(), StoreError> {
        self.check()?;
        let name = id.to_string();
        throw_away(&self.studies.join(&name), &self.trash.join(&name))
            .map_err(StoreError::new("forget the study"))
    }

    /// Returns all studies, oldest first, and how many entries were found that are not studies.
    pub(in crate::serve) async fn scan(&self) -> Result<(Vec<FoundStudy>, usize), StoreError> {
        let (prefixes, mut aside) =
            prefixes(&self.studies).map_err(StoreError::new("list the studies"))?;
        let mut found = Vec::with_capacity(prefixes.len());
        for (id, prefix) in prefixes {
            if !prefix.files.contains(REQUEST) && !prefix.stands(RESULT) {
                if prefix.is_unanswered() {
                    if let Err(error) = self.forget(id) {
                        tracing::warn!(study = %id, error = chain(&error), "an unfinished submission stays in the data directory");
                    }
                } else {
                    aside += 1;
                    tracing::error!(study = %id, "set aside: it has no request; nothing is removed");
                }
                continue;
            }
            let read = async |name: &str| match prefix.files.contains(name) {
                true => self.read(id, name).await,
                false => {
                    Err(StoreError::new("read the record of a study")("there is no such file"))
                }
            };
            let attempt = |name: &String| name.strip_prefix(ATTEMPT)?.parse().ok();
            found.push(FoundStudy {
                id,
                attempts: prefix.files.iter().filter_map(attempt).max().unwrap_or(0),
                request: read(REQUEST).await,
                result: if prefix.stands(RESULT) { Some(read(RESULT).await) } else { None },
            });
        }
        Ok((found, aside))
    }

    async fn read(&self, id: Uuid, name: &str) -> Result<Bytes, StoreError> {
        let failed = "read the record of a study";
        let text = read(&self.data, &self.objects, &key(id, name)).await;
        unsealed(text.map_err(StoreError::new(failed))?).map_err(StoreError::new(failed))
    }

    async fn create(&self, id: Uuid, name: &str, content: Vec<u8>) -> Result<(), Error> {
        create(&self.data, &self.objects, &key(id, name), content).await
    }
}

fn key(id: Uuid, name: &str) -> Key {
    Key::from_iter([STUDIES, &id.to_string(), name])
}
