//! How far a fleet grows: measures what vehicles, planners and routers cost, and derives what a larger fleet needs.
//!
//!   cargo run --release -p clearway-tests --bin growth
//!
//! It starts real servers, the router of `deploy/` and planners as processes of this machine, without root; a simulated
//! sensor sends each vehicle's packets over UDP, and each planner has a zenoh session of its own and reads two layers
//! of one vehicle. The model ([`clearway_tests::growth`]) says what each group of processes takes as a sum of constants
//! times numbers of the [`Size`]. The constants that fit the sizes of [`FITTED`] best (least squares of the relative
//! errors, none below 0) predict the sizes of [`CHECKED`], which are then measured, and a fleet that this machine
//! cannot hold.
//!
//! Processor time is that of `/proc/PID/stat`, which other programs on the machine disturb little; they still delay
//! maps, so the table of the runs has the share of maps that came late, and of the processors that was idle.

use std::net::{SocketAddr, TcpListener, UdpSocket};
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use clap::Parser;
use clearway_daemon::config::Udp;
use clearway_tests::growth::{Model, PARTS, Size};
use clearway_tests::larger_fleet::Fleet;
use clearway_tests::roles::{Process, ROUTER_ENVIRONMENT, Role, last_line, name, server_binary, server_config};
use zenoh::Wait;

/// How far a fleet grows.
#[derive(Parser)]
struct Arguments {
    #[command(subcommand)]
    role: Option<Role>,
    /// Time for which each size is measured, in seconds.
    #[arg(long, default_value_t = 12)]
    seconds: u64,
    /// The server's binary; by default `clearway` beside this one.
    #[arg(long)]
    server: Option<PathBuf>,
}

/// Sizes from which the constants are derived. The first without maps: sessions and announcements alone.
const FITTED: [Size; 4] = [
    Size { vehicles: 4, planners: 120, routers: 2, is_moving: false },
    Size { vehicles: 2, planners: 2, routers: 2, is_moving: true },
    Size { vehicles: 2, planners: 120, routers: 2, is_moving: true },
    Size { vehicles: 12, planners: 12, routers: 2, is_moving: true },
];
/// Sizes that the model predicts before they are measured.
const CHECKED: [Size; 3] = [
    Size { vehicles: 4, planners: 40, routers: 2, is_moving: true },
    Size { vehicles: 8, planners: 80, routers: 2, is_moving: true },
    Size { vehicles: 16, planners: 160, routers: 3, is_moving: true },
];
/// The size at which the larger sensor is measured.
const LARGER: Size = Size { vehicles: 2, planners: 2, routers: 2, is_moving: true };
/// The sensor of the vehicles, and the larger one.
const SENSORS: [&str; 2] = ["vlp16", "hdl64e_s2"];
/// Time after which all streams have maps and memory is allocated.
const SETTLE: Duration = Duration::from_secs(4);
/// Longest wait for the planners to be connected, and for maps.
const PATIENCE: Duration = Duration::from_secs(60);

/// Least share of the due maps that come, and of the processors that is idle, on a machine that is not starved.
const CAME_MIN: f64 = 0.95;
const IDLE_MIN: f64 = 0.05;

/// What was measured at one size.
struct Measured {
    /// One value for each of [`PARTS`].
    values: Vec<f64>,
    /// Shares of the maps due that came, that the links lost, that came late; share of the processors that was idle.
    came: f64,
    lost: f64,
    late: f64,
    idle: f64,
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    match &arguments.role {
        Some(role) => role.run(),
        None => grow(&arguments),
    }
    ExitCode::SUCCESS
}

fn grow(arguments: &Arguments) {
    let run = |size: &Size, sensor| Run::start(size, sensor, arguments).measure(arguments.seconds);
    println!(
        "| vehicles, planners, routers | sensor | {} | maps that came | lost | late | idle |\n|---|---|{}---:|---:|---:|---:|",
        PARTS.each_ref().map(|part| part.name).join(" | "),
        "---:|".repeat(PARTS.len())
    );
    let measured = FITTED.each_ref().map(|size| {
        let measured = run(size, SENSORS[0]);
        print_run(size, if size.is_moving { SENSORS[0] } else { "none" }, &measured);
        measured
    });
    let larger = Run::start(&LARGER, SENSORS[1], arguments);
    let announcement_bytes = larger.announcement_bytes();
    let larger = larger.measure(arguments.seconds);
    print_run(&LARGER, SENSORS[1], &larger);
    let model = Model::fit(&FITTED, &measured.each_ref().map(|measured| measured.values.clone()));
    let checked = CHECKED.each_ref().map(|size| {
        let measured = run(size, SENSORS[0]);
        print_run(size, SENSORS[0], &measured);
        measured
    });
    let of_larger = model.of_sensor(&LARGER, &larger.values);
    println!("\n| constant | {} | {} |\n|---|---:|---:|", SENSORS[0], SENSORS[1]);
    for ((name, value), (_, of_larger)) in model.constants().iter().zip(of_larger.constants()) {
        let other = if of_larger == *value { "the same".into() } else { format!("{of_larger:.3}") };
        println!("| {name} | {value:.3} | {other} |");
    }
    println!("| an announcement of a vehicle, kB | {:.3} | the same |", 1e-3 * announcement_bytes);
    println!("\n| vehicles, planners, routers | | predicted | measured | error, % |\n|---|---|---:|---:|---:|");
    for (size, measured) in CHECKED.iter().zip(&checked) {
        for ((part, predicted), value) in PARTS.iter().zip(model.predict(size)).zip(&measured.values) {
            let error = 100.0 * (predicted / value - 1.0);
            println!("| {size} | {} | {predicted:.3} | {value:.3} | {error:+.0} |", part.name);
        }
    }
    if measured.iter().chain(&checked).any(|measured| measured.came < CAME_MIN || measured.idle < IDLE_MIN) {
        println!("\nThe processors had no time to spare at some size: its figures are those of a starved machine.");
    }
    let fleet = Fleet { announcement_bytes, ..Fleet::default() };
    println!("\n| {} vehicles, {} planners | |\n|---|---:|", fleet.vehicles, fleet.planners);
    fleet.rows(&of_larger).iter().for_each(|(name, value)| println!("| {name} | {value} |"));
    println!("\n| limit, ten planners a vehicle | reached with vehicles |\n|---|---:|");
    fleet.limits(&of_larger).iter().for_each(|(name, value)| println!("| {name} | {value} |"));
}

fn print_run(size: &Size, sensor: &str, measured: &Measured) {
    let values: Vec<_> = measured.values.iter().map(|value| format!("{value:.3}")).collect();
    let shares =
        [measured.came, measured.lost, measured.late, measured.idle].map(|share| format!("{:.1} %", 1e2 * share));
    println!("| {size} | {sensor} | {} | {} |", values.join(" | "), shares.join(" | "));
}

/// The processes of one size.
struct Run {
    size: Size,
    servers: Vec<Process>,
    routers: Vec<Process>,
    planners: Vec<(Process, Arc<Mutex<String>>)>,
    /// The endpoint of each router.
    endpoints: Vec<String>,
    _sensors: Option<Process>,
    /// Holds the servers' configurations.
    _folder: tempfile::TempDir,
}

/// What all planners have received, and what the processes have taken, until a moment.
struct Counts {
    /// Processor time of servers, routers and planners, in seconds.
    spent_s: [f64; 3],
    /// Milliseconds by the planners' clocks, planners, maps, bytes, lost maps, late maps; one list for each process.
    received: Vec<[f64; 6]>,
    /// Ticks of all processors: all, idle.
    ticks: [f64; 2],
}

impl Run {
    fn start(size: &Size, sensor: &str, arguments: &Arguments) -> Self {
        let own = std::env::current_exe().expect("the path of this binary");
        let role = |words: &[&str]| Process::start(Command::new(&own).args(words));
        let at: Vec<_> = (0..size.routers).map(|_| format!("tcp/{}", free_tcp())).collect();
        // Each two routers are joined by one of them.
        let others = |router: usize| at[..router].join(",");
        let routers = (0..size.routers).map(|router| {
            let mut command = Command::new(&own);
            command.env(ROUTER_ENVIRONMENT.0, ROUTER_ENVIRONMENT.1);
            Process::start(command.args(["router", &at[router], &others(router)]))
        });
        let routers = routers.collect();
        let folder = tempfile::tempdir().expect("a folder");
        let sockets: Vec<SocketAddr> = (0..size.vehicles).map(|_| free_udp()).collect();
        let servers = (0..size.servers()).map(|server| {
            let of: Vec<_> = (0..size.vehicles).filter(|vehicle| size.server_of(*vehicle) == server).collect();
            let named: Vec<_> = of.iter().map(|vehicle| name(*vehicle)).collect();
            let mut config = server_config(&named, &[at[server].clone()]);
            config.grpc.listen.set_port(0);
            for (vehicle, number) in config.vehicles.iter_mut().zip(of) {
                let telemetry = SocketAddr::new(sockets[number].ip(), 0);
                vehicle.udp = Some(Udp { data: sockets[number], telemetry, ..Udp::default() });
                vehicle.sensors[0].extrinsics.z_m = 1.9;
            }
            let file = folder.path().join(format!("{server}.toml"));
            std::fs::write(&file, config.to_toml()).expect("a file of ours");
            serve(&server_binary(arguments.server.as_ref()), &file)
        });
        let servers = servers.collect();
        let planners = (0..size.routers).map(|router| {
            let of = (0..size.planners).filter(|planner| size.router_of(*planner) == router);
            let vehicles: Vec<_> = of.map(|planner| name(size.vehicle_of(planner))).collect();
            let mut process = role(&["planners", &at[router], &vehicles.join(",")]);
            let last = last_line(&mut process);
            (process, last)
        });
        let planners = planners.collect();
        let mut run = Self { size: *size, servers, routers, planners, endpoints: at, _sensors: None, _folder: folder };
        run.wait("all planners", |received| received[1] as usize == run.size.planners);
        if size.is_moving {
            let to: Vec<_> = sockets.iter().map(ToString::to_string).collect();
            let seconds = (4 * SETTLE).as_secs() + arguments.seconds;
            run._sensors = Some(role(&["sensors", sensor, &seconds.to_string(), &to.join(",")]));
            run.wait("maps", |received| received[2] > 0.0);
        }
        std::thread::sleep(SETTLE);
        run
    }

    /// Waits until the sum of what the planners have received is enough.
    fn wait(&self, what: &str, is_enough: impl Fn([f64; 6]) -> bool) {
        let began = Instant::now();
        while !is_enough(sum(&self.counts().received)) {
            assert!(began.elapsed() < PATIENCE, "{}: {what} are not there after {PATIENCE:?}", self.size);
            std::thread::sleep(Duration::from_millis(100));
        }
    }

    fn groups(&self) -> [Vec<u32>; 3] {
        let ids = |processes: &[Process]| processes.iter().map(|process| process.0.id()).collect();
        let planners = self.planners.iter().map(|(process, _)| process.0.id()).collect();
        [ids(&self.servers), ids(&self.routers), planners]
    }

    fn counts(&self) -> Counts {
        let spent_s = self.groups().map(|ids| ids.into_iter().map(processor_s).sum());
        let received = self.planners.iter().map(|(_, line)| {
            let line = line.lock().expect("no panic").clone();
            let mut numbers = line.split(' ').map(|number| number.parse().unwrap_or(0.0));
            [(); 6].map(|()| numbers.next().unwrap_or(0.0))
        });
        Counts { spent_s, received: received.collect(), ticks: ticks() }
    }

    /// Mean size of an announcement, in bytes.
    fn announcement_bytes(&self) -> f64 {
        let mut config = zenoh::Config::default();
        let settings = [("mode", "'client'".to_owned()), ("connect/endpoints", format!("{:?}", [&self.endpoints[0]]))];
        settings.iter().for_each(|(key, value)| config.insert_json5(key, value).expect("a setting of zenoh"));
        let session = zenoh::open(config).wait().expect("the router answers");
        let announcements = session.declare_subscriber("clearway/@fleet/*/*").wait().expect("a subscriber");
        std::thread::sleep(SETTLE);
        let sizes: Vec<_> = announcements.drain().map(|sample| sample.payload().len() as f64).collect();
        sizes.iter().sum::<f64>() / sizes.len() as f64
    }

    fn measure(self, seconds: u64) -> Measured {
        let (began, before) = (Instant::now(), self.counts());
        std::thread::sleep(Duration::from_secs(seconds));
        let (elapsed_s, after) = (began.elapsed().as_secs_f64(), self.counts());
        let memory_mib = self.groups().map(|ids| ids.into_iter().map(resident_mib).sum::<f64>());
        let cores = [0, 1, 2].map(|group| (after.spent_s[group] - before.spent_s[group]) / elapsed_s);
        // By the planners' own clocks: their lines are up to 0.2 s old.
        let mut rates = [0.0; 6];
        for (after, before) in after.received.iter().zip(&before.received) {
            for index in 0..6 {
                rates[index] += 1e3 * (after[index] - before[index]) / (after[0] - before[0]);
            }
        }
        let [_, _, maps, bytes, lost, late] = rates;
        let due = self.size.maps_delivered();
        let [all, idle] = [0, 1].map(|index| after.ticks[index] - before.ticks[index]);
        let share = |part: f64, without: f64| if due > 0.0 { part / due } else { without };
        let values = cores.into_iter().chain(memory_mib).chain([1e-6 * bytes]).collect();
        Measured { values, came: share(maps, 1.0), lost: share(lost, 0.0), late: share(late, 0.0), idle: idle / all }
    }
}

/// Starts a server with the environment of `deploy/systemd/clearway.service`.
fn serve(server: &Path, config: &Path) -> Process {
    let mut command = Command::new(server);
    command.envs([("MALLOC_ARENA_MAX", "2"), ("MALLOC_TRIM_THRESHOLD_", "131072")]);
    Process::start(command.args(["serve", "--config"]).arg(config))
}

fn sum(received: &[[f64; 6]]) -> [f64; 6] {
    received.iter().fold([0.0; 6], |sum, of| std::array::from_fn(|index| sum[index] + of[index]))
}

/// An address on which nothing listens now.
fn free_tcp() -> SocketAddr {
    TcpListener::bind("127.0.0.1:0").and_then(|listener| listener.local_addr()).expect("a free port")
}

fn free_udp() -> SocketAddr {
    UdpSocket::bind("127.0.0.1:0").and_then(|socket| socket.local_addr()).expect("a free port")
}

/// Processor time of a process so far, in seconds.
fn processor_s(process: u32) -> f64 {
    let text = std::fs::read_to_string(format!("/proc/{process}/stat")).expect("the process lives");
    let fields = text.rsplit(')').next().expect("the name ends").split_whitespace();
    // User and system time, in hundredths of a second.
    fields.skip(11).take(2).map(|ticks| ticks.parse::<f64>().expect("a number") / 100.0).sum()
}

/// Resident memory of a process, in MiB.
fn resident_mib(process: u32) -> f64 {
    let text = std::fs::read_to_string(format!("/proc/{process}/status")).expect("the process lives");
    let line = text.lines().find_map(|line| line.strip_prefix("VmRSS:")).expect("VmRSS");
    line.split_whitespace().next().and_then(|kib| kib.parse::<f64>().ok()).expect("a number") / 1024.0
}

/// Ticks of all processors since the start of the machine: all, idle.
fn ticks() -> [f64; 2] {
    let text = std::fs::read_to_string("/proc/stat").expect("Linux");
    let ticks: Vec<f64> = text.lines().next().expect("cpu").split_whitespace().skip(1).flat_map(str::parse).collect();
    [ticks.iter().sum(), ticks[3]]
}
