// Checks of a scenario by its JSON Schema: missing or unknown fields of a text, values that could
// stand at a place, and the meaning of a field. The service has the last word; this one is quick.
let schema = null;

// A schema with what it refers to; what it says itself comes first.
function resolved(node) {
  const { $ref, ...own } = node;
  return $ref ? { ...resolved(schema.$defs[$ref.split("/").at(-1)]), ...own } : own;
}

// The forms a value may have.
function forms(node) {
  const own = resolved(node);
  const of = own.oneOf ?? own.anyOf;
  return of ? of.flatMap(forms).map(form => ({ said: own.description, ...form })) : [own];
}

const typeOf = ({ kind }, source) => ({ "{": "object", "[": "array", String: "string", Number: /^-?\d+$/.test(source) ? "integer" : "number", True: "boolean", False: "boolean", Null: "null" })[kind];

const types = form => [form.type ?? (form.const !== undefined || form.enum ? "string" : [])].flat();

// The forms that a value has, or comes nearest to: by its type, by a field that names its kind, by the fields it has.
function fitting(all, node, source) {
  if (!node) return all;
  const type = typeOf(node, source.slice(node.begin, node.end));
  const typed = all.filter(form => types(form).some(of => of === type || of === "number" && type === "integer"));
  if (node.kind !== "{") return typed;
  const named = typed.filter(form => node.entries.every(({ key, value }) => {
    const wanted = form.properties?.[key]?.const;
    return wanted === undefined || !value || source.slice(value.begin, value.end) === JSON.stringify(wanted);
  }));
  const strange = form => node.entries.filter(({ key }) => !form.properties?.[key]).length;
  const least = Math.min(...(named.length ? named : typed).map(strange));
  return (named.length ? named : typed).filter(form => strange(form) === least);
}

function within(form, key) {
  const own = form.properties?.[key];
  // A form that is known by its one field means what the field means.
  if (own && !resolved(own).description && String(form.required) === key) return [{ ...own, description: form.description }];
  return [own ?? form.prefixItems?.[key] ?? (/^\d+$/.test(key) ? form.items : null)].filter(Boolean);
}

// A sweep is a file around a scenario.
const rootForm = root => child(root, "vary") ? { type: "object", properties: { scenario: schema } } : schema;

// The forms of the value at a path of keys, and that value.
function formsAt(source, root, path) {
  let [found, node] = [[rootForm(root)].flatMap(forms), root];
  for (const key of path) {
    found = fitting(found, node, source).flatMap(form => within(form, key)).flatMap(forms);
    node = child(node, key);
  }
  return { found, node };
}

// ---- what is wrong

const listed = (names, most = 12) => names.length > most ? `${names.slice(0, most).join(", ")}, …` : names.join(", ");
const article = word => `${/^[aeio]/.test(word) ? "an" : "a"} ${word}`;

// Returns the mistakes in a text: [{ from, to, message }], in the order of the text.
function mistakes(source) {
  try { JSON.parse(source); } catch (error) { return [unfinished(source, error)]; }
  const root = tree(source);
  const found = [];
  const add = (from, to, message) => found.push({ from, to, message });
  const look = (all, node, name) => {
    const text = source.slice(node.begin, node.end);
    const here = fitting(all, node, source);
    if (!here.length) {
      const wanted = [...new Set(all.flatMap(types).filter(type => type !== "null"))];
      if (wanted.length) add(node.begin, node.end, `${name} is ${article(typeOf(node, text))}, expected ${wanted.map(article).join(" or ")}`);
      return;
    }
    const words = here.flatMap(form => form.enum ?? (form.const !== undefined ? [form.const] : [null]));
    if (!words.includes(null) && !words.some(word => JSON.stringify(word) === text)) add(node.begin, node.end, `${text} is not one of ${listed(words, 30)}`);
    const form = here[0];
    if (form.minimum !== undefined && Number(text) < form.minimum) add(node.begin, node.end, `${name} must be ${form.minimum} or more`);
    if (form.maximum !== undefined && Number(text) > form.maximum) add(node.begin, node.end, `${name} must be ${form.maximum} or less`);
    if (node.kind === "[") {
      const count = node.entries.length;
      if (form.minItems > count || form.maxItems < count) add(node.begin, node.end, `${name} has ${count} entries, expected ${form.minItems ?? form.maxItems}`);
    }
    if (node.kind === "{" && form.additionalProperties === false)
      for (const { key, begin, named } of node.entries) if (!form.properties?.[key]) add(begin, named, `${JSON.stringify(key)} is not known here; expected one of ${listed(Object.keys(form.properties))}`);
    const absent = node.kind === "{" ? (form.required ?? []).filter(key => !child(node, key)) : [];
    if (absent.length) add(node.begin, node.begin + 1, `${name} needs ${listed(absent.map(key => JSON.stringify(key)))}`);
    for (const { key, value } of node.entries) {
      const inner = here.flatMap(form => within(form, key)).flatMap(forms);
      if (inner.length && value) look(inner, value, node.kind === "[" ? name : JSON.stringify(key));
    }
  };
  try { if (root) look([rootForm(root)], root, "the scenario"); } catch { /* Nested too deeply: the service says so. */ }
  return found.sort((a, b) => a.from - b.from);
}

// Returns the place where a text stops being JSON: where the parser stumbles first.
function unfinished(source, { message }) {
  let at = Number(/position (\d+)/.exec(message)?.[1] ?? source.length);
  codemirror.jsonLanguage.parser.parse(source).iterate({ enter: node => { if (node.type.isError) at = Math.min(at, node.from); } });
  const from = Math.max(0, Math.min(at, source.trimEnd().length - 1));
  const [word] = /^("(\\.|[^"\\\n])*"?|[\w.+-]+|[^])?/.exec(source.slice(from));
  return { from, to: from + word.length, message: `This is not valid JSON yet: ${message.replace(/^JSON.parse: | (in JSON )?at (position|line) .*/gs, "")}` };
}

// ---- what a field means

const bounds = form => [form.minimum !== undefined && `at least ${form.minimum}`, form.maximum !== undefined && `at most ${form.maximum}`].filter(Boolean);

// Returns what is known of the value at a path: its name, its kind, its meaning.
function meaning(source, path) {
  const root = tree(source);
  const { found, node } = formsAt(source, root, path);
  const here = node ? fitting(found, node, source) : found;
  const form = here[0] ?? found[0];
  if (!form || !path.length) return null;
  const kinds = [...new Set(found.flatMap(types).filter(type => type !== "null"))];
  const parts = [kinds.join(" or "), ...bounds(form)];
  if (form.default !== undefined && JSON.stringify(form.default).length < 60) parts.push(`${line(form.default)} if absent`);
  const text = node ? source.slice(node.begin, node.end) : "";
  const word = found.find(form => form.const !== undefined && JSON.stringify(form.const) === text);
  const said = [...new Set([form.said ?? form.description, word?.description ?? form.description])].filter(Boolean);
  // An entry of a list means what the list means.
  if (!said.length && /^\d+$/.test(path.at(-1))) said.push(meaning(source, path.slice(0, -1))?.said ?? "");
  return { name: /^\d+$/.test(path.at(-1)) ? `${path.at(-2)}[${path.at(-1)}]` : path.at(-1), kind: parts.filter(Boolean).join(", "), said: said.join(" ") };
}

// The path to what stands at a place, and where that begins and ends; the root has none.
function pathAt(source, at) {
  let node = tree(source);
  const path = [];
  let [from, to] = [node?.begin ?? 0, node?.end ?? 0];
  while (node) {
    const entry = node.entries.find(({ begin, named, value }) => begin <= at && at <= (value?.end ?? named ?? begin));
    if (!entry) break;
    path.push(entry.key);
    // On its name, or on its value.
    [from, to] = entry.named >= at ? [entry.begin, entry.named] : [entry.value?.begin ?? entry.begin, entry.value?.end ?? entry.named];
    if (entry.named >= at) break;
    node = entry.value;
  }
  return { path, from, to };
}

// ---- what could stand at a place

// Returns the state of a text before a place: the keys that lead there, and whether a key or a
// value begins at `from`.
function reached(source, at) {
  const open = [];
  let [from, wants] = [at, "value"];
  for (let k = 0; k < at;) {
    const letter = source[k], top = open.at(-1);
    if (letter === '"') {
      const begin = k++;
      while (k < at && source[k] !== '"') k += source[k] === "\\" ? 2 : 1;
      if (k >= at) { from = begin; return { path: open.map(level => level.key), from, wants, quoted: true }; }
      k += 1;
      if (top && wants === "key") try { top.key = JSON.parse(source.slice(begin, k)); } catch { top.key = ""; }
      wants = wants === "key" ? "colon" : "none";
      continue;
    }
    if (letter === "{" || letter === "[") { open.push({ array: letter === "[", key: letter === "[" ? "0" : "" }); wants = letter === "{" ? "key" : "value"; }
    else if (letter === "}" || letter === "]") { open.pop(); wants = "none"; }
    else if (letter === ":") wants = "value";
    else if (letter === "," && top) { if (top.array) top.key = String(Number(top.key) + 1); wants = top.array ? "value" : "key"; }
    else if (!/\s/.test(letter)) {
      const begin = k;
      while (k < at && /[^\s,:{}[\]"]/.test(source[k])) k += 1;
      if (k >= at) { from = begin; return { path: open.map(level => level.key), from, wants, quoted: false }; }
      wants = "none";
      continue;
    }
    k += 1;
  }
  return { path: open.map(level => level.key), from: at, wants, quoted: false };
}

// A value to begin with, as a template: what is to be filled in stands in `${}`.
function skeleton(node, places = { count: 0 }) {
  const [form] = forms(node);
  const gap = text => `\${${places.count += 1}:${text}}`;
  if (form.const !== undefined) return JSON.stringify(form.const);
  const [type] = types(form);
  if (type === "object") {
    const inner = (form.required ?? []).map(key => `${JSON.stringify(key)}: ${skeleton(form.properties[key], places)}`);
    return inner.length ? `{ ${inner.join(", ")} }` : `{ ${gap("")} }`;
  }
  if (type === "array") return `[${Array.from({ length: form.minItems ?? 1 }, () => form.minItems ? skeleton(form.items, places) : gap("")).join(", ")}]`;
  if (type === "string") return form.enum ? JSON.stringify(form.enum[0]) : `"${gap("")}"`;
  if (type === "boolean") return gap("true");
  return gap(type === "null" ? "null" : "0");
}

// Puts a template in the place of what was typed, with the commas and the closing quote that go with it.
const inserted = template => (view, completion, from, to) => {
  const after = view.state.sliceDoc(to);
  const end = to + (view.state.sliceDoc(from, from + 1) === '"' && after[0] === '"' ? 1 : 0);
  const next = view.state.sliceDoc(end).trimStart()[0];
  codemirror.snippet(`${template}${next && !/[,}\]:]/.test(next) ? "," : ""}`)(view, completion, from, end);
};

function completions({ state, pos, explicit }) {
  if (!schema) return null;
  const source = state.doc.toString();
  const { path, from, wants, quoted } = reached(source, pos);
  if (wants !== "key" && wants !== "value" || !explicit && !quoted && from === pos) return null;
  const colon = /^[\w$]*"?\s*:/.test(source.slice(pos));
  const keys = path.slice(0, wants === "key" ? -1 : path.length);
  // Half a key would hide what comes after it.
  const end = pos + (quoted && source[pos] === '"' ? 1 : 0);
  const whole = wants === "key" && !colon ? source.slice(0, from) + " ".repeat(end - from) + source.slice(end) : source;
  const { found, node } = formsAt(whole, tree(whole), keys);
  const options = [];
  if (wants === "key") {
    const others = node && { ...node, entries: node.entries.filter(entry => entry.begin !== from) };
    const taken = new Set(others?.entries.map(entry => entry.key));
    for (const form of fitting(found, others, whole))
      for (const [key, of] of Object.entries(form.properties ?? {})) {
        if (taken.has(key) || options.some(option => option.label === `"${key}"`)) continue;
        const needed = form.required?.includes(key);
        const [first] = forms(of);
        options.push({ label: `"${key}"`, detail: needed ? "required" : types(first)[0], info: resolved(of).description ?? first.description, boost: needed ? 2 : key === "$schema" ? -1 : 0, type: "property",
          apply: inserted(colon ? `"${key}"` : `"${key}": ${skeleton(of)}`) });
      }
  } else {
    const add = (label, form, template) => { if (!options.some(option => option.label === label)) options.push({ label, info: form.description, type: "constant", apply: inserted(template) }); };
    for (const form of found) {
      for (const word of form.enum ?? (form.const !== undefined ? [form.const] : [])) add(JSON.stringify(word), form, JSON.stringify(word));
      if (types(form).includes("boolean")) { add("true", form, "true"); add("false", form, "false"); }
      if (types(form).includes("object") && !quoted) add(skeleton(form).replace(/\$\{\d+:([^}]*)\}/g, "$1"), form, skeleton(form));
      if (types(form).includes("array") && !quoted) add("[]", form, skeleton(form));
    }
  }
  return options.length ? { from, options, validFor: /^"?[\w$]*$/ } : null;
}
