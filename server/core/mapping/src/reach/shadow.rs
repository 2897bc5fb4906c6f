//! Shadows: the ground that nearer obstacles hide from the sensor.
//!
//! In: cells with an obstacle, and the heights over the ground that it spans, metres. Out: by cell whether the ground
//! there lies in a shadow. A gap between two rings on visible ground is only a gap; a gap in a shadow may hide the
//! continuation of a fence. The sensor is assumed to be above the ego origin, as in the radial layers.

use std::f32::consts::TAU;
use std::sync::Arc;

/// Number of azimuths about the vehicle. Ours: 90 degrees are a whole number of azimuths, and no centre of a cell lies
/// on the border between two.
const AZIMUTHS: usize = 1440;
/// Number of distance steps, one bit each, and number of them in a metre. Ours: half a metre each, for a body is free
/// from its face to the step behind it; what is farther away than all steps counts as in the last one.
const STEPS: usize = 128;
const STEPS_A_M: f32 = STEPS as f32 / 64.0;

/// Least height over the ground of the lowest return of an obstacle, metres, under which ground counts as seen. Ours:
/// ground that is seen under a lower one, such as the body of a car, lies in what stands on it.
const UNDER_M_MIN: f32 = 1.0;
/// Least height that an obstacle spans if it casts a shadow, metres; of what stands on the ground, from the ground on.
/// Ours: kerbs cast none; not tuned.
const HEIGHT_M_MIN: f32 = 0.5;

/// Place of a cell's centre, in half the bytes of its azimuth and distance.
#[derive(Clone, Copy, Debug)]
pub struct Place {
    azimuth: u16,
    step: u8,
}

impl Place {
    /// The place of a position.
    pub fn at([x, y]: [f32; 2]) -> Self {
        let azimuth = (libm::atan2f(y, x) / TAU * AZIMUTHS as f32 + AZIMUTHS as f32 + 0.5) as usize % AZIMUTHS;
        let step = ((x * x + y * y).sqrt() * STEPS_A_M).min((STEPS - 1) as f32);
        Self { azimuth: azimuth as u16, step: step as u8 }
    }
}

/// Shadows on the ground by azimuth and distance.
#[derive(Clone, Debug)]
pub struct Shadow {
    /// By cell.
    places: Arc<[Place]>,
    /// By azimuth: one bit for each distance step, set if it is hidden.
    hidden: Vec<u128>,
}

impl Shadow {
    /// Shadows on cells with these places; none yet.
    pub fn new(places: Arc<[Place]>) -> Self {
        Self { places, hidden: vec![0; AZIMUTHS] }
    }

    /// Removes all shadows.
    pub fn clear(&mut self) {
        self.hidden.fill(0);
    }

    /// Adds the shadow, if it casts one, of an obstacle that spans these heights in a cell of this size with its centre
    /// at this position, with the sensor at height `sensor_m`.
    pub fn cast(&mut self, [x, y]: [f32; 2], cell_m: f32, [lowest_m, highest_m]: [f32; 2], sensor_m: f32) {
        let under_m = if lowest_m < UNDER_M_MIN { 0.0 } else { lowest_m };
        if highest_m - under_m < HEIGHT_M_MIN {
            return;
        }
        let (azimuth, distance_m) = (Place::at([x, y]).azimuth, (x * x + y * y).sqrt());
        // Distance at which the ray over a height meets the ground.
        let meets = |height_m: f32| {
            if height_m < sensor_m { distance_m * sensor_m / (sensor_m - height_m) } else { f32::INFINITY }
        };
        // The shadow begins with the step behind the obstacle.
        let first = (meets(under_m).max(distance_m + cell_m) * STEPS_A_M).ceil() as usize;
        let last = (meets(highest_m) * STEPS_A_M).min(STEPS as f32) as usize;
        if first >= last {
            return;
        }
        let steps = (u128::MAX >> (STEPS - (last - first))) << first;
        let half_width = (cell_m / 2.0 / distance_m * AZIMUTHS as f32 / TAU) as usize;
        for azimuth in usize::from(azimuth) + AZIMUTHS - half_width..=usize::from(azimuth) + AZIMUTHS + half_width {
            self.hidden[azimuth % AZIMUTHS] |= steps;
        }
    }

    /// True if the ground in a cell is hidden.
    pub fn hides(&self, cell: usize) -> bool {
        let Place { azimuth, step } = self.places[cell];
        self.hidden[usize::from(azimuth)] >> step & 1 != 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_low_wall_hides_the_ground_behind_it_and_a_branch_the_ground_farther_on() {
        let centre = |cell: usize| [cell as f32 * 0.5 + 0.25, 0.25];
        let shadow = |span_m: [f32; 2]| {
            let mut shadow = Shadow::new((0..120).map(|cell| Place::at(centre(cell))).collect());
            // 10.25 m away; a sensor at 2 m looks over 1 m of it at 20.5 m.
            shadow.cast(centre(20), 0.5, span_m, 2.0);
            (0..120).filter(|cell| shadow.hides(*cell)).map(|cell| centre(cell)[0]).collect::<Vec<f32>>()
        };
        let wall = shadow([0.0, 1.0]);
        assert!((10.5..12.5).contains(&wall[0]) && (18.5..20.6).contains(wall.last().unwrap()), "{wall:?}");
        let branch = shadow([1.0, 1.5]);
        assert!((20.5..22.5).contains(&branch[0]) && (38.5..41.1).contains(branch.last().unwrap()), "{branch:?}");
        assert!(shadow([1.0, 3.0]).last().unwrap() > &58.0);
        let body = shadow([0.4, 1.0]);
        assert_eq!(body, wall, "the ground under a body is hidden");
        assert!(shadow([0.1, 0.1]).is_empty());
    }

    #[test]
    fn a_shadow_is_as_wide_as_the_obstacle_that_casts_it() {
        // Cells 15 m away in a row across the shadow of a wall 10 m away.
        let across = |step: usize| [15.0, (step as f32 - 20.0) * 0.1];
        let mut shadow = Shadow::new((0..41).map(|step| Place::at(across(step))).collect());
        shadow.cast([10.0, 0.0], 0.5, [0.0, 1.5], 2.0);
        // 0.5 m at 10 m are 0.75 m at 15 m, up to the width of an azimuth on each side.
        let slack_m = TAU / AZIMUTHS as f32 * 15.0;
        for step in 0..41 {
            let aside_m = across(step)[1].abs();
            assert!(shadow.hides(step) || aside_m > 0.375 - slack_m, "{aside_m} m aside is hidden");
            assert!(!shadow.hides(step) || aside_m < 0.375 + slack_m, "{aside_m} m aside is seen");
        }
    }
}
