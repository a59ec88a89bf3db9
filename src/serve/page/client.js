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

async function call(path, options = {}) {
  const headers = { ...options.headers };
  const asked = token;
  if (token) headers.authorization = `Bearer ${token}`;
  const answer = await fetch(new URL(path.replace(/^\//, ""), base), { ...options, headers, cache: "no-store" });
  if (answer.ok) return answer;
  const problem = new Problem(await answer.json().catch(() => ({})), answer.status);
  // A request that was sent before the token was given says nothing about it.
  problem.shut = answer.status === 401 && asked === token;
  if (problem.shut && !options.quiet) askToken();
  throw problem;
}

const json = async (path, options) => (await call(path, options)).json();

const send = (path, text, headers = {}) =>
  json(path, { method: "POST", body: text, headers: { "content-type": "application/json", ...headers } });

function askToken() {
  if ($("token-dialog").open) return;
  $("token").value = token;
  $("token-dialog").showModal();
}

function say(text) { $("news").textContent = text; }

// Follows a job by its events until it has ended; where proxies cut the stream, by asking.
async function follow(id, seen, signal) {
  const tell = job => { seen(job); return ENDED.includes(job.state); };
  for (let cuts = 0; cuts < 2 && !signal.aborted; cuts += 1) {
    try {
      const answer = await call(`jobs/${id}/events`, { signal, quiet: true });
      if (!answer.headers.get("content-type")?.startsWith("text/event-stream")) break;
      const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
      let job = null;
      for (let rest = ""; ;) {
        const { value, done } = await reader.read();
        if (done) break;
        const events = (rest + value).split("\n\n");
        rest = events.pop();
        for (const event of events) {
          const field = name => event.split("\n").filter(line => line.startsWith(`${name}:`))
            .map(line => line.slice(name.length + 1).trim()).join("\n");
          const data = field("data") && JSON.parse(field("data"));
          if (field("event") === "state") job = data;
          else if (field("event") === "progress" && job) job = { ...job, progress: data };
          else continue;
          cuts = 0;
          if (tell(job)) return;
        }
      }
    } catch (error) {
      if (signal.aborted || error.status === 404 && error.body.code === "unknown_job") return;
    }
  }
  while (!signal.aborted) {
    try { if (tell(await json(`jobs/${id}`, { signal, quiet: true }))) return; } catch (error) {
      if (error.status === 404) return;
    }
    await new Promise(later => setTimeout(later, 1000));
  }
}

// ---- names in commands and files

// One word to a POSIX shell, whatever is in it.
const quoted = text => `'${text.replaceAll("'", "'\\''")}'`;

// A name that is safe as that of a file, and in a shell, on every system.
const fileName = name => name.replace(/[^A-Za-z0-9_.-]+/g, "-").replace(/^[-.]+|[-.]+$/g, "").slice(0, 80) || "log";

// ---- words and figures

const count = number => number.toLocaleString("en");
const figure = x => x === 0 ? "0" : Math.abs(x) >= 1e-3 && Math.abs(x) < 1e6 ? String(Number(x.toPrecision(4))) : x.toExponential(1);

function span(seconds) {
  if (seconds < 1) return `${Math.max(1, Math.round(seconds * 1000))} ms`;
  if (seconds < 90) return `${Number(seconds.toPrecision(3))} s`;
  if (seconds < 5400) return `${Math.round(seconds / 60)} min`;
  return seconds < 172800 ? `${(seconds / 3600).toFixed(1)} h` : `${Math.round(seconds / 86400)} days`;
}

// The time of today, or the day.
function when(created) {
  if (!created) return "";
  const at = new Date(created);
  const time = at.toLocaleTimeString([], { hour: "2-digit", minute: "2-digit" });
  return at.toDateString() === new Date().toDateString() ? time : `${at.toLocaleDateString([], { dateStyle: "medium" })}, ${time}`;
}

function standing({ state, progress, trouble }) {
  const { percent, steps, steps_done, eta_s } = progress;
  if (state === "queued") return trouble ? "waiting for the disk" : "waiting for a free worker";
  if (state === "running" && steps === 0) return "searching for a method and a step";
  if (state !== "running" && steps === 0) return "no steps";
  if (state !== "running") return `${count(steps_done)} of ${count(steps)} steps`;
  return `${percent.toFixed(1)} %, ${eta_s == null ? "starting" : `${span(eta_s)} left`}`;
}

// Describes the state of a job in plain words.
function outcome(job) {
  const { summary, state } = job;
  if (state === "queued" && job.trouble) return `The job is stored and will be tried again: ${job.trouble.message}.`;
  if (state === "queued") return "The job is stored and waits for a free worker.";
  if (state === "running") return "The job is running. You may close this page: the job continues.";
  if (!summary) return state === "cancelled" ? "Stopped before it began." : "";
  if (summary.steps === 0 && !summary.ensemble) return state === "failed" ? "It failed at its first step: the log holds only the start." : "Stopped before its first step.";
  const made = `${count(summary.steps)} steps, to t = ${figure(summary.time_s)} s, in ${span(summary.wall_s)}`;
  const parts = [state === "succeeded" ? `Done: ${made}.` : state === "failed" ? `It failed after ${made}.` : `Stopped after ${made}.`];
  const { energy, orthogonality, momentum, ensemble } = summary;
  if (ensemble) {
    const failed = Object.entries(ensemble.failed ?? {}).map(([code, number]) => `, ${count(number)} ${code}`).join("");
    parts[0] = `${count(ensemble.succeeded)} of ${count(ensemble.members)} members finished${failed}, in ${span(summary.wall_s)}. Member 0:`;
  }
  if (energy) parts.push(`The energy, ${figure(energy.initial)} J, is constant to ${figure(energy.max_abs_error)} J.`);
  if (orthogonality) parts.push(orthogonality.max < 1e-14
    ? `The attitude stayed a rotation to round-off (${figure(orthogonality.max)}).`
    : `The attitude deviates from a rotation by ${figure(orthogonality.max)}.`);
  if (momentum) parts.push(`The conserved part of the momentum drifted by ${figure(momentum.max_drift)} kg m²/s.`);
  if (summary.warning) parts.push(`Warning: ${summary.warning}.`);
  return parts.join(" ");
}
