//! The layers of a configuration; later layers replace keys of earlier layers: `[vehicle_defaults]`, each
//! `[[vehicle]]`, environment variables and `--set`. Each value keeps the place at which it was given.

use std::collections::BTreeMap;
use std::path::Path;

use toml::de::{DeTable, DeValue};
use toml::{Table, Value};

use super::error::Origin;

/// The table of what all vehicles have in common. It holds the keys of `[[vehicle]]`.
pub(super) const DEFAULTS: &str = "vehicle_defaults";

/// Where a value was given.
#[derive(Clone, Debug)]
pub(super) struct Given {
    pub origin: Origin,
    /// True if a vehicle has it from [`DEFAULTS`].
    pub is_inherited: bool,
}

/// A value, a table, or a list of tables.
#[derive(Clone, Debug)]
pub(super) enum Node {
    Value(Value, Given),
    Table(BTreeMap<String, Node>),
    List(Vec<Node>),
}

/// The root table, by key.
#[derive(Clone, Debug)]
pub(super) struct Layers(pub BTreeMap<String, Node>);

impl Node {
    /// A value that was given at one place.
    pub fn of(value: Value, given: &Given) -> Self {
        match value {
            Value::Table(table) => {
                Self::Table(table.into_iter().map(|(key, value)| (key, Self::of(value, given))).collect())
            }
            Value::Array(items) if !items.is_empty() && items.iter().all(Value::is_table) => {
                Self::List(items.into_iter().map(|item| Self::of(item, given)).collect())
            }
            value => Self::Value(value, given.clone()),
        }
    }

    /// The value of the key `name` of a table.
    pub fn name(&self) -> Option<&str> {
        let Self::Table(table) = self else { return None };
        let Some(Self::Value(Value::String(name), _)) = table.get("name") else { return None };
        Some(name)
    }

    fn into_value(self) -> Value {
        match self {
            Self::Value(value, _) => value,
            Self::Table(table) => Value::Table(table.into_iter().map(|(key, node)| (key, node.into_value())).collect()),
            Self::List(items) => Value::Array(items.into_iter().map(Self::into_value).collect()),
        }
    }

    fn inherited(mut self) -> Self {
        match &mut self {
            Self::Value(_, given) => given.is_inherited = true,
            Self::Table(table) => table.values_mut().for_each(|node| *node = node.clone().inherited()),
            Self::List(items) => items.iter_mut().for_each(|node| *node = node.clone().inherited()),
        }
        self
    }

    fn visit(&self, at: &str, found: &mut BTreeMap<String, Given>) {
        match self {
            Self::Value(_, given) => _ = found.insert(at.to_owned(), given.clone()),
            Self::Table(table) => table.iter().for_each(|(key, node)| node.visit(&format!("{at}.{key}"), found)),
            Self::List(items) => {
                items.iter().enumerate().for_each(|(index, node)| node.visit(&format!("{at}[{index}]"), found));
            }
        }
    }
}

impl Layers {
    /// Keeps the vehicles of these names alone; all if there are no names.
    pub fn select(&mut self, names: &[String]) {
        let is_selected = |vehicle: &Node| vehicle.name().is_some_and(|name| names.iter().any(|of| of == name));
        if let Some(Node::List(vehicles)) = self.0.get_mut("vehicle").filter(|_| !names.is_empty()) {
            vehicles.retain(is_selected);
        }
    }

    /// The layer of the file. `table` is the table of `text`.
    pub fn of_file(text: &str, table: &Table, file: &Path) -> Self {
        let Ok(lines) = DeTable::parse(text) else { return Self(BTreeMap::new()) };
        Self(of_table(table, lines.get_ref(), &|at| Given {
            origin: Origin::File { file: file.to_owned(), line: Some(1 + text[..at].matches('\n').count()) },
            is_inherited: false,
        }))
    }

    /// Gives every vehicle the keys of `[vehicle_defaults]` that it does not have itself. A vehicle without sensors has
    /// the default sensors; a sensor of its own has the keys of the default sensor with its name.
    ///
    /// # Errors
    /// The value and what is allowed, if `vehicle_defaults` is no table, or names a vehicle.
    pub fn inherit(&mut self) -> Result<(), (String, String, String)> {
        let Some(defaults) = self.0.remove(DEFAULTS) else { return Ok(()) };
        let Node::Table(defaults) = defaults else {
            let allowed = format!("one table: write [{DEFAULTS}]");
            return Err((DEFAULTS.into(), "(no table)".into(), allowed));
        };
        if let Some(name) = defaults.get("name") {
            let value = name.clone().into_value().to_string();
            return Err((format!("{DEFAULTS}.name"), value, "no name: each [[vehicle]] has its own".into()));
        }
        if let Some(Node::List(vehicles)) = self.0.get_mut("vehicle") {
            for vehicle in vehicles {
                fill(vehicle, &defaults);
            }
        }
        Ok(())
    }

    /// The table of all layers.
    pub fn into_table(self) -> Table {
        self.0.into_iter().map(|(key, node)| (key, node.into_value())).collect()
    }

    /// Where each value was given, by its path, such as `vehicle[0].udp.data`.
    pub fn given(&self) -> BTreeMap<String, Given> {
        let mut found = BTreeMap::new();
        self.0.iter().for_each(|(key, node)| node.visit(key, &mut found));
        found
    }

    /// Where the key of an error was given, such as `vehicle.sensor[0].rpm (of car)`, or the first key below it.
    pub fn origin(&self, key: &str) -> Option<Origin> {
        let (path, vehicle) =
            key.split_once(" (of ").map_or((key, ""), |(path, rest)| (path, rest.trim_end_matches(')')));
        let named = match self.0.get("vehicle") {
            Some(Node::List(vehicles)) => vehicles.iter().position(|node| node.name() == Some(vehicle)),
            _ => None,
        };
        let path = match path.strip_prefix("vehicle.") {
            Some(rest) => format!("vehicle[{}].{rest}", named.unwrap_or(0)),
            None => path.to_owned(),
        };
        let given = self.given();
        let below =
            |at: &str| at.strip_prefix(&path).is_some_and(|rest| rest.is_empty() || rest.starts_with(['.', '[']));
        given.iter().find(|(at, _)| below(at)).map(|(_, given)| given.origin.clone())
    }
}

fn of_table(table: &Table, lines: &DeTable<'_>, given: &dyn Fn(usize) -> Given) -> BTreeMap<String, Node> {
    let keys = lines.iter().filter_map(|(key, spanned)| {
        let name = key.get_ref().as_ref();
        let node = of_value(table.get(name)?, spanned.get_ref(), &given(key.span().start), given);
        Some((name.to_owned(), node))
    });
    keys.collect()
}

fn of_value(value: &Value, spanned: &DeValue<'_>, here: &Given, given: &dyn Fn(usize) -> Given) -> Node {
    match (value, spanned) {
        (Value::Table(table), DeValue::Table(lines)) => Node::Table(of_table(table, lines, given)),
        (Value::Array(items), DeValue::Array(lines)) if !items.is_empty() && items.iter().all(Value::is_table) => {
            let items = items.iter().zip(lines.iter());
            Node::List(items.map(|(item, line)| of_value(item, line.get_ref(), here, given)).collect())
        }
        (value, _) => Node::of(value.clone(), here),
    }
}

/// Adds the keys of `defaults` that `node` does not have, if it is a table.
fn fill(node: &mut Node, defaults: &BTreeMap<String, Node>) {
    let Node::Table(table) = node else { return };
    for (key, default) in defaults {
        match (table.get_mut(key), default) {
            (None, default) => _ = table.insert(key.clone(), default.clone().inherited()),
            (Some(own @ Node::Table(_)), Node::Table(default)) => fill(own, default),
            (Some(Node::List(own)), Node::List(default)) => {
                for item in own {
                    let named =
                        default.iter().find(|default| default.name().is_some() && default.name() == item.name());
                    if let Some(Node::Table(default)) = named {
                        fill(item, default);
                    }
                }
            }
            _ => {}
        }
    }
}
