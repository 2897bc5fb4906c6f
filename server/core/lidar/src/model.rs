//! The Velodyne models and their properties: lasers, blocks, timing, resolution.
//!
//! All values come from the manuals, none is measured here. The decoder uses them, and so does the encoder of a
//! simulated sensor. Sources: HDL-64E S2/S3 manual (63-HDL64ES3 rev K, appendices E to G), HDL-32E application note
//! 63-9277, VLP-16 manual 63-9243 rev E, VLP-32C manual 63-9325, VLS-128 manual 63-9480, and VeloView for the pauses
//! between groups of lasers of a VLS-128.

use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// A Velodyne sensor model.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Model {
    /// HDL-64E S1: 64 lasers.
    Hdl64eS1,
    /// HDL-64E S2 (and S2.1): 64 lasers.
    Hdl64eS2,
    /// HDL-64E S3: 64 lasers.
    Hdl64eS3,
    /// HDL-32E: 32 lasers.
    Hdl32e,
    /// VLP-16 (Puck, Puck LITE): 16 lasers.
    Vlp16,
    /// Puck Hi-Res: 16 lasers, closer together than in a VLP-16.
    PuckHiRes,
    /// VLP-32C (Ultra Puck): 32 lasers.
    Vlp32c,
    /// VLS-128 (Alpha Prime): 128 lasers.
    Vls128,
}

/// The echoes that a sensor reports.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ReturnMode {
    /// The strongest echo of each laser.
    Strongest,
    /// The last echo of each laser.
    Last,
    /// The strongest and the last echo, in pairs of blocks.
    Dual,
}

/// Number of blocks of a data packet.
pub const BLOCKS_PER_PACKET: usize = 12;
/// Number of returns of a block.
pub const RETURNS_PER_BLOCK: usize = 32;
/// Azimuth counts of a revolution: hundredths of a degree.
pub const AZIMUTHS_PER_REVOLUTION: u32 = 36_000;
/// Flag of the block of lasers 0 to 31, the upper block of an HDL-64E (bytes FF EE on the wire).
pub const FLAG_LASERS_0: u16 = 0xEEFF;
/// Flag of the block of lasers 32 to 63, the lower block of an HDL-64E.
pub const FLAG_LASERS_32: u16 = 0xDDFF;
/// Flag of the block of lasers 64 to 95 (VLS-128).
pub const FLAG_LASERS_64: u16 = 0xCCFF;
/// Flag of the block of lasers 96 to 127 (VLS-128).
pub const FLAG_LASERS_96: u16 = 0xBBFF;
/// The flags in the order in which the blocks of a firing are sent.
pub const BLOCK_FLAGS: [u16; 4] = [FLAG_LASERS_0, FLAG_LASERS_32, FLAG_LASERS_64, FLAG_LASERS_96];
/// The flags of an HDL-64E S1, repeated: one lower block, then three upper blocks.
pub const S1_FLAGS: [u16; 4] = [FLAG_LASERS_32, FLAG_LASERS_0, FLAG_LASERS_0, FLAG_LASERS_0];

/// The properties of a model, from its manual.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ModelSpec {
    /// Model that these properties describe.
    pub model: Model,
    /// Name as Velodyne writes it.
    pub name: &'static str,
    /// Number of lasers, and so of slots of a firing.
    pub lasers: usize,
    /// Number of firings of one block: 2 with 16 lasers, else 1.
    pub firings_per_block: usize,
    /// Number of blocks of one firing and one echo: 2 (HDL-64E S2, S3), 4 (VLS-128), else 1. Each block of an HDL-64E
    /// S1 has its own azimuth, so each is a firing that fills 32 of the 64 slots.
    pub blocks_per_firing: usize,
    /// Time from one firing to the next, in ns.
    pub firing_period_ns: u32,
    /// Time from one firing to the next in dual-return mode, in ns.
    pub firing_period_dual_ns: u32,
    /// Values of byte 1205 that sensors of this model send; the first value is the manual's. Empty for an HDL-64E,
    /// whose last two bytes are status bytes.
    pub model_bytes: &'static [u8],
    /// True if the model has a dual-return mode.
    pub dual_return: bool,
    /// Length of one raw distance count, in metres.
    pub distance_m_per_count: f64,
    /// Rate of rotation in the factory settings, in revolutions per minute.
    pub rpm_nominal: f32,
    /// Greatest range in the manual, in m.
    pub range_m_max: f32,
    /// Range noise, one standard deviation, in m: the distance accuracy in the specifications of the manual.
    pub range_noise_m: f32,
    /// Lowest and highest nominal elevation, in degrees.
    pub elevation_deg: (f32, f32),
}

impl Model {
    /// All models, in the order of the enum.
    pub const ALL: [Model; 8] = [
        Model::Hdl64eS1,
        Model::Hdl64eS2,
        Model::Hdl64eS3,
        Model::Hdl32e,
        Model::Vlp16,
        Model::PuckHiRes,
        Model::Vlp32c,
        Model::Vls128,
    ];

    /// Properties of the model.
    pub const fn spec(self) -> &'static ModelSpec {
        match self {
            Model::Hdl64eS1 => &HDL64E_S1,
            Model::Hdl64eS2 => &HDL64E_S2,
            Model::Hdl64eS3 => &HDL64E_S3,
            Model::Hdl32e => &HDL32E,
            Model::Vlp16 => &VLP16,
            Model::PuckHiRes => &PUCK_HI_RES,
            Model::Vlp32c => &VLP32C,
            Model::Vls128 => &VLS128,
        }
    }

    /// Name of the model in configuration, maps and logs, such as `vlp16`; [`Model::from_str`] reads it.
    pub const fn as_str(self) -> &'static str {
        match self {
            Model::Hdl64eS1 => "hdl64e_s1",
            Model::Hdl64eS2 => "hdl64e_s2",
            Model::Hdl64eS3 => "hdl64e_s3",
            Model::Hdl32e => "hdl32e",
            Model::Vlp16 => "vlp16",
            Model::PuckHiRes => "puck_hi_res",
            Model::Vlp32c => "vlp32c",
            Model::Vls128 => "vls128",
        }
    }

    /// True if the last two bytes of a packet are status bytes of an HDL-64E, instead of return mode and model.
    pub const fn is_hdl64e(self) -> bool {
        matches!(self, Model::Hdl64eS1 | Model::Hdl64eS2 | Model::Hdl64eS3)
    }
}

/// The text is not the name of a sensor model.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("unknown sensor model `{name}`; known: {}", Model::ALL.map(Model::as_str).join(", "))]
pub struct UnknownModelError {
    /// Text that is not the name of a model.
    pub name: String,
}

impl FromStr for Model {
    type Err = UnknownModelError;

    /// Finds the model with that name.
    fn from_str(name: &str) -> Result<Self, UnknownModelError> {
        let found = Self::ALL.into_iter().find(|model| model.as_str() == name);
        found.ok_or_else(|| UnknownModelError { name: name.to_owned() })
    }
}

impl ModelSpec {
    /// Number of returns of one firing and one echo. It is less than `lasers` only for the HDL-64E S1.
    pub const fn returns_per_firing(&self) -> usize {
        self.blocks_per_firing * RETURNS_PER_BLOCK / self.firings_per_block
    }

    /// Number of firings of one packet. In dual-return mode it is half; the VLS-128 then leaves its last four blocks
    /// unused.
    pub const fn firings_per_packet(&self, mode: ReturnMode) -> usize {
        match mode {
            ReturnMode::Dual => BLOCKS_PER_PACKET / (2 * self.blocks_per_firing) * self.firings_per_block,
            _ => BLOCKS_PER_PACKET / self.blocks_per_firing * self.firings_per_block,
        }
    }

    /// Number of blocks of a packet with data: 8 of a VLS-128 in dual-return mode, else 12.
    pub const fn blocks_used(&self, mode: ReturnMode) -> usize {
        let echoes = if matches!(mode, ReturnMode::Dual) { 2 } else { 1 };
        self.firings_per_packet(mode) / self.firings_per_block * self.blocks_per_firing * echoes
    }

    /// Time from one firing to the next, in ns.
    pub const fn period_ns(&self, mode: ReturnMode) -> u32 {
        match mode {
            ReturnMode::Dual => self.firing_period_dual_ns,
            _ => self.firing_period_ns,
        }
    }

    /// Time from one packet to the next, in ns.
    pub const fn packet_period_ns(&self, mode: ReturnMode) -> u32 {
        self.period_ns(mode) * self.firings_per_packet(mode) as u32
    }

    /// Number of firings of a revolution at `rpm`, rounded.
    pub fn firings_per_revolution(&self, mode: ReturnMode, rpm: f32) -> usize {
        (60e9 / (f64::from(rpm) * f64::from(self.period_ns(mode)))).round() as usize
    }

    /// Azimuth counts from one firing to the next at `rpm`, rounded.
    pub fn firing_step(&self, mode: ReturnMode, rpm: f32) -> u32 {
        let per_ns = f64::from(rpm) / 60e9 * f64::from(AZIMUTHS_PER_REVOLUTION);
        (per_ns * f64::from(self.period_ns(mode))).round() as u32
    }

    /// Time from the stamp of a firing until `laser` fires, in ns.
    pub fn laser_offset_ns(&self, laser: usize) -> u32 {
        match self.model {
            Model::Hdl64eS1 => 0,
            Model::Hdl64eS2 => (laser % 32 / 4 * 6_000) as u32 + [0, 1_260, 2_460, 3_660][laser % 4],
            Model::Hdl64eS3 => (laser % 32 / 4 * 6_000) as u32 + [0, 1_300, 2_500, 3_700][laser % 4],
            Model::Hdl32e => laser as u32 * 1_152,
            Model::Vlp16 | Model::PuckHiRes => laser as u32 * 2_304,
            Model::Vlp32c => (laser / 2) as u32 * 2_304,
            Model::Vls128 => group_of_vls128(laser) * 2_665,
        }
    }

    /// Counts by which the sensor turns from the azimuth of its block until return `index` of that block is fired, if
    /// it turns by `step` counts per block (VLS-128: per firing). It is rounded half up, as in VeloView. It is 0 for an
    /// HDL-64E, whose calibration refers to the azimuth of the block.
    ///
    /// `index` is the index of the return in its block, plus 32, 64 or 96 for the later blocks of a VLS-128.
    pub fn azimuth_offset(&self, index: usize, step: u32) -> u32 {
        let (share, whole) = match self.model {
            Model::Hdl64eS1 | Model::Hdl64eS2 | Model::Hdl64eS3 => return 0,
            Model::Hdl32e => (index as u32, 40),
            Model::Vlp16 | Model::PuckHiRes => ((index / 16 * 24 + index % 16) as u32, 48),
            Model::Vlp32c => ((index / 2) as u32, 24),
            Model::Vls128 => (group_of_vls128(index), 20),
        };
        (2 * step * share + whole) / (2 * whole)
    }

    /// The first laser of the blocks with this flag; `None` if the model has no such block.
    pub fn first_laser(&self, flag: u16) -> Option<usize> {
        let rank = BLOCK_FLAGS.iter().position(|f| *f == flag)?;
        (rank * RETURNS_PER_BLOCK < self.lasers).then_some(rank * RETURNS_PER_BLOCK)
    }

    /// Position of block `block` of a packet.
    pub fn block_position(&self, block: usize, mode: ReturnMode) -> BlockPosition {
        let banks = self.blocks_per_firing;
        let (group, bank, echo) = match (mode, self.model.is_hdl64e()) {
            (ReturnMode::Dual, true) => (block / (2 * banks), block % banks, block / banks % 2),
            // The last echo precedes the strongest (VLP-16 manual 63-9243, section 9.3.1: even blocks).
            (ReturnMode::Dual, false) => (block / (2 * banks), block / 2 % banks, 1 - block % 2),
            _ => (block / banks, block % banks, 0),
        };
        BlockPosition { firing: group * self.firings_per_block, bank, echo }
    }

    /// Flag that block `block` of a packet must have; `None` for an HDL-64E S1, whose blocks may have either flag.
    pub fn flag(&self, block: usize, mode: ReturnMode) -> Option<u16> {
        match self.model {
            Model::Hdl64eS1 => None,
            _ => Some(BLOCK_FLAGS[self.block_position(block, mode).bank]),
        }
    }
}

/// The position of the returns of one block.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BlockPosition {
    /// Index of its first firing in the packet.
    pub firing: usize,
    /// Index of the block in that firing: its first laser is `32 * bank`.
    pub bank: usize,
    /// Index of the range image: 0 for the strongest or only echo, 1 for the last.
    pub echo: usize,
}

/// Time slot of 2.665 µs in which a laser of a VLS-128 fires: eight lasers per slot, and a pause of two slots after the
/// eighth slot.
fn group_of_vls128(laser: usize) -> u32 {
    (laser / 8 + laser / 64 * 2) as u32
}

const HDL64E_S2: ModelSpec = ModelSpec {
    model: Model::Hdl64eS2,
    name: "HDL-64E S2",
    lasers: 64,
    firings_per_block: 1,
    blocks_per_firing: 2,
    firing_period_ns: 48_000,
    firing_period_dual_ns: 57_600,
    model_bytes: &[],
    dual_return: false,
    distance_m_per_count: 0.002,
    rpm_nominal: 600.0,
    range_m_max: 120.0,
    // 63-HDL64ES3, specifications: "< 2 cm distance accuracy (one sigma)".
    range_noise_m: 0.02,
    elevation_deg: (-24.33, 2.0),
};

const HDL64E_S3: ModelSpec = ModelSpec { model: Model::Hdl64eS3, name: "HDL-64E S3", dual_return: true, ..HDL64E_S2 };

/// An HDL-64E S1 measures a million points per second, in blocks of 32.
const HDL64E_S1: ModelSpec = ModelSpec {
    model: Model::Hdl64eS1,
    name: "HDL-64E S1",
    blocks_per_firing: 1,
    firing_period_ns: 32_000,
    firing_period_dual_ns: 32_000,
    ..HDL64E_S2
};

const HDL32E: ModelSpec = ModelSpec {
    model: Model::Hdl32e,
    name: "HDL-32E",
    lasers: 32,
    blocks_per_firing: 1,
    firing_period_ns: 46_080,
    firing_period_dual_ns: 46_080,
    model_bytes: &[0x21],
    dual_return: true,
    range_m_max: 100.0,
    // HDL-32E user's manual 63-9113, specifications: "±2 cm (one sigma at 25 m)".
    range_noise_m: 0.02,
    elevation_deg: (-30.67, 10.67),
    ..HDL64E_S2
};

const VLP16: ModelSpec = ModelSpec {
    model: Model::Vlp16,
    name: "VLP-16",
    lasers: 16,
    firings_per_block: 2,
    firing_period_ns: 55_296,
    firing_period_dual_ns: 55_296,
    // Sensors of 2014 send the byte of the HDL-32E.
    model_bytes: &[0x22, 0x21],
    // 63-9243, specifications: "range accuracy up to ±3 cm (typical)".
    range_noise_m: 0.03,
    elevation_deg: (-15.0, 15.0),
    ..HDL32E
};

const PUCK_HI_RES: ModelSpec = ModelSpec {
    model: Model::PuckHiRes,
    name: "Puck Hi-Res",
    model_bytes: &[0x24, 0x22],
    elevation_deg: (-10.0, 10.0),
    ..VLP16
};

const VLP32C: ModelSpec = ModelSpec {
    model: Model::Vlp32c,
    name: "VLP-32C",
    firing_period_ns: 55_296,
    firing_period_dual_ns: 55_296,
    model_bytes: &[0x28],
    distance_m_per_count: 0.004,
    range_m_max: 200.0,
    // 63-9325, specifications: "range accuracy up to ±3 cm (typical)".
    range_noise_m: 0.03,
    elevation_deg: (-25.0, 15.0),
    ..HDL32E
};

const VLS128: ModelSpec = ModelSpec {
    model: Model::Vls128,
    name: "VLS-128",
    lasers: 128,
    firings_per_block: 1,
    blocks_per_firing: 4,
    firing_period_ns: 53_300,
    firing_period_dual_ns: 53_300,
    model_bytes: &[0xA1, 0x63],
    dual_return: true,
    distance_m_per_count: 0.004,
    rpm_nominal: 600.0,
    range_m_max: 245.0,
    // 63-9480, specifications: "range accuracy up to ±3 cm (typical)".
    range_noise_m: 0.03,
    elevation_deg: (-25.0, 15.0),
};
