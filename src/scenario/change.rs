//! Sets a field of a scenario by its JSON pointer (RFC 6901), for `--set` and for sweeps.

use serde_json::{Value, json};

use super::suggest::keys_at;
use super::{ScenarioError, schema};

/// Puts `value` in the place of `pointer`; `null` removes the field there, as if it had never been
/// written. Sections on the way may be absent from the text; one that does not exist is refused
/// when the document is read.
///
/// # Errors
/// If the way leads through a list without such an item, or through a value without fields.
pub(crate) fn set(document: &mut Value, pointer: &str, value: Value) -> Result<(), ScenarioError> {
    let mut place = document;
    let mut way = pointer.split('/').skip(1).peekable();
    let mut passed = String::new();
    while let Some(part) = way.next() {
        let key = part.replace("~1", "/").replace("~0", "~");
        let taken_away = value.is_null() && way.peek().is_none();
        let nowhere = |what: String| {
            let place = if passed.is_empty() { "the scenario" } else { &passed };
            ScenarioError::invalid(
                pointer,
                format!("there is no such field to set: {place} {what}"),
            )
        };
        place = match place {
            Value::Array(items) => {
                let count = items.len();
                // RFC 6901: no leading zeros, and no sign.
                let index: Option<usize> = key.parse().ok();
                let index = index.filter(|&index| index < count && index.to_string() == key);
                let index = index.ok_or_else(|| match count {
                    0 => nowhere("is a list without items".to_owned()),
                    _ => nowhere(format!("is a list with the items 0 to {}", count - 1)),
                })?;
                if taken_away {
                    items.remove(index);
                    return Ok(());
                }
                &mut items[index]
            }
            Value::Object(map) => {
                if taken_away {
                    let known = || keys_at(&schema(), &passed);
                    if map.shift_remove(&key).is_some() || known().contains(&key) {
                        return Ok(());
                    }
                    return Err(nowhere(format!("has {}", known().join(", "))));
                }
                map.entry(key).or_insert_with(|| json!({}))
            }
            Value::Null => return Err(nowhere("is null".to_owned())),
            Value::Bool(_) => return Err(nowhere("is true or false".to_owned())),
            Value::Number(_) => return Err(nowhere("is a number".to_owned())),
            Value::String(_) => return Err(nowhere("is text".to_owned())),
        };
        passed += "/";
        passed += part;
    }
    *place = value;
    Ok(())
}
