//! Suggestions for a value of the wrong form: the first of the forms that the schema allows there
//! into which the value fits.
//!
//! Invariant: only what would be accepted is suggested.

use serde_json::{Value, json};

use super::parse::typed;
use super::{Scenario, ScenarioError, schema};

/// Characters of a value that are repeated in a suggestion.
const SHOWN: usize = 120;

/// Adds to the error of a scenario's text what to write instead, if that can be known.
pub(super) fn with_suggestion(error: ScenarioError, tree: &Value) -> ScenarioError {
    let pointer = error.pointer.clone();
    let found = error.message.starts_with("invalid type").then(|| suggestion(tree, &pointer));
    let Some((keys, written)) = found.flatten() else { return error };
    let named: Vec<String> = keys.iter().map(|key| format!("`{key}`")).collect();
    let mut message = error.message;
    // serde's term for the name of one of several forms.
    if let Some((before, _)) = message.split_once("expected string or map") {
        message = match words(tree, &pointer) {
            Some(words) if named.is_empty() => format!("{before}expected {words}"),
            _ => format!("{before}expected an object with one of {}", named.join(", ")),
        };
    }
    match (written, with_unit(tree, &pointer)) {
        (_, Some(key)) => message += &format!("; give a number as `{key}`"),
        (Some(written), None) => message += &format!("; write {written}"),
        (None, None) => {}
    }
    ScenarioError::invalid(pointer, message)
}

/// Returns the words that are allowed at a place, from the error for a word that is not.
fn words(tree: &Value, pointer: &str) -> Option<String> {
    let mut other = tree.clone();
    *other.pointer_mut(pointer)? = Value::from("");
    let error = super::parse::typed::<super::Scenario>(&other).err()?;
    let (_, words) = error.message.split_once("expected ")?;
    (error.pointer == pointer).then(|| words.to_owned())
}

/// Returns the same key with its unit, if there is one and a number was given.
fn with_unit(tree: &Value, pointer: &str) -> Option<String> {
    tree.pointer(pointer)?.as_number()?;
    let (parent, key) = pointer.rsplit_once('/')?;
    let start = format!("{key}_");
    keys_at(&schema(), parent).into_iter().find(|other| other.starts_with(&start))
}

/// Returns the keys that an object may have at a pointer, and what fits there.
fn suggestion(tree: &Value, pointer: &str) -> Option<(Vec<String>, Option<String>)> {
    let given = tree.pointer(pointer)?;
    let schema = schema();
    let keys = keys_at(&schema, pointer);
    let number =
        given.as_str().and_then(|text| text.parse::<f64>().ok()).map(|number| json!(number));
    let in_object = keys.iter().map(|key| json!({ key: given }));
    let candidates = number.into_iter().chain(in_object).chain([json!([given])]);
    // A null has no intended value.
    let mut candidates = candidates.filter(|_| !given.is_null());
    let fits = |candidate: &Value| {
        let mut whole = tree.clone();
        let Some(place) = whole.pointer_mut(pointer) else { return false };
        *place = candidate.clone();
        // Any other error is of another place.
        typed::<Scenario>(&whole).map_or_else(|other| !other.pointer.starts_with(pointer), |_| true)
    };
    let written = candidates.find(fits).map(|found| found.to_string());
    Some((keys, written.filter(|text| text.len() <= SHOWN)))
}

/// Returns the keys of the objects that a schema allows at a pointer.
pub(super) fn keys_at(schema: &Value, pointer: &str) -> Vec<String> {
    let mut places = alternatives(schema, schema);
    for key in pointer.split('/').skip(1) {
        let inner = places
            .iter()
            .filter_map(|place| place["properties"].get(key).or_else(|| place.get("items")));
        places = inner.flat_map(|inner| alternatives(schema, inner)).collect();
    }
    let keys = places.iter().filter_map(|place| place["properties"].as_object());
    keys.flat_map(|properties| properties.keys().cloned()).collect()
}

/// Returns a schema, or the schemas of its choices, without references.
fn alternatives<'a>(root: &'a Value, schema: &'a Value) -> Vec<&'a Value> {
    let referred = schema["$ref"].as_str().and_then(|at| root.pointer(at.strip_prefix('#')?));
    let several = ["oneOf", "anyOf", "allOf"].iter().filter_map(|word| schema[*word].as_array());
    let several = several.flatten().chain(referred).flat_map(|inner| alternatives(root, inner));
    std::iter::once(schema).chain(several).collect()
}
