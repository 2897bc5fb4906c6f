//! Sources -> which module imports which, by the paths that its code names.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

use super::files;

/// The modules of a crate, as `a::b`, each with the modules that it names in a path.
pub fn imports(sources: &Path) -> BTreeMap<String, BTreeSet<String>> {
    let module = |file: &Path| {
        let path = file.strip_prefix(sources).expect("below the sources").with_extension("");
        let names: Vec<_> = path.iter().filter_map(|name| name.to_str()).collect();
        names.into_iter().filter(|name| !["mod", "lib", "main"].contains(name)).collect::<Vec<_>>().join("::")
    };
    let sources: Vec<_> = files(sources, &["rs"]);
    let modules: BTreeSet<String> = sources.iter().map(|file| module(file)).collect();
    let mut imports = BTreeMap::new();
    for file in &sources {
        let own = module(file);
        let text = without_comments(&fs::read_to_string(file).expect("UTF-8"));
        let mut named = BTreeSet::new();
        for path in paths(&text) {
            let Some(path) = absolute(&path, &own, &modules) else { continue };
            // The longest part of the path that is a module: what follows is an item in it.
            let found = (1..=path.len()).rev().map(|length| path[..length].join("::")).find(|m| modules.contains(m));
            named.extend(found.filter(|module| *module != own));
        }
        imports.entry(own).or_insert_with(BTreeSet::new).extend(named);
    }
    imports
}

/// The code of a file, without comments and without its module of tests.
pub fn without_comments(text: &str) -> String {
    let code = text.split("#[cfg(test)]\nmod ").next().unwrap_or(text);
    code.lines().map(|line| line.split("//").next().unwrap_or(line)).collect::<Vec<_>>().join("\n")
}

/// Every path of the code, `use` trees written out, visibility left out.
fn paths(code: &str) -> Vec<Vec<String>> {
    let mut paths = Vec::new();
    let mut rest = code;
    while let Some(start) = rest.find(|c: char| c.is_ascii_alphabetic() || c == '_') {
        let before = rest[..start].chars().next_back();
        rest = &rest[start..];
        let length = tree_length(rest);
        let is_visibility = before == Some('(') && ["crate", "super", "self"].contains(&rest[..length].trim());
        if !is_visibility {
            expand(&[], &rest[..length], &mut paths);
        }
        rest = &rest[length..];
    }
    paths
}

/// Bytes of the path that the text begins with, and of its `{...}` if it ends in one.
fn tree_length(text: &str) -> usize {
    let mut depth = 0_usize;
    for (at, c) in text.char_indices() {
        match c {
            '{' if depth > 0 || text[..at].ends_with("::") => depth += 1,
            '}' if depth > 0 => {
                depth -= 1;
                if depth == 0 {
                    return at + 1;
                }
            }
            _ if depth > 0 || c.is_ascii_alphanumeric() || c == '_' || c == ':' => {}
            _ => return at,
        }
    }
    text.len()
}

/// Writes out `a::{b, c::d}` as `a::b` and `a::c::d`.
fn expand(before: &[String], tree: &str, paths: &mut Vec<Vec<String>>) {
    let (path, branches) = match tree.split_once('{') {
        Some((path, branches)) => (path, Some(branches.trim_end().trim_end_matches('}'))),
        None => (tree, None),
    };
    let names = path.split("::").map(|name| name.split(" as ").next().unwrap_or(name).trim().to_owned());
    let path: Vec<_> = before.iter().cloned().chain(names.filter(|name| !name.is_empty())).collect();
    let Some(branches) = branches else {
        paths.push(path);
        return;
    };
    let (mut depth, mut from) = (0, 0);
    for (at, c) in branches.char_indices().chain([(branches.len(), ',')]) {
        match c {
            '{' => depth += 1,
            '}' => depth -= 1,
            ',' if depth == 0 => {
                expand(&path, branches[from..at].trim(), paths);
                from = at + 1;
            }
            _ => {}
        }
    }
}

/// The path from the crate's root; `None` where it leads out of the crate.
fn absolute(path: &[String], own: &str, modules: &BTreeSet<String>) -> Option<Vec<String>> {
    let mut place: Vec<String> = own.split("::").filter(|name| !name.is_empty()).map(str::to_owned).collect();
    let mut names = path.iter().peekable();
    match names.peek()?.as_str() {
        "crate" => {
            place.clear();
            names.next();
        }
        "self" | "super" => {
            while let Some(first) = names.next_if(|name| ["self", "super"].contains(&name.as_str())) {
                if first == "super" {
                    place.pop()?;
                }
            }
        }
        child => {
            let child: Vec<_> = place.iter().cloned().chain([child.to_owned()]).collect();
            modules.contains(&child.join("::")).then_some(())?;
        }
    }
    place.extend(names.cloned());
    Some(place)
}

/// Groups of modules that reach each other.
pub fn circles(imports: &BTreeMap<String, BTreeSet<String>>) -> Vec<Vec<String>> {
    let reached_from = |start: &String| {
        let (mut reached, mut open) = (BTreeSet::new(), vec![start]);
        while let Some(module) = open.pop() {
            for next in imports.get(module).into_iter().flatten() {
                if reached.insert(next.clone()) {
                    open.push(next);
                }
            }
        }
        reached
    };
    let reached: BTreeMap<_, _> = imports.keys().map(|module| (module, reached_from(module))).collect();
    let mut found: Vec<Vec<String>> = Vec::new();
    for module in imports.keys() {
        let circle = imports.keys().filter(|m| reached[module].contains(*m) && reached[*m].contains(module));
        let circle: Vec<_> = circle.cloned().collect();
        if circle.len() > 1 && !found.contains(&circle) {
            found.push(circle);
        }
    }
    found
}
