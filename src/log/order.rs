//! The messages of a log in the order of time, also where another program has put them in another one: all of a topic
//! together, or a chunk a topic.
//!
//! Invariant: memory is bounded however long the log is. What is to be sorted goes to a temporary file a run of messages in
//! order, and the runs are merged.

use std::collections::{BTreeMap, BinaryHeap};
use std::fs::File;
use std::io::{BufReader, BufWriter, Read, Seek, Write};
use std::ops::ControlFlow;
use std::path::Path;

use super::LogError;
use super::reader::{self, Ending, Item, is_foreign};
use super::schema::Topic;

/// Most runs that are merged: each is an open file.
const MOST_RUNS: usize = 250;

/// Shows the messages of a log of ours in the order of the file, and our messages of one that another program wrote in the
/// order of time; messages of one time in that of their topics.
///
/// # Errors
/// If the file, or a temporary one, cannot be opened, read or written.
pub(crate) fn read_by_time(
    path: &Path,
    visit: impl FnMut(Item<'_>) -> ControlFlow<()>,
) -> Result<Ending, LogError> {
    if is_foreign_log(path)? { read_sorted(path, visit) } else { reader::read(path, visit) }
}

/// Returns whether another program wrote a log.
///
/// # Errors
/// If it cannot be opened.
pub(crate) fn is_foreign_log(path: &Path) -> Result<bool, LogError> {
    let mut file = File::open(path).map_err(|source| LogError::io(path, "read", source))?;
    Ok(is_foreign(&mut file))
}

/// Shows our messages of a log in the order of time; those of one time in the order of their topics, and those of one topic
/// in that of the file.
///
/// # Errors
/// If the file, or a temporary one, cannot be opened, read or written.
pub(crate) fn read_sorted(
    path: &Path,
    mut visit: impl FnMut(Item<'_>) -> ControlFlow<()>,
) -> Result<Ending, LogError> {
    let failed = |source| LogError::io(path, "sort", source);
    // The last run of each topic is at hand; a topic that steps back in time begins another one.
    let (mut runs, mut open) = (Vec::new(), BTreeMap::new());
    let (mut put, mut too_many) = (Ok(()), false);
    let mut ending = reader::read(path, |item| {
        let Item::Message { topic, schema, time_ns, sequence, data } = item else {
            return ControlFlow::Continue(());
        };
        let Some(topic) = Topic::parse(topic) else { return ControlFlow::Continue(()) };
        let run = match open.get(&topic) {
            Some(&(run, last_ns)) if time_ns >= last_ns => run,
            _ => runs.len(),
        };
        open.insert(topic, (run, time_ns));
        if run == runs.len() {
            too_many = run == MOST_RUNS;
            if too_many {
                return ControlFlow::Break(());
            }
            match Run::begin(topic, schema) {
                Ok(begun) => runs.push(begun),
                Err(error) => put = Err(error),
            }
        }
        if put.is_ok() {
            put = runs[run].put(time_ns, sequence, data);
        }
        if put.is_ok() { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
    })?;
    put.map_err(failed)?;
    if too_many {
        ending.damage = Some(format!(
            "its messages are in no order: they step back in time more than {MOST_RUNS} times"
        ));
    }
    let mut sorted = Vec::with_capacity(runs.len());
    for run in runs {
        sorted.push(run.sorted().map_err(failed)?);
    }
    let mut heads = BinaryHeap::new();
    for (k, run) in sorted.iter_mut().enumerate() {
        heads.extend(run.next().map_err(failed)?.then_some(Head(run.time_ns, run.topic, k)));
    }
    while let Some(Head(time_ns, topic, k)) = heads.pop() {
        let run = &mut sorted[k];
        let item = Item::Message {
            topic: &topic.name(),
            schema: &run.schema,
            time_ns,
            sequence: run.sequence,
            data: &run.data,
        };
        if visit(item).is_break() {
            return Ok(Ending { finished: false, damage: None, ..ending });
        }
        heads.extend(run.next().map_err(failed)?.then_some(Head(run.time_ns, topic, k)));
    }
    Ok(ending)
}

/// The next message of a run: its time, its topic, and which run it is. The largest comes first.
#[derive(PartialEq, Eq)]
struct Head(u64, Topic, usize);

impl Ord for Head {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        (other.0, other.1, other.2).cmp(&(self.0, self.1, self.2))
    }
}

impl PartialOrd for Head {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

/// Messages of a topic in the order of time, on their way into a file.
struct Run {
    topic: Topic,
    schema: String,
    file: BufWriter<File>,
}

impl Run {
    fn begin(topic: Topic, schema: &str) -> std::io::Result<Self> {
        let file = BufWriter::new(tempfile::tempfile()?);
        Ok(Self { topic, schema: schema.to_owned(), file })
    }

    fn put(&mut self, time_ns: u64, sequence: u32, data: &[u8]) -> std::io::Result<()> {
        self.file.write_all(&time_ns.to_le_bytes())?;
        self.file.write_all(&sequence.to_le_bytes())?;
        self.file.write_all(&(data.len() as u64).to_le_bytes())?;
        self.file.write_all(data)
    }

    fn sorted(self) -> std::io::Result<Sorted> {
        let mut file = self.file.into_inner().map_err(std::io::IntoInnerError::into_error)?;
        file.rewind()?;
        Ok(Sorted {
            topic: self.topic,
            schema: self.schema,
            file: BufReader::new(file),
            time_ns: 0,
            sequence: 0,
            data: Vec::new(),
        })
    }
}

/// The same on their way out, with the message that comes next.
struct Sorted {
    topic: Topic,
    schema: String,
    file: BufReader<File>,
    time_ns: u64,
    sequence: u32,
    data: Vec<u8>,
}

impl Sorted {
    /// Goes on to the next message; returns whether there is one.
    fn next(&mut self) -> std::io::Result<bool> {
        let mut head = [0; 20];
        if let Err(error) = self.file.read_exact(&mut head) {
            let over = error.kind() == std::io::ErrorKind::UnexpectedEof;
            return if over { Ok(false) } else { Err(error) };
        }
        let (time_ns, rest) = head.split_at(8);
        let (sequence, length) = rest.split_at(4);
        let number =
            |bytes: &[u8]| bytes.iter().rev().fold(0, |sum, &byte| sum << 8 | u64::from(byte));
        self.time_ns = number(time_ns);
        self.sequence = number(sequence) as u32;
        self.data.resize(number(length) as usize, 0);
        self.file.read_exact(&mut self.data)?;
        Ok(true)
    }
}
