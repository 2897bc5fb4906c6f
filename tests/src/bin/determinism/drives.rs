//! The drives whose maps are compared: recordings in the repository, live runs, simulated and recorded captures.

use std::net::{Ipv4Addr, SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use clearway_daemon::config::{Config, Udp};
use clearway_tests::digests::Digests;
use clearway_tests::workspace;

use crate::programs::{Program, Surroundings};

/// Longest wait for a server to listen.
const PATIENCE: Duration = Duration::from_secs(60);
/// Seconds of a live run.
const LIVE_S: &str = "3";

/// Files of which maps are made.
pub struct Drive {
    /// Its name in the table.
    pub name: String,
    /// The arguments of `clearway replay`.
    pub arguments: Vec<String>,
    /// The maps that it was recorded with; `None` of a capture.
    pub recorded: Option<Digests>,
}

impl Drive {
    fn capture(name: &str, file: &Path) -> Self {
        Self { name: name.to_owned(), arguments: vec![text(file)], recorded: None }
    }

    fn recording(name: &str, file: &Path) -> Self {
        let recorded = Digests::of(file).unwrap_or_else(|error| panic!("{name}: {error}"));
        Self { name: name.to_owned(), arguments: vec![text(file)], recorded: Some(recorded) }
    }
}

/// Recordings that come with the repository.
pub fn golden() -> Vec<Drive> {
    ["tests/golden/drive.mcap", "client/golden/town.mcap"]
        .map(|file| Drive::recording(&format!("`{file}`"), &workspace().join(file)))
        .into()
}

/// Recorded drives in the folder of the tests' data; those that are not there are left out.
pub fn recorded(data: &Path) -> Vec<Drive> {
    let velodyne64 = "pcap/opendlv/proxy-velodyne64";
    let drives = [
        ("HDL-64E S1", format!("{velodyne64}/cut_for_developers/atwall_first174packets.pcap")),
        ("HDL-32E", "pcap/rust-lidar-utils/hdl32_example.pcap".to_owned()),
        ("VLP-16", "pcap/opendlv/proxy-velodyne16/sampleShort.pcap".to_owned()),
        ("VLP-16, dual return", "mcap/nebula_vlp16_zstd.mcap".to_owned()),
        ("VLS-128", "mcap/nebula_vls128_none.mcap".to_owned()),
        ("scans of SemanticKITTI", "kitti/patchwork-plusplus".to_owned()),
        ("scans of Udacity", "kitti/udacity_data_2".to_owned()),
        ("scan of nuScenes", "nuscenes/mmdet3d".to_owned()),
    ];
    let drives = drives.into_iter().map(|(name, path)| (name, data.join(path))).filter(|(_, path)| path.exists());
    let mut drives: Vec<_> = drives.map(|(name, path)| Drive::capture(&format!("recorded {name}"), &path)).collect();
    let calibration = data.join(velodyne64).join("db.xml");
    if let Some(drive) = drives.iter_mut().find(|drive| drive.name.ends_with("S1")) {
        drive.arguments.extend(["--calibration".to_owned(), text(&calibration)]);
    }
    // The mount is not estimated from its ground, and without a mount no map is made.
    if let Some(drive) = drives.iter_mut().find(|drive| drive.name.ends_with("dual return")) {
        drive.arguments.extend(["--extrinsics".to_owned(), "0,0,1.9,0,0,0".to_owned()]);
    }
    drives
}

/// Simulates a scene with a program.
pub fn simulate(program: &Program, surroundings: Surroundings, scene: &str, sensor: &str, file: &Path) {
    let _ = std::fs::remove_file(file);
    let seconds = if scene == "town" { "2" } else { "1" };
    program.run(surroundings, &["simulate", scene, "--sensor", sensor, "--seconds", seconds, "--out", &text(file)]);
}

/// The drive of a simulated capture.
pub fn simulated(scene: &str, sensor: &str, file: &Path) -> Drive {
    Drive::capture(&format!("simulated {scene}, {sensor}"), file)
}

/// A live run of the demo: a car with eight sensors over UDP and gRPC, with poses and roads, in traffic.
pub fn live_demo(program: &Program, folder: &Path) -> Drive {
    let file = folder.join(format!("demo-{}.mcap", program.name));
    let record = text(&file);
    program.run(Surroundings::PLAIN, &["demo", "--sensors", "many", "--seconds", LIVE_S, "--record", &record]);
    Drive::recording(&format!("live, eight sensors, recorded by {}", program.name), &file)
}

/// A live run of four vehicles on one server, each on a thread of its own, that receive the same capture over UDP.
pub fn live_fleet(program: &Program, capture: &Path, folder: &Path) -> Drive {
    let file = folder.join(format!("fleet-{}.mcap", program.name));
    let (config, configuration) = (fleet(&file), folder.join(format!("fleet-{}.toml", program.name)));
    std::fs::write(&configuration, config.to_toml()).expect("the folder can be written to");
    let mut command = program.command(Surroundings::PLAIN, &["serve", "--config", &text(&configuration)]);
    let mut server = command.stderr(Stdio::null()).spawn().expect("taskset, of util-linux");
    await_listener(&mut server, config.grpc.listen);
    let sources = config.vehicles.iter().map(|vehicle| {
        let to = vehicle.udp.as_ref().expect("it has a socket").data;
        let arguments = ["send", &text(capture), "--to", &format!("udp://{to}")];
        program.command(Surroundings::PLAIN, &arguments).stdout(Stdio::null()).spawn().expect("taskset")
    });
    for mut source in sources.collect::<Vec<_>>() {
        assert!(source.wait().expect("it ends").success(), "{}: clearway send", program.name);
    }
    // taskset has become the server, so that this is its process.
    let stopped = Command::new("kill").args(["-INT", &server.id().to_string()]).status().expect("kill");
    assert!(stopped.success() && server.wait().expect("it ends").success(), "{}: the server's end", program.name);
    Drive::recording(&format!("live, four vehicles, recorded by {}", program.name), &file)
}

/// The configuration of a server of four vehicles, on ports that were free.
fn fleet(file: &Path) -> Config {
    let any = SocketAddr::from((Ipv4Addr::LOCALHOST, 0));
    let free = || UdpSocket::bind(any).and_then(|socket| socket.local_addr()).expect("a free port");
    let mut config = Config::of_one_vehicle("car-0", "top");
    config.vehicles[0].sensors[0].extrinsics.z_m = 1.9;
    config.vehicles = vec![config.vehicles.remove(0); 4];
    for (number, vehicle) in config.vehicles.iter_mut().enumerate() {
        vehicle.name = format!("car-{number}");
        vehicle.udp = Some(Udp { data: free(), telemetry: free(), ..Udp::default() });
    }
    config.grpc.listen = TcpListener::bind(any).and_then(|listener| listener.local_addr()).expect("a free port");
    (config.page.enabled, config.zenoh.enabled) = (false, false);
    config.recorder.file = file.to_owned();
    config
}

/// Waits until a server listens.
fn await_listener(server: &mut Child, address: SocketAddr) {
    let began = Instant::now();
    while TcpStream::connect(address).is_err() {
        assert!(server.try_wait().expect("a child").is_none(), "the server has ended");
        assert!(began.elapsed() < PATIENCE, "the server does not listen on {address}");
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// The folder of the recorded drives.
pub fn data() -> PathBuf {
    std::env::var_os("CLEARWAY_DATA").map_or_else(|| workspace().join("../shared/data"), PathBuf::from)
}

fn text(path: &Path) -> String {
    path.to_str().expect("a path in UTF-8").to_owned()
}
