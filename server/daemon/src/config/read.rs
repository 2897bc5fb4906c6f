//! A TOML text or table -> a part of the configuration, or a [`Refusal`]: the key, its value and what is allowed.
//!
//! serde describes a wrong value in words of Rust ("expected u16"). [`allowed`] replaces them by words of TOML.

use serde::de::DeserializeOwned;
use serde_path_to_error::{Path, Segment};
use toml::de::{DeTable, DeValue};
use toml::{Table, Value};

/// What a document refused, and where.
type Error = serde_path_to_error::Error<toml::de::Error>;

/// Keys that hold a list of tables, without the indices of the lists.
const LISTS: [&str; 2] = ["vehicle", "vehicle.sensor"];

/// Why a key or a value is refused.
#[derive(Debug, PartialEq)]
pub(super) struct Refusal {
    /// Path of the key, such as `vehicle.udp.data (of car)`.
    pub key: String,
    /// What is wrong with it.
    pub problem: Problem,
    /// Position in the text, in bytes; `None` if the configuration is read from a table.
    pub at: Option<usize>,
}

/// What is wrong with a key.
#[derive(Debug, PartialEq)]
pub(super) enum Problem {
    /// There is no such key; `known` are the keys of its table, separated by commas.
    Unknown { known: String },
    /// The key has no default and is not given.
    Missing,
    /// The value is not allowed.
    Value { value: String, allowed: String },
}

/// Reads a text that is valid TOML, and whose table is `table`.
///
/// # Errors
/// [`Refusal`] for the first key or value that is not allowed.
pub(super) fn from_text<T: DeserializeOwned>(text: &str, table: &Table) -> Result<T, Refusal> {
    read(table).map_err(|error| Refusal { at: position(text, &error), ..refusal(&error, table) })
}

/// Reads a table.
///
/// # Errors
/// [`Refusal`] for the first key or value that is not allowed.
pub(super) fn from_table<T: DeserializeOwned>(table: &Table) -> Result<T, Refusal> {
    read(table).map_err(|error| refusal(&error, table))
}

/// Texts are read as tables too, because each further kind of document would compile the whole configuration again.
fn read<T: DeserializeOwned>(table: &Table) -> Result<T, Error> {
    serde_path_to_error::deserialize(Value::Table(table.clone()))
}

/// The path of a key without the indices of lists and the names of vehicles: `vehicle.sensor.rpm` of
/// `vehicle.sensor[0].rpm (of car)`.
pub(super) fn plain_key(key: &str) -> String {
    let key = key.split(' ').next().unwrap_or(key);
    key.split('.').map(|part| part.split('[').next().unwrap_or(part)).collect::<Vec<_>>().join(".")
}

/// The text of a message of serde between the backticks after `start`.
fn named<'a>(message: &'a str, start: &str) -> Option<&'a str> {
    message.strip_prefix(start).and_then(|rest| rest.split('`').next())
}

const UNKNOWN: &str = "unknown field `";

fn refusal(error: &Error, table: &Table) -> Refusal {
    let message = error.inner().message();
    let (mut keys, value) = follow(error.path(), table);
    let problem = if let Some(unknown) = named(message, UNKNOWN) {
        if keys.last() != Some(unknown) {
            keys.push(unknown);
        }
        Problem::Unknown { known: quoted(message).skip(1).collect::<Vec<_>>().join(", ") }
    } else if let Some(missing) = named(message, "missing field `") {
        keys.push(missing);
        Problem::Missing
    } else if let Some((list, allowed)) = wrong_brackets(&keys.plain(), table) {
        return Refusal { key: list, problem: Problem::Value { value: "(a table)".into(), allowed }, at: None };
    } else {
        Problem::Value { value: value.map_or("(nothing)".into(), shown), allowed: allowed(message, &keys.plain()) }
    };
    Refusal { key: keys.to_string(), problem, at: None }
}

/// Where the refused key stands in the text, in bytes, or the table in which it is missing.
fn position(text: &str, error: &Error) -> Option<usize> {
    let document = DeTable::parse(text).ok()?;
    let mut at = document.span().start;
    let mut here = DeValue::Table(document.into_inner());
    let unknown = named(error.inner().message(), UNKNOWN);
    let segments = error.path().iter().map(|segment| match segment {
        Segment::Seq { index } => (None, *index),
        Segment::Map { key } => (Some(key.as_str()), 0),
        Segment::Enum { .. } | Segment::Unknown => (None, usize::MAX),
    });
    for (key, index) in segments.chain([(unknown, usize::MAX)]) {
        let (start, inner) = match (here, key) {
            (DeValue::Table(table), Some(key)) => {
                let mut keys = table.into_iter();
                let Some((name, value)) = keys.find(|(name, _)| name.get_ref() == key) else { break };
                (name.span().start, value)
            }
            (DeValue::Array(items), None) => {
                let Some(item) = items.into_iter().nth(index) else { break };
                (item.span().start, item)
            }
            _ => break,
        };
        (at, here) = (start, inner.into_inner());
    }
    Some(at)
}

/// The parts of a key's path.
struct Keys<'a> {
    parts: Vec<(&'a str, Option<usize>)>,
    vehicle: Option<&'a str>,
}

impl<'a> Keys<'a> {
    fn last(&self) -> Option<&'a str> {
        self.parts.last().map(|(name, _)| *name)
    }

    fn push(&mut self, name: &'a str) {
        self.parts.push((name, None));
    }

    fn plain(&self) -> String {
        self.parts.iter().map(|(name, _)| *name).collect::<Vec<_>>().join(".")
    }
}

impl std::fmt::Display for Keys<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        for (number, (name, index)) in self.parts.iter().enumerate() {
            let dot = if number > 0 { "." } else { "" };
            match index {
                // The vehicle's name is at the end.
                Some(index) if number > 0 => write!(f, "{dot}{name}[{index}]")?,
                _ => write!(f, "{dot}{name}")?,
            }
        }
        self.vehicle.map_or(Ok(()), |vehicle| write!(f, " (of {vehicle})"))
    }
}

/// The keys of a path and the value there. An index counts only in a list of tables; elsewhere the value says enough.
fn follow<'a>(path: &'a Path, table: &'a Table) -> (Keys<'a>, Option<&'a Value>) {
    let mut keys = Keys { parts: Vec::new(), vehicle: None };
    let mut value = None;
    for segment in path.iter() {
        match segment {
            Segment::Map { key } => {
                value = if keys.parts.is_empty() { table.get(key) } else { value.and_then(|value| value.get(key)) };
                keys.push(key);
            }
            Segment::Seq { index } => {
                value = value.and_then(|value| value.get(*index));
                let list = LISTS.contains(&keys.plain().as_str());
                if let (true, Some(last)) = (list, keys.parts.last_mut()) {
                    last.1 = Some(*index);
                    let name = value.and_then(|value| value.get("name")).and_then(Value::as_str);
                    keys.vehicle = keys.vehicle.or(name);
                }
            }
            Segment::Enum { .. } | Segment::Unknown => {}
        }
    }
    (keys, value)
}

/// A value as it stands in the file; a table only as such.
fn shown(value: &Value) -> String {
    match value {
        Value::Table(_) => "(a table)".into(),
        Value::Array(items) if items.iter().any(Value::is_table) => "(a list of tables)".into(),
        value => value.to_string(),
    }
}

/// The first table on the way to `key` that is written with one pair of brackets and needs two, or the reverse: its
/// key, and how to write it.
fn wrong_brackets(key: &str, table: &Table) -> Option<(String, String)> {
    let mut table = table;
    let mut at = String::new();
    for part in key.split('.') {
        at = if at.is_empty() { part.to_owned() } else { format!("{at}.{part}") };
        let is_list = LISTS.contains(&at.as_str());
        table = match table.get(part)? {
            Value::Table(_) if is_list => {
                return Some((at.clone(), format!("a list of tables: write [[{at}]] instead of [{at}]")));
            }
            Value::Array(items) if !is_list && items.iter().any(Value::is_table) => {
                return Some((at.clone(), format!("one table: write [{at}] instead of [[{at}]]")));
            }
            Value::Array(items) => items.first()?.as_table()?,
            value => value.as_table()?,
        };
    }
    None
}

/// The parts of a message that stand between backticks.
fn quoted(message: &str) -> impl Iterator<Item = &str> {
    message.split('`').skip(1).step_by(2)
}

/// What is allowed, by the message of serde or of the type that refused the value.
fn allowed(message: &str, key: &str) -> String {
    if message.starts_with("unknown variant") {
        let names: Vec<_> = quoted(message).skip(1).map(|name| format!("{name:?}")).collect();
        return names.join(", ");
    }
    let expected = message.rsplit_once(", expected ").map_or(message, |(_, expected)| expected);
    match expected {
        "a boolean" => "true or false",
        "u8" => "a whole number from 0 to 255",
        "u16" => "a whole number from 0 to 65535",
        "u32" => "a whole number from 0 to 4294967295",
        "u64" | "usize" => "a whole number, 0 or more",
        "f32" | "f64" => "a number",
        "a string" | "path string" | "string or map" | "wanted string or table" | "string only" => "text in quotes",
        "socket address" | "invalid socket address syntax" => {
            "an address with a port, such as \"127.0.0.1:50051\" or \"[::]:2368\""
        }
        "IP address" | "invalid IP address syntax" => "an address without a port, such as \"192.168.1.201\"",
        "a sequence" if LISTS.contains(&key) => return format!("a list of tables: write [[{key}]]"),
        "a sequence" => "a list in brackets, such as [] or [\"one\", \"two\"]",
        "a map" => return format!("a table: write [{key}]"),
        list if list.starts_with("an array of length ") => {
            return format!("a list of {} values in brackets", list.trim_start_matches("an array of length "));
        }
        table if table.starts_with("struct ") => return format!("a table: write [{key}]"),
        other => other,
    }
    .into()
}
