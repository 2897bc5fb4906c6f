//! A closed loop: the simulated vehicle scans the town, its datagrams and ego poses go through real sockets into the real
//! server, the map comes back, the example planner plans on it, and the vehicle moves. One turn, one map, one move: the
//! loop waits for each and never for the clock, so that every run drives the same way.

#[path = "../../client/examples/planner/astar.rs"]
mod astar;
mod house;

use std::net::UdpSocket;

use astar::{Move, Planner};
use clearway_client::ingest::Ingester;
use clearway_client::stream::MapStream;
use clearway_client::{Client, MapView, Observation, Subscription, ZenohClient};
use clearway_server::server::{Running, Server, Setup};
use clearway_sim::contact::Hull;
use clearway_sim::course::{Course, Drive};
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes::{Scene, town};
use clearway_sim::vehicle::{Datagram, Kind, SimulatedVehicle};
use house::{config, until, within};

/// A saloon; the simulated cars have the same.
const SIZE_M: [f64; 3] = [4.4, 1.8, 1.5];
/// The goal lies so far along the route.
const GOAL_M: f64 = 12.0;
/// Datagrams on their way: as many as the smallest kernel buffer holds.
const UNDER_WAY: u64 = 60;
/// From one ego pose to the next, and from one look at the truth to the next.
const POSE_PERIOD_NS: i64 = 20_000_000;

/// The vehicle, its way to the server, and its eyes.
struct Loop {
    vehicle: SimulatedVehicle,
    socket: UdpSocket,
    running: Running,
    ingester: Ingester,
    maps: MapStream,
    sent: u64,
}

/// What came of a drive.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Driven {
    turns: u32,
    length_m: f64,
    seconds: f64,
    /// From the hull to the nearest thing, the least of the whole drive, in steps of 0.1 m.
    nearest_m: f64,
}

async fn server(zenoh: bool) -> Running {
    let mut config = config();
    config.zenoh.enabled = zenoh;
    let vehicle = &mut config.vehicles[0];
    // The drive is older than its arrival, and nothing of the vehicle itself is in its world.
    vehicle.sensors[0].gps_late_days_max = 36_525.0;
    vehicle.sensors[0].range_m_min = 0.5;
    vehicle.body = None;
    Server::start(Setup { config, ..Setup::default() }).await.expect("the server starts")
}

impl Loop {
    fn new(running: Running, ingester: Ingester, maps: MapStream) -> Self {
        let scene = town();
        let (x, y, heading) = scene.drive.at(0.0);
        let here = Course::from(x, y, heading).straight(1.0);
        let scene = Scene { drive: Drive::steady(here.into(), 0.0, 0.0, 0.0), ..scene };
        let vehicle = SimulatedVehicle::new(scene, ScannerConfig::default());
        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        Self { vehicle, socket, running, ingester, maps, sent: 0 }
    }

    /// Drives so until the sensor's head has turned past the vehicle's back, where the server cuts turns; then waits for
    /// the map of that turn. Gives when that was, and the map.
    async fn turn(&mut self, next: Move) -> (std::ops::Range<i64>, MapView) {
        let begin_ns = self.vehicle.steer(next.curvature_per_m, next.mps);
        let datagrams = cast(&mut self.vehicle);
        let end_ns = datagrams.last().expect("a turn").stamp_ns;
        for stamp_ns in (begin_ns..end_ns).step_by(POSE_PERIOD_NS as usize).skip(1).chain([end_ns]) {
            let pose = pose(&self.vehicle, stamp_ns, next.mps);
            within("room", self.ingester.send(pose)).await.unwrap();
        }
        assert_eq!(within("verdicts", self.ingester.settled()).await.unwrap(), []);
        let (data, telemetry) = self.running.doors[0].udp.unwrap();
        let status = self.running.vehicles.0[0].status.clone();
        for datagram in datagrams {
            let to = if datagram.kind == Kind::Data { data } else { telemetry };
            self.socket.send_to(&datagram.payload, to).unwrap();
            self.sent += 1;
            until("room", || status.snapshot().ledger.received + UNDER_WAY > self.sent).await;
        }
        // Maps of before may be told again for a late reader.
        loop {
            let map = within("a map", self.maps.next()).await.unwrap().map;
            if map.header().capture_end_ns > begin_ns {
                return (begin_ns..end_ns, map);
            }
        }
    }

    /// Follows the route for `length_m`; panics where anything is touched, or where it stands still for too long.
    async fn drive(mut self, length_m: f64) -> Driven {
        let (route, world) = (town().drive, self.vehicle.scene().world.clone());
        let mut planner = Planner::default();
        let mut next = Move { curvature_per_m: 0.0, mps: 0.0, way_m: 0.0 };
        let mut driven = Driven { turns: 0, length_m: 0.0, seconds: 0.0, nearest_m: 1.0 };
        // The first turn is not whole.
        cast(&mut self.vehicle);
        while driven.length_m < length_m {
            let (stamps, map) = self.turn(next).await;
            for stamp_ns in stamps.clone().step_by(POSE_PERIOD_NS as usize) {
                let time = (stamp_ns - self.vehicle.start_ns()) as f64 * 1e-9;
                let (x, y, heading) = self.vehicle.scene().drive.at(time);
                let grown =
                    |by: f64| Hull { x, y, heading, size: [SIZE_M[0] + 2.0 * by, SIZE_M[1] + 2.0 * by, SIZE_M[2]] };
                assert_eq!(world.touched(&grown(0.0), time), None, "at ({x:.1}, {y:.1}) after {time:.1} s, {driven:?}");
                while driven.nearest_m > 0.05 && world.touched(&grown(driven.nearest_m), time).is_some() {
                    driven.nearest_m -= 0.1;
                }
            }
            let (x, y, _) = self.vehicle.scene().drive.at((stamps.end - self.vehicle.start_ns()) as f64 * 1e-9);
            let along = driven.length_m;
            // How far it got: the place of the route ahead that is nearest.
            let off = |ahead: f64| {
                let (rx, ry, _) = route.course.at(route.start + ahead, route.left);
                (rx - x).hypot(ry - y)
            };
            let places = (0..40).map(|step| along + 0.1 * f64::from(step));
            driven.length_m = places.min_by(|a, b| off(*a).total_cmp(&off(*b))).expect("places");
            driven.seconds = (stamps.end - self.vehicle.start_ns()) as f64 * 1e-9;
            driven.turns += 1;
            let (gx, gy, _) = route.course.at(route.start + driven.length_m + GOAL_M, route.left);
            planner.take(&map).unwrap();
            next = planner.next_move([gx, gy]);
            if std::env::var_os("CLEARWAY_DRIVE_SHOW").is_some() {
                println!("{driven:?} at ({x:.1}, {y:.1}) off {:.1}: {next:?}", off(driven.length_m));
            }
            assert!(driven.seconds < 30.0 + driven.length_m / 2.0, "it does not get on: {driven:?}, {next:?}");
        }
        let ledger = self.running.vehicles.0[0].status.snapshot().ledger;
        assert_eq!((ledger.lost, ledger.kernel_drops, ledger.refused.len()), (0, 0, 0));
        within("shutdown", self.running.shutdown()).await.unwrap();
        driven
    }
}

/// What the sensor sends until its head has turned past the vehicle's back.
fn cast(vehicle: &mut SimulatedVehicle) -> Vec<Datagram> {
    let (mut datagrams, mut before) = (Vec::new(), u16::MAX);
    loop {
        let datagram = vehicle.next().expect("datagrams do not end");
        let is_data = datagram.kind == Kind::Data;
        // Of the last block; 1 degree later the server has seen it too.
        let azimuth = u16::from_le_bytes([
            datagram.payload[1102 % datagram.payload.len()],
            datagram.payload[1103 % datagram.payload.len()],
        ]);
        datagrams.push(datagram);
        if is_data {
            if before < 18_100 && azimuth >= 18_100 {
                return datagrams;
            }
            before = azimuth;
        }
    }
}

fn pose(vehicle: &SimulatedVehicle, stamp_ns: i64, speed_mps: f64) -> Observation {
    let pose = vehicle.pose_at(stamp_ns);
    let (at, turned) = (pose.translation.vector, pose.rotation.coords);
    Observation::pose(stamp_ns, at.into(), [turned.x, turned.y, turned.z, turned.w], speed_mps)
}

/// Once round the town.
const LAP_M: f64 = 480.0;

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_planner_over_grpc_drives_round_the_town_and_touches_nothing() {
    let running = server(false).await;
    let client = Client::connect(&running.grpc.unwrap().to_string()).await.unwrap();
    let ingester = within("a stream", client.ingest("car")).await.unwrap();
    let selection = Subscription { layers: vec!["speed".into()], ..Default::default() };
    let maps = within("maps", client.subscribe(selection)).await.unwrap();
    println!("over gRPC: {:?}", Loop::new(running, ingester, maps).drive(LAP_M).await);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_planner_over_zenoh_drives_round_the_town_and_touches_nothing() {
    let running = server(true).await;
    let endpoint = running.zenoh.iter().find(|e| e.starts_with("tcp/127.0.0.1")).expect("zenoh listens");
    let client = within("zenoh", ZenohClient::connect(endpoint)).await.unwrap();
    let ingester = within("a stream", client.ingest("car")).await.unwrap();
    let maps = within("maps", client.subscribe("car", "speed")).await.unwrap();
    println!("over zenoh: {:?}", Loop::new(running, ingester, maps).drive(LAP_M).await);
}
