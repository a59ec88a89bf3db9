//! The file of an unfinished log: written, synced behind the writer's back, or compared with what is
//! written anew.
//!
//! Invariant: bytes that were reported durable are on the disk and do not change any more, whatever
//! happens to the process or the machine. A failed sync is never tried again: what it lost is not known.

use std::fs::{File, OpenOptions};
use std::io::{self, BufRead, BufReader, BufWriter, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;

/// Bytes compared at once when a log is resumed.
const COMPARED: usize = 64 << 10;

/// A handle on the file; the container writes through a copy of it.
#[derive(Clone)]
pub(super) struct Part(Arc<Mutex<Inner>>);

struct Inner {
    mode: Mode,
    /// Bytes written so far, compared ones included.
    position: u64,
    /// Whether something was written that the file does not hold.
    differs: bool,
}

enum Mode {
    Writing(BufWriter<File>),
    /// Written bytes must be those that the file holds.
    Comparing(BufReader<File>),
    /// Nothing is written any more.
    Left,
}

impl Part {
    /// Creates an empty file, over any file of that name. Anything that is no file, or a link to
    /// one, is left alone, and so is a file that another process writes.
    pub(super) fn create(path: &Path) -> io::Result<Self> {
        // Emptied once it is locked.
        let file = own(path, OpenOptions::new().write(true).create(true).truncate(false))?;
        file.set_len(0)?;
        Ok(Self::new(Mode::Writing(BufWriter::new(file))))
    }

    /// Opens the file that an interrupted run left; written bytes are compared with it until its
    /// end or [`Part::go_on`].
    pub(super) fn compare(path: &Path) -> io::Result<Self> {
        let file = own(path, OpenOptions::new().read(true).write(true))?;
        let held = BufReader::with_capacity(COMPARED, file);
        Ok(Self::new(Mode::Comparing(held)))
    }

    fn new(mode: Mode) -> Self {
        Self(Arc::new(Mutex::new(Inner { mode, position: 0, differs: false })))
    }

    /// Cuts off what the file holds beyond what was written, and writes from here on.
    pub(super) fn go_on(&self) -> io::Result<()> {
        let mut inner = self.inner();
        inner.write_from_here()?;
        match &mut inner.mode {
            Mode::Writing(buffer) => {
                buffer.flush()?;
                buffer.get_ref().sync_all()
            }
            _ => Err(io::Error::other("the file was left")),
        }
    }

    /// Returns whether something was written that the file does not hold.
    pub(super) fn differs(&self) -> bool {
        self.inner().differs
    }

    /// Leaves the file as it is: what is written from now on goes nowhere.
    pub(super) fn leave(&self) {
        if let Mode::Writing(buffer) = std::mem::replace(&mut self.inner().mode, Mode::Left) {
            // Not flushed: only whole chunks count, and those were.
            drop(buffer.into_parts());
        }
    }

    /// Returns the number of bytes written so far.
    fn position(&self) -> u64 {
        self.inner().position
    }

    /// Brings everything to the disk and returns the file, which is locked until it is dropped.
    pub(super) fn close(&self) -> io::Result<File> {
        match std::mem::replace(&mut self.inner().mode, Mode::Left) {
            Mode::Writing(buffer) => {
                let file = buffer.into_inner().map_err(io::IntoInnerError::into_error)?;
                file.sync_all().map(|()| file)
            }
            _ => Err(io::Error::other("the file was left")),
        }
    }

    fn second_handle(&self) -> io::Result<File> {
        match &self.inner().mode {
            Mode::Writing(buffer) => buffer.get_ref().try_clone(),
            _ => Err(io::Error::other("the file is not being written")),
        }
    }

    fn inner(&self) -> MutexGuard<'_, Inner> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Inner {
    /// Ends the comparison at the place that was reached.
    fn write_from_here(&mut self) -> io::Result<()> {
        let Mode::Comparing(held) = &self.mode else { return Ok(()) };
        let mut file = held.get_ref().try_clone()?;
        file.set_len(self.position)?;
        file.seek(SeekFrom::Start(self.position))?;
        self.mode = Mode::Writing(BufWriter::new(file));
        Ok(())
    }

    /// Compares the beginning of `bytes`; returns how many there were.
    fn compare(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let Mode::Comparing(held) = &mut self.mode else { return Ok(0) };
        let expected = held.fill_buf()?;
        let length = expected.len().min(bytes.len());
        if expected[..length] != bytes[..length] {
            self.differs = true;
            return Err(io::Error::other("the file holds something else"));
        }
        held.consume(length);
        Ok(length)
    }
}

impl Write for Part {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let mut inner = self.inner();
        let compared = inner.compare(bytes)?;
        if compared == 0 && !bytes.is_empty() {
            // The end of what the file holds: a kill may have cut off the index of the last chunk.
            inner.write_from_here()?;
        }
        let written = match &mut inner.mode {
            Mode::Writing(buffer) => buffer.write(bytes)?,
            Mode::Comparing(_) => compared,
            Mode::Left => bytes.len(),
        };
        inner.position += written as u64;
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        match &mut self.inner().mode {
            Mode::Writing(buffer) => buffer.flush(),
            Mode::Comparing(_) | Mode::Left => Ok(()),
        }
    }
}

/// Opens and locks a regular file: through a link in its place the target would be overwritten, and
/// reading from a pipe may never end.
pub(crate) fn own(path: &Path, options: &mut OpenOptions) -> io::Result<File> {
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::custom_flags(
        options,
        (rustix::fs::OFlags::NOFOLLOW | rustix::fs::OFlags::NONBLOCK).bits().cast_signed(),
    );
    let file = options.open(path)?;
    if !file.metadata()?.is_file() {
        return Err(io::Error::other("this is not a regular file"));
    }
    lock(&file, path)?;
    Ok(file)
}

/// Returns what is in the place of an output if no file may replace it: a device, a pipe, a socket, a folder, or a link
/// to one. Replacing `/dev/null` by a file would break the machine.
pub(crate) fn irreplaceable(path: &Path) -> Option<&'static str> {
    // Through a link, because it would be replaced itself. What is not there, or a link to nothing, is in nobody's way.
    let kind = std::fs::metadata(path).ok()?.file_type();
    if kind.is_file() {
        return None;
    }
    if kind.is_dir() {
        return Some("a folder");
    }
    #[cfg(unix)]
    {
        use std::os::unix::fs::FileTypeExt;
        if kind.is_fifo() {
            return Some("a pipe");
        }
        if kind.is_socket() {
            return Some("a socket");
        }
    }
    Some("a device")
}

/// Another process writes the file.
#[derive(Debug, thiserror::Error)]
#[error("another process{} is writing it", holder.map_or_else(String::new, |pid| format!(" ({pid})")))]
pub(super) struct Busy {
    holder: Option<u32>,
}

/// Returns whether the error is that another process writes the file.
pub(crate) fn is_busy(error: &io::Error) -> bool {
    error.get_ref().is_some_and(|inner| inner.is::<Busy>())
}

/// Locks a file for as long as it is open: two writers would not leave a valid log.
#[cfg(unix)]
fn lock(file: &File, path: &Path) -> io::Result<()> {
    use std::fs::TryLockError;
    use std::os::unix::fs::MetadataExt;
    use std::time::{Duration, Instant};
    /// A process that is just being started holds the locks of its parent until it runs its own program.
    const FORKED: Duration = Duration::from_millis(200);
    let busy = |holder| Err(io::Error::new(io::ErrorKind::ResourceBusy, Busy { holder }));
    let place = |found: std::fs::Metadata| (found.dev(), found.ino());
    let begun = Instant::now();
    let mut locked = file.try_lock();
    while matches!(locked, Err(TryLockError::WouldBlock)) && begun.elapsed() < FORKED {
        std::thread::sleep(Duration::from_millis(5));
        locked = file.try_lock();
    }
    match locked {
        // The file was finished since it was opened: by now it has another name.
        Ok(()) if place(file.metadata()?) != place(path.symlink_metadata()?) => busy(None),
        Err(TryLockError::WouldBlock) => busy(holder(file.metadata()?.ino())),
        // The file system has no locks.
        Ok(()) | Err(TryLockError::Error(_)) => Ok(()),
    }
}

#[cfg(not(unix))]
fn lock(_: &File, _: &Path) -> io::Result<()> {
    Ok(())
}

/// Returns the process that has locked a file, where the system tells it: lines of `1: FLOCK
/// ADVISORY WRITE pid major:minor:inode ..`.
#[cfg(unix)]
fn holder(inode: u64) -> Option<u32> {
    let locks = std::fs::read_to_string("/proc/locks").ok()?;
    locks.lines().find_map(|line| {
        let words: Vec<&str> = line.split_whitespace().collect();
        let own = words.get(5)?.rsplit(':').next()?.parse() == Ok(inode);
        if own && words.get(1) == Some(&"FLOCK") { words.get(4)?.parse().ok() } else { None }
    })
}

/// A place in the log: the step of a checkpoint, and the bytes of the file up to its end.
type Place = (u64, u64);

/// Extent to which the file is on the disk.
#[derive(Debug, Default)]
pub(super) struct Durable {
    step: AtomicU64,
    bytes: AtomicU64,
}

impl Durable {
    pub(super) fn step(&self) -> u64 {
        self.step.load(Ordering::Acquire)
    }

    /// Returns the number of bytes of the file that are known to be on the disk.
    pub(super) fn bytes(&self) -> u64 {
        self.bytes.load(Ordering::Acquire)
    }

    fn reach(&self, (step, bytes): Place) {
        // A reader of the step finds at least its bytes.
        self.bytes.store(bytes, Ordering::Release);
        self.step.store(step, Ordering::Release);
    }
}

/// Syncs the file on a thread of its own, so that the integrator need not wait for the disk.
pub(super) struct Syncer {
    part: Part,
    folder: PathBuf,
    durable: Arc<Durable>,
    running: Option<(Sender<Place>, JoinHandle<io::Result<()>>)>,
}

impl Syncer {
    pub(super) fn new(part: Part, path: &Path) -> Self {
        Self { part, folder: folder(path).to_owned(), durable: Arc::default(), running: None }
    }

    /// Brings what is flushed by now, the samples up to `step`, to the disk; soon, and without
    /// waiting.
    ///
    /// # Errors
    /// If an earlier sync failed.
    pub(super) fn request(&mut self, step: u64) -> io::Result<()> {
        let (requests, _) = match &mut self.running {
            Some(running) => running,
            // Only now: most logs end within their first chunk.
            None => {
                let (file, folder) = (self.part.second_handle()?, self.folder.clone());
                let (requests, requested) = channel();
                let durable = self.durable.clone();
                let thread = std::thread::Builder::new()
                    .name("log-sync".to_owned())
                    .spawn(move || sync(&file, &folder, &requested, &durable))?;
                self.running.insert((requests, thread))
            }
        };
        // The thread is gone only if it failed.
        let place = (step, self.part.position());
        if requests.send(place).is_err() { self.settle() } else { Ok(()) }
    }

    /// Takes note that the file is on the disk up to `step`.
    pub(super) fn settled(&self, step: u64) {
        self.durable.reach((step, self.part.position()));
    }

    pub(super) fn durable(&self) -> Arc<Durable> {
        self.durable.clone()
    }

    /// Waits for the requested syncs.
    ///
    /// # Errors
    /// If a sync failed.
    pub(super) fn settle(&mut self) -> io::Result<()> {
        let Some((requests, thread)) = self.running.take() else { return Ok(()) };
        drop(requests);
        thread.join().unwrap_or_else(|_| Err(io::Error::other("the sync panicked")))
    }
}

/// Runs the thread: syncs as often as the disk can, and no more often than requested.
fn sync(
    file: &File,
    folder: &Path,
    requested: &Receiver<Place>,
    durable: &Durable,
) -> io::Result<()> {
    let mut named = false;
    while let Ok(place) = requested.recv() {
        let place = requested.try_iter().last().unwrap_or(place);
        file.sync_data()?;
        if !named {
            // A file is durable with its name.
            sync_folder(folder)?;
            named = true;
        }
        durable.reach(place);
    }
    Ok(())
}

/// Returns the folder in which a file stands.
pub(crate) fn folder(path: &Path) -> &Path {
    match path.parent() {
        Some(folder) if folder != Path::new("") => folder,
        _ => Path::new("."),
    }
}

/// Makes names in a folder durable.
pub(crate) fn sync_folder(folder: &Path) -> io::Result<()> {
    if cfg!(unix) { File::open(folder)?.sync_all() } else { Ok(()) }
}
