//! Overrides of single keys: `--set KEY=VALUE`, and environment variables.
//!
//! An override is a text: `grpc.listen=0.0.0.0:50051` of an option, or `$CLEARWAY__GRPC__LISTEN=0.0.0.0:50051` of a
//! variable. `vehicle[car2].queue` names one vehicle, by its name or its index; without brackets the first is meant.

use std::path::Path;

use super::error::{ConfigError, Origin, ValueError};
use super::layers::{Given, Layers, Node};
use super::read::plain_key;

/// Start of the variables that override keys: `CLEARWAY__GRPC__LISTEN` is `grpc.listen`.
const VARIABLE: &str = "CLEARWAY__";

/// The overrides in the environment, in the order of their names.
pub fn of_environment(variables: impl Iterator<Item = (String, String)>) -> Vec<String> {
    let ours = variables.filter(|(name, _)| name.starts_with(VARIABLE));
    let mut overrides: Vec<String> = ours.map(|(name, value)| format!("${name}={value}")).collect();
    overrides.sort();
    overrides
}

/// An override as its user wrote it.
pub(super) fn shown(text: &str) -> String {
    if text.starts_with('$') { text.to_owned() } else { format!("--set {text}") }
}

/// The path of the key that an override sets.
fn key(text: &str) -> String {
    let name = text.split('=').next().unwrap_or(text).trim();
    match name.strip_prefix('$').and_then(|name| name.strip_prefix(VARIABLE)) {
        Some(variable) => variable.to_lowercase().replace("__", "."),
        None => name.to_owned(),
    }
}

/// The overrides that set `key`, a table with that key, or a key of that table.
pub(super) fn matching<'a>(overrides: &'a [String], wanted: &str) -> impl Iterator<Item = &'a String> {
    let wanted = plain_key(wanted);
    let is_within = |inner: &str, outer: &str| {
        inner.strip_prefix(outer).is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
    };
    overrides.iter().filter(move |text| {
        let path = plain_key(&key(text)).replacen("vehicle_defaults", "vehicle", 1);
        is_within(&path, &wanted) || is_within(&wanted, &path)
    })
}

/// The overrides that an error at `key` is due to: the last of that key, or all if none sets it.
pub(super) fn blamed(overrides: &[String], key: &str) -> Vec<String> {
    match matching(overrides, key).last() {
        Some(text) => vec![shown(text)],
        None => overrides.iter().map(|text| shown(text)).collect(),
    }
}

/// The error of a value that was given in the overrides, else in the file.
pub(super) fn placed(error: ValueError, overrides: &[String], file: &Path) -> ConfigError {
    let origin = match matching(overrides, &error.key).next() {
        Some(_) => Origin::Options(blamed(overrides, &error.key)),
        None => Origin::file(file),
    };
    error.at(&origin)
}

/// Applies the override `a.b=value`; the value is TOML, or a bare string.
pub(super) fn set(layers: &mut Layers, text: &str) -> Result<(), ConfigError> {
    let wrong = || ConfigError::Override { option: shown(text) };
    let (_, value) = text.split_once('=').ok_or_else(wrong)?;
    let value = match toml::from_str::<toml::Table>(&format!("v = {value}")) {
        Ok(mut parsed) => parsed.remove("v").ok_or_else(wrong)?,
        Err(_) => toml::Value::String(value.to_owned()),
    };
    let path = key(text);
    let keys: Vec<&str> = path.split('.').collect();
    let (last, before) = keys.split_last().filter(|_| keys.iter().all(|key| !key.is_empty())).ok_or_else(wrong)?;
    let mut place = &mut layers.0;
    for (index, key) in before.iter().enumerate() {
        let not_table = || ConfigError::NotTable { option: shown(text), key: keys[..=index].join(".") };
        let not_there = || ConfigError::NotThere { option: shown(text), key: keys[..=index].join(".") };
        let (name, selected) = key.strip_suffix(']').and_then(|key| key.split_once('[')).unwrap_or((key, ""));
        let slot = place.entry(name.to_owned()).or_insert_with(|| Node::Table(Default::default()));
        let slot = match slot {
            Node::List(items) => {
                let is_selected = |(index, item): (usize, &Node)| {
                    // `vehicle.udp.data` means the first vehicle: the common case has one.
                    item.name() == Some(selected)
                        || selected.parse() == Ok(index)
                        || (selected.is_empty() && index == 0)
                };
                let index = items.iter().enumerate().position(is_selected).ok_or_else(not_there)?;
                &mut items[index]
            }
            other => other,
        };
        let Node::Table(table) = slot else { return Err(not_table()) };
        place = table;
    }
    let given = Given { origin: Origin::Options(vec![shown(text)]), is_inherited: false };
    place.insert((*last).to_owned(), Node::of(value, &given));
    Ok(())
}
