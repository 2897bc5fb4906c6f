//! A closed loop: the simulated vehicle scans the town and sends datagrams and ego poses through real sockets to a
//! server. The maps come back over gRPC (and over zenoh), an example program plans on them, and the vehicle makes the
//! planned move. Each revolution makes one map and one move. The loop waits for each map and never for the clock, so
//! that every run drives the same way.
//!
//! Three programs drive: A* on the layer `speed`, the follower of the safe points on the layer `safe_path`, and arcs
//! over the layer `freespace`, by its answers alone.

#[allow(dead_code, reason = "the example has a goal straight ahead")]
#[path = "../../../client/examples/free_arcs/arcs.rs"]
mod arcs;
#[allow(dead_code, reason = "the example shows pictures")]
#[path = "../../../client/examples/planner/astar.rs"]
mod astar;
#[path = "../../../client/examples/planner/motion.rs"]
mod motion;
#[allow(dead_code, reason = "the example has a goal straight ahead")]
#[path = "../../../client/examples/follower/safe_points.rs"]
mod safe_points;

use std::net::UdpSocket;
use std::ops::Range;

use arcs::ArcPlanner;
use astar::Planner;
use clearway_client::ingest::Ingester;
use clearway_client::stream::MapStream;
use clearway_client::{Client, MapView, Observation, Subscription, ZenohClient};
use clearway_daemon::run::{Running, Server, Setup};
use clearway_sim::contact::Hull;
use clearway_sim::course::{Course, Drive};
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes::{Scene, town};
use clearway_sim::vehicle::{Datagram, Kind, SimulatedVehicle};
use safe_points::Follower;

use crate::fixture::{config, until, within};

/// Length, width and height of the vehicle, in metres, as of the simulated cars.
const SIZE_M: [f64; 3] = [4.4, 1.8, 1.5];
/// Distance of the goal along the route, in metres.
const GOAL_M: f64 = 10.0;
/// Least distance that a drive must keep from all things, in metres. Ours: the planner keeps 0.7 and 0.9 m in its two
/// drives, the follower 0.7 and 0.5 m, measured in steps of 0.1 m.
const NEAREST_M_MIN: f64 = 0.35;
/// Most datagrams in flight: as many as the smallest kernel buffer holds.
const UNDER_WAY: u64 = 60;
/// Period of the ego poses and of the checks against the world, in ns.
const POSE_PERIOD_NS: i64 = 20_000_000;

/// A program that drives by the maps of one layer.
trait Driver: Default {
    const LAYER: &'static str;
    /// True if the server remembers ground ([`clearway_mapping::memory`]).
    const MEMORY: bool;
    fn update(&mut self, map: &MapView);
    /// The next move towards a goal.
    fn next_move(&self, goal: [f64; 2]) -> Move;
}

/// Curvature in 1/m, positive to the left, and speed in m/s.
#[derive(Clone, Copy, Debug, Default)]
struct Move {
    curvature_per_m: f64,
    mps: f64,
}

impl Driver for Planner {
    const LAYER: &'static str = "speed";
    const MEMORY: bool = false;

    fn update(&mut self, map: &MapView) {
        Planner::update(self, map).unwrap();
    }

    fn next_move(&self, goal: [f64; 2]) -> Move {
        let motion::Move { curvature_per_m, mps, .. } = Planner::next_move(self, goal);
        Move { curvature_per_m, mps }
    }
}

impl Driver for Follower {
    const LAYER: &'static str = "safe_path";
    // The sensor does not see the ground beside a parked car that the vehicle passes.
    const MEMORY: bool = true;

    fn update(&mut self, map: &MapView) {
        Follower::update(self, map).unwrap();
    }

    fn next_move(&self, goal: [f64; 2]) -> Move {
        let motion::Move { curvature_per_m, mps, .. } = Follower::next_move(self, goal);
        Move { curvature_per_m, mps }
    }
}

impl Driver for ArcPlanner {
    const LAYER: &'static str = "freespace";
    const MEMORY: bool = true;

    fn update(&mut self, map: &MapView) {
        ArcPlanner::update(self, map);
    }

    fn next_move(&self, goal: [f64; 2]) -> Move {
        let motion::Move { curvature_per_m, mps, .. } = ArcPlanner::next_move(self, goal).unwrap();
        Move { curvature_per_m, mps }
    }
}

/// One drive: its start and its length along the route in metres, and the seed of the sensor's noise.
#[derive(Clone, Copy, Debug)]
struct Plan {
    start_m: f64,
    length_m: f64,
    seed: u64,
}

/// A lap from the simulation's own start.
fn lap() -> Plan {
    Plan { start_m: 0.0, length_m: town().drive.course.length(), seed: 1 }
}

/// A drive that starts behind the second corner, where the street runs in the opposite direction.
const OPPOSITE: Plan = Plan { start_m: 250.0, length_m: 200.0, seed: 7 };

/// This drive, and the other one too with `CLEARWAY_CAMPAIGN=1`.
fn plans(own: Plan, other: Plan) -> impl Iterator<Item = Plan> {
    let is_campaign = std::env::var_os("CLEARWAY_CAMPAIGN").is_some();
    [own].into_iter().chain(is_campaign.then_some(other))
}

/// The vehicle, its connections to the server, and the maps that it receives.
struct Loop {
    vehicle: SimulatedVehicle,
    socket: UdpSocket,
    running: Running,
    ingester: Ingester,
    /// The same maps over each transport; at least one.
    maps: Vec<MapStream>,
    plan: Plan,
    sent: u64,
}

/// Result of a drive.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Driven {
    revolutions: u32,
    length_m: f64,
    seconds: f64,
    /// Least distance from the hull to a thing in the whole drive, in steps of 0.1 m.
    nearest_m: f64,
}

async fn server(memory: bool) -> Running {
    let mut config = config();
    config.zenoh.enabled = true;
    let vehicle = &mut config.vehicles[0];
    vehicle.maps.memory.enabled = memory;
    // The stamps are older than the arrivals, and the simulated world does not contain the vehicle itself.
    vehicle.sensors[0].gps_late_days_max = 36_525.0;
    vehicle.sensors[0].range_m_min = 0.5;
    vehicle.body = None;
    Server::start(Setup { config, ..Setup::default() }).await.expect("the server starts")
}

impl Loop {
    fn new(running: Running, ingester: Ingester, maps: Vec<MapStream>, plan: Plan) -> Self {
        let scene = town();
        let (x, y, heading) = scene.drive.course.at(scene.drive.start + plan.start_m, scene.drive.left);
        let here = Course::from(x, y, heading).straight(1.0);
        let mut world = (*scene.world).clone();
        // The car that drives in the same direction stays ahead: it would not brake for the vehicle.
        let drives = world.objects.iter_mut().filter_map(|object| object.drive.as_mut());
        drives.filter(|drive| drive.speed > 0.0).for_each(|drive| drive.start += plan.start_m);
        let scene = Scene { drive: Drive::steady(here.into(), 0.0, 0.0, 0.0), world: world.into(), ..scene };
        let vehicle = SimulatedVehicle::new(scene, ScannerConfig { seed: plan.seed, ..ScannerConfig::default() });
        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        Self { vehicle, socket, running, ingester, maps, plan, sent: 0 }
    }

    /// Drives until the sensor's head has passed the vehicle's back, where the server ends a revolution, then waits for
    /// the map of that revolution. Returns the range of its stamps, and the map over each transport.
    async fn revolution(&mut self, next: Move) -> (Range<i64>, Vec<MapView>) {
        let begin_ns = self.vehicle.steer(next.curvature_per_m, next.mps);
        let datagrams = cast(&mut self.vehicle);
        let end_ns = datagrams.last().expect("a revolution").stamp_ns;
        for stamp_ns in (begin_ns..end_ns).step_by(POSE_PERIOD_NS as usize).skip(1).chain([end_ns]) {
            let pose = pose(&self.vehicle, stamp_ns, next.mps);
            within("capacity", self.ingester.send(pose)).await.unwrap();
        }
        assert_eq!(within("outcomes", self.ingester.settled()).await.unwrap(), []);
        let (data, telemetry) = self.running.inputs[0].udp.unwrap();
        let status = self.running.vehicles.0[0].status.clone();
        for datagram in datagrams {
            let to = if datagram.kind == Kind::Data { data } else { telemetry };
            self.socket.send_to(&datagram.payload, to).unwrap();
            self.sent += 1;
            until("capacity", || status.snapshot().ledger.received + UNDER_WAY > self.sent).await;
        }
        let mut maps = Vec::new();
        for stream in &mut self.maps {
            maps.push(map_since(stream, begin_ns).await);
        }
        (begin_ns..end_ns, maps)
    }

    /// Drives as planned. Panics if the vehicle touches a thing, or if it does not progress.
    async fn drive<D: Driver>(mut self) -> Driven {
        let mut route = town().drive;
        route.start += self.plan.start_m;
        let mut driver = D::default();
        let mut next = Move::default();
        let mut driven = Driven { revolutions: 0, length_m: 0.0, seconds: 0.0, nearest_m: 1.0 };
        println!("{}: {:?}", D::LAYER, self.plan);
        // The first revolution is not whole.
        cast(&mut self.vehicle);
        while driven.length_m < self.plan.length_m {
            let (stamps, maps) = self.revolution(next).await;
            assert!(maps.iter().all(|map| map.bytes() == maps[0].bytes()), "{driven:?}");
            self.check_contact(stamps.clone(), &mut driven);
            driven.revolutions += 1;
            driven.seconds = self.seconds(stamps.end);
            driven.length_m = along(&route, driven.length_m, self.vehicle.scene().drive.at(driven.seconds));
            // The bytes are equal, so the driver uses the maps of the transports in turn.
            driver.update(&maps[driven.revolutions as usize % maps.len()]);
            let (x, y, _) = route.course.at(route.start + driven.length_m + GOAL_M, route.left);
            next = driver.next_move([x, y]);
            if driven.revolutions.is_multiple_of(100) {
                println!("{driven:?}: {next:?}");
            }
            assert!(
                driven.seconds < 30.0 + driven.length_m / 2.0,
                "the vehicle does not progress: {driven:?}, {next:?}"
            );
        }
        println!("{driven:?}");
        let ledger = self.running.vehicles.0[0].status.snapshot().ledger;
        assert_eq!((ledger.lost, ledger.kernel_drops, ledger.refused.len()), (0, 0, 0));
        within("shutdown", self.running.shutdown()).await.unwrap();
        driven
    }

    /// Checks the places of the vehicle against the geometry of the world.
    fn check_contact(&self, stamps: Range<i64>, driven: &mut Driven) {
        let scene = self.vehicle.scene();
        for stamp_ns in stamps.step_by(POSE_PERIOD_NS as usize) {
            let time = self.seconds(stamp_ns);
            let (x, y, heading) = scene.drive.at(time);
            let grown = |by: f64| Hull { x, y, heading, size: [SIZE_M[0] + 2.0 * by, SIZE_M[1] + 2.0 * by, SIZE_M[2]] };
            let touched = |by: f64| scene.world.touched(&grown(by), time);
            assert_eq!(touched(0.0), None, "at ({x:.1}, {y:.1}) after {time:.1} s, {driven:?}");
            while driven.nearest_m > 0.05 && touched(driven.nearest_m).is_some() {
                driven.nearest_m -= 0.1;
            }
        }
    }

    /// Time in the scene, in seconds.
    fn seconds(&self, stamp_ns: i64) -> f64 {
        (stamp_ns - self.vehicle.start_ns()) as f64 * 1e-9
    }
}

/// Length of the route up to its point nearest to a place: at most 4 m more than `before_m`.
fn along(route: &Drive, before_m: f64, (x, y, _): (f64, f64, f64)) -> f64 {
    let off = |length_m: &f64| {
        let (route_x, route_y, _) = route.course.at(route.start + length_m, route.left);
        (route_x - x).hypot(route_y - y)
    };
    let lengths = (0..40).map(|step| before_m + 0.1 * f64::from(step));
    lengths.min_by(|a, b| off(a).total_cmp(&off(b))).expect("lengths")
}

/// The datagrams until the sensor's head has passed the vehicle's back.
fn cast(vehicle: &mut SimulatedVehicle) -> Vec<Datagram> {
    let (mut datagrams, mut before) = (Vec::new(), u16::MAX);
    loop {
        let datagram = vehicle.next().expect("datagrams do not end");
        // The azimuth of the last block; 181 degrees, so that the server has seen the end of the revolution too.
        let azimuth = match datagram.kind {
            Kind::Data => u16::from_le_bytes([datagram.payload[1102], datagram.payload[1103]]),
            Kind::Telemetry => before,
        };
        datagrams.push(datagram);
        if before < 18_100 && azimuth >= 18_100 {
            return datagrams;
        }
        before = azimuth;
    }
}

fn pose(vehicle: &SimulatedVehicle, stamp_ns: i64, speed_mps: f64) -> Observation {
    let pose = vehicle.pose_at(stamp_ns);
    let (at, turned) = (pose.translation.vector, pose.rotation.coords);
    Observation::pose(stamp_ns, at.into(), [turned.x, turned.y, turned.z, turned.w], speed_mps)
}

/// The next map of a revolution that ended after `begin_ns`. Earlier maps may be sent again to a late reader.
async fn map_since(maps: &mut MapStream, begin_ns: i64) -> MapView {
    loop {
        let map = within("a map", maps.next()).await.unwrap().map;
        if map.header().capture_end_ns > begin_ns {
            return map;
        }
    }
}

/// Drives by the maps of gRPC, and also of zenoh if that is demanded.
async fn drive<D: Driver>(plan: Plan, over_zenoh: bool) -> Driven {
    let running = server(D::MEMORY).await;
    let client = Client::connect(&running.grpc.unwrap().to_string()).await.unwrap();
    let ingester = within("a stream", client.ingest("car")).await.unwrap();
    let selection = Subscription { layers: vec![D::LAYER.into()], ..Default::default() };
    let mut maps = vec![within("maps over gRPC", client.subscribe(selection)).await.unwrap()];
    let endpoint = running.zenoh.iter().find(|e| e.starts_with("tcp/127.0.0.1")).expect("zenoh listens");
    let client = within("zenoh", ZenohClient::connect(endpoint)).await.unwrap();
    if over_zenoh {
        maps.push(within("maps over zenoh", client.subscribe("car", D::LAYER)).await.unwrap());
    }
    Loop::new(running, ingester, maps, plan).drive::<D>().await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_planner_on_maps_of_grpc_and_zenoh_drives_a_lap_without_contact() {
    for plan in plans(lap(), OPPOSITE) {
        let driven = drive::<Planner>(plan, true).await;
        assert!(driven.nearest_m > NEAREST_M_MIN, "{driven:?}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn arcs_over_freespace_alone_drive_without_contact() {
    for plan in plans(OPPOSITE, lap()) {
        let driven = drive::<ArcPlanner>(plan, false).await;
        assert!(driven.nearest_m > NEAREST_M_MIN, "{driven:?}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_follower_of_the_safe_points_drives_without_contact() {
    for plan in plans(OPPOSITE, lap()) {
        let driven = drive::<Follower>(plan, false).await;
        assert!(driven.nearest_m > NEAREST_M_MIN, "{driven:?}");
    }
}
