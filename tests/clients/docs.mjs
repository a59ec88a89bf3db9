// The description of the API at /docs as a person uses it, in a real browser.
//
//     node docs.mjs [DIRECTORY]     also writes a screenshot
import assert from "node:assert/strict";
import { browser, checks, ended, service } from "./service.mjs";

const shots = process.argv[2];
const { url, stop } = await service();
const guarded = await service([], { VPD_TOKENS: "admin a-token-of-the-tests" });
const chromium = await browser();

async function open(to, options = {}) {
  const context = await chromium.newContext({ viewport: { width: 1200, height: 1000 }, ...options });
  const page = await context.newPage();
  page.wrong = [];
  page.on("pageerror", error => page.wrong.push(String(error)));
  page.on("console", line => line.type() === "error" && !/status of 4\d\d/.test(line.text()) && page.wrong.push(line.text()));
  await page.goto(to);
  await page.waitForFunction(() => document.querySelectorAll("#types details").length > 50);
  return page;
}

// Sends what stands in the form of an operation; the first line of the answer and its text.
async function send(page, operation) {
  await page.click(`#${operation} form button`);
  await page.waitForFunction(id => document.querySelector(`#${id} form pre`)?.textContent
    && document.querySelector(`#${id} form button`).textContent === "Send", operation);
  return [await page.textContent(`#${operation} form strong`), await page.textContent(`#${operation} form pre`)];
}

await checks({
  "every operation stands in its group, with its answers": async () => {
    const page = await open(`${url}/docs`);
    const api = await (await fetch(`${url}/openapi.json`)).json();
    const ids = Object.values(api.paths).flatMap(methods => Object.values(methods).map(one => one.operationId));
    for (const id of ids) assert.equal(await page.locator(`#routes section > details#${id} table`).count(), 1, id);
    if (shots) await page.screenshot({ path: `${shots}/docs.png` });
    assert.deepEqual(page.wrong, []);
    return `${ids.length} operations`;
  },
  "a job is sent from the page, looked at and found in the list": async () => {
    const page = await open(`${url}/docs#submitJob`);
    assert.equal(await page.getAttribute("#submitJob", "open"), "");
    const scenario = JSON.parse(await page.inputValue("#submitJob textarea"));
    await page.fill("#submitJob textarea", JSON.stringify({ ...scenario, steps: 1000, expect: undefined }));
    const [status, text] = await send(page, "submitJob");
    assert.match(status, /^202 /);
    const { id } = JSON.parse(text);
    assert.equal((await ended(url, id)).state, "succeeded");
    await page.click("#getJob > summary");
    await page.fill("#getJob input", id);
    const [found, job] = await send(page, "getJob");
    assert.match(found, /^200 /);
    assert.equal(JSON.parse(job).summary.steps, 1000);
    await page.click("#listJobs > summary");
    await page.selectOption("#listJobs select", "succeeded");
    assert.equal(JSON.parse((await send(page, "listJobs"))[1]).jobs.length, 1);
    await page.click("#getLog > summary");
    await page.fill("#getLog input", id);
    assert.match((await send(page, "getLog"))[1], /^\d+ bytes$/);
    // Events end with the job, whose end this is.
    await page.click("#followJob > summary");
    await page.fill("#followJob input", id);
    assert.match((await send(page, "followJob"))[1], /event: ?state/);
    assert.deepEqual(page.wrong, []);
  },
  "a mistake is answered at its field, and a type is a click away": async () => {
    const page = await open(`${url}/docs#submitJob`);
    await page.fill("#submitJob textarea", '{"name": "nothing"}');
    const [status, text] = await send(page, "submitJob");
    assert.match(status, /^422 /);
    assert.match(JSON.parse(text).detail, /missing field/);
    await page.click("#submitJob table a >> text=Problem");
    await page.waitForFunction(() => document.querySelector("#type-Problem").open);
    assert.match(await page.textContent("#type-Problem"), /pointer/);
    assert.deepEqual(page.wrong, []);
  },
  "with tokens it asks with the one that is given": async () => {
    const page = await open(`${guarded.url}/docs#listJobs`);
    assert.match((await send(page, "listJobs"))[0], /^401 /);
    await page.fill("#token", "a-token-of-the-tests");
    assert.match((await send(page, "listJobs"))[0], /^200 /);
    assert.deepEqual(page.wrong, []);
  },
  "on a phone nothing is wider than the page": async () => {
    const page = await open(`${url}/docs#submitJob`, { viewport: { width: 390, height: 800 } });
    assert.ok(await page.evaluate(() => document.documentElement.scrollWidth <= innerWidth));
    if (shots) await page.screenshot({ path: `${shots}/docs-phone.png` });
  },
});
await chromium.close();
await stop();
await guarded.stop();
