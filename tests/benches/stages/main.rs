//! Measures each stage of a revolution of an HDL-64E on one thread, in turn with a floor: the least work on the same
//! data that could do it. Times are processor times of the thread, which the load of other programs changes little.
//!
//!   cargo bench -p clearway-tests --no-default-features --bench stages       a simulated scan of a town
//!   cargo bench ... --bench stages -- SCAN.bin --height 1.73                 a scan in KITTI's format
//!
//! `--ask` is for `tests/peers/peers.py`.
//!
//! | stage | from -> to | floor |
//! |---|---|---|
//! | decode | the datagrams of a revolution -> the revolution | each return once through a table of sines and cosines |
//! | a layer | a scan event -> a map of that layer alone, with its ground and reach | see [`Floor`] |
//! | occupancy_six_units | the scans of six sensors in 100 ms -> the layer | |
//! | occupancy_six_units_paper | the same, as published: one line of Bresenham for each return | |
//! | maps | a scan event -> a map of all six layers | |
//! | shared | a scan -> its points, their ground and reach: what all layers have in common | |
//! | freespace | a scan event -> the bytes of `freespace`, when nothing else is wanted | |
//! | freespace_of_packets | the datagrams of a revolution -> the bytes of `freespace` | |
//! | maps_of_packets | the datagrams of a revolution -> the bytes of six layers | |
//! | encode | a map of six layers -> the bytes of each, with all channels | the runs of six grids of 160,000 cells |
//!
//! The first rounds, in which buffers get their sizes, are not counted.

mod floor;

use std::collections::BTreeMap;
use std::hint::black_box;
use std::io::{BufRead, stdin};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use clap::Parser;
use clearway_journal::encode::EncodedMap;
use clearway_lidar::calibration::Calibration;
use clearway_lidar::model::Model;
use clearway_lidar::{Sensor, SensorConfig as LidarConfig};
use clearway_mapping::config::{
    Extrinsics, MapsConfig, OccupancyConfig, OccupancyVariant, SensorConfig, VehicleConfig,
};
use clearway_mapping::event::{Body, EgoPose, Event, Scan};
use clearway_mapping::ground::Ground;
use clearway_mapping::layer::occupancy::Occupancy;
use clearway_mapping::layer::{Context, Layer, LayerMaker, Rays};
use clearway_mapping::pipeline::Pipeline;
use clearway_mapping::reach::Reach;
use clearway_mapping::reach::config::ReachConfig;
use clearway_mapping::scan_file;
use clearway_mapping::sensor::sweep::{Mount, Sweep};
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes::town;
use clearway_sim::traffic;
use clearway_sim::vehicle::{Kind, SimulatedVehicle};
use nalgebra::Isometry3;
use nix::time::ClockId;

use floor::Floor;

/// Rounds before the first that counts.
const WARM_UP: u32 = 6;
const PERIOD_NS: i64 = 100_000_000;
/// The layers, in the order of a map.
const LAYERS: [&str; 6] = ["drivability", "height_difference", "terrain", "occupancy", "speed", "safe_path"];

#[derive(Parser)]
struct StagesArguments {
    /// A scan in KITTI's format: float32 x y z intensity.
    scan: Option<PathBuf>,
    /// Height of its sensor over the ground, metres.
    #[arg(long, default_value_t = 1.73)]
    height: f64,
    /// Rounds of the table.
    #[arg(long, default_value_t = 30)]
    rounds: u32,
    /// Writes the scan to this file in KITTI's format, and ends.
    #[arg(long)]
    write: Option<PathBuf>,
    /// Prints the names of the stages on one line; then reads names, one a line, runs each once, and answers each with
    /// its nanoseconds.
    #[arg(long)]
    ask: bool,
    /// Set by cargo bench.
    #[arg(long, hide = true)]
    bench: bool,
}

fn main() {
    let arguments = StagesArguments::parse();
    let mut stages = Stages::new(&arguments);
    if let Some(file) = &arguments.write {
        let Scan { x, y, z, intensity, .. } = &stages.scan;
        let points = x.iter().zip(y).zip(z).zip(intensity);
        let bytes = points.flat_map(|(((x, y), z), i)| [x, y, z, i].map(|value| value.to_le_bytes())).flatten();
        std::fs::write(file, bytes.collect::<Vec<_>>()).expect("a file that can be written");
        return;
    }
    if arguments.ask {
        println!("{}", Stages::NAMES.join(" "));
        for name in stdin().lock().lines().map_while(Result::ok) {
            println!("{}", stages.run(&name).as_nanos());
        }
        return;
    }
    println!("| stage | median ms | floor ms | times its floor |\n|---|---|---|---|");
    let mut times: BTreeMap<&str, (Vec<Duration>, Vec<Duration>)> = BTreeMap::new();
    for round in 0..WARM_UP + arguments.rounds {
        for name in Stages::NAMES {
            let (own, floor) = (stages.run(name), stages.run_floor(name));
            if round >= WARM_UP {
                let (owns, floors) = times.entry(name).or_default();
                owns.push(own);
                floors.extend(floor);
            }
        }
    }
    for (name, (owns, floors)) in &mut times {
        let own_ms = median_ms(owns).unwrap_or_default();
        let beside = |floor_ms: f64| format!("{floor_ms:.2} | {:.1}", own_ms / floor_ms);
        println!("| {name} | {own_ms:.2} | {} |", median_ms(floors).map_or("| ".into(), beside));
    }
}

fn median_ms(times: &mut [Duration]) -> Option<f64> {
    times.sort_unstable();
    times.get(times.len() / 2).map(|time| time.as_secs_f64() * 1e3)
}

/// Processor time of this thread.
fn thread_time() -> Duration {
    ClockId::CLOCK_THREAD_CPUTIME_ID.now().expect("the thread's clock").into()
}

/// Runs `work` and takes its time; what it returns is dropped after that.
fn timed<T>(work: impl FnOnce() -> T) -> Duration {
    let start = thread_time();
    let result = black_box(work());
    let time = thread_time() - start;
    drop(result);
    time
}

/// What every stage runs on.
struct Stages {
    datagrams: Vec<Box<[u8]>>,
    decoder: Sensor,
    scan: Scan,
    /// A pipeline for each stage that makes maps, by name.
    pipelines: BTreeMap<&'static str, Pipeline>,
    of_packets: BTreeMap<&'static str, OfPackets>,
    six_units: SixUnits,
    six_units_paper: SixUnits,
    shared: Shared,
    floor: Floor,
    /// Number of runs so far: the stamps of a stage rise.
    runs: i64,
}

impl Stages {
    const NAMES: [&'static str; 15] = [
        "decode",
        "drivability",
        "height_difference",
        "terrain",
        "occupancy",
        "speed",
        "safe_path",
        "occupancy_six_units",
        "occupancy_six_units_paper",
        "shared",
        "maps",
        "freespace",
        "freespace_of_packets",
        "maps_of_packets",
        "encode",
    ];

    fn new(arguments: &StagesArguments) -> Self {
        let vehicle = SimulatedVehicle::new(town(), ScannerConfig::default());
        let start_ns = vehicle.start_ns();
        let data = vehicle.clone().filter(|datagram| datagram.kind == Kind::Data);
        let datagrams = data.take_while(|datagram| datagram.stamp_ns < start_ns + PERIOD_NS);
        let (scan, height_m) = match &arguments.scan {
            Some(file) => {
                let bytes = std::fs::read(file).unwrap_or_else(|error| panic!("{}: {error}", file.display()));
                let (_, scan) = scan_file::read(&file.to_string_lossy(), &bytes).expect("a scan");
                (scan, arguments.height)
            }
            None => (Scan::from(&vehicle.revolution(1)), 1.9),
        };
        let layers_of = |stage: &'static str| match stage {
            "maps" | "encode" => LAYERS.to_vec(),
            alone => vec![alone],
        };
        let of_maps = LAYERS.into_iter().chain(["maps", "freespace", "encode"]);
        Self {
            datagrams: datagrams.map(|datagram| datagram.payload.into()).collect(),
            decoder: Sensor::new(LidarConfig { model: Some(Model::Hdl64eS2), ..LidarConfig::default() }),
            pipelines: of_maps.map(|stage| (stage, pipeline(height_m, &layers_of(stage)))).collect(),
            of_packets: [("freespace_of_packets", &["freespace"][..]), ("maps_of_packets", &LAYERS)]
                .map(|(stage, layers)| (stage, OfPackets { vehicle: vehicle.clone(), pipeline: pipeline(1.9, layers) }))
                .into(),
            six_units: SixUnits::new(OccupancyVariant::Polar),
            six_units_paper: SixUnits::new(OccupancyVariant::Paper),
            shared: Shared::new(height_m),
            floor: Floor::new(&scan),
            scan,
            runs: 0,
        }
    }

    /// Runs a stage once.
    fn run(&mut self, name: &str) -> Duration {
        self.runs += 1;
        let stamp_ns = 1_700_000_000_000_000_000 + self.runs * PERIOD_NS;
        match name {
            "decode" => timed(|| {
                // When the stream begins again its device time goes back, and the first packet is refused.
                let mut firings = 0;
                for datagram in &self.datagrams {
                    if let Ok(Some(revolution)) = self.decoder.push(datagram, stamp_ns) {
                        firings += revolution.firings.len();
                    }
                }
                firings
            }),
            "occupancy_six_units" => timed(|| self.six_units.run()),
            "occupancy_six_units_paper" => timed(|| self.six_units_paper.run()),
            "shared" => timed(|| self.shared.run(&self.scan)),
            name if let Some(stage) = self.of_packets.get_mut(name) => stage.run(),
            _ => {
                let pipeline = self.pipelines.get_mut(name).unwrap_or_else(|| panic!("{name} is no stage"));
                let event = |body| Event { sequence: 0, arrival_ns: stamp_ns, source: 0, body };
                let pose = EgoPose { stamp_ns, map_from_ego: Isometry3::identity(), speed_mps: 0.0 };
                pipeline.step(&event(Body::EgoPose(pose))).expect("a pose");
                let scan = event(Body::Scan(Scan { stamp_ns, ..self.scan.clone() }));
                let start = thread_time();
                let map = pipeline.step(&scan).expect("a scan").expect("a map");
                let making = thread_time() - start;
                let encoding = timed(|| EncodedMap::new(map, "car".into(), 1, 300));
                match name {
                    "encode" => encoding,
                    "freespace" => making + encoding,
                    _ => making,
                }
            }
        }
    }

    /// Runs the floor of a stage once; `None` if it has none.
    fn run_floor(&mut self, name: &str) -> Option<Duration> {
        let (floor, scan) = (&mut self.floor, &self.scan);
        Some(match name {
            "decode" => timed(|| floor.decode(&self.datagrams)),
            "drivability" => timed(|| floor.scatter_polar(scan)),
            "terrain" => timed(|| floor.sum_moments(scan)),
            "encode" => timed(|| floor.count_runs()),
            _ => return None,
        })
    }
}

/// A pipeline of an HDL-64E that makes `layers`.
fn pipeline(height_m: f64, layers: &[&str]) -> Pipeline {
    let extrinsics = Extrinsics { x_m: 0.0, y_m: 0.0, z_m: height_m, roll_deg: 0.0, pitch_deg: 0.0, yaw_deg: 0.0 };
    let sensor = SensorConfig { model: Some(Model::Hdl64eS2), ..SensorConfig::new("top", extrinsics) };
    let config = VehicleConfig { maps: MapsConfig::default(), ..VehicleConfig::new("car", vec![sensor]) };
    let mut pipeline = Pipeline::new(&config, vec![None]).expect("the default configuration");
    pipeline.set_active_layers(|layer| layers.contains(&layer));
    pipeline
}

/// The stream of a simulated sensor, and a pipeline that makes maps of it.
struct OfPackets {
    vehicle: SimulatedVehicle,
    pipeline: Pipeline,
}

impl OfPackets {
    /// Makes and encodes the map of the next revolution.
    fn run(&mut self) -> Duration {
        let mut events = Vec::new();
        let mut end_ns = None;
        for datagram in self.vehicle.by_ref() {
            let arrival_ns = datagram.stamp_ns;
            events.push(Event { sequence: 0, arrival_ns, source: 0, body: Body::Datagram(datagram.payload.into()) });
            if arrival_ns >= *end_ns.get_or_insert(arrival_ns + PERIOD_NS) {
                break;
            }
        }
        timed(|| {
            for event in &events {
                if let Ok(Some(map)) = self.pipeline.step(event) {
                    black_box(EncodedMap::new(map, "car".into(), 1, 300));
                }
            }
        })
    }
}

/// What all layers have in common: a scan's points, and once for each map their ground and reach.
struct Shared {
    calibration: Arc<Calibration>,
    mount: Mount,
    sweep: Sweep,
    ground: Ground,
    reach: Reach,
}

impl Shared {
    fn new(height_m: f64) -> Self {
        let config = ReachConfig::default();
        Self {
            calibration: Arc::new(Calibration::factory(Model::Hdl64eS2)),
            mount: Mount { ego_from_sensor: Isometry3::translation(0.0, 0.0, height_m), range_m_min: 0.9 },
            sweep: Sweep::default(),
            ground: Ground::new(config.outline()),
            reach: Reach::new(&config),
        }
    }

    fn run(&mut self, scan: &Scan) {
        self.sweep.set_scan(scan, &self.calibration, &self.mount);
        self.ground.estimate(&self.sweep);
        self.reach.update(&self.sweep, &self.ground);
        self.reach.flood();
    }
}

/// Scans of 100 ms from six sensors on a vehicle in traffic ([`traffic::scans_of_six_units`]).
struct SixUnits {
    scans: Vec<(Sweep, [f32; 3])>,
    maker: Occupancy,
    layer: Layer,
}

impl SixUnits {
    fn new(variant: OccupancyVariant) -> Self {
        let scans = traffic::scans_of_six_units().into_iter();
        let scans = scans.map(|([x, y, z], origin_m)| (Sweep { x, y, z, ..Sweep::default() }, origin_m)).collect();
        let maker = Occupancy::new(&OccupancyConfig { variant, ..OccupancyConfig::default() });
        Self { scans, layer: maker.layer(), maker }
    }

    fn run(&mut self) {
        let pose = Some(Isometry3::identity());
        for (number, (returns, origin_m)) in self.scans.iter().enumerate() {
            self.maker.integrate(&Rays {
                sensor: (number % 6) as u16,
                stamp_ns: 0,
                returns,
                heights_m: &returns.z,
                origin_m: *origin_m,
                origin_height_m: origin_m[2],
                no_returns: &[],
                map_from_ego: pose,
                speed_mps: Some(0.0),
            });
        }
        let context = Context { map_from_ego: pose, ..Context::default() };
        self.maker.make(&Sweep::default(), &context, &mut self.layer);
    }
}
