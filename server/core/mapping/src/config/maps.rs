//! The tables `[vehicle.maps.*]`, one for each map -> values, checked by [`MapsConfig::validate`].

use serde::{Deserialize, Serialize};

use crate::config::check::{Allowed, ConfigValueError, check, check_cells, check_columns, check_each};
use crate::layer::occupancy::config::OccupancyConfig;
use crate::layer::speed::config::SpeedConfig;

/// Which maps are made, each in its own table. A map that is switched off costs nothing.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MapsConfig {
    /// Age after capture at which a map is stale.
    pub valid_ms: u32,
    /// How the points of a turn are moved to its end.
    pub motion: MotionConfig,
    /// The thesis' drivability map.
    pub drivability: DrivabilityConfig,
    /// The thesis' baseline.
    pub height_difference: HeightDifferenceConfig,
    /// Neuhaus' terrain map.
    pub terrain: TerrainConfig,
    /// Seo's occupancy map.
    pub occupancy: OccupancyConfig,
    /// Lindström's speed map.
    pub speed: SpeedConfig,
    /// The thesis' safe points.
    pub safe_path: SafePathConfig,
}

impl Default for MapsConfig {
    fn default() -> Self {
        Self {
            valid_ms: 300,
            motion: MotionConfig::default(),
            drivability: DrivabilityConfig::default(),
            height_difference: HeightDifferenceConfig::default(),
            terrain: TerrainConfig::default(),
            occupancy: OccupancyConfig::default(),
            speed: SpeedConfig::default(),
            safe_path: SafePathConfig::default(),
        }
    }
}

/// Parameters of [`crate::sensor::motion`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MotionConfig {
    /// Whether points are moved; the pose of a map's header is interpolated either way.
    pub enabled: bool,
    /// How far beyond the newest pose (and before the oldest) its motion is taken to go on.
    pub extrapolation_ms: u32,
    /// How old the newest speed may be where poses do not reach; 0 leaves such turns as they are.
    pub speed_age_ms: u32,
}

impl Default for MotionConfig {
    /// Two turns at 10 Hz; two sentences of a receiver that speaks each second.
    fn default() -> Self {
        Self { enabled: true, extrapolation_ms: 200, speed_age_ms: 2000 }
    }
}

/// Parameters of [`crate::layer::drivability`]; the thesis' value, or the reading's where the thesis has none, is the
/// default.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DrivabilityConfig {
    /// Whether the map is made.
    pub enabled: bool,
    /// Points farther than this over the ground are dropped; the outermost row ends here.
    pub range_m_max: f32,
    /// Points higher than this over the ground are dropped: the vehicle passes under them.
    pub overhang_m: f32,
    /// Height of one unit.
    pub unit_height_m: f32,
    /// Added to z before it is cut into units; half a unit puts level ground in the middle of unit 0, the thesis has 0.
    pub offset_m: f32,
    /// Columns of a turn; 360, 180 and 90 are the thesis' 1, 2 and 4 degrees.
    pub columns: u16,
    /// Where segments start to grow.
    pub seed: Seed,
    /// With `seed = "blind_zone"`: how far out a column's innermost cell may still be a seed.
    pub blind_zone_m: f32,
    /// Empty rows a segment grows across; 0 is the thesis.
    pub bridge_rows: u8,
    /// Whether a cell between two higher ones is no way through; false is the thesis.
    pub close_gaps: bool,
    /// Greatest step between boundary cells of two segments (criterion 1); two units make it the thesis' own.
    pub step_m_max: f32,
    /// Rise over distance between boundary cells that is a slope, not a step (criterion 1).
    pub grade_max: f32,
    /// How far a segment's plane may miss its neighbour's boundary cells (criterion 2).
    pub plane_error_m_max: f32,
    /// Least width of a contiguous boundary the vehicle drives across (criterion 3).
    pub gate_m_min: f32,
    /// Which boundary must be that wide.
    pub gate: Gate,
}

impl Default for DrivabilityConfig {
    fn default() -> Self {
        Self {
            enabled: true,
            range_m_max: 60.0,
            overhang_m: 2.5,
            unit_height_m: 0.25,
            offset_m: 0.125,
            columns: 360,
            seed: Seed::BlindZone,
            blind_zone_m: 7.0,
            bridge_rows: 2,
            close_gaps: true,
            step_m_max: 0.15,
            grade_max: 0.2,
            plane_error_m_max: 0.25,
            gate_m_min: 3.0,
            gate: Gate::ToDrivableGround,
        }
    }
}

/// Where segments start to grow.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Seed {
    /// In every column, the innermost cell that holds a point within the blind zone, if it is about as high as the
    /// ground under the vehicle.
    BlindZone,
    /// Cell (0, 0) alone, as the thesis has it.
    FirstCell,
}

/// Which contiguous boundary must be as wide as a gate (criterion 3).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Gate {
    /// The one to all the ground found drivable so far.
    ToDrivableGround,
    /// The one between two segments, as the thesis has it.
    BetweenSegments,
}

/// Parameters of [`crate::layer::height_difference`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct HeightDifferenceConfig {
    /// Whether the map is made.
    pub enabled: bool,
    /// Points farther than this over the ground are dropped; the outermost row ends here.
    pub range_m_max: f32,
    /// A cell whose highest and lowest points differ by more is an obstacle.
    pub difference_m_max: f32,
    /// Columns of a turn.
    pub columns: u16,
}

impl Default for HeightDifferenceConfig {
    fn default() -> Self {
        Self { enabled: true, range_m_max: 60.0, difference_m_max: 0.25, columns: 360 }
    }
}

/// Parameters of [`crate::layer::terrain`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TerrainConfig {
    /// Whether the map is made.
    pub enabled: bool,
    /// Which reading of the paper.
    pub form: Form,
    /// The grid reaches this far from the vehicle in each direction.
    pub range_m_max: f32,
    /// Side of a cell.
    pub cell_m: f32,
    /// Points higher than this over the ground under the vehicle are dropped: the vehicle passes under them.
    pub overhang_m: f32,
    /// A region whose local height disturbance (a variance, eq. 1) is less is flat.
    pub flatness_m2_max: f32,
    /// Fewer points cannot be judged.
    pub points_min: u16,
    /// With `form = "grounded"`: how far a point of a flat region may lie off its plane.
    pub residual_m_max: f32,
    /// With `form = "grounded"`: rise over run beyond which a flat region is no ground.
    pub grade_max: f32,
    /// With `form = "grounded"`: how far out flat ground may be taken for the ground under the vehicle.
    pub blind_zone_m: f32,
    /// With `form = "grounded"`: how much higher or lower it may be.
    pub start_m_max: f32,
    /// With `form = "grounded"`: greatest step between neighbouring regions of the ground.
    pub step_m_max: f32,
    /// With `form = "grounded"`: widest gap without points over which regions can be neighbours, as far rings are.
    pub bridge_m_max: f32,
    /// With `form = "grounded"`: least width between obstacles the vehicle drives through; 0 takes every way.
    pub gate_m_min: f32,
    /// With `form = "grounded"`: widest hole in seen ground that is inferred to be flat.
    pub inference_m_max: f32,
    /// Deviation of the sensor's own ranges, taken off the roughness.
    pub noise_m: f32,
    /// Fewer points with a distance series have no roughness.
    pub roughness_points_min: u16,
    /// Whether the layer carries each flat cell's plane: height and slopes.
    pub planes: bool,
}

impl Default for TerrainConfig {
    fn default() -> Self {
        Self {
            enabled: true,
            form: Form::Grounded,
            range_m_max: 50.0,
            cell_m: 0.25,
            overhang_m: 2.5,
            flatness_m2_max: 0.005,
            points_min: 3,
            residual_m_max: 0.15,
            grade_max: 0.2,
            blind_zone_m: 7.0,
            start_m_max: 0.25,
            step_m_max: 0.15,
            bridge_m_max: 8.0,
            gate_m_min: 2.0,
            inference_m_max: 3.0,
            noise_m: 0.02,
            roughness_points_min: 4,
            planes: false,
        }
    }
}

/// How [`crate::layer::terrain`] finds flat cells.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Form {
    /// Hierarchical division, flat regions joined to the ground under the vehicle, inference within seen ground.
    Grounded,
    /// Hierarchical division as published (§2.3).
    Paper,
    /// Every cell for itself (§2.2), with the shape of its points.
    Grid,
}

/// Parameters of [`crate::layer::safe_path`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SafePathConfig {
    /// Whether the map is made.
    pub enabled: bool,
    /// The grid reaches this far to each side of the vehicle.
    pub extent_m: f32,
    /// Side of a cell.
    pub cell_m: f32,
    /// Points nearer than half of this to an obstacle are no way through; obstacles nearer to one another count as one.
    pub vehicle_width_m: f32,
    /// The vehicle reaches this far before the ego origin; what returns from within its outline is no obstacle.
    pub vehicle_front_m: f32,
    /// And this far behind it.
    pub vehicle_rear_m: f32,
    /// The sensor does not see the ground this near to the vehicle: what is unknown there is no obstacle.
    pub blind_zone_m: f32,
    /// Unseen ground no wider than this between drivable cells of one ring or azimuth is no obstacle.
    pub hole_m_max: f32,
    /// Farthest safe point the vehicle joins its path at.
    pub join_m_max: f32,
}

impl Default for SafePathConfig {
    fn default() -> Self {
        Self {
            enabled: true,
            extent_m: 30.0,
            cell_m: 0.25,
            vehicle_width_m: 2.0,
            vehicle_front_m: 3.0,
            vehicle_rear_m: 2.0,
            blind_zone_m: 7.0,
            hole_m_max: 1.0,
            join_m_max: 15.0,
        }
    }
}

impl MapsConfig {
    /// Every map switched off.
    pub fn none() -> Self {
        let mut maps = Self::default();
        (maps.drivability.enabled, maps.height_difference.enabled, maps.terrain.enabled) = (false, false, false);
        (maps.occupancy.enabled, maps.speed.enabled, maps.safe_path.enabled) = (false, false, false);
        maps
    }

    /// Checks every value of every map, whether made or not.
    ///
    /// # Errors
    /// The first value that cannot be used.
    pub fn validate(&self) -> Result<(), ConfigValueError> {
        check(f64::from(self.valid_ms), 1.0..=60_000.0, || "vehicle.maps.valid_ms".into(), "1 to 60000")?;
        self.motion.validate("vehicle.maps.motion")?;
        self.drivability.validate("vehicle.maps.drivability")?;
        self.height_difference.validate("vehicle.maps.height_difference")?;
        self.terrain.validate("vehicle.maps.terrain")?;
        self.occupancy.validate("vehicle.maps.occupancy")?;
        self.speed.validate("vehicle.maps.speed")?;
        self.safe_path.validate("vehicle.maps.safe_path")
    }
}

impl MotionConfig {
    fn validate(&self, at: &str) -> Result<(), ConfigValueError> {
        let reach = f64::from(self.extrapolation_ms);
        check(reach, 0.0..=1000.0, || format!("{at}.extrapolation_ms"), "0 to 1000")?;
        check(f64::from(self.speed_age_ms), 0.0..=10_000.0, || format!("{at}.speed_age_ms"), "0 to 10000")
    }
}

impl DrivabilityConfig {
    fn validate(&self, at: &str) -> Result<(), ConfigValueError> {
        let values = [
            ("range_m_max", self.range_m_max, RANGE),
            ("overhang_m", self.overhang_m, (0.5..=20.0, "0.5 to 20")),
            ("unit_height_m", self.unit_height_m, (0.05..=1.0, "0.05 to 1")),
            ("offset_m", self.offset_m, (0.0..=1.0, "0 to 1")),
            ("blind_zone_m", self.blind_zone_m, (0.0..=60.0, "0 to 60")),
            ("bridge_rows", self.bridge_rows.into(), (0.0..=8.0, "0 to 8")),
            ("step_m_max", self.step_m_max, (0.0..=10.0, "0 to 10")),
            ("grade_max", self.grade_max, (0.0..=1.0, "0 to 1")),
            ("plane_error_m_max", self.plane_error_m_max, (0.0..=10.0, "0 to 10")),
            ("gate_m_min", self.gate_m_min, (0.0..=20.0, "0 to 20")),
        ];
        check_each(at, values)?;
        check_columns(at, self.columns)
    }
}

impl HeightDifferenceConfig {
    fn validate(&self, at: &str) -> Result<(), ConfigValueError> {
        let values = [
            ("range_m_max", self.range_m_max, RANGE),
            ("difference_m_max", self.difference_m_max, (0.01..=10.0, "0.01 to 10")),
        ];
        check_each(at, values)?;
        check_columns(at, self.columns)
    }
}

impl TerrainConfig {
    fn validate(&self, at: &str) -> Result<(), ConfigValueError> {
        let values = [
            // 2000 cells a side at most.
            ("range_m_max", self.range_m_max, (5.0..=100.0, "5 to 100")),
            ("cell_m", self.cell_m, (0.1..=2.0, "0.1 to 2")),
            ("overhang_m", self.overhang_m, (0.5..=100.0, "0.5 to 100")),
            ("flatness_m2_max", self.flatness_m2_max, (1e-6..=1.0, "0.000001 to 1")),
            ("residual_m_max", self.residual_m_max, (0.01..=10.0, "0.01 to 10")),
            ("grade_max", self.grade_max, (0.01..=10.0, "0.01 to 10")),
            ("blind_zone_m", self.blind_zone_m, (0.0..=60.0, "0 to 60")),
            ("start_m_max", self.start_m_max, (0.01..=10.0, "0.01 to 10")),
            ("step_m_max", self.step_m_max, (0.0..=10.0, "0 to 10")),
            ("bridge_m_max", self.bridge_m_max, (0.0..=20.0, "0 to 20")),
            ("gate_m_min", self.gate_m_min, (0.0..=20.0, "0 to 20")),
            ("inference_m_max", self.inference_m_max, (0.0..=20.0, "0 to 20")),
            // The plane of a stretch of one ring needs some.
            ("noise_m", self.noise_m, (0.001..=1.0, "0.001 to 1")),
            ("points_min", self.points_min.into(), (1.0..=1000.0, "1 to 1000")),
            ("roughness_points_min", self.roughness_points_min.into(), (1.0..=1000.0, "1 to 1000")),
        ];
        check_each(at, values)
    }
}

impl SafePathConfig {
    fn validate(&self, at: &str) -> Result<(), ConfigValueError> {
        let values = [
            ("extent_m", self.extent_m, (5.0..=200.0, "5 to 200")),
            ("cell_m", self.cell_m, (0.1..=2.0, "0.1 to 2")),
            ("vehicle_width_m", self.vehicle_width_m, (0.1..=10.0, "0.1 to 10")),
            ("vehicle_front_m", self.vehicle_front_m, (0.0..=20.0, "0 to 20")),
            ("vehicle_rear_m", self.vehicle_rear_m, (0.0..=20.0, "0 to 20")),
            ("blind_zone_m", self.blind_zone_m, (0.0..=60.0, "0 to 60")),
            ("hole_m_max", self.hole_m_max, (0.0..=5.0, "0 to 5")),
            ("join_m_max", self.join_m_max, (0.0..=100.0, "0 to 100")),
        ];
        check_each(at, values)?;
        check_cells(at, self.extent_m, self.cell_m)
    }
}

const RANGE: Allowed = (5.0..=200.0, "5 to 200");
