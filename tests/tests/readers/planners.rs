//! Planners in C++ and Python beside one in Rust, over gRPC: the same maps and answers, also through a proxy that cuts
//! their connections, and after a server that is killed. The C++ client is installed, and found as a CMake package.

use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::OnceLock;
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use clearway_client::test::{Replay, town};
use clearway_client::{Client, MapStream, MapView, Outline, Subscription, v1};
use clearway_tests::{binaries, workspace};
use serde_json::{Value, json};
use tokio::io::copy_bidirectional;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;

use super::cpp::{is_same, text};
use crate::fixture::venv::{self, run};
use crate::fixture::within;

const LAYER: &str = "freespace";
const CAR: Outline = Outline { front_m: 3.0, rear_m: 2.0, width_m: 2.0 };
/// Longest wait for an answer, so that a test that hangs ends.
const PATIENCE: Duration = Duration::from_secs(120);

/// A project that uses the installed package.
const PROJECT: &str = "cmake_minimum_required(VERSION 3.14)
project(planner LANGUAGES CXX)
find_package(clearway 0.1 REQUIRED COMPONENTS grpc)
foreach(program follow answers)
    add_executable(${program} ${program}.cpp)
    target_compile_options(${program} PRIVATE -O0 -Wall -Wextra -Werror)
    target_compile_definitions(${program} PRIVATE CLEARWAY_STREAM)
    target_link_libraries(${program} PRIVATE clearway::grpc)
endforeach()
";

/// A program of a project outside the tree that uses the installed C++ client. Compiled again only if a file changes.
fn of_cpp(program: &str) -> PathBuf {
    static BUILT: OnceLock<PathBuf> = OnceLock::new();
    let built = BUILT.get_or_init(|| {
        let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("cpp-client");
        let [prefix, project, build] = ["prefix", "project", "build"].map(|name| folder.join(name));
        let client = workspace().join("client/cpp");
        // CMake refuses what another clone with the same target folder has built.
        let cache = fs::read_to_string(folder.join("client/CMakeCache.txt")).unwrap_or_default();
        if !cache.contains(&format!("={}\n", client.display())) {
            let _ = fs::remove_dir_all(&folder);
        }
        fs::create_dir_all(&project).expect("a folder of ours");
        fs::write(project.join("CMakeLists.txt"), PROJECT).expect("a file of ours");
        for source in ["examples/follow.cpp", "tests/answers.cpp"] {
            let source = workspace().join("client/cpp").join(source);
            run(Command::new("cp").arg("-p").arg(source).arg(&project), "cp");
        }
        let cmake = || Command::new("cmake");
        let option = |name: &str, path: &Path| format!("-D{name}={}", path.display());
        run(cmake().arg("-S").arg(client).arg("-B").arg(folder.join("client")), "CMake says why");
        run(cmake().arg("--install").arg(folder.join("client")).arg("--prefix").arg(&prefix), "CMake says why");
        let prefix = option("CMAKE_PREFIX_PATH", &prefix);
        run(cmake().arg("-S").arg(project).arg("-B").arg(&build).arg(prefix), "CMake says why");
        run(cmake().arg("--build").arg(&build), "the compiler says why");
        build
    });
    built.join(program)
}

/// A planner in another language: a program that answers one request a line.
struct Planner {
    program: Child,
    requests: ChildStdin,
    answers: Receiver<String>,
}

impl Planner {
    fn start(mut program: Command) -> Self {
        let mut program = program.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().expect("the program runs");
        let requests = program.stdin.take().expect("piped");
        let said = BufReader::new(program.stdout.take().expect("piped"));
        let (sender, answers) = channel();
        std::thread::spawn(move || said.lines().map_while(Result::ok).try_for_each(|line| sender.send(line)));
        Self { program, requests, answers }
    }

    fn ask(&mut self, request: &str) -> Value {
        writeln!(self.requests, "{request}").expect("the program reads");
        let answer = tokio::task::block_in_place(|| self.answers.recv_timeout(PATIENCE));
        serde_json::from_str(&answer.unwrap_or_else(|error| panic!("{request}: {error}"))).expect("JSON")
    }

    /// Asks until an answer is as wanted.
    fn ask_until(&mut self, request: &str, is_wanted: impl Fn(&Value) -> bool) -> Value {
        loop {
            let answer = self.ask(request);
            if is_wanted(&answer) {
                return answer;
            }
        }
    }

    /// Waits until the stream says that the server at this address is away.
    fn learns_that_it_is_away(&mut self, address: &str) {
        let address = text(address);
        let names_it = |reason: &Value| reason.as_str().is_some_and(|reason| reason.contains(&address));
        self.ask_until("reasons", |reasons| reasons.as_array().expect("a list").iter().any(names_it));
    }
}

impl Drop for Planner {
    fn drop(&mut self) {
        // It may have ended already.
        let _ = self.program.kill();
        let _ = self.program.wait();
    }
}

/// A proxy of TCP connections to a server. A change of the server cuts them; to an empty address there is no way.
async fn proxy(server: watch::Receiver<String>) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let at = listener.local_addr().expect("bound").to_string();
    tokio::spawn(async move {
        while let Ok((mut reader, _)) = listener.accept().await {
            let mut server = server.clone();
            tokio::spawn(async move {
                let address = server.borrow_and_update().clone();
                let Ok(mut upstream) = TcpStream::connect(address).await else { return };
                tokio::select! {
                    _ = copy_bidirectional(&mut reader, &mut upstream) => {}
                    _ = server.changed() => {}
                }
            });
        }
    });
    at
}

/// A server that makes a map of the town at each step.
struct Stepped {
    replay: Replay,
    control: Client,
}

impl Stepped {
    async fn start() -> Self {
        binaries();
        let replay = Replay::with(town(), &["--paused"]).expect("the replay starts");
        let control = replay.client().await.expect("the server answers");
        Self { replay, control }
    }

    async fn make(&self, maps: u32) {
        let step = v1::ReplayControl { step: Some(maps), ..Default::default() };
        within("a step", self.control.replay_control(step)).await.expect("a step");
    }
}

/// The run and the number of a map.
fn id(map: &MapView) -> (u64, u64) {
    (map.header().boot_id, map.sequence())
}

/// Asserts that both planners receive the newest map, count every map since `last`, and have the same answers.
async fn agree(rust: &mut MapStream, other: &mut Planner, last: Option<(u64, u64)>, newest: u64) -> (u64, u64) {
    let map = loop {
        let map = within("a map", rust.next()).await.expect("the stream goes on").map;
        if map.sequence() == newest && Some(id(&map)) != last {
            break map;
        }
    };
    let (run, sequence) = id(&map);
    let mut counted = 0;
    loop {
        let found = other.ask("next");
        let number = |index: usize| found[index].as_u64().unwrap_or_else(|| panic!("{found}"));
        if last == Some((number(0), number(1))) {
            continue; // It is stale.
        }
        counted += number(2) + 1;
        if (number(0), number(1)) == (run, sequence) {
            break;
        }
    }
    if let Some((_, before)) = last.filter(|(before, _)| *before == run) {
        assert_eq!(counted, sequence - before, "each map is received or skipped");
    }
    let place = |met: Option<(f64, clearway_client::Blocker)>| {
        met.map(|(along_m, by)| json!([along_m, [by.x_m, by.y_m, by.class, by.why]]))
    };
    for (curvature_per_m, length_m) in [(0.0, 20.0), (0.05, 12.0), (-0.1, -6.0)] {
        let path = clearway_client::Path::Arc { curvature_per_m, length_m };
        let met = map.along(LAYER, &path, &CAR).expect("an answer");
        let expected = json!([met.length_m, place(met.low), place(met.blocked)]);
        let Outline { front_m, rear_m, width_m } = CAR;
        let found = other.ask(&format!("arc {LAYER} {front_m} {rear_m} {width_m} {curvature_per_m} {length_m}"));
        assert!(is_same(&found, &expected), "{found}, not {expected}");
    }
    let nearest = map.nearest_obstacle(LAYER, [1.0, 2.0], None).expect("an answer");
    let expected = json!(nearest.map(|found| json!([found.x_m, found.y_m, found.distance_m, found.class])));
    let found = other.ask(&format!("nearest_obstacle {LAYER} 1 2"));
    assert!(is_same(&found, &expected), "{found}, not {expected}");
    (run, sequence)
}

/// Both planners follow a server through a proxy that cuts them off, and then another server, because the first was
/// killed. The other planner ends if it is not to reconnect, and is refused as Rust is.
async fn survive(mut other: Planner) {
    let mut first = Stepped::start().await;
    let (way, server) = watch::channel(first.replay.grpc.clone());
    let at = proxy(server).await;
    other.ask(&format!("watch {at} once 1 no_layer"));
    assert_eq!(other.ask("next"), json!({ "error": "INVALID_ARGUMENT" }));

    let wanted = Subscription { layers: vec![LAYER.into()], deltas: true, reconnects: true, ..Default::default() };
    let client = within("the server", Client::connect(&at)).await.expect("it answers");
    let mut rust = within("a stream", client.subscribe(wanted)).await.expect("a stream");
    other.ask(&format!("watch {at} reconnects 1 {LAYER}"));
    first.make(1).await;
    let mut last = agree(&mut rust, &mut other, None, 0).await;
    for (maps, newest) in [(1, 1), (3, 4)] {
        first.make(maps).await;
        last = agree(&mut rust, &mut other, Some(last), newest).await;
    }

    way.send_replace(String::new());
    other.learns_that_it_is_away(&at);
    first.make(1).await;
    way.send_replace(first.replay.grpc.clone());
    last = agree(&mut rust, &mut other, Some(last), 5).await;

    first.replay.kill();
    other.learns_that_it_is_away(&at);
    let mut second = Stepped::start().await;
    way.send_replace(second.replay.grpc.clone());
    second.make(1).await;
    let run = agree(&mut rust, &mut other, Some(last), 0).await.0;
    assert_ne!(run, last.0, "a map of the second server");

    other.ask(&format!("watch {at} once 0 {LAYER}"));
    assert_eq!(other.ask("next")[0], run);
    second.replay.kill();
    let ended = other.ask_until("next", Value::is_object);
    assert_eq!(ended, json!({ "error": "UNAVAILABLE" }));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
#[cfg_attr(
    not(clearway_cpp_grpc),
    ignore = "needs C++ and gRPC: apt-get install g++ cmake libgrpc++-dev libprotobuf-dev protobuf-compiler-grpc"
)]
async fn a_planner_in_cpp_survives_a_proxy_that_cuts_and_a_server_that_is_killed() {
    let answers = tokio::task::spawn_blocking(|| of_cpp("answers")).await.expect("it is compiled");
    survive(Planner::start(Command::new(answers))).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
#[cfg_attr(not(clearway_python), ignore = "needs Python: apt-get install python3 python3-venv")]
async fn a_planner_in_python_survives_a_proxy_that_cuts_and_a_server_that_is_killed() {
    let python = tokio::task::spawn_blocking(|| venv::client(&workspace())).await.expect("the client is installed");
    let mut program = Command::new(python);
    program.arg("-B").arg(workspace().join("tests/python/stream.py"));
    survive(Planner::start(program)).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
#[cfg_attr(
    not(clearway_cpp_grpc),
    ignore = "needs C++ and gRPC: apt-get install g++ cmake libgrpc++-dev libprotobuf-dev protobuf-compiler-grpc"
)]
async fn a_planner_in_cpp_waits_no_longer_than_it_asks_and_is_told_of_a_wrong_address_and_vehicle() {
    let answers = tokio::task::spawn_blocking(|| of_cpp("answers")).await.expect("it is compiled");
    let mut planner = Planner::start(Command::new(answers));
    assert_eq!(planner.ask(&format!("watch localhost reconnects 0 {LAYER}")), json!({ "error": "address" }));
    let server = Stepped::start().await;
    let at = format!("http://{}", server.replay.grpc);
    planner.ask(&format!("watch {at} reconnects 0 @beta {LAYER}"));
    assert_eq!(planner.ask("next"), json!({ "error": "NOT_FOUND" }));
    planner.ask(&format!("watch {at} reconnects 0 {LAYER}"));
    assert_eq!(planner.ask("next 1"), Value::Null);
    server.make(1).await;
    planner.ask_until("next 1", Value::is_array);
    assert_eq!(planner.ask("next 1")[1], 0, "the newest map again");
}

#[test]
#[cfg_attr(
    not(clearway_cpp_grpc),
    ignore = "needs C++ and gRPC: apt-get install g++ cmake libgrpc++-dev libprotobuf-dev protobuf-compiler-grpc"
)]
fn the_cpp_example_follows_a_drive_to_its_end() {
    let follow = of_cpp("follow");
    binaries();
    let drive = Replay::with(town(), &["--lockstep"]).expect("the replay starts");
    let output = Command::new(follow).arg(&drive.grpc).output().expect("it runs");
    let said = String::from_utf8_lossy(&output.stdout);
    let complained = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && complained.starts_with("replay_ended"), "{said}{complained}");
    for sequence in 0..10 {
        let line = said.lines().find(|line| line.starts_with(&format!("map {sequence}, ")));
        let (_, found) = line.and_then(|line| line.split_once(" ms old: ")).unwrap_or_else(|| panic!("{said}"));
        let is_answer = ["STALE: ", "blocked after ", "low things ahead for ", "free for "];
        assert!(is_answer.iter().any(|answer| found.starts_with(answer)), "{said}");
    }
}
