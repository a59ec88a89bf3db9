// The lists of jobs and studies: found, followed, cancelled, deleted.
const PAGE = 20;
let jobs = [];
let studies = null;
// The search, and the cursors of the pages that were opened.
const sought = { name: "", state: "", cursors: [null], next: null };
// Jobs that are chosen to be deleted; null if none are being chosen.
let chosen = null;

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
  const box = h("input", { type: "checkbox", onchange: () => { chosen?.[box.checked ? "add" : "delete"](id); showChosen(); } });
  const stop = h("button", { type: "button", className: "small", onclick: () => cancel(job) }, "Cancel");
  const remove = h("button", { type: "button", className: "small", onclick: () => forgetJob(job) }, "Delete");
  const node = h("li", { id: `job-${id}` }, h("div", { className: "row" }, h("span", { className: "named" }, box, name), state), progress,
    h("div", { className: "row soft" }, words, stop, remove));
  const update = fresh => {
    job = fresh;
    const ended = ENDED.includes(job.state);
    point(node, name);
    put(name, job.name || "unnamed");
    put(state, job.state);
    state.className = `state ${job.state}`;
    progress.hidden = stop.hidden = ended;
    stop.hidden ||= Boolean(chosen);
    remove.hidden = !ended || Boolean(chosen);
    box.hidden = !chosen;
    box.disabled = !ended;
    box.checked = Boolean(chosen?.has(id));
    progress.value = job.state === "queued" ? 0 : job.progress.percent;
    put(words, ended ? `${standing(job)} · ${when(job.created)}` : standing(job));
    words.title = job.created ? new Date(job.created).toLocaleString() : "";
    for (const [node, what] of [[progress, "Progress of"], [stop, "Cancel"], [remove, "Delete"], [box, "Choose"]]) node.ariaLabel = `${what} ${job.name}`;
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

const showJobs = () => fill("jobs", jobs, jobRow, sought.name || sought.state || sought.cursors[0] || $("find-from").value ? "No job matches." : "No jobs yet.");

function heard(job) {
  jobs = jobs.map(known => known.id === job.id ? { ...known, ...job, plan: job.plan ?? known.plan } : known);
  // Only the row of the job: events are many, and dates are slow to write.
  lists.get("jobs")?.get(job.id)?.update(jobs.find(known => known.id === job.id));
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

function question(limit, cursor) {
  const { name, state } = sought;
  return `jobs?${new URLSearchParams({ limit, ...name && { name }, ...state && { state }, ...cursor && { cursor } })}`;
}

let refreshed = 0;

async function refresh() {
  const turn = ++refreshed;
  try {
    const page = since($("find-from").value, await json(question(PAGE, sought.cursors.at(-1)), { quiet: true }));
    // The user has asked for another page since.
    if (turn !== refreshed) return;
    jobs = page.jobs;
    sought.next = page.next_cursor;
    if (!jobs.length && sought.cursors.length > 1) { sought.cursors.pop(); return await refresh(); }
    showPages();
    showJobs();
    followSome();
    if (studies) await refreshStudies();
  } catch (error) { if (error.shut) askToken(); }
}

function showPages() {
  const page = sought.cursors.length;
  $("pages").hidden = page === 1 && !sought.next;
  $("newer").disabled = page === 1;
  $("older").disabled = !sought.next;
  put($("page-number"), `Page ${page}`);
}

async function refreshStudies() {
  ({ studies } = await json("studies", { quiet: true }));
  fill("studies", studies, studyRow, "No studies yet.");
}

// ---- looking for jobs

// Returns the cursor of the jobs that are no newer than a day: ids begin with their time in
// milliseconds.
function upTo(day) {
  if (!day) return null;
  const [year, month, date] = day.split("-").map(Number);
  const digits = new Date(year, month - 1, date + 1).getTime().toString(16).padStart(12, "0");
  return `${digits.slice(0, 8)}-${digits.slice(8)}-7000-8000-000000000000`;
}

// Returns the jobs of a page, newest first, that are of a day or later; once there are older ones,
// it is the last page.
function since(day, page) {
  if (!day) return page;
  const [year, month, date] = day.split("-").map(Number);
  const from = new Date(year, month - 1, date).getTime();
  const jobs = page.jobs.filter(({ id }) => parseInt(id.slice(0, 8) + id.slice(9, 13), 16) >= from);
  return jobs.length < page.jobs.length ? { jobs, next_cursor: null } : page;
}

async function seek(change) {
  Object.assign(sought, { cursors: [upTo($("find-until").value)] }, change);
  chosen?.clear();
  showChosen();
  await refresh();
}

let typing = 0;
$("find").oninput = () => { clearTimeout(typing); typing = setTimeout(() => seek({ name: $("find").value.trim() }), 200); };
$("find-state").onchange = () => seek({ state: $("find-state").value });
$("find-from").onchange = $("find-until").onchange = () => seek({});
$("older").onclick = () => { if (sought.next) { sought.cursors.push(sought.next); refresh(); } };
$("newer").onclick = () => { if (sought.cursors.length > 1) { sought.cursors.pop(); refresh(); } };

// ---- many at once

function showChosen() {
  $("choose").hidden = Boolean(chosen);
  $("chosen").hidden = !chosen;
  put($("delete-chosen"), chosen?.size === 1 ? "Delete 1 job" : `Delete ${count(chosen?.size ?? 0)} jobs`);
  $("delete-chosen").disabled = !chosen?.size;
  showJobs();
}

$("choose").onclick = () => { chosen = new Set(); showChosen(); $("choose-all").focus(); };
$("choose-end").onclick = () => { chosen = null; showChosen(); $("choose").focus(); };
$("choose-all").onclick = async () => {
  try {
    for (let cursor = sought.cursors[0]; ;) {
      const page = since($("find-from").value, await json(question(500, cursor)));
      page.jobs.filter(job => ENDED.includes(job.state)).forEach(job => chosen?.add(job.id));
      cursor = page.next_cursor;
      if (!cursor || !chosen) break;
    }
  } catch (error) { say(error.message); }
  showChosen();
};

// Deletes one job, however often the answer is to wait.
async function deleted(id) {
  for (;;) {
    try { return await call(`jobs/${id}`, { method: "DELETE" }); } catch (error) {
      if (error.status === 404) return null;
      if (error.status !== 429) throw error;
      await new Promise(later => setTimeout(later, 1000));
    }
  }
}

$("delete-chosen").onclick = async () => {
  const ids = [...chosen];
  const whole = ids.length === 1 ? "1 job and its log" : `${count(ids.length)} jobs and their logs`;
  if (!confirm(`Delete ${whole}? This cannot be undone.`)) return;
  $("chosen").inert = true;
  let done = 0;
  try {
    const next = async () => {
      for (let id = ids.pop(); id; id = ids.pop()) {
        await deleted(id);
        done += 1;
        put($("delete-chosen"), `${count(done)} deleted`);
        if (location.hash.endsWith(id)) location.hash = "#/";
      }
    };
    await Promise.all([next(), next(), next()]);
    say(`${count(done)} jobs deleted`);
  } catch (error) {
    ids.length = 0;
    say(error.message);
    $("chosen-problem").textContent = `${count(done)} deleted, then: ${error.message}`;
  }
  $("chosen").inert = false;
  chosen = null;
  showChosen();
  await refresh();
};

// ---- studies

const KINDS = { precision: "speed against accuracy", stability: "stability map", long_term: "long-term energy", sweep: "sweep" };

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
