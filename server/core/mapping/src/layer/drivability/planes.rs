//! Plane fitting (UT Austin thesis, section IV.4): z = ax + by + c through the highest points of each segment's cells.
//!
//! In: highest points and segments. Out: a, b, c of each segment, metres; in the frame of the points. The normal
//! equations of the thesis are solved relative to the segment's centroid: there the sums of x and y are zero, two
//! unknowns remain, and the distance from the origin costs no precision.

use super::class::SEGMENT;
use super::segments::Segments;

/// Least number of cells of a segment with a plane (UT Austin thesis, section IV.4).
const CELLS_MIN: u32 = 3;

/// One plane for each segment.
#[derive(Clone, Debug, Default)]
pub struct Planes {
    moments: Vec<Moments>,
    of_segment: Vec<[f64; 3]>,
}

/// Sums over the cells of one segment, relative to its centroid.
#[derive(Clone, Copy, Debug, Default)]
struct Moments {
    cells: u32,
    centroid: [f64; 3],
    xx: f64,
    xy: f64,
    yy: f64,
    xz: f64,
    yz: f64,
}

impl Planes {
    /// Fits a plane to each segment except the last, unreachable one. `points` are the highest points of all cells.
    pub fn fit(&mut self, points: impl Iterator<Item = [f32; 3]> + Clone, segments: &Segments) {
        let unreachable = usize::from(segments.unreachable());
        self.moments.clear();
        self.moments.resize(unreachable + 1, Moments::default());
        let cells = || segments.of_cell().iter().zip(points.clone()).filter(|(s, _)| **s != SEGMENT.unknown);
        for (segment, point) in cells() {
            let moments = &mut self.moments[usize::from(*segment)];
            moments.cells += 1;
            for (sum, value) in moments.centroid.iter_mut().zip(point) {
                *sum += f64::from(value);
            }
        }
        for moments in &mut self.moments {
            let cells = f64::from(moments.cells.max(1));
            moments.centroid = moments.centroid.map(|sum| sum / cells);
        }
        for (segment, point) in cells() {
            self.moments[usize::from(*segment)].add(&point);
        }
        self.of_segment.clear();
        self.of_segment.extend(self.moments[..unreachable].iter().map(Moments::plane));
        self.of_segment.push([0.0; 3]);
    }

    /// a, b, c by segment; zeros for a segment of fewer than three cells, and for the unreachable segment.
    pub fn of_segment(&self) -> &[[f64; 3]] {
        &self.of_segment
    }

    /// Number of cells of a segment.
    pub fn cells(&self, segment: u16) -> u32 {
        self.moments[usize::from(segment)].cells
    }
}

impl Moments {
    fn add(&mut self, point: &[f32; 3]) {
        let [x, y, z] = [0, 1, 2].map(|i| f64::from(point[i]) - self.centroid[i]);
        self.xx += x * x;
        self.xy += x * y;
        self.yy += y * y;
        self.xz += x * z;
        self.yz += y * z;
    }

    fn plane(&self) -> [f64; 3] {
        if self.cells < CELLS_MIN {
            return [0.0; 3];
        }
        let determinant = self.xx * self.yy - self.xy * self.xy;
        let trace = self.xx + self.yy;
        let (a, b) = if determinant > 1e-6 * trace * trace {
            (
                (self.xz * self.yy - self.yz * self.xy) / determinant,
                (self.yz * self.xx - self.xz * self.xy) / determinant,
            )
        } else if trace > 0.0 {
            // Cells in a line, a thousand times longer than wide, determine the slope along the line only: of all
            // solutions this has the least slope.
            let scale = 1.0 / (trace * trace);
            ((self.xx * self.xz + self.xy * self.yz) * scale, (self.xy * self.xz + self.yy * self.yz) * scale)
        } else {
            (0.0, 0.0)
        };
        let [x, y, z] = self.centroid;
        [a, b, z - a * x - b * y]
    }
}
