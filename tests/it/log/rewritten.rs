//! Logs that another program wrote anew: the same samples, whatever the order and the form of the records.
//! (`tests/clients/rewrite.py` has six programs of others do it.)

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use mcap::records::{MessageHeader, Record, op};
use mcap::{Attachment, WriteOptions};
use vpd::log::course::Course;
use vpd::log::inspect::{Inspection, inspect};
use vpd::log::rows::{Row, read_rows};
use vpd::log::samples::{Curve, Window, read_course};
use vpd::log::stretch::{Wanted, read_stretch};

use super::fixture::*;

/// A message with its topic and its schema.
struct Sent {
    topic: String,
    schema: (String, Vec<u8>),
    header: MessageHeader,
    data: Vec<u8>,
}

/// The contents of a log.
#[derive(Default)]
struct Contents {
    messages: Vec<Sent>,
    attachments: Vec<(mcap::records::AttachmentHeader, Vec<u8>)>,
    metadata: Vec<mcap::records::Metadata>,
}

fn contents(log: &Path) -> Contents {
    let bytes = fs::read(log).expect("read");
    let mut contents = Contents::default();
    let (mut schemas, mut channels) = (BTreeMap::new(), BTreeMap::new());
    for record in mcap::read::ChunkFlattener::new(&bytes).expect("an MCAP file") {
        match record.expect("sound") {
            Record::Schema { header, data } => {
                schemas.insert(header.id, (header.name, data.into_owned()));
            }
            Record::Channel(channel) => {
                channels.insert(channel.id, (channel.topic, channel.schema_id));
            }
            Record::Message { header, data } => {
                let (topic, schema) = channels[&header.channel_id].clone();
                let schema = schemas[&schema].clone();
                contents.messages.push(Sent { topic, schema, header, data: data.into_owned() });
            }
            Record::Attachment { header, data, .. } => {
                contents.attachments.push((header, data.into_owned()));
            }
            Record::Metadata(metadata) => contents.metadata.push(metadata),
            Record::DataEnd(_) => break,
            _ => {}
        }
    }
    contents
}

/// Writes them by the writer of the `mcap` crate.
fn write(contents: &Contents, options: WriteOptions, parts_first: bool) -> Vec<u8> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    let mut file = options.library("another").create(&mut bytes).expect("begun");
    let parts = |file: &mut mcap::Writer<_>| {
        for (header, data) in &contents.attachments {
            let attachment = Attachment {
                log_time: header.log_time,
                create_time: header.create_time,
                name: header.name.clone(),
                media_type: header.media_type.clone(),
                data: data.into(),
            };
            file.attach(&attachment).expect("attached");
        }
        for metadata in &contents.metadata {
            file.write_metadata(metadata).expect("written");
        }
    };
    if parts_first {
        parts(&mut file);
    }
    for Sent { topic, schema: (name, descriptors), header, data } in &contents.messages {
        let schema = file.add_schema(name, "protobuf", descriptors).expect("a schema");
        let channel_id =
            file.add_channel(schema, topic, "protobuf", &BTreeMap::new()).expect("a channel");
        file.write_to_known_channel(&MessageHeader { channel_id, ..*header }, data)
            .expect("written");
    }
    if !parts_first {
        parts(&mut file);
    }
    file.finish().expect("finished");
    drop(file);
    bytes.into_inner()
}

fn rows(log: &Path) -> Vec<Row> {
    let mut rows = Vec::new();
    read_rows(log, 0, |row| {
        rows.push(row);
        std::ops::ControlFlow::Continue(())
    })
    .expect("read");
    rows
}

/// Asserts that all that is read of two logs is the same, and returns the sum of the second.
fn assert_same(log: &Path, anew: &Path, what: &str) -> Inspection {
    let (old, new) = (inspect(log).expect("read"), inspect(anew).expect("read"));
    assert!(new.finished, "{what}: {new}");
    assert_eq!(
        (&old.outcome, &old.job, old.samples, old.span, old.extremes),
        (&new.outcome, &new.job, new.samples, new.span, new.extremes),
        "{what}"
    );
    assert!(rows(log) == rows(anew), "{what}");
    let points = |log: &Path| {
        let course = Course::of(log).expect("read");
        vpd::log::course::LogChart::ALL.map(|chart| course.points(chart).to_vec())
    };
    assert_eq!(points(log), points(anew), "{what}");
    let window = Window { from_s: 0.05, to_s: 0.15, points: 100 };
    let curve = |log: &Path| {
        read_course(log, Curve::EnergyError, window, &|_| Vec::new(), &|| false).expect("read")
    };
    assert_eq!(curve(log).map(|found| found.low), curve(anew).map(|found| found.low), "{what}");
    let wanted = Wanted { from_s: 0.1, every_s: 0.02, samples: 5 };
    let stretch = |log: &Path| read_stretch(log, wanted).expect("read");
    assert_eq!(stretch(log), stretch(anew), "{what}");
    new
}

fn anew(log: &Path, bytes: &[u8]) -> PathBuf {
    let path = log.with_extension("anew.mcap");
    fs::write(&path, bytes).expect("written");
    path
}

#[test]
fn what_another_program_wrote_anew_has_the_same_samples() {
    let (_folder, log) = write_dipole(35);
    let contents = contents(&log);
    let none = || WriteOptions::new().compression(None);
    let no_sums = || {
        none()
            .calculate_chunk_crcs(false)
            .calculate_data_section_crc(false)
            .calculate_summary_section_crc(false)
    };
    let chunks = |bytes| WriteOptions::new().chunk_size(Some(bytes));
    for (what, options, parts_first, unchecked) in [
        ("one chunk", WriteOptions::new().chunk_size(None), false, false),
        ("small chunks", chunks(500), false, false),
        ("lz4", WriteOptions::new().compression(Some(mcap::Compression::Lz4)), false, false),
        ("the outcome first", WriteOptions::new(), true, false),
        ("no chunks", none().use_chunks(false), false, false),
        ("no chunks, the outcome first", none().use_chunks(false), true, false),
        ("no chunks, no checksums", no_sums().use_chunks(false), false, true),
        ("chunks without checksums", no_sums(), false, true),
        (
            "no summary",
            WriteOptions::new().emit_summary_records(false).emit_summary_offsets(false),
            false,
            false,
        ),
        ("no index of messages", chunks(700).emit_message_indexes(false), false, false),
        ("no index of chunks", chunks(700).emit_chunk_indexes(false), false, false),
    ] {
        let path = anew(&log, &write(&contents, options, parts_first));
        let found = assert_same(&log, &path, what);
        assert_eq!(found.unchecked.is_some(), unchecked, "{what}: {:?}", found.unchecked);
    }
}

#[test]
fn another_order_of_the_messages_changes_no_sample() {
    let (_folder, log) = write_dipole(35);
    let mut contents = contents(&log);
    // Each topic by itself, in chunks of its own.
    contents.messages.sort_by(|a, b| a.topic.cmp(&b.topic));
    let path = anew(&log, &write(&contents, WriteOptions::new().chunk_size(Some(500)), false));
    assert_same(&log, &path, "a topic after another");
    // Numbers of messages by channel, as some programs give them.
    let mut counts = BTreeMap::<u16, u32>::new();
    for sent in &mut contents.messages {
        let count = counts.entry(sent.header.channel_id).or_default();
        sent.header.sequence = *count;
        *count += 1;
    }
    contents.messages.sort_by_key(|sent| (sent.header.log_time, u16::MAX - sent.header.channel_id));
    let path = anew(&log, &write(&contents, WriteOptions::new(), false));
    assert_same(&log, &path, "other numbers, topics in another order");
    // A part of the time after the rest.
    contents
        .messages
        .sort_by_key(|sent| (sent.header.log_time / 100_000_000 % 2, sent.header.log_time));
    let path = anew(&log, &write(&contents, WriteOptions::new(), false));
    assert_same(&log, &path, "times in no order");
}

/// Messages outside chunks have no checksum of their own: that of the data section counts before the first of them is shown.
#[test]
fn a_flipped_bit_of_an_unchunked_log_is_reported() {
    let (_folder, log) = write_dipole(15);
    let whole = all_messages(&log);
    let bytes =
        write(&contents(&log), WriteOptions::new().compression(None).use_chunks(false), false);
    let mut random = 0x5eed_0002_u64;
    let ends = record_ends(&bytes);
    for k in 0..200 {
        let draw = next(&mut random);
        // Behind the header, by which the file is known as another program's.
        let byte = match k % 2 {
            0 => (ends[1 + draw as usize % (ends.len() - 1)] + (draw >> 32) as usize % 9)
                .min(bytes.len() - 1),
            _ => ends[1] + draw as usize % (bytes.len() - ends[1]),
        };
        let bit = next(&mut random) % 8;
        let mut damaged = bytes.clone();
        damaged[byte] ^= 1 << bit;
        let path = anew(&log, &damaged);
        let found = inspect(&path).expect("read");
        assert!(
            (!found.finished && found.damage.is_some()) || found.unchecked.is_some(),
            "byte {byte}, bit {bit}: {found}"
        );
        let messages = all_messages(&path);
        let same = messages.iter().all(|message| whole.contains(message));
        // Where the flip took the checksum of the data away, it says that none covers them.
        assert!(same || found.unchecked.is_some(), "byte {byte}, bit {bit}");
    }
}

#[test]
fn a_log_of_ours_has_no_message_outside_its_chunks() {
    let (_folder, log) = write_dipole(15);
    let options = WriteOptions::new().compression(None).use_chunks(false);
    let mut bytes = write(&contents(&log), options, false);
    // The name of the program at its place in the header: a log of ours is held to what ours writes.
    let at = bytes.windows(7).position(|word| word == b"another").expect("in the header");
    bytes[at..at + 7].copy_from_slice(b"vpd/0.1");
    let found = inspect(&anew(&log, &bytes)).expect("read");
    assert!(!found.finished && found.samples == 0, "{found}");
}

/// An attachment that ends within its own head.
#[test]
fn a_short_attachment_is_damage() {
    let (_folder, log) = write_dipole(3);
    let bytes = fs::read(&log).expect("read");
    let header_ends = record_ends(&bytes)[1];
    for length in 0..50 {
        let mut damaged = bytes[..header_ends].to_vec();
        damaged.push(op::ATTACHMENT);
        damaged.extend_from_slice(&u64::to_le_bytes(length));
        damaged.extend(std::iter::repeat_n(0, length as usize));
        let found = inspect(&anew(&log, &damaged)).expect("read");
        assert!(!found.finished && found.damage.is_some(), "{length}");
    }
}
