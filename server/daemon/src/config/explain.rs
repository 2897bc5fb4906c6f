//! The whole configuration as TOML, with the place at which each value was given.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use super::error::Origin;
use super::layers::Given;

/// Adds to each line of `toml`, as the `toml` crate writes it, where its value was given; a default has no comment.
pub(super) fn explained(toml: &str, given: &BTreeMap<String, Given>) -> String {
    let explained = |(key, line): (Option<String>, &str)| match key.and_then(|key| given.get(&key)) {
        Some(given) => format!("{line}  # {}\n", place(given)),
        None => format!("{line}\n"),
    };
    keyed(toml).into_iter().map(explained).collect()
}

/// The keys whose values differ in two configurations, as [`super::Config::to_toml`] writes them.
pub fn differing_keys(one: &str, other: &str) -> BTreeSet<String> {
    let [one, other] = [one, other].map(|toml| keyed(toml).into_iter().collect::<BTreeSet<_>>());
    one.symmetric_difference(&other).filter_map(|(key, _)| key.clone()).collect()
}

/// Each line of `toml` with the path of its key, if it has one.
fn keyed(toml: &str) -> Vec<(Option<String>, &str)> {
    let mut counts: BTreeMap<String, usize> = BTreeMap::new();
    let mut at = String::new();
    let mut lines = Vec::new();
    for line in toml.lines() {
        if let Some(header) = line.strip_prefix('[') {
            let name = header.trim_matches(['[', ']']);
            if header.starts_with('[') {
                let of = indexed(name.rsplit_once('.').map_or("", |(list, _)| list), &counts);
                let list = if of.is_empty() { name.to_owned() } else { format!("{of}.{}", last(name)) };
                *counts.entry(list).or_default() += 1;
            }
            at = indexed(name, &counts);
        }
        let key = line.split_once(" = ").map(|(key, _)| if at.is_empty() { key.into() } else { format!("{at}.{key}") });
        lines.push((key, line));
    }
    lines
}

fn last(name: &str) -> &str {
    name.rsplit('.').next().unwrap_or(name)
}

/// `vehicle.sensor.extrinsics` with the index of the newest item of each list: `vehicle[1].sensor[0].extrinsics`.
fn indexed(name: &str, counts: &BTreeMap<String, usize>) -> String {
    name.split('.').filter(|part| !part.is_empty()).fold(String::new(), |before, part| {
        let path = if before.is_empty() { part.to_owned() } else { format!("{before}.{part}") };
        match counts.get(&path) {
            Some(count) => format!("{path}[{}]", count - 1),
            None => path,
        }
    })
}

fn place(given: &Given) -> String {
    let name = |file: &Path| file.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let place = match &given.origin {
        Origin::File { file, line: Some(line) } => format!("{}:{line}", name(file)),
        Origin::File { file, line: None } => name(file),
        Origin::Options(options) => {
            options.iter().map(|option| option.split('=').next().unwrap_or(option)).collect::<Vec<_>>().join(" ")
        }
    };
    if given.is_inherited { format!("{place}, vehicle_defaults") } else { place }
}
