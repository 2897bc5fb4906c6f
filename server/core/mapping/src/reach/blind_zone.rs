//! The unseen ground around the vehicle, nearer than the sensor's first ring.
//!
//! In: the cells beside a step of the ground. Out: by cell of the blind zone whether the vehicle may get there. No
//! return shows a kerb or a ditch beside the vehicle; but a vehicle does not move sideways. On a side with a step near
//! the vehicle only what lies on an arc ahead or behind counts as open: whatever was seen there closes the way.

use super::cells::{SIDE, centre_m};
use super::flood::Bits;

/// Radius of the tightest arc, metres. Ours: tighter than any car drives; tuned on the even seeds of the random worlds.
const ARC_RADIUS_M: f32 = 3.0;
/// Deviation from an arc, metres. Ours; it does not matter on the random worlds.
const ARC_MARGIN_M: f32 = 0.5;
/// Greatest distance ahead and to the side at which a step is near. Ours; tuned as the arc.
const NEAR_M: f32 = 6.0;

/// What is known of the blind zone of one sweep.
#[derive(Clone)]
pub struct BlindZone {
    /// The cells that lie on an arc.
    on_arc: Bits,
    /// True on the left and on the right if a step is near there.
    has_step: [bool; 2],
}

impl BlindZone {
    /// The blind zone of a sweep without a step.
    pub fn new() -> Self {
        let mut on_arc = Bits::square(SIDE);
        on_arc.fill(|cell| is_on_arc(centre_m(cell)));
        Self { on_arc, has_step: [false; 2] }
    }

    /// Finds the sides with a step near the vehicle.
    pub fn update(&mut self, beside_step: &Bits) {
        self.has_step = [false; 2];
        beside_step.each(|ix, iy| {
            let [x, y] = centre_m(iy * SIDE + ix);
            if x.abs() < NEAR_M && y.abs() < NEAR_M {
                self.has_step[side(y)] = true;
            }
        });
    }

    /// True if the vehicle may get to a cell of the blind zone.
    pub fn is_open(&self, cell: usize) -> bool {
        self.on_arc.get(cell % SIDE, cell / SIDE) || !self.has_step[side(centre_m(cell)[1])]
    }
}

/// 0 on the left, 1 on the right.
fn side(y: f32) -> usize {
    usize::from(y < 0.0)
}

/// True if the middle of the vehicle gets to a place on one arc, ahead or behind.
fn is_on_arc([x, y]: [f32; 2]) -> bool {
    let x = x.abs().min(ARC_RADIUS_M);
    y.abs() <= ARC_RADIUS_M - (ARC_RADIUS_M * ARC_RADIUS_M - x * x).sqrt() + ARC_MARGIN_M
}

#[cfg(test)]
mod tests {
    use super::super::cells::cell;
    use super::*;

    #[test]
    fn beside_a_step_only_what_lies_ahead_or_behind_is_open() {
        let mut zone = BlindZone::new();
        let mut steps = Bits::square(SIDE);
        let open = |zone: &BlindZone, x, y| zone.is_open(cell(x, y) as usize);
        zone.update(&steps);
        assert!(open(&zone, 0.1, 2.5) && open(&zone, 0.1, -2.5), "no step is near");
        let at = cell(5.0, 3.6) as usize;
        steps.set(at % SIDE, at / SIDE);
        zone.update(&steps);
        assert!(!open(&zone, 0.1, 2.5), "beside the vehicle, where the step is");
        assert!(open(&zone, 0.1, -2.5), "on the other side");
        assert!(open(&zone, 3.5, 2.5) && open(&zone, -3.5, 2.5), "ahead and behind");
        let far = cell(9.0, 3.6) as usize;
        steps.clear();
        steps.set(far % SIDE, far / SIDE);
        zone.update(&steps);
        assert!(open(&zone, 0.1, 2.5), "the step is far");
    }
}
