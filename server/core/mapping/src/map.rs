//! What a map is: a header, and layers of channels over one grid each. Class 0 is unknown everywhere, and is never
//! free.

use clearway_lidar::blocked::Blocked;
use nalgebra::Isometry3;

use crate::sensor::motion::Compensation;
use crate::road::TakenRoad;
use crate::sensor::sweep::Sweep;

/// Everything made from one revolution (or scan) of one vehicle's lead, and the newest ones of its other sensors.
#[derive(Clone, Debug, PartialEq)]
pub struct Map {
    /// Counts from 0 without a hole for each vehicle.
    pub sequence: u64,
    /// First firing, ns since the Unix epoch.
    pub capture_start_ns: i64,
    /// Last firing; the stamp all points are expressed at, and the one age is measured from.
    pub capture_end_ns: i64,
    /// Arrival of the event that completed the map.
    pub completed_ns: i64,
    /// Ego frame in the world frame at `capture_end_ns`, interpolated; `None` where no pose is near enough.
    pub map_from_ego: Option<Isometry3<f64>>,
    /// Forward speed, where known.
    pub speed_mps: Option<f64>,
    /// What moved the points to `capture_end_ns`.
    pub compensation: Compensation,
    /// Index of the sensor whose turn made the map: the lead, or one that stands in for it.
    pub made_by: u16,
    /// Every sensor of the vehicle, in the order of the configuration, whether it contributed or not.
    pub sensors: Vec<SensorState>,
    /// Those that are wanted, and those they are made from, in the order of the configuration.
    pub layers: Vec<Layer>,
}

/// One sensor's part in a map; what counts one turn is 0 where it has none in it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SensorState {
    /// From the configuration.
    pub name: String,
    /// `hdl32e`, …; `scan` where the turn was assembled elsewhere.
    pub model: String,
    /// Data packets of this revolution.
    pub packets: u32,
    /// The same and those that were missing before them, ±1 a gap; 0 for scans.
    pub packets_expected: u32,
    /// Datagrams and scans refused since the start, but for copies of packets.
    pub refused: u64,
    /// Returns in this revolution.
    pub returns: u32,
    /// Measured turning rate; 0 where unknown.
    pub rpm: f32,
    /// Share of the turn's azimuths that have firings, 0 to 1.
    pub completeness: f32,
    /// `start`, `end`, `gap`, `reversal`, `overlong`, or empty for a whole turn.
    pub partial: &'static str,
    /// Where the sensor used to see and did not in this revolution.
    pub blocked: Blocked,
    /// The clock the stamps follow, as [`clearway_lidar::Clock::as_str`] spells it; `sender` where a scan brings its
    /// stamp.
    pub clock: &'static str,
    /// By how much the host's clock is ahead of the stamps, ms.
    pub clock_offset_ms: i64,
    /// Whether its newest turn is in the map.
    pub state: Part,
    /// From its newest turn's end to the map's stamp; `None` before its first turn.
    pub age_ms: Option<f32>,
}

/// Whether a sensor's newest turn is in a map, and why not.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Part {
    /// Whole.
    Ok,
    /// A turn that is not whole.
    Partial,
    /// No: it is too old, or its clock is behind.
    Late,
    /// No: its clock is ahead.
    Ahead,
    /// No: the sensor gives none.
    #[default]
    Silent,
}

impl Part {
    /// As the wire spells it.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Ok => "ok",
            Self::Partial => "partial",
            Self::Late => "late",
            Self::Ahead => "ahead",
            Self::Silent => "silent",
        }
    }

    /// Whether the map holds points of the turn.
    pub fn contributes(self) -> bool {
        matches!(self, Self::Ok | Self::Partial)
    }
}

/// One named grid.
#[derive(Clone, Debug, PartialEq)]
pub struct Layer {
    /// `drivability`, `height_difference`, …
    pub name: &'static str,
    /// Where the cells lie.
    pub geometry: Geometry,
    /// Names of the values of the channel `class`, by value; entry 0 is `unknown`.
    pub legend: &'static [&'static str],
    /// The first is `class`.
    pub channels: Vec<Channel>,
    /// Segment planes z = ax + by + c, ego frame, by segment id; empty for layers without.
    pub planes: Vec<[f64; 3]>,
    /// Named figures of the whole layer (`drivable_share`, …).
    pub figures: Vec<(&'static str, f64)>,
    /// Safe points, the vehicle's own place first; empty for layers without.
    pub points: Vec<SafePoint>,
}

impl Layer {
    /// A layer without cells.
    pub fn new(
        name: &'static str,
        geometry: Geometry,
        legend: &'static [&'static str],
        channels: Vec<Channel>,
    ) -> Self {
        Self { name, geometry, legend, channels, planes: Vec::new(), figures: Vec::new(), points: Vec::new() }
    }

    /// Empties what stands beside the cells: planes, figures and points.
    pub fn clear_lists(&mut self) {
        self.planes.clear();
        self.figures.clear();
        self.points.clear();
    }
}

/// A place that is as far as can be from the obstacles on both sides.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SafePoint {
    /// Metres forward.
    pub x_m: f64,
    /// Metres to the left.
    pub y_m: f64,
    /// Distance to the nearest cell that is not free.
    pub radius_m: f64,
    /// Points, all before this one, that the vehicle gets to from here; so each link is named once.
    pub links: Vec<u32>,
}

/// What is known beside the sweep when a map is made.
#[derive(Clone, Copy, Debug, Default)]
pub struct Context<'a> {
    /// Layers of the same map made before this one, in the map's order.
    pub earlier: &'a [Layer],
    /// The map's `capture_end_ns`.
    pub stamp_ns: i64,
    /// What was seen before this is in no map, ns since the Unix epoch.
    pub earliest_ns: i64,
    /// Newest ego pose; `None` while no pose is known.
    pub map_from_ego: Option<Isometry3<f64>>,
    /// Newest road to paint.
    pub road: Option<&'a TakenRoad>,
    /// Newest route.
    pub route: Option<&'a TakenRoad>,
}

/// One sensor's turn or scan, as the maps that gather evidence between two maps see it.
#[derive(Clone, Copy, Debug)]
pub struct Rays<'a> {
    /// Index of the sensor in the vehicle's configuration.
    pub sensor: u16,
    /// When the turn ended, ns since the Unix epoch; the ego frame below is the one of this moment.
    pub stamp_ns: i64,
    /// What came back, ego frame.
    pub returns: &'a Sweep,
    /// The sensor's place, ego frame, metres.
    pub origin_m: [f32; 3],
    /// Directions (unit vectors, ego frame) of rays that came back with nothing; empty where the sensor does not tell.
    pub no_returns: &'a [[f32; 3]],
    /// Ego frame in the world frame at `stamp_ns`; `None` where no pose is near enough.
    pub map_from_ego: Option<Isometry3<f64>>,
    /// Forward speed, where known.
    pub speed_mps: Option<f64>,
}

/// Makes one layer from sweep after sweep, reusing its buffers.
pub trait LayerMaker: Send {
    /// The layer without cells.
    fn layer(&self) -> Layer;

    /// Takes one sensor's turn or scan as it ends, in the order of the events; for maps that gather evidence at each
    /// sensor's own rate.
    fn take(&mut self, rays: &Rays<'_>) {
        // Most maps are made from the map's sweep alone.
        let _ = rays;
    }

    /// Names of the earlier layers it is made from.
    fn needs(&self) -> &'static [&'static str] {
        &[]
    }

    /// Whether [`LayerMaker::make`] uses the deviations of the lead's distance series: where no map does, they are not
    /// measured.
    fn wants_deviations(&self) -> bool {
        false
    }

    /// Whether [`LayerMaker::take`] uses [`Rays::no_returns`]: where no map does, they are not looked for.
    fn wants_no_returns(&self) -> bool {
        false
    }

    /// Makes the layer of one sweep in `layer`, one of [`LayerMaker::layer`], in place of what it held. Every cell is
    /// written.
    fn make(&mut self, sweep: &Sweep, layer: &mut Layer);

    /// The same, for a map that uses more than the sweep; what the pipeline calls.
    fn make_with(&mut self, sweep: &Sweep, context: &Context<'_>, layer: &mut Layer) {
        // Most maps are made from the sweep alone.
        let _ = context;
        self.make(sweep, layer);
    }
}

/// Where cells lie, in the ego frame.
#[derive(Clone, Debug, PartialEq)]
pub enum Geometry {
    /// r-θ grid: cell index = row * columns + column; row 0 innermost, row j spans `(r_bench[j-1], r_bench[j]]`;
    /// column c spans azimuths [c, c+1) * 2π/columns, counter-clockwise from the ego x axis.
    Radial {
        /// Outer radius of each row, metres, ascending.
        r_bench_m: Vec<f32>,
        /// Number of columns.
        columns: u16,
    },
    /// Square cells: index = iy * width + ix; cell (ix, iy) spans `origin + i * cell_m` to `origin + (i + 1) * cell_m`
    /// along the grid's axes, which begin at the ego frame's origin: `(x cos yaw - y sin yaw, x sin yaw + y cos yaw)`
    /// are the grid's coordinates of the ego frame's (x, y).
    Cartesian {
        /// Corner of cell (0, 0), metres along the grid's x axis.
        origin_x_m: f64,
        /// Corner of cell (0, 0), metres along the grid's y axis.
        origin_y_m: f64,
        /// Cells along x.
        width: u32,
        /// Cells along y.
        height: u32,
        /// Side of a cell.
        cell_m: f32,
        /// Heading of the ego frame in the grid's axes; 0 where these are the vehicle's own.
        yaw_rad: f64,
        /// World index (x, y) of cell (0, 0) where the axes are the world's; 0 where they are the vehicle's own.
        first_cell: [i64; 2],
    },
}

impl Geometry {
    /// An r-θ grid of so many columns, without rows.
    pub fn radial(columns: u16) -> Self {
        Self::Radial { r_bench_m: Vec::new(), columns }
    }

    /// A square of `side` x `side` cells (an even number) with the vehicle in its middle, along the vehicle's own axes.
    pub fn about_vehicle(side: u32, cell_m: f32) -> Self {
        let corner_m = -f64::from(side / 2) * f64::from(cell_m);
        Self::Cartesian {
            origin_x_m: corner_m,
            origin_y_m: corner_m,
            width: side,
            height: side,
            cell_m,
            yaw_rad: 0.0,
            first_cell: [0, 0],
        }
    }
}

/// One value a cell.
#[derive(Clone, Debug, PartialEq)]
pub struct Channel {
    /// `class`, `unit_height`, `segment`, `difference`, …
    pub name: &'static str,
    /// `""` for a class or an id, else `m`, …
    pub unit: &'static str,
    /// A cell's value in `unit` is `raw * scale`.
    pub scale: f32,
    /// The raw value that means "nothing is known of this cell".
    pub unknown: i32,
    /// Raw values.
    pub cells: Cells,
}

impl Channel {
    /// The channel `class`, without cells: 0 is unknown.
    pub fn class() -> Self {
        Self::u8("class", "", 1.0, 0)
    }

    /// Without cells, which are 0 to 255.
    pub fn u8(name: &'static str, unit: &'static str, scale: f32, unknown: u8) -> Self {
        Self { name, unit, scale, unknown: unknown.into(), cells: Cells::U8(Vec::new()) }
    }

    /// Without cells, which are -128 to 127.
    pub fn i8(name: &'static str, unit: &'static str, scale: f32, unknown: i8) -> Self {
        Self { name, unit, scale, unknown: unknown.into(), cells: Cells::I8(Vec::new()) }
    }

    /// Without cells, which are 0 to 65535.
    pub fn u16(name: &'static str, unit: &'static str, scale: f32, unknown: u16) -> Self {
        Self { name, unit, scale, unknown: unknown.into(), cells: Cells::U16(Vec::new()) }
    }
}

/// Raw cell values.
#[derive(Clone, Debug, PartialEq)]
pub enum Cells {
    /// 0 to 255.
    U8(Vec<u8>),
    /// -128 to 127.
    I8(Vec<i8>),
    /// 0 to 65535.
    U16(Vec<u16>),
}
