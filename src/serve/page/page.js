// The page: one job or study in full, and the way between them.
let stage = null, chart = null, members = null;
// ---- one job

async function picture(path, alt, className = "") {
  const link = URL.createObjectURL(await (await read(path)).blob());
  return h("img", { src: link, alt, className, onload: () => URL.revokeObjectURL(link) });
}

function shell(command) {
  const shown = h("pre", {}, command);
  const copy = async event => {
    try { await navigator.clipboard.writeText(command); event.target.textContent = "Copied"; } catch {
      getSelection().selectAllChildren(shown);
      event.target.textContent = "Selected";
    }
  };
  return h("div", { className: "shell" }, shown, h("button", { type: "button", className: "small", onclick: copy }, "Copy"));
}

function diagnosis(job) {
  const found = job.diagnosis;
  if (!found) return null;
  const step = found.advised_step_s;
  const again = step && pressable(`Run again with a step of ${step} s`, async () => {
    // The run is to reach the same time.
    const steps = Math.ceil(job.plan.steps * job.plan.step_s / step);
    await edit(job, source => ["duration_s", "accuracy"].reduce((source, key) => altered(source, [key], null),
      altered(altered(source, ["step_s"], String(step)), ["steps"], String(steps))));
    await runJob(text.value);
  }, { className: "main", id: "again" });
  const where = found.step == null ? "" : ` at step ${count(found.step)}, t = ${figure(found.time_s)} s`;
  return h("div", { className: "diagnosis" },
    h("p", {}, h("strong", {}, "Why: "), ...prose(`${found.cause ?? found.message ?? ""} (${found.code}${where})`)),
    h("p", {}, h("strong", {}, "What to do: "), ...prose(found.advice ?? "")), again || null);
}

const own = path => new URL(path.replace(/^\//, ""), base);

// A command that fetches something of the service. What a person pastes into a shell has to be one word to it.
function fetching(path, ...options) {
  const place = own(path);
  // The user who pastes it has a token; a signed address would end in the history.
  place.search = "";
  return ["curl", ...token ? ['-H "authorization: Bearer $TOKEN"'] : [], ...options, quoted(place.href)].join(" ");
}

function links(job) {
  const { viewers, log } = job.links;
  const to = (name, href, props = {}) => h("a", { href, ...props }, name);
  const out = { target: "_blank", rel: "noopener noreferrer" };
  const names = { foxglove: "Foxglove", foxglove_desktop: "Foxglove desktop", lichtblick_desktop: "Lichtblick", rerun: "Rerun" };
  return [
    h("h3", {}, "The log"),
    h("div", { className: "links" },
      to("Download", own(log).href, { download: `vpd-${job.id}.mcap`, id: "download" }),
      Object.entries(names).filter(([key]) => viewers?.[key])
        .map(([key, name]) => to(`Open in ${name}`, viewers[key], { ...out, id: `open-${key}` })),
      to("Foxglove layout", own("layouts/foxglove.json").href, { download: "vpd-foxglove.json" }),
      to("Lichtblick layout", own("layouts/lichtblick.json").href, { download: "vpd-lichtblick.json" })),
    shell(fetching(log, "-o", `${fileName(job.name)}.mcap`)),
    h("div", { className: "row" }, h("span", { className: "soft" }, "Run the same scenario again:"),
      pressable("Edit a copy", () => edit(job), { id: "edit" })),
    shell(`${fetching(job.links.scenario, "-o", "scenario.json")}\nvpd run scenario.json`),
  ];
}

// Links that can be opened before the job has ended.
function liveLinks(job) {
  const { live, live_viewers: viewers } = job.links;
  const names = { foxglove: "Foxglove", foxglove_desktop: "Foxglove desktop", lichtblick_desktop: "Lichtblick" };
  const out = { target: "_blank", rel: "noopener noreferrer" };
  return [
    h("h3", {}, "While it runs"),
    h("div", { className: "links" },
      Object.entries(names).filter(([key]) => viewers?.[key])
        .map(([key, name]) => h("a", { href: viewers[key], ...out, id: `live-${key}` }, `Watch in ${name}`)),
      h("a", { href: own(live).href, download: `vpd-${job.id}.mcap`, id: "follow" }, "Follow the log")),
    viewers ? h("p", { className: "soft" }, `The live view at ${viewers.address.split("/?")[0]} shows one job at a time.`) : null,
    shell(fetching(live, "-o", `${fileName(job.name)}.mcap`)),
  ];
}

// Puts the scenario of a job into the editor, as it was sent.
async function edit(job, change = source => source) {
  const source = await (await call(job.links.sent)).text();
  replaceText(change(source), "", `the scenario of ${job.name}`);
  text.focus();
}

function facts({ plan, summary, attempts }) {
  const rows = [];
  const add = (name, value) => value != null && rows.push(h("dt", {}, name), h("dd", {}, ...prose(String(value))));
  if (plan) {
    const { formulation } = plan;
    add("body", `SO(${plan.dimension})`);
    add("method", `${formulation.method}${formulation.tableau ? ` ${formulation.tableau}` : ""}${formulation.order ? `, order ${formulation.order}` : ""}`);
    add("reason", formulation.why);
    add("step", `${figure(plan.step_s)} s, ${counted(plan.steps, "step")}, a sample ${plan.every === 1 ? "after each" : `every ${count(plan.every)}`}`);
    const change = what => what && `the change of ${what}`;
    add("energy error", change(plan.balance));
    add("momentum drift", change(plan.momentum_balance));
    add("Jacobi error", change(plan.jacobi_integral));
    (plan.warnings ?? []).forEach(warning => add("warning", warning));
  }
  if (summary) {
    add("solver", `${figure(summary.solver.iterations_per_step)} iterations per step${summary.solver.kind ? ` (${summary.solver.kind})` : ""}`);
    const control = summary.control;
    if (control) add("control", control.saturated ? `a limit cut the command at ${count(control.saturated)} of ${count(control.samples)} samples` : "no limit cut a command");
    if (summary.ns_per_step) add("speed", `${count(Math.round(summary.ns_per_step))} ns per step`);
    add("samples", count(summary.samples));
  }
  if (attempts > 1) add("runs", `${attempts}: resumed where it was interrupted`);
  return h("dl", {}, rows);
}

// The title of the tab says what it shows.
function title(name, state) { document.title = name ? `${name}: ${state} – vpd` : "vpd"; }

let shown = 0;

// Asks for what is to be shown; until it comes, the page says that it waits.
async function shownSoon(path) {
  const turn = shown;
  const late = setTimeout(() => { if (turn === shown) $("view").replaceChildren(h("div", { className: "card soft" }, "Waiting for the service …")); }, 150);
  try { return await json(path); } finally { clearTimeout(late); }
}

async function viewJob(id) {
  const turn = ++shown;
  const { signal } = leaving;
  const current = () => turn === shown && !signal.aborted;
  const job = await shownSoon(`jobs/${id}`);
  if (!current()) return;
  const head = h("div");
  const looks = h("div", { id: "looks" });
  const crowd = h("div", { id: "crowd" });
  const drawn = h("div", { id: "drawn" });
  const rest = h("div");
  $("view").replaceChildren(h("article", { className: "card" }, head, looks, crowd, drawn, rest));
  let body = false, ended = false, before = "", latest = job;
  // The place of a job in the queue changes with the others.
  addEventListener("listed", () => { if (!ended && $("standing")) put($("standing"), standing(latest)); }, { signal });

  // Once; what came to nothing while the job ran is tried again when it has ended.
  const show = async job => {
    if (body) return;
    body = true;
    const last = ended;
    body = await showBody(job, looks, current) || last;
    if (!body && ended) await show(job);
  };

  // From when there is a log on: now and then while it grows.
  let asked = 0;
  const showChart = async job => {
    if (asked === Infinity || Date.now() < asked) return;
    const begun = Date.now();
    asked = Infinity;
    if (!chart) {
      chart = new Chart(job, t => stage?.jump(t));
      drawn.replaceChildren(h("h3", {}, job.plan?.ensemble ? "Member 0 over time" : "Over time"), chart.root);
    }
    if (!members && job.plan?.ensemble) {
      members = new Members(job);
      crowd.replaceChildren(members.root);
    }
    // Not under the pointer.
    if (members && (ended || !members.body.matches(":hover"))) await members.load();
    if (ended || !chart.span) await chart.load();
    asked = ended ? Infinity : Date.now() + Math.max(3000, 5 * (Date.now() - begun));
  };

  const update = async job => {
    await calm();
    if (!current() || ended) return;
    latest = job;
    // While this one waits, the one of the end may come: each goes on with its own job.
    const last = ended = ENDED.includes(job.state);
    const key = job.state;
    if (key !== before) {
      before = key;
      head.replaceChildren(
        h("div", { className: "row" }, h("h1", {}, job.name || "unnamed"), h("span", { className: `state ${job.state}`, id: "state" }, job.state)),
        h("p", { className: "outcome" }, ...prose(outcome(job))), diagnosis(job) ?? "",
        last ? "" : h("div", { className: "row" }, h("progress", { max: 100, ariaLabel: "Progress" }), h("span", { className: "soft", id: "standing" }),
          pressable("Cancel", () => cancel(job))));
      rest.replaceChildren(...(job.state === "running" ? liveLinks(job).filter(Boolean) : []));
      if (last) say(`Job ${job.name} ${job.state}`);
    }
    title(job.name, last || job.state === "queued" ? job.state : `${Math.floor(job.progress.percent)} %`);
    if (!last) {
      head.querySelector("progress").value = job.progress.percent;
      $("standing").textContent = standing(job);
    }
    if (!last && !body && !looks.children.length && job.state === "running") looks.append(h("p", { className: "soft" }, "Waiting for the first samples …"));
    if (last ? job.links.log : job.progress.durable_step > 0) {
      await show(job);
      if (!current()) return;
      if (last) asked = 0;
      const made = showChart(job);
      if (last) await made;
    }
    if (last) {
      if (!current()) return;
      const pictures = await charts(job);
      await calm();
      if (!current()) return;
      rest.replaceChildren(...pictures, ...(job.links.log ? links(job) : []),
        job.plan ? h("h3", {}, "Run details") : "", facts(job), h("div", { className: "row" }, pressable("Delete", () => forgetJob(job))));
    }
  };
  // All of a job that has ended: asked for until it comes.
  const whole = async () => {
    for (;;) {
      try { return await json(`jobs/${id}`); } catch (error) { if (error.status === 404 || !current()) return latest; }
      await new Promise(later => setTimeout(later, 1000));
    }
  };
  const first = update(job);
  if (!ENDED.includes(job.state)) follow(job, async seen => { heard(seen); await update(ENDED.includes(seen.state) ? await whole() : seen); }, signal);
  await first;
}

async function showBody(job, looks, current) {
  try {
    const player = new Stage($("stage"));
    const load = (from, every) => readJson(`jobs/${job.id}/attitudes.json?samples=600&from_s=${from}&every_s=${every}`);
    await calm();
    looks.replaceChildren(player.root);
    const { scene } = await json(job.links.scenario, { quiet: true, patient: true });
    player.onframe = t => chart?.follow(t);
    if (await player.open(load, scene) && current()) { stage = player; return true; }
  } catch { /* Nothing to show. */ }
  await calm();
  looks.replaceChildren();
  return false;
}

const CHARTS = { energy: "Energy error over time", orthogonality: "Orthogonality error over time", momentum: "Drift of the conserved momentum over time" };

// A picture, or in its place why it is not there.
const pictured = (path, alt, className) =>
  picture(path, alt, className).catch(error => h("p", { className: "soft" }, `${alt}: not drawn. ${error.message}`));

async function charts({ links, summary, plan }) {
  if (!links.charts || !summary) return [];
  const logged = topic => plan?.channels.some(channel => channel.topic === topic);
  const why = key => summary.samples < 2 ? "the log holds less than two samples"
    : key === "momentum" && logged("/momentum") ? "no part of the momentum is conserved" : `/${key} is not logged`;
  const drawn = await Promise.all(Object.entries(CHARTS).map(([key, alt]) =>
    summary[key] && summary.samples > 1 ? pictured(links.charts[key], alt) : h("p", { className: "soft" }, `${alt}: not drawn, because ${why(key)}.`)));
  return [h("details", {}, h("summary", {}, "Charts of the accuracy as pictures"), h("div", { className: "charts" }, drawn))];
}

// ---- studies

async function viewStudy(id) {
  const turn = ++shown;
  const card = h("article", { className: "card" });
  while (turn === shown) {
    const study = await (card.isConnected ? json(`studies/${id}`).catch(() => null) : shownSoon(`studies/${id}`));
    if (turn !== shown) return;
    if (!study) { await new Promise(later => setTimeout(later, 1000)); continue; }
    const ended = ENDED.includes(study.state);
    title(study.name, study.state);
    const files = Object.values(study.links ?? []).filter(link => typeof link === "string");
    // A sweep shows the members so far.
    const pictures = ended || study.kind === "sweep" ? await Promise.all(files.filter(link => link.endsWith(".svg"))
      .map(link => pictured(link, `${KINDS[study.kind]} of ${study.name}: ${link.split("/").at(-1)}`, ["stability", "sweep"].includes(study.kind) ? "map" : ""))) : [];
    await calm();
    if (turn !== shown) return;
    if (!card.isConnected) $("view").replaceChildren(card);
    card.replaceChildren(
      h("div", { className: "row" }, h("h1", {}, study.name), h("span", { className: `state ${study.state}`, id: "state" }, study.state)),
      h("p", { className: "outcome" }, study.error ?? `${KINDS[study.kind] ?? study.kind}: ${ended ? counted(study.runs_done, "run") : `${count(study.runs_done)} of ${counted(study.runs, "run")}`}.`),
      ended ? "" : h("progress", { max: study.runs || 1, value: study.runs_done, ariaLabel: "Progress" }),
      h("div", { className: "charts" }, pictures),
      h("div", { className: "links" }, files.filter(link => link.endsWith(".csv"))
        .map(link => h("a", { href: own(link).href, download: `${fileName(study.name)}.csv` }, "Table (CSV)"))),
      ended && study.kind === "sweep" ? memberForm(study) : "");
    if (ended) return;
    await new Promise(later => setTimeout(later, study.kind === "sweep" ? 5000 : 1000));
  }
}

// A member of a sweep, by its number in the table.
function memberForm(study) {
  const number = h("input", { type: "number", id: "member", min: 0, max: study.runs - 1, value: 0 });
  return h("form", { className: "row", onsubmit: event => {
    event.preventDefault();
    press(event.submitter, async () => {
      const scenario = await (await call(`studies/${study.id}/members/${number.value}.json`)).text();
      replaceText(scenario, "", `member ${number.value} of ${study.name}`);
      location.hash = "#/";
      text.focus();
    });
  } }, h("label", { htmlFor: "member" }, "Member"), number, h("button", { className: "small" }, "Open in the editor"));
}

// ---- the whole

let ready = false;

// What got no answer is asked again after this time, and the page says so meanwhile.
const AGAIN_MS = 2000;
const waitForIt = error => $("view").replaceChildren(h("div", { className: "card hello" }, h("h1", {}, "Waiting for the service"), h("p", {}, error.message)));

async function route() {
  if (!ready) return;
  leaving.abort();
  leaving = new AbortController();
  const { signal } = leaving;
  stage?.close();
  chart?.close();
  members?.close();
  stage = chart = members = null;
  const [, kind, id] = location.hash.split("/");
  document.body.classList.toggle("open", Boolean(id) && kind !== "draft");
  showLists();
  try {
    if (kind === "draft" && id) await openDraft(id);
    else if (kind === "jobs" && id) await viewJob(id);
    else if (kind === "studies" && id) await viewStudy(id);
    else {
      shown += 1;
      title();
      $("view").replaceChildren(h("div", { className: "card hello" }, h("h1", {}, "Choose a scenario and run it"),
        h("p", { className: "soft" }, "You will see the body turn, charts of the energy and momentum errors, and links that open the log in a viewer.")));
    }
  } catch (error) {
    // Something else is shown by now.
    if (signal.aborted) return;
    if (error instanceof Problem && !error.status) {
      waitForIt(error);
      setTimeout(() => { if (!signal.aborted) route(); }, AGAIN_MS);
    } else $("view").replaceChildren(h("div", { className: "card" }, h("h1", {}, error.status === 404 ? "Not found" : "The request failed"), h("p", {}, error.message),
      error.status === 404 ? "" : h("button", { type: "button", onclick: route }, "Try again")));
  }
  if (id && matchMedia("(max-width: 60rem)").matches) scrollTo(0, 0);
}

// A scenario that came as an address.
async function openDraft(letters) {
  const found = await shared(letters);
  location.replace("#/");
  if (found === null) say("The address holds no scenario");
  else replaceText(found, "", "the scenario in the address");
}

// First content of the editor: the text written last, or an example.
async function firstText() {
  const found = kept();
  if (found) { restore(found); showPlaced(); return; }
  $("shipped").value = "heavy-top";
  await $("shipped").onchange();
}

async function start() {
  // These are no presses: they may take long on a busy machine.
  const patient = true;
  const described = json("openapi.json", { patient }).catch(() => ({ paths: {} }));
  const [{ scenarios }] = await Promise.all([json("scenarios", { patient }), makeForm()]);
  const options = scenarios.map(({ name, description }) => {
    const option = h("option", { value: name }, name);
    option.dataset.about = description ?? "";
    return option;
  });
  $("shipped").replaceChildren(h("option", { value: "" }, "your own scenario"), ...options);
  if (!text.value) await firstText();
  const api = await described;
  if (api.paths["/studies"]?.get) {
    studies = [];
    $("study-row").hidden = $("studies-card").hidden = false;
  }
  await refresh();
  ready = true;
  await route();
}

$("token-open").onclick = askToken;
$("token-form").onsubmit = ({ submitter }) => {
  token = submitter.value === "save" ? $("token").value.trim() : "";
  if (token) sessionStorage.setItem("vpd-token", token); else sessionStorage.removeItem("vpd-token");
  begin();
};
addEventListener("hashchange", route);
document.addEventListener("visibilitychange", () => { if (!document.hidden) refresh(); });
setInterval(() => {
  const active = jobs.some(job => !ENDED.includes(job.state)) || studies?.some(study => !ENDED.includes(study.state));
  if (!document.hidden && !refreshing && Date.now() >= rested && (active || Date.now() % 10000 < 2000)) refresh();
}, 2000);

// A service that does not answer at first is asked again.
async function begin() {
  try { await start(); } catch (error) {
    if (error.shut) return;
    waitForIt(error);
    setTimeout(begin, AGAIN_MS);
  }
}
begin();
