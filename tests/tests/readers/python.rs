//! The Python client's own tests, against a running server: installed from the tree into an environment of its own.

use std::path::{Path, PathBuf};
use std::process::Command;

use clearway_daemon::run::Running;

use crate::fixture::certificates::{self, behind, certificates, router};
use crate::fixture::venv::{self, run};
use crate::fixture::{self, config, feed, readings, start, until, within};

const REPOSITORY: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/..");

fn python() -> PathBuf {
    venv::client(Path::new(REPOSITORY))
}

/// A server with some maps that requires client certificates, behind a router that requires them too.
async fn secured_server(folder: &Path, router: &str) -> Running {
    let mut config = behind(router, folder, certificates::secured(true));
    // A recording makes the server make all layers, with or without readers.
    config.recorder.file = folder.join("secured.mcap");
    let running = fixture::certificates::start(config).await;
    feed(&running, readings(3)).await;
    running
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
#[cfg_attr(not(clearway_openssl), ignore = "needs openssl: apt-get install openssl")]
#[cfg_attr(not(clearway_python), ignore = "needs Python: apt-get install python3 python3-venv")]
async fn the_tests_of_the_python_client_pass_against_running_servers() {
    let interpreter = tokio::task::spawn_blocking(python).await.expect("the Python client installs");

    let folder = tempfile::tempdir().unwrap();
    let recording = folder.path().join("recorded.mcap");
    let mut recorded = config();
    recorded.recorder.file.clone_from(&recording);
    let running = start(recorded).await;
    feed(&running, readings(4)).await;
    within("shutdown", running.shutdown()).await.unwrap();

    let mut live = config();
    live.zenoh.enabled = true;
    let running = start(live).await;
    let car = fixture::Driving::to(&running);
    let status = running.vehicles.0[0].status.clone();
    until("a map", || status.snapshot().maps > 0).await;

    let (router, routed) = router().await;
    let secured = secured_server(folder.path(), &routed).await;
    let zenoh = running.zenoh.iter().find(|endpoint| endpoint.starts_with("tcp/127.0.0.1")).expect("zenoh listens");
    let grpc = |running: &Running| running.grpc.expect("gRPC is served").to_string();
    let places = [
        ("CLEARWAY_GRPC", grpc(&running)),
        ("CLEARWAY_ZENOH", zenoh.clone()),
        ("CLEARWAY_SECURED_GRPC", grpc(&secured)),
        ("CLEARWAY_SECURED_ZENOH", routed),
        ("CLEARWAY_CERTIFICATES", certificates("ours").display().to_string()),
        ("CLEARWAY_RECORDING", recording.display().to_string()),
        ("CLEARWAY", clearway_tests::binaries().join("clearway").display().to_string()),
    ];
    let tests = tokio::task::spawn_blocking(move || {
        let tests = Path::new(REPOSITORY).join("client/python/tests");
        let mut pytest = Command::new(interpreter);
        pytest.args(["-B", "-m", "pytest", "-q", "-p", "no:cacheprovider"]).arg(tests);
        let said = run(pytest.envs(places), "pytest names what failed");
        assert!(!said.contains("skipped"), "{said}");
        println!("{said}");
    });
    let outcome = tests.await;
    car.halt();
    within("shutdown", running.shutdown()).await.unwrap();
    within("shutdown", secured.shutdown()).await.unwrap();
    router.close().await.unwrap();
    outcome.expect("the Python client's tests pass");
}
