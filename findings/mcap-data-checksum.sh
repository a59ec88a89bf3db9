#!/usr/bin/env bash
# The Rust crate mcap: without chunk checksums the checksum of the data is wrong.
#
# Version: mcap 0.26.0 (crate).
# Behaviour: with `WriteOptions::calculate_chunk_crcs(false)` the record DataEnd of a chunked file holds a CRC-32 that is not that
# of the bytes before it. With the default options, and without chunks, it is.
# Seen: default true, no chunk checksums false, no chunks true.
# A reader that checks the data section, as the format allows, calls such a file damaged.
#
# Fails if the checksum is right in all three.
set -euo pipefail
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
mkdir "$place/src"
cat > "$place/Cargo.toml" <<'TOML'
[package]
name = "checksum"
version = "0.0.0"
edition = "2021"

[dependencies]
crc32fast = "=1.5.0"
mcap = "=0.26.0"

[workspace]
TOML
cat > "$place/src/main.rs" <<'RUST'
use mcap::{records::MessageHeader, WriteOptions};

/// Writes ten messages, and returns whether the checksum in DataEnd is that of the bytes before it.
fn agrees(options: WriteOptions) -> bool {
    let mut bytes = std::io::Cursor::new(Vec::new());
    let mut writer = options.create(&mut bytes).unwrap();
    let schema = writer.add_schema("a", "protobuf", &[]).unwrap();
    let channel_id = writer.add_channel(schema, "/a", "protobuf", &Default::default()).unwrap();
    for k in 0..10 {
        let header = MessageHeader { channel_id, sequence: k, log_time: k.into(), publish_time: k.into() };
        writer.write_to_known_channel(&header, &[1, 2, 3]).unwrap();
    }
    writer.finish().unwrap();
    drop(writer);
    let (bytes, mut at) = (bytes.into_inner(), 8);
    loop {
        let length = u64::from_le_bytes(bytes[at + 1..at + 9].try_into().unwrap()) as usize;
        if bytes[at] == 0x0f {
            return bytes[at + 9..at + 13] == crc32fast::hash(&bytes[..at]).to_le_bytes();
        }
        at += 9 + length;
    }
}

fn main() {
    let all = agrees(WriteOptions::new());
    let none_of_chunks = agrees(WriteOptions::new().calculate_chunk_crcs(false));
    let no_chunks = agrees(WriteOptions::new().use_chunks(false));
    println!("default {all}, no chunk checksums {none_of_chunks}, no chunks {no_chunks}");
    std::process::exit(i32::from((all, none_of_chunks, no_chunks) != (true, false, true)));
}
RUST
cargo run --quiet --release --manifest-path "$place/Cargo.toml"
