//! JSON text → the types of a scenario, with the pointer of anything that does not fit.
//!
//! Two passes. The first reads any JSON into a tree and refuses duplicate keys; it puts the keys that choose a form
//! first, so that the second, typed pass can choose the variant of a potential term, or the kind of scene, before the
//! fields and still know where it is.

use std::borrow::Cow;
use std::fmt;
use std::io::{self, Read};

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::de::DeserializeOwned;
use serde::de::value::{MapAccessDeserializer, SeqAccessDeserializer};
use serde::de::{self, DeserializeSeed, Deserializer, IgnoredAny, MapAccess, SeqAccess, Visitor};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use serde_path_to_error::{Path, Segment};

use super::bodies::PairKind;
use super::term::Kind;
use super::{
    Bodies, Body, Coefficients, Control, DrivenTerm, Entry, Field, FormatVersion, Inertia, Initial,
    Interaction, Joint, PairLaw, PotentialTerm, ScenarioError, ScenarioErrorKind, Scene,
    SchemaAddress, TableauChoice, TableauName, Torque,
};

/// Keys that choose the form of the object they stand in, in the order in which they are read.
const FIRST_KEYS: [&str; 3] = ["bodies", "between", "kind"];

/// Longest text of a scenario or of a sweep, in bytes: the largest tables are a tenth of it.
const LARGEST_TEXT_BYTES: u64 = 64 << 20;

/// Makes the second pass: a tree → types.
pub(crate) fn from_tree<T: DeserializeOwned + Serialize>(tree: Value) -> Result<T, ScenarioError> {
    typed(&tree)
}

/// Does the same for a tree that is kept.
pub(super) fn typed<T: DeserializeOwned + Serialize>(tree: &Value) -> Result<T, ScenarioError> {
    let typed = serde_path_to_error::deserialize(tree).map_err(|error| {
        let at = pointer(error.path());
        let message = plain(&error.inner().to_string());
        let given = tree.pointer(&at);
        let message = match given {
            Some(Value::Array(_)) if message.contains("expected an object") => A_LIST.to_owned(),
            _ => several_keys(&message, given).unwrap_or(message),
        };
        ScenarioError::invalid(at, message)
    })?;
    match serde_json::to_value(&typed) {
        Ok(printed) => no_list_for_an_object(tree, &printed, "").map(|()| typed),
        Err(error) => Err(ScenarioError::invalid("", plain(&error.to_string()))),
    }
}

/// serde takes a list of its fields for an object, or counts what is in the list.
const A_LIST: &str = "is a list where an object belongs";

/// Explains serde's error where one of several forms is expected, and none or more than one is
/// given.
fn several_keys(message: &str, given: Option<&Value>) -> Option<String> {
    let keys: Vec<_> = given?.as_object()?.keys().map(|key| format!("`{key}`")).collect();
    (message.ends_with("map with a single key") && keys.len() != 1).then(|| match keys.len() {
        0 => "is empty: exactly one key is needed".to_owned(),
        count => format!("has {count} keys, {}: exactly one is allowed", keys.join(", ")),
    })
}

/// Refuses a list of fields in the place of an object, which serde takes: the description of the
/// API does not allow it, and a new field would change its meaning. A value that prints as an
/// object must have been given as one.
fn no_list_for_an_object(given: &Value, printed: &Value, at: &str) -> Result<(), ScenarioError> {
    match (given, printed) {
        (Value::Array(_), Value::Object(_)) => Err(ScenarioError::invalid(at, A_LIST)),
        (Value::Array(given), Value::Array(printed)) => {
            let pairs = given.iter().zip(printed).enumerate();
            pairs.into_iter().try_for_each(|(index, (given, printed))| {
                // Rows of numbers need no pointer of their own.
                if given.is_number() {
                    return Ok(());
                }
                no_list_for_an_object(given, printed, &format!("{at}/{index}"))
            })
        }
        (Value::Object(given), Value::Object(printed)) => {
            given.iter().try_for_each(|(key, given)| match printed.get(key) {
                Some(printed) => no_list_for_an_object(given, printed, &format!("{at}/{key}")),
                None => Ok(()),
            })
        }
        _ => Ok(()),
    }
}

/// Returns the text after the byte order mark that some editors put before UTF-8.
///
/// # Errors
/// If the text is UTF-16, which other editors write, or UTF-32.
pub(crate) fn without_mark(text: &[u8]) -> Result<&[u8], ScenarioError> {
    // JSON begins with an ASCII character, of which these encodings make zero bytes.
    let is_wide = |&byte: &u8| byte == 0;
    let wide = text.starts_with(&[0xFF, 0xFE])
        || text.starts_with(&[0xFE, 0xFF])
        || text.iter().take(2).any(is_wide);
    if wide {
        let message = "is text in UTF-16 or UTF-32; JSON is UTF-8: save the file in that encoding";
        return Err(ScenarioError::new(
            ScenarioErrorKind::Malformed,
            String::new(),
            message.to_owned(),
        ));
    }
    Ok(text.strip_prefix(&[0xEF, 0xBB, 0xBF]).unwrap_or(text))
}

/// Reads the text of a scenario or of a sweep, of at most [`LARGEST_TEXT_BYTES`] bytes.
///
/// # Errors
/// If it cannot be read or is longer.
pub(crate) fn read_text(from: impl Read) -> io::Result<Vec<u8>> {
    let mut text = Vec::new();
    from.take(LARGEST_TEXT_BYTES + 1).read_to_end(&mut text)?;
    if text.len() as u64 > LARGEST_TEXT_BYTES {
        let most = LARGEST_TEXT_BYTES >> 20;
        let message = format!("is longer than the {most} MiB that are allowed");
        return Err(io::Error::new(io::ErrorKind::FileTooLarge, message));
    }
    Ok(text)
}

/// Makes the first pass: text → a tree without duplicate keys.
pub(crate) fn tree(text: &[u8]) -> Result<Value, ScenarioError> {
    let text = without_mark(text)?;
    let mut reader = serde_json::Deserializer::from_slice(text);
    let Tree(value) = serde_path_to_error::deserialize(&mut reader).map_err(|error| {
        let inner = error.inner();
        let message = plain(&inner.to_string());
        // A word or a number that JSON does not have, where a field's value should be (NaN, 1e400), is a
        // wrong value; anything else that cannot be read is not JSON.
        let no_number = ["expected value", "number out of range", "invalid number"];
        let at_value = no_number.iter().any(|start| message.starts_with(start));
        let wrong_value = inner.is_data() || (at_value && error.path().iter().next().is_some());
        let kind =
            if wrong_value { ScenarioErrorKind::Invalid } else { ScenarioErrorKind::Malformed };
        ScenarioError::new(kind, pointer(error.path()), message)
    })?;
    reader.end().map_err(|error| {
        let message = plain(&error.to_string());
        ScenarioError::new(ScenarioErrorKind::Malformed, String::new(), message)
    })?;
    Ok(value)
}

/// Reads a value that may be left out, but may not be `null`.
pub(super) fn given<'de, D: Deserializer<'de>, T: Deserialize<'de>>(
    deserializer: D,
) -> Result<Option<T>, D::Error> {
    T::deserialize(deserializer).map(Some)
}

/// Refuses `bodies` after the fields of one body.
pub(super) fn late_bodies<'de, D: Deserializer<'de>>(
    _: D,
) -> Result<Option<Box<Bodies>>, D::Error> {
    Err(de::Error::custom(super::bodies::TOGETHER))
}

/// Returns a JSON pointer (RFC 6901) from the path that serde took.
fn pointer(path: &Path) -> String {
    path.iter()
        .map(|segment| match segment {
            Segment::Seq { index } => format!("/{index}"),
            Segment::Map { key } | Segment::Enum { variant: key } => {
                format!("/{}", key.replace('~', "~0").replace('/', "~1"))
            }
            Segment::Unknown => String::new(),
        })
        .collect()
}

/// Translates serde's words for types into those of JSON.
fn plain(message: &str) -> String {
    const WORDS: &[(&str, &str)] = &[
        ("expected f64", "expected a number"),
        ("expected u64", "expected a whole number in digits, 0 to 2^64 - 1"),
        ("expected u32", "expected a whole number in digits, 0 to 2^32 - 1"),
        ("expected a sequence", "expected a list"),
        ("expected a map", "expected an object"),
        ("sequence", "list"),
        ("floating point `", "number `"),
        ("integer `", "number `"),
        ("invalid type: map", "invalid type: object"),
    ];
    let mut words = message.to_owned();
    if let Some((before, after)) = words.split_once("expected struct ") {
        let rest = after.split_once(' ').map_or("", |(_, rest)| rest);
        words = format!("{before}expected an object {rest}").trim_end().to_owned();
    }
    for (rust, json) in WORDS {
        words = words.replace(rust, json);
    }
    words
}

/// Any JSON value without duplicate keys.
struct Tree(Value);

impl<'de> Deserialize<'de> for Tree {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(TreeVisitor).map(Tree)
    }
}

struct TreeVisitor;

impl<'de> Visitor<'de> for TreeVisitor {
    type Value = Value;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a JSON value")
    }

    fn visit_bool<E>(self, value: bool) -> Result<Value, E> {
        Ok(value.into())
    }

    fn visit_i64<E>(self, value: i64) -> Result<Value, E> {
        Ok(value.into())
    }

    fn visit_u64<E>(self, value: u64) -> Result<Value, E> {
        Ok(value.into())
    }

    fn visit_f64<E>(self, value: f64) -> Result<Value, E> {
        Ok(value.into())
    }

    fn visit_str<E>(self, value: &str) -> Result<Value, E> {
        Ok(value.into())
    }

    fn visit_unit<E>(self) -> Result<Value, E> {
        Ok(Value::Null)
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut access: A) -> Result<Value, A::Error> {
        let mut items = Vec::new();
        while let Some(Tree(item)) = access.next_element()? {
            items.push(item);
        }
        Ok(Value::Array(items))
    }

    fn visit_map<A: MapAccess<'de>>(self, mut access: A) -> Result<Value, A::Error> {
        let mut map = Map::new();
        while let Some(key) = access.next_key::<String>()? {
            let value =
                access.next_value_seed(Unique { taken: map.contains_key(&key), key: &key })?;
            match FIRST_KEYS.iter().position(|first| *first == key) {
                Some(at) => {
                    let before = FIRST_KEYS[..at].iter().filter(|first| map.contains_key(**first));
                    map.shift_insert(before.count(), key, value);
                }
                None => {
                    map.insert(key, value);
                }
            }
        }
        Ok(Value::Object(map))
    }
}

/// The value of a key: refused, at its own path, if the key was there before.
struct Unique<'a> {
    taken: bool,
    key: &'a str,
}

impl<'de> DeserializeSeed<'de> for Unique<'_> {
    type Value = Value;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Value, D::Error> {
        if self.taken {
            return Err(de::Error::custom(format!("duplicate key `{}`", self.key)));
        }
        Tree::deserialize(deserializer).map(|Tree(value)| value)
    }
}

impl<'de> Deserialize<'de> for SchemaAddress {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        String::deserialize(deserializer).map(|_| Self)
    }
}

impl JsonSchema for SchemaAddress {
    fn schema_name() -> Cow<'static, str> {
        "SchemaAddress".into()
    }

    fn inline_schema() -> bool {
        true
    }

    fn json_schema(generator: &mut SchemaGenerator) -> Schema {
        String::json_schema(generator)
    }
}

impl<'de> Deserialize<'de> for FormatVersion {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let given = u64::deserialize(deserializer)?;
        let allowed = Self::NUMBER;
        let newer = if given > allowed { "; a newer vpd may read it" } else { "" };
        let refused = || format!("{given} given, this build reads the format {allowed}{newer}");
        if given == allowed { Ok(Self) } else { Err(de::Error::custom(refused())) }
    }
}

impl JsonSchema for FormatVersion {
    fn schema_name() -> Cow<'static, str> {
        "FormatVersion".into()
    }

    fn inline_schema() -> bool {
        true
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        json_schema!({ "type": "integer", "const": Self::NUMBER })
    }
}

impl<'de> Deserialize<'de> for PotentialTerm {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_map(TermVisitor)
    }
}

struct TermVisitor;

impl<'de> Visitor<'de> for TermVisitor {
    type Value = PotentialTerm;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an object with the key `kind`")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut access: A) -> Result<PotentialTerm, A::Error> {
        // The first pass put it first.
        match access.next_key::<String>()? {
            Some(key) if key == "kind" => {}
            Some(key) if key == "between" => {
                return Err(de::Error::custom("`between` is for scenes with `bodies`"));
            }
            _ => return Err(de::Error::missing_field("kind")),
        }
        let kind = access.next_value::<Kind>()?;
        kind.read(MapAccessDeserializer::new(access))
    }
}

impl<'de> Deserialize<'de> for Interaction {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_map(InteractionVisitor)
    }
}

struct InteractionVisitor;

impl<'de> Visitor<'de> for InteractionVisitor {
    type Value = Interaction;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an object with the key `kind`")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut access: A) -> Result<Interaction, A::Error> {
        let mut key = access.next_key::<String>()?;
        let mut between = None;
        if key.as_deref() == Some("between") {
            between = Some(access.next_value()?);
            key = access.next_key()?;
        }
        if key.as_deref() != Some("kind") {
            return Err(de::Error::missing_field("kind"));
        }
        if let Some(between) = between {
            let kind = access.next_value::<PairKind>()?;
            let law = kind.read(MapAccessDeserializer::new(access))?;
            return Ok(Interaction::Between { between, law });
        }
        let OfOneBody(kind) = access.next_value()?;
        let mut body = None;
        let rest = WithoutBody { access, body: &mut body };
        let term = kind.read(MapAccessDeserializer::new(rest))?;
        let body = body.ok_or_else(|| de::Error::custom("missing field `body` (or `between`)"))?;
        Ok(Interaction::On { body, term })
    }
}

/// The kind of a term that acts on one body.
struct OfOneBody(Kind);

impl<'de> Deserialize<'de> for OfOneBody {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let name = String::deserialize(deserializer)?;
        if name == PairLaw::MUTUAL_GRAVITY {
            return Err(de::Error::custom(format!("{name} needs two bodies: give `between`")));
        }
        Kind::deserialize(de::value::StringDeserializer::new(name)).map(Self)
    }
}

/// The fields of a term but for its body, which is put aside.
struct WithoutBody<'a, A> {
    access: A,
    body: &'a mut Option<String>,
}

impl<'de, A: MapAccess<'de>> MapAccess<'de> for WithoutBody<'_, A> {
    type Error = A::Error;

    fn next_key_seed<K: DeserializeSeed<'de>>(
        &mut self,
        seed: K,
    ) -> Result<Option<K::Value>, A::Error> {
        match self.access.next_key_seed(OrBody(seed))? {
            Some(Key::Field(field)) => Ok(Some(field)),
            Some(Key::Body(seed)) => {
                *self.body = Some(self.access.next_value()?);
                self.access.next_key_seed(seed)
            }
            None => Ok(None),
        }
    }

    fn next_value_seed<V: DeserializeSeed<'de>>(&mut self, seed: V) -> Result<V::Value, A::Error> {
        self.access.next_value_seed(seed)
    }
}

/// A key of a term: of its body, with the seed that is still to be used, or of another field.
enum Key<K, V> {
    Body(K),
    Field(V),
}

struct OrBody<K>(K);

impl<'de, K: DeserializeSeed<'de>> DeserializeSeed<'de> for OrBody<K> {
    type Value = Key<K, K::Value>;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Self::Value, D::Error> {
        let key = String::deserialize(deserializer)?;
        if key == "body" {
            return Ok(Key::Body(self.0));
        }
        self.0.deserialize(de::value::StringDeserializer::new(key)).map(Key::Field)
    }
}

impl<'de> Deserialize<'de> for Scene {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_map(SceneVisitor)
    }
}

struct SceneVisitor;

/// The fields that may stand next to `bodies`, and those of one body, which [`Scenario::check`](super::Scenario::check)
/// refuses there.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct NextToBodies {
    #[serde(default)]
    potential: Vec<Interaction>,
    #[serde(default)]
    joints: Vec<Joint>,
    inertia: Option<Inertia>,
    #[serde(default)]
    driven: Vec<DrivenTerm>,
    #[serde(default)]
    torques: Vec<Torque>,
    wheels: Option<Vec<Entry>>,
    control: Option<Control>,
    field: Option<Field>,
    #[serde(default, deserialize_with = "refused_start")]
    initial: Initial,
}

fn refused_start<'de, D: Deserializer<'de>>(_: D) -> Result<Initial, D::Error> {
    Err(de::Error::custom(super::bodies::TOGETHER))
}

impl<'de> Visitor<'de> for SceneVisitor {
    type Value = Scene;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an object")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut access: A) -> Result<Scene, A::Error> {
        // The first pass put it first.
        let first = access.next_key::<SceneKey>()?.map(|SceneKey(key)| key);
        if first.as_deref() != Some("bodies") {
            return Scene::deserialize(MapAccessDeserializer::new(WithFirst { first, access }));
        }
        let bodies = access.next_value::<Vec<Body>>()?;
        let next = NextToBodies::deserialize(MapAccessDeserializer::new(access))?;
        let NextToBodies { potential, joints, .. } = next;
        Ok(Scene {
            inertia: next.inertia,
            driven: next.driven,
            torques: next.torques,
            wheels: next.wheels,
            control: next.control,
            field: next.field,
            initial: next.initial,
            ..Scene::of_bodies(Bodies { bodies, potential, joints })
        })
    }
}

/// A key of a scene.
struct SceneKey(String);

impl<'de> Deserialize<'de> for SceneKey {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        const KEYS: &[&str] = &[
            "inertia",
            "potential",
            "driven",
            "torques",
            "wheels",
            "control",
            "field",
            "initial",
            "bodies",
        ];
        let key = String::deserialize(deserializer)?;
        // Refused here, where the error still knows its place.
        if KEYS.contains(&key.as_str()) {
            Ok(Self(key))
        } else {
            Err(de::Error::unknown_field(&key, KEYS))
        }
    }
}

/// Fields of which the first key was read.
struct WithFirst<A> {
    first: Option<String>,
    access: A,
}

impl<'de, A: MapAccess<'de>> MapAccess<'de> for WithFirst<A> {
    type Error = A::Error;

    fn next_key_seed<K: DeserializeSeed<'de>>(
        &mut self,
        seed: K,
    ) -> Result<Option<K::Value>, A::Error> {
        match self.first.take() {
            Some(first) => seed.deserialize(de::value::StringDeserializer::new(first)).map(Some),
            None => self.access.next_key_seed(seed),
        }
    }

    fn next_value_seed<V: DeserializeSeed<'de>>(&mut self, seed: V) -> Result<V::Value, A::Error> {
        self.access.next_value_seed(seed)
    }
}

impl<'de> Deserialize<'de> for Entry {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(EntryVisitor)
    }
}

struct EntryVisitor;

impl<'de> Visitor<'de> for EntryVisitor {
    type Value = Entry;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a number (of a 3-vector) or a row of numbers (of a skew matrix)")
    }

    fn visit_f64<E>(self, value: f64) -> Result<Entry, E> {
        Ok(Entry::Number(value))
    }

    fn visit_i64<E>(self, value: i64) -> Result<Entry, E> {
        Ok(Entry::Number(value as f64))
    }

    fn visit_u64<E>(self, value: u64) -> Result<Entry, E> {
        Ok(Entry::Number(value as f64))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, access: A) -> Result<Entry, A::Error> {
        Vec::deserialize(SeqAccessDeserializer::new(access)).map(Entry::Row)
    }
}

impl<'de> Deserialize<'de> for TableauChoice {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(TableauVisitor)
    }
}

struct TableauVisitor;

impl<'de> Visitor<'de> for TableauVisitor {
    type Value = TableauChoice;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("the name of a tableau or an object with `a` and `b`")
    }

    fn visit_str<E: de::Error>(self, name: &str) -> Result<TableauChoice, E> {
        TableauName::deserialize(de::value::StrDeserializer::new(name)).map(TableauChoice::Named)
    }

    fn visit_map<A: MapAccess<'de>>(self, access: A) -> Result<TableauChoice, A::Error> {
        Coefficients::deserialize(MapAccessDeserializer::new(access)).map(TableauChoice::Custom)
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut access: A) -> Result<TableauChoice, A::Error> {
        while access.next_element::<IgnoredAny>()?.is_some() {}
        Err(de::Error::invalid_type(de::Unexpected::Seq, &self))
    }
}
