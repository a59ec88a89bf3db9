// The editor of a scenario: what is wrong is shown at its field.
const text = $("text");

// The values of a JSON text and where they stand: { begin, end, kind, entries: [{ key, begin, value }] }. Null if it is
// no JSON.
function parsed(source) {
  let at = 0;
  const blank = () => { while (/\s/.test(source[at] ?? "")) at += 1; };
  const string = () => { const begin = at++; while (source[at] !== '"') at += source[at] === "\\" ? 2 : 1; at += 1; return JSON.parse(source.slice(begin, at)); };
  const value = () => {
    blank();
    const [begin, kind, entries] = [at, source[at], []];
    if (kind === '"') string();
    else if (kind === "{" || kind === "[") {
      for (at += 1; ;) {
        blank();
        if (source[at] === "}" || source[at] === "]") { at += 1; break; }
        if (source[at] === ",") { at += 1; blank(); }
        const begin = at;
        const key = kind === "{" ? string() : String(entries.length);
        if (kind === "{") { blank(); at += 1; }
        entries.push({ key, begin, value: value() });
      }
    } else while (at < source.length && !/[\s,\]}]/.test(source[at])) at += 1;
    return { begin, end: at, kind, entries };
  };
  try { JSON.parse(source); return value(); } catch { return null; }
}

const child = (node, key) => node?.entries.find(entry => entry.key === key)?.value;

// Where the value at a JSON pointer stands: [begin, end]; of what is missing, its parent.
function place(source, pointer) {
  let node = parsed(source);
  if (!node) return null;
  for (const key of pointer.split("/").slice(1)) {
    const next = child(node, key.replace(/~1/g, "/").replace(/~0/g, "~"));
    if (!next) break;
    node = next;
  }
  return [node.begin, node.end];
}

// JSON in one line, as the shipped scenarios have it.
function line(value) {
  if (Array.isArray(value)) return `[${value.map(line).join(", ")}]`;
  if (value === null || typeof value !== "object") return JSON.stringify(value);
  const parts = Object.entries(value).map(([key, value]) => `${JSON.stringify(key)}: ${line(value)}`);
  return parts.length ? `{ ${parts.join(", ")} }` : "{}";
}

// The text with another value at a path of keys, given as JSON; without it if that is null. All else stays as written.
function altered(source, path, json) {
  const root = parsed(source);
  const [keys, last] = [path.slice(0, -1), path.at(-1)];
  const parent = keys.reduce(child, root);
  if (parent?.kind !== "{") {
    // What it stands in is missing, too.
    return json === null || !keys.length || !root ? source : altered(source, keys, `{ ${JSON.stringify(last)}: ${json} }`);
  }
  const { entries, begin, end } = parent;
  const index = entries.findIndex(entry => entry.key === last);
  const cut = (from, to, middle) => source.slice(0, from) + middle + source.slice(to);
  if (index >= 0 && json !== null) return cut(entries[index].value.begin, entries[index].value.end, json);
  if (index >= 0) {
    if (entries.length === 1) return cut(begin, end, "{}");
    return index > 0 ? cut(entries[index - 1].value.end, entries[index].value.end, "") : cut(entries[0].begin, entries[1].begin, "");
  }
  if (json === null) return source;
  const member = `${JSON.stringify(last)}: ${json}`;
  if (!entries.length) return cut(begin, end, `{ ${member} }`);
  // As the members before it: on a line of its own, or not.
  const before = source.slice(entries.length > 1 ? entries.at(-2).value.end + 1 : begin + 1, entries.at(-1).begin);
  return cut(entries.at(-1).value.end, entries.at(-1).value.end, `,${/\s/.test(before) ? before.match(/\s[^]*$/)[0] : " "}${member}`);
}

// ---- what stood there before

// What is written is kept: for the tab, and for the next one.
const DRAFT = "vpd-draft";
const past = [], future = [];
let draft = { text: "", from: "", edited: false, at: 0 };
let typed = 0;

function keep() {
  for (const store of [sessionStorage, localStorage]) try { store.setItem(DRAFT, JSON.stringify(draft)); } catch { /* Full, or not allowed. */ }
}

function kept() {
  for (const store of [sessionStorage, localStorage]) try {
    const found = JSON.parse(store.getItem(DRAFT));
    if (typeof found?.text === "string" && found.text) return found;
  } catch { /* Not ours. */ }
  return null;
}

// Takes note of a new text. Letters typed one after another are one step back.
function noted(fresh, letters = false) {
  const now = Date.now();
  if (!letters || now - typed > 1000) past.push(draft);
  if (past.length > 300) past.shift();
  typed = letters ? now : 0;
  future.length = 0;
  draft = fresh;
  keep();
}

function showDraft() {
  unmark();
  text.value = draft.text;
  text.setSelectionRange(draft.at, draft.at);
  $("shipped").value = draft.from;
  $("about").textContent = $("shipped").selectedOptions[0]?.dataset.about ?? "";
  fillForm();
}

// Puts another text into the editor; one that somebody wrote can be had back.
function replaceText(fresh, from, what) {
  const lost = draft.edited && draft.text.trim() && draft.text !== fresh;
  noted({ text: fresh, from, edited: false, at: 0 });
  showDraft();
  text.scrollTop = 0;
  $("replaced").hidden = !lost;
  if (lost) put($("replaced-by"), `Your text was replaced by ${what}.`);
}

// Changes the text as the form says.
function alter(change) {
  const fresh = change(text.value);
  if (fresh === text.value) return;
  noted({ ...draft, text: fresh, edited: true });
  text.value = fresh;
  unmark();
}

function back(from, to) {
  if (!from.length) return;
  to.push(draft);
  draft = from.pop();
  typed = 0;
  keep();
  showDraft();
  $("replaced").hidden = true;
}

text.oninput = () => {
  if (text.value === draft.text) return;
  const letters = Math.abs(text.value.length - draft.text.length) <= 2;
  noted({ ...draft, text: text.value, edited: true, at: text.selectionStart }, letters);
  $("replaced").hidden = true;
  unmark();
  fillForm();
};
text.addEventListener("beforeinput", event => {
  if (!event.inputType.startsWith("history")) return;
  event.preventDefault();
  if (event.inputType === "historyUndo") back(past, future); else back(future, past);
});
text.onkeydown = event => {
  const key = event.ctrlKey || event.metaKey ? event.key.toLowerCase() : "";
  if (key !== "z" && key !== "y") return;
  event.preventDefault();
  if (key === "y" || event.shiftKey) back(future, past); else back(past, future);
};
$("undo").onclick = () => { back(past, future); text.focus(); };
$("editor").onkeydown = event => {
  if (event.key === "Enter" && (event.ctrlKey || event.metaKey)) { event.preventDefault(); $("editor").requestSubmit(); }
};

// ---- what is wrong

function unmark() {
  $("marks").replaceChildren();
  $("problem").replaceChildren();
  text.removeAttribute("aria-invalid");
}

// Shows what is wrong with the text, at the field.
function complain({ body, message }) {
  unmark();
  text.setAttribute("aria-invalid", "true");
  // What is studied is the text; of a sweep it is in the text.
  const pointer = isSweep(text.value) ? body?.pointer : body?.pointer?.replace(/^\/scenario(?=\/|$)/, "");
  const spot = pointer != null ? place(text.value, pointer) : null;
  const line = spot && text.value.slice(0, spot[0]).split("\n").length;
  $("problem").append(h("strong", {}, line ? `Line ${line}` : "Rejected"), body?.pointer ? h("code", {}, ` ${body.pointer}`) : "", `: ${message}`);
  if (!spot) return;
  const [begin, end] = spot;
  const short = Math.min(end, begin + 200);
  $("marks").append(text.value.slice(0, begin), h("mark", {}, text.value.slice(begin, short)), text.value.slice(short));
  text.focus();
  text.setSelectionRange(begin, begin);
  text.scrollTop = Math.max(0, (line - 5) * 18.85);
  $("marks").scrollTop = text.scrollTop;
}

async function submit(path, body) {
  unmark();
  try { return await send(path, body); } catch (error) { complain(error); return null; }
}

// Whether a text is a sweep: a scenario has no fields to vary.
function isSweep(source) {
  try { return Array.isArray(JSON.parse(source).vary); } catch { return false; }
}

async function runSweep(source) {
  const study = await submit("studies", JSON.stringify({ ...JSON.parse(source), kind: "sweep" }));
  if (!study) return;
  location.hash = `#/studies/${study.id}`;
  await refresh();
}

async function runJob(scenario) {
  const job = await submit("jobs", scenario);
  if (!job) return;
  say(`Job ${job.name} accepted`);
  location.hash = `#/jobs/${job.id}`;
  await refresh();
}

$("editor").onsubmit = event => { event.preventDefault(); isSweep(text.value) ? runSweep(text.value) : runJob(text.value); };
$("study").onclick = async () => {
  let scenario;
  try { scenario = JSON.parse(text.value); } catch (error) { complain(error); return; }
  const study = await submit("studies", JSON.stringify({ kind: $("kind").value, scenario }));
  if (!study) return;
  location.hash = `#/studies/${study.id}`;
  await refresh();
};
text.onscroll = () => { $("marks").scrollTop = text.scrollTop; $("marks").scrollLeft = text.scrollLeft; };
$("shipped").onchange = async () => {
  const chosen = $("shipped").value;
  if (chosen) replaceText(await (await call(`scenarios/${chosen}`)).text(), chosen, chosen);
};

// ---- an address that holds the text

const packed = async (bytes, way) => new Uint8Array(await new Response(new Blob([bytes]).stream().pipeThrough(way)).arrayBuffer());

async function shareLink() {
  const bytes = await packed(new TextEncoder().encode(text.value), new CompressionStream("deflate-raw"));
  const letters = btoa(Array.from(bytes, byte => String.fromCharCode(byte)).join(""));
  const link = new URL(base);
  link.hash = `#/draft/${letters.replaceAll("+", "-").replaceAll("/", "_").replaceAll("=", "")}`;
  return link.href;
}

// The text of such an address; null if it is damaged, or longer than a scenario may be.
async function shared(letters) {
  try {
    const bytes = Uint8Array.from(atob(letters.replaceAll("-", "+").replaceAll("_", "/")), letter => letter.charCodeAt(0));
    const found = new TextDecoder().decode(await packed(bytes, new DecompressionStream("deflate-raw")));
    return found.length <= 1 << 20 ? found : null;
  } catch { return null; }
}

$("share").onclick = async () => {
  const link = await shareLink();
  try { await navigator.clipboard.writeText(link); say("Address copied"); put($("share"), "Copied"); } catch {
    // Not allowed here: it stands in the address bar.
    history.replaceState(null, "", link);
    put($("share"), "See the address bar");
  }
  setTimeout(() => put($("share"), "Copy address"), 3000);
};
