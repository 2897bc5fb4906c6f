//! A closed loop: the simulated vehicle scans the town, its datagrams and ego poses go through real sockets into the
//! real server, the map comes back over gRPC and over zenoh, the example planner plans on each, and the vehicle makes
//! the move they agree on. One turn, one map, one move: the loop waits for each and never for the clock, so that every
//! run drives the same way.

#[allow(dead_code, reason = "the example shows pictures")]
#[path = "../../client/examples/planner/astar.rs"]
mod astar;
mod fixture;

use std::net::UdpSocket;
use std::ops::Range;

use astar::{Move, Planner};
use clearway::server::{Running, Server, Setup};
use clearway_client::ingest::Ingester;
use clearway_client::stream::MapStream;
use clearway_client::{Client, MapView, Observation, Subscription, ZenohClient};
use clearway_sim::contact::Hull;
use clearway_sim::course::{Course, Drive};
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes::{Scene, town};
use clearway_sim::vehicle::{Datagram, Kind, SimulatedVehicle};
use fixture::{config, until, within};

/// A saloon; the simulated cars have the same.
const SIZE_M: [f64; 3] = [4.4, 1.8, 1.5];
/// The goal lies so far along the route.
const GOAL_M: f64 = 10.0;
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
    /// Over gRPC, over zenoh.
    maps: [MapStream; 2],
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

async fn server() -> Running {
    let mut config = config();
    config.zenoh.enabled = true;
    let vehicle = &mut config.vehicles[0];
    // The drive is older than its arrival, and nothing of the vehicle itself is in its world.
    vehicle.sensors[0].gps_late_days_max = 36_525.0;
    vehicle.sensors[0].range_m_min = 0.5;
    vehicle.body = None;
    Server::start(Setup { config, ..Setup::default() }).await.expect("the server starts")
}

impl Loop {
    fn new(running: Running, ingester: Ingester, maps: [MapStream; 2]) -> Self {
        let scene = town();
        let (x, y, heading) = scene.drive.at(0.0);
        let here = Course::from(x, y, heading).straight(1.0);
        let scene = Scene { drive: Drive::steady(here.into(), 0.0, 0.0, 0.0), ..scene };
        let vehicle = SimulatedVehicle::new(scene, ScannerConfig::default());
        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        Self { vehicle, socket, running, ingester, maps, sent: 0 }
    }

    /// Drives so until the sensor's head has turned past the vehicle's back, where the server cuts turns; then waits
    /// for the map of that turn. Gives when that was, and the map.
    async fn turn(&mut self, next: Move) -> (Range<i64>, [MapView; 2]) {
        let begin_ns = self.vehicle.steer(next.curvature_per_m, next.mps);
        let datagrams = cast(&mut self.vehicle);
        let end_ns = datagrams.last().expect("a turn").stamp_ns;
        for stamp_ns in (begin_ns..end_ns).step_by(POSE_PERIOD_NS as usize).skip(1).chain([end_ns]) {
            let pose = pose(&self.vehicle, stamp_ns, next.mps);
            within("room", self.ingester.send(pose)).await.unwrap();
        }
        assert_eq!(within("verdicts", self.ingester.settled()).await.unwrap(), []);
        let (data, telemetry) = self.running.inputs[0].udp.unwrap();
        let status = self.running.vehicles.0[0].status.clone();
        for datagram in datagrams {
            let to = if datagram.kind == Kind::Data { data } else { telemetry };
            self.socket.send_to(&datagram.payload, to).unwrap();
            self.sent += 1;
            until("room", || status.snapshot().ledger.received + UNDER_WAY > self.sent).await;
        }
        let [grpc, zenoh] = &mut self.maps;
        (begin_ns..end_ns, [map_since(grpc, begin_ns).await, map_since(zenoh, begin_ns).await])
    }

    /// Follows the route for `length_m`; panics where anything is touched, or where it stands still for too long.
    async fn drive(mut self, length_m: f64) -> Driven {
        let route = town().drive;
        let mut planner = Planner::default();
        let mut next = Move { curvature_per_m: 0.0, mps: 0.0, way_m: 0.0 };
        let mut driven = Driven { turns: 0, length_m: 0.0, seconds: 0.0, nearest_m: 1.0 };
        // The first turn is not whole.
        cast(&mut self.vehicle);
        while driven.length_m < length_m {
            let (stamps, [over_grpc, over_zenoh]) = self.turn(next).await;
            assert_eq!(over_grpc.bytes(), over_zenoh.bytes(), "{driven:?}");
            self.look(stamps.clone(), &mut driven);
            driven.turns += 1;
            driven.seconds = self.seconds(stamps.end);
            driven.length_m = along(&route, driven.length_m, self.vehicle.scene().drive.at(driven.seconds));
            // The same bytes: each carrier brings every other map.
            planner.take(if driven.turns.is_multiple_of(2) { &over_grpc } else { &over_zenoh }).unwrap();
            let (x, y, _) = route.course.at(route.start + driven.length_m + GOAL_M, route.left);
            next = planner.next_move([x, y]);
            if driven.turns.is_multiple_of(100) {
                println!("{driven:?}: {next:?}");
            }
            assert!(driven.seconds < 30.0 + driven.length_m / 2.0, "it does not get on: {driven:?}, {next:?}");
        }
        let ledger = self.running.vehicles.0[0].status.snapshot().ledger;
        assert_eq!((ledger.lost, ledger.kernel_drops, ledger.refused.len()), (0, 0, 0));
        within("shutdown", self.running.shutdown()).await.unwrap();
        driven
    }

    /// Looks where the vehicle was, by the world's own geometry.
    fn look(&self, stamps: Range<i64>, driven: &mut Driven) {
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

    /// Of the scene.
    fn seconds(&self, stamp_ns: i64) -> f64 {
        (stamp_ns - self.vehicle.start_ns()) as f64 * 1e-9
    }
}

/// The length of the route up to where it is nearest to a place, at most 4 m more than before.
fn along(route: &Drive, before_m: f64, (x, y, _): (f64, f64, f64)) -> f64 {
    let off = |length_m: &f64| {
        let (route_x, route_y, _) = route.course.at(route.start + length_m, route.left);
        (route_x - x).hypot(route_y - y)
    };
    let lengths = (0..40).map(|step| before_m + 0.1 * f64::from(step));
    lengths.min_by(|a, b| off(a).total_cmp(&off(b))).expect("lengths")
}

/// What the sensor sends until its head has turned past the vehicle's back.
fn cast(vehicle: &mut SimulatedVehicle) -> Vec<Datagram> {
    let (mut datagrams, mut before) = (Vec::new(), u16::MAX);
    loop {
        let datagram = vehicle.next().expect("datagrams do not end");
        // Of the last block; 1 degree later the server has seen it too.
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

/// The next map of a turn that ended after `begin_ns`: those of before may be told again for a late reader.
async fn map_since(maps: &mut MapStream, begin_ns: i64) -> MapView {
    loop {
        let map = within("a map", maps.next()).await.unwrap().map;
        if map.header().capture_end_ns > begin_ns {
            return map;
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_planner_on_maps_of_grpc_and_zenoh_drives_a_lap_without_contact() {
    let running = server().await;
    let client = Client::connect(&running.grpc.unwrap().to_string()).await.unwrap();
    let ingester = within("a stream", client.ingest("car")).await.unwrap();
    let selection = Subscription { layers: vec!["speed".into()], ..Default::default() };
    let over_grpc = within("maps over gRPC", client.subscribe(selection)).await.unwrap();
    let endpoint = running.zenoh.iter().find(|e| e.starts_with("tcp/127.0.0.1")).expect("zenoh listens");
    let client = within("zenoh", ZenohClient::connect(endpoint)).await.unwrap();
    let over_zenoh = within("maps over zenoh", client.subscribe("car", "speed")).await.unwrap();
    let lap_m = town().drive.course.length();
    let driven = Loop::new(running, ingester, [over_grpc, over_zenoh]).drive(lap_m).await;
    println!("{driven:?}");
}
