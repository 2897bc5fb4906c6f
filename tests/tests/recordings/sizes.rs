//! The sizes of the maps of recorded and simulated drives: for each layer and channel, as a whole map and as a delta to
//! the map before.
//! `cargo test -p clearway-tests --test system sizes -- --nocapture` prints the table.

#![cfg_attr(not(clearway_data), allow(unused))]

use std::collections::BTreeMap;
use std::path::Path;

use clearway_daemon::config::Config;
use clearway_daemon::ingest::observation;
use clearway_daemon::record::run_config;
use clearway_journal::encode::EncodedMap;
use clearway_journal::reader::{RecordedMessage, RecordingReader};
use clearway_mapping::config::MapsConfig;
use clearway_mapping::event::{Body, EgoPose, Event};
use clearway_mapping::map::Map;
use clearway_mapping::pipeline::Pipeline;
use clearway_proto::codec::Limits;
use clearway_proto::delta::encode_delta;
use clearway_proto::v1;
use clearway_replay::{ReplayOptions, replay};
use clearway_sim::scenes::{Scene, town};
use clearway_sim::traffic::street;
use clearway_tools::demo::rig::Rig;
use nalgebra::{Isometry3, Matrix3, Rotation3, UnitQuaternion, Vector3};
use prost::Message;

use crate::fixture;

/// A recorded drive and the source of its poses.
struct Drive {
    name: &'static str,
    path: &'static str,
    poses: Poses,
}

enum Poses {
    /// The poses are not known.
    None,
    /// One pose for each scan, in this file of the folder.
    PerScan(&'static str),
    /// The vehicle drives straight ahead at this speed.
    SpeedMps(f64),
}

const DRIVES: [Drive; 6] = [
    Drive { name: "hdl64e kitti", path: "kitti/patchwork-plusplus", poses: Poses::PerScan("icp_poses_DERIVED.json") },
    Drive { name: "hdl64e udacity", path: "kitti/udacity_data_2", poses: Poses::PerScan("icp_poses_DERIVED.json") },
    Drive { name: "hdl32e nuscenes", path: "nuscenes/mmdet3d", poses: Poses::None },
    Drive { name: "hdl32e", path: "pcap/rust-lidar-utils/hdl32_example.pcap", poses: Poses::SpeedMps(15.0) },
    Drive { name: "vlp16", path: "pcap/opendlv/proxy-velodyne16/sampleShort.pcap", poses: Poses::SpeedMps(5.1) },
    Drive { name: "vls128", path: "mcap/nebula_vls128_none.mcap", poses: Poses::None },
];

/// One map: the size of the whole message in bytes, and the layers.
struct Sized {
    message: usize,
    layers: Vec<v1::Layer>,
}

impl Sized {
    fn of(map: &Map) -> Self {
        let bytes = EncodedMap::new(map, "car".into(), 7, 300).select(&[]);
        Self { message: bytes.len(), layers: v1::Map::decode(bytes).unwrap().layers }
    }
}

/// Replays a drive once for its events and the mount of its sensor, then makes its maps with the poses added.
async fn maps(drive: &Drive) -> Vec<Sized> {
    let folder = tempfile::tempdir().unwrap();
    let (file, record) = (Path::new(env!("CLEARWAY_DRIVES")).join(drive.path), folder.path().join("drive.mcap"));
    let options = ReplayOptions { files: vec![file.clone()], record: Some(record.clone()), ..ReplayOptions::default() };
    fixture::within("replay", replay(options)).await.unwrap();
    let mut recording = RecordingReader::open(&record).unwrap();
    let (config, tables) = run_config(&recording).unwrap();
    // Time by which the arrivals are ahead of the sensor's clock: the poses have stamps of that clock.
    let (mut events, mut ahead_ns) = (Vec::new(), None);
    for entry in recording.by_ref() {
        match entry.unwrap() {
            RecordedMessage::Event { event, .. } => events.push(event),
            RecordedMessage::Map { bytes, .. } if ahead_ns.is_none() => {
                let header = v1::Map::decode(bytes).unwrap().header.unwrap();
                ahead_ns = Some(header.completed_ns - header.capture_end_ns);
            }
            _ => {}
        }
    }
    let mut pipeline = Pipeline::new(&config.vehicles[0].core(), tables.into_iter().next().unwrap()).unwrap();
    let mut made = Vec::new();
    for (sequence, event) in (0..).zip(with_poses(drive, &file, ahead_ns.expect("a map"), events)) {
        let event = Event { sequence, ..event };
        if let Ok(Some(map)) = pipeline.step(&event) {
            made.push(Sized::of(map));
        }
    }
    assert!(!made.is_empty(), "{} makes no map", drive.name);
    made
}

/// Maps of a car with six sensors of four planes at 50 Hz that drives through a simulated scene, with poses.
fn simulated(scene: Scene, maps: usize) -> Vec<Sized> {
    const START_NS: i64 = 1_767_270_000_000_000_000;
    let mut rig = Rig::many(scene, START_NS);
    rig.scanners.clear();
    let mut config = Config::of_one_vehicle("car", "ahead");
    config.vehicles[0].sensors = rig.sensors();
    let mut vehicle = config.vehicles[0].core();
    vehicle.maps = MapsConfig { occupancy: vehicle.maps.occupancy, ..MapsConfig::none() };
    let mut pipeline = Pipeline::new(&vehicle, vec![None; rig.units.len()]).unwrap();
    let source = |sensor: &str| rig.units.iter().position(|(name, _)| name == sensor).unwrap_or(0) as u16;
    let mut made = Vec::new();
    for (sequence, timed) in (0..).zip(rig.observations()) {
        let observation = v1::Observation::from(timed.observation);
        let source = source(&observation.sensor);
        let (_, body) =
            observation::decode(observation, &observation::Limits::from_points_max(1 << 16)).unwrap().remove(0);
        let event = Event { sequence, arrival_ns: timed.stamp_ns + 1_000_000, source, body };
        if let Ok(Some(map)) = pipeline.step(&event) {
            made.push(Sized::of(map));
            if made.len() == maps {
                break;
            }
        }
    }
    made
}

fn with_poses(drive: &Drive, folder: &Path, ahead_ns: i64, events: Vec<Event>) -> Vec<Event> {
    let pose = |event: &Event, stamp_ns: i64, map_from_ego: Isometry3<f64>| Event {
        body: Body::EgoPose(EgoPose { stamp_ns, map_from_ego, speed_mps: 3.5 }),
        ..event.clone()
    };
    match drive.poses {
        Poses::None => events,
        Poses::PerScan(file) => {
            let text = std::fs::read(folder.join(file)).unwrap();
            let list: Vec<serde_json::Value> = serde_json::from_slice(&text).unwrap();
            let mut poses = list.iter().map(|entry| {
                let rows: [[f64; 4]; 4] = serde_json::from_value(entry["T_first_from_this"].clone()).unwrap();
                let rotation = Matrix3::from_fn(|row, column| rows[row][column]);
                let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix(&rotation));
                Isometry3::from_parts(Vector3::new(rows[0][3], rows[1][3], rows[2][3]).into(), rotation)
            });
            let mut all = Vec::new();
            for event in events {
                if let Body::Scan(scan) = &event.body {
                    all.push(pose(&event, scan.stamp_ns, poses.next().expect("a pose for every scan")));
                }
                all.push(event);
            }
            all
        }
        Poses::SpeedMps(speed_mps) => {
            let Some(first_ns) = events.first().map(|event| event.arrival_ns) else { return events };
            let mut all = Vec::new();
            for (number, event) in events.into_iter().enumerate() {
                let x = (event.arrival_ns - first_ns) as f64 * 1e-9 * speed_mps;
                if number % 10 == 0 {
                    all.push(pose(&event, event.arrival_ns - ahead_ns, Isometry3::translation(x, 0.0, 0.0)));
                }
                all.push(event);
            }
            all
        }
    }
}

/// Sum of the bytes and number of maps of each part of a map.
#[derive(Default)]
struct Table(BTreeMap<String, (usize, usize)>);

impl Table {
    fn add(&mut self, what: String, bytes: usize) {
        let (sum, maps) = self.0.entry(what).or_default();
        (*sum, *maps) = (*sum + bytes, *maps + 1);
    }

    /// Sizes of each layer and channel, whole and as sent to a reader that has the map before.
    fn of(maps: &[Sized]) -> Self {
        let mut table = Self::default();
        for (number, map) in maps.iter().enumerate() {
            table.add("message".into(), map.message);
            for layer in &map.layers {
                table.add_layer(layer, layer, "whole");
                let Some(before) = number.checked_sub(1) else { continue };
                let before = maps[before].layers.iter().find(|before| before.name == layer.name).unwrap();
                let delta = encode_delta(before, 1, layer, &Limits::default());
                table.add_layer(layer, delta.as_ref().unwrap_or(layer), "sent");
                table.add(format!("{} sent as a delta, of 1", layer.name), usize::from(delta.is_some()));
            }
        }
        table
    }

    fn add_layer(&mut self, layer: &v1::Layer, sent: &v1::Layer, how: &str) {
        self.add(format!("{} {how}", layer.name), sent.encoded_len());
        for channel in &sent.channels {
            let bytes = channel.payload.len() + channel.by_class.len();
            self.add(format!("{}.{} {how}", layer.name, channel.name), bytes);
        }
    }

    fn print(&self) {
        for what in self.0.keys() {
            println!("    {what}: {:.1}", self.mean(what));
        }
    }

    fn mean(&self, what: &str) -> f64 {
        self.0.get(what).map_or(f64::NAN, |(sum, maps)| *sum as f64 / *maps as f64)
    }
}

#[tokio::test(flavor = "multi_thread")]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
async fn maps_of_recorded_drives_are_within_their_size_limits() {
    let mut classes = Table::default();
    for drive in &DRIVES {
        let maps = maps(drive).await;
        let table = Table::of(&maps);
        let largest = maps.iter().map(|map| map.message).max().unwrap();
        println!("{}: {} maps, largest message {largest} bytes", drive.name, maps.len());
        table.print();
        for map in &maps {
            let occupancy = map.layers.iter().find(|layer| layer.name == "occupancy").unwrap();
            let class = occupancy.channels.iter().find(|channel| channel.name == "class").unwrap();
            classes.add(drive.name.into(), class.payload.len());
            classes.add("all".into(), class.payload.len());
        }
        assert!(largest <= 65_536, "{}: {largest} bytes", drive.name);
    }
    println!("class of occupancy, all maps: {:.0} bytes", classes.mean("all"));
    assert!(classes.mean("hdl64e kitti") <= 7500.0 && classes.mean("all") <= 7500.0);
}

#[test]
fn deltas_of_a_simulated_drive_take_no_more_than_half_of_the_maps() {
    // The first maps are left out: the car has not seen its surroundings yet.
    const SEEN: usize = 25;
    for scene in [street(8.0), town()] {
        let name = scene.name;
        let maps = simulated(scene, SEEN + 75);
        let table = Table::of(&maps[SEEN..]);
        println!("{name}: {} maps", maps.len() - SEEN);
        table.print();
        let share = table.mean("occupancy sent") / table.mean("occupancy whole");
        println!("{name}: occupancy is sent in {:.1} % of what it takes whole", 100.0 * share);
        assert!(share <= 0.5, "{name}: {share}");
    }
}
