//! The Velodyne models and what their manuals say of them: lasers, blocks, timing, resolution.
//!
//! Nothing here is measured: a decoder reads these figures forwards, an encoder backwards. Sources: HDL-64E S2/S3
//! manual (63-HDL64ES3 rev K, appendices E to G), HDL-32E application note 63-9277, VLP-16 manual 63-9243 rev E,
//! VLP-32C manual 63-9325, VLS-128 manual 63-9480, and VeloView for the VLS-128's pauses between groups of lasers.

use serde::{Deserialize, Serialize};

/// A Velodyne sensor model.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Model {
    /// HDL-64E S1.
    Hdl64eS1,
    /// HDL-64E S2 (and S2.1).
    Hdl64eS2,
    /// HDL-64E S3.
    Hdl64eS3,
    /// HDL-32E.
    Hdl32e,
    /// VLP-16 (Puck, Puck LITE).
    Vlp16,
    /// Puck Hi-Res.
    PuckHiRes,
    /// VLP-32C (Ultra Puck).
    Vlp32c,
    /// VLS-128 (Alpha Prime).
    Vls128,
}

/// Which echoes the sensor reports.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ReturnMode {
    /// The strongest echo.
    Strongest,
    /// The last echo.
    Last,
    /// Both, in pairs of blocks.
    Dual,
}

/// Blocks a data packet.
pub const BLOCKS_PER_PACKET: usize = 12;
/// Returns a block.
pub const RETURNS_PER_BLOCK: usize = 32;
/// Azimuth counts a turn: hundredths of a degree.
pub const AZIMUTHS_PER_TURN: u32 = 36_000;
/// Flag of the block of lasers 0 to 31, the upper block of an HDL-64E (bytes FF EE on the wire).
pub const FLAG_LASERS_0: u16 = 0xEEFF;
/// Flag of the block of lasers 32 to 63, the lower block of an HDL-64E.
pub const FLAG_LASERS_32: u16 = 0xDDFF;
/// Flag of the block of lasers 64 to 95 (VLS-128).
pub const FLAG_LASERS_64: u16 = 0xCCFF;
/// Flag of the block of lasers 96 to 127 (VLS-128).
pub const FLAG_LASERS_96: u16 = 0xBBFF;
/// The flags in the order in which a firing's blocks are sent.
pub const BLOCK_FLAGS: [u16; 4] = [FLAG_LASERS_0, FLAG_LASERS_32, FLAG_LASERS_64, FLAG_LASERS_96];
/// The blocks of an HDL-64E S1, over and over: three upper blocks a lower one.
pub const S1_FLAGS: [u16; 4] = [FLAG_LASERS_32, FLAG_LASERS_0, FLAG_LASERS_0, FLAG_LASERS_0];

/// What a model's manual says of it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ModelSpec {
    /// The model.
    pub model: Model,
    /// As Velodyne writes it.
    pub name: &'static str,
    /// Lasers, and so slots a firing.
    pub lasers: usize,
    /// Firings in one block: 2 with 16 lasers, else 1.
    pub firings_per_block: usize,
    /// Blocks of one firing and one echo: 2 (HDL-64E S2, S3), 4 (VLS-128), else 1. An HDL-64E S1 gives each block its
    /// own azimuth, so each is a firing that fills 32 of the 64 slots.
    pub blocks_per_firing: usize,
    /// Time from one firing to the next, ns.
    pub firing_period_ns: u32,
    /// The same in dual-return mode.
    pub firing_period_dual_ns: u32,
    /// Values of byte 1205 this model has been seen with; the first is the one it should send. Empty: an HDL-64E, whose
    /// last two bytes are status.
    pub model_bytes: &'static [u8],
    /// Whether two echoes can be asked for.
    pub dual_return: bool,
    /// Metres a raw distance count.
    pub distance_m_per_count: f64,
    /// Turning rate out of the box.
    pub rpm_nominal: f32,
    /// Farthest range the manual promises.
    pub range_m_max: f32,
    /// Lowest and highest nominal elevation, degrees.
    pub elevation_deg: (f32, f32),
}

impl Model {
    /// Every model.
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

    /// Name of the model in configurations, messages and logs: `hdl64e_s1`, `vlp16`, and so on.
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

    /// The model whose [`Model::as_str`] is `name`; `None` if there is no such model.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|model| model.as_str() == name)
    }

    /// The model's figures.
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

    /// Whether the last six bytes are an HDL-64E's (no return mode, no model byte).
    pub const fn is_hdl64e(self) -> bool {
        matches!(self, Model::Hdl64eS1 | Model::Hdl64eS2 | Model::Hdl64eS3)
    }
}

impl ModelSpec {
    /// Returns of one echo that one firing has: less than `lasers` on the HDL-64E S1 alone.
    pub const fn returns_per_firing(&self) -> usize {
        self.blocks_per_firing * RETURNS_PER_BLOCK / self.firings_per_block
    }

    /// Firings in one packet. In dual-return mode half as many; the VLS-128 then leaves its last four blocks unused.
    pub const fn firings_per_packet(&self, mode: ReturnMode) -> usize {
        match mode {
            ReturnMode::Dual => BLOCKS_PER_PACKET / (2 * self.blocks_per_firing) * self.firings_per_block,
            _ => BLOCKS_PER_PACKET / self.blocks_per_firing * self.firings_per_block,
        }
    }

    /// Blocks of a packet that hold data: 8 in a VLS-128's dual-return packet, else 12.
    pub const fn blocks_used(&self, mode: ReturnMode) -> usize {
        let echoes = if matches!(mode, ReturnMode::Dual) { 2 } else { 1 };
        self.firings_per_packet(mode) / self.firings_per_block * self.blocks_per_firing * echoes
    }

    /// Time from one firing to the next, ns.
    pub const fn period_ns(&self, mode: ReturnMode) -> u32 {
        match mode {
            ReturnMode::Dual => self.firing_period_dual_ns,
            _ => self.firing_period_ns,
        }
    }

    /// Time from one packet to the next, ns.
    pub const fn packet_period_ns(&self, mode: ReturnMode) -> u32 {
        self.period_ns(mode) * self.firings_per_packet(mode) as u32
    }

    /// Firings in a whole turn at `rpm`, rounded.
    pub fn firings_per_turn(&self, mode: ReturnMode, rpm: f32) -> usize {
        (60e9 / (f64::from(rpm) * f64::from(self.period_ns(mode)))).round() as usize
    }

    /// When `laser` fires, ns after its firing's stamp.
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

    /// How far the sensor turns from its block's azimuth until return `index` of that block is fired, in counts, when
    /// it turns `step` counts a block (a firing, on the VLS-128): rounded half up, as VeloView does. Always 0 on an
    /// HDL-64E, whose factory tables are made for the block's azimuth.
    ///
    /// `index` is the return's place in its block, plus 32, 64 or 96 for the VLS-128's later blocks.
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
        let place = BLOCK_FLAGS.iter().position(|f| *f == flag)?;
        (place * RETURNS_PER_BLOCK < self.lasers).then_some(place * RETURNS_PER_BLOCK)
    }

    /// Where block `block` of a packet belongs.
    pub fn place(&self, block: usize, mode: ReturnMode) -> BlockPlace {
        let banks = self.blocks_per_firing;
        let (group, bank, echo) = match (mode, self.model.is_hdl64e()) {
            (ReturnMode::Dual, true) => (block / (2 * banks), block % banks, block / banks % 2),
            // The last echo comes first (VLP-16 manual, 9.3.1: even blocks).
            (ReturnMode::Dual, false) => (block / (2 * banks), block / 2 % banks, 1 - block % 2),
            _ => (block / banks, block % banks, 0),
        };
        BlockPlace { firing: group * self.firings_per_block, bank, echo }
    }

    /// The flag block `block` of a packet must carry; `None`: either flag of an HDL-64E S1.
    pub fn flag(&self, block: usize, mode: ReturnMode) -> Option<u16> {
        match self.model {
            Model::Hdl64eS1 => None,
            _ => Some(BLOCK_FLAGS[self.place(block, mode).bank]),
        }
    }
}

/// Where the returns of one block belong.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BlockPlace {
    /// The first of its firings, counted from the start of the packet.
    pub firing: usize,
    /// Its place among the blocks of that firing: its first laser is `32 * bank`.
    pub bank: usize,
    /// 0 for the strongest echo (or the only one), 1 for the last.
    pub echo: usize,
}

/// The slot of time, 2.665 µs long, in which a VLS-128 laser fires: eight at once, a pause of two after the eighth.
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
    elevation_deg: (-24.33, 2.0),
};

const HDL64E_S3: ModelSpec = ModelSpec { model: Model::Hdl64eS3, name: "HDL-64E S3", dual_return: true, ..HDL64E_S2 };

/// A million points a second in blocks of 32.
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
    // Units of 2014 carry the HDL-32E's byte.
    model_bytes: &[0x22, 0x21],
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
    elevation_deg: (-25.0, 15.0),
};
