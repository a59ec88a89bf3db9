// The page as a person uses it, in a real browser.
//
//     node page.mjs [DIRECTORY]            in Chromium; also writes screenshots
//     BROWSER=firefox node page.mjs        in Firefox
import assert from "node:assert/strict";
import { execFile } from "node:child_process";
import { mkdtemp, readFile, readdir, rm } from "node:fs/promises";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { promisify } from "node:util";
import { FIREFOX, browser, checks, ended, service, shipped, submit } from "./service.mjs";

const shots = process.argv[2];
const { url, stop } = await service(["--workers", "2"]);
const guarded = await service([], { VPD_TOKENS: "admin a-token-of-the-tests" });
const shown = await service(["--foxglove-listen", "127.0.0.1:0"]);
const opened = await browser();

// How long a busy machine may take for what takes a moment: no check measures time by it.
const PATIENCE_MS = 150_000;

// A page that notes what goes wrong on it and where it turns to.
async function open(to = url, options = {}) {
  const context = await opened.newContext({ viewport: { width: 1440, height: 1000 }, ...options });
  context.setDefaultTimeout(PATIENCE_MS);
  const page = await context.newPage();
  page.wrong = [];
  page.asked = [];
  // The description of the API names no icon; Firefox asks for one, and says that it may not.
  page.on("pageerror", error => !/favicon\.ico/.test(error) && page.wrong.push(String(error)));
  page.on("console", line => line.type() === "error" && !/status of 4\d\d/.test(line.text()) && page.wrong.push(line.text()));
  page.on("request", request => page.asked.push(request.url()));
  await page.goto(`${to}/`);
  return page;
}

// Reads the text of the editor; and replaces it, as if pasted.
const written = page => page.evaluate(() => text.value);
const write = async (page, text) => {
  await page.click("#text");
  await page.keyboard.press("Control+a");
  if (!text) await page.keyboard.press("Delete");
  // Firefox takes the data by other names.
  else await page.evaluate(text => {
    const clipboardData = new DataTransfer();
    clipboardData.setData("text/plain", text);
    document.activeElement.dispatchEvent(new ClipboardEvent("paste", { clipboardData, dataType: "text/plain", data: text, bubbles: true, cancelable: true }));
  }, text);
  await page.waitForFunction(wanted => text.value === wanted, text);
};
const holds = (page, words) => page.waitForFunction(words => text.value.includes(words), words);

const state = (page, wanted) => page.waitForFunction(wanted => document.querySelector("#state")?.textContent === wanted, wanted, { timeout: PATIENCE_MS });
// Chromium draws the pictures; in Firefox the policy of the page keeps Playwright from hiding the cursor for them.
const shoot = async (page, name) => { if (shots && !FIREFOX) await page.screenshot({ path: `${shots}/${name}.png` }); };
// A press as a person makes it: down, and 150 ms later up, where the button stands still by then.
const press = (page, selector) => page.click(selector, { delay: 150 });
// The matrix that the body is painted with.
const turned = page => page.evaluate(() => stage.g.flat());
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
    if (!own || !node.checkVisibility({ visibilityProperty: true }) || node.closest(".away, .skip, option, script, style")) continue;
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
    await holds(page, "heavy-top");
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
    await page.waitForFunction(() => stage?.g);
    const before = await turned(page);
    await page.waitForFunction(before => stage.g.flat().some((x, i) => x !== before[i]), before);
    await page.click(".play");
    const matrix = await turned(page);
    const id = page.url().split("/").at(-1);
    const time = Number((await page.textContent(".time")).match(/[\d.]+/)[0]);
    const stretch = await (await fetch(`${url}/jobs/${id}/attitudes.json?from_s=${Math.max(0, time - 0.02)}&samples=5`)).json();
    const near = g => Math.max(...[0, 1, 2].flatMap(i => [0, 1, 2].map(j => Math.abs(g[3 * i + j] - matrix[3 * i + j]))));
    const off = Math.min(...stretch.attitude.map(near));
    assert.ok(off < 1e-15, `off by ${off}`);
    return `off by ${off.toExponential(1)} at t = ${time} s`;
  },
  "real time is real, and what is too fast to see is slowed": async () => {
    const body = await open();
    const shows = async (name, change = x => x) => {
      const { id } = await submit(url, change(await shipped(url, name)));
      await ended(url, id);
      await body.goto(`${url}/#/jobs/${id}`);
      await body.waitForFunction(id => stage?.g && document.querySelector("#download")?.href.includes(id), id);
      return id;
    };
    // As the pendulum turns, it can be seen.
    await shows("pendulum");
    assert.match(await body.textContent(".pace"), /^Real time: /);
    assert.equal(await body.inputValue(".rate"), "1");
    // From one picture to another, however few there are, and while nothing is fetched, for which the body waits.
    const measured = () => body.evaluate(() => new Promise(done => {
      const { onframe } = stage;
      let first;
      stage.onframe = t => {
        onframe(t);
        const now = document.timeline.currentTime;
        first = stage.busy ? undefined : first ?? { now, t: stage.t };
        if (!(first && now - first.now > 2000)) return;
        stage.onframe = onframe;
        done((stage.t - first.t) / (now - first.now) * 1000);
      };
    }));
    const real = await measured();
    assert.ok(Math.abs(real - 1) < 0.01, `${real} s in a second`);
    // 40 rad/s: more than six turns in a second.
    await shows("heavy-top");
    assert.match(await body.textContent(".pace"), /^10 times slower than real time: it turns up to 6\.4 times a second/);
    const slow = await measured();
    assert.ok(Math.abs(slow - 0.1) < 0.001, `${slow} s in a second`);
    await body.selectOption(".rate", "1");
    assert.match(await body.textContent(".pace"), /^Real time/);
    // Hours, in minutes.
    await shows("satellite");
    assert.match(await body.textContent(".pace"), /^200 times faster than real time: one turn takes 56 min or more/);
    // A top whose inertia is that of a disc has no corners.
    await shows("free-body", scenario => ({ ...scenario, name: "disc", scene: { ...scenario.scene, inertia: { principal: [1, 1, 2] } } }));
    const corners = await body.evaluate(() => [...new Set(stage.parts.flatMap(part => part.points.length > 2 ? part.points : []).map(String))].length);
    assert.ok(corners > 40, `${corners} corners`);
    await body.click(".play");
    // Nearer and farther: wheel, keys, buttons, two fingers.
    const zoom = () => body.evaluate(() => stage.zoom);
    const grows = async (act, sign) => { const before = await zoom(); await act(); const after = await zoom(); assert.ok(sign * (after - before) > 0.05, `${before} to ${after}`); };
    await body.hover(".stage");
    await grows(() => body.mouse.wheel(0, -300).then(() => body.waitForTimeout(100)), 1);
    await grows(() => body.mouse.wheel(0, 300).then(() => body.waitForTimeout(100)), -1);
    await body.focus(".stage");
    await grows(() => body.keyboard.press("+"), 1);
    await grows(() => body.keyboard.press("-"), -1);
    await grows(() => body.click(".nearer"), 1);
    await grows(() => body.evaluate(() => {
      const stage = document.querySelector(".stage");
      stage.setPointerCapture = () => {};
      const finger = (kind, pointerId, clientX) => stage.dispatchEvent(new PointerEvent(kind, { pointerId, clientX, clientY: 300, bubbles: true }));
      finger("pointerdown", 11, 700); finger("pointerdown", 12, 740); finger("pointermove", 12, 800);
      finger("pointerup", 11, 700); finger("pointerup", 12, 800);
    }), 1);
    // Trail, arrows and labels are drawn, each as long as it is wanted.
    await shows("dipole");
    await body.click(".play");
    const ink = () => body.evaluate(() => document.querySelector(".ink").toDataURL());
    let before = await ink();
    for (const box of ["trail", "velocity", "momentum", "labels"]) {
      await body.click(`.drawn input[value=${box}]`);
      const after = await ink();
      assert.notEqual(after, before, box);
      before = after;
    }
    assert.deepEqual(body.wrong, []);
    await body.context().close();
    return `${real.toFixed(3)} s in a second, slowed ${slow.toFixed(3)}`;
  },
  "a chart shows values, zooms, and follows the body": async () => {
    const chart = await open();
    const ids = [];
    for (const step_s of [0.01, 0.02]) {
      const { id } = await submit(url, { ...await shipped(url, "pendulum"), name: `pendulum-${step_s}`, step_s, expect: undefined });
      await ended(url, id);
      ids.push(id);
    }
    await chart.goto(`${url}/#/jobs/${ids[0]}`);
    await chart.waitForSelector(".plot canvas");
    await chart.click(".play");
    const words = () => chart.textContent(".readout");
    const { x, y, width, height } = await chart.locator(".plot .u-over").boundingBox();
    await chart.mouse.move(x + width / 2, y + height / 2);
    const read = await words();
    assert.match(read, /^t = (59|60)(\.\d+)? s: Energy error -?[\d.e-]+ … -?[\d.e-]+ J$/);
    // The chart says what the route says.
    const asked = chart.asked.filter(to => to.includes("/samples")).at(-1);
    const samples = await (await fetch(asked)).json();
    const k = samples.time_s.findLastIndex(t => t <= Number(read.match(/[\d.]+/)[0]));
    const said = read.match(/-?[\d.]+(e-?\d+)?(?= …)/)[0];
    assert.ok(Math.abs(Number(said) - samples.low[0][k]) <= 0.06 * Math.abs(samples.low[0][k]), `${said} is not ${samples.low[0][k]}`);
    // A drag shows a part of it, anew and finer.
    await chart.mouse.down();
    await chart.mouse.move(x + width / 2 + 100, y + height / 2, { steps: 4 });
    const finer = chart.waitForRequest(/samples.*from_s=(59|60)/);
    await chart.mouse.up();
    await finer;
    const whole = chart.waitForRequest(to => to.url().includes("/samples") && !to.url().includes("from_s"));
    await chart.click(".chart button:text('Whole')");
    await whole;
    // A click moves the body, and the line.
    const time = async () => Number((await chart.textContent(".time")).match(/[\d.]+/)[0]);
    await chart.waitForFunction(() => chart.u?.scales.x.max > 100);
    const now = await chart.locator(".plot .u-over").boundingBox();
    await chart.mouse.click(now.x + now.width / 4, now.y + now.height / 2);
    await chart.waitForFunction(() => Math.abs(Number(document.querySelector(".time").textContent.match(/[\d.]+/)[0]) - 30) < 1);
    const line = await chart.evaluate(() => new DOMMatrix(document.querySelector(".now").style.transform).m41);
    assert.ok(Math.abs(line - width / 4) < 5, `${line} of ${width}`);
    await chart.click(".play");
    await chart.waitForFunction(line => new DOMMatrix(document.querySelector(".now").style.transform).m41 > line + 2, line);
    await chart.click(".play");
    // Every quantity, and two jobs.
    const names = await chart.$$eval(".chart select[aria-label=Quantity] option", options => options.map(option => option.value));
    assert.ok(names.length === 7 && !names.includes("step"), `${names}`);
    for (const name of names) {
      const answer = chart.waitForResponse(answer => answer.url().includes(`channel=${name}`));
      await chart.selectOption(".chart select[aria-label=Quantity]", name);
      const found = await (await answer).json();
      await chart.waitForFunction(() => document.querySelector(".plot canvas"));
      assert.ok(found.low.length === (/error|drift/.test(name) ? 1 : 3) && found.time_s.length > 100, name);
    }
    await chart.focus(".plot");
    await chart.keyboard.press("ArrowRight");
    assert.match(await words(), /^t = .* s: axis 1 [\d.]+.*, axis 2 .*, axis 3 .* rad$/);
    await chart.selectOption(".chart select[aria-label=Quantity]", "energy_error");
    await chart.focus(".chart select[aria-label^=Compare]");
    await chart.selectOption(".chart select[aria-label^=Compare]", ids[1]);
    await chart.waitForSelector(".chart button:text('pendulum-0.02')");
    await chart.waitForTimeout(300);
    await chart.focus(".plot");
    await chart.keyboard.press("ArrowRight");
    const both = await words();
    assert.match(both, /pendulum-0\.01 .*, pendulum-0\.02 /);
    await shoot(chart, "page-chart");
    await chart.click(".chart button:text('pendulum-0.02')");
    // Steps that adapt are shown as well.
    const flyby = await submit(url, { ...await shipped(url, "flyby"), expect: undefined });
    await ended(url, flyby.id);
    await chart.goto(`${url}/#/jobs/${flyby.id}`);
    await chart.waitForFunction(() => document.querySelector(".chart option[value=step]"));
    await chart.selectOption(".chart select[aria-label=Quantity]", "step");
    await chart.waitForFunction(() => chart.found?.[0].channel === "step");
    const steps = await chart.evaluate(() => chart.found[0].high[0]);
    assert.ok(Math.max(...steps) > 2 * Math.min(...steps), `${Math.min(...steps)} to ${Math.max(...steps)} s`);
    // So is what a control does: its error, its commands, its wheels.
    const slew = await submit(url, { ...await shipped(url, "slew"), expect: undefined });
    await ended(url, slew.id);
    await chart.goto(`${url}/#/jobs/${slew.id}`);
    await chart.waitForFunction(() => document.querySelector(".chart option[value=pointing_error]"));
    for (const [name, count, unit] of [["pointing_error", 1, "rad"], ["control_command", 4, "N m"], ["wheel_momenta", 4, "N m s"], ["wheel_speeds", 4, "rad/s"]]) {
      await chart.selectOption(".chart select[aria-label=Quantity]", name);
      await chart.waitForFunction(name => chart.found?.[0].channel === name && document.querySelector(".plot canvas"), name);
      const found = await chart.evaluate(() => chart.found[0]);
      assert.ok(found.low.length === count && found.unit.startsWith(unit) && found.time_s.length > 100, `${name}: ${found.low.length} in ${found.unit}`);
      if (name === "pointing_error") assert.ok(found.low[0].at(-1) < 1e-3 && found.high[0][0] > 1, `from ${found.high[0][0]} to ${found.low[0].at(-1)}`);
      if (name === "wheel_momenta") assert.match(await chart.textContent(".legend"), /wheel 1.*wheel 4/);
    }
    // For a running job it shows the samples so far, and goes on.
    const { id } = await submit(url, { ...await long(), name: "grows", log: { every: 5, channels: ["/state", "/energy"] } });
    await chart.goto(`${url}/#/jobs/${id}`);
    await chart.waitForSelector(".plot canvas");
    const end = () => chart.evaluate(() => chart.found[0].time_s.at(-1));
    const before = await end();
    await chart.waitForFunction(before => chart.found[0].time_s.at(-1) > before, before);
    await chart.click("#view button:text('Cancel')");
    await state(chart, "cancelled");
    await chart.waitForSelector(".plot canvas");
    await chart.selectOption(".chart select[aria-label=Quantity]", "momentum_drift");
    await chart.waitForFunction(() => /does not hold/.test(document.querySelector(".plot").textContent));
    assert.deepEqual(chart.wrong, []);
    await chart.context().close();
    return both;
  },
  "an ensemble shows all its members, and the worst ones alone": async () => {
    const crowd = await open();
    const scenario = { ...await shipped(url, "satellite-ensemble"), expect: undefined };
    const { id } = await submit(url, scenario);
    await crowd.goto(`${url}/#/jobs/${id}`);
    await state(crowd, "succeeded");
    await crowd.waitForSelector(".members .plot canvas");
    const words = () => crowd.textContent(".members .readout");
    const column = k => crowd.$$eval(`.members tbody tr > :nth-child(${k})`, cells => cells.map(cell => cell.textContent));
    // The answers to the page after an action, and what it shows.
    const answer = async (act, ...asked) => {
      const answered = crowd.waitForResponse(answer => answer.url().includes(`${id}/members?`) && asked.every(part => answer.url().includes(part)));
      await act();
      const found = await (await answered).json();
      await crowd.waitForFunction(found => members.found && JSON.stringify(members.found) === found, JSON.stringify(found));
      return found;
    };
    const choose = (name, value, ...asked) => answer(() => crowd.selectOption(`.members [aria-label='${name}']`, value), ...asked);
    const quantity = name => choose("Quantity of the members", name, `channel=${name}`);
    const found = await quantity("axis_angle");
    assert.match(await words(), /^Angle of an axis in rad of 200 members: .* member \d+\.$/);
    const sizes = (await column(3)).map(Number);
    assert.ok(sizes.length === 10 && sizes.every((size, k) => !k || size <= sizes[k - 1]), `${sizes}`);
    assert.deepEqual(await column(1), found.rows.map(row => String(row.member)));
    // The fan says what the route says, with the mouse and with the keys.
    const { x, y, width, height } = await crowd.locator(".members .u-over").boundingBox();
    await crowd.mouse.move(x + width / 2, y + height / 2);
    const read = await words();
    assert.match(read, /^t = \d+ s: median [\d.]+, half of them [\d.]+ … [\d.]+, all [\d.]+ … [\d.]+ rad; member \d+ [\d.]+$/);
    const k = found.time_s.findLastIndex(t => t <= Number(read.match(/[\d.]+/)[0]));
    const said = read.match(/[\d.]+/g).map(Number);
    found.quantiles.filter(({ part }) => [0.25, 0.5, 0.75].includes(part)).forEach(({ part, values }) =>
      assert.ok(said.some(value => Math.abs(value - values[k]) < 1e-3 * values[k]), `${part}: ${values[k]} of ${said}`));
    await crowd.mouse.move(5, 5);
    await crowd.focus(".members .plot");
    await crowd.keyboard.press("ArrowRight");
    assert.match(await words(), /^t = /);
    // A row that is pointed at is drawn.
    const ink = () => crowd.evaluate(() => document.querySelector(".members canvas").toDataURL());
    const before = await ink();
    await crowd.hover(".members tbody tr:nth-child(5)");
    await crowd.waitForFunction(before => document.querySelector(".members canvas").toDataURL() !== before, before);
    assert.ok((await words()).includes(`member ${found.rows[4].member}.`));
    await crowd.locator(".members").scrollIntoViewIfNeeded();
    await shoot(crowd, "page-ensemble");
    // Another order, another page, another axis.
    const least = await choose("Order of the members", "smallest", "order=smallest");
    assert.ok(least.rows[0].largest < least.rows[9].largest);
    const next = await answer(() => press(crowd, ".members button:text('Next')"), "offset=10");
    assert.ok(next.rows[0].largest >= least.rows[9].largest && !next.rows.some(row => row.member === least.rows[0].member));
    const first = await choose("Axis", "1", "axis=1");
    assert.notDeepEqual(first.quantiles, least.quantiles);
    for (const name of ["distance", "angular_velocity", "orthogonality_error", "momentum_drift", "energy_error"]) {
      const answered = await quantity(name);
      assert.ok(answered.channel === name && answered.time_s.length > 60, name);
      await crowd.waitForSelector(".members .plot canvas");
    }
    // The worst one as a run of its own, once.
    const worst = await choose("Order of the members", "largest", "order=largest");
    await press(crowd, ".members tbody tr:first-child button");
    await crowd.waitForFunction(id => /jobs/.test(location.hash) && !location.hash.endsWith(id), id);
    await crowd.waitForFunction(name => document.querySelector("h1")?.textContent === name, `satellite-ensemble, member ${worst.rows[0].member}`);
    await state(crowd, "succeeded");
    const alone = crowd.url();
    const job = await (await fetch(alone.replace("#/", ""))).json();
    assert.ok(Math.abs(job.summary.energy.max_abs_error - worst.rows[0].largest) <= 1e-3 * worst.rows[0].largest, `${job.summary.energy.max_abs_error} and ${worst.rows[0].largest}`);
    await crowd.goBack();
    await crowd.waitForSelector(".members tbody button");
    await quantity("energy_error");
    await press(crowd, ".members tbody tr:first-child button");
    await crowd.waitForFunction(alone => location.href === alone, alone);
    assert.deepEqual(crowd.wrong, []);
    await crowd.context().close();
    return read;
  },
  "many jobs are found, turned over and deleted": async () => {
    const many = await service(["--workers", "2"]);
    const scenario = { ...await shipped(many.url, "free-body"), duration_s: 1, expect: undefined };
    const ids = [];
    for (let k = 0; k < 65; k += 1) ids.push((await submit(many.url, { ...scenario, name: k % 3 ? `spin ${k}` : `Other ${k}` })).id);
    for (const id of ids) await ended(many.url, id);
    const list = await open(many.url);
    const names = () => list.$$eval("#jobs li a", links => links.map(link => link.textContent));
    const showing = (count, first) => list.waitForFunction(([count, first]) => {
      const links = [...document.querySelectorAll("#jobs li a")];
      return links.length === count && (!first || links[0].textContent === first);
    }, [count, first]);
    await showing(20, "spin 64");
    await list.click("#older");
    await showing(20, "spin 44");
    assert.equal(await list.textContent("#page-number"), "Page 2");
    await list.click("#newer");
    await showing(20, "spin 64");
    await list.fill("#find", "OTHER");
    await showing(20, "Other 63");
    await list.click("#older");
    await showing(2, "Other 3");
    assert.match(await list.textContent("#jobs li:first-child"), /\d\d:\d\d/);
    const day = past => { const at = new Date(Date.now() - past * 864e5); return [at.getFullYear(), at.getMonth() + 1, at.getDate()].map(x => String(x).padStart(2, "0")).join("-"); };
    await list.fill("#find-until", day(1));
    await list.waitForFunction(() => document.querySelector("#jobs").textContent === "No job matches.");
    await list.fill("#find-until", day(0));
    await showing(20, "Other 63");
    await list.fill("#find-from", day(0));
    await list.waitForTimeout(300);
    await showing(20, "Other 63");
    await list.fill("#find-until", "");
    await list.fill("#find-from", day(-1));
    await list.waitForFunction(() => document.querySelector("#jobs").textContent === "No job matches.");
    await list.fill("#find-from", "");
    await showing(20, "Other 63");
    await list.selectOption("#find-state", "failed");
    await list.waitForFunction(() => document.querySelector("#jobs").textContent === "No job matches.");
    await list.selectOption("#find-state", "succeeded");
    await showing(20, "Other 63");
    await list.click("#job-" + ids[63] + " a");
    await list.waitForFunction(() => document.title === "Other 63: succeeded – vpd");
    await list.click("#choose");
    await list.check(`#job-${ids[63]} input`);
    assert.equal(await list.textContent("#delete-chosen"), "Delete 1 job");
    await list.click("#choose-all");
    await list.waitForFunction(() => document.querySelector("#delete-chosen").textContent === "Delete 22 jobs");
    const asked = [];
    list.on("dialog", dialog => { asked.push(dialog.message()); return asked.length === 1 ? dialog.dismiss() : dialog.accept(); });
    await list.click("#delete-chosen");
    await showing(20, "Other 63");
    await list.click("#delete-chosen");
    await list.waitForFunction(() => document.querySelector("#jobs").textContent === "No job matches.");
    assert.deepEqual(asked, Array(2).fill("Delete 22 jobs and their logs? This cannot be undone."));
    await list.fill("#find", "");
    await showing(20, "spin 64");
    const left = (await (await fetch(`${many.url}/jobs?limit=500`)).json()).jobs;
    assert.ok(left.length === 43 && left.every(job => job.name.startsWith("spin")), `${left.length} left`);
    assert.equal(await list.title(), "vpd");
    assert.deepEqual(list.wrong, []);
    await list.context().close();
    await many.stop();
    return `${asked.length} questions`;
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
  "what the page says of a job is true": async () => {
    const told = await open(url, { viewport: { width: 360, height: 780 } });
    const show = async scenario => {
      const { id } = await submit(url, { ...scenario, expect: undefined });
      await ended(url, id);
      await told.goto(`${url}/#/jobs/${id}`);
      await told.waitForFunction(id => stage?.g && document.querySelector("#download")?.href.includes(id), id);
      return told.textContent(".outcome");
    };
    const labels = () => told.evaluate(() => stage.labels.flatMap(label => label.texts));
    // The energy of a damped body falls; what is constant is its balance.
    const damped = await shipped(url, "dual-spin");
    const words = await show({ ...damped, log: { every: 5, channels: ["/state", "/energy", "/tf", "/scene/body"] } });
    const [, first, last, least, largest] = words.match(/The energy was (\S+) J at the start and (\S+) J at the end, between (\S+) J and (\S+) J\. Its balance, the energy less the work of the torques, is constant to \S+ J\./).map(Number);
    assert.ok(least <= last && last < first && first <= largest, words);
    assert.ok(!/no method is symplectic/.test(await told.textContent("#view")));
    // Charts that are not there are not asked for, and the page says why.
    const pictures = await told.$$eval(".charts > *", nodes => nodes.map(node => node.alt ?? node.textContent));
    assert.deepEqual(pictures, ["Energy error over time", "Orthogonality error over time: not drawn, because /orthogonality is not logged.",
      "Drift of the conserved momentum over time: not drawn, because /momentum is not logged."]);
    assert.ok(!told.asked.some(to => /orthogonality\.svg|momentum\.svg/.test(to)));
    assert.ok(!(await labels()).includes("fixed point"));
    // No figure is broken over lines, and its unit stays with it.
    const broken = await told.$$eval(".outcome .whole, dd .whole, .readout .whole", parts => parts.filter(part => part.getClientRects().length > 1).map(part => part.textContent));
    assert.deepEqual(broken, []);
    assert.ok(await told.evaluate(() => document.scrollingElement.scrollWidth <= innerWidth));
    // Labels stand at what they name, in the length of the drawing.
    await show(await shipped(url, "heavy-top"));
    const named = await told.evaluate(() => {
      const ball = stage.parts.find(part => part.frame === "body" && part.radius !== undefined).points[0];
      const weight = stage.labels.find(label => /weight/.test(label.texts));
      return Math.max(...ball.map((x, i) => Math.abs(x - weight.at[i])));
    });
    assert.ok(named < 1e-6, `${named}`);
    const top = await labels();
    for (const label of ["fixed point", "up", "x", "y", "z"]) assert.ok(top.includes(label), `${label} of ${top}`);
    // What moves is drawn where it is: the vertical of the satellite goes round with its orbit.
    await show(await shipped(url, "satellite"));
    await told.click(".play");
    const vertical = async t => {
      await told.evaluate(t => stage.go(t), t);
      return told.evaluate(() => stage.place("source/0", [1, 0, 0], stage.now(stage.index())));
    };
    const turn = 2 * Math.PI / 0.001107549848;
    const near = (a, b) => assert.ok(Math.max(...a.map((x, i) => Math.abs(x - b[i]))) < 0.02, `${a} and ${b}`);
    near(await vertical(0), [0, 0, 1]);
    near(await vertical(turn / 4), [0, -1, 0]);
    assert.match(await told.textContent(".time"), /^t = 23 min \d+ s$/);
    assert.ok((await told.$$eval(".rate option", options => options.map(option => option.textContent))).includes("3000 (all in 20 s)"));
    assert.deepEqual(told.wrong, []);
    await told.context().close();
    return words;
  },
  "several bodies stand and turn as the log says, and their joints are closed": async () => {
    const scene = await open();
    const show = async name => {
      const { id } = await submit(url, { ...await shipped(url, name), expect: undefined });
      await ended(url, id);
      await scene.goto(`${url}/#/jobs/${id}`);
      await scene.waitForFunction(id => stage?.g && document.querySelector("#download")?.href.includes(id), id);
      await scene.evaluate(() => stage.run(false));
      return id;
    };
    const id = await show("chain");
    const joints = (await shipped(url, "chain")).scene.joints;
    const names = ["upper", "middle", "lower"];
    assert.deepEqual(await scene.$$eval(".which option", options => options.map(option => option.textContent)), ["All bodies", ...names]);
    let [off, open_px] = [0, 0];
    // At samples of the log, and between two of them.
    for (const t of [0.3, 2, 2.0037, 7.5, 7.5061]) {
      await scene.evaluate(t => stage.go(t), t);
      const drawn = await scene.evaluate(joints => {
        const poses = stage.poses(stage.index()), { spot } = stage.camera(poses);
        const spots = joints.map(({ between, points }) => between.map((name, k) => spot(stage.place(name, points[k], poses))));
        const pen = stage.ink.getContext("2d"), dense = devicePixelRatio;
        const inked = spots.map(([[x, y]]) => pen.getImageData(Math.round(x * dense), Math.round(y * dense), 1, 1).data[3] > 0);
        return { time: stage.times[stage.index()], poses: [...poses], spots, inked };
      }, joints);
      for (const [[x, y], [u, v]] of drawn.spots) open_px = Math.max(open_px, Math.abs(x - u), Math.abs(y - v));
      assert.deepEqual(drawn.inked, [true, true, true]);
      const { time_s, bodies } = await (await fetch(`${url}/jobs/${id}/attitudes.json?from_s=${drawn.time - 0.005}&samples=1`)).json();
      assert.deepEqual([time_s[0], bodies.map(body => body.name), drawn.poses.map(([name]) => name)], [drawn.time, names, names]);
      const between = t > drawn.time + 1e-9;
      drawn.poses.forEach(([, { g, x }], k) => {
        const far = (a, b) => Math.max(...a.map((value, i) => Math.abs(value - b[i])));
        const moved = Math.max(far(g.flat(), bodies[k].attitude[0]), far(x, bodies[k].position[0]));
        if (between) assert.ok(moved > 1e-4 && moved < 0.2, `${moved}`);
        else off = Math.max(off, moved);
      });
    }
    assert.ok(off < 1e-14, `off by ${off}`);
    assert.ok(open_px < 0.1, `open by ${open_px} pixels`);
    await shoot(scene, "page-bodies");
    // One of them is followed: it stands in the middle, with its own arrows.
    assert.ok(!await scene.isVisible(".drawn input[value=velocity]"));
    await scene.selectOption(".which", { label: "lower" });
    const middle = () => scene.evaluate(() => { const poses = stage.poses(stage.index()), { spot, width, height } = stage.camera(poses); return Math.hypot(...spot(poses.get("lower").x).map((x, i) => x - [width, height][i] / 2)); });
    assert.ok(await middle() < 1e-9);
    assert.ok(await scene.isVisible(".drawn input[value=velocity]"));
    const before = await turned(scene);
    await scene.click(".play");
    await scene.waitForFunction(before => stage.g.flat().some((x, i) => x !== before[i]), before);
    await scene.click(".play");
    // The charts are those of all bodies.
    assert.deepEqual(await scene.$$eval(".chart select[aria-label=Quantity] option", options => options.map(option => option.value)), ["energy_error", "orthogonality_error", "momentum_drift", "spatial_momentum"]);
    // What flies free stays in sight; what is too small to be seen is drawn larger, and said to be; errors of 1e-22 J have an axis.
    for (const name of ["tether", "orbit-and-attitude", "binary-asteroid"]) {
      await show(name);
      for (const part of [0.2, 0.9]) {
        await scene.evaluate(part => stage.go(part * stage.end), part);
        const out = await scene.evaluate(() => { const poses = stage.poses(stage.index()), { spot, width, height } = stage.camera(poses);
          return [...poses].filter(([, { x }]) => { const [left, top] = spot(x); return !(left > 0 && left < width && top > 0 && top < height); }).map(([name]) => name); });
        assert.deepEqual(out, [], name);
      }
      const words = await scene.textContent(".caption");
      assert.match(words, name === "orbit-and-attitude" ? /^Drawn larger than to scale, to be seen: dumbbell [\d.]+ times\.$/ : /^$/);
      await scene.waitForSelector(".plot canvas");
    }
    // While a job runs its beginning is played.
    const runs = { ...await shipped(url, "chain"), name: "long chain", expect: undefined, duration_s: 100_000 };
    const long = await submit(url, runs);
    await scene.goto(`${url}/#/jobs/${long.id}`);
    await scene.waitForFunction(() => stage?.g && stage.tracks.length === 3 && document.querySelector("#state").textContent === "running");
    await press(scene, "#view button:text('Cancel')");
    await state(scene, "cancelled");
    assert.deepEqual(scene.wrong, []);
    await scene.context().close();
    return `off by ${off.toExponential(1)}, joints open by ${open_px.toExponential(1)} pixels`;
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
    await holds(page, "heavy-top");
    const text = await written(page);
    await write(page, text.replace("[0.02, 0.02, 0.01]", "[0.02, 0.02, -0.01]"));
    await press(page, "button[type=submit]");
    await page.waitForSelector(".cm-lintRange-error");
    assert.equal(await page.textContent(".cm-lintRange-error"), "-0.01");
    const words = await page.textContent("#problem");
    assert.match(words, /^Line 5 \/scene\/inertia\/principal\/2: .*moment of inertia/);
    assert.equal(await page.getAttribute("#text", "aria-invalid"), "true");
    await shoot(page, "page-error");
    await write(page, "{");
    // A message about an unfinished text, now and once it is checked, does not move the button away
    // from a press.
    const top = () => page.$eval("button[type=submit]", button => button.getBoundingClientRect().top + scrollY);
    const before = await top();
    await page.waitForSelector("#check:not(:empty)");
    assert.equal(await top(), before);
    await press(page, "button[type=submit]");
    await page.waitForFunction(() => /Rejected/.test(document.querySelector("#problem").textContent));
    return words;
  },
  "the editor knows the schema": async () => {
    const editor = await open();
    await holds(editor, "heavy-top");
    const line = words => editor.locator(".cm-line", { hasText: words });
    const popup = ".cm-tooltip-autocomplete";
    const offered = () => editor.$$eval(".cm-tooltip-autocomplete li .cm-completionLabel", labels => labels.map(label => label.textContent));
    // No line is cut off: long ones go on below.
    assert.ok(await editor.evaluate(() => { const { scrollWidth, clientWidth } = document.querySelector(".cm-scroller"); return scrollWidth <= clientWidth; }));
    // Fields that are not there yet are completed, with what they need.
    await editor.click("#text");
    await editor.keyboard.press("Control+Home");
    await editor.keyboard.press("End");
    await editor.keyboard.press("Enter");
    await editor.keyboard.type('"');
    await editor.waitForSelector(popup);
    const fields = await offered();
    await editor.waitForSelector(".cm-completionInfo");
    await shoot(editor, "page-editor");
    assert.ok(fields.includes('"ensemble"') && fields.includes('"accuracy"') && !fields.includes('"name"'), `${fields}`);
    await editor.keyboard.type("ens");
    await editor.waitForFunction(() => document.querySelectorAll(".cm-tooltip-autocomplete li").length === 1);
    assert.match(await editor.textContent(".cm-completionInfo"), /Many runs of the scene/);
    await editor.keyboard.press("Enter");
    await holds(editor, '{\n  "ensemble": { "members": 0 },\n  "name"');
    // The number is chosen, to be written over; what the field means stands below.
    await editor.keyboard.type("20");
    await editor.waitForFunction(() => /^members integer.*Number of members, 2 to 100,000/s.test(document.querySelector("#field").textContent));
    // What is typed over a selection, too, makes the browser complain of nothing: see the end of this check.
    await editor.keyboard.press("Shift+ArrowUp");
    await editor.keyboard.press("Shift+ArrowUp");
    await editor.keyboard.type("x");
    await editor.keyboard.press("Control+z");
    await holds(editor, '"ensemble": { "members": 20');
    // Values that are words.
    await line('"method"').click();
    const method = /"name": "vpd"/.exec(await written(editor)).index + 9;
    await editor.evaluate(at => view.dispatch({ selection: { anchor: at } }), method);
    await editor.keyboard.press("Control+ ");
    await editor.waitForSelector(popup);
    assert.ok((await offered()).includes('"splitting"'));
    await editor.keyboard.press("Escape");
    await editor.waitForSelector(popup, { state: "detached" });
    // The meaning of a field is shown at the mouse.
    await editor.hover(".cm-line .key:text('\"step_s\"')");
    await editor.waitForSelector(".hint");
    assert.match(await editor.textContent(".hint"), /^step_s number.*The step in seconds; either this or `accuracy`/s);
    await editor.mouse.move(5, 5);
    // Errors are marked without asking the service: a word, a missing field, a type, and text that
    // is no JSON.
    const good = await written(editor);
    const marked = async (text, mark, words) => {
      await write(editor, text);
      await editor.waitForFunction(([mark, words]) => document.querySelector(".cm-lintRange-error")?.textContent === mark && document.querySelector("#check").textContent.includes(words), [mark, words]);
    };
    await marked(good.replace('"step_s"', '"stride"'), '"stride"', '"stride" is not known here; expected one of $schema, format,');
    await marked(good.replace('"weight": 4.905, ', ""), "{", 'needs "weight"');
    await marked(good.replace('"members": 20', '"members": "many"'), '"many"', '"members" is a string, expected an integer');
    await marked(good.replace('"vpd"', '"vpq"'), '"vpq"', '"vpq" is not one of auto');
    await marked(good.replace('"step_s": ', '"step_s" '), "0.002", "This is not valid JSON yet");
    // The keys go there.
    await editor.keyboard.press("Control+Home");
    await editor.keyboard.press("F8");
    assert.equal(await editor.evaluate(() => view.state.sliceDoc(view.state.selection.main.from, view.state.selection.main.to)), "0.002");
    await write(editor, good);
    await editor.waitForFunction(() => !document.querySelector(".cm-lintRange-error"));
    // Every shipped scenario is without fault, and one may name its schema.
    const { scenarios } = await (await fetch(`${url}/scenarios`)).json();
    for (const { name } of scenarios) assert.deepEqual(await editor.evaluate(async name => mistakes(await (await fetch(`scenarios/${name}`)).text()), name), [], name);
    await write(editor, (await (await fetch(`${url}/scenarios/free-body`)).text()).replace("{", '{ "$schema": "scenario.schema.json",'));
    await editor.keyboard.press("Control+Enter");
    await state(editor, "succeeded");
    // Tab leaves it, as it leaves any field.
    await editor.focus("#text");
    await editor.keyboard.press("Tab");
    assert.notEqual(await editor.evaluate(() => document.activeElement.id), "text");
    assert.deepEqual(editor.wrong, []);
    await editor.context().close();
    return `${fields.length} fields offered`;
  },
  "what is written is not lost": async () => {
    const own = await open();
    const value = () => written(own);
    await holds(own, "heavy-top");
    const shippedText = await value();
    // An example that was not changed is replaced without a message.
    await own.selectOption("#shipped", "pendulum");
    await holds(own, "pendulum");
    assert.ok(!await own.isVisible("#replaced"));
    await write(own, (await value()).replace('"pendulum"', '"mine"'));
    await own.selectOption("#shipped", "dipole");
    await holds(own, "Dipole on a stick");
    assert.match(await own.textContent("#replaced"), /replaced by dipole/);
    await own.click("#undo");
    assert.match(await value(), /"mine"/);
    assert.ok(!await own.isVisible("#replaced"));
    // The keys go the same way back and forth, over typing too.
    await own.selectOption("#shipped", "dipole");
    await holds(own, "Dipole on a stick");
    await own.focus("#text");
    await own.keyboard.press("Control+z");
    assert.match(await value(), /"mine"/);
    await own.keyboard.press("Control+Shift+Z");
    assert.match(await value(), /Dipole on a stick/);
    await own.keyboard.press("Control+y");
    for (let k = 0; k < 3; k += 1) await own.keyboard.press("Control+z");
    assert.equal(await value(), shippedText);
    for (let k = 0; k < 9; k += 1) await own.keyboard.press("Control+Shift+Z");
    await own.keyboard.press("Control+z");
    await own.reload();
    await holds(own, '"mine"');
    // A second tab begins with it, and keeps its own.
    const second = await own.context().newPage();
    await second.goto(`${url}/`);
    await holds(second, '"mine"');
    await write(second, (await written(second)).replace('"mine"', '"theirs"'));
    await own.reload();
    await holds(own, '"mine"');
    await second.reload();
    await holds(second, '"theirs"');
    assert.deepEqual(own.wrong, []);
    await own.context().close();
  },
  "the short form and the text say the same": async () => {
    const form = await open();
    await holds(form, "heavy-top");
    const before = await written(form);
    const text = () => written(form);
    assert.deepEqual([await form.inputValue("#method"), await form.inputValue("#scheme"), await form.inputValue("#by-value"), await form.inputValue("#long-value")],
      ["vpd", "gauss3", "0.002", "20"]);
    await form.fill("#by-value", "1e-3");
    await form.selectOption("#scheme", "gauss4");
    // Nothing else of the text has changed.
    assert.equal(await text(), before.replace('"step_s": 0.002', '"step_s": 1e-3').replace("gauss3", "gauss4"));
    await form.selectOption("#method", "splitting");
    assert.match(await text(), /"method": \{ "name": "splitting" \},\n/);
    await form.selectOption("#scheme", "6");
    assert.match(await text(), /"method": \{ "name": "splitting", "order": 6 \},\n/);
    await form.selectOption("#long", "steps");
    await form.fill("#long-value", "2000");
    assert.match(await text(), /\n {2}"steps": 2000,\n/);
    await form.click("#channels-word");
    await form.uncheck("#channels input[value='/solver']");
    assert.match(await text(), /"log": \{ "every": 10, "channels": \["\/state", .*\] \}/);
    await form.check("#channels input[value='/solver']");
    assert.match(await text(), /"log": \{ "every": 10 \},/);
    // The other way round, and not while the text is no JSON.
    await write(form, (await text()).replace('"steps": 2000', '"steps": 3000').replace("splitting", "lgvi"));
    assert.deepEqual([await form.inputValue("#long-value"), await form.inputValue("#method")], ["3000", "lgvi"]);
    await write(form, "{");
    assert.ok(await form.isDisabled("#method"));
    await form.focus("#text");
    await form.keyboard.press("Control+z");
    assert.ok(await form.isEnabled("#method"));
    await form.selectOption("#by", "accuracy");
    assert.match(await text(), /\n {2}"accuracy": \{ "error": 0.000001 \},\n {2}"duration_s": 3,\n/);
    await form.fill("#by-value", "1e-4");
    await form.focus("#text");
    await form.keyboard.press("Control+Enter");
    await state(form, "succeeded");
    // The text that was sent comes back unchanged.
    const sent = await text();
    await form.selectOption("#shipped", "pendulum");
    await holds(form, "pendulum");
    await form.click("#edit");
    await form.waitForFunction(sent => text.value === sent, sent);
    assert.deepEqual(form.wrong, []);
    await form.context().close();
    return sent.match(/"accuracy".*/)[0];
  },
  "the address of a draft brings its text": async () => {
    const from = await open();
    if (!FIREFOX) await from.context().grantPermissions(["clipboard-read", "clipboard-write"]);
    await holds(from, "heavy-top");
    const text = (await written(from)).replace('"heavy-top"', '"Kreisel, schräg"');
    await write(from, text);
    await from.click("#share");
    await from.waitForFunction(() => document.querySelector("#share").textContent === "Copied");
    // Firefox does not let a page read the clipboard.
    const link = await from.evaluate(firefox => firefox ? shareLink() : navigator.clipboard.readText(), FIREFOX);
    assert.ok(link.startsWith(`${url}/#/draft/`) && /^[\w-]+$/.test(link.split("/").at(-1)), link);
    const to = await open();
    await to.goto(link);
    await to.waitForFunction(wanted => text.value === wanted, text);
    await write(to, text.replace("schräg", "steil"));
    await to.goto(link);
    await to.waitForFunction(wanted => text.value === wanted, text);
    await to.click("#undo");
    assert.match(await written(to), /steil/);
    assert.deepEqual([...from.wrong, ...to.wrong], []);
    await from.context().close();
    await to.context().close();
    return `${link.length} characters`;
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
    // Rows come when the pointer is not over the list.
    const away = () => pressed.mouse.move(2, 2);
    // How often the list has heard of its jobs: no press counts that no event fell into.
    const value = id => pressed.evaluate(id => document.querySelector(`#job-${id} progress`).value, id);
    const ids = [];
    for (let k = 0; k < 3; k += 1) {
      const { id } = await submit(url, await long());
      const other = await submit(url, await long());
      ids.push(id);
      await away();
      await pressed.waitForFunction(ids => ids.every(id => document.querySelector(`#job-${id} progress`)?.value > 0), [id, other.id]);
      const before = await value(id);
      await press(pressed, `#job-${id} a`);
      await pressed.waitForFunction(id => location.hash.endsWith(id), id);
      await pressed.waitForFunction(([id, before]) => document.querySelector(`#job-${id} progress`).value > before, [id, before]);
      await press(pressed, k === 1 ? "#view button:text('Cancel')" : `#job-${id} button:text('Cancel')`);
      await state(pressed, "cancelled");
      await press(pressed, `#job-${other.id} button:text('Cancel')`);
      await away();
      assert.equal((await ended(url, other.id)).state, "cancelled");
    }
    assert.deepEqual(pressed.wrong, []);
    await pressed.context().close();
    return `${3 * ids.length} presses of 150 ms`;
  },
  "eight windows on six active jobs hold one stream, and each press is answered": async () => {
    const many = await service(["--workers", "2"]);
    const context = await opened.newContext({ viewport: { width: 1440, height: 1000 } });
    context.setDefaultTimeout(PATIENCE_MS);
    const scenario = await long();
    const ids = [];
    for (let k = 0; k < 6; k += 1) ids.push((await submit(many.url, { ...scenario, name: `long ${k}` })).id);
    const streams = new Set();
    const windows = [];
    for (let k = 0; k < 8; k += 1) {
      const window = await context.newPage();
      window.on("request", request => { if (request.url().endsWith("/events")) streams.add(request); });
      for (const end of ["requestfinished", "requestfailed"]) window.on(end, request => streams.delete(request));
      await window.goto(`${many.url}/#/jobs/${ids[k % 6]}`);
      await state(window, k % 6 < 2 ? "running" : "queued");
      windows.push(window);
    }
    // Those of the jobs that run go on to show how far these are; one that waits says for how many.
    assert.match(await windows[5].textContent("#standing"), /^waiting: 3 before it$/);
    for (const window of windows.filter((_, k) => k % 6 < 2)) {
      const value = await window.$eval("#view progress", bar => bar.value);
      await window.waitForFunction(value => document.querySelector("#view progress").value > value, value);
    }
    assert.equal(streams.size, 1, [...streams].map(request => request.url()).join(" "));
    // A window that nobody sees holds none.
    const hidden = (window, is) => window.evaluate(is => {
      Object.defineProperty(document, "hidden", { value: is, configurable: true });
      document.dispatchEvent(new Event("visibilitychange"));
    }, is);
    const [holder] = [...streams].map(request => windows.findIndex(window => window === request.frame().page()));
    await hidden(windows[holder], true);
    for (let k = 0; k < 100 && [...streams].some(request => request.frame().page() === windows[holder]); k += 1) await windows[0].waitForTimeout(100);
    assert.ok(![...streams].some(request => request.frame().page() === windows[holder]));
    await hidden(windows[holder], false);
    const times = [];
    for (const [k, window] of windows.entries()) {
      // A person presses in the window in front; the browser draws the others seldom.
      await window.bringToFront();
      if (k >= 6) {
        await window.selectOption("#shipped", "free-body");
        await holds(window, '"free-body"');
      }
      const [button, path] = k < 6 ? ["#view button:text('Cancel')", `/jobs/${ids[k]}/cancel`] : ["#run", "/jobs"];
      // From the click to the answer, as the browser notes it: an observer hears of each answer, also where a window has had
      // more of them than the browser keeps.
      await window.evaluate(url => {
        window.answered = new Promise(done => {
          let pressed = Infinity;
          addEventListener("click", () => { pressed = performance.now(); }, { capture: true, once: true });
          new PerformanceObserver(list => {
            const last = list.getEntriesByName(url).find(entry => entry.startTime >= pressed);
            if (last) done(last.responseEnd - pressed);
          }).observe({ type: "resource" });
        });
      }, many.url + path);
      const answer = window.waitForResponse(answer => answer.request().method() === "POST" && answer.url().endsWith(path));
      await press(window, button);
      assert.ok((await answer).ok());
      times.push(Math.round(await window.evaluate(() => window.answered)));
    }
    for (const id of ids) assert.equal((await ended(many.url, id)).state, "cancelled");
    await context.close();
    await many.stop();
    return `answered after ${times.join(", ")} ms`;
  },
  "a button that waits says so, is pressed once, and gives up": async () => {
    const waits = await open();
    await holds(waits, "heavy-top");
    await write(waits, JSON.stringify({ ...await shipped(url, "free-body"), name: `once ${Date.now()}`, expect: undefined }));
    const posts = [];
    waits.on("request", request => { if (request.method() === "POST" && request.url().endsWith("/jobs")) posts.push(request.headers()["idempotency-key"]); });
    const named = async () => (await (await fetch(`${url}/jobs?name=once`)).json()).jobs.length;
    // Both clicks of a double click, however slow this machine is; whether it says at once that it waits.
    const twice = () => waits.evaluate(() => { $("run").click(); $("run").click(); return $("run").ariaBusy; });
    assert.equal(await twice(), "true");
    await state(waits, "succeeded");
    await waits.waitForSelector("#run:not([aria-busy])");
    assert.equal(posts.length, 1);
    assert.equal(await named(), 1);
    // The service takes the job, and its answer does not come. It is asked from here: what Playwright 1.64 sends on
    // for a page of Firefox 153 that has given up was seen not to end.
    const more = (await written(waits)).replace("once", "once more");
    let taken;
    await waits.route(/\/jobs$/, async route => {
      const { "content-type": type, "idempotency-key": key } = route.request().headers();
      taken = fetch(`${url}/jobs`, { method: "POST", headers: { "content-type": type, "idempotency-key": key }, body: more, signal: AbortSignal.timeout(10_000) });
      await taken;
    });
    await write(waits, more);
    await waits.waitForTimeout(700);
    assert.equal(await twice(), "true");
    await waits.waitForFunction(() => /has not answered within 10 s/.test(document.querySelector("#problem").textContent));
    assert.equal((await taken).status, 202);
    await waits.unroute(/\/jobs$/);
    await waits.waitForSelector("#run:not([aria-busy])");
    await waits.waitForTimeout(700);
    await press(waits, "#run");
    await state(waits, "succeeded");
    assert.ok(posts.length === 3 && posts[1] === posts[2] && posts[0] !== posts[1], `${posts}`);
    assert.equal(await named(), 2);
    // So does a button of a list, and what went wrong is shown.
    const { id } = await submit(url, await long());
    await waits.mouse.move(2, 2);
    await waits.waitForSelector(`#job-${id} .running`);
    await waits.route(/cancel$/, route => route.abort());
    await press(waits, `#job-${id} button:text('Cancel')`);
    await waits.waitForSelector("#news.wrong");
    assert.match(await waits.textContent("#news"), /cannot be reached/);
    await waits.unroute(/cancel$/);
    await waits.waitForTimeout(700);
    await press(waits, `#job-${id} button:text('Cancel')`);
    assert.equal((await ended(url, id)).state, "cancelled");
    await waits.context().close();
    return `${posts.length} requests`;
  },
  "no press is lost while jobs come, go and end": async () => {
    const many = await service(["--workers", "2"]);
    const scenario = { ...await shipped(many.url, "free-body"), expect: undefined };
    const slow = { ...await long(), log: { every: 10_000, channels: ["/state"] } };
    let going = true, posted = 0;
    const load = (async () => {
      for (let k = 0; going; k += 1) {
        const { id } = await submit(many.url, k % 4 ? { ...scenario, name: `spin ${k}`, duration_s: 1 + 400 * (k % 3) } : { ...slow, name: `long ${k}` });
        posted += 1;
        if (k % 4 === 0) setTimeout(() => fetch(`${many.url}/jobs/${id}/cancel`, { method: "POST" }).catch(() => {}), 1500);
        await new Promise(later => setTimeout(later, 300));
      }
    })();
    const presses = Number(process.env.PRESSES ?? 20), wrong = [];
    let cancels = 0, waited = 0;
    try {
      const list = await open(many.url);
      await list.waitForFunction(() => document.querySelectorAll("#jobs li a").length > 8);
      // The same presses each time.
      let seed = 7;
      const random = () => { seed = (seed * 16807) % 2147483647; return seed / 2147483647; };
      const cancelled = new Set();
      list.on("request", request => { if (request.url().endsWith("/cancel")) cancelled.add(request.url().split("/").at(-2)); });
      const hash = () => list.evaluate(() => location.hash);
      for (let k = 0; k < presses;) {
        const before = await hash();
        // Every third press is one of a Cancel, if there is one.
        const rows = await list.$$eval("#jobs li", (rows, before) => rows.map(row => row.id.slice(4)).filter(id => !before.endsWith(id)), before);
        const active = await list.$$eval("#jobs li:has(progress:not([hidden])):has(button:enabled:not([hidden]))", rows => rows.map(row => row.id.slice(4)));
        const stop = k % 3 === 2 && active.length > 0, among = stop ? active : rows;
        const id = among[Math.floor(random() * among.length)];
        const button = list.locator(`#job-${id} button:text('Cancel')`);
        const target = stop ? button : list.locator(`#job-${id} a`);
        // A person scrolls to the row and comes to it. Rows move until the pointer is over the list; one may have left it.
        if (!await target.hover({ timeout: 1000 }).then(() => true, () => false)) continue;
        const { x, y, width, height } = await target.boundingBox();
        const at = [x + Math.min(20, width / 2), y + height / 2];
        await list.mouse.move(...at);
        waited += await list.isVisible("#jobs-new");
        await list.mouse.down();
        // From here on nothing changes; the job may have ended before.
        const off = stop && await button.isDisabled();
        await list.waitForTimeout(120 + Math.round(1380 * random()));
        // No hand is still.
        await list.mouse.move(at[0] + 3, at[1] + 2, { steps: 3 });
        await list.mouse.up();
        if (off) { await list.mouse.move(2, 2); continue; }
        k += 1;
        if (stop) {
          cancels += 1;
          for (let wait = 0; wait < 1000 && !cancelled.has(id); wait += 1) await list.waitForTimeout(20);
          if (!cancelled.has(id)) wrong.push(`${k}: cancel of ${id} was lost`);
          if (await hash() !== before) wrong.push(`${k}: cancel of ${id} opened ${await hash()}`);
        } else if (!await list.waitForFunction(id => location.hash.endsWith(id), id, { timeout: 20_000 }).catch(() => null))
          wrong.push(`${k}: ${id} was pressed, ${await hash()} came`);
        if (k % 2) { await list.mouse.move(2, 2); await list.waitForTimeout(100); }
      }
      // What waits is counted, and shown when somebody asks for it, or leaves.
      await list.hover("#jobs-title");
      await list.waitForSelector("#jobs-new:not([hidden])");
      assert.match(await list.textContent("#jobs-new"), /^\d+ new$/);
      const first = () => list.getAttribute("#jobs li", "id");
      const before = await first();
      await press(list, "#jobs-new");
      assert.notEqual(await first(), before);
      assert.deepEqual(wrong, []);
      assert.deepEqual(list.wrong, []);
      await list.context().close();
    } finally {
      going = false;
      await load;
      await many.stop();
    }
    return `${presses} presses, ${cancels} of them Cancel, ${waited} while rows waited; ${posted} jobs came`;
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
    // The linked address answers as Foxglove's server does.
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
  "a job that ends while its body is read keeps its links": async () => {
    const slow = await open();
    // The answer to the first question for attitudes comes when all else has been drawn.
    let release;
    const drawn = new Promise(resolve => { release = resolve; });
    await slow.route("**/attitudes.json*", async route => {
      await drawn;
      await route.continue();
    });
    const { id } = await submit(url, { ...await long(), log: { every: 5, channels: ["/state", "/energy"] } });
    const asked = slow.waitForRequest("**/attitudes.json*");
    await slow.goto(`${url}/#/jobs/${id}`);
    await asked;
    await slow.click("#view button:text('Cancel')");
    await state(slow, "cancelled");
    await slow.waitForSelector(".charts img", { state: "attached" });
    release();
    await slow.waitForFunction(() => stage?.g);
    await slow.waitForTimeout(500);
    assert.equal(await slow.locator("#open-foxglove").count(), 1);
    assert.equal(await slow.locator(".charts img").count(), 1);
    await slow.context().close();
  },
  "what gets no answer is asked again": async () => {
    const lost = await open();
    const { id } = await submit(url, { ...await shipped(url, "free-body"), name: "asked again", expect: undefined });
    await ended(url, id);
    // The first two questions for a job are lost.
    let left = 2;
    const lose = route => { left -= 1; return left < 0 ? route.continue() : route.abort(); };
    const whole = new RegExp(`/jobs/${id}$`);
    await lost.route(whole, lose);
    await lost.goto(`${url}/#/jobs/${id}`);
    await lost.waitForSelector("h1:text('Waiting for the service')");
    await state(lost, "succeeded");
    assert.equal(left, -1);
    // What was asked for before does not take the place of what is shown now.
    await lost.goto(`${url}/#/`);
    await lost.waitForSelector("h1:text('Choose a scenario')");
    const asked = lost.waitForRequest(whole);
    let give = null;
    await lost.unroute(whole);
    await lost.route(whole, route => { give = () => route.abort(); });
    await lost.goto(`${url}/#/jobs/${id}`);
    await asked;
    await lost.waitForSelector("text=Waiting for the service …");
    await lost.goto(`${url}/#/`);
    await lost.waitForSelector("h1:text('Choose a scenario')");
    const failed = lost.waitForEvent("requestfailed");
    give();
    await failed;
    await lost.evaluate(() => new Promise(later => setTimeout(later, 100)));
    assert.equal(await lost.textContent("#view h1"), "Choose a scenario and run it");
    await lost.unroute(whole);
    // The last question for a job, when its events have said that it ended.
    const last = (await submit(url, await long())).id;
    await lost.goto(`${url}/#/jobs/${last}`);
    await state(lost, "running");
    left = 2;
    await lost.route(new RegExp(`/jobs/${last}$`), lose);
    await fetch(`${url}/jobs/${last}/cancel`, { method: "POST" });
    await state(lost, "cancelled");
    await lost.waitForSelector("#download");
    assert.ok(left < 0);
    // The browser itself notes each question that is lost.
    assert.deepEqual(lost.wrong.filter(line => !/ERR_FAILED|net::/.test(line)), []);
    await lost.context().close();
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
    await write(page, "");
    await page.click("#edit");
    await holds(page, "too-large-a-step");
    return words.slice(0, 120);
  },
  "a body in four dimensions is shown by its first axes": async () => {
    const { id } = await submit(url, await shipped(url, "so4-free"));
    await page.goto(`${url}/#/jobs/${id}`);
    // The body of the job before may still be there.
    await page.waitForFunction(() => /SO\(4\)/.test(document.querySelector(".caption")?.textContent));
    await page.waitForFunction(() => stage?.g);
  },
  "everything can be reached with the keyboard": async () => {
    const keyed = await open();
    await keyed.waitForFunction(() => text.value.length > 0);
    const reached = [];
    for (let i = 0; i < 30; i += 1) {
      await keyed.keyboard.press("Tab");
      reached.push(await keyed.evaluate(() => document.activeElement.id || document.activeElement.className || document.activeElement.textContent));
      if (reached.at(-1) === "run") break;
    }
    for (const stop of ["skip", "token-open", "shipped", "text", "run"]) assert.ok(reached.includes(stop), `${stop} of ${reached}`);
    await keyed.keyboard.press("Enter");
    await state(keyed, "succeeded");
    await keyed.focus(".stage");
    await keyed.waitForFunction(() => stage);
    const before = await keyed.evaluate(() => stage.azimuth);
    await keyed.keyboard.press("ArrowLeft");
    assert.notEqual(await keyed.evaluate(() => stage.azimuth), before);
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
    await holds(shut, "heavy-top");
    await shut.click("button[type=submit]");
    await state(shut, "succeeded");
    await shut.waitForFunction(() => document.querySelectorAll(".charts img").length === 3);
    // The links and pictures of the page lead to the log, and none of them holds the token.
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
    await study.waitForFunction(() => text.value.length > 0 && document.querySelector("#jobs li"));
    const offered = await study.isVisible("#study");
    assert.equal(offered, Boolean(api.paths["/studies"]));
    if (offered) {
      // A short one: what matters here is that it is drawn.
      await write(study, (await written(study)).replace('"duration_s": 20', '"duration_s": 0.4'));
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
    await study.waitForFunction(() => text.value.length > 0 && document.querySelector("#jobs li"));
    // A free body, of few methods: a small study, but a whole one.
    const scenario = await shipped(url, "free-body");
    await write(study, JSON.stringify({ ...scenario, name: "map" }));
    await study.evaluate(methods => {
      const plain = fetch;
      window.fetch = (to, options) => plain(to, options?.method === "POST" ? { ...options, body: JSON.stringify({ ...JSON.parse(options.body), methods }) } : options);
    }, [{ name: "splitting", order: 2 }, { name: "rkmk", tableau: "rk4" }]);
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
  "a sweep is run from the editor, and a member of it opened": async () => {
    const study = await open();
    await holds(study, "heavy-top");
    const scenario = await shipped(url, "pendulum");
    const sweep = { scenario: { ...scenario, expect: undefined, steps: 50, duration_s: undefined }, vary: [{ pointer: "/step_s", values: { list: [0.01, 0.02, 0.04] } }] };
    await write(study, JSON.stringify(sweep, null, 2));
    await study.waitForTimeout(400);
    assert.equal(await study.textContent("#check"), "");
    await press(study, "button[type=submit]");
    await study.waitForFunction(() => document.querySelector("#state")?.textContent === "succeeded", null, { timeout: 60_000 });
    assert.match(await study.textContent(".outcome"), /^sweep: 3 runs\.$/);
    await study.fill("#member", "2");
    await press(study, "#view button:text('Open in the editor')");
    await holds(study, '"step_s": 0.04');
    assert.deepEqual(study.wrong, []);
    await study.context().close();
  },
  "the page is small, and ready within a second": async () => {
    const bytes = (await (await fetch(`${url}/`)).arrayBuffer()).byteLength;
    assert.ok(bytes < 600_000, `${bytes} bytes`);
    // The time is printed, not judged: what else this machine does is unknown.
    const times = [];
    for (let k = 0; k < 5; k += 1) {
      const fresh = await open();
      await fresh.waitForFunction(() => text.value.includes("heavy-top") && document.querySelector("#jobs li"));
      times.push(await fresh.evaluate(() => Math.round(performance.now())));
      await fresh.context().close();
    }
    return `${bytes} bytes, ready after ${times.sort((a, b) => a - b)[2]} ms (${times[0]} to ${times[4]})`;
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
await opened.close();
await stop();
await guarded.stop();
await shown.stop();
