//! Certificates of a CA, and of another one, as deploy/make-test-ca.sh makes them, and what is served with them, and routed.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

use clearway::config::{Access, Config, Tls, ZenohMode};
use clearway::server::{Running, Server, Setup};

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

/// The router of deploy/zenoh, on a port of the system's choice, and where it is met.
pub async fn router() -> (zenoh::Session, String) {
    let text = zenoh_file("router.json5", &certificates("ours")).replace("tls/0.0.0.0:7447", "tls/127.0.0.1:0");
    let config = zenoh::Config::from_json5(&text).expect("a file of the repository");
    let router = super::within("a router", zenoh::open(config).into_future()).await.expect("the router starts");
    let locators = router.info().locators().await;
    let port = locators.iter().find_map(|at| at.to_string().rsplit_once(':').map(|(_, port)| port.to_owned()));
    let at = format!("tls/localhost:{}", port.expect("the router listens"));
    (router, at)
}

/// The configuration of a server that hangs on the router, with a file in this folder.
pub fn behind(router: &str, folder: &Path, mut config: Config) -> Config {
    let file = folder.join("server.json5");
    std::fs::write(&file, zenoh_file("server.json5", &certificates("ours"))).expect("a file of ours");
    (config.zenoh.enabled, config.zenoh.file) = (true, file);
    let connect = vec![router.to_owned()];
    (config.zenoh.mode, config.zenoh.listen, config.zenoh.connect) = (ZenohMode::Client, Vec::new(), connect);
    config
}
