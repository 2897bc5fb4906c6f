//! A file that tells the program that started a replay how to reach it.

use std::path::{Path, PathBuf};

use clearway_daemon::run::Running;
use serde_json::json;

use super::error::ReplayError;

/// A file with the addresses of a replay, which exists while the replay can be reached.
pub(super) struct ReadyFile(PathBuf);

impl ReadyFile {
    /// Removes an empty file of this name, as `mktemp` makes one.
    ///
    /// # Errors
    /// [`ReplayError::Option`] if the file has a content, or cannot be removed.
    pub(super) fn prepare(file: &Path) -> Result<(), ReplayError> {
        match file.symlink_metadata() {
            Err(_) => Ok(()),
            Ok(metadata) if metadata.is_file() && metadata.len() == 0 => {
                std::fs::remove_file(file).map_err(|error| ReplayError::path("--ready-file", file, error))
            }
            Ok(_) => {
                let advice = "the file exists and is not overwritten; name another file, or delete it";
                Err(ReplayError::path("--ready-file", file, advice))
            }
        }
    }

    /// Writes the process id and the addresses of the running server as one JSON object: `pid`, `grpc` (`HOST:PORT`),
    /// `page` (URL), `zenoh` (list of endpoints), `foxglove` (URL), `vehicles`. What is not served is null, or an empty
    /// list. The file appears with its whole content.
    ///
    /// # Errors
    /// [`ReplayError::Option`] if the file exists or cannot be written.
    pub(super) fn write(file: &Path, running: &Running) -> Result<Self, ReplayError> {
        let vehicles: Vec<&str> = running.inputs.iter().map(|input| &*input.name).collect();
        let document = json!({
            "pid": std::process::id(),
            "grpc": running.grpc.map(|at| at.to_string()),
            "page": running.page.map(|at| format!("http://{at}/")),
            "zenoh": running.zenoh,
            "foxglove": running.foxglove.map(|at| format!("ws://{at}")),
            "vehicles": vehicles,
        });
        let unfinished = file.with_extension(format!("{}.unfinished", std::process::id()));
        let written = std::fs::write(&unfinished, format!("{document:#}\n"));
        // A link, unlike a rename, replaces no file.
        let linked = written.and_then(|()| std::fs::hard_link(&unfinished, file));
        // The file itself remains.
        let _ = std::fs::remove_file(&unfinished);
        linked.map_err(|error| ReplayError::path("--ready-file", file, error))?;
        Ok(Self(file.to_owned()))
    }
}

impl Drop for ReadyFile {
    fn drop(&mut self) {
        // The program that read it may have removed it.
        let _ = std::fs::remove_file(&self.0);
    }
}
