// The page: the jobs, one job or study in full.
let stage = null;
let jobs = [];
let cursor = null;
let studies = null;

// ---- lists

async function act(path, options, word) {
  try { await call(path, options); say(word); } catch (error) { say(error.message); }
  await refresh();
}

const cancel = job => act(`jobs/${job.id}/cancel`, { method: "POST" }, "Job cancelled");

async function forgetJob(job) {
  if (!confirm(`Delete the job ${job.name} and its log?`)) return;
  await act(`jobs/${job.id}`, { method: "DELETE" }, "Job deleted");
  if (location.hash.endsWith(job.id)) location.hash = "#/";
}

// A row of a list, made once: `update` puts what is new into it, so that a press that begins on a button ends on it.
function jobRow({ id }) {
  const name = h("a", { href: `#/jobs/${id}` });
  const state = h("span"), progress = h("progress", { max: 100 }), words = h("span");
  let job;
  const stop = h("button", { type: "button", className: "small", onclick: () => cancel(job) }, "Cancel");
  const remove = h("button", { type: "button", className: "small", onclick: () => forgetJob(job) }, "Delete");
  const node = h("li", { id: `job-${id}` }, h("div", { className: "row" }, name, state), progress,
    h("div", { className: "row soft" }, words, stop, remove));
  const update = fresh => {
    job = fresh;
    const ended = ENDED.includes(job.state);
    point(node, name);
    put(name, job.name || "unnamed");
    put(state, job.state);
    state.className = `state ${job.state}`;
    progress.hidden = stop.hidden = ended;
    remove.hidden = !ended;
    progress.value = job.state === "queued" ? 0 : job.progress.percent;
    put(words, ended ? `${standing(job)} · ${when(job.created)}` : standing(job));
    for (const [node, what] of [[progress, "Progress of"], [stop, "Cancel"], [remove, "Delete"]]) node.ariaLabel = `${what} ${job.name}`;
  };
  return { node, update };
}

// Marks the row of what is shown.
function point(node, link) {
  const here = location.hash === link.getAttribute("href");
  node.className = here ? "here" : "";
  if (here) link.setAttribute("aria-current", "page"); else link.removeAttribute("aria-current");
}

// A text that stays as it is leaves its node alone.
function put(node, text) { if (node.textContent !== text) node.textContent = text; }

const lists = new Map();

// Shows a row for each item by its id: rows stay, and move only if others come between.
function fill(list, items, make, empty) {
  const old = lists.get(list) ?? new Map();
  const rows = new Map(items.map(item => [item.id, old.get(item.id) ?? make(item)]));
  items.forEach(item => rows.get(item.id).update(item));
  lists.set(list, rows);
  const nodes = rows.size ? [...rows.values()].map(row => row.node) : [h("li", { className: "soft" }, empty)];
  const wanted = new Set(nodes);
  for (const node of [...$(list).children]) if (!wanted.has(node)) node.remove();
  nodes.forEach((node, at) => { if ($(list).children[at] !== node) $(list).insertBefore(node, $(list).children[at] ?? null); });
}

const showJobs = () => fill("jobs", jobs, jobRow, "No jobs yet.");

function heard(job) {
  jobs = jobs.map(known => known.id === job.id ? { ...known, ...job, plan: job.plan ?? known.plan } : known);
  showJobs();
}

const followed = new Map();

// Streams are few: a browser keeps six connections to a place.
function followSome() {
  for (const job of jobs.filter(job => !ENDED.includes(job.state)))
    if (followed.size < 2 && !followed.has(job.id) && !document.hidden) {
      const stop = new AbortController();
      followed.set(job.id, stop);
      follow(job.id, heard, stop.signal).finally(() => { followed.delete(job.id); });
    }
}

async function refresh() {
  try {
    const page = await json("jobs?limit=20", { quiet: true });
    const shown = new Set(page.jobs.map(job => job.id));
    const oldest = page.jobs.at(-1)?.id ?? "";
    jobs = [...page.jobs, ...jobs.filter(job => !shown.has(job.id) && job.id < oldest)];
    if (jobs.length === page.jobs.length) cursor = page.next_cursor;
    $("more").hidden = !cursor;
    showJobs();
    followSome();
    if (studies) await refreshStudies();
  } catch (error) { if (error.shut) askToken(); }
}

async function refreshStudies() {
  ({ studies } = await json("studies", { quiet: true }));
  fill("studies", studies, studyRow, "No studies yet.");
}

$("more").onclick = async () => {
  const page = await json(`jobs?limit=20&cursor=${cursor}`);
  jobs = [...jobs, ...page.jobs];
  cursor = page.next_cursor;
  $("more").hidden = !cursor;
  showJobs();
};

// ---- one job

async function picture(path, alt) {
  const link = URL.createObjectURL(await (await call(path, { quiet: true })).blob());
  return h("img", { src: link, alt, onload: () => URL.revokeObjectURL(link) });
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
  const again = step && h("button", { type: "button", className: "main", id: "again", onclick: async () => {
    // As far in time as was asked for.
    const steps = Math.ceil(job.plan.steps * job.plan.step_s / step);
    await edit(job, ({ duration_s, accuracy, ...scenario }) => ({ ...scenario, step_s: step, steps }));
    await runJob(text.value);
  } }, `Run again with a step of ${step} s`);
  const where = found.step == null ? "" : ` at step ${count(found.step)}, t = ${figure(found.time_s)} s`;
  return h("div", { className: "diagnosis" },
    h("p", {}, h("strong", {}, "Why: "), found.cause ?? found.message ?? "", ` (${found.code}${where})`),
    h("p", {}, h("strong", {}, "What to do: "), found.advice ?? ""), again || null);
}

const own = path => new URL(path.replace(/^\//, ""), base);

// A command that fetches something of the service. What a person pastes into a shell has to be one word to it.
function fetching(path, ...options) {
  const place = own(path);
  // Whoever pastes it has a token; a signed address would end in the history.
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
      h("button", { type: "button", className: "small", id: "edit", onclick: () => edit(job) }, "Edit a copy")),
    shell(`${fetching(job.links.scenario, "-o", "scenario.json")}\nvpd run scenario.json`),
  ];
}

// What can be looked at before the job has ended.
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

// Puts the scenario of a job into the editor.
async function edit(job, change = scenario => scenario) {
  const scenario = change(await json(`jobs/${job.id}/scenario.json`));
  unmark();
  text.value = JSON.stringify(scenario, null, 2);
  $("shipped").value = $("about").textContent = "";
  text.focus();
}

function facts({ plan, summary, attempts }) {
  const rows = [];
  const add = (name, value) => value != null && rows.push(h("dt", {}, name), h("dd", {}, value));
  if (plan) {
    const { formulation } = plan;
    add("body", `SO(${plan.dimension})`);
    add("method", `${formulation.method}${formulation.tableau ? ` ${formulation.tableau}` : ""}${formulation.order ? `, order ${formulation.order}` : ""}`);
    add("reason", formulation.why);
    add("step", `${figure(plan.step_s)} s, ${count(plan.steps)} steps, a sample every ${count(plan.every)}`);
  }
  if (summary) {
    add("solver", `${figure(summary.solver.iterations_per_step)} iterations per step${summary.solver.kind ? ` (${summary.solver.kind})` : ""}`);
    add("speed", `${count(Math.round(summary.ns_per_step))} ns per step`);
    add("samples", count(summary.samples));
  }
  if (attempts > 1) add("runs", `${attempts}: resumed where it was interrupted`);
  return h("dl", {}, rows);
}

let shown = 0;

async function viewJob(id) {
  const turn = ++shown;
  const stop = new AbortController();
  addEventListener("hashchange", () => stop.abort(), { once: true });
  const current = () => turn === shown && !stop.signal.aborted;
  const job = await json(`jobs/${id}`);
  if (!current()) return;
  const head = h("div");
  const looks = h("div", { id: "looks" });
  const rest = h("div");
  $("view").replaceChildren(h("article", { className: "card" }, head, looks, rest));
  let body = false, ended = false, before = "";

  // Once; what came to nothing while the job ran is tried again when it has ended.
  const show = async job => {
    if (body) return;
    body = true;
    const last = ended;
    body = await showBody(job, looks, current) || last;
    if (!body && ended) await show(job);
  };

  const update = async job => {
    if (!current() || ended) return;
    ended = ENDED.includes(job.state);
    const key = job.state;
    if (key !== before) {
      before = key;
      head.replaceChildren(
        h("div", { className: "row" }, h("h1", {}, job.name || "unnamed"), h("span", { className: `state ${job.state}`, id: "state" }, job.state)),
        h("p", { className: "outcome" }, outcome(job)), diagnosis(job) ?? "",
        ended ? "" : h("div", { className: "row" }, h("progress", { max: 100, ariaLabel: "Progress" }), h("span", { className: "soft", id: "standing" }),
          h("button", { type: "button", className: "small", onclick: () => cancel(job) }, "Cancel")));
      rest.replaceChildren(...(job.state === "running" ? liveLinks(job).filter(Boolean) : []));
      if (ended) say(`Job ${job.name} ${job.state}`);
    }
    if (!ended) {
      head.querySelector("progress").value = job.progress.percent;
      $("standing").textContent = standing(job);
    }
    if (ended ? job.links.log : job.progress.durable_step > 0) await show(job);
    if (ended) {
      rest.replaceChildren(...await charts(job), ...(job.links.log ? links(job) : []),
        job.plan ? h("h3", {}, "Run details") : "", facts(job), h("div", { className: "row" }, h("button", { type: "button", className: "small", onclick: () => forgetJob(job) }, "Delete")));
    }
  };
  await update(job);
  if (!ended) follow(id, async seen => update(ENDED.includes(seen.state) ? await json(`jobs/${id}`) : seen), stop.signal);
}

async function showBody(job, looks, current) {
  try {
    const player = new Stage($("stage"));
    const load = from => json(`jobs/${job.id}/attitudes.json?samples=600&from_s=${from}`, { quiet: true });
    looks.replaceChildren(player.root);
    if (await player.open(load) && current()) { stage = player; return true; }
  } catch { /* Nothing to show. */ }
  looks.replaceChildren();
  return false;
}

const CHARTS = { energy: "Energy error over time", orthogonality: "Orthogonality error over time", momentum: "Drift of the conserved momentum over time" };

async function charts(job) {
  if (!job.summary || job.summary.samples < 2) return [];
  const drawn = await Promise.all(Object.entries(CHARTS).filter(([key]) => job.links.charts?.[key])
    .map(([key, alt]) => picture(job.links.charts[key], alt).catch(() => null)));
  const found = drawn.filter(Boolean);
  return found.length ? [h("h3", {}, "Accuracy"), h("div", { className: "charts" }, found)] : [];
}

// ---- studies

const KINDS = { precision: "speed against accuracy", stability: "stability map", long_term: "long-term energy" };

async function forgetStudy(study) {
  if (!confirm(`Delete the study of ${study.name}?`)) return;
  await act(`studies/${study.id}`, { method: "DELETE" }, "Study deleted");
  if (location.hash.endsWith(study.id)) location.hash = "#/";
}

function studyRow({ id, name, kind }) {
  const link = h("a", { href: `#/studies/${id}` }, `${name}: ${KINDS[kind] ?? kind}`);
  const state = h("span"), words = h("span");
  let study;
  const progress = h("progress", { ariaLabel: `Progress of ${name}` });
  const stop = h("button", { type: "button", className: "small", ariaLabel: `Cancel the study of ${name}`,
    onclick: () => act(`studies/${id}/cancel`, { method: "POST" }, "Study cancelled") }, "Cancel");
  const remove = h("button", { type: "button", className: "small", ariaLabel: `Delete the study of ${name}`,
    onclick: () => forgetStudy(study) }, "Delete");
  const node = h("li", { id: `study-${id}` }, h("div", { className: "row" }, link, state), progress,
    h("div", { className: "row soft" }, words, stop, remove));
  const update = fresh => {
    study = fresh;
    const ended = ENDED.includes(study.state);
    point(node, link);
    put(state, study.state);
    state.className = `state ${study.state}`;
    progress.hidden = stop.hidden = ended;
    remove.hidden = !ended;
    progress.max = study.runs || 1;
    progress.value = study.runs_done;
    put(words, `${count(study.runs_done)}${ended ? "" : ` of ${count(study.runs)}`} runs`);
  };
  return { node, update };
}

async function viewStudy(id) {
  const turn = ++shown;
  const card = h("article", { className: "card" });
  $("view").replaceChildren(card);
  while (turn === shown) {
    const study = await json(`studies/${id}`);
    if (turn !== shown) return;
    const ended = ENDED.includes(study.state);
    const files = Object.values(study.links ?? []).filter(link => typeof link === "string");
    const pictures = ended ? await Promise.all(files.filter(link => link.endsWith(".svg"))
      .map(link => picture(link, `${KINDS[study.kind]} of ${study.name}: ${link.split("/").at(-1)}`).catch(() => null))) : [];
    card.replaceChildren(
      h("div", { className: "row" }, h("h1", {}, study.name), h("span", { className: `state ${study.state}`, id: "state" }, study.state)),
      h("p", { className: "outcome" }, study.error ?? `${KINDS[study.kind] ?? study.kind}: ${count(study.runs_done)} runs${ended ? "" : ` of ${count(study.runs)}`}.`),
      ended ? "" : h("progress", { max: study.runs || 1, value: study.runs_done, ariaLabel: "Progress" }),
      h("div", { className: "charts" }, pictures.filter(Boolean)),
      h("div", { className: "links" }, files.filter(link => link.endsWith(".csv"))
        .map(link => h("a", { href: own(link).href, download: `${fileName(study.name)}.csv` }, "Table (CSV)"))));
    if (ended) return;
    await new Promise(later => setTimeout(later, 1000));
  }
}

// ---- the whole

async function route() {
  stage?.run(false);
  stage = null;
  const [, kind, id] = location.hash.split("/");
  document.body.classList.toggle("open", Boolean(id));
  showJobs();
  try {
    if (kind === "jobs" && id) await viewJob(id);
    else if (kind === "studies" && id) await viewStudy(id);
    else {
      shown += 1;
      $("view").replaceChildren(h("div", { className: "card hello" }, h("h1", {}, "Choose a scenario and run it"),
        h("p", { className: "soft" }, "You will see the body turn, charts of the energy and momentum errors, and links that open the log in a viewer.")));
    }
  } catch (error) {
    $("view").replaceChildren(h("div", { className: "card" }, h("h1", {}, error.status === 404 ? "Not found" : "The request failed"), h("p", {}, error.message)));
  }
  if (id && matchMedia("(max-width: 60rem)").matches) scrollTo(0, 0);
}

async function start() {
  const { scenarios } = await json("scenarios");
  const options = scenarios.map(({ name, description }) => {
    const option = h("option", { value: name }, name);
    option.dataset.about = description ?? "";
    return option;
  });
  $("shipped").replaceChildren(h("option", { value: "" }, "your own scenario"), ...options);
  if (!text.value) { $("shipped").value = "heavy-top"; await $("shipped").onchange(); }
  const api = await json("openapi.json").catch(() => ({ paths: {} }));
  if (api.paths["/studies"]?.get) {
    studies = [];
    $("study-row").hidden = $("studies-card").hidden = false;
  }
  await refresh();
  await route();
}

$("token-open").onclick = askToken;
$("token-form").onsubmit = ({ submitter }) => {
  token = submitter.value === "save" ? $("token").value.trim() : "";
  if (token) sessionStorage.setItem("vpd-token", token); else sessionStorage.removeItem("vpd-token");
  start().catch(error => say(error.message));
};
addEventListener("hashchange", route);
document.addEventListener("visibilitychange", () => {
  if (document.hidden) for (const stop of followed.values()) stop.abort();
  else refresh();
});
setInterval(() => {
  const active = jobs.some(job => !ENDED.includes(job.state)) || studies?.some(study => !ENDED.includes(study.state));
  if (!document.hidden && (active || Date.now() % 10000 < 2000)) refresh();
}, 2000);
start().catch(error => say(error.message));
