// The short form next to the text: what people change first. It shows what the text says, and changes nothing else in it.
const EXPLICIT = ["rkmk", "rk", "rk_projected"], COMPOSED = ["splitting", "lgvi"];
const GAUSS = Array.from({ length: 8 }, (_, k) => `gauss${k + 1}`);

// Returns the tableaux or orders of a method; for an unknown one none.
function schemes(method) {
  if (method === "auto") return [];
  if (EXPLICIT.includes(method)) return ["rk3", "rk4", "rk8"];
  return COMPOSED.includes(method) ? ["2", "4", "6", "8"] : GAUSS;
}

// Methods and channels as the schema lists them.
async function makeForm() {
  schema = await json("scenario.schema.json", { patient: true });
  const { $defs } = schema;
  const options = $defs.MethodName.oneOf.map(({ const: name, description }) => h("option", { value: name, title: description }, name));
  $("method").replaceChildren(...options);
  $("channels").replaceChildren(...$defs.Channel.oneOf.map(({ const: topic, description }) => h("label", { title: description },
    h("input", { type: "checkbox", value: topic, onchange: setChannels }), topic)));
}

let filled = null;

// Shows what the text says; a text that is no scenario yet leaves the form as it was, out of use.
function fillForm() {
  try { filled = JSON.parse(text.value); } catch { filled = null; }
  if (typeof filled !== "object" || Array.isArray(filled)) filled = null;
  $("short").disabled = !filled;
  $("short-off").hidden = Boolean(filled) || !text.value.trim();
  if (!filled) return;
  const set = (id, value) => { const node = $(id); if (node.value !== value && document.activeElement !== node) node.value = value; };
  const number = value => value == null ? "" : String(value);
  const chosen = filled.accuracy != null;
  const method = filled.method?.name ?? "auto";
  $("method").value = method;
  const made = [h("option", { value: "" }, "default"), ...schemes(method).map(name =>
    h("option", { value: name }, COMPOSED.includes(method) ? `order ${name}` : name))];
  $("scheme").replaceChildren(...made);
  const { tableau, order } = filled.method ?? {};
  $("scheme").value = typeof tableau === "string" ? tableau : number(order);
  $("method").disabled = chosen;
  $("scheme").disabled = chosen || made.length < 2;
  $("by").value = chosen ? "accuracy" : "step_s";
  set("by-value", number(chosen ? filled.accuracy?.error : filled.step_s));
  $("long").value = filled.steps != null ? "steps" : "duration_s";
  set("long-value", number(filled.steps ?? filled.duration_s));
  $("long").disabled = chosen;
  const channels = filled.log?.channels;
  for (const box of $("channels").querySelectorAll("input")) box.checked = !Array.isArray(channels) || channels.includes(box.value);
  put($("channels-word"), Array.isArray(channels) ? `Channels: ${channels.length} chosen` : "Channels: all");
}

// A number as it was typed, if JSON takes it; null if it is none.
function numeral(typed) {
  const plain = typed.trim().replace(",", ".");
  if (!plain || !Number.isFinite(Number(plain))) return null;
  try { JSON.parse(plain); return plain; } catch { return String(Number(plain)); }
}

const changed = change => () => { if (filled) { alter(change); fillForm(); } };

$("method").onchange = changed(source => {
  const name = $("method").value;
  const { tableau, order, solver } = filled.method ?? {};
  // Choices that do not fit the new method are removed.
  const fits = value => value != null && schemes(name).includes(String(value));
  return altered(source, ["method"], line({ name, ...fits(tableau) && { tableau }, ...fits(order) && { order }, ...solver && { solver } }));
});

$("scheme").onchange = changed(source => {
  const scheme = $("scheme").value;
  const key = COMPOSED.includes(filled.method?.name) ? "order" : "tableau";
  return altered(source, ["method", key], !scheme ? null : key === "order" ? scheme : JSON.stringify(scheme));
});

$("by").onchange = changed(source => {
  const { steps, step_s } = filled;
  if ($("by").value === "accuracy") {
    const seconds = Number((steps * step_s).toPrecision(12));
    source = renamed(altered(source, ["method"], null), "step_s", "accuracy", line({ error: 1e-6 }));
    return steps == null ? source : renamed(source, "steps", "duration_s", String(seconds || 1));
  }
  return renamed(source, "accuracy", "step_s", "0.001");
});

$("by-value").oninput = changed(source => {
  const value = numeral($("by-value").value);
  if (value === null) return source;
  return altered(source, $("by").value === "accuracy" ? ["accuracy", "error"] : ["step_s"], value);
});

$("long").onchange = changed(source => {
  const { steps, step_s, duration_s } = filled;
  if ($("long").value === "steps") return renamed(source, "duration_s", "steps", String(Math.round(duration_s / step_s) || 1));
  return renamed(source, "steps", "duration_s", String(Number((steps * step_s).toPrecision(12)) || 1));
});

$("long-value").oninput = changed(source => {
  const value = numeral($("long-value").value);
  return value === null ? source : altered(source, [$("long").value], value);
});

function setChannels() {
  changed(source => {
    const boxes = [...$("channels").querySelectorAll("input")];
    const chosen = boxes.filter(box => box.checked).map(box => box.value);
    return altered(source, ["log", "channels"], chosen.length === boxes.length ? null : line(chosen));
  })();
}

// The text with another key, and its value, in the place of a key.
function renamed(source, key, fresh, json) {
  const entry = parsed(source)?.entries.find(entry => entry.key === key);
  if (!entry) return altered(source, [fresh], json);
  return `${source.slice(0, entry.begin)}${JSON.stringify(fresh)}: ${json}${source.slice(entry.value.end)}`;
}
