//! The file of `--ready-file`: tells the program that started the replay how to reach it.

use std::io::{Error, ErrorKind};
use std::path::{Path, PathBuf};

use serde_json::{Value, json};

use super::options::ReplayError;
use clearway_daemon::run::Running;

/// Greatest length of the file. Ours: it has a line for each vehicle.
const BYTES_MAX: u64 = 1 << 20;

/// The file, which exists while the replay can be reached.
pub struct ReadyFile(PathBuf);

impl ReadyFile {
    /// Removes the file of an earlier replay.
    ///
    /// # Errors
    /// [`ReplayError::ReadyFile`] if it is another file, or cannot be removed.
    pub fn remove_earlier(file: &Path) -> Result<(), ReplayError> {
        let wrong = |source| ReplayError::ReadyFile { file: file.to_owned(), source };
        let other = || {
            let advice = "the file exists and is not that of an earlier replay; name another file";
            wrong(Error::new(ErrorKind::AlreadyExists, advice))
        };
        let metadata = match file.metadata() {
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(()),
            metadata => metadata.map_err(wrong)?,
        };
        if !metadata.is_file() || metadata.len() > BYTES_MAX {
            return Err(other());
        }
        let text = std::fs::read(file).map_err(wrong)?;
        if !text.is_empty() {
            let pid = pid_of(&text).ok_or_else(other)?;
            if Path::new("/proc").join(pid.to_string()).exists() {
                let advice = format!("the file is that of process {pid}, which still runs; name another file");
                return Err(wrong(Error::new(ErrorKind::AlreadyExists, advice)));
            }
        }
        std::fs::remove_file(file).map_err(wrong)
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

/// The process that has written this text, if it is that of a replay.
fn pid_of(text: &[u8]) -> Option<u64> {
    let document: Value = serde_json::from_slice(text).ok()?;
    let is_ours = ["grpc", "page", "zenoh", "foxglove", "vehicles"].iter().all(|key| document.get(key).is_some());
    document.get("pid")?.as_u64().filter(|_| is_ours)
}

impl Drop for ReadyFile {
    fn drop(&mut self) {
        // It may have been removed by the program that read it.
        let _ = std::fs::remove_file(&self.0);
    }
}
