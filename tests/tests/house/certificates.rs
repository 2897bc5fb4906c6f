//! Certificates of a CA, and of another one, as deploy/make-test-ca.sh makes them, and what is served with them.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

use clearway_server::config::{Access, Config, Tls};
use clearway_server::server::{Running, Server, Setup};

/// The folder of `ours` or `theirs`, which lie beside each other.
pub fn certificates(ca: &str) -> PathBuf {
    static MADE: OnceLock<tempfile::TempDir> = OnceLock::new();
    let folder = MADE.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        for ca in ["ours", "theirs"] {
            let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy/make-test-ca.sh");
            let made = Command::new("sh").arg(script).arg(folder.path().join(ca)).output().expect("a shell");
            let said = String::from_utf8_lossy(&made.stderr).into_owned();
            assert!(made.status.success(), "deploy/make-test-ca.sh needs Debian's openssl: {said}");
        }
        folder
    });
    folder.path().join(ca)
}

/// The configuration of a server of our CA over gRPC, with a role for each name; `ask_clients`: they show who they are.
pub fn secured(ask_clients: bool) -> Config {
    let folder = certificates("ours");
    let mut config = super::config();
    config.grpc.tls = Some(Tls {
        certificate: folder.join("server.pem"),
        key: folder.join("server.key"),
        client_ca: ask_clients.then(|| folder.join("ca.pem")),
    });
    if ask_clients {
        config.grpc.access = Access {
            readers: vec!["reader".into()],
            ingesters: vec!["ingester".into()],
            operators: vec!["operator".into()],
        };
    }
    config
}

/// Starts a server with the certificates that its configuration names.
pub async fn start(config: Config) -> Running {
    let certificates = config.certificates(Path::new("")).expect("the certificates are there");
    let setup = Setup { config, certificates, from_files: true, ..Setup::default() };
    Server::start(setup).await.expect("the server starts")
}

/// A file of deploy/zenoh with these certificates instead of those in `certificates/`.
pub fn zenoh_file(name: &str, certificates: &Path) -> String {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy/zenoh").join(name);
    let text = std::fs::read_to_string(file).expect("a file of the repository");
    text.replace("\"certificates/", &format!("\"{}/", certificates.display()))
}
