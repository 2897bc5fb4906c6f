//! The wire is a promise: `buf` finds neither a fault nor a break in it, and the page that shows how to decode a map is
//! right.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use clearway_proto::codec::{Cells, Limits};
use clearway_proto::map::decode_map;
use clearway_tests::workspace;
use serde_json::{Value, json};

use crate::fixture::venv;

/// The descriptors of the wire as it landed last: what a change may not break.
const LANDED: &str = "golden/landed.binpb";

/// `buf`, installed below the target directory.
fn buf() -> PathBuf {
    const PACKAGE: &str = "@bufbuild/buf@1.75.0";
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("buf-1.75.0");
    let program = folder.join("node_modules/.bin/buf");
    if !program.exists() {
        let mut npm = Command::new("npm");
        npm.args(["install", "--silent", "--no-audit", "--no-fund", "--prefix"]).arg(&folder).arg(PACKAGE);
        venv::run(&mut npm, "this test needs npm, and a package registry");
    }
    program
}

fn buf_in(folder: &Path, arguments: &[&str]) -> Output {
    Command::new(buf()).args(arguments).current_dir(folder).output().expect("buf runs")
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr)
}

#[test]
#[cfg_attr(not(clearway_npm), ignore = "needs npm: apt-get install npm")]
fn buf_finds_no_fault_in_the_wire_and_no_break_since_it_landed() {
    let proto = workspace().join("proto");
    for arguments in [&["lint"][..], &["breaking", "--against", LANDED]] {
        let output = buf_in(&proto, arguments);
        assert!(output.status.success(), "buf {arguments:?}:\n{}", said(&output));
    }
    let folder = tempfile::tempdir().unwrap();
    let built = folder.path().join("built.binpb");
    let output = buf_in(&proto, &["build", "--exclude-source-info", "-o", built.to_str().unwrap()]);
    assert!(output.status.success(), "{}", said(&output));
    if std::env::var_os("CLEARWAY_BLESS").is_some() {
        fs::copy(&built, proto.join(LANDED)).unwrap();
    }
    let is_landed = fs::read(&built).unwrap() == fs::read(proto.join(LANDED)).unwrap();
    assert!(is_landed, "the wire has grown; CLEARWAY_BLESS=1 makes proto/{LANDED} hold it to what is new");

    // A field with another number is a break.
    venv::run(Command::new("cp").arg("-r").arg(proto.join("clearway")).arg(folder.path()), "cp");
    fs::copy(proto.join("buf.yaml"), folder.path().join("buf.yaml")).unwrap();
    let file = folder.path().join("clearway/v1/map.proto");
    let changed = fs::read_to_string(&file).unwrap().replace("uint64 sequence = 3;", "uint64 sequence = 33;");
    fs::write(&file, changed).unwrap();
    let output = buf_in(folder.path(), &["breaking", "--against", proto.join(LANDED).to_str().unwrap()]);
    assert!(!output.status.success() && said(&output).contains("\"sequence\""), "{}", said(&output));
}

#[test]
#[cfg_attr(not(clearway_python), ignore = "needs Python: apt-get install python3 python3-venv")]
fn the_program_of_the_page_on_decoding_finds_the_classes_of_every_golden_map() {
    let proto = workspace().join("proto");
    let page = fs::read_to_string(proto.join("DECODE.md")).unwrap();
    let program = page.split("```python\n").nth(1).and_then(|rest| rest.split("```").next()).expect("a program");
    assert!(program.lines().filter(|line| !line.is_empty()).count() <= 60, "as the page says");
    for name in ["map", "by_class", "by_class_plain", "delta_base", "delta_whole"] {
        let file = proto.join("golden").join(name).with_extension("bin");
        let decoded = venv::run(Command::new("python3").arg("-c").arg(program).arg(&file), "the page is wrong");
        let decoded: Value = serde_json::from_str(&decoded).unwrap();
        let map = decode_map(fs::read(&file).unwrap().into(), &Limits::default()).unwrap();
        assert_eq!(decoded["vehicle"], json!(map.header.vehicle));
        assert_eq!(decoded["valid_until_ns"], json!(map.header.valid_until_ns));
        assert_eq!(decoded["layers"].as_array().unwrap().len(), map.layers.len());
        for (layer, decoded) in map.layers.iter().zip(decoded["layers"].as_array().unwrap()) {
            let classes = layer.channel("class").map(|channel| {
                let Cells::U8(cells) = &channel.cells else { panic!("classes are bytes") };
                cells.iter().map(|&class| layer.legend[usize::from(class)].name.clone()).collect::<Vec<_>>()
            });
            assert_eq!((&decoded["name"], &decoded["classes"]), (&json!(layer.name), &json!(classes)), "{name}");
        }
    }
}
