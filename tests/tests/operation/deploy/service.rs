//! The server under a service manager: what it reports, and sockets that outlive it.

use std::fs;
use std::net::UdpSocket;
use std::os::fd::AsRawFd;
use std::os::unix::net::UnixDatagram;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use clearway_tests::{binaries, run, workspace};

use super::said;

/// Longest wait: ten times what a step of these tests needs.
const PATIENCE: Duration = Duration::from_secs(60);

/// A server that stops when this is dropped.
struct Stopped(Child);

impl Drop for Stopped {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

const ANY: [&str; 4] = [
    "page.listen=127.0.0.1:0",
    "zenoh.enabled=false",
    "vehicle.udp.telemetry=127.0.0.1:0",
    "vehicle.udp.data=127.0.0.1:0",
];

/// Writes the configuration of a server with any ports, with these overrides at the end; returns its arguments.
fn arguments(overrides: &[String]) -> Vec<String> {
    let config = workspace().join("deploy/clearway.toml").display().to_string();
    let set = ANY.iter().map(ToString::to_string).chain(overrides.iter().cloned());
    let set = set.flat_map(|set| ["--set".to_owned(), set]);
    ["serve".to_owned(), "--config".to_owned(), config].into_iter().chain(set).collect()
}

/// The manager's socket, and the next of its messages.
struct Manager(UnixDatagram);

impl Manager {
    fn listen(at: &Path) -> Self {
        let socket = UnixDatagram::bind(at).expect("a socket of ours");
        socket.set_read_timeout(Some(PATIENCE)).expect("a time-out");
        Self(socket)
    }

    fn next(&self) -> String {
        let mut message = [0; 4096];
        let length = self.0.recv(&mut message).expect("a message in time");
        String::from_utf8_lossy(&message[..length]).into_owned()
    }
}

#[test]
fn the_service_manager_learns_that_the_server_is_ready_lives_and_stops() {
    let folder = tempfile::tempdir().expect("a folder");
    let manager = Manager::listen(&folder.path().join("notify"));
    let server = Command::new(binaries().join("clearway"))
        .args(arguments(&["grpc.listen=127.0.0.1:0".into()]))
        .env("NOTIFY_SOCKET", folder.path().join("notify"))
        .env("WATCHDOG_USEC", "200000")
        .stderr(Stdio::null())
        .spawn();
    let mut server = Stopped(server.expect("clearway starts"));
    assert!(manager.next().starts_with("READY=1\n"), "ready before anything else");
    for _ in 0..5 {
        assert_eq!(manager.next().trim(), "WATCHDOG=1");
    }
    let stopped = Command::new("kill").args(["-TERM", &server.0.id().to_string()]).status().expect("kill");
    assert!(stopped.success());
    let last = std::iter::repeat_with(|| manager.next()).find(|message| !message.starts_with("WATCHDOG=1"));
    assert!(last.is_some_and(|message| message.starts_with("STOPPING=1\n")));
    assert!(server.0.wait().expect("it ends").success());
}

#[test]
fn datagrams_that_arrive_while_the_server_restarts_wait_in_the_sockets_of_the_service_manager() {
    let folder = tempfile::tempdir().expect("a folder");
    let held = UdpSocket::bind("127.0.0.1:0").expect("a port");
    let grpc = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
    let (udp_at, grpc_at) = (held.local_addr().expect("bound"), grpc.local_addr().expect("bound"));
    let sender = UdpSocket::bind("127.0.0.1:0").expect("a port");
    let overrides = [format!("vehicle.udp.data={udp_at}"), format!("grpc.listen={grpc_at}")];
    for start in 0..2_u64 {
        // No server listens now.
        for _ in 0..3 {
            sender.send_to(b"not a packet", udp_at).expect("sent");
        }
        let fds = [held.as_raw_fd(), grpc.as_raw_fd()];
        socket2::SockRef::from(&held).set_cloexec(false).expect("inherited");
        socket2::SockRef::from(&grpc).set_cloexec(false).expect("inherited");
        // As systemd passes them: descriptors 3 and 4.
        // By way of numbers that no descriptor of this process has.
        let [udp, tcp] = fds;
        let script = format!("exec 900<&{udp} 901<&{tcp}; exec 3<&900 4<&901 900<&- 901<&-; exec \"$@\"");
        let server = Command::new("bash")
            .args(["-c", &script, "bash"])
            .arg(binaries().join("clearway"))
            .args(arguments(&overrides))
            .env("LISTEN_FDS", "2")
            .stderr(fs::File::create(folder.path().join("log")).expect("a file of ours"))
            .spawn();
        let mut server = Stopped(server.expect("bash starts"));
        let grpc_at = grpc_at.to_string();
        let counted = loop {
            let listed = run(folder.path(), "clearway", &["vehicles", "--server", &grpc_at, "--json"]);
            let ended = server.0.try_wait().expect("the server's state");
            let log = || fs::read_to_string(folder.path().join("log")).unwrap_or_default();
            assert!(ended.is_none(), "clearway serve ended: {ended:?}\n{}", log());
            let vehicles: serde_json::Value = serde_json::from_slice(&listed.stdout).unwrap_or_default();
            if vehicles[0]["ledger"]["received"].as_u64().or(vehicles[0]["received"].as_u64()) == Some(3) {
                break said(&listed);
            }
        };
        assert!(counted.contains("length"), "start {start}: refused for their length: {counted}");
    }
}
