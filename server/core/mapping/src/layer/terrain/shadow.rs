//! Beyond the paper: which ground something standing nearer hides from the sensor.
//!
//! In: cells in which something stands, with the heights it spans, and the sensor's height; ego frame, metres. Out: by
//! cell whether level ground there lies in a shadow. A gap between two rings on the ground is no more than that; a gap
//! in a shadow may hide how a fence goes on. The sensor is taken to be over the ego origin, as the radial maps have it.

use std::f32::consts::TAU;

/// Azimuths about the vehicle; a quarter turn is whole ones, and no middle of a cell lies between two.
const AZIMUTHS: usize = 1440;
/// Steps of distance: one bit each.
const STEPS: usize = 64;

/// Shadows on the ground by azimuth and distance, reusing its buffers.
#[derive(Clone, Debug, Default)]
pub struct Shadow {
    /// By cell: azimuth and distance of its middle.
    place_of_cell: Vec<(u16, f32)>,
    steps_a_m: f32,
    /// By azimuth: the steps of distance that are hidden.
    hidden: Vec<u64>,
}

impl Shadow {
    /// Begins anew, over cells with these middles.
    pub fn clear(&mut self, cells: usize, middle_m: impl Fn(usize) -> [f32; 2]) {
        if self.place_of_cell.len() != cells {
            self.place_of_cell = (0..cells).map(|cell| place(middle_m(cell))).collect();
            let farthest_m = self.place_of_cell.iter().map(|(_, distance_m)| *distance_m).fold(1.0, f32::max);
            self.steps_a_m = (STEPS - 1) as f32 / farthest_m;
        }
        self.hidden.clear();
        self.hidden.resize(AZIMUTHS, 0);
    }

    /// Adds the shadow of what spans these heights in a cell of this size, under a sensor at `sensor_m`.
    pub fn cast(&mut self, cell: usize, cell_m: f32, [lowest_m, highest_m]: [f32; 2], sensor_m: f32) {
        let (azimuth, distance_m) = self.place_of_cell[cell];
        // Where the ray over a height meets the ground.
        let meets = |height_m: f32| {
            if height_m < sensor_m { distance_m * sensor_m / (sensor_m - height_m) } else { f32::INFINITY }
        };
        // From the step behind what stands there on.
        let first = (meets(lowest_m.max(0.0)).max(distance_m + cell_m) * self.steps_a_m).ceil() as usize;
        let last = (meets(highest_m) * self.steps_a_m).min(STEPS as f32) as usize;
        if first >= last {
            return;
        }
        let steps = (u64::MAX >> (STEPS - (last - first))) << first;
        let half_width = (cell_m / 2.0 / distance_m * AZIMUTHS as f32 / TAU) as usize;
        for azimuth in usize::from(azimuth) + AZIMUTHS - half_width..=usize::from(azimuth) + AZIMUTHS + half_width {
            self.hidden[azimuth % AZIMUTHS] |= steps;
        }
    }

    /// Distance of a cell's middle.
    pub fn distance_m(&self, cell: usize) -> f32 {
        self.place_of_cell[cell].1
    }

    /// Whether the ground in a cell is hidden.
    pub fn hides(&self, cell: usize) -> bool {
        let (azimuth, distance_m) = self.place_of_cell[cell];
        self.hidden[usize::from(azimuth)] >> (distance_m * self.steps_a_m) as usize & 1 != 0
    }
}

fn place([x, y]: [f32; 2]) -> (u16, f32) {
    let azimuth = (y.atan2(x) / TAU * AZIMUTHS as f32 + AZIMUTHS as f32 + 0.5) as usize % AZIMUTHS;
    (azimuth as u16, (x * x + y * y).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_low_wall_hides_the_ground_to_where_the_sensor_looks_over_it_and_a_branch_what_is_beyond() {
        let middle = |cell: usize| [cell as f32 * 0.5 + 0.25, 0.25];
        let shadow = |span_m: [f32; 2]| {
            let mut shadow = Shadow::default();
            shadow.clear(120, middle);
            // 10.25 m away; a sensor at 2 m looks over 1 m of it at 20.5 m.
            shadow.cast(20, 0.5, span_m, 2.0);
            (0..120).filter(|cell| shadow.hides(*cell)).map(|cell| middle(cell)[0]).collect::<Vec<f32>>()
        };
        let wall = shadow([0.0, 1.0]);
        assert!((10.5..12.5).contains(&wall[0]) && (18.5..20.6).contains(wall.last().unwrap()), "{wall:?}");
        let branch = shadow([1.0, 1.5]);
        assert!((20.5..22.5).contains(&branch[0]) && (38.5..41.1).contains(branch.last().unwrap()), "{branch:?}");
        assert!(shadow([1.0, 3.0]).last().unwrap() > &58.0);
        assert!(shadow([0.1, 0.1]).is_empty());
    }
}
