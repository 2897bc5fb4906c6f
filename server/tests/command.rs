//! The command `clearway`, as a person meets it.

use std::process::{Command, Output};

fn clearway(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_clearway")).args(arguments).output().expect("the binary starts")
}

#[test]
fn check_prints_the_default_configuration_as_one_that_check_accepts() {
    let output =
        clearway(&["check", "--config", concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/clearway.toml")]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let folder = tempfile::tempdir().unwrap();
    let printed = folder.path().join("effective.toml");
    std::fs::write(&printed, &output.stdout).unwrap();
    let again = clearway(&["check", "--config", printed.to_str().unwrap()]);
    assert_eq!(String::from_utf8_lossy(&again.stdout), String::from_utf8_lossy(&output.stdout));
}

#[test]
fn an_unknown_key_is_named_with_its_file_and_line_and_nothing_is_served() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("clearway.toml");
    std::fs::write(&file, "[grpc]\nlisten = \"127.0.0.1:0\"\nlissten = 1\n").unwrap();
    let output = clearway(&["serve", "--config", file.to_str().unwrap()]);
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("clearway.toml") && said.contains("line 3") && said.contains("lissten"), "{said}");
}

#[test]
fn a_wrong_use_is_answered_with_how_to_use_it() {
    let output = clearway(&["replay"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&output.stderr).contains("Usage: clearway replay"));
}
