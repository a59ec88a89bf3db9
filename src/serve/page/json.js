// JSON as a text: which value stands where, and the text with another value in it.

// The values of a text and where they stand, also while it is not complete: { begin, end, kind, entries: [{ key, begin,
// value }] }; null if there is none.
function tree(source) {
  const value = node => {
    const { from: begin, to: end, name } = node;
    const entries = [];
    for (let inner = node.firstChild; inner; inner = inner.nextSibling) {
      if (name === "Array" && /^[A-Z]/.test(inner.name)) entries.push({ key: String(entries.length), begin: inner.from, value: value(inner) });
      if (inner.name !== "Property") continue;
      const said = inner.getChild("PropertyName"), last = inner.lastChild;
      if (!said) continue;
      let key;
      try { key = JSON.parse(source.slice(said.from, said.to)); } catch { continue; }
      entries.push({ key, begin: inner.from, named: said.to, value: last !== said && /^[A-Z]/.test(last.name) ? value(last) : null });
    }
    return { begin, end, kind: { Object: "{", Array: "[" }[name] ?? name, entries };
  };
  for (let node = codemirror.jsonLanguage.parser.parse(source).topNode.firstChild; node; node = node.nextSibling)
    if (/^[A-Z]/.test(node.name)) return value(node);
  return null;
}

// The same of a text that is complete; null of any other, and of one that is nested too deeply to follow.
function parsed(source) {
  try { JSON.parse(source); return tree(source); } catch { return null; }
}

const child = (node, key) => node?.entries.find(entry => entry.key === key)?.value;

// Returns the place of the value at a JSON pointer: [begin, end]; for a missing one, that of its
// parent.
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
    // Its parent is missing, too.
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
  // Written like the members before it: on a line of its own, or not.
  const before = source.slice(entries.length > 1 ? entries.at(-2).value.end + 1 : begin + 1, entries.at(-1).begin);
  return cut(entries.at(-1).value.end, entries.at(-1).value.end, `,${/\s/.test(before) ? before.match(/\s[^]*$/)[0] : " "}${member}`);
}
