//! Measures what a map costs against the lasers of the sensor, and against the cells of a layer: processor time of one
//! thread, which the load of other programs changes little.
//!
//!   cargo bench -p clearway-tests --bench costs -- lasers cells --rounds 20
//!
//! `lasers`: five sensor models in the simulated town, at 10 revolutions a second; each layer alone, all six, and none,
//! which is decoding and moving the points. `cells`: an HDL-64E there; each layer alone, with the cells and columns
//! that the configuration allows. A round processes one revolution in every setting. The first rounds, in which
//! buffers get their sizes, are not counted.
//!
//! Out: CSV, a line for each revolution and setting, for `tests/peers/costs.py`. `map_ms`: from the datagrams and poses
//! of 100 ms to the map, with the ground, the reach and the layers that the layer needs. `encode_ms`, `bytes`: from the
//! layers of the series to their messages.

use std::hint::black_box;
use std::rc::Rc;
use std::time::Duration;

use clap::{Parser, ValueEnum};
use clearway_journal::encode::EncodedMap;
use clearway_lidar::model::Model;
use clearway_mapping::config::{Extrinsics, MapsConfig, SensorConfig, VehicleConfig};
use clearway_mapping::event::{Body, EgoPose, Event};
use clearway_mapping::layer::Geometry;
use clearway_mapping::pipeline::Pipeline;
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes::town;
use clearway_sim::vehicle::SimulatedVehicle;
use nix::time::ClockId;

/// Rounds before the first that counts.
const WARM_UP: usize = 6;
/// Time of a revolution, and between two poses.
const REVOLUTION_NS: i64 = 100_000_000;
const POSE_PERIOD_NS: i64 = 50_000_000;
/// The sensors, in the order of their numbers of points.
const MODELS: [Model; 5] = [Model::Vlp16, Model::Hdl32e, Model::Vlp32c, Model::Hdl64eS2, Model::Vls128];
/// The layers, in the order of a map.
const LAYERS: [&str; 6] = ["drivability", "height_difference", "terrain", "occupancy", "speed", "safe_path"];
/// Sides of a square cell, metres, and columns of a radial grid: from the least to the greatest allowed.
const CELLS_M: [f32; 6] = [2.0, 1.0, 0.5, 0.25, 0.15, 0.1];
const COLUMNS: [u16; 6] = [8, 90, 180, 360, 720, 1440];

/// The events of each revolution.
type Drive = Rc<[Vec<Event>]>;

#[derive(Parser)]
struct CostsArguments {
    /// What the cost is measured against.
    #[arg(value_enum, default_values_t = [Quantity::Lasers, Quantity::Cells])]
    quantities: Vec<Quantity>,
    /// Rounds that count.
    #[arg(long, default_value_t = 20)]
    rounds: usize,
    /// Set by cargo bench.
    #[arg(long, hide = true)]
    bench: bool,
}

#[derive(Clone, Copy, ValueEnum)]
enum Quantity {
    Lasers,
    Cells,
}

fn main() {
    let arguments = CostsArguments::parse();
    let revolutions = WARM_UP + arguments.rounds;
    println!("quantity,setting,lasers,series,round,cells,points,map_ms,encode_ms,bytes");
    for quantity in arguments.quantities {
        let (quantity, mut settings) = match quantity {
            Quantity::Lasers => ("lasers", by_lasers(revolutions)),
            Quantity::Cells => ("cells", by_cells(revolutions)),
        };
        for round in 0..revolutions {
            for setting in &mut settings {
                let Cost { cells, points, map_ms, encode_ms, bytes } = setting.step(round);
                if let Some(round) = round.checked_sub(WARM_UP) {
                    let names = &setting.names;
                    println!("{quantity},{names},{round},{cells},{points},{map_ms:.4},{encode_ms:.4},{bytes}");
                }
            }
        }
    }
}

/// Every model, with each layer alone, with all and with none.
fn by_lasers(revolutions: usize) -> Vec<Setting> {
    let mut settings = Vec::new();
    for model in MODELS {
        let drive = drive(model, revolutions);
        let mut add = |series: &str, layers: &[&'static str]| {
            settings.push(Setting::new(model, (model.as_str(), MapsConfig::default()), series, layers, &drive));
        };
        add("no layer", &[]);
        LAYERS.iter().for_each(|layer| add(layer, &[layer]));
        add("six layers", &LAYERS);
    }
    settings
}

/// An HDL-64E with each layer alone, for each size of the layer's cells.
fn by_cells(revolutions: usize) -> Vec<Setting> {
    let model = Model::Hdl64eS2;
    let drive = drive(model, revolutions);
    let of_size = |(cell_m, columns)| {
        LAYERS.map(|layer| {
            let (size, maps) = sized(layer, cell_m, columns);
            Setting::new(model, (&size, maps), layer, &[layer], &drive)
        })
    };
    CELLS_M.into_iter().zip(COLUMNS).flat_map(of_size).collect()
}

/// The default configuration with a layer's cells of this size, if they are square, or as many columns.
fn sized(layer: &str, cell_m: f32, columns: u16) -> (String, MapsConfig) {
    let mut maps = MapsConfig::default();
    match layer {
        "drivability" => maps.drivability.columns = columns,
        "height_difference" => maps.height_difference.columns = columns,
        "terrain" => maps.terrain.cell_m = cell_m,
        "occupancy" => maps.occupancy.cell_m = cell_m,
        "speed" => maps.speed.cell_m = cell_m,
        _ => maps.safe_path.cell_m = cell_m,
    }
    let is_radial = matches!(layer, "drivability" | "height_difference");
    (if is_radial { format!("{columns} columns") } else { format!("{cell_m} m") }, maps)
}

/// The events of each 100 ms of a drive through the town. A decoder ends one revolution in each.
fn drive(model: Model, revolutions: usize) -> Drive {
    let vehicle = SimulatedVehicle::new(town(), ScannerConfig { model, ..ScannerConfig::default() });
    let (start_ns, truth) = (vehicle.start_ns(), vehicle.clone());
    let mut drive = vec![Vec::new(); revolutions];
    let mut pose_ns = start_ns;
    for datagram in vehicle {
        let stamp_ns = datagram.stamp_ns;
        let Some(events) = drive.get_mut(((stamp_ns - start_ns) / REVOLUTION_NS) as usize) else { break };
        let event = |body| Event { sequence: 0, arrival_ns: stamp_ns, source: 0, body };
        if stamp_ns >= pose_ns {
            pose_ns += POSE_PERIOD_NS;
            let (map_from_ego, speed_mps) = (truth.pose_at(stamp_ns), truth.speed_at(stamp_ns));
            events.push(event(Body::EgoPose(EgoPose { stamp_ns, map_from_ego, speed_mps })));
        }
        events.push(event(Body::Datagram(datagram.payload.into())));
    }
    drive.into()
}

/// A vehicle and the layers that are made of its drive.
struct Setting {
    /// The columns `setting`, `lasers` and `series` of its lines.
    names: String,
    layers: Vec<&'static str>,
    pipeline: Pipeline,
    drive: Drive,
}

/// What one revolution costs.
struct Cost {
    cells: usize,
    points: usize,
    map_ms: f64,
    encode_ms: f64,
    bytes: usize,
}

impl Setting {
    fn new(
        model: Model,
        (setting, maps): (&str, MapsConfig),
        series: &str,
        layers: &[&'static str],
        drive: &Drive,
    ) -> Self {
        let z_m = ScannerConfig::default().ego_from_sensor.translation.z;
        let extrinsics = Extrinsics { x_m: 0.0, y_m: 0.0, z_m, roll_deg: 0.0, pitch_deg: 0.0, yaw_deg: 0.0 };
        let sensor = SensorConfig { model: Some(model), ..SensorConfig::new("top", extrinsics) };
        let config = VehicleConfig { maps, ..VehicleConfig::new("car", vec![sensor]) };
        let mut pipeline = Pipeline::new(&config, vec![None]).expect("an allowed configuration");
        pipeline.set_active_layers(|layer| layers.contains(&layer));
        let names = format!("{setting},{},{series}", model.spec().lasers);
        Self { names, layers: layers.to_vec(), pipeline, drive: drive.clone() }
    }

    /// Processes the revolution of this round.
    fn step(&mut self, round: usize) -> Cost {
        let (events, pipeline) = (&self.drive[round], &mut self.pipeline);
        let is_map = |event| pipeline.step(event).expect("an event of the simulator").is_some();
        let (map_ms, maps) = timed(|| events.iter().map(is_map).filter(|is_map| *is_map).count());
        assert!(maps == 1 || round == 0, "{maps} maps of a revolution");
        let mut map = pipeline.newest_map().expect("a map").clone();
        // A layer that another layer is made from is in its map too.
        map.layers.retain(|layer| self.layers.contains(&layer.name));
        let (encode_ms, encoded) = timed(|| EncodedMap::new(&map, "car".into(), 1, 300));
        Cost {
            cells: map.layers.iter().map(|layer| cells(&layer.geometry)).sum(),
            points: pipeline.newest_sweep().x.len(),
            map_ms,
            encode_ms,
            bytes: encoded.bytes(),
        }
    }
}

/// Runs `work`, and takes the processor time of this thread in milliseconds.
fn timed<T>(work: impl FnOnce() -> T) -> (f64, T) {
    let now = || Duration::from(ClockId::CLOCK_THREAD_CPUTIME_ID.now().expect("the clock of this thread"));
    let before = now();
    let result = black_box(work());
    ((now() - before).as_secs_f64() * 1e3, result)
}

fn cells(geometry: &Geometry) -> usize {
    match geometry {
        Geometry::Radial { row_radius_m, columns, .. } => row_radius_m.len() * usize::from(*columns),
        Geometry::Cartesian { width, height, .. } => (width * height) as usize,
    }
}
