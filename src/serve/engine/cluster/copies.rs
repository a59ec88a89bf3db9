//! Copies of logs on the disk of a service, for its charts and for readers that follow.
//!
//! Invariant: a copy with the name of a log is whole and has its checksum. Copies take a limited amount of room; the
//! oldest go first, and a start begins without any.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use std::{fs, io};

use futures_util::StreamExt;
use tokio::io::AsyncWriteExt;
use uuid::Uuid;

use super::{Refusal, lock};
use crate::log::part_path;
use crate::serve::ServeError;
use crate::serve::store::bucket::{Bucket, copy_of};
use crate::serve::store::{LogSum, StoreError};

/// Time for which a copy of an unfinished log serves repeated requests.
const LOOK: Duration = Duration::from_millis(500);

/// Lock of a copy while it is changed; holds the time of the last look at it.
type Held = Arc<tokio::sync::Mutex<Option<Instant>>>;

#[derive(Debug)]
pub(super) struct Copies {
    folder: PathBuf,
    room_bytes: u64,
    held: Mutex<HashMap<Uuid, Held>>,
}

impl Copies {
    pub(super) fn open(data: &Path, room_bytes: u64) -> Result<Self, ServeError> {
        let folder = data.join("copies");
        let failed = |source| ServeError::Data { path: folder.clone(), source };
        match fs::remove_dir_all(&folder) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(failed(error)),
            _ => {}
        }
        fs::create_dir_all(&folder).map_err(failed)?;
        Ok(Self { folder, room_bytes, held: Mutex::default() })
    }

    fn hold(&self, id: Uuid) -> Held {
        lock(&self.held).entry(id).or_default().clone()
    }

    /// Returns the unfinished log as far as it is durable, in a file with this name and `.part`.
    pub(super) async fn grown(&self, bucket: &Bucket, id: Uuid) -> Result<PathBuf, Refusal> {
        let (held, path) = (self.hold(id), copy_of(&self.folder, id));
        let mut looked = held.lock().await;
        if !path.exists() && looked.is_none_or(|at| at.elapsed() > LOOK) {
            bucket.fetch_part(id, &part_path(&path)).await?;
            *looked = Some(Instant::now());
        }
        Ok(path)
    }

    /// Returns the finished log.
    pub(super) async fn whole(
        &self,
        bucket: &Bucket,
        id: Uuid,
        sum: &LogSum,
    ) -> Result<PathBuf, Refusal> {
        let (held, path) = (self.hold(id), copy_of(&self.folder, id));
        let _held = held.lock().await;
        if path.exists() {
            return Ok(path);
        }
        let part = part_path(&path);
        // The rest is added to the same file; where that held something else, it is begun anew.
        for _ in 0..2 {
            fetch(bucket, id, sum, &part).await?;
            let of_part = part.clone();
            let found = tokio::task::spawn_blocking(move || LogSum::of(&of_part, || false)).await;
            let found = found.map_err(|_| Refusal::Stopping)?.map_err(StoreError::reading_a_log)?;
            if found.as_ref() == Some(sum) {
                fs::rename(&part, &path).map_err(StoreError::reading_a_log)?;
                self.make_room(&path);
                return Ok(path);
            }
            let emptied = fs::File::options().write(true).truncate(true).open(&part);
            emptied.map_err(StoreError::reading_a_log)?;
        }
        tracing::error!(job = %id, "log damaged");
        Err(Refusal::LogDamaged)
    }

    pub(super) async fn forget(&self, id: Uuid) {
        let (held, path) = (self.hold(id), copy_of(&self.folder, id));
        let _held = held.lock().await;
        let _ = fs::remove_file(part_path(&path));
        let _ = fs::remove_file(path);
        lock(&self.held).remove(&id);
    }

    /// Removes the oldest copies but one, until the others fit.
    fn make_room(&self, newest: &Path) {
        let found = fs::read_dir(&self.folder).into_iter().flatten().flatten();
        let mut copies: Vec<_> = found
            .filter_map(|entry| {
                let metadata = entry.metadata().ok()?;
                Some((metadata.modified().ok()?, metadata.len(), entry.path()))
            })
            .collect();
        copies.sort();
        let mut taken: u64 = copies.iter().map(|(_, bytes, _)| bytes).sum();
        for (_, bytes, path) in copies {
            if taken <= self.room_bytes {
                break;
            }
            if path != newest && fs::remove_file(&path).is_ok() {
                taken -= bytes;
            }
        }
    }

    /// Returns the free bytes on their disk; 0 where that is unknown.
    pub(super) fn free_bytes(&self) -> u64 {
        #[cfg(unix)]
        {
            let disk = rustix::fs::statvfs(&self.folder);
            disk.map_or(0, |disk| disk.f_bavail.saturating_mul(disk.f_frsize))
        }
        #[cfg(not(unix))]
        {
            0
        }
    }
}

/// Fetches the missing part of a finished log.
async fn fetch(bucket: &Bucket, id: Uuid, sum: &LogSum, part: &Path) -> Result<(), Refusal> {
    let failed = StoreError::reading_a_log;
    let file = tokio::fs::File::options().create(true).append(true).open(part).await;
    let mut file = file.map_err(failed)?;
    let held = file.metadata().await.map_err(failed)?.len();
    if held < sum.bytes {
        let mut bytes = bucket.log_bytes(id, sum, held..sum.bytes).await?;
        while let Some(piece) = bytes.next().await {
            file.write_all(&piece.map_err(failed)?).await.map_err(failed)?;
        }
    }
    Ok(file.flush().await.map_err(failed)?)
}
