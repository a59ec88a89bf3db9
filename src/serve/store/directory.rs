//! The data directory in the file system: one service holds it, and its contents may be anything.
//!
//! Invariant: nothing is opened that is not what its name says, nothing is removed but what was
//! thrown away, and nothing is read or written once the name leads to another directory than the one
//! that is locked.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, DirBuilder, File, Metadata, TryLockError};
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use uuid::Uuid;

use super::{KEY, SENT, ServeError, StoreError, parse_id};

/// Time for which a directory may be locked by another process before that is reported.
const LOCK_PATIENCE: Duration = Duration::from_secs(2);

/// The data directory of a service, by its name and by what that name led to when it was locked.
#[derive(Clone, Debug)]
pub(in crate::serve) struct DataDirectory {
    path: PathBuf,
    place: Option<(u64, u64)>,
}

/// The name of the data directory leads elsewhere by now, or nowhere.
#[derive(Debug, thiserror::Error)]
#[error("the data directory {} was moved or replaced", .0.display())]
pub(in crate::serve) struct Moved(PathBuf);

impl DataDirectory {
    /// Returns its name, without links.
    pub(in crate::serve) fn path(&self) -> &Path {
        &self.path
    }

    /// Checks that the name still leads to the directory that is locked: whoever holds another one
    /// of this name would find our files among theirs.
    pub(in crate::serve) fn check(&self) -> Result<(), StoreError> {
        let moved = || StoreError::new("reach its data directory")(Moved(self.path.clone()));
        let found = fs::metadata(&self.path).map_err(|_| moved())?;
        if self.place == place(&found) { Ok(()) } else { Err(moved()) }
    }
}

/// Returns the numbers of a file by which it can be told from every other one, if there are any.
fn place(found: &Metadata) -> Option<(u64, u64)> {
    #[cfg(unix)]
    {
        use std::os::unix::fs::MetadataExt;
        Some((found.dev(), found.ino()))
    }
    #[cfg(not(unix))]
    {
        let _ = found;
        None
    }
}

/// Lock on the data directory, ours while this lives: two services on one record would run each
/// other's jobs.
#[derive(Debug)]
pub(in crate::serve) struct DataLock {
    _file: File,
    directory: DataDirectory,
}

impl DataLock {
    /// Returns the directory that is locked.
    pub(in crate::serve) fn directory(&self) -> &DataDirectory {
        &self.directory
    }

    /// Makes the directory if need be, readable by its owner alone, and locks it.
    pub(in crate::serve) fn take(data: &Path) -> Result<Self, ServeError> {
        let failed = |source| ServeError::Data { path: data.into(), source };
        if !data.exists() {
            make_directory(data).map_err(failed)?;
        }
        let file = open_directory(data).map_err(failed)?;
        let path = data.canonicalize().map_err(failed)?;
        let directory = match cfg!(unix) {
            true => DataDirectory { path, place: place(&file.metadata().map_err(failed)?) },
            false => DataDirectory { path, place: None },
        };
        let begun = Instant::now();
        loop {
            match file.try_lock() {
                Ok(()) => return Ok(Self { _file: file, directory }),
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

/// Opens what is locked: the directory itself where possible, for a file in it could be removed, and
/// a second one locked. What is no directory is not waited for.
fn open_directory(data: &Path) -> io::Result<File> {
    let mut options = File::options();
    #[cfg(unix)]
    {
        use rustix::fs::OFlags;
        let flags = (OFlags::DIRECTORY | OFlags::NONBLOCK).bits().cast_signed();
        std::os::unix::fs::OpenOptionsExt::custom_flags(&mut options, flags);
        options.read(true).open(data)
    }
    #[cfg(not(unix))]
    {
        options.create(true).truncate(false).write(true).open(data.join("lock"))
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
    aside.push(format!(".set-aside-{}", Uuid::new_v4()));
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
