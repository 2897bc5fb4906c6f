//! The command `clearway`: configuration and usage errors.

use std::process::{Command, Output};

fn clearway(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_clearway")).args(arguments).output().expect("the binary starts")
}

#[test]
fn check_accepts_the_effective_configuration_that_it_prints() {
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
fn an_unknown_key_is_refused_with_its_file_and_line() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("clearway.toml");
    std::fs::write(&file, "[grpc]\nlisten = \"127.0.0.1:0\"\nlissten = 1\n").unwrap();
    let output = clearway(&["serve", "--config", file.to_str().unwrap()]);
    let message = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{message}");
    assert!(message.contains("clearway.toml") && message.contains("line 3") && message.contains("lissten"), "{message}");
}

#[test]
fn wrong_arguments_are_answered_with_the_usage() {
    let output = clearway(&["replay"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&output.stderr).contains("Usage: clearway replay"));
}
