//! The file of `--ready-file`: tells the program that started the replay how to reach it.

use std::path::{Path, PathBuf};

use serde_json::json;

use super::options::ReplayError;
use crate::server::Running;

/// The file, which exists while the replay can be reached.
pub struct ReadyFile(PathBuf);

impl ReadyFile {
    /// Removes the file of an earlier replay.
    ///
    /// # Errors
    /// [`ReplayError::ReadyFile`] if it cannot be removed.
    pub fn remove_earlier(file: &Path) -> Result<(), ReplayError> {
        match std::fs::remove_file(file) {
            Err(source) if source.kind() != std::io::ErrorKind::NotFound => {
                Err(ReplayError::ReadyFile { file: file.to_owned(), source })
            }
            _ => Ok(()),
        }
    }

    /// Writes the process id and the addresses of the running server as one JSON object: `pid`, `grpc` (`HOST:PORT`),
    /// `page` (URL), `zenoh` (list of endpoints), `foxglove` (URL), `vehicles`. What is not served is null, or an empty
    /// list. The file appears with its whole content.
    ///
    /// # Errors
    /// [`ReplayError::ReadyFile`] if it cannot be written.
    pub fn write(file: &Path, running: &Running) -> Result<Self, ReplayError> {
        let vehicles: Vec<&str> = running.inputs.iter().map(|input| &*input.name).collect();
        let document = json!({
            "pid": std::process::id(),
            "grpc": running.grpc.map(|at| at.to_string()),
            "page": running.page.map(|at| format!("http://{at}/")),
            "zenoh": running.zenoh,
            "foxglove": running.foxglove.map(|at| format!("ws://{at}")),
            "vehicles": vehicles,
        });
        let wrong = |source| ReplayError::ReadyFile { file: file.to_owned(), source };
        let unfinished = file.with_extension(format!("{}.unfinished", std::process::id()));
        std::fs::write(&unfinished, format!("{document:#}\n")).map_err(wrong)?;
        std::fs::rename(&unfinished, file).map_err(wrong)?;
        Ok(Self(file.to_owned()))
    }
}

impl Drop for ReadyFile {
    fn drop(&mut self) {
        // It may have been removed by the program that read it.
        let _ = std::fs::remove_file(&self.0);
    }
}
