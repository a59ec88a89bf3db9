// The service as the page knows it, and what it says in words. It speaks to the public API and to nothing else.
const $ = id => document.getElementById(id);

// Makes an element; children that are null are left out.
function h(tag, props = {}, ...children) {
  const node = Object.assign(document.createElement(tag), props);
  node.append(...children.flat().filter(child => child != null));
  return node;
}

const base = new URL(".", location.href);
const ENDED = ["succeeded", "failed", "cancelled"];
let token = sessionStorage.getItem("vpd-token") ?? "";

class Problem extends Error {
  constructor(body, status) { super(body.detail ?? body.title ?? `status ${status}`); Object.assign(this, { body, status }); }
}

// The longest wait for an answer, of whatever somebody waits for.
const LIMIT_MS = 10_000;

// Signals that end with the first of them.
const any = (...signals) => AbortSignal.any(signals.filter(Boolean));

// `patient` waits as long as it takes.
async function call(path, { patient, ...options } = {}) {
  const headers = { ...options.headers };
  const asked = token;
  if (token) headers.authorization = `Bearer ${token}`;
  const limit = patient ? null : AbortSignal.timeout(LIMIT_MS);
  const signal = any(options.signal, limit);
  let answer;
  try { answer = await fetch(new URL(path.replace(/^\//, ""), base), { ...options, headers, signal, cache: "no-store" }); } catch (error) {
    if (options.signal?.aborted) throw error;
    throw new Problem({ detail: limit?.aborted ? `The service has not answered within ${LIMIT_MS / 1000} s.` : "The service cannot be reached." });
  }
  if (answer.ok) return answer;
  const problem = new Problem(await answer.json().catch(() => ({})), answer.status);
  // A request that was sent before the token was given says nothing about it.
  problem.shut = answer.status === 401 && asked === token;
  if (problem.shut && !options.quiet) askToken();
  throw problem;
}

const json = async (path, options) => (await call(path, options)).json();

const send = (path, text, headers = {}) =>
  json(path, { method: "POST", body: text, headers: { "content-type": "application/json", ...headers }, priority: "high" });

// A browser keeps six connections to a place for all its windows. What may take seconds there, reading a log or drawing
// it, takes three of them at most, the events of jobs one: the others are for presses. Without locks, as on a page
// without TLS, each window goes its own way.
const READERS = 3;

// Reads something as soon as one of the places for readers is free.
const inTurn = read => !navigator.locks ? read() : new Promise((done, failed) => {
  const taken = new AbortController();
  for (let place = 0; place < READERS; place += 1) {
    navigator.locks.request(`vpd read ${place} ${base}`, { signal: taken.signal }, async () => {
      if (taken.signal.aborted) return;
      taken.abort();
      try { done(await read()); } catch (error) { failed(error); }
    }).catch(() => { /* Another one was free before. */ });
  }
});

// Ends when something else is shown: what was being read for it is not wanted any more.
let leaving = new AbortController();

// Reads something that may take long.
function read(path) {
  const { signal } = leaving;
  return inTurn(() => { signal.throwIfAborted(); return call(path, { signal, quiet: true, patient: true }); });
}
const readJson = async path => (await read(path)).json();

function askToken() {
  if ($("token-dialog").open) return;
  $("token").value = token;
  $("token-dialog").showModal();
}

// For those who hear the page; what went wrong is also shown.
function say(text, wrong = false) {
  put($("news"), text);
  $("news").classList.toggle("wrong", wrong);
}

// A text that stays as it is leaves its node alone.
function put(node, text) { if (node.textContent !== text) node.textContent = text; }

// ---- presses

// The time within which two clicks are one double click.
const DOUBLE_MS = 600;
const busy = new WeakSet();

// Does what a button is for, once at a time: it shows that it waits, and a second press, or one within `again_ms`, is none.
// Says what went wrong.
async function press(button, act, again_ms = DOUBLE_MS) {
  if (busy.has(button)) return;
  busy.add(button);
  const doubled = new Promise(later => setTimeout(later, again_ms));
  button.ariaBusy = "true";
  say("");
  try { await act(); } catch (error) { say(error.message, true); } finally {
    button.ariaBusy = null;
    await doubled;
    busy.delete(button);
  }
}

// Makes a small button for it.
const pressable = (word, act, props = {}) =>
  h("button", { type: "button", className: "small", onclick: event => press(event.currentTarget, act), ...props }, word);

// Whether a button of the mouse, a finger or a pen is down, and what waits until it is up.
let down = false, lifting = 0;
const waiting = [];

// Ends when nothing is being pressed: what moves or replaces things waits for it, so that a press that began on a button
// ends on it.
const calm = () => down ? new Promise(later => waiting.push(later)) : Promise.resolve();

function lift() {
  [down, lifting] = [false, 0];
  waiting.splice(0).forEach(later => later());
}

addEventListener("pointerdown", event => { if (event.button === 0) { clearTimeout(lifting); [down, lifting] = [true, 0]; } }, true);
// The click comes after the pointer is up, on a busy machine some time after; there is none where the pointer has left.
const lifted = after_ms => { clearTimeout(lifting); lifting = setTimeout(lift, after_ms); };
for (const kind of ["pointerup", "pointercancel", "dragend"]) addEventListener(kind, () => lifted(300), true);
// That of the window: what is pressed takes the focus from something else, which blurs too.
addEventListener("blur", event => { if (event.target === window) lifted(300); }, true);
addEventListener("pointermove", event => { if (down && !lifting && event.buttons === 0) lifted(300); }, true);
addEventListener("click", () => { if (down) lifted(0); }, true);

// ---- following jobs

// What one window hears of a job, told to the others: its state and its progress.
const air = new BroadcastChannel(`vpd ${base}`);
const pass = ({ id, state, progress }) => air.postMessage({ id, state, progress });

const shownAgain = () => document.hidden ? new Promise(later => document.addEventListener("visibilitychange", later, { once: true })) : null;

// The shortest time between two pieces of progress that are shown.
const TOLD_MS = 250;

// Follows a job until it has ended. One window of a browser at a time holds a stream of events, and only while it can be
// seen; the others hear what it tells, or ask every second. A service that answers slowly is asked less often: all windows
// share the few connections, and a press must find one of them free.
async function follow(job, seen, signal) {
  let next = 0, told = 0, streams = false;
  const over = () => signal.aborted || ENDED.includes(job.state);
  const tell = (fresh, rest_ms = 1000) => { if (over()) return; [job, next] = [fresh, Date.now() + rest_ms]; seen(job); };
  const ask = async () => {
    const begun = Date.now();
    const fresh = await json(`jobs/${job.id}`, { signal, quiet: true });
    pass(fresh);
    tell(fresh, Math.max(1000, 5 * (Date.now() - begun)));
  };
  const listen = ({ data }) => { if (data.id === job.id && data.state === job.state) tell({ ...job, progress: data.progress }); };
  air.addEventListener("message", listen);
  const stream = async () => {
    // Some proxies cut streams.
    for (let cuts = 0; cuts < 2 && !over(); cuts += 1) {
      await shownAgain();
      const stop = new AbortController();
      const hide = () => { if (document.hidden) stop.abort(); };
      document.addEventListener("visibilitychange", hide);
      const either = any(signal, stop.signal);
      try {
        await navigator.locks.request(`vpd events ${base}`, { signal: either }, () => events(job.id, fresh => {
          [cuts, streams] = [0, true];
          // Ten times a second is more than anybody reads, and every window hears of it.
          if (fresh.state === job.state && Date.now() < told + TOLD_MS) return;
          told = Date.now();
          pass(fresh);
          tell(fresh);
        }, either));
      } catch { if (stop.signal.aborted) cuts = -1; } finally {
        streams = false;
        document.removeEventListener("visibilitychange", hide);
      }
    }
  };
  if (navigator.locks) stream();
  while (!over()) {
    await new Promise(later => setTimeout(later, 500));
    await shownAgain();
    if (over() || streams || Date.now() < next) continue;
    try { await ask(); } catch (error) { if (error.status === 404) break; }
  }
  air.removeEventListener("message", listen);
}

// Reads the events of a job until they end.
async function events(id, seen, signal) {
  const answer = await call(`jobs/${id}/events`, { signal, quiet: true, patient: true });
  if (!answer.headers.get("content-type")?.startsWith("text/event-stream")) return;
  const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
  let job = null;
  for (let rest = ""; ;) {
    const { value, done } = await reader.read();
    if (done) return;
    const events = (rest + value).split("\n\n");
    rest = events.pop();
    for (const event of events) {
      const field = name => event.split("\n").filter(line => line.startsWith(`${name}:`))
        .map(line => line.slice(name.length + 1).trim()).join("\n");
      const data = field("data") && JSON.parse(field("data"));
      if (field("event") === "state") job = data;
      else if (field("event") === "progress" && job) job = { ...job, progress: data };
      else continue;
      seen(job);
    }
  }
}

// ---- names in commands and files

// One word to a POSIX shell, whatever is in it.
const quoted = text => `'${text.replaceAll("'", "'\\''")}'`;

// A name that is safe as that of a file, and in a shell, on every system.
const fileName = name => name.replace(/[^A-Za-z0-9_.-]+/g, "-").replace(/^[-.]+|[-.]+$/g, "").slice(0, 80) || "log";

// ---- words and figures

const count = number => number.toLocaleString("en");
const counted = (number, word) => `${count(number)} ${word}${number === 1 ? "" : "s"}`;
const figure = x => x === 0 ? "0" : Math.abs(x) >= 1e-3 && Math.abs(x) < 1e6 ? String(Number(x.toPrecision(4))) : x.toExponential(1);

function span(seconds) {
  if (seconds < 1) return `${Math.max(1, Math.round(seconds * 1000))} ms`;
  if (seconds < 90) return `${Number(seconds.toPrecision(3))} s`;
  if (seconds < 5400) return `${Math.round(seconds / 60)} min`;
  return seconds < 172800 ? `${(seconds / 3600).toFixed(1)} h` : `${Math.round(seconds / 86400)} days`;
}

// A time of a run as a person reads it, in four digits.
function clock(seconds) {
  if (seconds < 600) return `${seconds.toPrecision(4)} s`;
  const whole = Math.round(seconds), [days, hours, minutes] = [Math.floor(whole / 86400), Math.floor(whole / 3600) % 24, Math.floor(whole / 60) % 60];
  const parts = [days && `${count(days)} d`, (days || hours) && `${hours} h`, `${minutes} min`, !days && `${whole % 60} s`];
  return parts.filter(Boolean).join(" ");
}

// Text as nodes: a figure and its unit stay in one line; 2.3e0 is 2.3.
const prose = text => text.replace(/(?<![\w.])(\d+(?:\.\d+)?)e0(?![\w.])/g, "$1").split(/([-−]?\d[\d.,]*(?:e[-+]?\d+)?(?:\s(?:J|s|ms|ns|min|h|d|days|rad|%|kg m²\/s|N m s)(?![\p{L}\d]))?)/u)
  .map((part, k) => k % 2 ? h("span", { className: "whole" }, part) : part);

// Puts a text with figures.
function putProse(node, text) { if (node.textContent !== text) node.replaceChildren(...prose(text)); }

// The time of today, or the day.
function when(created) {
  if (!created) return "";
  const at = new Date(created);
  const time = at.toLocaleTimeString([], { hour: "2-digit", minute: "2-digit" });
  return at.toDateString() === new Date().toDateString() ? time : `${at.toLocaleDateString([], { dateStyle: "medium" })}, ${time}`;
}

// The ids of the jobs that wait, the next one first; null if it is not known.
let queue = null;

function inQueue(id) {
  const at = queue?.indexOf(id) ?? -1;
  return at < 0 ? "waiting for a free worker" : at === 0 ? "waiting: next" : `waiting: ${count(at)} before it`;
}

function standing({ id, state, progress, trouble }) {
  const { percent, steps, steps_done, eta_s } = progress;
  if (state === "queued" && trouble) return "waiting for the disk";
  if (state === "queued") return inQueue(id);
  if (state === "running" && steps === 0) return "searching for a method and a step";
  if (state !== "running" && steps === 0) return "no steps";
  if (state !== "running") return steps_done === steps ? counted(steps, "step") : `${count(steps_done)} of ${counted(steps, "step")}`;
  return `${percent.toFixed(1)} %, ${eta_s == null ? "starting" : `${span(eta_s)} left`}`;
}

// Describes the state of a job in plain words.
function outcome(job) {
  const { summary, state, plan } = job;
  if (state === "queued" && job.trouble) return `The job is stored and will be tried again: ${job.trouble.message}.`;
  if (state === "queued") return "The job is stored and waits for a free worker.";
  if (state === "running") return "The job is running. You may close this page: the job continues.";
  if (!summary) return state === "cancelled" ? "Stopped before it began." : "";
  if (summary.steps === 0 && !summary.ensemble) return state === "failed" ? "It failed at its first step: the log holds only the start." : "Stopped before its first step.";
  const made = `${counted(summary.steps, "step")}, to t = ${figure(summary.time_s)} s${summary.time_s < 600 ? "" : ` (${clock(summary.time_s)})`}, in ${span(summary.wall_s)}${summary.stopped ? `, where it ended early: ${summary.stopped}` : ""}`;
  const parts = [state === "succeeded" ? `Done: ${made}.` : state === "failed" ? `It failed after ${made}.` : `Stopped after ${made}.`];
  const { energy, orthogonality, momentum, ensemble } = summary;
  if (ensemble) {
    const failed = Object.entries(ensemble.failed ?? {}).map(([code, number]) => `, ${count(number)} ${code}`).join("");
    const stopped = Object.entries(ensemble.stopped ?? {}).map(([pointer, number]) => `, ${count(number)} by ${pointer}`).join("");
    parts[0] = `${count(ensemble.succeeded)} of ${counted(ensemble.members, "member")} finished${stopped}${failed}, in ${span(summary.wall_s)}. Member 0:`;
  }
  if (energy && plan?.balance) {
    const { initial, least, largest, last } = energy;
    if (last != null) parts.push(`The energy was ${figure(initial)} J at the start and ${figure(last)} J at the end, between ${figure(least)} J and ${figure(largest)} J.`);
    parts.push(`Its balance, ${plan.balance}, is constant to ${figure(energy.max_abs_error)} J.`);
  } else if (energy) parts.push(`The energy, ${figure(energy.initial)} J, is constant to ${figure(energy.max_abs_error)} J.`);
  if (orthogonality) parts.push(orthogonality.max < 1e-14
    ? `The attitude stayed a rotation to round-off (${figure(orthogonality.max)}).`
    : `The attitude deviates from a rotation by ${figure(orthogonality.max)}.`);
  const kept = plan?.momentum_balance ? "The spatial momentum less the impulse of the torques" : "The conserved part of the momentum";
  if (momentum) parts.push(`${kept} drifted by ${figure(momentum.max_drift)} kg m²/s.`);
  if (summary.warning) parts.push(`Warning: ${summary.warning}.`);
  return parts.join(" ");
}
