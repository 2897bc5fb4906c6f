//! `clearway info`: a recording, a capture, a scan or a folder of them -> a description of its contents.

use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use serde_json::Value;

use crate::info::{of_file, of_folder};
use crate::terminal::{Exit, counted, print_line, printable};

/// Describe a file: a recording, a ROS 2 bag, a capture (pcap, pcapng) or a scan (.bin, .pcd.bin, .pcd); or a folder.
#[derive(Args)]
#[command(after_help = "Examples:
  clearway info drive.mcap
  clearway info drive.pcap --json")]
pub struct InfoArguments {
    /// The file; its first bytes, or else its name, give its kind. Of a folder, each file but one of its scans alone.
    file: PathBuf,
    /// Print one JSON object.
    #[arg(long)]
    json: bool,
}

/// Prints the description of the file. A file that is not whole is [`Exit::Unreadable`].
pub fn run(options: &InfoArguments) -> Result<Exit> {
    let file = &options.file;
    let document = if file.is_dir() { of_folder(file)? } else { of_file(file)? };
    if options.json {
        print_line(&serde_json::to_string_pretty(&document)?)?;
    } else {
        let mut lines = Vec::new();
        describe(&document, "", &mut lines);
        print_line(&lines.join("\n"))?;
    }
    let described: Vec<(PathBuf, &Value)> = match document["files"].as_object() {
        Some(files) => files.iter().map(|(name, document)| (file.join(name), document)).collect(),
        None => vec![(file.clone(), &document)],
    };
    let mut is_incomplete = false;
    for (file, document) in described.iter().filter(|(_, document)| document["complete"] == false) {
        is_incomplete = true;
        let state = printable(document["state"].as_str().unwrap_or_default());
        eprintln!("clearway: {} is not whole: {state}", file.display());
    }
    Ok(Exit::from_incomplete(is_incomplete))
}

/// Adds the document as `key: value` lines; nested objects are indented.
fn describe(document: &Value, indent: &str, lines: &mut Vec<String>) {
    for (key, value) in document.as_object().into_iter().flatten() {
        match value {
            Value::Object(inner) if inner.is_empty() => lines.push(format!("{indent}{key}: none")),
            Value::Object(_) => {
                lines.push(format!("{indent}{key}:"));
                describe(value, &format!("{indent}  "), lines);
            }
            Value::Null => lines.push(format!("{indent}{key}: not known")),
            Value::String(text) if text.contains('\n') => {
                let count = counted(text.lines().count() as u64, "line");
                lines.push(format!("{indent}{key}: {count}; --json prints it"));
            }
            Value::String(text) => lines.push(format!("{indent}{key}: {text}")),
            other => lines.push(format!("{indent}{key}: {other}")),
        }
    }
}
