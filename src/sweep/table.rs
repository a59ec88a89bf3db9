//! The table of a sweep: one line per member, in order, and the file that holds them until it is
//! finished.
//!
//! Invariant: a finished table holds nothing but a head and its lines; until then, or if it is a
//! part of a whole, it begins with a line that describes it, and each line ends with its checksum. Anything after the last
//! sound line of a member is written anew.

use std::fs::{self, File, OpenOptions};
use std::io::{self, BufRead, BufReader, BufWriter, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use serde_json::{Number, Value};

use super::{Counts, Sweep, SweepError};
use crate::log::part::{folder, irreplaceable, own, sync_folder};
use crate::log::part_path;

/// Beginning of the first line of a part; to most readers of tables a comment.
const MARK: &str = "# vpd sweep ";

/// Head of the last column of a part.
pub(super) const SEAL: &str = ",line_crc32";

/// Returns a line of a part: with its checksum, CRC-32 in eight hexadecimal digits, as the last cell.
fn sealed(line: &str) -> String {
    let line = line.trim_end_matches('\n');
    format!("{line},{:08x}\n", crc32fast::hash(line.as_bytes()))
}

/// Returns a line of a part without its checksum, if that is right.
fn unsealed(line: &[u8]) -> Option<&[u8]> {
    let (line, seal) = line.split_at_checked(line.len().checked_sub(9)?)?;
    let right = format!(",{:08x}", crc32fast::hash(line));
    (seal == right.as_bytes()).then_some(line)
}

/// Description of a part.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Identity {
    /// SHA-256 of the sweep.
    pub(super) sweep: String,
    /// The build that runs it.
    pub(super) build: String,
    /// Members of the whole.
    pub(super) members: u64,
    /// The first member in this part, and the first after its last.
    pub(super) first: u64,
    pub(super) end: u64,
    /// Number of the part, and of all parts.
    pub(super) shard: (u64, u64),
}

impl Identity {
    fn line(&self) -> String {
        let json = serde_json::to_string(self).expect("words and numbers are JSON");
        format!("{MARK}{json}\n")
    }

    fn read(line: &str) -> Option<Self> {
        serde_json::from_slice(line.strip_prefix(MARK)?.as_bytes()).ok()
    }
}

/// Returns a cell of any JSON value.
pub(super) fn cell(value: &Value) -> String {
    match value {
        Value::Number(number) => number.to_string(),
        Value::String(text) if !text.contains(char::is_control) => text.clone(),
        value => value.to_string(),
    }
}

/// Returns a line of cells, its end included.
pub(super) fn line(cells: &[String]) -> String {
    let mut out = csv::Writer::from_writer(Vec::new());
    out.write_record(cells).expect("memory takes what is written");
    let line = out.into_inner().expect("memory takes what is written");
    String::from_utf8(line).expect("cells are text")
}

/// Returns the shortest digits that give the same number back; empty if it is not finite.
pub(super) fn figure(x: Option<f64>) -> String {
    x.and_then(Number::from_f64).map_or_else(String::new, |number| number.to_string())
}

/// Returns the cells of a line.
pub(super) fn cells(line: &str) -> Vec<String> {
    let mut reader = csv::ReaderBuilder::new()
        .has_headers(false)
        .buffer_capacity(line.len())
        .from_reader(line.as_bytes());
    let record = reader.records().next().and_then(Result::ok).unwrap_or_default();
    record.iter().map(str::to_owned).collect()
}

impl Sweep {
    /// Shows each line of a table of this sweep, finished or not, to `visit`: the number of the member, its values and its cells.
    ///
    /// # Errors
    /// If it cannot be read, or is not of this sweep.
    pub(super) fn lines(
        &self,
        table: &Path,
        mut visit: impl FnMut(u64, &[Value], &[String]),
    ) -> Result<(), SweepError> {
        let failed = |source| SweepError::io(table, "read", source);
        let other = || SweepError::NoTable { path: table.to_owned() };
        let mut reader = BufReader::with_capacity(1 << 18, File::open(table).map_err(failed)?);
        let mut head = String::new();
        let mut line = |head: &mut String| {
            head.clear();
            (&mut reader).take(1 << 20).read_line(head).map_err(failed)
        };
        line(&mut head)?;
        let unfinished = head.starts_with('#');
        if unfinished {
            line(&mut head)?;
        }
        let names = head.trim_end();
        let names = if unfinished { names.strip_suffix(SEAL).ok_or_else(other)? } else { names };
        if cells(names) != self.columns {
            return Err(other());
        }
        let mut lines = match unfinished {
            true => Lines::of_part(reader, self.columns.len(), 0),
            false => Lines::new(reader, self.columns.len(), 0),
        };
        let mut member = 0;
        while member < self.members
            && let Some((_, cells)) = lines.read().map_err(failed)?
        {
            let values = self.values(member);
            if values.iter().map(cell).ne(cells[1..=values.len()].iter().cloned()) {
                return Err(other());
            }
            visit(member, &values, &cells);
            member += 1;
        }
        Ok(())
    }
}

/// Reads lines of members, in order from `next` on, each with as many cells as the head.
pub(super) struct Lines<R> {
    reader: R,
    columns: usize,
    next: u64,
    /// Whether each line ends with its checksum.
    sealed: bool,
    /// Bytes of the last line in the file, its end included.
    length: u64,
    line: Vec<u8>,
}

impl<R: BufRead> Lines<R> {
    /// Reads a finished table.
    pub(super) fn new(reader: R, columns: usize, next: u64) -> Self {
        Self { reader, columns, next, sealed: false, length: 0, line: Vec::new() }
    }

    /// Reads a part; the checksum is no column of it.
    pub(super) fn of_part(reader: R, columns: usize, next: u64) -> Self {
        Self { sealed: true, ..Self::new(reader, columns, next) }
    }

    /// Returns whether the line at which [`Lines::read`] ended is a whole one that is wrong.
    fn met_damage(&self) -> bool {
        self.line.ends_with(b"\n")
    }

    /// Returns the next line, its end included and its checksum not, and its cells; `None` where there is no sound line
    /// of the next member.
    pub(super) fn read(&mut self) -> io::Result<Option<(&[u8], Vec<String>)>> {
        self.line.clear();
        self.length = self.reader.read_until(b'\n', &mut self.line)? as u64;
        let Some(mut text) = self.line.strip_suffix(b"\n") else { return Ok(None) };
        if self.sealed {
            let Some(line) = unsealed(text) else { return Ok(None) };
            text = line;
        }
        let length = text.len();
        let Ok(text) = std::str::from_utf8(text) else { return Ok(None) };
        let cells = cells(text);
        if cells.len() != self.columns || cells.first() != Some(&self.next.to_string()) {
            return Ok(None);
        }
        self.next += 1;
        self.line.truncate(length);
        self.line.push(b'\n');
        Ok(Some((&self.line, cells)))
    }
}

/// The file of a table that is being made, locked for as long.
pub(super) struct Part {
    path: PathBuf,
    part: PathBuf,
    file: File,
    /// The first member that is not there yet.
    pub(super) next: u64,
    /// Outcomes of the members before it.
    pub(super) counts: Counts,
    /// The member whose line was found damaged; it and those after it are run again.
    pub(super) damaged: Option<u64>,
    first: u64,
    end: u64,
    head: String,
    /// Bytes of the first line, which a finished whole leaves out.
    mark: u64,
}

impl Part {
    /// Begins the file of a table, or resumes that of an interrupted sweep.
    pub(super) fn open(
        path: &Path,
        identity: &Identity,
        head: &str,
        replaces: bool,
    ) -> Result<Self, SweepError> {
        may_write(path)?;
        if !replaces && path.symlink_metadata().is_ok() {
            return Err(SweepError::Exists { path: path.to_owned(), finished: true });
        }
        let part = part_path(path);
        let failed = |source| SweepError::io(&part, "open", source);
        let mut options = OpenOptions::new();
        let mut file = own(&part, options.read(true).write(true).create(true).truncate(false))
            .map_err(failed)?;
        let mark = identity.line();
        let begin = format!("{mark}{head}{SEAL}\n");
        let mut found = Vec::new();
        (&mut file).take(begin.len() as u64).read_to_end(&mut found).map_err(failed)?;
        let same = found == begin.as_bytes();
        // A beginning that was cut off may be replaced.
        if !same && !replaces && !begin.as_bytes().starts_with(&found) {
            return Err(SweepError::Exists { path: part, finished: false });
        }
        let mut table = Self {
            path: path.to_owned(),
            part: part.clone(),
            file,
            next: identity.first,
            counts: Counts::default(),
            damaged: None,
            first: identity.first,
            end: identity.end,
            head: head.to_owned(),
            mark: mark.len() as u64,
        };
        if same {
            table.take_up(begin.len() as u64).map_err(failed)?;
        } else {
            table.file.set_len(0).map_err(failed)?;
            table.file.rewind().map_err(failed)?;
            table.write(&begin)?;
        }
        Ok(table)
    }

    /// Counts the lines that are there, and leaves out anything after the last sound one.
    fn take_up(&mut self, begin: u64) -> io::Result<()> {
        let columns = cells(&self.head);
        let outcome = columns.iter().position(|name| name == "outcome").unwrap_or_default();
        let mut good = begin;
        let mut lines = Lines::of_part(BufReader::new(&self.file), columns.len(), self.next);
        while self.next < self.end {
            let Some((_, cells)) = lines.read()? else {
                self.damaged = lines.met_damage().then_some(self.next);
                break;
            };
            self.counts.add(&cells[outcome]);
            good += lines.length;
            self.next += 1;
        }
        self.file.set_len(good)?;
        self.file.seek(SeekFrom::Start(good)).map(drop)
    }

    /// Adds a line; it goes to the file at once.
    pub(super) fn append(&mut self, line: &str) -> Result<(), SweepError> {
        self.write(&sealed(line))
    }

    fn write(&mut self, text: &str) -> Result<(), SweepError> {
        let failed = |source| SweepError::io(&self.part, "write", source);
        self.file.write_all(text.as_bytes()).map_err(failed)
    }

    /// Brings everything to the disk.
    pub(super) fn sync(&self) -> Result<(), SweepError> {
        self.file.sync_data().map_err(|source| SweepError::io(&self.part, "sync", source))
    }

    /// Gives the table its name; a whole one without its first line and the checksums.
    pub(super) fn finish(mut self, whole: bool) -> Result<(), SweepError> {
        let Self { path, part, file, mark, first, end, head, .. } = &mut self;
        if !whole {
            let named = file.sync_all().and_then(|()| fs::rename(&part, &path));
            let named = named.and_then(|()| sync_folder(folder(path)));
            return named.map_err(|source| SweepError::io(path, "finish", source));
        }
        let begin = *mark + (head.len() + SEAL.len() + 1) as u64;
        let copied = file.seek(SeekFrom::Start(begin)).map(drop);
        let copied = copied.and_then(|()| {
            replace(path, |out| {
                writeln!(out, "{head}")?;
                let mut lines = Lines::of_part(BufReader::new(file), cells(head).len(), *first);
                for _ in *first..*end {
                    let changed = || io::Error::other("its lines changed while it was made");
                    out.write_all(lines.read()?.ok_or_else(changed)?.0)?;
                }
                Ok(())
            })
        });
        let removed = copied.and_then(|()| fs::remove_file(part));
        removed.map_err(|source| SweepError::io(path, "finish", source))
    }
}

/// Refuses a place where something is that no file may replace.
fn may_write(path: &Path) -> Result<(), SweepError> {
    match irreplaceable(path) {
        Some(kind) => Err(SweepError::NoFile { path: path.to_owned(), kind }),
        None => Ok(()),
    }
}

/// Writes a file under another name first, so that whatever is at `path` is whole.
fn replace(
    path: &Path,
    write: impl FnOnce(&mut BufWriter<&File>) -> io::Result<()>,
) -> io::Result<()> {
    let mut builder = tempfile::Builder::new();
    builder.prefix(".vpd-");
    // The usual permissions of a file of this user, as umask leaves them.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    let new = builder.tempfile_in(folder(path))?;
    let mut out = BufWriter::with_capacity(1 << 20, new.as_file());
    write(&mut out)?;
    out.flush()?;
    drop(out);
    new.as_file().sync_all()?;
    new.persist(path).map_err(|error| error.error)?;
    sync_folder(folder(path))
}

/// A part that is to be merged.
struct Found {
    path: PathBuf,
    identity: Identity,
    /// Bytes before its first line.
    begin: u64,
    head: String,
}

impl Found {
    fn open(path: &Path) -> Result<Self, SweepError> {
        let failed = |source| SweepError::io(path, "read", source);
        let mut reader = BufReader::new(File::open(path).map_err(failed)?);
        // The line is no longer than any of ours.
        let mut line = || {
            let mut text = Vec::new();
            (&mut reader).take(1 << 20).read_until(b'\n', &mut text)?;
            Ok(String::from_utf8_lossy(&text).into_owned())
        };
        let (mark, head) = (line().map_err(failed)?, line().map_err(failed)?);
        let identity = mark.ends_with('\n').then(|| Identity::read(&mark)).flatten();
        let identity = identity.filter(|id| id.first <= id.end && id.end <= id.members);
        let begin = (mark.len() + head.len()) as u64;
        let head = head.strip_suffix('\n').and_then(|head| head.strip_suffix(SEAL));
        let (Some(identity), Some(head)) = (identity, head) else {
            return Err(SweepError::NoPart { path: path.to_owned() });
        };
        Ok(Self { path: path.to_owned(), identity, begin, head: head.to_owned() })
    }

    /// Gives each line to `put`; all that should be there are.
    fn lines(
        &self,
        mut put: impl FnMut(&[u8]) -> Result<(), SweepError>,
    ) -> Result<(), SweepError> {
        let failed = |source| SweepError::io(&self.path, "read", source);
        let mut file = File::open(&self.path).map_err(failed)?;
        file.seek(SeekFrom::Start(self.begin)).map_err(failed)?;
        let Identity { first, end, .. } = self.identity;
        let columns = cells(&self.head).len();
        let mut lines = Lines::of_part(BufReader::with_capacity(1 << 18, file), columns, first);
        for member in first..end {
            let Some((line, _)) = lines.read().map_err(failed)? else {
                let (path, missing) = (self.path.clone(), (member, end - 1));
                return Err(SweepError::Unfinished { path, missing });
            };
            put(line)?;
        }
        let rest = lines.reader.fill_buf().map_err(failed)?;
        if rest.is_empty() { Ok(()) } else { Err(SweepError::NoPart { path: self.path.clone() }) }
    }

    /// Checks that all its lines are there.
    fn check(&self) -> Result<(), SweepError> {
        self.lines(|_| Ok(()))
    }
}

/// Returns the outcomes of the members of a part that is finished; `None` if there is no such file,
/// or it is of something else.
pub(super) fn finished(path: &Path, identity: &Identity, head: &str) -> Option<Counts> {
    let found = Found::open(path).ok()?;
    let columns = cells(head);
    let outcome = columns.iter().position(|name| name == "outcome")?;
    if found.identity != *identity || found.head != head {
        return None;
    }
    let mut counts = Counts::default();
    let count = |line: &[u8]| {
        let line = String::from_utf8_lossy(line);
        counts.add(&cells(line.trim_end())[outcome]);
        Ok(())
    };
    found.lines(count).ok().map(|()| counts)
}

/// Merges the parts of a sweep into the table of the whole, as `vpd sweep` writes it in one piece.
/// A part that is given twice, to the byte, counts once. Returns the number of members.
///
/// # Errors
/// If a part is missing, unfinished, of another sweep or of another build, if two overlap, or a file cannot be read or written.
pub fn merge(parts: &[PathBuf], out: &Path, replaces: bool) -> Result<u64, SweepError> {
    may_write(out)?;
    if !replaces && out.symlink_metadata().is_ok() {
        return Err(SweepError::Exists { path: out.to_owned(), finished: true });
    }
    let mut found = parts.iter().map(|path| Found::open(path)).collect::<Result<Vec<_>, _>>()?;
    let Some(first) = found.first() else { return Err(SweepError::NoParts) };
    let (sweep, build) = (first.identity.sweep.clone(), first.identity.build.clone());
    let (members, head, of) = (first.identity.members, first.head.clone(), first.identity.shard.1);
    let by = first.path.clone();
    for part in &found {
        let paths = || (by.clone(), part.path.clone());
        if part.identity.sweep != sweep || part.identity.members != members || part.head != head {
            return Err(SweepError::OtherSweep(Box::new(paths())));
        }
        if part.identity.build != build {
            return Err(SweepError::OtherBuild(Box::new(paths())));
        }
    }
    // Empty parts, of more shards than members, stand nowhere.
    found.retain(|part| part.identity.first < part.identity.end);
    found.sort_by_key(|part| (part.identity.first, part.identity.end));
    let mut next = 0;
    let mut whole: Vec<Found> = Vec::new();
    for part in found {
        let Identity { first, end, .. } = part.identity;
        if let Some(last) = whole.last()
            && first < next
        {
            let same = part.identity == last.identity && same_content(&part.path, &last.path)?;
            if !same {
                return Err(SweepError::Overlap(Box::new((last.path.clone(), part.path))));
            }
            continue;
        }
        if first > next {
            return Err(missing(next, first, members, of));
        }
        next = end;
        whole.push(part);
    }
    if next < members {
        return Err(missing(next, members, members, of));
    }
    // Errors of a part are reported before anything is written.
    for part in &whole {
        part.check()?;
    }
    let unwritten = |source| SweepError::io(out, "write", source);
    let mut broken = None;
    let written = replace(out, |file| {
        writeln!(file, "{head}")?;
        for part in &whole {
            if let Err(error) = part.lines(|line| file.write_all(line).map_err(unwritten)) {
                broken = Some(error);
                return Err(io::Error::other("a part changed"));
            }
        }
        Ok(())
    });
    match (written, broken) {
        (_, Some(error)) => Err(error),
        (written, None) => written.map_err(unwritten).map(|()| members),
    }
}

/// Returns the error that the members from `first` to before `end` are in no part, with the shards
/// of `of` that hold them.
fn missing(first: u64, end: u64, members: u64, of: u64) -> SweepError {
    let shards = (1..=of).filter(|&number| {
        let shard = super::Shard { number, of }.range(members);
        shard.start < end && shard.end > first
    });
    SweepError::Missing { members: (first, end - 1), shards: shards.take(10).collect(), of }
}

fn same_content(a: &Path, b: &Path) -> Result<bool, SweepError> {
    let open = |path: &Path| {
        let file = File::open(path).map_err(|source| SweepError::io(path, "read", source))?;
        Ok::<_, SweepError>(BufReader::new(file))
    };
    let (mut left, mut right) = (open(a)?, open(b)?);
    loop {
        let filled = |reader: &mut BufReader<File>, path: &Path| {
            let bytes = reader.fill_buf().map_err(|source| SweepError::io(path, "read", source))?;
            Ok::<_, SweepError>(bytes.to_vec())
        };
        let (x, y) = (filled(&mut left, a)?, filled(&mut right, b)?);
        let length = x.len().min(y.len());
        if x[..length] != y[..length] || (length == 0 && x.len() != y.len()) {
            return Ok(false);
        }
        if length == 0 {
            return Ok(true);
        }
        left.consume(length);
        right.consume(length);
    }
}
