//! A car with two rotating and six non-rotating LIDARs, through real sockets and a real stream: the server makes one
//! map of all of them, and its occupancy matches the simulated world.

use std::collections::BTreeMap;
use std::iter::Peekable;
use std::net::UdpSocket;

use clearway_client::{Client, MapView};
use clearway_daemon::config::{Sender, Udp};
use clearway_mapping::config::BodyConfig;
use clearway_proto::v1;
use clearway_sim::traffic::{Footprints, street};
use clearway_sim::vehicle::{Datagram, Kind, SimulatedVehicle};
use clearway_tools::demo::car::address;
use clearway_tools::demo::rig::{Rig, TimedObservation};
use nalgebra::{Isometry3, Point3, Quaternion, Translation3, Unit};

use crate::fixture::{config, start, until, within};

const START_NS: i64 = 1_767_270_000_000_000_000;
/// Stamp of the last reading that is sent, in ns.
const END_NS: i64 = START_NS + 800_000_000;
/// Most datagrams in flight: as many as the smallest kernel buffer holds.
const UNDER_WAY: u64 = 60;

/// The next reading of all sensors, in the order of the stamps.
enum Next {
    Datagram(usize, Datagram),
    Observation(Box<TimedObservation>),
}

fn next(
    sensors: &mut [Peekable<SimulatedVehicle>],
    observations: &mut Peekable<impl Iterator<Item = TimedObservation>>,
) -> Next {
    let sent = |(index, sensor): (usize, &mut Peekable<SimulatedVehicle>)| Some((sensor.peek()?.stamp_ns, index));
    let (stamp_ns, index) = sensors.iter_mut().enumerate().filter_map(sent).min().expect("they do not end");
    match observations.next_if(|timed| timed.stamp_ns <= stamp_ns) {
        Some(timed) => Next::Observation(Box::new(timed)),
        None => Next::Datagram(index, sensors[index].next().expect("just seen")),
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn eight_sensors_over_udp_and_grpc_make_one_map_that_matches_the_world() {
    let rig = Rig::many(street(8.0), START_NS);
    let mut config = config();
    let vehicle = &mut config.vehicles[0];
    vehicle.sensors = rig.sensors();
    // The drive is older than its arrival.
    vehicle.sensors.iter_mut().for_each(|sensor| sensor.gps_late_days_max = 36_525.0);
    vehicle.maps.speed.enabled = true;
    // Arrival times depend on the test machine.
    vehicle.fusion.deadline_ms = 10_000;
    vehicle.body = None::<BodyConfig>;
    let any = "127.0.0.1:0".parse().unwrap();
    let sender = |(index, (name, _)): (usize, &(String, _))| (name.clone(), Sender::Address(address(index).into()));
    let from: BTreeMap<_, _> = rig.scanners.iter().enumerate().map(sender).collect();
    vehicle.udp = Some(Udp { data: any, telemetry: any, from, ..Udp::default() });
    let running = start(config).await;
    let status = running.vehicles.0[0].status.clone();
    let (data, telemetry) = running.inputs[0].udp.unwrap();
    let client = Client::connect(&running.grpc.unwrap().to_string()).await.unwrap();
    let mut ingester = within("a stream", client.ingest("car")).await.unwrap();

    let sockets: Vec<UdpSocket> = (0..2).map(|index| UdpSocket::bind((address(index), 0)).unwrap()).collect();
    let mut sensors: Vec<_> = (0..2).map(|index| rig.vehicle(index).peekable()).collect();
    let mut observations = rig.observations().peekable();
    let (mut sent, mut scans) = (0, 0);
    loop {
        match next(&mut sensors, &mut observations) {
            Next::Datagram(_, datagram) if datagram.stamp_ns > END_NS => break,
            Next::Datagram(index, datagram) => {
                let to = if datagram.kind == Kind::Data { data } else { telemetry };
                sockets[index].send_to(&datagram.payload, to).unwrap();
                sent += 1;
                until("capacity", || status.snapshot().ledger.received + UNDER_WAY > sent + scans).await;
            }
            Next::Observation(timed) => {
                let observation: v1::Observation = timed.observation.clone().into();
                scans += u64::from(matches!(observation.body, Some(v1::observation::Body::Scan(_))));
                until("all datagrams", || status.snapshot().ledger.received + 1 + UNDER_WAY / 2 > sent + scans).await;
                within("capacity", ingester.send(timed.observation)).await.unwrap();
            }
        }
    }
    assert_eq!(within("outcomes", ingester.settled()).await.unwrap(), []);
    until("all datagrams", || status.snapshot().ledger.received == sent + scans).await;
    let snapshot = status.snapshot();
    assert_eq!((snapshot.refused(), snapshot.ledger.lost, snapshot.ledger.kernel_drops), (0, 0, 0));
    assert!(snapshot.sensors.iter().all(|sensor| sensor.ledger.decoded > 30), "{:?}", snapshot.sensors);

    let newest = running.vehicles.0[0].newest.borrow().clone().expect("a map");
    let map = MapView::decode(newest.select(&[])).unwrap();
    let header = map.header();
    let states: Vec<_> = header.sensors.iter().map(|sensor| (&*sensor.name, &*sensor.state)).collect();
    assert!(states.len() == 8 && states.iter().all(|(_, state)| *state == "ok"), "{states:?}");
    assert_eq!((&*header.source_sensor, &*header.compensation), ("top", "poses"));
    assert_matches_world(&map, &rig);
    within("shutdown", running.shutdown()).await.unwrap();
}

/// Asserts that no clear cell lies inside a thing that was there for one revolution, and that each occupied cell had a
/// thing in the last 0.3 s.
fn assert_matches_world(map: &MapView, rig: &Rig) {
    let header = map.header();
    let v1::Pose { x, y, z, qx, qy, qz, qw } = header.map_from_ego.expect("the car sends poses");
    let turned = Unit::new_normalize(Quaternion::new(qw, qx, qy, qz));
    let map_from_ego = Isometry3::from_parts(Translation3::new(x, y, z), turned);
    let time = (header.capture_end_ns - rig.start_ns) as f64 * 1e-9;
    let world = &rig.scene.world;
    // The rays of a rotating sensor are up to one revolution old, so a thing that has arrived since is not in the map.
    let (now, a_revolution_ago) = (Footprints::at(world, time), Footprints::at(world, time - 0.1));
    let lately: Vec<Footprints> = (0..=6).map(|step| Footprints::at(world, time - 0.05 * f64::from(step))).collect();
    let layer = map.layer("occupancy").unwrap();
    let (mut clear, mut occupied) = (0, 0);
    for index in 0..layer.grid.cell_count() as usize {
        let (x, y) = layer.grid.centre_of(index).unwrap();
        let place = map_from_ego * Point3::new(x, y, 0.0);
        let middle = [place.x, place.y];
        match layer.class_at(x, y).1 {
            "clear" => {
                // These points lie on the circle through the corners: a thing that covers them covers the cell.
                let around = [[0.177, 0.0], [0.0, 0.177], [-0.177, 0.0], [0.0, -0.177]];
                let corners = around.map(|[dx, dy]| [middle[0] + dx, middle[1] + dy]);
                let inside = now.covering(&corners).is_some() && a_revolution_ago.covering(&corners).is_some();
                assert!(!inside, "a clear cell inside a thing: {middle:?} at {time} s");
                clear += 1;
            }
            "occupied" => {
                let touched = lately.iter().any(|footprints| footprints.near(middle, 0.28));
                assert!(touched, "an occupied cell without a thing for 0.3 s: {middle:?} at {time} s");
                occupied += 1;
            }
            _ => {}
        }
    }
    assert!(clear > 2000 && occupied > 50, "{clear} clear, {occupied} occupied");
}
