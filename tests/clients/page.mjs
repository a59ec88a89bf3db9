// The page as a person uses it, in a real browser.
//
//     node page.mjs [DIRECTORY]     also writes screenshots
import assert from "node:assert/strict";
import { execFile } from "node:child_process";
import { mkdtemp, readFile, readdir, rm } from "node:fs/promises";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { promisify } from "node:util";
import { browser, checks, ended, service, shipped, submit } from "./service.mjs";

const shots = process.argv[2];
const { url, stop } = await service(["--workers", "2"]);
const guarded = await service([], { VPD_TOKENS: "admin a-token-of-the-tests" });
const shown = await service(["--foxglove-listen", "127.0.0.1:0"]);
const chromium = await browser();

// A page that notes what goes wrong on it and where it turns to.
async function open(to = url, options = {}) {
  const context = await chromium.newContext({ viewport: { width: 1440, height: 1000 }, ...options });
  const page = await context.newPage();
  page.wrong = [];
  page.asked = [];
  page.on("pageerror", error => page.wrong.push(String(error)));
  page.on("console", line => line.type() === "error" && !/status of 4\d\d/.test(line.text()) && page.wrong.push(line.text()));
  page.on("request", request => page.asked.push(request.url()));
  await page.goto(`${to}/`);
  return page;
}

const state = (page, wanted) => page.waitForFunction(wanted => document.querySelector("#state")?.textContent === wanted, wanted, { timeout: 30_000 });
const shoot = async (page, name) => { if (shots) await page.screenshot({ path: `${shots}/${name}.png` }); };
const turned = page => page.evaluate(() => document.querySelector(".body").style.transform);
const long = async () => {
  const scenario = { ...await shipped(url, "dipole"), name: "long", steps: 50_000_000, log: { every: 10_000 } };
  delete scenario.expect;
  return scenario;
};

// Text whose contrast with what is behind it is below 4.5, the limit of WCAG AA.
const faint = page => page.evaluate(() => {
  const channel = x => (x /= 255) <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4;
  const light = ([r, g, b]) => 0.2126 * channel(r) + 0.7152 * channel(g) + 0.0722 * channel(b);
  const parse = color => color.match(/[\d.]+/g).map(Number);
  const behind = node => {
    for (; node; node = node.parentElement) {
      const color = parse(getComputedStyle(node).backgroundColor);
      if ((color[3] ?? 1) === 1) return color;
    }
    return [255, 255, 255];
  };
  const found = [];
  for (const node of document.querySelectorAll("body *")) {
    const own = [...node.childNodes].some(child => child.nodeType === 3 && child.textContent.trim());
    if (!own || !node.checkVisibility({ visibilityProperty: true }) || node.closest("#marks, .away, .skip, option, script, style")) continue;
    const [a, b] = [light(parse(getComputedStyle(node).color)), light(behind(node))].sort((a, b) => b - a);
    const ratio = (a + 0.05) / (b + 0.05);
    if (ratio < 4.5) found.push(`${node.tagName} ${node.className} ${ratio.toFixed(2)}: ${node.textContent.slice(0, 30)}`);
  }
  return found;
});

const page = await open();

await checks({
  "a scenario is chosen, run and watched to its end": async () => {
    await page.selectOption("#shipped", "heavy-top");
    await page.waitForFunction(() => document.querySelector("#text").value.includes("heavy-top"));
    await page.click("button[type=submit]");
    await state(page, "succeeded");
    const words = await page.textContent(".outcome");
    assert.match(words, /Done: 10,000 steps.*energy.*stayed a rotation/);
    return words;
  },
  "its charts are drawn": async () => {
    await page.waitForFunction(() => document.querySelectorAll(".charts img").length === 3);
    const widths = await page.$$eval(".charts img", images => Promise.all(images.map(async image => { await image.decode(); return image.naturalWidth; })));
    assert.deepEqual(widths, [960, 960, 960]);
  },
  "the body turns as the log says": async () => {
    await page.waitForSelector(".body .face");
    const before = await turned(page);
    await page.waitForFunction(before => document.querySelector(".body").style.transform !== before, before);
    await page.click(".play");
    const matrix = (await turned(page)).match(/-?[\d.e-]+/g).slice(1).map(Number);
    const id = page.url().split("/").at(-1);
    const time = Number((await page.textContent(".time")).match(/[\d.]+/)[0]);
    const stretch = await (await fetch(`${url}/jobs/${id}/attitudes.json?from_s=${Math.max(0, time - 0.02)}&samples=5`)).json();
    const near = g => Math.max(...[0, 1, 2].flatMap(i => [0, 1, 2].map(j => Math.abs(g[3 * i + j] - matrix[4 * j + i]))));
    const off = Math.min(...stretch.attitude.map(near));
    // A style keeps six digits.
    assert.ok(off < 2e-6, `off by ${off}`);
    return `off by ${off.toExponential(1)} at t = ${time} s`;
  },
  "the links are those of the viewers": async () => {
    const log = encodeURIComponent(`${url}/jobs/${page.url().split("/").at(-1)}/log.mcap`);
    const link = id => page.getAttribute(id, "href");
    assert.equal(await link("#open-foxglove"), `https://app.foxglove.dev/~/view?ds=remote-file&ds.url=${log}`);
    assert.equal(await link("#open-rerun"), `https://rerun.io/viewer?url=${log}`);
    assert.ok((await link("#open-lichtblick_desktop")).startsWith(`lichtblick://open?ds=remote-file&ds.url=${log}`));
    const [download] = await Promise.all([page.waitForEvent("download"), page.click("#download")]);
    assert.match(download.suggestedFilename(), /^vpd-.*\.mcap$/);
  },
  "a command is safe to paste, whatever the name of the job": async () => {
    const names = ["$(touch pwned)", "`touch pwned`; touch pwned #", "a'b\"; touch pwned; '", "-rf ../../x & touch pwned", "..", "Kreisel, schräg"];
    const shown = [];
    for (const name of names) {
      const { id } = await submit(url, { ...await shipped(url, "free-body"), name });
      await ended(url, id);
      await page.goto(`${url}/#/jobs/${id}`);
      await page.waitForFunction(id => document.querySelector(".shell pre")?.textContent.includes(id), id);
      const folder = await mkdtemp(join(tmpdir(), "vpd-shell-"));
      for (const command of await page.$$eval(".shell pre", boxes => boxes.map(box => box.textContent))) {
        const fetched = command.split("\n")[0];
        await promisify(execFile)("sh", ["-ec", fetched], { cwd: folder });
        shown.push(fetched);
      }
      const files = (await readdir(folder)).sort();
      assert.ok(files.length === 2 && files.includes("scenario.json") && files.every(file => /^\w[\w.-]*$/.test(file)), `${name}: ${files}`);
      await rm(folder, { recursive: true });
    }
    return shown[0];
  },
  "bad input is shown at its field": async () => {
    const text = await page.inputValue("#text");
    await page.fill("#text", text.replace("[0.02, 0.02, 0.01]", "[0.02, 0.02, -0.01]"));
    await page.click("button[type=submit]");
    await page.waitForSelector("#marks mark");
    assert.equal(await page.textContent("#marks mark"), "-0.01");
    const words = await page.textContent("#problem");
    assert.match(words, /^Line 5 \/scene\/inertia\/principal\/2: .*moment of inertia/);
    assert.equal(await page.getAttribute("#text", "aria-invalid"), "true");
    await shoot(page, "page-error");
    await page.fill("#text", "{");
    await page.click("button[type=submit]");
    await page.waitForFunction(() => /Rejected/.test(document.querySelector("#problem").textContent));
    return words;
  },
  "a long job is followed by its events, and cancelled": async () => {
    const { id } = await submit(url, await long());
    await page.goto(`${url}/#/jobs/${id}`);
    await state(page, "running");
    const value = () => page.evaluate(() => document.querySelector("#view progress").value);
    await page.waitForFunction(() => /left$/.test(document.querySelector("#standing").textContent));
    const before = await value();
    await page.waitForFunction(before => document.querySelector("#view progress").value > before, before);
    assert.ok(page.asked.includes(`${url}/jobs/${id}/events`));
    const words = await page.textContent("#standing");
    await page.click("#view button:text('Cancel')");
    await state(page, "cancelled");
    assert.equal((await ended(url, id)).state, "cancelled");
    return words;
  },
  "a press of a person finds its button while events arrive": async () => {
    const pressed = await open();
    const press = async selector => {
      const { x, y, width, height } = await pressed.locator(selector).boundingBox();
      await pressed.mouse.move(x + width / 2, y + height / 2);
      await pressed.mouse.down();
      await pressed.waitForTimeout(150);
      await pressed.mouse.up();
    };
    // How often the list has been told of its jobs: no press counts that no event fell into.
    const value = id => pressed.evaluate(id => document.querySelector(`#job-${id} progress`).value, id);
    const ids = [];
    for (let k = 0; k < 3; k += 1) {
      const { id } = await submit(url, await long());
      const other = await submit(url, await long());
      ids.push(id);
      await pressed.waitForFunction(ids => ids.every(id => document.querySelector(`#job-${id} progress`)?.value > 0), [id, other.id]);
      const before = await value(id);
      await press(`#job-${id} a`);
      await pressed.waitForFunction(id => location.hash.endsWith(id), id, { timeout: 2000 });
      await pressed.waitForFunction(([id, before]) => document.querySelector(`#job-${id} progress`).value > before, [id, before]);
      await press(k === 1 ? "#view button:text('Cancel')" : `#job-${id} button:text('Cancel')`);
      await state(pressed, "cancelled");
      await press(`#job-${other.id} button:text('Cancel')`);
      assert.equal((await ended(url, other.id)).state, "cancelled");
    }
    assert.deepEqual(pressed.wrong, []);
    await pressed.context().close();
    return `${3 * ids.length} presses of 150 ms`;
  },
  "a running job is linked to the live view": async () => {
    const live = await open(shown.url);
    const { id } = await submit(shown.url, await long());
    await live.goto(`${shown.url}/#/jobs/${id}`);
    await live.waitForSelector("#live-foxglove");
    const { address } = (await (await fetch(`${shown.url}/jobs/${id}`)).json()).links.live_viewers;
    assert.match(address, /^ws:\/\/127\.0\.0\.1:[1-9]\d*$/);
    assert.equal(await live.getAttribute("#live-foxglove", "href"), `https://app.foxglove.dev/~/view?ds=foxglove-websocket&ds.url=${encodeURIComponent(address)}`);
    assert.equal(await live.getAttribute("#follow", "href"), `${shown.url}/jobs/${id}/live.mcap`);
    // What is linked answers as Foxglove's server does.
    const viewer = await live.context().newPage();
    const spoken = await viewer.evaluate(address => new Promise((resolve, reject) => {
      const socket = new WebSocket(address, ["foxglove.sdk.v1"]);
      socket.onmessage = event => { resolve(JSON.parse(event.data).op); socket.close(); };
      socket.onerror = () => reject(new Error("no answer"));
    }), address);
    assert.equal(spoken, "serverInfo");
    await live.click("#view button:text('Cancel')");
    await state(live, "cancelled");
    assert.equal(await live.$("#live-foxglove"), null);
    assert.deepEqual(live.wrong, []);
    await live.context().close();
    return address;
  },
  "where the events are cut, the page asks": async () => {
    const cut = await open();
    await cut.route("**/events", route => route.abort());
    const { id } = await submit(url, await long());
    await cut.goto(`${url}/#/jobs/${id}`);
    await state(cut, "running");
    await cut.waitForFunction(() => document.querySelector("#view progress")?.value > 0);
    await cut.click("#view button:text('Cancel')");
    await state(cut, "cancelled");
    await cut.context().close();
  },
  "a failure is explained, and its advice works": async () => {
    const scenario = { ...await shipped(url, "dipole"), name: "too-large-a-step", step_s: 1.5, steps: 100, log: { every: 1 } };
    delete scenario.expect;
    const { id } = await submit(url, scenario);
    await page.goto(`${url}/#/jobs/${id}`);
    await state(page, "failed");
    const advised = (await ended(url, id)).diagnosis.advised_step_s;
    const words = await page.textContent(".diagnosis");
    assert.match(words, /Why: .*What to do: /);
    await page.click("#again");
    await page.waitForFunction(id => !location.hash.endsWith(id), id);
    await state(page, "succeeded");
    const again = await (await fetch(`${url}/jobs/${page.url().split("/").at(-1)}/scenario.json`)).json();
    assert.equal(again.step_s, advised);
    assert.ok(again.steps * advised >= scenario.steps * scenario.step_s * (1 - 1e-9), `${again.steps} steps`);
    await page.fill("#text", "");
    await page.click("#edit");
    await page.waitForFunction(() => document.querySelector("#text").value.includes("too-large-a-step"));
    return words.slice(0, 120);
  },
  "a body in four dimensions is shown by its first axes": async () => {
    const { id } = await submit(url, await shipped(url, "so4-free"));
    await page.goto(`${url}/#/jobs/${id}`);
    // The body of the job before may still be there.
    await page.waitForFunction(() => /SO\(4\)/.test(document.querySelector(".caption")?.textContent));
    await page.waitForSelector(".body .face");
  },
  "everything can be reached with the keyboard": async () => {
    const keyed = await open();
    await keyed.waitForFunction(() => document.querySelector("#text").value.length > 0);
    const reached = [];
    for (let i = 0; i < 12; i += 1) {
      await keyed.keyboard.press("Tab");
      reached.push(await keyed.evaluate(() => document.activeElement.id || document.activeElement.className || document.activeElement.textContent));
      if (reached.at(-1) === "main") break;
    }
    for (const stop of ["skip", "token-open", "shipped", "text", "main"]) assert.ok(reached.includes(stop), `${stop} of ${reached}`);
    await keyed.keyboard.press("Enter");
    await state(keyed, "succeeded");
    await keyed.focus(".stage");
    const before = await keyed.evaluate(() => document.querySelector(".space").style.transform);
    await keyed.keyboard.press("ArrowLeft");
    assert.notEqual(await keyed.evaluate(() => document.querySelector(".space").style.transform), before);
    await keyed.context().close();
    return reached.join(" → ");
  },
  "it can be read in light and dark, on a desktop and on a phone": async () => {
    const { id } = await submit(url, await shipped(url, "dipole"));
    await ended(url, id);
    const bad = [];
    for (const [name, options] of Object.entries({
      "page-light": { colorScheme: "light" },
      "page-dark": { colorScheme: "dark" },
      "page-phone": { colorScheme: "light", viewport: { width: 390, height: 844 } },
    })) {
      const look = await open(url, options);
      await look.goto(`${url}/#/jobs/${id}`);
      await look.waitForFunction(() => document.querySelectorAll(".charts img").length === 3);
      await look.waitForTimeout(700);
      bad.push(...(await faint(look)).map(text => `${name}: ${text}`));
      const over = await look.evaluate(() => document.scrollingElement.scrollWidth - innerWidth);
      assert.ok(over <= 0, `${name} is ${over} pixels too wide`);
      await shoot(look, name);
      assert.deepEqual(look.wrong, []);
      await look.context().close();
    }
    assert.deepEqual(bad, []);
  },
  "a token is asked for, kept in the tab, and sent": async () => {
    const shut = await open(guarded.url);
    await shut.waitForSelector("#token-dialog[open]");
    // An answer to what was asked before comes only when the token is given.
    const late = [];
    await shut.route("**/jobs?*", route => { late.push(route); });
    await shut.waitForRequest(/jobs\?/);
    await shut.fill("#token", "a-token-of-the-tests");
    await shut.click("#token-form .main");
    for (const route of late.splice(0)) await route.continue();
    await shut.unroute("**/jobs?*");
    await shut.waitForFunction(() => document.querySelector("#text").value.includes("heavy-top"));
    await shut.click("button[type=submit]");
    await state(shut, "succeeded");
    await shut.waitForFunction(() => document.querySelectorAll(".charts img").length === 3);
    // What the page links to and shows leads to the log, and the token is in none of it.
    assert.match(await shut.getAttribute("#open-rerun", "href"), /log\.mcap%3Fexpires%3D\d+%26signature%3D[0-9a-f]{64}$/);
    const [download] = await Promise.all([shut.waitForEvent("download"), shut.click("#download")]);
    assert.equal((await readFile(await download.path())).subarray(1, 5).toString(), "MCAP");
    assert.ok(!(await shut.content()).includes("a-token-of-the-tests"));
    assert.ok(!shut.asked.some(to => to.includes("a-token-of-the-tests")));
    for (const command of await shut.$$eval(".shell pre", shown => shown.map(node => node.textContent)))
      assert.match(command, /^curl -H "authorization: Bearer \$TOKEN" -o [\w.-]+ 'http:[^'?]*'/);
    assert.equal(await shut.evaluate(() => sessionStorage.getItem("vpd-token")), "a-token-of-the-tests");
    assert.deepEqual(shut.wrong, []);
    await shut.context().close();
  },
  "studies are drawn where the service makes them": async () => {
    const api = await (await fetch(`${url}/openapi.json`)).json();
    const study = await open();
    await study.waitForFunction(() => document.querySelector("#text").value.length > 0 && document.querySelector("#jobs li"));
    const offered = await study.isVisible("#study");
    assert.equal(offered, Boolean(api.paths["/studies"]));
    if (offered) {
      // A short one: what matters here is that it is drawn.
      await study.fill("#text", (await study.inputValue("#text")).replace('"duration_s": 20', '"duration_s": 0.4'));
      await study.selectOption("#kind", "long_term");
      await study.click("#study");
      await study.waitForFunction(() => document.querySelector("#state")?.textContent === "succeeded", null, { timeout: 120_000 });
      await study.waitForSelector(".charts img");
      await shoot(study, "page-study");
    }
    await study.context().close();
    return offered ? "offered" : "not offered, and not shown";
  },
  "a stability map is asked for and drawn, and found again": async () => {
    const study = await open();
    await study.waitForFunction(() => document.querySelector("#text").value.length > 0 && document.querySelector("#jobs li"));
    // A free body, of few methods: a small study, but a whole one.
    const scenario = await shipped(url, "free-body");
    await study.fill("#text", JSON.stringify({ ...scenario, name: "map" }));
    await study.route("**/studies", route => route.request().method() === "POST"
      ? route.continue({ postData: JSON.stringify({ ...route.request().postDataJSON(), methods: [{ name: "splitting", order: 2 }, { name: "rkmk", tableau: "rk4" }] }) })
      : route.continue());
    await study.selectOption("#kind", "stability");
    await study.click("#study");
    await study.waitForFunction(() => document.querySelector("#state")?.textContent === "succeeded", null, { timeout: 120_000 });
    await study.waitForSelector(".charts img");
    const size = await study.$eval(".charts img", async image => { await image.decode(); return [image.naturalWidth, image.naturalHeight, image.alt]; });
    assert.ok(size[0] > 500 && size[1] > 100 && /stability\.svg$/.test(size[2]), `${size}`);
    const id = study.url().split("/").at(-1);
    const map = await (await fetch(`${url}/studies/${id}/charts/stability.svg`)).text();
    assert.ok(map.includes("rkmk rk4") && (map.match(/<rect/g) ?? []).length > 40, map.slice(0, 200));
    assert.equal((await fetch(`${url}/studies/${id}/table.csv`)).status, 200);
    const again = await open();
    await again.waitForSelector(`#study-${id} .succeeded`);
    await again.click(`#study-${id} a`);
    await again.waitForSelector(".charts img");
    assert.deepEqual([...study.wrong, ...again.wrong], []);
    await study.context().close();
    await again.context().close();
    return size.join(" ");
  },
  "the description of the API is readable under its policy": async () => {
    const docs = await open();
    const answer = await docs.goto(`${url}/docs`);
    assert.match(answer.headers()["content-security-policy"], /^default-src 'none'; script-src 'sha256-[^']+'; style-src 'sha256-/);
    await docs.waitForFunction(() => document.querySelectorAll("#routes details").length > 20);
    assert.deepEqual(docs.wrong, []);
    await docs.context().close();
  },
  "it asks nobody but the service, and its policy is strict": async () => {
    const answer = await fetch(`${url}/`);
    const policy = answer.headers.get("content-security-policy");
    assert.match(policy, /^default-src 'none'; script-src 'sha256-[^']+'; style-src 'sha256-[^']+'; /);
    const elsewhere = page.asked.filter(to => !to.startsWith(url) && !/^(data|blob):/.test(to));
    assert.deepEqual(elsewhere, []);
    assert.deepEqual(page.wrong, []);
    return `${page.asked.length} requests`;
  },
});
await chromium.close();
await stop();
await guarded.stop();
await shown.stop();
