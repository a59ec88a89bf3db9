//! A field of a scenario, set by its JSON pointer (RFC 6901): what `--set` and sweeps do.

use serde_json::{Value, json};

use super::ScenarioError;

/// Puts `value` in the place of `pointer`. Sections on the way may be absent from the text; one that does not exist is
/// refused when the document is read.
///
/// # Errors
/// If the way leads through a list without such an item, or through what has no fields.
pub(crate) fn set(document: &mut Value, pointer: &str, value: Value) -> Result<(), ScenarioError> {
    let missing = || ScenarioError::invalid(pointer, "there is no such field to set");
    let mut place = document;
    for key in pointer.split('/').skip(1) {
        let key = key.replace("~1", "/").replace("~0", "~");
        place = match place {
            Value::Array(items) => {
                let index = key.parse::<usize>().ok();
                index.and_then(|index| items.get_mut(index)).ok_or_else(missing)?
            }
            Value::Object(map) => map.entry(key).or_insert_with(|| json!({})),
            _ => return Err(missing()),
        };
    }
    *place = value;
    Ok(())
}
