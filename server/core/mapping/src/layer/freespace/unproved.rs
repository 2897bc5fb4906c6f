//! Ground in a gap of seen ground over which the sensor's rays pass too high to prove that nothing stands there.
//!
//! In: the local ground by polar cell. Out: the cells without a return at which the ray to the next ground behind them
//! passes higher over the ground than a thing that the layer must not miss. The rings of a sensor with few lasers lie
//! so far apart from some range on that such a thing stands between two rays.

use crate::ground::Ground;
use crate::ground::polar::{CELLS, COLUMNS, ROWS, row_middles_m};
use crate::ground::surface::Confidence;
use crate::reach::Reach;
use crate::reach::bits::Bits;
use crate::reach::cells::SIDE;

/// Greatest height of that ray over the ground, metres. Ours: a thing of half a metre is met wherever in its polar cell
/// it stands.
const RAY_M_MAX: f32 = 0.43;
/// Least range of unproved ground, metres. Ours: nearer ground was seen before the vehicle came there, and the first
/// ring of a sensor with few lasers lies up to there.
const RANGE_M_MIN: f32 = 12.0;

/// Finds unproved ground. It reuses its buffers.
#[derive(Clone)]
pub struct Unproved {
    row_middles_m: [f32; ROWS],
    /// By polar cell: 1 if its unseen ground is unproved.
    polar: Vec<u8>,
    cells: Bits,
}

impl Unproved {
    /// No cell yet.
    pub fn new() -> Self {
        Self { row_middles_m: row_middles_m(), polar: vec![0; CELLS], cells: Bits::square(SIDE) }
    }

    /// The unproved cells of a map whose sensor is `sensor_m` over the ground; none without a ground.
    pub fn find(&mut self, ground: Option<&Ground>, reach: &Reach, sensor_m: f32) -> &Bits {
        self.cells.clear();
        let Some(ground) = ground else { return &self.cells };
        let confidences = ground.confidences();
        self.polar.fill(0);
        for column in 0..COLUMNS {
            let mut behind_m: Option<f32> = None;
            let far = |(_, range_m): &(usize, &f32)| **range_m >= RANGE_M_MIN;
            for (row, range_m) in self.row_middles_m.iter().enumerate().rev().take_while(far) {
                let cell = row * COLUMNS + column;
                match confidences[cell] {
                    Confidence::Seen => behind_m = Some(*range_m),
                    Confidence::Bridged => {
                        let ray_m = behind_m.map(|behind_m| sensor_m * (1.0 - range_m / behind_m));
                        self.polar[cell] = u8::from(ray_m.is_some_and(|ray_m| ray_m > RAY_M_MAX));
                    }
                    Confidence::Extrapolated | Confidence::None => {}
                }
            }
        }
        reach.copy_polar(|polar| polar.of(&self.polar).copied().unwrap_or(0), &mut self.cells);
        self.cells.remove(reach.bits().seen);
        &self.cells
    }
}
