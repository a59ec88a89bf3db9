//! The record of the studies, on disk, beside that of the jobs and under the same rules.
//!
//! A study is a prefix: `studies/<uuid v7>/{request.json, attempt-1, …, result.json}`.
//!
//! Invariants: a study exists while its `request.json` does. `attempt-N` counts the runs that never came back,
//! and `result.json` is written put-if-absent: a study ends once.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use axum::body::Bytes;
use futures_util::TryStreamExt;
use object_store::local::LocalFileSystem;
use object_store::path::Path as Key;
use object_store::{Error, ObjectStore, ObjectStoreExt};
use uuid::Uuid;

use super::{
    ATTEMPT, RESULT, ServeError, StoreError, create, forget_prefix, make_directory, objects,
    parse_id, sealed, unsealed,
};

const STUDIES: &str = "studies";
const REQUEST: &str = "request.json";

/// What the scan found of one study.
#[derive(Debug)]
pub(in crate::serve) struct FoundStudy {
    pub(in crate::serve) id: Uuid,
    pub(in crate::serve) attempts: u32,
    pub(in crate::serve) request: Result<Bytes, StoreError>,
    /// None if it has not ended.
    pub(in crate::serve) result: Option<Result<Bytes, StoreError>>,
}

/// The record of the studies.
#[derive(Debug)]
pub(in crate::serve) struct StudyStore {
    objects: LocalFileSystem,
    studies: PathBuf,
}

impl StudyStore {
    /// Opens the record in a directory that exists and is locked.
    pub(in crate::serve) fn open(data: &Path) -> Result<Self, ServeError> {
        let failed = |source| ServeError::Data { path: data.into(), source };
        let studies = data.canonicalize().map_err(failed)?.join(STUDIES);
        make_directory(&studies).map_err(failed)?;
        Ok(Self { objects: objects(data)?, studies })
    }

    /// Keeps what was asked.
    pub(in crate::serve) async fn keep(&self, id: Uuid, request: &[u8]) -> Result<(), StoreError> {
        let failed = StoreError::new("keep the study");
        create(&self.objects, &key(id, REQUEST), sealed(request.to_vec())).await.map_err(failed)
    }

    /// Notes that attempt `n` begins.
    pub(in crate::serve) async fn begin_attempt(&self, id: Uuid, n: u32) -> Result<(), StoreError> {
        let failed = StoreError::new("note the attempt");
        let note = key(id, &format!("{ATTEMPT}{n}"));
        create(&self.objects, &note, Vec::new()).await.map_err(failed)
    }

    /// Takes back the note of an attempt that was interrupted in order.
    pub(in crate::serve) async fn take_back_attempt(
        &self,
        id: Uuid,
        n: u32,
    ) -> Result<(), StoreError> {
        let failed = StoreError::new("take back the note of the attempt");
        self.objects.delete(&key(id, &format!("{ATTEMPT}{n}"))).await.map_err(failed)
    }

    /// Ends a study; the first record stands.
    pub(in crate::serve) async fn publish(
        &self,
        id: Uuid,
        result: Vec<u8>,
    ) -> Result<(), StoreError> {
        match create(&self.objects, &key(id, RESULT), sealed(result)).await {
            Ok(()) | Err(Error::AlreadyExists { .. }) => Ok(()),
            Err(error) => Err(StoreError::new("write the result of the study")(error)),
        }
    }

    /// Forgets a study. Blocking.
    pub(in crate::serve) fn forget(&self, id: Uuid) -> Result<(), StoreError> {
        forget_prefix(&self.studies.join(id.to_string()), REQUEST)
            .map_err(StoreError::new("forget the study"))
    }

    /// All studies, oldest first. Prefixes without a request are passed over.
    pub(in crate::serve) async fn scan(&self) -> Result<Vec<FoundStudy>, StoreError> {
        let failed = "list the studies";
        let mut studies: BTreeMap<Uuid, Vec<String>> = BTreeMap::new();
        let mut entries = self.objects.list(Some(&Key::from(STUDIES)));
        while let Some(entry) = entries.try_next().await.map_err(StoreError::new(failed))? {
            let parts: Vec<_> = entry.location.parts().collect();
            if let [_, id, name] = parts.as_slice()
                && let Some(id) = parse_id(id.as_ref())
            {
                studies.entry(id).or_default().push(name.as_ref().to_owned());
            }
        }
        let mut found = Vec::with_capacity(studies.len());
        for (id, names) in studies {
            let has = |wanted: &str| names.iter().any(|name| name == wanted);
            if !has(REQUEST) {
                continue;
            }
            let attempt = |name: &String| name.strip_prefix(ATTEMPT)?.parse().ok();
            found.push(FoundStudy {
                id,
                attempts: names.iter().filter_map(attempt).max().unwrap_or(0),
                request: self.read(id, REQUEST).await,
                result: if has(RESULT) { Some(self.read(id, RESULT).await) } else { None },
            });
        }
        Ok(found)
    }

    async fn read(&self, id: Uuid, name: &str) -> Result<Bytes, StoreError> {
        let failed = "read the record of a study";
        let object = self.objects.get(&key(id, name)).await.map_err(StoreError::new(failed))?;
        let text = object.bytes().await.map_err(StoreError::new(failed))?;
        unsealed(text).map_err(StoreError::new(failed))
    }
}

fn key(id: Uuid, name: &str) -> Key {
    Key::from_iter([STUDIES, &id.to_string(), name])
}
