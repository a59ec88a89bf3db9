//! The MCAP file of a log as it grows: whole chunks, metadata and attachments in, bytes out.
//!
//! A [`Chunk`] is put together in memory and goes to the file in one piece. The `mcap` crate, which reads logs, also has a
//! writer; it hands each field of a message to the compressor by itself, which costs more than the compression.
//!
//! Invariant: what stands in the file is whole records at any time, but for the last of them, and the same records give the
//! same bytes. (Format: the MCAP specification, version 0.)

use std::collections::BTreeMap;
use std::io::{self, Write};

use crc32fast::Hasher;
use mcap::records::op;

use super::part::Part;
use super::schema::{Compression, ENCODING};

/// Level of the compression by zstd. On the samples of a run level 1 takes 0.4 of the time of the usual level 3, for 3 % more
/// bytes: `docs/decisions/0015-the-log-is-written-on-a-thread.md`.
const ZSTD_LEVEL: i32 = 1;

/// Puts the parts of a record into bytes.
trait Put {
    fn u16(&mut self, x: u16);
    fn u32(&mut self, x: u32);
    fn u64(&mut self, x: u64);
    fn text(&mut self, text: &str);
    /// A list, with its length in bytes before it.
    fn list(&mut self, body: impl FnOnce(&mut Self));
    /// A record, with its length before it.
    fn record(&mut self, opcode: u8, body: impl FnOnce(&mut Self));
}

impl Put for Vec<u8> {
    fn u16(&mut self, x: u16) {
        self.extend_from_slice(&x.to_le_bytes());
    }

    fn u32(&mut self, x: u32) {
        self.extend_from_slice(&x.to_le_bytes());
    }

    fn u64(&mut self, x: u64) {
        self.extend_from_slice(&x.to_le_bytes());
    }

    fn text(&mut self, text: &str) {
        self.u32(text.len() as u32);
        self.extend_from_slice(text.as_bytes());
    }

    fn list(&mut self, body: impl FnOnce(&mut Self)) {
        let at = self.len();
        self.u32(0);
        body(self);
        let length = (self.len() - at - 4) as u32;
        self[at..at + 4].copy_from_slice(&length.to_le_bytes());
    }

    fn record(&mut self, opcode: u8, body: impl FnOnce(&mut Self)) {
        self.push(opcode);
        let at = self.len();
        self.u64(0);
        body(self);
        let length = (self.len() - at - 8) as u64;
        self[at..at + 8].copy_from_slice(&length.to_le_bytes());
    }
}

fn put_schema(out: &mut Vec<u8>, id: u16, (name, descriptors): &(String, Vec<u8>)) {
    out.record(op::SCHEMA, |out| {
        out.u16(id);
        out.text(name);
        out.text(ENCODING);
        out.u32(descriptors.len() as u32);
        out.extend_from_slice(descriptors);
    });
}

fn put_channel(out: &mut Vec<u8>, id: u16, (schema, topic): &(u16, String)) {
    out.record(op::CHANNEL, |out| {
        out.u16(id);
        out.u16(*schema);
        out.text(topic);
        out.text(ENCODING);
        // It has no metadata.
        out.u32(0);
    });
}

/// Schemas and channels of a log; their ids are their places, from 1.
#[derive(Clone, Debug, Default)]
pub(super) struct Catalog {
    schemas: Vec<(String, Vec<u8>)>,
    /// Id of the schema, and topic.
    channels: Vec<(u16, String)>,
}

/// Records on their way into the file, and where the messages of each channel are among them.
#[derive(Debug, Default)]
pub(super) struct Chunk {
    records: Vec<u8>,
    /// Time and place of each message, by the id of its channel.
    index: Vec<Vec<(u64, u64)>>,
    /// Times of the first message and of the last; `None` without one: such a chunk would start in 1970.
    span_ns: Option<(u64, u64)>,
}

impl Chunk {
    /// Returns whether it holds messages.
    pub(super) fn has_messages(&self) -> bool {
        self.span_ns.is_some()
    }

    /// Adds a channel, and its schema unless there is one of the same content. Returns its id.
    pub(super) fn channel(
        &mut self,
        catalog: &mut Catalog,
        topic: String,
        schema: (&str, &[u8]),
    ) -> u16 {
        let known = |known: &(String, Vec<u8>)| (known.0.as_str(), known.1.as_slice()) == schema;
        let schema = match catalog.schemas.iter().position(known) {
            Some(at) => at as u16 + 1,
            None => {
                catalog.schemas.push((schema.0.to_owned(), schema.1.to_vec()));
                let id = catalog.schemas.len() as u16;
                put_schema(&mut self.records, id, &catalog.schemas[id as usize - 1]);
                id
            }
        };
        catalog.channels.push((schema, topic));
        let id = catalog.channels.len() as u16;
        put_channel(&mut self.records, id, &catalog.channels[id as usize - 1]);
        id
    }

    /// Adds a message that `encode` writes.
    pub(super) fn message(
        &mut self,
        channel: u16,
        sequence: u32,
        time_ns: u64,
        encode: impl FnOnce(&mut Vec<u8>),
    ) {
        let at = self.records.len() as u64;
        let channel_at = usize::from(channel);
        if self.index.len() <= channel_at {
            self.index.resize_with(channel_at + 1, Vec::new);
        }
        self.index[channel_at].push((time_ns, at));
        let (first, last) = self.span_ns.unwrap_or((time_ns, time_ns));
        self.span_ns = Some((first.min(time_ns), last.max(time_ns)));
        self.records.record(op::MESSAGE, |out| {
            let mut head = [0; 2 + 4 + 8 + 8];
            head[..2].copy_from_slice(&channel.to_le_bytes());
            head[2..6].copy_from_slice(&sequence.to_le_bytes());
            head[6..14].copy_from_slice(&time_ns.to_le_bytes());
            head[14..].copy_from_slice(&time_ns.to_le_bytes());
            out.extend_from_slice(&head);
            encode(out);
        });
    }

    /// Adds a record of an opcode of our own.
    pub(super) fn private(&mut self, opcode: u8, data: &[u8]) {
        self.records.record(opcode, |out| out.extend_from_slice(data));
    }

    /// Empties it, and keeps its room.
    pub(super) fn clear(&mut self) {
        self.records.clear();
        self.index.iter_mut().for_each(Vec::clear);
        self.span_ns = None;
    }
}

/// The compression of chunks.
enum Packer {
    Zstd(zstd::bulk::Compressor<'static>),
    Lz4,
    None,
}

impl Packer {
    const fn name(&self) -> &'static str {
        match self {
            Self::Zstd(_) => "zstd",
            Self::Lz4 => "lz4",
            Self::None => "",
        }
    }

    /// Adds the compressed form of `records`.
    fn pack(&mut self, records: &[u8], out: &mut Vec<u8>) -> io::Result<()> {
        match self {
            Self::Zstd(packer) => {
                let at = out.len();
                out.resize(at + zstd::zstd_safe::compress_bound(records.len()), 0);
                let length = packer.compress_to_buffer(records, &mut out[at..])?;
                out.truncate(at + length);
                Ok(())
            }
            Self::Lz4 => {
                // The records have a checksum themselves, and some readers count those of blocks wrongly.
                let mut packer = lz4::EncoderBuilder::new()
                    .level(0)
                    .block_checksum(lz4::liblz4::BlockChecksum::NoBlockChecksum)
                    .build(out)?;
                packer.write_all(records)?;
                packer.finish().1
            }
            Self::None => {
                out.extend_from_slice(records);
                Ok(())
            }
        }
    }
}

/// The file, and what its end will say of it.
pub(super) struct Container {
    file: Part,
    /// Bytes written.
    position: u64,
    /// Checksum of them: of the data section.
    sum: Hasher,
    packer: Packer,
    /// Bytes of a chunk, for the next one to use their room.
    out: Vec<u8>,
    /// Records of the summary, and how many.
    chunks: (Vec<u8>, u32),
    attachments: (Vec<u8>, u32),
    metadata: (Vec<u8>, u32),
    span_ns: Option<(u64, u64)>,
    /// Messages by the id of their channel.
    counts: BTreeMap<u16, u64>,
}

impl Container {
    /// Begins the file.
    pub(super) fn begin(file: Part, library: &str, compression: Compression) -> io::Result<Self> {
        let packer = match compression {
            Compression::Zstd => Packer::Zstd(zstd::bulk::Compressor::new(ZSTD_LEVEL)?),
            Compression::Lz4 => Packer::Lz4,
            Compression::None => Packer::None,
        };
        let mut container = Self {
            file,
            position: 0,
            sum: Hasher::new(),
            packer,
            out: Vec::new(),
            chunks: Default::default(),
            attachments: Default::default(),
            metadata: Default::default(),
            span_ns: None,
            counts: BTreeMap::new(),
        };
        container.put(|out| {
            out.extend_from_slice(mcap::MAGIC);
            out.record(op::HEADER, |out| {
                // It has no profile.
                out.text("");
                out.text(library);
            });
        })?;
        Ok(container)
    }

    /// Writes bytes in one piece.
    fn put(&mut self, body: impl FnOnce(&mut Vec<u8>)) -> io::Result<()> {
        self.out.clear();
        body(&mut self.out);
        self.write_out()
    }

    fn write_out(&mut self) -> io::Result<()> {
        self.file.write_all(&self.out)?;
        self.sum.update(&self.out);
        self.position += self.out.len() as u64;
        Ok(())
    }

    /// Writes a metadata record.
    pub(super) fn metadata(
        &mut self,
        name: &str,
        entries: &BTreeMap<String, String>,
    ) -> io::Result<()> {
        let offset = self.position;
        self.put(|out| {
            out.record(op::METADATA, |out| {
                out.text(name);
                out.list(|out| {
                    for (key, value) in entries {
                        out.text(key);
                        out.text(value);
                    }
                });
            });
        })?;
        let length = self.position - offset;
        self.metadata.1 += 1;
        self.metadata.0.record(op::METADATA_INDEX, |out| {
            out.u64(offset);
            out.u64(length);
            out.text(name);
        });
        Ok(())
    }

    /// Writes an attachment; no clock shows in it: the same job gives the same bytes.
    pub(super) fn attach(
        &mut self,
        time_ns: u64,
        name: &str,
        media_type: &str,
        data: &[u8],
    ) -> io::Result<()> {
        let offset = self.position;
        self.put(|out| {
            out.record(op::ATTACHMENT, |out| {
                let at = out.len();
                out.u64(time_ns);
                out.u64(time_ns);
                out.text(name);
                out.text(media_type);
                out.u64(data.len() as u64);
                out.extend_from_slice(data);
                let sum = crc32fast::hash(&out[at..]);
                out.u32(sum);
            });
        })?;
        let length = self.position - offset;
        self.attachments.1 += 1;
        self.attachments.0.record(op::ATTACHMENT_INDEX, |out| {
            out.u64(offset);
            out.u64(length);
            out.u64(time_ns);
            out.u64(time_ns);
            out.u64(data.len() as u64);
            out.text(name);
            out.text(media_type);
        });
        Ok(())
    }

    /// Writes a chunk and the index of its messages, up to the operating system. One without records is left out.
    pub(super) fn chunk(&mut self, chunk: &Chunk) -> io::Result<()> {
        if chunk.records.is_empty() {
            return self.file.flush();
        }
        let offset = self.position;
        let (first_ns, last_ns) = chunk.span_ns.unwrap_or_default();
        let (mut sizes, mut pressed) = ([0; 2], Ok(()));
        let (out, packer) = (&mut self.out, &mut self.packer);
        out.clear();
        out.record(op::CHUNK, |out| {
            out.u64(first_ns);
            out.u64(last_ns);
            out.u64(chunk.records.len() as u64);
            out.u32(crc32fast::hash(&chunk.records));
            out.text(packer.name());
            let at = out.len();
            out.u64(0);
            pressed = packer.pack(&chunk.records, out);
            let size = (out.len() - at - 8) as u64;
            out[at..at + 8].copy_from_slice(&size.to_le_bytes());
            sizes = [size, chunk.records.len() as u64];
        });
        pressed?;
        let length = out.len() as u64;
        let mut places = BTreeMap::new();
        for (channel, entries) in
            chunk.index.iter().enumerate().filter(|(_, entries)| !entries.is_empty())
        {
            places.insert(channel as u16, offset + out.len() as u64);
            *self.counts.entry(channel as u16).or_default() += entries.len() as u64;
            out.record(op::MESSAGE_INDEX, |out| {
                out.u16(channel as u16);
                out.list(|out| {
                    for &(time_ns, at) in entries {
                        let mut entry = [0; 16];
                        entry[..8].copy_from_slice(&time_ns.to_le_bytes());
                        entry[8..].copy_from_slice(&at.to_le_bytes());
                        out.extend_from_slice(&entry);
                    }
                });
            });
        }
        let index_length = out.len() as u64 - length;
        if let Some((first_ns, last_ns)) = chunk.span_ns {
            let (first, last) = self.span_ns.unwrap_or((first_ns, last_ns));
            self.span_ns = Some((first.min(first_ns), last.max(last_ns)));
        }
        self.chunks.1 += 1;
        self.chunks.0.record(op::CHUNK_INDEX, |out| {
            out.u64(first_ns);
            out.u64(last_ns);
            out.u64(offset);
            out.u64(length);
            out.list(|out| {
                for (channel, at) in places {
                    out.u16(channel);
                    out.u64(at);
                }
            });
            out.u64(index_length);
            out.text(packer.name());
            sizes.into_iter().for_each(|size| out.u64(size));
        });
        self.write_out()?;
        self.file.flush()
    }

    /// Writes the end of the file.
    pub(super) fn finish(mut self, catalog: &Catalog) -> io::Result<()> {
        let sum = self.sum.clone().finalize();
        self.put(|out| out.record(op::DATA_END, |out| out.u32(sum)))?;
        let start = self.position;
        let mut out = Vec::new();
        let mut groups = Vec::new();
        let mut group = |out: &mut Vec<u8>, opcode, body: &dyn Fn(&mut Vec<u8>)| {
            let at = out.len() as u64;
            body(out);
            let length = out.len() as u64 - at;
            if length > 0 {
                groups.push((opcode, start + at, length));
            }
        };
        let numbered = |k: usize| k as u16 + 1;
        group(&mut out, op::SCHEMA, &|out| {
            catalog
                .schemas
                .iter()
                .enumerate()
                .for_each(|(k, schema)| put_schema(out, numbered(k), schema));
        });
        group(&mut out, op::CHANNEL, &|out| {
            catalog
                .channels
                .iter()
                .enumerate()
                .for_each(|(k, channel)| put_channel(out, numbered(k), channel));
        });
        group(&mut out, op::STATISTICS, &|out| {
            out.record(op::STATISTICS, |out| {
                out.u64(self.counts.values().sum());
                out.u16(catalog.schemas.len() as u16);
                out.u32(catalog.channels.len() as u32);
                out.u32(self.attachments.1);
                out.u32(self.metadata.1);
                out.u32(self.chunks.1);
                let (first_ns, last_ns) = self.span_ns.unwrap_or_default();
                out.u64(first_ns);
                out.u64(last_ns);
                out.list(|out| {
                    for (&channel, &count) in &self.counts {
                        out.u16(channel);
                        out.u64(count);
                    }
                });
            });
        });
        for (opcode, records) in [
            (op::CHUNK_INDEX, &self.chunks.0),
            (op::ATTACHMENT_INDEX, &self.attachments.0),
            (op::METADATA_INDEX, &self.metadata.0),
        ] {
            group(&mut out, opcode, &|out| out.extend_from_slice(records));
        }
        let groups_at = start + out.len() as u64;
        for (opcode, at, length) in groups {
            out.record(op::SUMMARY_OFFSET, |out| {
                out.push(opcode);
                out.u64(at);
                out.u64(length);
            });
        }
        out.record(op::FOOTER, |out| {
            out.u64(start);
            out.u64(groups_at);
            out.u32(0);
        });
        // The checksum of the summary covers the footer up to itself.
        let at = out.len() - 4;
        let sum = crc32fast::hash(&out[..at]);
        out[at..].copy_from_slice(&sum.to_le_bytes());
        out.extend_from_slice(mcap::MAGIC);
        self.out = out;
        self.write_out()?;
        self.file.flush()
    }
}
