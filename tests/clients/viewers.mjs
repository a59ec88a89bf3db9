// A page on another origin does what viewers do, and the Rerun web viewer opens our address.
//
//     node viewers.mjs [SCREENSHOT.png]
import assert from "node:assert/strict";
import { spawn, spawnSync } from "node:child_process";
import { mkdtempSync, writeFileSync } from "node:fs";
import { createServer } from "node:http";
import { tmpdir } from "node:os";
import { browser, checks, ended, service, shipped, submit } from "./service.mjs";

const RERUN = process.env.RERUN ?? "target/clients/bin/rerun";
const { url, stop } = await service();
const job = await ended(url, (await submit(url, await shipped(url, "heavy-top"))).id);
const log = `${url}/jobs/${job.id}/log.mcap`;
const other = createServer((_, answer) => answer.setHeader("content-type", "text/html").end("<title>other</title>"));
await new Promise(ready => other.listen(0, "127.0.0.1", ready));
const chromium = await browser(["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]);
const port = async () => {
  const server = createServer();
  await new Promise(ready => server.listen(0, "127.0.0.1", ready));
  const { port } = server.address();
  await new Promise(closed => server.close(closed));
  return port;
};

// What Rerun shows of an address: the picture once it stays, and the number of colours in it and where the body is.
const inRerun = async (files, address, loaded) => {
  const [grpc, web] = [await port(), await port()];
  const rerun = spawn(RERUN, [...files, "--serve-web", "--bind", "127.0.0.1", "--port", String(grpc), "--web-viewer-port", String(web)],
    { stdio: "ignore", detached: true, env: { ...process.env, RERUN_ANALYTICS: "0" } });
  try {
    const viewer = await chromium.newPage({ viewport: { width: 1200, height: 760 } });
    const requested = loaded?.(viewer);
    for (let tries = 0; ; tries += 1) {
      try { await viewer.goto(`http://127.0.0.1:${web}/?url=${encodeURIComponent(address(grpc))}`); break; } catch (error) {
        if (tries === 40) throw error;
        await new Promise(later => setTimeout(later, 250));
      }
    }
    const request = await requested;
    const count = (shot, [x, y, width, height]) => viewer.evaluate(async ({ bytes, x, y, width, height }) => {
      const picture = await createImageBitmap(new Blob([new Uint8Array(bytes)], { type: "image/png" }));
      const canvas = new OffscreenCanvas(picture.width, picture.height);
      const pen = canvas.getContext("2d");
      pen.drawImage(picture, 0, 0);
      const { data } = pen.getImageData(x, y, width, height);
      const seen = new Set();
      for (let i = 0; i < data.length; i += 4) seen.add(data[i] << 16 | data[i + 1] << 8 | data[i + 2]);
      return seen.size;
    }, { bytes: [...shot], x, y, width, height });
    // The viewer draws on a canvas: it has drawn the log once there are colours and they stay, which takes moments.
    let [shot, colors] = [await viewer.screenshot(), 0];
    for (let same = 0, tries = 0; (same < 2 || colors <= 100) && tries < 120; tries += 1) {
      await viewer.waitForTimeout(500);
      const next = await viewer.screenshot();
      same = next.equals(shot) ? same + 1 : 0;
      shot = next;
      colors = await count(shot, [0, 0, 1200, 760]);
    }
    assert.ok(colors > 100, `${colors} colours: nothing was drawn`);
    return { request, shot, colors, middle: await count(shot, [250, 280, 100, 100]) };
  } finally { process.kill(-rerun.pid); } // the viewer is a child of what was started
};

const page = await chromium.newPage();
await page.goto(`http://127.0.0.1:${other.address().port}/`);

await checks({
  "a page of another origin reads the headers, leaves, and asks for a range": async () => {
    const seen = await page.evaluate(async log => {
      const stop = new AbortController();
      const whole = await fetch(log, { signal: stop.signal, cache: "no-store" });
      const { headers } = whole;
      const found = { status: whole.status, ranges: headers.get("accept-ranges"), length: headers.get("content-length"), etag: headers.get("etag") };
      stop.abort();
      const part = await fetch(log, { headers: { range: "bytes=0-7" } });
      const magic = [...new Uint8Array(await part.arrayBuffer())];
      return { ...found, part: part.status, range: part.headers.get("content-range"), magic };
    }, log);
    assert.equal(seen.status, 200);
    assert.equal(seen.ranges, "bytes");
    assert.match(seen.etag, /^"/);
    assert.equal(seen.part, 206);
    assert.equal(seen.range, `bytes 0-7/${seen.length}`);
    assert.deepEqual(seen.magic.slice(1, 5), [..."MCAP"].map(c => c.charCodeAt(0)));
    return `${seen.length} bytes, ETag ${seen.etag}`;
  },
  "it may read the layouts, but not the list of jobs": async () => {
    const [layout, jobs] = await page.evaluate(async url => [
      await fetch(`${url}/layouts/lichtblick.json`).then(answer => answer.json()),
      await fetch(`${url}/jobs`).then(() => "read", error => error.name),
    ], url);
    const topics = JSON.stringify(layout);
    for (const topic of ["/energy", "/orthogonality", "/momentum", "/solver", "/scene/body"]) assert.ok(topics.includes(`"${topic}`), topic);
    assert.equal(jobs, "TypeError");
  },
  "the log of a running job is refused until it is finished": async () => {
    const scenario = { ...await shipped(url, "heavy-top"), steps: 1_000_000_000, log: { every: 100_000 } };
    delete scenario.duration_s;
    const { id } = await submit(url, scenario);
    const status = await page.evaluate(log => fetch(log).then(answer => answer.status), `${url}/jobs/${id}/log.mcap`);
    await fetch(`${url}/jobs/${id}/cancel`, { method: "POST" });
    assert.equal(status, 409);
  },
  "the Rerun web viewer opens our address": async () => {
    const { request, colors } = await inRerun([], () => log, page => page.waitForEvent("requestfinished",
      { predicate: request => request.url().startsWith(log), timeout: 60_000 }));
    const answer = await request.response();
    assert.equal(answer.status(), 200);
    return `${request.method()} ${answer.status()}, ${colors} colours`;
  },
  "a recording of it shows the body": async () => {
    const folder = mkdtempSync(`${tmpdir()}/vpd-`);
    const [file, recording] = [`${folder}/heavy-top.mcap`, `${folder}/heavy-top.rrd`];
    writeFileSync(file, Buffer.from(await (await fetch(log)).arrayBuffer()));
    const done = spawnSync(RERUN.replace(/rerun$/, "python"), ["docs/rerun_log.py", file, recording], { encoding: "utf8" });
    assert.equal(done.status, 0, done.stderr);
    const { colors, shot, middle } = await inRerun([recording], grpc => `rerun+http://127.0.0.1:${grpc}/proxy`);
    // The box is in the middle of the left half, shaded: an empty view is of one colour there.
    assert.ok(middle > 20, `${middle} colours where the body is`);
    if (process.argv[2]) writeFileSync(process.argv[2], shot);
    return `${colors} colours, ${middle} where the body is`;
  },
});
await chromium.close();
other.close();
await stop();
