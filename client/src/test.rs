//! For tests of planners: a recording -> a server of its own process that replays it as if live (feature `test`).
//!
//! The command `clearway` is the command that the environment variable `CLEARWAY` names, else the command that cargo
//! built beside the test, else the installed command. The stamps of the maps are shifted to the present, so that their
//! ages are as on the vehicle. The drive begins when the first reader has subscribed; after its end the last map stays,
//! and becomes stale. [`Client::replay_control`] pauses, steps and seeks.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use crate::{Client, ClientError};

/// Longest wait for the server; ours, ten times what a loaded machine needs.
const PATIENCE: Duration = Duration::from_secs(60);
/// Interval at which the ready file is looked for.
const POLL: Duration = Duration::from_millis(5);

/// The file of what the server says.
const LOG: &str = "log.txt";

/// A recording that is replayed by a server of its own process, on free ports of this machine. Dropping it, or the end
/// of this process, however it ends, ends the server.
#[derive(Debug)]
pub struct Replay {
    server: Child,
    folder: PathBuf,
    /// Address of gRPC, `HOST:PORT`.
    pub grpc: String,
    /// Address of the page, a URL; empty if it is not served.
    pub page: String,
    /// Endpoints of zenoh, separated by commas, as `ZenohClient::connect` takes them; empty if it is not served.
    pub zenoh: String,
}

/// Why a replay did not start.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// The command cannot be run.
    #[error("run {command:?}: {source}; install clearway, or name its command in the environment variable CLEARWAY")]
    Command {
        /// Path or name of the command that was tried.
        command: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// The server ended before readers could connect.
    #[error("clearway replay ended: {0}")]
    Ended(String),
    /// The server was not ready in time.
    #[error("clearway replay is not ready after {} s", PATIENCE.as_secs())]
    Late,
    /// The server has not ended in time.
    #[error("clearway replay has not ended after {} s; --exit-at-end ends it with the drive", PATIENCE.as_secs())]
    Running,
    /// A folder or file of the replay cannot be written or read.
    #[error("{}: {source}", path.display())]
    File {
        /// The folder or file.
        path: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
}

/// The golden recording: 0.9 s of a car with a VLP-16 in a simulated town, 10 maps.
pub fn town() -> &'static Path {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/golden/town.mcap"))
}

/// The command that replays.
fn command() -> PathBuf {
    let beside = || {
        let test = std::env::current_exe().ok()?;
        // target/<profile>/deps/<test>
        Some(test.parent()?.parent()?.join("clearway")).filter(|command| command.is_file())
    };
    std::env::var_os("CLEARWAY").map(PathBuf::from).or_else(beside).unwrap_or_else(|| "clearway".into())
}

impl Replay {
    /// Starts the replay of a recording.
    ///
    /// # Errors
    /// As [`Replay::with`].
    pub fn start(recording: impl AsRef<Path>) -> Result<Self, ReplayError> {
        Self::with(recording, &[])
    }

    /// Starts the replay of a recording with more options of `clearway replay`, such as `["--speed", "0.5"]`; returns
    /// when readers can connect.
    ///
    /// # Errors
    /// [`ReplayError::Command`] if the command cannot be run, [`ReplayError::Ended`] with its message if it ends,
    /// [`ReplayError::Late`] if it is not ready after 60 s, [`ReplayError::File`] if a file cannot be written or read.
    pub fn with(recording: impl AsRef<Path>, options: &[&str]) -> Result<Self, ReplayError> {
        static STARTED: AtomicU32 = AtomicU32::new(0);
        let number = STARTED.fetch_add(1, Ordering::Relaxed);
        let folder = std::env::temp_dir().join(format!("clearway-replay-{}-{number}", std::process::id()));
        let [ready, log] = ["ready.json", LOG].map(|name| folder.join(name));
        let file = |path: &Path| {
            let path = path.to_owned();
            move |source| ReplayError::File { path, source }
        };
        fs::create_dir_all(&folder).map_err(file(&folder))?;
        let command = command();
        let server = Command::new(&command)
            .arg("replay")
            .arg(recording.as_ref())
            .args(["--serve", "--as-live", "--any-port", "--ready-file"])
            .arg(&ready)
            .args(if options.contains(&"--wait-readers") { &[][..] } else { &["--wait-readers", "1"] })
            .args(options)
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(fs::File::create(&log).map_err(file(&log))?)
            .spawn()
            .map_err(|source| ReplayError::Command { command, source })?;
        let mut replay = Self { server, folder, grpc: String::new(), page: String::new(), zenoh: String::new() };
        let began = Instant::now();
        while !ready.exists() {
            if let Ok(Some(status)) = replay.server.try_wait() {
                let said = fs::read_to_string(&log).unwrap_or_default();
                return Err(ReplayError::Ended(format!("{status}: {}", said.trim())));
            }
            if began.elapsed() > PATIENCE {
                return Err(ReplayError::Late);
            }
            std::thread::sleep(POLL);
        }
        let text = fs::read_to_string(&ready).map_err(file(&ready))?;
        let addresses: serde_json::Value =
            serde_json::from_str(&text).map_err(|error| file(&ready)(std::io::Error::other(error)))?;
        let address = |name: &str| addresses[name].as_str().unwrap_or_default().to_owned();
        (replay.grpc, replay.page) = (address("grpc"), address("page"));
        let endpoints = addresses["zenoh"].as_array().into_iter().flatten().filter_map(|endpoint| endpoint.as_str());
        replay.zenoh = endpoints.collect::<Vec<_>>().join(",");
        Ok(replay)
    }

    /// A client of the server.
    ///
    /// # Errors
    /// As [`Client::connect`].
    pub async fn client(&self) -> Result<Client, ClientError> {
        Client::connect(&self.grpc).await
    }

    /// Waits until the server has ended, which it does with the option `--exit-at-end`; returns its exit status.
    ///
    /// # Errors
    /// [`ReplayError::Running`] if it has not ended after 60 s, [`ReplayError::File`] if the system does not tell.
    pub fn wait(&mut self) -> Result<ExitStatus, ReplayError> {
        let began = Instant::now();
        while began.elapsed() < PATIENCE {
            let ended = self.server.try_wait();
            if let Some(status) = ended.map_err(|source| ReplayError::File { path: self.folder.clone(), source })? {
                return Ok(status);
            }
            std::thread::sleep(POLL);
        }
        Err(ReplayError::Running)
    }

    /// What the server has said so far.
    pub fn log(&self) -> String {
        fs::read_to_string(self.folder.join(LOG)).unwrap_or_default()
    }

    /// Stops the server as a crash would: without a word to its readers.
    pub fn kill(&mut self) {
        // It may have ended already.
        let _ = self.server.kill();
        let _ = self.server.wait();
    }
}

impl Drop for Replay {
    fn drop(&mut self) {
        self.kill();
        let _ = fs::remove_dir_all(&self.folder);
    }
}
