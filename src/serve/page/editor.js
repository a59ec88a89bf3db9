// The editor of a scenario: what is wrong is shown at its field.
const text = $("text");

// Where the value at a JSON pointer stands in a text that parses: [begin, end]; of what is missing, its parent.
function place(source, pointer) {
  const wanted = pointer.split("/").slice(1).map(key => key.replace(/~1/g, "/").replace(/~0/g, "~"));
  let at = 0, found = null, depth = -1;
  const blank = () => { while (/\s/.test(source[at] ?? "")) at += 1; };
  const string = () => { const begin = at++; while (source[at] !== '"') at += source[at] === "\\" ? 2 : 1; at += 1; return JSON.parse(source.slice(begin, at)); };
  const value = path => {
    blank();
    const begin = at;
    const open = source[at];
    if (open === '"') string();
    else if (open === "{" || open === "[") {
      at += 1;
      for (let index = 0; ; index += 1) {
        blank();
        if (source[at] === "}" || source[at] === "]") { at += 1; break; }
        if (source[at] === ",") { at += 1; blank(); }
        const key = open === "{" ? string() : String(index);
        if (open === "{") { blank(); at += 1; }
        value([...path, key]);
      }
    } else while (at < source.length && !/[\s,\]}]/.test(source[at])) at += 1;
    if (path.length > depth && path.every((key, i) => key === wanted[i])) { depth = path.length; found = [begin, at]; }
  };
  try { JSON.parse(source); value([]); } catch { return null; }
  return found;
}

function unmark() {
  $("marks").replaceChildren();
  $("problem").replaceChildren();
  text.removeAttribute("aria-invalid");
}

// Shows what is wrong with the text, at the field.
function complain({ body, message }) {
  unmark();
  text.setAttribute("aria-invalid", "true");
  const spot = body?.pointer != null ? place(text.value, body.pointer.replace(/^\/scenario(?=\/|$)/, "")) : null;
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

async function runJob(scenario) {
  const job = await submit("jobs", scenario);
  if (!job) return;
  say(`Job ${job.name} accepted`);
  location.hash = `#/jobs/${job.id}`;
  await refresh();
}

$("editor").onsubmit = event => { event.preventDefault(); runJob(text.value); };
$("study").onclick = async () => {
  let scenario;
  try { scenario = JSON.parse(text.value); } catch (error) { complain(error); return; }
  const study = await submit("studies", JSON.stringify({ kind: $("kind").value, scenario }));
  if (!study) return;
  location.hash = `#/studies/${study.id}`;
  await refresh();
};
text.oninput = unmark;
text.onscroll = () => { $("marks").scrollTop = text.scrollTop; $("marks").scrollLeft = text.scrollLeft; };
$("shipped").onchange = async () => {
  unmark();
  const chosen = $("shipped").selectedOptions[0];
  if (!chosen?.value) return;
  $("about").textContent = chosen.dataset.about;
  text.value = await (await call(`scenarios/${chosen.value}`)).text();
};
