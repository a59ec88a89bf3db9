//! The description of the API, made from the same list that makes the router.
//!
//! Invariant: a route that is not described does not exist, and a schema is that of the type that is sent.

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

/// What the description says of a route.
pub(super) struct Operation {
    id: &'static str,
    summary: &'static str,
    parameters: Vec<Parameter>,
    body: Option<(SchemaOf, Option<&'static str>)>,
    answers: Vec<Answer>,
}

struct Parameter {
    place: &'static str,
    name: &'static str,
    about: &'static str,
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
        self.parameters.push(Parameter { place, name, about, schema: schema_of::<T> });
        self
    }

    /// The JSON that is sent, with the text of an example if there is one.
    pub(super) fn body<T: JsonSchema>(mut self, example: Option<&'static str>) -> Self {
        self.body = Some((schema_of::<T>, example));
        self
    }

    /// An answer in JSON.
    pub(super) fn json<T: JsonSchema>(self, status: u16, about: &'static str) -> Self {
        self.answer::<T>(status, "application/json", about)
    }

    /// An answer in text or bytes.
    pub(super) fn raw(self, status: u16, media_type: &'static str, about: &'static str) -> Self {
        self.answer::<String>(status, media_type, about)
    }

    /// An answer of a media type with parts of one schema.
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

    /// An answer without content.
    pub(super) fn empty(mut self, status: u16, about: &'static str) -> Self {
        self.answers.push(Answer { status, about, content: None });
        self
    }

    fn describe(&self, path: &str, scope: Option<Scope>, generator: &mut SchemaGenerator) -> Value {
        let mut parameters: Vec<_> = path
            .split('/')
            .filter_map(|part| part.strip_prefix('{')?.strip_suffix('}'))
            .map(|name| {
                let schema = match name {
                    "id" => json!({ "type": "string", "format": "uuid" }),
                    _ => json!({ "type": "string" }),
                };
                json!({ "name": name, "in": "path", "required": true, "schema": schema })
            })
            .collect();
        parameters.extend(self.parameters.iter().map(|parameter| {
            let Parameter { place, name, about, schema } = parameter;
            let schema = schema(generator);
            json!({ "name": name, "in": place, "description": about, "schema": schema })
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
                "content": { problem::MEDIA_TYPE: { "schema": problem } },
            }),
        );
        let mut operation = json!({
            "operationId": self.id,
            "summary": self.summary,
            "parameters": parameters,
            "responses": answers,
        });
        if let Some((schema, example)) = self.body {
            let mut content = json!({ "schema": schema(generator) });
            if let Some(example) = example {
                content["example"] = serde_json::from_str(example).unwrap_or_default();
            }
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

/// The whole description, of OpenAPI 3.1.
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
    json!({
        "openapi": "3.1.0",
        "info": {
            "title": "vpd",
            "version": env!("CARGO_PKG_VERSION"),
            "description": env!("CARGO_PKG_DESCRIPTION"),
            "license": { "name": env!("CARGO_PKG_LICENSE") },
        },
        "paths": paths,
        "components": {
            "schemas": generator.take_definitions(true),
            "securitySchemes": { "token": { "type": "http", "scheme": "bearer" } },
        },
    })
}
