"use strict";
// The description of the API as a page, which sends what is asked. All it knows is in openapi.json.

// Characters of an answer that are shown; the rest is for programs.
const SHOWN = 20000;

const make = (tag, attributes, ...children) => {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  node.append(...children);
  return node;
};
// A text with `names` in it.
const said = text => make("span", {}, ...text.split("`").map((part, k) => k % 2 ? make("code", {}, part) : part));

// A schema in words; names of types lead to them.
const words = schema => {
  const out = make("span", {});
  const list = (schemas, between) => schemas.forEach((one, k) => out.append(k ? between : "", words(one)));
  const choices = schema.oneOf ?? schema.anyOf;
  if (schema.$ref) {
    const name = schema.$ref.split("/").pop();
    out.append(make("a", { href: `#type-${name}` }, name));
  } else if (schema.title && schema.properties) {
    out.append(`{ ${Object.keys(schema.properties).join(", ")} }`);
  } else if (schema.const !== undefined) out.append(JSON.stringify(schema.const));
  else if (schema.enum) out.append(schema.enum.map(value => JSON.stringify(value)).join(" or "));
  else if (choices) list(choices, " or ");
  else if (schema.allOf) list(schema.allOf, " and ");
  else if ([schema.type].flat().includes("array")) {
    const count = schema.minItems && schema.minItems === schema.maxItems ? `${schema.minItems} ` : "";
    out.append(`list of ${count}`, words(schema.items ?? {}), [schema.type].flat().includes("null") ? " or null" : "");
  } else if (schema.type) {
    const [low, high] = [schema.minimum, schema.maximum];
    const range = (low !== undefined ? `, ${low} or more` : "") + (high !== undefined ? `, ${high} or less` : "");
    out.append([schema.type].flat().join(" or ") + range);
  } else out.append("any JSON");
  return out;
};

// A table of named things: [name, what it is, what is said of it].
const table = (heads, rows) => make("table", {},
  make("thead", {}, make("tr", {}, ...heads.map(head => make("th", { scope: "col" }, head)))),
  make("tbody", {}, ...rows.map(cells => make("tr", {}, ...cells.map(cell => make("td", {}, cell))))));

const fields = schema => {
  const required = new Set(schema.required ?? []);
  return table(["field", "type", "meaning"], Object.entries(schema.properties).map(([name, field]) => [
    make("code", {}, name), words(field),
    said((required.has(name) ? "" : "May be absent. ") + (field.description ?? ""))]));
};

const type = (name, schema) => {
  const body = make("details", { id: `type-${name}` }, make("summary", {}, make("code", {}, name)));
  if (schema.description) body.append(make("p", {}, said(schema.description)));
  if (schema.properties) body.append(fields(schema));
  for (const part of schema.oneOf ?? schema.anyOf ?? []) {
    body.append(make("p", {}, part.title ? make("strong", {}, part.title) : words(part), " ", said(part.description ?? "")));
    if (part.properties) body.append(fields(part));
  }
  if (!schema.properties && !schema.oneOf && !schema.anyOf) body.append(make("p", {}, words(schema)));
  return body;
};

// Shows an answer as it comes: some never end.
const show = async (answer, out, signal) => {
  const kind = answer.headers.get("content-type") ?? "";
  out.replaceChildren(make("p", {}, make("strong", {}, `${answer.status} ${answer.statusText}`), ` ${kind}`));
  const text = make("pre", { tabindex: 0 });
  out.append(text);
  if (!/json|text|xml/.test(kind)) {
    const bytes = (await answer.arrayBuffer()).byteLength;
    text.textContent = `${bytes} bytes`;
    return;
  }
  let all = "";
  const reader = answer.body.pipeThrough(new TextDecoderStream(), { signal }).getReader();
  for (;;) {
    const { done, value } = await reader.read();
    if (done) break;
    all += value;
    text.textContent = all.slice(0, SHOWN);
    if (all.length > SHOWN) {
      await reader.cancel();
      out.append(make("p", {}, `The first ${SHOWN} characters.`));
      return;
    }
  }
  if (kind.includes("json")) try { text.textContent = JSON.stringify(JSON.parse(all), null, 2); } catch { /* as it came */ }
};

// The values that a schema lists; none if any will do.
const listed = (schema, types) => {
  const { enum: some, oneOf } = types[schema.$ref?.split("/").pop()] ?? schema;
  return some ?? oneOf?.map(one => one.const).filter(value => value !== undefined);
};

// The inputs of a request: a field for each parameter, the body as text.
const form = (method, path, operation, types) => {
  const inputs = operation.parameters.map(parameter => {
    const choices = listed(parameter.schema, types);
    const input = choices?.length
      ? make("select", {}, make("option", { value: "" }, ""), ...choices.map(choice => make("option", {}, choice)))
      : make("input", { placeholder: parameter.example ?? "", autocomplete: "off" });
    if (parameter.required) input.required = true;
    return { parameter, input, row: make("label", {}, make("code", {}, parameter.name),
      " ", said(parameter.description ?? ""), " ", input) };
  });
  const example = operation.requestBody?.content["application/json"].example;
  const body = operation.requestBody && make("textarea", { rows: 12, spellcheck: "false", "aria-label": "Body" },
    JSON.stringify(example, null, 2));
  const send = make("button", {}, "Send");
  const out = make("div", { "aria-live": "polite" });
  let running;
  const asked = make("form", {}, ...inputs.map(one => one.row), ...(body ? [body] : []), send, out);
  asked.addEventListener("submit", async event => {
    event.preventDefault();
    if (running) return running.abort();
    let address = path.slice(1);
    const [query, headers] = [new URLSearchParams(), new Headers()];
    for (const { parameter: { name, in: place }, input: { value } } of inputs) {
      if (place === "path") address = address.replace(`{${name}}`, encodeURIComponent(value));
      else if (value && place === "query") query.set(name, value);
      else if (value) headers.set(name, value);
    }
    const token = document.getElementById("token").value;
    if (token) headers.set("Authorization", `Bearer ${token}`);
    if (body) headers.set("Content-Type", "application/json");
    running = new AbortController();
    send.textContent = "Stop";
    try {
      const { signal } = running;
      const answer = await fetch(`${address || "./"}${query.size ? `?${query}` : ""}`,
        { method: method.toUpperCase(), headers, body: body?.value, signal });
      await show(answer, out, signal);
    } catch (error) {
      if (error.name !== "AbortError") out.append(make("p", {}, String(error)));
    }
    [running, send.textContent] = [null, "Send"];
  });
  return asked;
};

const route = (path, method, operation, types) => {
  const head = make("summary", {}, make("span", { class: `method ${method}` }, method.toUpperCase()),
    make("code", {}, path), said(operation.summary));
  const answers = Object.entries(operation.responses).map(([status, { description, content }]) => {
    const [kind, media] = Object.entries(content ?? {})[0] ?? [];
    return [status === "default" ? "other" : status, said(description),
      kind ? make("span", {}, `${kind}: `, words(media.schema)) : "nothing"];
  });
  const who = operation.security ? `${operation.description} No token is needed if the service has no tokens.` : "No token is needed.";
  return make("details", { id: operation.operationId }, head, make("p", {}, who),
    form(method, path, operation, types), make("h4", {}, "Answers"), table(["status", "meaning", "content"], answers));
};

// Opens what an address names, which is closed otherwise.
const open = () => {
  const target = document.getElementById(decodeURIComponent(location.hash.slice(1)));
  if (target?.tagName === "DETAILS") { target.open = true; target.scrollIntoView(); }
};

fetch("openapi.json").then(answer => answer.json()).then(api => {
  for (const { name, description } of api.tags) {
    const group = make("section", {}, make("h2", {}, name), make("p", {}, description));
    for (const [path, methods] of Object.entries(api.paths))
      for (const [method, operation] of Object.entries(methods))
        if (operation.tags.includes(name)) group.append(route(path, method, operation, api.components.schemas));
    document.getElementById("routes").append(group);
  }
  for (const [name, schema] of Object.entries(api.components.schemas).sort(([a], [b]) => a < b ? -1 : 1))
    document.getElementById("types").append(type(name, schema));
  addEventListener("hashchange", open);
  open();
}).catch(error => document.getElementById("routes").append(make("p", {}, String(error))));
