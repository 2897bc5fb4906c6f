//! Limits of plans, and of the map format: one table for every decoder. `golden/limits.json` is written from it; the
//! Python and JavaScript decoders compare their limits with that file.

/// Most cells of one channel: a square of 400 m with cells of 0.2 m. Ours; the default grids have at most 160,000.
pub const CHANNEL_CELLS_MAX: u32 = 4 << 20;
/// Most cells of all channels of a map together: four of the largest channels. Ours; it bounds the memory that a small
/// payload can claim.
pub const MAP_CELLS_MAX: u64 = 16 << 20;
/// Most bytes of an encoded map: what gRPC receives by default. The default grids need less than 64 KiB.
pub const MAP_BYTES_MAX: usize = 4 << 20;
/// Most parts of a map: layers, channels, planes, sensors and names together; also most safe points of a layer. A map
/// can have a plane for each of 65,535 segments; each part takes some hundred bytes of memory.
pub const MAP_PARTS_MAX: usize = 1 << 16;
/// Longest number in an encoded payload, in bits: a count of cells has 32.
pub const NUMBER_BITS_MAX: u32 = 32;
/// Greatest coordinate of a safe point, in steps: single precision represents integers exactly up to here.
pub const SAFE_POINT_STEPS_MAX: i64 = 1 << 24;
/// Greatest colour of a class: 0xRRGGBB.
pub const RGB_MAX: u32 = 0x00ff_ffff;
/// Latest major version of the wire that is read; 0 and 1 are the first one.
pub const WIRE_VERSION: u32 = 1;

/// Most points of a plan's path. Ours: 400 m in steps of 0.1 m.
pub const PLAN_POINTS_MAX: usize = 4096;
/// Most corners of a plan's footprint. Ours.
pub const PLAN_CORNERS_MAX: usize = 64;
/// Most bytes of the name of a planner. Ours: half a line on a picture.
pub const PLANNER_BYTES_MAX: usize = 64;
/// Most bytes of the text of a plan. Ours: some lines on a picture.
pub const PLAN_TEXT_BYTES_MAX: usize = 256;
/// Most bytes of an encoded plan: its points with headings, and ample for the rest.
pub const PLAN_BYTES_MAX: usize = 128 << 10;
/// Greatest time by which the stamp of a plan may be ahead of the server's clock, in ns. Ours: an observation may be
/// as far ahead.
pub const PLAN_AHEAD_NS_MAX: i64 = 10_000_000_000;
/// Greatest difference of the stamps of a plan and of a map over which it is drawn, in ns. Ours: two periods of a
/// planner that plans once a second.
pub const PLAN_DRAWN_NS_MAX: i64 = 2_000_000_000;

/// Name and value of each limit of the map format, as in `golden/limits.json`.
pub const TABLE: [(&str, u64); 8] = [
    ("channel_cells_max", CHANNEL_CELLS_MAX as u64),
    ("map_cells_max", MAP_CELLS_MAX),
    ("map_bytes_max", MAP_BYTES_MAX as u64),
    ("map_parts_max", MAP_PARTS_MAX as u64),
    ("number_bits_max", NUMBER_BITS_MAX as u64),
    ("safe_point_steps_max", SAFE_POINT_STEPS_MAX as u64),
    ("rgb_max", RGB_MAX as u64),
    ("wire_version", WIRE_VERSION as u64),
];

/// The limits that a reader may lower. The default is the table's values.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    /// Most cells of one channel.
    pub channel_cells: u32,
    /// Most cells of all channels of a map together.
    pub map_cells: u64,
    /// Most bytes of an encoded map.
    pub map_bytes: usize,
    /// Most layers, channels, planes, sensors and names of a map together, and most safe points of a layer.
    pub map_parts: usize,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            channel_cells: CHANNEL_CELLS_MAX,
            map_cells: MAP_CELLS_MAX,
            map_bytes: MAP_BYTES_MAX,
            map_parts: MAP_PARTS_MAX,
        }
    }
}
