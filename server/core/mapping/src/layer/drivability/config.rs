//! The table `[vehicle.maps.drivability]`.
//!
//! "Thesis" in the docs of the defaults is the UT Austin thesis.

use serde::{Deserialize, Serialize};

use crate::value_check::{ConfigValueError, check_columns, check_each};

/// Height of one unit, metres. 0.25: thesis, section IV.3.
pub(super) const UNIT_HEIGHT_M: f32 = 0.25;

/// With `seed = "blind_zone"`: largest range at which a column's innermost cell is a seed, metres. 7 is ours; not
/// tuned.
pub(super) const BLIND_ZONE_M: f32 = 7.0;

/// Parameters of the layer `drivability`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DrivabilityConfig {
    /// True if the layer is made.
    pub enabled: bool,
    /// Variant of the algorithm. `extended` is ours, because `paper` starts at a cell that has no point on most real
    /// scans, and loses slopes (BENCHMARKS.md compares the two). `paper` replaces `offset_m`, `seed`, `bridge_rows`,
    /// `close_gaps`, `step_m_max`, `grade_max`, `plane_test` and `passage` by the thesis' values.
    pub variant: DrivabilityVariant,
    /// Largest horizontal range of a point, metres; the outermost row ends here. 60: thesis, section IV.1.
    pub range_m_max: f32,
    /// Largest height of a point over the ground, metres; the vehicle passes under higher ones. 2.5: thesis, section
    /// IV.2.
    #[serde(skip)]
    pub overhang_m: f32,
    /// Offset added to a height before it is divided into units, metres. 0.125 is ours: half a unit puts level ground
    /// in the middle of unit 0, so that noise does not split it. The thesis has 0.
    #[serde(skip)]
    pub offset_m: f32,
    /// Number of columns of the grid. 360 (one degree each): thesis, section IV.1; 180 and 90 are its 2 and 4 degrees.
    pub columns: u16,
    /// Cells where segments start. `blind_zone` is ours, because row 0 of real scans has points in few columns. The
    /// thesis has `first_cell`.
    #[serde(skip)]
    pub seed: Seed,
    /// Largest number of empty rows that a segment grows across. 2 is ours, because slopes stretch the rings apart and
    /// leave rows empty; not tuned. The thesis has 0.
    #[serde(skip)]
    pub bridge_rows: u8,
    /// True if a cell between two higher ones is not joined to a segment. `true` is ours, because barriers have holes
    /// one cell wide; chosen on the labelled frame of BENCHMARKS.md. The thesis has `false`.
    #[serde(skip)]
    pub close_gaps: bool,
    /// Largest step between boundary cells of two segments, metres (criterion 1). 0.15 is ours; chosen on the labelled
    /// frame of BENCHMARKS.md. 0.5, two units, is the thesis' criterion.
    #[serde(skip)]
    pub step_m_max: f32,
    /// Largest rise over distance between boundary cells that counts as a slope, not a step (criterion 1). 0.2 is ours;
    /// chosen on the labelled frame of BENCHMARKS.md.
    #[serde(skip)]
    pub grade_max: f32,
    /// Largest distance between a segment's plane and the boundary cells of its neighbour, metres (criterion 2). 0.25,
    /// one unit: thesis, section IV.5.
    #[serde(skip)]
    pub plane_error_m_max: f32,
    /// The boundary cells that are compared with a plane (criterion 2). `each_side` is ours, because one bad cell of a
    /// long boundary must not close all of it; not tuned. The thesis has `whole_boundary`.
    #[serde(skip)]
    pub plane_test: PlaneTest,
    /// Least width of a contiguous boundary that the vehicle can drive across, metres (criterion 3). 3: thesis, section
    /// IV.5.
    #[serde(skip)]
    pub passage_m_min: f32,
    /// The boundary that must be that wide. `to_drivable_ground` is ours, because noise frays the boundary between two
    /// segments; not tuned. The thesis has `between_segments`.
    #[serde(skip)]
    pub passage: Passage,
}

impl Default for DrivabilityConfig {
    fn default() -> Self {
        Self {
            enabled: true,
            variant: DrivabilityVariant::Extended,
            range_m_max: 60.0,
            overhang_m: 2.5,
            offset_m: 0.125,
            columns: 360,
            seed: Seed::BlindZone,
            bridge_rows: 2,
            close_gaps: true,
            step_m_max: 0.15,
            grade_max: 0.2,
            plane_error_m_max: 0.25,
            plane_test: PlaneTest::EachSide,
            passage_m_min: 3.0,
            passage: Passage::ToDrivableGround,
        }
    }
}

/// Which steps the layer `drivability` takes from the thesis.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DrivabilityVariant {
    /// The values of the keys as they are.
    Extended,
    /// The UT Austin thesis, section IV, in every step.
    Paper,
}

/// The boundary cells that are compared with a plane (criterion 2).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PlaneTest {
    /// Each side shared by two cells by itself: the plane of the larger segment at the cell of the other one.
    EachSide,
    /// The planes of both segments at all boundary cells of the other one (UT Austin thesis, section IV.5). One cell
    /// that fails separates the two segments.
    WholeBoundary,
}

/// Cells where segments start to grow.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Seed {
    /// In every column, the innermost cell with a point within the blind zone, if its height is within one unit of the
    /// ground under the vehicle.
    BlindZone,
    /// Cell (0, 0) alone (UT Austin thesis, section IV.3).
    FirstCell,
}

/// The contiguous boundary that must be as wide as a passage (criterion 3).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Passage {
    /// The boundary to all the ground found drivable so far.
    ToDrivableGround,
    /// The boundary between two segments (UT Austin thesis, section IV.5).
    BetweenSegments,
}

impl DrivabilityConfig {
    /// The parameters with the values of the variant.
    pub(crate) fn of_variant(&self) -> Self {
        match self.variant {
            DrivabilityVariant::Extended => self.clone(),
            DrivabilityVariant::Paper => Self {
                offset_m: 0.0,
                seed: Seed::FirstCell,
                bridge_rows: 0,
                close_gaps: false,
                // Segments grow by one unit, and heights one unit apart differ by less than two.
                step_m_max: 2.0 * UNIT_HEIGHT_M,
                grade_max: 0.0,
                plane_test: PlaneTest::WholeBoundary,
                passage: Passage::BetweenSegments,
                ..self.clone()
            },
        }
    }

    /// Checks the values of the table `at`.
    ///
    /// # Errors
    /// [`ConfigValueError`] for the first value that is not allowed.
    pub(crate) fn validate(&self, at: &str) -> Result<(), ConfigValueError> {
        check_each(at, [("range_m_max", self.range_m_max, (5.0..=200.0, "5 to 200"))])?;
        check_columns(at, self.columns)
    }
}
