//! How a subcommand meets a server, and prints.

use std::path::PathBuf;

use anyhow::{Context, Result};
use clap::Args;
use clearway_client::{Client, Tls};
use indicatif::{ProgressBar, ProgressStyle};

/// Where a server listens unless told otherwise.
const SERVER: &str = "localhost:50051";

/// Which server, and how it is met.
#[derive(Args)]
pub struct Server {
    /// The server's gRPC address.
    #[arg(long = "server", default_value = SERVER, env = "CLEARWAY_SERVER")]
    pub address: String,
    /// PEM file with the CA of the server's certificate: the connection is encrypted.
    #[arg(long, value_name = "FILE.pem", env = "CLEARWAY_CA")]
    ca: Option<PathBuf>,
    /// PEM file with this client's certificate, where the server asks for one.
    #[arg(long, value_name = "FILE.pem", env = "CLEARWAY_CERT", requires_all = ["ca", "key"])]
    cert: Option<PathBuf>,
    /// PEM file with its private key.
    #[arg(long, value_name = "FILE.key", env = "CLEARWAY_KEY", requires = "cert")]
    key: Option<PathBuf>,
}

impl Server {
    /// Connects.
    ///
    /// # Errors
    /// A file that cannot be read, or what the transport says.
    pub async fn connect(&self) -> Result<Client> {
        let read = |file: &PathBuf| std::fs::read_to_string(file).with_context(|| format!("read {}", file.display()));
        let Some(ca) = &self.ca else { return Ok(Client::connect(&self.address).await?) };
        let identity = match (&self.cert, &self.key) {
            (Some(certificate), Some(key)) => Some((read(certificate)?, read(key)?)),
            _ => None,
        };
        Ok(Client::connect_tls(&self.address, &Tls { ca: read(ca)?, identity, server_name: String::new() }).await?)
    }
}

/// zenoh needs the multi-thread runtime.
pub fn block_on(work: impl Future<Output = Result<()>>) -> Result<()> {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().context("start the runtime")?;
    runtime.block_on(work)
}

/// Progress through a file, on a terminal only.
pub fn progress_bar(length: u64) -> ProgressBar {
    let style = ProgressStyle::with_template("{bar:40} {percent:>3} % {msg}").unwrap_or_else(|_| {
        // The template is a constant; the plain bar serves as well.
        ProgressStyle::default_bar()
    });
    // indicatif draws nothing where stderr is no terminal.
    ProgressBar::new(length).with_style(style)
}

/// Prints one line on stdout; a reader that has gone (`| head`) ends the command in peace.
pub fn say(line: &str) -> Result<bool> {
    use std::io::Write;
    match writeln!(std::io::stdout(), "{line}") {
        Ok(()) => Ok(true),
        Err(error) if error.kind() == std::io::ErrorKind::BrokenPipe => Ok(false),
        Err(error) => Err(error).context("write to stdout"),
    }
}
