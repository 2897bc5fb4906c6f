//! Machines of a simulated fleet: each a network namespace of its own, with IP links between them that can be cut,
//! slowed and repaired, and the processes on them. It needs root.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};

use clearway_daemon::config::Config;

use crate::roles::{Process, ROUTER_ENVIRONMENT, server_binary};

/// The machines and the last byte of their addresses: two routers, three servers, two planners, a store.
const HOSTS: &str = "r1:1 r2:2 s1:11 s2:12 s3:13 p1:21 p2:22 w1:31";
/// The endpoints of the routers r1 and r2.
pub const ROUTERS: [&str; 2] = ["tcp/10.99.0.1:7447", "tcp/10.99.0.2:7447"];

/// The name of a machine's network namespace, with the number of this process, because several runs may share a host.
pub fn namespace(machine: &str) -> String {
    format!("{machine}-{}", std::process::id())
}

/// A program in the namespace of a machine, by a clock that is this much ahead, such as `+2s`; empty: by the true one.
///
/// # Panics
/// If the clock is to be set and libfaketime is not installed.
pub fn command(machine: &str, clock: &str, program: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new("ip");
    command.args(["netns", "exec", &namespace(machine)]);
    if !clock.is_empty() {
        let library = faketime().expect("libfaketime: apt-get install faketime");
        let settings = [format!("LD_PRELOAD={}", library.display()), format!("FAKETIME={clock}")];
        // A host's clock that is set does not move its steady clock.
        command.arg("env").args(settings).args(["DONT_FAKE_MONOTONIC=1", "FAKETIME_DONT_FAKE_MONOTONIC=1"]);
    }
    command.arg(program).args(arguments);
    command
}

/// The library of the Debian package that sets the clock of a program with several threads.
fn faketime() -> Option<PathBuf> {
    let architectures = std::fs::read_dir("/usr/lib").ok()?.flatten();
    let mut libraries = architectures.map(|folder| folder.path().join("faketime/libfaketimeMT.so.1"));
    libraries.find(|library| library.is_file())
}

/// The links between the machines.
struct Hub {
    process: Child,
    rules: Option<ChildStdin>,
}

impl Hub {
    fn start() -> Self {
        let script = crate::workspace().join("tests/python/hub.py");
        let mut command = Command::new("python3");
        let hosts = HOSTS.split(' ').filter_map(|host| host.split_once(':'));
        let hosts = hosts.map(|(machine, host)| format!("{}:{host}", namespace(machine)));
        command.arg(script).args(hosts).stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut process = command.spawn().expect("python3 is installed");
        let mut line = String::new();
        BufReader::new(process.stdout.take().expect("piped")).read_line(&mut line).expect("the hub lives");
        assert_eq!(line.trim(), "ready", "the hub needs root, /dev/net/tun and ip");
        Self { rules: process.stdin.take(), process }
    }

    fn rule(&mut self, rule: &str) {
        let rules = self.rules.as_mut().expect("it is taken at the end");
        writeln!(rules, "{rule}").and_then(|()| rules.flush()).expect("the hub lives");
    }
}

impl Drop for Hub {
    fn drop(&mut self) {
        drop(self.rules.take());
        let _ended = self.process.wait();
    }
}

/// The machines, their links and the processes on them by name.
pub struct Machines {
    /// This binary, which has the roles.
    own: PathBuf,
    server: PathBuf,
    /// Files of the run.
    pub folder: tempfile::TempDir,
    /// The processes, by name. They end before the links.
    pub processes: BTreeMap<String, Process>,
    hub: Hub,
}

impl Machines {
    /// Makes the machines; a server is the program `clearway` beside this one, unless another is named.
    ///
    /// # Panics
    /// Without root, `/dev/net/tun`, `ip` or `python3`.
    pub fn start(server: Option<&PathBuf>) -> Self {
        let own = std::env::current_exe().expect("the path of this binary");
        let folder = tempfile::tempdir().expect("a folder");
        Self { own, server: server_binary(server), folder, processes: BTreeMap::new(), hub: Hub::start() }
    }

    /// Adds a process, and ends the process of the same name.
    pub fn add(&mut self, name: &str, process: Process) -> &mut Process {
        self.stop(&[name]);
        self.processes.entry(name.into()).or_insert(process)
    }

    /// Starts a command instead of the process of the same name.
    fn start_command(&mut self, name: &str, command: &mut Command) -> &mut Process {
        self.stop(&[name]);
        self.add(name, Process::start(command))
    }

    /// Starts a role of this binary instead of the process of the same name.
    pub fn start_role(&mut self, name: &str, machine: &str, clock: &str, arguments: &[&str]) -> &mut Process {
        let mut command = command(machine, clock, &self.own, arguments);
        self.start_command(name, &mut command)
    }

    /// Ends these processes.
    pub fn stop(&mut self, names: &[&str]) {
        names.iter().for_each(|name| drop(self.processes.remove(*name)));
    }

    /// Starts router r1 (0) or r2 (1), which connects to the other.
    pub fn start_router(&mut self, index: usize) {
        let name = ["r1", "r2"][index];
        let mut command = command(name, "", &self.own, &["router", "tcp/0.0.0.0:7447", ROUTERS[1 - index]]);
        command.env(ROUTER_ENVIRONMENT.0, ROUTER_ENVIRONMENT.1);
        self.start_command(name, &mut command);
    }

    /// Starts the server of a machine, with these variables, as the process `MACHINE server`.
    ///
    /// # Panics
    /// If its configuration cannot be written.
    pub fn start_server(&mut self, machine: &str, clock: &str, config: &Config, variables: &[(&str, &str)]) {
        let file = self.folder.path().join(format!("{machine}.toml"));
        std::fs::write(&file, config.to_toml()).expect("a file of ours");
        let arguments = ["serve", "--config", file.to_str().expect("UTF-8")];
        let mut command = command(machine, clock, &self.server, &arguments);
        command.envs(variables.iter().copied());
        self.start_command(&format!("{machine} server"), &mut command);
    }

    /// Runs a command of `clearway` on a machine to its end.
    ///
    /// # Panics
    /// If it cannot be started.
    pub fn run(&self, machine: &str, arguments: &[&str], variables: &[(&str, &str)]) -> std::process::Output {
        let mut command = command(machine, "", &self.server, arguments);
        command.envs(variables.iter().copied()).output().expect("the binary starts")
    }

    /// Changes the link between two machines: its delay, and the share of packets that it loses.
    pub fn link(&mut self, first: &str, second: &str, delay_ms: u32, loss: f64) {
        let (first, second) = (namespace(first), namespace(second));
        self.hub.rule(&format!("{first} {second} {delay_ms} {loss}"));
    }

    /// Limits what a machine sends, and what it receives, to a rate; 0: without a limit.
    pub fn limit(&mut self, machine: &str, kbit_s: u32) {
        self.hub.rule(&format!("{} {kbit_s}", namespace(machine)));
    }
}

/// Bytes that a machine has sent, by the counter of its interface.
///
/// # Panics
/// If there is no such machine.
pub fn sent_bytes(machine: &str) -> u64 {
    let file = ["/sys/class/net/wire/statistics/tx_bytes"];
    let output = command(machine, "", Path::new("cat"), &file).output().expect("ip runs");
    String::from_utf8_lossy(&output.stdout).trim().parse().expect("a number of bytes")
}
