//! The description of the API, made from the same list that makes the router.
//!
//! Invariant: a route that is not described does not exist, and a schema is that of the type that is sent. Generators of
//! clients understand it: no schema is `true`, each part of a choice has a name.

use axum::http::Method;
use schemars::generate::SchemaSettings;
use schemars::{JsonSchema, Schema, SchemaGenerator};
use serde_json::{Map, Value, json};

use super::config::Scope;
use super::problem;

/// The schema of a type.
type SchemaOf = fn(&mut SchemaGenerator) -> Schema;

fn schema_of<T: JsonSchema>(generator: &mut SchemaGenerator) -> Schema {
    generator.subschema_for::<T>()
}

/// Description of a route.
pub(super) struct Operation {
    id: &'static str,
    summary: &'static str,
    parameters: Vec<Parameter>,
    body: Option<(SchemaOf, fn() -> Value)>,
    answers: Vec<Answer>,
}

struct Parameter {
    place: &'static str,
    name: &'static str,
    about: &'static str,
    required: bool,
    schema: SchemaOf,
}

struct Answer {
    status: u16,
    about: &'static str,
    content: Option<(&'static str, SchemaOf)>,
}

impl Operation {
    pub(super) fn new(id: &'static str, summary: &'static str) -> Self {
        Self { id, summary, parameters: Vec::new(), body: None, answers: Vec::new() }
    }

    pub(super) fn query<T: JsonSchema>(self, name: &'static str, about: &'static str) -> Self {
        self.parameter::<T>("query", name, about)
    }

    pub(super) fn header<T: JsonSchema>(self, name: &'static str, about: &'static str) -> Self {
        self.parameter::<T>("header", name, about)
    }

    fn parameter<T: JsonSchema>(
        mut self,
        place: &'static str,
        name: &'static str,
        about: &'static str,
    ) -> Self {
        let schema = schema_of::<T>;
        self.parameters.push(Parameter { place, name, about, required: false, schema });
        self
    }

    /// Says that the last parameter may not be absent.
    pub(super) fn required(mut self) -> Self {
        self.parameters.iter_mut().next_back().into_iter().for_each(|last| last.required = true);
        self
    }

    /// Adds the JSON that is sent, with an example.
    pub(super) fn body<T: JsonSchema>(mut self, example: fn() -> Value) -> Self {
        self.body = Some((schema_of::<T>, example));
        self
    }

    /// Adds an answer in JSON.
    pub(super) fn json<T: JsonSchema>(self, status: u16, about: &'static str) -> Self {
        self.answer::<T>(status, "application/json", about)
    }

    /// Adds an answer in text or bytes.
    pub(super) fn raw(self, status: u16, media_type: &'static str, about: &'static str) -> Self {
        self.answer::<String>(status, media_type, about)
    }

    /// Adds an answer of a media type with parts of one schema.
    pub(super) fn answer<T: JsonSchema>(
        mut self,
        status: u16,
        media_type: &'static str,
        about: &'static str,
    ) -> Self {
        let content = Some((media_type, schema_of::<T> as SchemaOf));
        self.answers.push(Answer { status, about, content });
        self
    }

    /// Adds an answer without content.
    pub(super) fn empty(mut self, status: u16, about: &'static str) -> Self {
        self.answers.push(Answer { status, about, content: None });
        self
    }

    fn describe(&self, path: &str, scope: Option<Scope>, generator: &mut SchemaGenerator) -> Value {
        let mut parameters: Vec<_> = path
            .split('/')
            .filter_map(|part| part.strip_prefix('{')?.strip_suffix('}'))
            .map(|name| {
                let (schema, example) = match name {
                    "id" => (
                        json!({ "type": "string", "format": "uuid" }),
                        "019b7f5c-3c00-7000-8000-000000000000",
                    ),
                    "chart" => (json!({ "type": "string" }), "energy.svg"),
                    "member" => (json!({ "type": "string" }), "0.json"),
                    _ if path.starts_with("/studies") => (json!({ "type": "string" }), "order.svg"),
                    _ => (json!({ "type": "string" }), "heavy-top"),
                };
                json!({ "name": name, "in": "path", "required": true, "schema": schema, "example": example })
            })
            .collect();
        parameters.extend(self.parameters.iter().map(|parameter| {
            let Parameter { place, name, about, required, schema } = parameter;
            let schema = schema(generator);
            let mut shown =
                json!({ "name": name, "in": place, "description": about, "schema": schema });
            if *required {
                shown["required"] = json!(true);
            }
            shown
        }));
        let mut answers = Map::new();
        for Answer { status, about, content } in &self.answers {
            let mut answer = json!({ "description": about });
            if let Some((media_type, schema)) = content {
                answer["content"] = json!({ *media_type: { "schema": schema(generator) } });
            }
            answers.insert(status.to_string(), answer);
        }
        let problem = generator.subschema_for::<problem::Body>();
        answers.insert(
            "default".to_owned(),
            json!({
                "description": "A problem (RFC 9457); `code` says which.",
                "content": { problem::MEDIA_TYPE: { "schema": problem, "example": {
                    "type": "urn:vpd:problem:invalid_input",
                    "title": "Invalid input",
                    "status": 422,
                    "detail": "-0.01 given, a step must be from 1e-12 to 1e6 s",
                    "code": "invalid_input",
                    "pointer": "/step_s",
                } } },
            }),
        );
        let mut operation = json!({
            "operationId": self.id,
            "tags": [tag(path)],
            "summary": self.summary,
            "parameters": parameters,
            "responses": answers,
        });
        if let Some((schema, example)) = self.body {
            let content = json!({ "schema": schema(generator), "example": example() });
            let content = json!({ "application/json": content });
            operation["requestBody"] = json!({ "required": true, "content": content });
        }
        if let Some(scope) = scope {
            operation["security"] = json!([{}, { "token": [] }]);
            operation["description"] = json!(format!("Scope: {scope}."));
        }
        operation
    }
}

/// Returns the whole description, of OpenAPI 3.1.
pub(super) fn document<'a>(
    routes: impl Iterator<Item = (&'a Method, &'a str, Option<Scope>, &'a Operation)>,
) -> Value {
    let mut settings = SchemaSettings::draft2020_12();
    settings.definitions_path = "/components/schemas".into();
    let mut generator = settings.into_generator();
    let mut paths = Map::new();
    for (method, path, scope, operation) in routes {
        let described = operation.describe(path, scope, &mut generator);
        paths.entry(path).or_insert_with(|| json!({}))[method.as_str().to_lowercase()] = described;
    }
    let mut schemas = Value::Object(generator.take_definitions(true));
    if let Some(schemas) = schemas.as_object_mut() {
        let taken: Vec<String> = schemas.keys().cloned().collect();
        for (name, schema) in schemas.iter_mut() {
            list_words(schema);
            name_choices(name, schema, &taken);
        }
    }
    let tags = TAGS.map(|(name, description)| json!({ "name": name, "description": description }));
    let mut document = json!({
        "openapi": "3.1.0",
        "info": {
            "title": "vpd",
            "version": env!("CARGO_PKG_VERSION"),
            "description": env!("CARGO_PKG_DESCRIPTION"),
            "license": { "name": env!("CARGO_PKG_LICENSE") },
        },
        "tags": tags,
        "paths": paths,
        "components": {
            "schemas": schemas,
            "securitySchemes": { "token": { "type": "http", "scheme": "bearer" } },
        },
    });
    spell_out(&mut document);
    document
}

/// The groups of routes.
const TAGS: [(&str, &str); 4] = [
    ("jobs", "Runs of scenarios: submit them, follow them, read their logs"),
    ("studies", "Many runs of one scene, one table"),
    ("scenarios", "Input of a job: the shipped examples, the JSON Schema"),
    ("service", "The service itself, its pages, the layouts of viewers"),
];

fn tag(path: &str) -> &'static str {
    let first = path.split('/').nth(1).unwrap_or_default();
    match first {
        "jobs" | "studies" => {
            TAGS.iter().find(|(name, _)| *name == first).map_or("service", |tag| tag.0)
        }
        _ if first.starts_with("scenario") => "scenarios",
        _ => "service",
    }
}

/// Turns a choice of words, each with its meaning, into a list of them, which generators of clients
/// know as an enumeration. The meanings go into the description.
fn list_words(schema: &mut Value) {
    let Some(parts) = schema["oneOf"].as_array() else { return };
    let (mut words, mut meanings) = (Vec::new(), Vec::new());
    for part in parts {
        let one = part["const"].is_string().then(|| vec![part["const"].clone()]);
        let Some(some) = part["enum"].as_array().cloned().or(one) else { return };
        if let (Some(word), Some(meaning)) = (some[0].as_str(), part["description"].as_str()) {
            meanings.push(format!("- `{word}`: {meaning}"));
        }
        words.extend(some);
    }
    let about = schema["description"].as_str().unwrap_or_default();
    let description = format!("{about}\n\n{}", meanings.join("\n"));
    *schema = json!({ "description": description.trim(), "type": "string", "enum": words });
}

/// Names the parts of a choice, which generators of clients would number: `FramedBody` is the one of `Framed` with `body`,
/// `PotentialTermSpring` that of `kind` `spring`, and `TorqueWithTable` that of `Torque` with `table`, for `TorqueTable` is taken.
/// A second `spring`, which has another last field, is named by that too.
fn name_choices(of: &str, schema: &mut Value, taken: &[String]) {
    let mut named = Vec::new();
    for word in ["oneOf", "anyOf"] {
        let parts = schema.get_mut(word).and_then(Value::as_array_mut);
        for part in parts.into_iter().flatten() {
            let key = part["properties"]["kind"]["const"].as_str().or(part["required"][0].as_str());
            let last = part["required"].as_array().and_then(|all| all.last()?.as_str()).map(camel);
            let title = key.map(camel).map(|key| {
                let short = format!("{of}{key}");
                if taken.contains(&short) {
                    format!("{of}With{key}")
                } else if named.contains(&short) {
                    format!("{short}{}", last.unwrap_or_default())
                } else {
                    short
                }
            });
            named.extend(title.clone());
            if let (Some(title), Some(part)) = (title, part.as_object_mut())
                && part.contains_key("properties")
            {
                part.insert("title".to_owned(), title.into());
            }
        }
    }
}

/// Converts `point_source` → `PointSource`.
fn camel(words: &str) -> String {
    let word = |word: &str| {
        let mut letters = word.chars();
        letters.next().map(|first| first.to_ascii_uppercase().to_string() + letters.as_str())
    };
    words.split('_').filter_map(word).collect()
}

/// Replaces a schema `true`, which generators of clients do not take, by `{}`, which means the
/// same.
fn spell_out(value: &mut Value) {
    match value {
        Value::Array(values) => values.iter_mut().for_each(spell_out),
        Value::Object(fields) => {
            for (key, value) in fields {
                match value {
                    Value::Bool(true) if matches!(key.as_str(), "schema" | "items") => {
                        *value = json!({});
                    }
                    Value::Object(properties) if key == "properties" => {
                        for property in properties.values_mut() {
                            match property {
                                Value::Bool(true) => *property = json!({}),
                                property => spell_out(property),
                            }
                        }
                    }
                    value => spell_out(value),
                }
            }
        }
        _ => {}
    }
}
