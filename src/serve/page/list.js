// The lists of jobs and studies: found, followed, cancelled, deleted.
const PAGE = 20;
let jobs = [];
let studies = null;
// The search, and the cursors of the pages that were opened.
const sought = { name: "", state: "", cursors: [null], next: null };
// Jobs that are chosen to be deleted; null if none are being chosen.
let chosen = null;

// Whether the pointer is over a list. Then rows keep their places, and what has changed waits.
let over = false;
for (const card of ["jobs-card", "studies-card"]) {
  $(card).onpointerenter = () => { over = true; };
  // A finger leaves before its click comes.
  $(card).onpointerleave = async () => { over = false; await calm(); showLists(); };
}

async function act(path, options, word) {
  await call(path, { ...options, priority: "high" });
  say(word);
  await refresh();
}

const cancel = job => act(`jobs/${job.id}/cancel`, { method: "POST" }, "Job cancelled");

async function forgetJob(job) {
  if (!confirm(`Delete the job ${job.name} and its log?`)) return;
  await act(`jobs/${job.id}`, { method: "DELETE" }, "Job deleted");
  forgotten("jobs", job.id);
}

// A row whose pointer is still over it stays where it is.
function forgotten(list, id) {
  const node = lists.get(list)?.get(id)?.node;
  if (node) [node.inert, node.className] = [true, "gone"];
  if (location.hash.endsWith(id)) location.hash = "#/";
}

// A row of a list, made once: `update` puts what is new into it, so that a press that begins on a button ends on it.
// A row that is to stay as it is keeps its height and its buttons.
function jobRow({ id }) {
  // A hand that moves while it presses would drag the link, and press nothing.
  const name = h("a", { href: `#/jobs/${id}`, draggable: false });
  const state = h("span"), progress = h("progress", { max: 100 }), words = h("span");
  let job;
  const box = h("input", { type: "checkbox", onchange: () => { chosen?.[box.checked ? "add" : "delete"](id); showChosen(); } });
  const stop = pressable("Cancel", () => cancel(job));
  const remove = pressable("Delete", () => forgetJob(job));
  const node = h("li", { id: `job-${id}` }, h("div", { className: "row" }, h("span", { className: "named" }, box, name), state), progress,
    h("div", { className: "row soft" }, words, stop, remove));
  const update = (fresh, stays) => {
    const began = !job;
    job = fresh;
    const ended = ENDED.includes(job.state);
    point(node, name);
    put(name, job.name || "unnamed");
    put(state, job.state);
    state.className = `state ${job.state}`;
    if (!stays || began) {
      progress.hidden = stop.hidden = ended;
      stop.hidden ||= Boolean(chosen);
      remove.hidden = !ended || Boolean(chosen);
    }
    stop.disabled = ended;
    box.hidden = !chosen;
    box.disabled = !ended;
    box.checked = Boolean(chosen?.has(id));
    progress.value = job.state === "queued" ? 0 : job.progress.percent;
    // The time first: what does not fit is cut off at the end.
    put(words, ended ? `${when(job.created)} · ${standing(job)}` : standing(job));
    words.title = [words.textContent, job.created && new Date(job.created).toLocaleString()].filter(Boolean).join(", ");
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

const lists = new Map();

// Shows a row for each item by its id: rows stay, and move only if others come between. Under the pointer none of them
// moves, comes or goes; a line says how many wait.
function fill(list, items, make, empty) {
  const old = lists.get(list) ?? new Map();
  const stays = over && old.size > 0;
  const fresh = items.filter(item => !old.has(item.id));
  $(`${list}-new`).hidden = !(stays && fresh.length);
  put($(`${list}-new`), `${fresh.length} new`);
  const rows = stays ? old : new Map(items.map(item => [item.id, old.get(item.id) ?? make(item)]));
  items.forEach(item => rows.get(item.id)?.update(item, stays));
  if (stays) return;
  lists.set(list, rows);
  const nodes = rows.size ? [...rows.values()].map(row => row.node) : [h("li", { className: "soft" }, empty)];
  const wanted = new Set(nodes);
  for (const node of [...$(list).children]) if (!wanted.has(node)) node.remove();
  nodes.forEach((node, at) => { if ($(list).children[at] !== node) $(list).insertBefore(node, $(list).children[at] ?? null); });
}

function showJobs() {
  fill("jobs", jobs, jobRow, sought.name || sought.state || sought.cursors[0] || $("find-from").value ? "No job matches." : "No jobs yet.");
  if (!over) showPages();
}

const showStudies = () => fill("studies", studies, studyRow, "No studies yet.");

function showLists() {
  showJobs();
  if (studies) showStudies();
}

// Shows the rows that wait: somebody asks for them.
function showAll() {
  const before = over;
  over = false;
  showLists();
  over = before;
}
$("jobs-new").onclick = $("studies-new").onclick = showAll;

function heard({ id, state, progress }) {
  jobs = jobs.map(known => known.id === id ? { ...known, state, progress } : known);
  // Only the row of the job: events are many, and dates are slow to write.
  const known = jobs.find(known => known.id === id);
  if (known && !down) lists.get("jobs")?.get(id)?.update(known, over);
}
air.addEventListener("message", ({ data }) => heard(data));

function question(limit, cursor) {
  const { name, state } = sought;
  return `jobs?${new URLSearchParams({ limit, ...name && { name }, ...state && { state }, ...cursor && { cursor } })}`;
}

// The number of the latest question, and whether a person still waits for other rows: a later question answers that, too.
let refreshed = 0, awaited = false;
// Number of questions without an answer yet, and the time before which the clock asks no other: while the service is slow,
// it adds none, and leaves it time for presses.
let refreshing = 0, rested = 0;

// Asks for the lists; `asked` is whether a person asks for other rows.
async function refresh(asked = false) {
  const turn = ++refreshed;
  awaited ||= asked;
  refreshing += 1;
  const begun = Date.now();
  try {
    const page = since($("find-from").value, await json(question(PAGE, sought.cursors.at(-1)), { quiet: true }));
    const list = studies ? (await json("studies", { quiet: true })).studies : null;
    const waits = page.jobs.some(job => job.state === "queued");
    queue = waits ? (await json("jobs?state=queued&limit=500", { quiet: true })).jobs.map(job => job.id).reverse() : null;
    await calm();
    // The user has asked for another page since.
    if (turn !== refreshed) return;
    jobs = page.jobs;
    if (studies) studies = list;
    sought.next = page.next_cursor;
    if (!jobs.length && sought.cursors.length > 1) { sought.cursors.pop(); return await refresh(asked); }
    if (awaited) showAll(); else showLists();
    awaited = false;
    dispatchEvent(new Event("listed"));
  } catch (error) {
    if (error.shut) askToken();
    else if (asked) say(error.message, true);
  } finally {
    refreshing -= 1;
    rested = Date.now() + 2 * (Date.now() - begun);
  }
}

function showPages() {
  const page = sought.cursors.length;
  $("pages").hidden = page === 1 && !sought.next;
  $("newer").disabled = page === 1;
  $("older").disabled = !sought.next;
  put($("page-number"), `Page ${page}`);
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
  await refresh(true);
}

let typing = 0;
$("find").oninput = () => { clearTimeout(typing); typing = setTimeout(() => seek({ name: $("find").value.trim() }), 200); };
$("find-state").onchange = () => seek({ state: $("find-state").value });
$("find-from").onchange = $("find-until").onchange = () => seek({});
$("older").onclick = event => press(event.currentTarget, async () => { if (sought.next) { sought.cursors.push(sought.next); await refresh(true); } }, 0);
$("newer").onclick = event => press(event.currentTarget, async () => { if (sought.cursors.length > 1) { sought.cursors.pop(); await refresh(true); } }, 0);

// ---- many at once

function showChosen(show = showJobs) {
  $("choose").hidden = Boolean(chosen);
  $("chosen").hidden = !chosen;
  put($("delete-chosen"), chosen?.size === 1 ? "Delete 1 job" : `Delete ${count(chosen?.size ?? 0)} jobs`);
  $("delete-chosen").disabled = !chosen?.size;
  show();
}

$("choose").onclick = () => { chosen = new Set(); showChosen(showAll); $("choose-all").focus(); };
$("choose-end").onclick = () => { chosen = null; showChosen(showAll); $("choose").focus(); };
$("choose-all").onclick = event => press(event.currentTarget, async () => {
  for (let cursor = sought.cursors[0]; ;) {
    const page = since($("find-from").value, await json(question(500, cursor)));
    page.jobs.filter(job => ENDED.includes(job.state)).forEach(job => chosen?.add(job.id));
    cursor = page.next_cursor;
    if (!cursor || !chosen) break;
  }
  showChosen();
});

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
        forgotten("jobs", id);
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
  await refresh(true);
};

// ---- studies

const KINDS = { precision: "speed against accuracy", stability: "stability map", long_term: "long-term energy", sweep: "sweep" };

async function forgetStudy(study) {
  if (!confirm(`Delete the study of ${study.name}?`)) return;
  await act(`studies/${study.id}`, { method: "DELETE" }, "Study deleted");
  forgotten("studies", study.id);
}

function studyRow({ id, name, kind }) {
  const link = h("a", { href: `#/studies/${id}`, draggable: false }, `${name}: ${KINDS[kind] ?? kind}`);
  const state = h("span"), words = h("span");
  let study;
  const progress = h("progress", { ariaLabel: `Progress of ${name}` });
  const stop = pressable("Cancel", () => act(`studies/${id}/cancel`, { method: "POST" }, "Study cancelled"), { ariaLabel: `Cancel the study of ${name}` });
  const remove = pressable("Delete", () => forgetStudy(study), { ariaLabel: `Delete the study of ${name}` });
  const node = h("li", { id: `study-${id}` }, h("div", { className: "row" }, link, state), progress,
    h("div", { className: "row soft" }, words, stop, remove));
  const update = (fresh, stays) => {
    const began = !study;
    study = fresh;
    const ended = ENDED.includes(study.state);
    point(node, link);
    put(state, study.state);
    state.className = `state ${study.state}`;
    if (!stays || began) {
      progress.hidden = stop.hidden = ended;
      remove.hidden = !ended;
    }
    stop.disabled = ended;
    progress.max = study.runs || 1;
    progress.value = study.runs_done;
    put(words, ended ? counted(study.runs_done, "run") : `${count(study.runs_done)} of ${counted(study.runs, "run")}`);
  };
  return { node, update };
}
