//! The end of a finished log: where its messages and attachments stand.
//!
//! Invariant: however long a log is, what is read and kept is bounded by what is asked for. The places of the chunks, of
//! which a long log has tens of thousands, are looked through where they stand. A chunk is shown only after its checksum
//! agreed.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufReader, Read, Seek, SeekFrom};
use std::ops::{ControlFlow, Range};

use mcap::McapError;
use mcap::read::LinearReader;
use mcap::records::{AttachmentIndex, ChunkIndex, Footer, MetadataIndex, Record, Statistics, op};

use super::MAX_CHUNK_BYTES;
use super::reader::{Chunks, Item, is_foreign, parse};

/// Bytes of the opcode and of the length before what a record says.
const HEAD: usize = 1 + 8;

/// Places of the parts of a finished log.
pub(super) struct End {
    /// Log times of the first message and of the last.
    pub(super) span_ns: (u64, u64),
    /// Total number of messages.
    pub(super) messages: u64,
    /// Index of the attachments.
    pub(super) attachments: Vec<AttachmentIndex>,
    metadata: Vec<MetadataIndex>,
    /// Topics of the channels.
    channels: BTreeMap<u16, String>,
    /// Place of the chunk index in the file.
    chunks: Range<u64>,
}

impl End {
    /// Reads the end; `None` if the log has none or a damaged one, like a growing log, whose last
    /// bytes mean nothing, or if another program wrote it: such an index may leave messages out.
    pub(super) fn read(file: &mut File) -> Option<Self> {
        if is_foreign(file) {
            return None;
        }
        let footer_bytes = HEAD + 20;
        let length = file.seek(SeekFrom::End(0)).ok()?;
        let footer_at = length.checked_sub((footer_bytes + mcap::MAGIC.len()) as u64)?;
        let last = bytes_at(file, footer_at..length)?;
        let (footer, magic) = last.split_at(footer_bytes);
        let Ok(Record::Footer(footer)) = parse(footer[0], &footer[HEAD..]) else {
            return None;
        };
        let Footer { summary_offset_start: groups_at, .. } = footer;
        if magic != mcap::MAGIC || groups_at == 0 {
            return None;
        }
        let mut end = Self {
            span_ns: (0, 0),
            messages: 0,
            attachments: Vec::new(),
            metadata: Vec::new(),
            channels: BTreeMap::new(),
            chunks: 0..0,
        };
        let groups = bytes_at(file, groups_at..footer_at)?;
        for group in LinearReader::sans_magic(&groups) {
            let Record::SummaryOffset(group) = group.ok()? else { return None };
            let at = group.group_start..group.group_start.checked_add(group.group_length)?;
            match group.group_opcode {
                op::CHUNK_INDEX => end.chunks = at,
                op::STATISTICS | op::ATTACHMENT_INDEX | op::METADATA_INDEX | op::CHANNEL => {
                    for record in LinearReader::sans_magic(&bytes_at(file, at)?) {
                        end.note(record.ok()?)?;
                    }
                }
                _ => {}
            }
        }
        (end.span_ns.0 <= end.span_ns.1).then_some(end)
    }

    fn note(&mut self, record: Record<'_>) -> Option<()> {
        match record {
            Record::Statistics(Statistics {
                message_start_time: start_ns,
                message_end_time: end_ns,
                message_count,
                ..
            }) => (self.span_ns, self.messages) = ((start_ns, end_ns), message_count),
            Record::AttachmentIndex(index) => self.attachments.push(index),
            Record::MetadataIndex(index) => self.metadata.push(index),
            Record::Channel(channel) => {
                self.channels.insert(channel.id, channel.topic);
            }
            _ => return None,
        }
        Some(())
    }

    /// Returns the entries of a metadata record.
    pub(super) fn metadata(&self, file: &mut File, name: &str) -> Option<BTreeMap<String, String>> {
        let at = self.metadata.iter().find(|index| index.name == name)?;
        let record = bytes_at(file, at.offset..at.offset.checked_add(at.length)?)?;
        match LinearReader::sans_magic(&record).next()?.ok()? {
            Record::Metadata(record) => Some(record.metadata),
            _ => None,
        }
    }

    /// Passes on the messages of the topics that are wanted, with topic and log time, in a stretch of log times, chunk by
    /// chunk, until `visit` has enough.
    pub(super) fn messages(
        &self,
        file: &mut File,
        is_wanted: impl Fn(&str) -> bool,
        stretch: Range<u64>,
        mut visit: impl FnMut(&str, u64, &[u8]) -> ControlFlow<()>,
    ) -> Result<(), McapError> {
        let channels = self.channels.iter();
        let channels = channels.filter(|(_, topic)| is_wanted(topic));
        let channels: Vec<u16> = channels.map(|(&id, _)| id).collect();
        if stretch.is_empty() || channels.is_empty() {
            return Ok(());
        }
        let damaged =
            |what: String| McapError::Io(io::Error::new(io::ErrorKind::InvalidData, what));
        let mut chunks = Chunks::of(self.channels.iter().map(|(&id, topic)| (id, topic.clone())));
        for place in self.chunks_of(file, &channels, &stretch)? {
            let end = place.chunk_start_offset.saturating_add(place.chunk_length);
            let record = bytes_at(file, place.chunk_start_offset..end);
            let chunk = record.as_deref().and_then(|record| record.split_at_checked(HEAD));
            let Some((_, chunk)) = chunk.filter(|(head, _)| head[0] == op::CHUNK) else {
                return Err(damaged("the log is damaged: its index names no chunk".to_owned()));
            };
            let flow = chunks.read(chunk, &mut |item| match item {
                Item::Message { topic, time_ns, data, .. }
                    if is_wanted(topic) && stretch.contains(&time_ns) =>
                {
                    visit(topic, time_ns, data)
                }
                _ => ControlFlow::Continue(()),
            });
            if flow.map_err(damaged)?.is_break() {
                break;
            }
        }
        Ok(())
    }

    /// Returns the places of the chunks with messages of some channels in a stretch, in the order of the file.
    fn chunks_of(
        &self,
        file: &mut File,
        channels: &[u16],
        stretch: &Range<u64>,
    ) -> Result<Vec<ChunkIndex>, McapError> {
        let mut found = Vec::new();
        file.seek(SeekFrom::Start(self.chunks.start))?;
        let places = self.chunks.end.saturating_sub(self.chunks.start);
        let mut places = BufReader::with_capacity(1 << 16, file).take(places);
        let (mut head, mut place) = ([0; HEAD], Vec::new());
        while places.limit() > 0 {
            places.read_exact(&mut head)?;
            let [opcode, length @ ..] = head;
            let length = u64::from_le_bytes(length);
            if length > MAX_CHUNK_BYTES {
                return Err(McapError::RecordTooLarge { opcode, len: length });
            }
            place.resize(length as usize, 0);
            places.read_exact(&mut place)?;
            // Times of its first message and of its last come first.
            let time = |at: usize| {
                let bytes = place.get(at..at + 8).and_then(|bytes| bytes.try_into().ok());
                bytes.map_or(0, u64::from_le_bytes)
            };
            if time(0) < stretch.end
                && time(8) >= stretch.start
                && let Record::ChunkIndex(index) = parse(opcode, &place)?
                && channels.iter().any(|id| index.message_index_offsets.contains_key(id))
            {
                found.push(index);
            }
        }
        Ok(found)
    }
}

/// Returns an attachment, if its checksum agrees.
pub(super) fn attachment(file: &mut File, index: &AttachmentIndex) -> Option<Vec<u8>> {
    let record = bytes_at(file, index.offset..index.offset.checked_add(index.length)?)?;
    let (head, body) = record.split_at_checked(HEAD)?;
    let Ok(Record::Attachment { data, crc, .. }) = parse(op::ATTACHMENT, body) else {
        return None;
    };
    let covered = body.get(..body.len().checked_sub(4)?)?;
    let good = head[0] == op::ATTACHMENT && (crc == 0 || crc32fast::hash(covered) == crc);
    good.then(|| data.into_owned())
}

/// Returns the bytes of a file in a range, unless that is longer than any record of ours.
fn bytes_at(file: &mut File, at: Range<u64>) -> Option<Vec<u8>> {
    let length = at.end.checked_sub(at.start).filter(|&length| length <= MAX_CHUNK_BYTES)?;
    let mut bytes = vec![0; length as usize];
    file.seek(SeekFrom::Start(at.start)).ok()?;
    file.read_exact(&mut bytes).ok()?;
    Some(bytes)
}
