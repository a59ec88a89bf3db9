//! Reads a log: a finished one, one that is being written, what a crash or a bad disk left of it, or what another
//! program made of it.
//!
//! Invariant: whatever the bytes are, reading ends without a panic and within the memory of [`MAX_CHUNK_BYTES`] a piece
//! ([`FOREIGN_CHUNK_BYTES`] of another program); what a checksum covers is handed out only after it agreed, and what none
//! covers, which only other programs write, is reported; and so is every file that is not a finished log.

use std::collections::{BTreeMap, HashMap};
use std::fs::File;
use std::io::{self, BufReader, Read, Seek};
use std::ops::ControlFlow;
use std::path::Path;

use mcap::records::{MessageHeader, Record, op};
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::{McapError, parse_record};

pub use super::messages::Message;
use super::{
    CHECKPOINT_OPCODE, JOB_RECORD, LIBRARY_NAME, LogError, MAX_CHUNK_BYTES, OUTCOME_RECORD,
};

/// Bytes asked of the file at once: a damaged length must not become an allocation.
const READ_AT_ONCE: usize = 64 << 10;

/// The most bytes of a record that another program wrote: some put a whole log into one chunk.
pub const FOREIGN_CHUNK_BYTES: u64 = 256 << 20;

/// A part of a log, in the order of the file.
#[derive(Debug)]
pub enum Item<'a> {
    /// A metadata record.
    Metadata {
        /// Its name.
        name: &'a str,
        /// Its entries.
        entries: &'a BTreeMap<String, String>,
    },
    /// An attached file.
    Attachment {
        /// Its name.
        name: &'a str,
        /// Its bytes.
        data: &'a [u8],
    },
    /// A message of any topic.
    Message {
        /// The topic.
        topic: &'a str,
        /// Name of the message type.
        schema: &'a str,
        /// Log time, in nanoseconds since 1970.
        time_ns: u64,
        /// Number of the sample it belongs to.
        sequence: u32,
        /// The encoded message.
        data: &'a [u8],
    },
    /// Where an interrupted run goes on: the end of a chunk.
    Checkpoint {
        /// The encoded [`super::messages::Checkpoint`].
        data: &'a [u8],
    },
}

/// State of the end of a log.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Ending {
    /// Whether the log is finished: whole to the last byte, every checksum right, the outcome last.
    pub finished: bool,
    /// Reason why it is not, for a person. `None` also if the visitor stopped the reading.
    pub damage: Option<String>,
    /// What no checksum covers, for a person: only logs that another program wrote anew have such parts.
    pub unchecked: Option<String>,
    /// Chunks seen.
    pub chunks: u64,
    /// Bytes of the file.
    pub bytes: u64,
}

/// Visitor that is shown the parts of a log.
type Visit<'a> = dyn FnMut(Item<'_>) -> ControlFlow<()> + 'a;

/// Returns whether a file begins as an MCAP log does, finished or not.
///
/// # Errors
/// If it cannot be opened or read.
pub fn is_log(path: &Path) -> Result<bool, LogError> {
    let failed = |source| LogError::io(path, "read", source);
    let mut magic = Vec::new();
    let file = File::open(path).map_err(failed)?;
    file.take(mcap::MAGIC.len() as u64).read_to_end(&mut magic).map_err(failed)?;
    Ok(magic == mcap::MAGIC)
}

/// Reads `path` and shows its parts to `visit`, until that breaks off.
///
/// Damage is no error: it ends the reading and is reported in the [`Ending`]. Everything shown
/// before it is sound.
///
/// # Errors
/// If the file cannot be opened or read; [`LogError::Foreign`] if another program wrote it to its end and nothing in it is of
/// a log of ours, unless `visit` broke off.
pub fn read(
    path: &Path,
    mut visit: impl FnMut(Item<'_>) -> ControlFlow<()>,
) -> Result<Ending, LogError> {
    read_for(path, &mut visit)
}

/// Does the same, compiled once for all visitors.
fn read_for(path: &Path, visit: &mut Visit<'_>) -> Result<Ending, LogError> {
    let failed = |source| LogError::io(path, "read", source);
    let mut file = File::open(path).map_err(failed)?;
    let bytes = file.metadata().map_err(failed)?.len();
    let foreign = is_foreign(&mut file);
    let cover = if foreign { Cover::of(&mut file).map_err(failed)? } else { Cover::default() };
    file.rewind().map_err(failed)?;
    let mut file = BufReader::with_capacity(READ_AT_ONCE, file);

    let mut walk = Walk { foreign, cover, ..Walk::default() };
    let ControlFlow::Continue(damage) = walk.over(&mut file, visit).map_err(failed)? else {
        return Ok(Ending { chunks: walk.chunks, bytes, ..Ending::default() });
    };
    // What another program wrote is not a damaged log of ours. Of a damaged file, what shows whose it is may stand behind the damage.
    if let Some(library) = walk.library.as_ref().filter(|_| !walk.ours && walk.data_ended) {
        return Err(LogError::Foreign { path: path.to_owned(), library: library.clone() });
    }
    let unchecked = walk.unchecked();
    Ok(Ending { finished: damage.is_none(), damage, unchecked, chunks: walk.chunks, bytes })
}

fn options(foreign: bool) -> LinearReaderOptions {
    LinearReaderOptions::default()
        .with_check_finishes_after_end_magic(true)
        .with_emit_chunks(true)
        .with_validate_data_section_crc(true)
        .with_record_length_limit(record_limit(foreign))
}

/// The most bytes of a record. Not the length of the file: a chunk of a body at rest is longer than
/// its file, and the length of a big file is no bound at all.
fn record_limit(foreign: bool) -> usize {
    if foreign { FOREIGN_CHUNK_BYTES as usize } else { MAX_CHUNK_BYTES as usize }
}

/// Returns whether another program wrote the file, by its header; not if it has none. Every program names itself there, so
/// a log that went through one is known by it.
pub(super) fn is_foreign(file: &mut File) -> bool {
    const LONGEST: u64 = 64 << 10;
    let mut library = || {
        file.rewind().ok()?;
        let mut start = [0; mcap::MAGIC.len() + 1 + 8];
        file.read_exact(&mut start).ok()?;
        let (magic, [opcode, length @ ..]) = start.split_first_chunk::<{ mcap::MAGIC.len() }>()?
        else {
            return None;
        };
        let length = u64::from_le_bytes(length.try_into().ok()?);
        if magic != mcap::MAGIC || *opcode != op::HEADER || length > LONGEST {
            return None;
        }
        let mut header = vec![0; length as usize];
        file.read_exact(&mut header).ok()?;
        match parse(op::HEADER, &header).ok()? {
            Record::Header(header) => Some(header.library),
            _ => None,
        }
    };
    library().is_some_and(|library| !library.starts_with(LIBRARY_NAME))
}

/// Parses a record. (`mcap` 0.26 panics at an attachment that ends within its own head.)
pub(super) fn parse(opcode: u8, data: &[u8]) -> Result<Record<'_>, McapError> {
    if opcode == op::ATTACHMENT {
        // Two times, two texts, the length of the data, and the checksum behind it.
        let text = |at: usize| {
            let length = data.get(at..at.checked_add(4)?)?.try_into().ok()?;
            at.checked_add(4)?.checked_add(u32::from_le_bytes(length) as usize)
        };
        let head = text(16).and_then(text).and_then(|at| at.checked_add(8 + 4));
        if head.is_none_or(|head| head > data.len()) {
            return Err(McapError::UnexpectedEof);
        }
    }
    parse_record(opcode, data)
}

/// What the checksum of the data section says of a log that another program wrote.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Cover {
    /// It agrees.
    Agrees,
    /// It does not agree.
    Differs,
    /// There is none, or the data has no end.
    #[default]
    None,
}

impl Cover {
    fn of(file: &mut File) -> io::Result<Self> {
        file.rewind()?;
        let mut file = BufReader::with_capacity(READ_AT_ONCE, file);
        let mut reader = LinearReader::new_with_options(options(true));
        loop {
            match reader.next_event() {
                Some(Ok(LinearReadEvent::ReadRequest(wanted))) => {
                    let got = file.read(reader.insert(wanted.clamp(1, READ_AT_ONCE)))?;
                    reader.notify_read(got);
                }
                Some(Ok(LinearReadEvent::Record { opcode: op::DATA_END, data })) => {
                    return Ok(if data == [0; 4] { Self::None } else { Self::Agrees });
                }
                Some(Ok(LinearReadEvent::Record { .. })) => {}
                Some(Err(McapError::BadDataCrc { .. })) => return Ok(Self::Differs),
                Some(Err(_)) | None => return Ok(Self::None),
            }
        }
    }
}

/// Reads the samples of `path`: every message of `/state`, `/energy`, `/orthogonality`, `/momentum`, `/solver`
/// and `/pace` goes to `visit` with its log time.
///
/// # Errors
/// If the file cannot be opened or read.
pub fn read_samples(path: &Path, mut visit: impl FnMut(u64, Message)) -> Result<Ending, LogError> {
    read(path, |item| {
        if let Item::Message { topic, schema, time_ns, data, .. } = item
            && let Some(message) = Message::decode(topic, schema, data)
        {
            visit(time_ns, message);
        }
        ControlFlow::Continue(())
    })
}

/// Chunks that an index points to, one after another.
pub(super) struct Chunks(Walk);

impl Chunks {
    /// Knows the topics of the channels, which only the first chunk with one names.
    pub(super) fn of(topics: impl Iterator<Item = (u16, String)>) -> Self {
        let topics = topics.map(|(id, topic)| (id, (topic, String::new()))).collect();
        Self(Walk { topics, ..Walk::default() })
    }

    /// Shows what is in a chunk, given as its record without opcode and length, until `visit` breaks off.
    ///
    /// # Errors
    /// Its damage in words: then nothing of it was shown.
    pub(super) fn read(
        &mut self,
        chunk: &[u8],
        visit: &mut Visit<'_>,
    ) -> Result<ControlFlow<()>, String> {
        match parse(op::CHUNK, chunk).map_err(damaged)? {
            Record::Chunk { header, .. } if header.uncompressed_crc != 0 => {}
            _ => return Err(damaged("a chunk without a checksum")),
        }
        self.0.chunk(chunk, visit)
    }
}

/// State of the log so far. Its errors are damage, in words.
#[derive(Default)]
struct Walk {
    schemas: HashMap<u16, String>,
    /// Topic and schema name.
    topics: HashMap<u16, (String, String)>,
    chunks: u64,
    /// Library that wrote the file, by its own word.
    library: Option<String>,
    /// Whether anything shows that it is a log of ours, which other tools may have written anew.
    ours: bool,
    data_ended: bool,
    /// Whether the outcome was seen; in a log of ours, whether it is the last record of the data.
    outcome: bool,
    /// Whether another program wrote the file: it may put records anywhere, and leave checksums out.
    foreign: bool,
    cover: Cover,
    /// Records outside chunks that no checksum covers.
    unchecked_records: u64,
    /// Chunks that no checksum covers.
    unchecked_chunks: u64,
}

impl Walk {
    /// Walks over a file from its beginning; returns its damage, unless `visit` breaks off.
    fn over(
        &mut self,
        file: &mut impl Read,
        visit: &mut Visit<'_>,
    ) -> io::Result<ControlFlow<(), Option<String>>> {
        let options = options(self.foreign).with_validate_summary_section_crc(true);
        let mut reader = LinearReader::new_with_options(options);
        let damage = loop {
            match reader.next_event() {
                None => break self.missing(),
                Some(Ok(LinearReadEvent::ReadRequest(wanted))) => {
                    let space = reader.insert(wanted.clamp(1, READ_AT_ONCE));
                    let got = file.read(space)?;
                    reader.notify_read(got);
                }
                Some(Ok(LinearReadEvent::Record { opcode, data })) => {
                    match self.step(opcode, data, visit) {
                        Ok(ControlFlow::Continue(())) => {}
                        Ok(ControlFlow::Break(())) => return Ok(ControlFlow::Break(())),
                        Err(damage) => break Some(damage),
                    }
                }
                Some(Err(McapError::UnexpectedEof)) => break Some(self.cut()),
                Some(Err(error)) => break Some(damaged(error)),
            }
        };
        Ok(ControlFlow::Continue(damage))
    }

    /// Takes one record of the file.
    fn step(
        &mut self,
        opcode: u8,
        data: &[u8],
        visit: &mut Visit<'_>,
    ) -> Result<ControlFlow<()>, String> {
        let record = parse(opcode, data).map_err(damaged)?;
        if self.data_ended {
            // The summary repeats what was read. Its checksum does not cover the length of the
            // footer.
            return match opcode {
                op::FOOTER if data.len() != 20 => Err(damaged("bad footer")),
                _ => Ok(ControlFlow::Continue(())),
            };
        }
        if opcode != op::DATA_END && !self.foreign {
            self.outcome = false;
        }
        match record {
            Record::Chunk { header, .. } => {
                if header.uncompressed_crc == 0 {
                    self.unchecked_chunks += self.without_checksum("a chunk without a checksum")?;
                }
                self.chunks += 1;
                return self.chunk(data, visit);
            }
            Record::Header(header) => {
                self.ours |= header.library.starts_with(LIBRARY_NAME);
                self.library = Some(header.library);
            }
            Record::Metadata(metadata) => {
                self.ours |= metadata.name == JOB_RECORD;
                self.outcome |= metadata.name == OUTCOME_RECORD;
                return Ok(visit(Item::Metadata {
                    name: &metadata.name,
                    entries: &metadata.metadata,
                }));
            }
            Record::Attachment { header, data, .. } => {
                return Ok(visit(Item::Attachment { name: &header.name, data: &data }));
            }
            Record::DataEnd(_) => {
                if data.len() != 4 {
                    return Err(damaged("bad end of data"));
                }
                self.data_ended = true;
            }
            Record::Schema { .. } | Record::Channel(_) | Record::Message { .. } => {
                if let Record::Schema { header, .. } = &record {
                    self.ours |= is_own(&header.name);
                }
                self.unchecked_records += self.without_checksum(OUTSIDE)?;
                return self.entry(record, visit);
            }
            _ => {}
        }
        Ok(ControlFlow::Continue(()))
    }

    /// Takes note of a part that has no checksum of its own: one flipped bit makes an index a message. Returns 1 if nothing
    /// else covers it.
    ///
    /// # Errors
    /// If our writer does not write such a part, or the checksum of the data differs.
    fn without_checksum(&self, what: &str) -> Result<u64, String> {
        match self.cover {
            _ if !self.foreign => Err(damaged(what)),
            Cover::Differs => Err(damaged("the checksum of its data does not agree")),
            cover => Ok(u64::from(cover == Cover::None)),
        }
    }

    /// Returns what no checksum covers.
    fn unchecked(&self) -> Option<String> {
        let counts = [(self.unchecked_chunks, "chunk"), (self.unchecked_records, "record")];
        let some = counts.into_iter().filter(|(count, _)| *count > 0);
        let words = some
            .map(|(count, what)| format!("{count} {what}{}", if count == 1 { "" } else { "s" }));
        let words: Vec<String> = words.collect();
        (!words.is_empty()).then(|| format!("no checksum covers {}", words.join(" and ")))
    }

    /// Takes a chunk apart, after its checksum agreed.
    fn chunk(&mut self, chunk: &[u8], visit: &mut Visit<'_>) -> Result<ControlFlow<()>, String> {
        let options = LinearReaderOptions::default()
            .with_skip_start_magic(true)
            .with_skip_end_magic(true)
            .with_prevalidate_chunk_crcs(true)
            .with_record_length_limit(record_limit(self.foreign));
        let mut reader = LinearReader::new_with_options(options);
        // The record as it stood in the file: opcode, length, body.
        let head = std::iter::once(op::CHUNK).chain((chunk.len() as u64).to_le_bytes());
        let head: Vec<u8> = head.collect();
        let mut rest = head.as_slice().chain(chunk);
        while let Some(event) = reader.next_event() {
            match event.map_err(damaged)? {
                LinearReadEvent::ReadRequest(wanted) => {
                    let space = reader.insert(wanted.clamp(1, READ_AT_ONCE));
                    let got = rest.read(space).map_err(damaged)?;
                    reader.notify_read(got);
                }
                LinearReadEvent::Record { opcode, data } => {
                    let record = parse(opcode, data).map_err(damaged)?;
                    if self.entry(record, visit)?.is_break() {
                        return Ok(ControlFlow::Break(()));
                    }
                }
            }
        }
        Ok(ControlFlow::Continue(()))
    }

    /// Takes one record of a chunk.
    fn entry(
        &mut self,
        record: Record<'_>,
        visit: &mut Visit<'_>,
    ) -> Result<ControlFlow<()>, String> {
        match record {
            Record::Schema { header, .. } => {
                self.ours |= is_own(&header.name);
                self.schemas.insert(header.id, header.name);
            }
            Record::Channel(channel) => {
                let schema = self.schemas.get(&channel.schema_id).cloned().unwrap_or_default();
                self.topics.insert(channel.id, (channel.topic, schema));
            }
            Record::Message { header, data } => {
                let Some((topic, schema)) = self.topics.get(&header.channel_id) else {
                    return Err(damaged("a message of an unknown channel"));
                };
                let MessageHeader { log_time: time_ns, sequence, .. } = header;
                return Ok(visit(Item::Message { topic, schema, time_ns, sequence, data: &data }));
            }
            Record::Unknown { opcode: CHECKPOINT_OPCODE, data } => {
                return Ok(visit(Item::Checkpoint { data: &data }));
            }
            _ => {}
        }
        Ok(ControlFlow::Continue(()))
    }

    /// Returns what is missing in a file that was read to its end.
    fn missing(&self) -> Option<String> {
        if !self.data_ended {
            Some(damaged("its data has no end record"))
        } else if !self.outcome {
            Some("the log does not say how the job ended".to_owned())
        } else {
            None
        }
    }

    fn cut(&self) -> String {
        match (self.data_ended, self.outcome) {
            (true, _) => "the log breaks off within its index".to_owned(),
            (false, true) => "the log breaks off after the outcome, before its index".to_owned(),
            (false, false) => {
                "the log breaks off: the job still runs, or was interrupted".to_owned()
            }
        }
    }
}

/// What our writer does not write.
const OUTSIDE: &str = "a schema, a channel or a message outside a chunk";

/// Returns whether a message type is one of ours.
fn is_own(schema: &str) -> bool {
    schema.starts_with("vpd.")
}

fn damaged(what: impl std::fmt::Display) -> String {
    format!("the log is damaged: {what}")
}
