//! What is published: accepted by its registry's own check, and used where nothing but the package is there. The Python
//! distribution is checked and used in `kit`.

use std::fs;
use std::path::Path;
use std::process::Command;

use clearway_tests::{binaries, cargo, workspace};

use crate::fixture::pages;
use crate::fixture::venv::run;

#[test]
fn five_crates_can_be_published() {
    let folder = tempfile::tempdir().unwrap();
    let mut publish = cargo();
    publish.args(["publish", "--dry-run", "--no-verify", "--allow-dirty", "--target-dir"]).arg(folder.path());
    for name in ["proto", "ros", "lidar", "mapping", "client"] {
        publish.arg(format!("--package=clearway-{name}"));
    }
    run(&mut publish, "cargo names what a registry would refuse");
}

/// A program that uses the package `clearway-map`, in TypeScript.
const PROGRAM: &str = r#"
import { readFileSync } from "node:fs";
import { DecodeError, LiveMap, type Layer } from "clearway-map";

const map = new LiveMap(new Uint8Array(readFileSync(process.argv[2])));
const layer: Layer | null = map.layer("drivability");
const classes = layer?.cells("class");
if (!layer || !classes) throw new DecodeError("layer", map.names.join());
const cell: number = layer.grid.cellAt(2.0, 0.1);
const valid_ms: bigint = (map.header.valid_until_ns - map.header.capture_end_ns) / 1_000_000n;
console.log(layer.legend[classes[cell]].name, layer.legend[classes[cell]].meaning, valid_ms);
"#;

#[test]
#[cfg_attr(not(clearway_npm), ignore = "needs npm: apt-get install npm")]
fn the_package_of_the_browsers_decoder_is_used_from_typescript_where_only_it_is_installed() {
    let folder = tempfile::tempdir().unwrap();
    let npm = |arguments: &[&str], inside: &Path| {
        let hint = "this test needs npm, and a package registry";
        run(Command::new("npm").args(arguments).args(["--silent", "--no-audit", "--no-fund"]).current_dir(inside), hint)
    };
    let package = workspace().join("client/web");
    let packed = npm(&["pack", "--pack-destination", folder.path().to_str().unwrap()], &package);
    fs::write(folder.path().join("package.json"), r#"{"private": true, "type": "module"}"#).unwrap();
    npm(&["install", &format!("./{}", packed.trim()), "typescript@5.9.3", "@types/node@24.10.1"], folder.path());
    fs::write(folder.path().join("program.ts"), PROGRAM).unwrap();
    let compile = ["--strict", "--target", "es2022", "--module", "nodenext", "--types", "node", "program.ts"];
    let tsc = folder.path().join("node_modules/.bin/tsc");
    run(Command::new(tsc).args(compile).current_dir(folder.path()), "tsc names what is wrong");
    let map = workspace().join("proto/golden/map.bin");
    let said = run(Command::new("node").arg("program.js").arg(map).current_dir(folder.path()), "node");
    assert_eq!(said, "drivable free 300n\n");
}

#[test]
#[cfg_attr(not(clearway_npm), ignore = "needs npm: apt-get install npm")]
fn the_extension_for_foxglove_is_packed_and_shows_the_grids_of_the_servers_own_output() {
    let folder = tempfile::tempdir().unwrap();
    let copied = [("client/web", "client"), ("client/golden", "client"), ("proto/golden", "proto"), ("LICENSE", "")];
    for (from, to) in copied {
        fs::create_dir_all(folder.path().join(to)).unwrap();
        run(Command::new("cp").arg("-r").arg(workspace().join(from)).arg(folder.path().join(to)), "cp");
    }
    let exported = folder.path().join("town.foxglove.mcap");
    let mut export = Command::new(binaries().join("clearway"));
    export.args(["export", "client/golden/town.mcap", "--format", "foxglove", "--out"]).arg(&exported);
    run(export.current_dir(folder.path()), "clearway says what is wrong");
    let extension = folder.path().join("client/web/foxglove");
    let commands = pages::commands("client/web/foxglove/README.md");
    for command in &commands {
        let mut words = command.split(' ');
        let mut npm = Command::new(words.next().expect("npm"));
        npm.args(words).args(["--no-audit", "--no-fund"]).current_dir(&extension).env("CLEARWAY_EXPORTED", &exported);
        let said = run(&mut npm, "this test needs npm, and a package registry");
        assert!(!said.contains("# SKIP"), "{said}");
    }
    assert_eq!(commands.len(), 3, "{commands:?}");
    let packed = fs::read(extension.join("clearway.clearway-foxglove-0.1.0.foxe")).unwrap();
    let names = ["package.json", "README.md", "CHANGELOG.md", "dist/extension.js", "dist/LICENSE"];
    assert!(names.iter().all(|name| packed.windows(name.len()).any(|bytes| bytes == name.as_bytes())));
    println!("the extension has {} bytes", packed.len());
}
