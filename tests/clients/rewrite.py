"""Logs that went through other programs: each must be read with the same samples, bit for bit.

rewrite.py VPD NODE_FOLDER FOLDER: writes logs with VPD, has six tools write each anew in FOLDER, and compares what VPD reads.
"""

import json
import pathlib
import subprocess
import sys

import foxglove
import small_mcap
from foxglove.mcap import MCAPCompression, MCAPWriteOptions
from mcap.reader import NonSeekingReader, make_reader
from mcap.writer import CompressionType, IndexType, Writer

VPD, NODE, FOLDER = sys.argv[1], pathlib.Path(sys.argv[2]), pathlib.Path(sys.argv[3])
PYMCAP = pathlib.Path(sys.executable).with_name("pymcap-cli")
SCENES = pathlib.Path(__file__).parents[2] / "scenarios"


def vpd(*arguments, code=0):
    done = subprocess.run([VPD, *map(str, arguments)], capture_output=True)
    assert done.returncode == code, f"vpd {arguments}: {done.returncode}\n{done.stderr.decode()}"
    return done.stdout


def source(name, scene, *changes):
    log = FOLDER / f"{name}.mcap"
    settings = [word for change in ("/expect=null", *changes) for word in ("--set", change)]
    vpd("run", SCENES / scene, "-o", log, "--force", *settings)
    return log


def records(log):
    """Messages, attachments and metadata of a log, in the order of the file."""
    with open(log, "rb") as file:
        messages = list(NonSeekingReader(file).iter_messages(log_time_order=False))
    with open(log, "rb") as file:
        reader = make_reader(file)
        return messages, list(reader.iter_attachments()), list(reader.iter_metadata())


def python(log, out, *, first=(), last=("attachments", "metadata"), order=None, reverse_ids=False, foreign=False, **options):
    """By the writer of Python's mcap: what stands before the messages and what behind is to be chosen."""
    messages, attachments, metadata = records(log)
    if order:
        messages.sort(key=order)
    with open(out, "wb") as file:
        writer = Writer(file, **options)
        writer.start(profile="", library="rewrite.py")

        def put(what):
            for found in attachments if what == "attachments" else metadata:
                if what == "attachments":
                    writer.add_attachment(
                        create_time=found.create_time, log_time=found.log_time, name=found.name,
                        media_type=found.media_type, data=found.data,
                    )
                else:
                    writer.add_metadata(found.name, found.metadata)

        for what in first:
            put(what)
        channels, schemas = {}, {}
        found = {channel.id: (schema, channel) for schema, channel, _ in messages}
        for schema, channel in sorted(found.values(), key=lambda pair: pair[1].id, reverse=reverse_ids):
            if schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
            channels[channel.id] = writer.register_channel(
                channel.topic, channel.message_encoding, schemas[schema.id], channel.metadata
            )
        other = foreign and writer.register_channel("/camera", "json", writer.register_schema("Camera", "jsonschema", b"{}"))
        for index, (_, channel, message) in enumerate(messages):
            if other and index % 7 == 0:
                writer.add_message(other, message.log_time, b'{"state": 1}', message.log_time, index)
            writer.add_message(
                channels[channel.id], message.log_time, message.data, message.publish_time, message.sequence
            )
        for what in last:
            put(what)
        writer.finish()


def small(log, out, **options):
    """By the writer of small-mcap, in the order of the file."""
    messages, attachments, metadata = records(log)
    with open(out, "wb") as file:
        writer = small_mcap.McapWriter(file, **options)
        writer.start(profile="", library="small")
        seen = set()
        for schema, channel, message in messages:
            if schema.id not in seen:
                writer.add_schema(schema.id, schema.name, schema.encoding, schema.data)
                seen.add(schema.id)
            if (channel.id,) not in seen:
                writer.add_channel(channel.id, channel.topic, channel.message_encoding, schema.id)
                seen.add((channel.id,))
            writer.add_message(channel.id, message.log_time, message.data, message.publish_time, message.sequence)
        for found in attachments:
            writer.add_attachment(found.log_time, found.create_time, found.name, found.media_type, found.data)
        for found in metadata:
            writer.add_metadata(found.name, found.metadata)
        writer.finish()


def sdk(log, out, **options):
    """By Foxglove's SDK, which stores no attachments of another time and numbers messages anew."""
    messages, attachments, metadata = records(log)
    context = foxglove.Context()
    with foxglove.open_mcap(str(out), allow_overwrite=True, context=context, writer_options=MCAPWriteOptions(**options)) as writer:
        channels = {}
        for schema, channel, message in messages:
            if channel.id not in channels:
                channels[channel.id] = foxglove.Channel(
                    channel.topic, context=context, message_encoding=channel.message_encoding,
                    schema=foxglove.Schema(name=schema.name, encoding=schema.encoding, data=schema.data),
                )
            channels[channel.id].log(message.data, log_time=message.log_time)
        for found in attachments:
            writer.attach(
                log_time=found.log_time, create_time=found.create_time, name=found.name,
                media_type=found.media_type, data=found.data,
            )
        for found in metadata:
            writer.write_metadata(found.name, found.metadata)


def node(log, out, options):
    """By the writer of @mcap/core."""
    subprocess.run(["node", NODE / "rewrite.mjs", log, out, json.dumps(options)], check=True)


def pymcap(*command):
    def rewrite(log, out):
        # 3: the input was not whole.
        done = subprocess.run([PYMCAP, command[0], log, "-o", out, *command[1:], "--force"], capture_output=True, text=True)
        assert done.returncode in (0, 3), done.stderr

    return rewrite


def merge(log, out):
    """With the topics of another program."""
    other = out.with_suffix(".other")
    with open(other, "wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("/camera", "json", writer.register_schema("Camera", "jsonschema", b"{}"))
        for k in range(100):
            writer.add_message(channel, 1767225600000000000 + k * 1_000_000, b"{}", 0, k)
        writer.finish()
    done = subprocess.run([PYMCAP, "merge", log, other, "-o", out, "--force"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def by_python(**options):
    return lambda log, out: python(log, out, **options)


def by_small(**options):
    return lambda log, out: small(log, out, **options)


def by_sdk(**options):
    return lambda log, out: sdk(log, out, **options)


def by_node(**options):
    return lambda log, out: node(log, out, options)


NO_SUMMARY = dict(
    repeat_channels=False, repeat_schemas=False, use_statistics=False, use_summary_offsets=False, index_types=IndexType.NONE
)
WAYS = {
    "Python mcap": {
        "as it is": by_python(),
        "attachments and metadata first": by_python(first=("metadata", "attachments"), last=()),
        "no chunks": by_python(use_chunking=False),
        "no chunks, checksums of data and summary": by_python(use_chunking=False, enable_data_crcs=True),
        "no checksums": by_python(enable_crcs=False),
        "chunks of 2 kB, lz4": by_python(chunk_size=2000, compression=CompressionType.LZ4),
        "no compression": by_python(compression=CompressionType.NONE, chunk_size=50_000),
        "no index, no summary": by_python(**NO_SUMMARY),
        "statistics without an index": by_python(index_types=IndexType.NONE),
        "no message index": by_python(index_types=IndexType.CHUNK | IndexType.METADATA, chunk_size=30_000),
        "no offsets of the summary": by_python(use_summary_offsets=False),
        "numbers of channels and schemas reversed": by_python(reverse_ids=True),
        "another program's topic in between": by_python(foreign=True, chunk_size=10_000),
        "one topic after another": by_python(order=lambda found: found[1].topic, chunk_size=20_000),
        "topics in another order": by_python(order=lambda found: (found[2].log_time, -found[1].id)),
    },
    "pymcap-cli": {
        "recover": pymcap("recover"),
        "recover, decoded": pymcap("recover", "--always-decode-chunk"),
        "filter": pymcap("filter"),
        "filter, by time": pymcap("filter", "--order", "log_time"),
        "filter, by topic": pymcap("filter", "--order", "topic", "--chunk-size", "20000"),
        "filter, no chunks": pymcap("filter", "--no-chunks"),
        "filter, no checksums": pymcap("filter", "--no-crc"),
        "merge with another program's log": merge,
        "compress": pymcap("compress"),
        "compress, lz4, chunks of 10 kB": pymcap("compress", "--compression", "lz4", "--chunk-size", "10000"),
        "decompress": pymcap("decompress"),
        "rechunk, a chunk a topic": pymcap("rechunk", "--strategy", "all"),
        "rechunk, a chunk for states": pymcap("rechunk", "--strategy", "pattern", "-p", "/state", "--chunk-size", "30000"),
    },
    "small-mcap": {
        "as it is": by_small(),
        "no chunks": by_small(use_chunking=False),
        "chunks of 5 kB": by_small(chunk_size=5000),
    },
    "@mcap/core": {
        "as it is": by_node(),
        "chunks of 5 kB": by_node(chunkSize=5000),
        "no chunks": by_node(useChunks=False),
        "no summary": by_node(useStatistics=False, useSummaryOffsets=False, repeatChannels=False, repeatSchemas=False,
                              useMessageIndex=False, useChunkIndex=False, useAttachmentIndex=False, useMetadataIndex=False),
        "metadata first": by_node(metadataFirst=True),
    },
    "Foxglove SDK": {
        "as it is": by_sdk(),
        "chunks of 5 kB, lz4": by_sdk(chunk_size=5000, compression=MCAPCompression.Lz4),
        "no chunks": by_sdk(use_chunks=False),
        "no summary": by_sdk(emit_statistics=False, emit_summary_offsets=False, emit_message_indexes=False,
                             emit_chunk_indexes=False, repeat_channels=False, repeat_schemas=False),
    },
}

SOURCES = [
    (source("dipole", "dipole.json", "/steps=2000", "/log/every=1"), True),
    (source("satellites", "satellite-ensemble.json", "/duration_s=600", "/ensemble/members=6"), False),
]


def compared(log, out, whole):
    """What differs between a log and the one written anew, in words."""
    channels = [""] if whole else ["--channels=/ensemble/members", "--channels=/ensemble/statistics", "--member=2", ""]
    wrong = []
    for words in channels:
        words = [words] if words else []
        if vpd("export", log, *words) != (got := subprocess.run([VPD, "export", out, *words], capture_output=True)).stdout:
            wrong.append(f"export {words}: {got.stderr.decode()[-300:]}")
    found = json.loads(vpd("inspect", out, "--json"))
    if not found["finished"]:
        wrong.append(f"inspect: {found['damage']}")
    if found["extremes"] != json.loads(vpd("inspect", log, "--json"))["extremes"]:
        wrong.append("inspect: other extremes")
    if subprocess.run([VPD, "diff", log, out], capture_output=True).returncode != 0:
        wrong.append("diff")
    charts = [FOLDER / "charts", FOLDER / "charts.anew"]
    for path, folder in zip((log, out), charts):
        vpd("chart", path, "-o", folder)
    for chart in charts[0].iterdir():
        if chart.read_bytes() != (charts[1] / chart.name).read_bytes():
            wrong.append(f"chart {chart.name}")
    done = subprocess.run([VPD, "verify", out], capture_output=True, text=True)
    if done.returncode != 0:
        wrong.append(f"verify: {done.stdout[-200:]}{done.stderr[-300:]}")
    return wrong, found.get("unchecked")


count, failed = 0, 0
for tool, ways in WAYS.items():
    for way, rewrite in ways.items():
        for log, whole in SOURCES:
            out = FOLDER / f"{log.stem}-{count}.mcap"
            rewrite(log, out)
            try:
                wrong, unchecked = compared(log, out, whole)
            except AssertionError as error:
                wrong, unchecked = [str(error)], None
            count += 1
            failed += bool(wrong)
            print(f"{tool}, {way}, {log.stem}: {'; '.join(wrong) or 'the same'}{f' ({unchecked})' if unchecked else ''}", flush=True)
print(f"{count} files, {count - failed} read with the same samples")
assert failed == 0
