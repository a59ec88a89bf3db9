// A page on another origin does what viewers do, and the Rerun web viewer opens our address.
//
//     node viewers.mjs [SCREENSHOT.png]
import assert from "node:assert/strict";
import { spawn } from "node:child_process";
import { createServer } from "node:http";
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
    const [grpc, web] = [await port(), await port()];
    const rerun = spawn(RERUN, ["--serve-web", "--bind", "127.0.0.1", "--port", String(grpc), "--web-viewer-port", String(web)],
      { stdio: "ignore", detached: true, env: { ...process.env, RERUN_ANALYTICS: "0" } });
    try {
      const viewer = await chromium.newPage({ viewport: { width: 1100, height: 700 } });
      const loaded = viewer.waitForEvent("requestfinished", { predicate: request => request.url().startsWith(log), timeout: 60_000 });
      for (let tries = 0; ; tries += 1) {
        try { await viewer.goto(`http://127.0.0.1:${web}/?url=${encodeURIComponent(log)}`); break; } catch (error) {
          if (tries === 40) throw error;
          await new Promise(later => setTimeout(later, 250));
        }
      }
      const answer = await (await loaded).response();
      assert.equal(answer.status(), 200);
      // The viewer draws on a canvas: it has drawn the log once it no longer says that it loads, which takes moments.
      let shot = await viewer.screenshot();
      for (let same = 0, tries = 0; same < 2 && tries < 8; tries += 1) {
        await viewer.waitForTimeout(500);
        const next = await viewer.screenshot();
        same = next.equals(shot) ? same + 1 : 0;
        shot = next;
      }
      const colors = await viewer.evaluate(async bytes => {
        const picture = await createImageBitmap(new Blob([new Uint8Array(bytes)], { type: "image/png" }));
        const canvas = new OffscreenCanvas(picture.width, picture.height);
        const pen = canvas.getContext("2d");
        pen.drawImage(picture, 0, 0);
        const { data } = pen.getImageData(0, 0, picture.width, picture.height);
        const seen = new Set();
        for (let i = 0; i < data.length; i += 4) seen.add(data[i] << 16 | data[i + 1] << 8 | data[i + 2]);
        return seen.size;
      }, [...shot]);
      assert.ok(colors > 100, `${colors} colours: nothing was drawn`);
      if (process.argv[2]) (await import("node:fs")).writeFileSync(process.argv[2], shot);
      return `${answer.request().method()} ${answer.status()}, ${colors} colours`;
    } finally { process.kill(-rerun.pid); } // the viewer is a child of what was started
  },
});
await chromium.close();
other.close();
await stop();
