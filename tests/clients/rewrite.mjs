// Writes a log anew by the writer of @mcap/core: rewrite.mjs LOG OUT OPTIONS.
import { readFileSync, writeFileSync } from "node:fs";
import { McapStreamReader, McapWriter } from "@mcap/core";
import { loadDecompressHandlers } from "@mcap/support";

const [log, out, given] = process.argv.slice(2);
const { metadataFirst, ...options } = JSON.parse(given);
const parts = [];
let written = 0n;
const writable = {
  position: () => written,
  write: async (bytes) => {
    parts.push(Buffer.from(bytes));
    written += BigInt(bytes.byteLength);
  },
};

const reader = new McapStreamReader({ decompressHandlers: await loadDecompressHandlers() });
reader.append(readFileSync(log));
const records = [];
for (let record; (record = reader.nextRecord()); ) {
  if (record.type === "DataEnd") break;
  records.push(record);
}
const writer = new McapWriter({ writable, ...options });
await writer.start({ profile: "", library: "rewrite.mjs" });
const put = async () => {
  for (const record of records) {
    if (record.type === "Metadata") await writer.addMetadata(record);
    if (record.type === "Attachment") await writer.addAttachment(record);
  }
};
if (metadataFirst) await put();
const [schemas, channels] = [new Map(), new Map()];
for (const record of records) {
  if (record.type === "Schema") {
    schemas.set(record.id, await writer.registerSchema(record));
  } else if (record.type === "Channel") {
    channels.set(record.id, await writer.registerChannel({ ...record, schemaId: schemas.get(record.schemaId) }));
  } else if (record.type === "Message") {
    await writer.addMessage({ ...record, channelId: channels.get(record.channelId) });
  }
}
if (!metadataFirst) await put();
await writer.end();
writeFileSync(out, Buffer.concat(parts));
