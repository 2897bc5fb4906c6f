//! The revolutions of a sensor from which its mount is estimated.

use clearway_lidar::revolution::{Echo, Revolution};

/// Number of revolutions from which the mount is estimated: the first of them follow each other, and between the others
/// there are ten. Ours: a second at 600 rpm, which a short file has, and ten seconds more, in which the road changes.
const REVOLUTIONS: usize = 20;
const REVOLUTIONS_FIRST: usize = 10;
const REVOLUTIONS_STEP: usize = 10;

/// The points of some of the first revolutions or scans, each in the sensor frame, in metres.
#[derive(Default)]
pub struct GroundRevolutions {
    clouds: Vec<Vec<[f32; 3]>>,
    seen: usize,
}

impl GroundRevolutions {
    /// Takes the points of the next revolution, if they are needed. False if no further revolution is needed.
    pub fn push(&mut self, points: impl FnOnce() -> Vec<[f32; 3]>) -> bool {
        let is_complete = self.clouds.len() >= REVOLUTIONS;
        if !is_complete && (self.seen < REVOLUTIONS_FIRST || self.seen.is_multiple_of(REVOLUTIONS_STEP)) {
            self.clouds.push(points());
        }
        self.seen += 1;
        self.clouds.len() < REVOLUTIONS
    }

    /// The points, for [`clearway_mapping::sensor::mount::estimate`].
    pub fn into_clouds(self) -> Vec<Vec<[f32; 3]>> {
        self.clouds
    }
}

/// The returns of the first echo, in the sensor frame, in metres.
pub fn points_of(revolution: &Revolution) -> Vec<[f32; 3]> {
    let echo = revolution.echoes.first();
    let returned = |echo: &Echo| {
        let slots = (0..echo.range_m.len()).filter(|&slot| echo.range_m[slot] > 0.0);
        slots.map(|slot| [echo.x[slot], echo.y[slot], echo.z[slot]]).collect()
    };
    echo.map(returned).unwrap_or_default()
}
