"use strict";
const make = (tag, text, ...children) => {
  const node = document.createElement(tag);
  if (text) node.textContent = text;
  node.append(...children);
  return node;
};
const json = value => make("pre", JSON.stringify(value, null, 2));
fetch("openapi.json").then(answer => answer.json()).then(api => {
  for (const [path, methods] of Object.entries(api.paths))
    for (const [method, operation] of Object.entries(methods)) {
      const name = make("span", method.toUpperCase());
      name.className = "method";
      const { summary, operationId, ...rest } = operation;
      const head = make("summary", "", name, make("code", path), ` ${summary}`);
      document.getElementById("routes").append(make("details", "", head, json(rest)));
    }
  for (const [name, schema] of Object.entries(api.components.schemas))
    document.getElementById("types").append(
      make("details", "", make("summary", "", make("code", name)), json(schema)));
}).catch(error => document.getElementById("routes").append(make("p", String(error))));
