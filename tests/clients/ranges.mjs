// The reader inside Foxglove and Lichtblick, over HTTP ranges: what it needs to open a log and to read a part.
import assert from "node:assert/strict";
import { McapIndexedReader } from "@mcap/core";
import { loadDecompressHandlers } from "@mcap/support";
import { checks, ended, service, shipped, submit } from "./service.mjs";

const { url, stop } = await service();
const job = await ended(url, (await submit(url, await shipped(url, "dipole"))).id);
const log = `${url}/jobs/${job.id}/log.mcap`;

let requests = 0, bytes = 0;
const readable = {
  async size() {
    requests += 1;
    const head = await fetch(log, { method: "HEAD" });
    return BigInt(head.headers.get("content-length"));
  },
  async read(offset, length) {
    requests += 1;
    bytes += Number(length);
    const answer = await fetch(log, { headers: { range: `bytes=${offset}-${offset + length - 1n}` } });
    assert.equal(answer.status, 206);
    return new Uint8Array(await answer.arrayBuffer());
  },
};

let reader;
await checks({
  "the log opens with a few requests": async () => {
    reader = await McapIndexedReader.Initialize({ readable, decompressHandlers: await loadDecompressHandlers() });
    assert.ok(requests <= 6, `${requests} requests`);
    assert.ok(bytes < 200_000, `${bytes} bytes`);
    return `${requests} requests, ${bytes} bytes`;
  },
  "the statistics count the samples": () => {
    const state = [...reader.channelsById.values()].find(channel => channel.topic === "/state");
    assert.equal(reader.statistics.channelMessageCounts.get(state.id), 10001n);
  },
  "a second of log time takes a chunk or two": async () => {
    const before = requests;
    const start = reader.statistics.messageStartTime;
    let messages = 0;
    for await (const message of reader.readMessages({ topics: ["/energy"], startTime: start + 500_000_000_000n, endTime: start + 501_000_000_000n })) {
      assert.ok(message.logTime >= start);
      messages += 1;
    }
    assert.equal(messages, 11);
    assert.ok(requests - before <= 4, `${requests - before} requests`);
    return `${messages} messages, ${requests - before} requests`;
  },
});
await stop();
