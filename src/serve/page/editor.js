// The editor of a scenario: CodeMirror with what the schema says, drafts that are kept, and what is wrong at its field.
const { EditorView, EditorState, StateEffect, StateField } = codemirror;

// Where a text came from and what it was then: undone and redone with it.
const setPlaced = StateEffect.define();
const placed = StateField.define({
  create: () => ({ from: "", text: "" }),
  update: (value, change) => change.effects.findLast(effect => effect.is(setPlaced))?.value ?? value,
});
const placedBack = codemirror.invertedEffects.of(change =>
  change.effects.some(effect => effect.is(setPlaced)) ? [setPlaced.of(change.startState.field(placed))] : []);

const inks = codemirror.HighlightStyle.define([
  { tag: codemirror.tags.propertyName, class: "key" }, { tag: codemirror.tags.string, class: "string" },
  { tag: [codemirror.tags.number, codemirror.tags.bool, codemirror.tags.null], class: "number" },
]);

const run = () => { $("editor").requestSubmit(); return true; };

const view = new EditorView({
  parent: $("paper"),
  extensions: [
    codemirror.Prec.highest(codemirror.keymap.of([{ key: "Mod-Enter", run, preventDefault: true }, { key: "Mod-Shift-z", run: codemirror.redo, preventDefault: true }])),
    placed, placedBack, codemirror.history(), codemirror.json(), codemirror.syntaxHighlighting(inks),
    codemirror.lineNumbers(), codemirror.highlightSpecialChars(), codemirror.bracketMatching(), codemirror.closeBrackets(), codemirror.indentOnInput(),
    EditorView.lineWrapping, EditorState.tabSize.of(2),
    codemirror.autocompletion({ override: [completions], icons: false, defaultKeymap: true }),
    codemirror.hoverTooltip((_, at) => {
      const { path, from, to } = pathAt(text.value, at);
      const known = schema && meaning(text.value, path);
      if (!known) return null;
      return { pos: from, end: to, above: true, create: () => ({ dom: h("div", { className: "hint" }, ...explained(known)) }) };
    }),
    // Tab leaves the editor, as it leaves any other field.
    codemirror.keymap.of([...codemirror.closeBracketsKeymap, ...codemirror.defaultKeymap, ...codemirror.historyKeymap, ...codemirror.completionKeymap, ...codemirror.lintKeymap]),
    // Typed text is put in here: a browser that does it gives what it writes over a selection styles of its own, and complains
    // that the policy of the page forbids them.
    EditorView.domEventHandlers({ beforeinput: (event, view) => {
      if (event.inputType !== "insertText" || event.isComposing || !event.data) return false;
      const { from, to } = view.state.selection.main;
      const insert = () => view.state.update(view.state.replaceSelection(event.data), { userEvent: "input.type", scrollIntoView: true });
      event.preventDefault();
      if (!view.state.facet(EditorView.inputHandler).some(handle => handle(view, from, to, event.data, insert))) view.dispatch(insert());
      return true;
    } }),
    EditorView.contentAttributes.of({ id: "text", "aria-labelledby": "text-label", "aria-describedby": "keys problem", autocapitalize: "off" }),
    EditorView.updateListener.of(update => {
      if (update.docChanged) {
        $("replaced").hidden = true;
        unmark();
        fillForm();
      }
      if (update.startState.field(placed) !== update.state.field(placed)) showPlaced();
      if (update.docChanged || update.selectionSet) {
        keep();
        clearTimeout(pointing);
        pointing = setTimeout(showField, 60);
      }
    }),
  ],
});

// The interface of the editor for the other scripts.
const text = {
  get value() { return view.state.doc.toString(); },
  focus() { view.focus(); },
};

let pointing = 0;

const explained = ({ name, kind, said }) => [h("code", {}, name), ` ${kind}`, said ? h("br") : null, said ?? ""];

// Shows the meaning of the field at the cursor, for users without a mouse.
function showField() {
  const known = schema && meaning(text.value, pathAt(text.value, view.state.selection.main.head).path);
  $("keys").hidden = Boolean(known);
  $("field").replaceChildren(...known ? explained(known).filter(part => part !== null) : []);
}

// ---- what stood there before

// The text is kept: for the tab, and for the next one.
const DRAFT = "vpd-draft";

const edited = () => text.value !== view.state.field(placed).text;

function keep() {
  const draft = JSON.stringify({ text: text.value, from: view.state.field(placed).from, edited: edited(), at: view.state.selection.main.head });
  for (const store of [sessionStorage, localStorage]) try { store.setItem(DRAFT, draft); } catch { /* Full, or not allowed. */ }
}

function kept() {
  for (const store of [sessionStorage, localStorage]) try {
    const found = JSON.parse(store.getItem(DRAFT));
    if (typeof found?.text === "string" && found.text) return found;
  } catch { /* Not ours. */ }
  return null;
}

// Goes on with a draft. Nothing was there before it.
function restore({ text: found, from, edited, at }) {
  view.dispatch({
    changes: { from: 0, to: view.state.doc.length, insert: found }, selection: { anchor: Math.min(at || 0, EditorState.create({ doc: found }).doc.length) },
    effects: setPlaced.of({ from: from ?? "", text: edited ? null : view.state.toText(found).toString() }), annotations: codemirror.Transaction.addToHistory.of(false),
  });
}

function showPlaced() {
  $("shipped").value = view.state.field(placed).from;
  $("about").textContent = $("shipped").selectedOptions[0]?.dataset.about ?? "";
}

// Puts another text into the editor; one that the user wrote can be restored.
function replaceText(fresh, from, what) {
  if (!text.value) { restore({ text: fresh, from }); return; }
  const lost = edited() && text.value.trim() && text.value !== fresh;
  view.dispatch({
    changes: { from: 0, to: view.state.doc.length, insert: fresh }, selection: { anchor: 0 }, scrollIntoView: true,
    effects: setPlaced.of({ from, text: view.state.toText(fresh).toString() }), annotations: codemirror.isolateHistory.of("full"),
  });
  $("replaced").hidden = !lost;
  if (lost) put($("replaced-by"), `Your text was replaced by ${what}.`);
}

// Changes the text as the form says: only the part that differs, so that the cursor stays where it was.
function alter(change) {
  const before = text.value, fresh = change(before);
  if (fresh === before) return;
  let from = 0, end = 0;
  while (from < before.length && before[from] === fresh[from]) from += 1;
  while (end < Math.min(before.length, fresh.length) - from && before.at(-1 - end) === fresh.at(-1 - end)) end += 1;
  view.dispatch({ changes: { from, to: before.length - end, insert: fresh.slice(from, fresh.length - end) }, userEvent: "input.form" });
}

$("undo").onclick = () => { codemirror.undo(view); text.focus(); };
$("text-label").onclick = () => text.focus();
$("editor").onkeydown = event => {
  if (event.key === "Enter" && (event.ctrlKey || event.metaKey) && !event.defaultPrevented) { event.preventDefault(); run(); }
};

// ---- what is wrong

// The refusal of the service, until the text changes.
let refused = [];
let checking = 0;

function unmark() {
  refused = [];
  $("problem").replaceChildren();
  view.contentDOM.removeAttribute("aria-invalid");
  clearTimeout(checking);
  checking = setTimeout(() => calm().then(check), 300);
}

// Marks what is wrong at its place, and says what is wrong first.
function check() {
  clearTimeout(checking);
  const found = schema && text.value.trim() ? mistakes(text.value) : [];
  const marks = [...refused, ...found].sort((a, b) => a.from - b.from).map(mark => ({ severity: "error", ...mark }));
  view.dispatch(codemirror.setDiagnostics(view.state, marks));
  const [first] = found;
  putProse($("check"), refused.length || !first ? "" : `Line ${view.state.doc.lineAt(first.from).number}: ${first.message}${found.length > 1 ? ` (and ${found.length - 1} more)` : ""}`);
}

// Shows what the service says is wrong with the text, at the field.
function complain({ body, message, status }) {
  unmark();
  view.contentDOM.setAttribute("aria-invalid", "true");
  // The scenario of a study is the text itself; that of a sweep is in the text.
  const pointer = isSweep(text.value) ? body?.pointer : body?.pointer?.replace(/^\/scenario(?=\/|$)/, "");
  const spot = pointer != null ? place(text.value, pointer) : null;
  const line = spot && view.state.doc.lineAt(spot[0]).number;
  $("problem").append(h("strong", {}, line ? `Line ${line}` : status ? "Rejected" : "Not sent"), body?.pointer ? h("code", {}, ` ${body.pointer}`) : "", ...prose(`: ${message}`));
  if (spot) {
    const [from, end] = spot;
    refused = [{ from, to: Math.min(end, from + 200), message }];
    view.dispatch({ selection: { anchor: from }, effects: EditorView.scrollIntoView(from, { y: "center" }) });
    text.focus();
  }
  check();
}

// What was sent last without an answer, and its key: the service makes one job of it, however often it is sent.
let unanswered = null;

async function submit(path, body) {
  unmark();
  if (unanswered?.body !== body) {
    const key = Array.from(crypto.getRandomValues(new Uint8Array(16)), byte => byte.toString(16).padStart(2, "0")).join("");
    unanswered = { body, key };
  }
  try {
    const made = await send(path, body, { "idempotency-key": unanswered.key });
    unanswered = null;
    return made;
  } catch (error) {
    if (error.status) unanswered = null;
    else error.message += path === "jobs" ? " Press again: one job is made of it, also if this one has come." : " Look in the list before you press again.";
    await calm();
    complain(error);
    return null;
  }
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

$("editor").onsubmit = event => {
  event.preventDefault();
  press($("run"), () => isSweep(text.value) ? runSweep(text.value) : runJob(text.value));
};
$("study").onclick = () => press($("study"), async () => {
  let scenario;
  try { scenario = JSON.parse(text.value); } catch (error) { complain(error); return; }
  const study = await submit("studies", JSON.stringify({ kind: $("kind").value, scenario }));
  if (!study) return;
  location.hash = `#/studies/${study.id}`;
  await refresh();
});
$("shipped").onchange = async () => {
  const chosen = $("shipped").value;
  if (!chosen) return;
  try { replaceText(await (await call(`scenarios/${chosen}`)).text(), chosen, chosen); } catch (error) {
    say(error.message, true);
    showPlaced();
  }
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
