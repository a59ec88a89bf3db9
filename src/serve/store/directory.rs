//! The data directory in the file system: one service holds it, and its contents may be anything.
//!
//! Invariant: nothing is opened that is not what its name says, and nothing is removed but what was
//! thrown away.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, DirBuilder, File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use uuid::Uuid;

use super::{KEY, SENT, ServeError, parse_id};

/// Time for which a directory may be locked by another process before that is reported.
const LOCK_PATIENCE: Duration = Duration::from_secs(2);

/// Lock on the data directory, ours while this lives: two services on one record would run each
/// other's jobs.
#[derive(Debug)]
pub(in crate::serve) struct DataLock {
    _file: File,
}

impl DataLock {
    /// Makes the directory if need be, readable by its owner alone, and locks it.
    pub(in crate::serve) fn take(data: &Path) -> Result<Self, ServeError> {
        let failed = |source| ServeError::Data { path: data.into(), source };
        if !data.exists() {
            make_directory(data).map_err(failed)?;
        }
        // The directory itself is locked where possible: a file in it could be removed, and a
        // second one locked.
        let file = if cfg!(unix) {
            File::open(data)
        } else {
            File::options().create(true).truncate(false).write(true).open(data.join("lock"))
        };
        let file = file.map_err(failed)?;
        let begun = Instant::now();
        loop {
            match file.try_lock() {
                Ok(()) => return Ok(Self { _file: file }),
                // A child that a killed service was just starting holds its locks until it runs its
                // own program.
                Err(TryLockError::WouldBlock) if begun.elapsed() < LOCK_PATIENCE => {
                    std::thread::sleep(Duration::from_millis(20));
                }
                Err(TryLockError::WouldBlock) => {
                    return Err(ServeError::DataInUse { path: data.into() });
                }
                Err(TryLockError::Error(source)) => return Err(failed(source)),
            }
        }
    }
}

/// Returns a directory of ours, made if need be; anything else of its name is renamed and set
/// aside.
pub(in crate::serve) fn own_directory(data: &Path, name: &str) -> Result<PathBuf, ServeError> {
    let path = data.join(name);
    let failed = |source: io::Error| ServeError::Data { path: path.clone(), source };
    if !path.is_dir() {
        put_aside(&path).map_err(failed)?;
        make_directory(&path).map_err(failed)?;
    }
    Ok(path)
}

/// Renames what is in the place of a file or a directory of ours.
pub(in crate::serve) fn put_aside(path: &Path) -> io::Result<()> {
    if path.symlink_metadata().is_err() {
        return Ok(());
    }
    let mut aside = path.as_os_str().to_owned();
    aside.push(format!(".set-aside-{}", Uuid::now_v7()));
    tracing::warn!(from = %path.display(), to = %Path::new(&aside).display(), "set aside: not made by this service");
    fs::rename(path, aside)
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

/// Entries below a directory of jobs or studies under one id.
#[derive(Debug, Default)]
pub(in crate::serve) struct Prefix {
    pub(in crate::serve) files: BTreeSet<String>,
    /// Entries that are no files: directories, links, pipes.
    pub(in crate::serve) odd: BTreeSet<String>,
}

impl Prefix {
    pub(in crate::serve) fn stands(&self, name: &str) -> bool {
        self.files.contains(name) || self.odd.contains(name)
    }

    /// Returns whether these are the remains of a request that was never answered: a key, the text
    /// sent, or texts on their way.
    pub(in crate::serve) fn is_unanswered(&self) -> bool {
        let passing = |name: &String| name.starts_with(KEY) || name == SENT || name.contains('#');
        self.odd.is_empty() && self.files.iter().all(passing)
    }
}

/// Returns the prefixes below a directory by their ids, and how many entries are not ours: these
/// are reported.
pub(in crate::serve) fn prefixes(directory: &Path) -> io::Result<(BTreeMap<Uuid, Prefix>, usize)> {
    let (mut found, mut aside) = (BTreeMap::new(), 0);
    let mut reported = |path: &Path, why: &dyn std::fmt::Display| {
        aside += 1;
        tracing::error!(path = %path.display(), why = %why, "set aside: nothing of it is read or removed");
    };
    for entry in fs::read_dir(directory)? {
        let entry = match entry {
            Ok(entry) => entry,
            Err(error) => {
                reported(directory, &error);
                continue;
            }
        };
        let (name, path) = (entry.file_name(), entry.path());
        let id = name.to_str().and_then(parse_id);
        match (id, entry.file_type().and_then(|kind| contents(&path, kind.is_dir()))) {
            (Some(id), Ok(prefix)) => {
                found.insert(id, prefix);
            }
            (Some(_), Err(error)) => reported(&path, &error),
            (None, _) => reported(&path, &"its name is no id"),
        }
    }
    Ok((found, aside))
}

fn contents(path: &Path, is_directory: bool) -> io::Result<Prefix> {
    if !is_directory {
        return Err(io::Error::from(io::ErrorKind::NotADirectory));
    }
    let mut prefix = Prefix::default();
    for entry in fs::read_dir(path)? {
        let entry = entry?;
        let names = if entry.file_type()?.is_file() { &mut prefix.files } else { &mut prefix.odd };
        names.insert(entry.file_name().to_string_lossy().into_owned());
    }
    Ok(prefix)
}

/// Takes a directory out of its place at once, and then removes it. Blocking.
pub(in crate::serve) fn throw_away(from: &Path, to: &Path) -> io::Result<()> {
    match fs::rename(from, to) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
        Err(error) => return Err(error),
        Ok(()) => {}
    }
    from.parent().map_or(Ok(()), sync_directory)?;
    if let Err(error) = fs::remove_dir_all(to) {
        tracing::warn!(path = %to.display(), %error, "removed files stay until the next start");
    }
    Ok(())
}

/// Removes what was thrown away before.
pub(in crate::serve) fn empty(trash: &Path) {
    for entry in fs::read_dir(trash).into_iter().flatten().flatten() {
        let is_directory = entry.file_type().is_ok_and(|kind| kind.is_dir());
        let path = entry.path();
        let removed = if is_directory { fs::remove_dir_all(&path) } else { fs::remove_file(&path) };
        if let Err(error) = removed {
            tracing::warn!(path = %path.display(), %error, "removed files stay in the data directory");
        }
    }
}
