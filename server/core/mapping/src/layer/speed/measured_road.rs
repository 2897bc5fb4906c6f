//! Width and lateral offset of the road ahead, measured in the sweep itself (Lindström 2005, section 3.1: "distance
//! measurements from the Ladars where used to calculate the width of the road and the lateral offset").
//!
//! In: the sweep's points, ego frame, metres. Out: points along the middle of the road ahead and its width at each, or
//! nothing. The paper gives no steps. Ours, in bands of [`BAND_M`] across the vehicle's heading:
//!
//! 1. A plane through the ground in the strip ahead of the vehicle, over three bands; heights over it.
//! 2. The profile across: the mean height of each bin of [`BIN_M`].
//! 3. From the middle outward, the first step of the profile is the road's edge: a kerb, a berm, a verge, a ditch. What
//!    stands higher than [`EDGE_M_MAX`] is no edge; it hides the edge.
//! 4. On each side the longest chain of edges that continue one another. A road is measured where both sides have a
//!    chain, and where its width stays nearly the same. Otherwise nothing is measured.
//!
//! Positions are whole millimetres, so that the order of the points does not matter.

use crate::sensor::sweep::Sweep;

/// Distance ahead at which the first band begins, metres. Ours: a sensor on a roof does not see the ground before it.
const FROM_M: f32 = 4.0;
/// Depth of a band, metres. Ours: the rings of 64 lasers lie less than that apart up to 25 m.
const BAND_M: f32 = 2.0;
/// Number of bands. Ours: to 30 m ahead, the length over which the curvature of a route is measured.
const BANDS: usize = 13;
/// Half the width of the measured profile, metres. Ours: wider than six lanes.
const HALF_M: f32 = 12.0;
/// Width of a bin of the profile, metres. Ours; not tuned.
const BIN_M: f32 = 0.2;
/// Number of bins on one side.
const BINS: usize = 60;
/// Half the width of the strip of ground that defines the plane of a band, metres. Ours: about a vehicle's width.
const STRIP_MM: i32 = 1500;
/// Largest height of a point of that strip over its lowest one, millimetres. Ours: what a grade of 15 % rises in a
/// band.
const STRIP_RISE_MM: i32 = 300;
/// Least number of points of a plane. Ours; not tuned.
const STRIP_POINTS_MIN: i64 = 20;
/// Largest standard deviation of the heights in the strip from the plane, metres. Ours: rougher ground hides kerbs.
const STRIP_ROUGHNESS_M: f64 = 0.04;
/// Least height of a step at the road's edge, metres. Ours: a low kerb, and above the noise of a bin.
const EDGE_M_MIN: f32 = 0.05;
/// Largest height of an edge over the plane, metres; higher bins contain an obstacle. Ours: twice a high kerb.
const EDGE_M_MAX: f32 = 0.4;
/// Largest height of a point that is used, over the plane, and largest depth under it, metres. Ours: the value of
/// `overhang_m`; mirror images lie deeper.
const USED_M: [f32; 2] = [-0.8, 2.5];
/// Widest gap of the profile, in bins. Ours: an edge in a wider gap would be a guess.
const GAP_BINS: usize = 4;
/// Least distance of an edge from the middle of the vehicle, metres. Ours: the vehicle stands on the road.
const EDGE_OFFSET_M_MIN: f32 = 0.6;
/// Largest change of an edge's offset from band to band, and added for its own uncertainty, metres. Ours: a road that
/// bends with a radius of 50 m reaches this at 20 m.
const CHANGE_M: [f32; 2] = [0.4, 0.2];
/// Largest number of bands without an edge within a chain. Ours: a parked car hides three.
const HIDDEN_BANDS: usize = 3;
/// Least number of edges of a chain, and of bands of a road. Ours: two edges are a coincidence.
const CHAIN_MIN: usize = 3;
/// Least and largest width of a road, metres. Ours: a lane, and six lanes.
const WIDTH_M: [f32; 2] = [2.5, 20.0];
/// Largest difference of a width from the median of the widths, metres. Ours: a junction is no road of one width.
const WIDTH_CHANGE_M: f32 = 0.75;

/// Measures one road after the other and reuses its buffers.
#[derive(Clone, Debug, Default)]
pub struct MeasuredRoad {
    /// Points by band: x, y, z, mm.
    points: Vec<Vec<[i32; 3]>>,
    points_m: Vec<[f64; 2]>,
    widths_m: Vec<f64>,
}

/// One bin of a profile.
#[derive(Clone, Copy, Default)]
struct Bin {
    points: i32,
    /// Sum of the heights over the plane, tenths of a millimetre.
    sum: i32,
    /// True if a point is higher than an edge.
    is_high: bool,
}

/// Plane z = c + a x + b y over a band, metres.
#[derive(Clone, Copy)]
struct BandPlane([f64; 3]);

impl MeasuredRoad {
    /// Measures the road ahead. Returns true if there is one.
    pub fn measure(&mut self, sweep: &Sweep) -> bool {
        self.points_m.clear();
        self.widths_m.clear();
        self.sort_points(sweep);
        let edges: [[Option<f32>; 2]; BANDS] = std::array::from_fn(|band| self.edges(band));
        let [left, right] = [0, 1].map(|side| longest_chain(&edges.map(|edges| edges[side])));
        let both: Vec<(usize, [f32; 2])> =
            (0..BANDS).filter_map(|band| Some((band, [left[band]?, right[band]?]))).collect();
        let mut widths: Vec<f32> = both.iter().map(|(_, [left, right])| left + right).collect();
        if widths.len() < CHAIN_MIN {
            return false;
        }
        widths.sort_by(f32::total_cmp);
        let median = widths[widths.len() / 2];
        let is_even = widths.iter().all(|width| (width - median).abs() <= WIDTH_CHANGE_M);
        if !is_even || !(WIDTH_M[0]..=WIDTH_M[1]).contains(&median) {
            return false;
        }
        for (band, [left, right]) in both {
            let x = FROM_M + (band as f32 + 0.5) * BAND_M;
            self.points_m.push([x.into(), ((left - right) / 2.0).into()]);
            self.widths_m.push((left + right).into());
        }
        true
    }

    /// Points along the middle of the measured road, ego frame, metres; empty if none was measured.
    pub fn points_m(&self) -> &[[f64; 2]] {
        &self.points_m
    }

    /// Width of the measured road at each point, metres.
    pub fn widths_m(&self) -> &[f64] {
        &self.widths_m
    }

    fn sort_points(&mut self, sweep: &Sweep) {
        self.points.resize(BANDS, Vec::new());
        self.points.iter_mut().for_each(Vec::clear);
        let far = FROM_M + BANDS as f32 * BAND_M;
        for ((&x, &y), &z) in sweep.x.iter().zip(&sweep.y).zip(&sweep.z) {
            // NaN fails every comparison.
            if x >= FROM_M && x < far && y.abs() < HALF_M && z.abs() < 20.0 {
                let band = ((x - FROM_M) / BAND_M) as usize;
                self.points[band.min(BANDS - 1)].push([x, y, z].map(|metres| (metres * 1000.0).round() as i32));
            }
        }
    }

    /// Distances of the road's left and right edge from the middle of the vehicle in a band, metres.
    fn edges(&self, band: usize) -> [Option<f32>; 2] {
        let Some(plane) = self.plane(band) else { return [None; 2] };
        let mut profile = [[Bin::default(); BINS]; 2];
        for &[x, y, z] in &self.points[band] {
            let over = plane.over_m([x, y, z]);
            if !(USED_M[0]..=USED_M[1]).contains(&over) {
                continue;
            }
            let index = (y.abs() as f32 * 1e-3 / BIN_M) as usize;
            let bin = &mut profile[usize::from(y < 0)][index.min(BINS - 1)];
            if over > EDGE_M_MAX {
                bin.is_high = true;
            } else {
                (bin.points, bin.sum) = (bin.points + 1, bin.sum + (over * 1e4).round() as i32);
            }
        }
        profile.map(|side| edge_m(&side))
    }

    /// The plane of the ground ahead over a band and the bands beside it; `None` if too few points define it, or if the
    /// ground is rough.
    fn plane(&self, band: usize) -> Option<BandPlane> {
        let mut sums = [0_i64; 10];
        for points in &self.points[band.saturating_sub(1)..(band + 2).min(BANDS)] {
            let strip = points.iter().filter(|point| point[1].abs() <= STRIP_MM);
            let Some(lowest) = strip.clone().map(|point| point[2]).min() else { continue };
            for &[x, y, z] in strip.filter(|point| point[2] <= lowest + STRIP_RISE_MM) {
                let [x, y, z] = [x, y, z].map(i64::from);
                let values = [1, x, y, z, x * x, y * y, z * z, x * y, x * z, y * z];
                (0..10).for_each(|i| sums[i] += values[i]);
            }
        }
        if sums[0] < STRIP_POINTS_MIN {
            return None;
        }
        let n = sums[0] as f64;
        let [_, x, y, z, xx, yy, zz, xy, xz, yz] = sums.map(|sum| sum as f64 / n);
        let [x, y, z] = [x, y, z].map(|mm| mm * 1e-3);
        // Added to the variances of the positions, so that a piece of one ring has no slope across it.
        const POSITION_M2: f64 = 0.01;
        let vx = xx * 1e-6 - x * x + POSITION_M2;
        let vy = yy * 1e-6 - y * y + POSITION_M2;
        let [vz, cxy, cxz, cyz] = [zz * 1e-6 - z * z, xy * 1e-6 - x * y, xz * 1e-6 - x * z, yz * 1e-6 - y * z];
        let determinant = vx * vy - cxy * cxy;
        let (a, b) = ((vy * cxz - cxy * cyz) / determinant, (vx * cyz - cxy * cxz) / determinant);
        let rest = vz - a * cxz - b * cyz;
        (rest <= STRIP_ROUGHNESS_M * STRIP_ROUGHNESS_M).then_some(BandPlane([z - a * x - b * y, a, b]))
    }
}

impl BandPlane {
    /// Height of a point over the plane, metres.
    fn over_m(&self, point_mm: [i32; 3]) -> f32 {
        let [x, y, z] = point_mm.map(|mm| f64::from(mm) * 1e-3);
        let [c, a, b] = self.0;
        (z - (c + a * x + b * y)) as f32
    }
}

/// Distance of the first step of a profile, from the middle outward, metres; `None` if there is none, or if something
/// hides it.
fn edge_m(side: &[Bin; BINS]) -> Option<f32> {
    let height = |bin: &Bin| (bin.points > 0).then(|| bin.sum as f32 * 1e-4 / bin.points as f32);
    let mut unknown = 0;
    for (index, bin) in side.iter().enumerate() {
        if bin.is_high {
            return None;
        }
        let Some(here) = height(bin) else {
            unknown += 1;
            if unknown > GAP_BINS {
                return None;
            }
            continue;
        };
        unknown = 0;
        // The ground just inside: the bins before, except the bin that a step is spread over.
        let inside: Vec<f32> =
            side[index.saturating_sub(2 + GAP_BINS)..index.saturating_sub(1)].iter().filter_map(height).collect();
        if inside.is_empty() {
            continue;
        }
        let ground = inside.iter().sum::<f32>() / inside.len() as f32;
        if (here - ground).abs() < EDGE_M_MIN {
            continue;
        }
        let begins_before =
            index > 0 && height(&side[index - 1]).is_some_and(|h| (h - ground).abs() >= EDGE_M_MIN / 2.0);
        let edge_m = (index - usize::from(begins_before)) as f32 * BIN_M;
        return (edge_m >= EDGE_OFFSET_M_MIN).then_some(edge_m);
    }
    None
}

/// The longest chain of edges that continue one another, by band; bands within the chain without an edge of their own
/// have one half-way between those beside them. Empty if no chain is long enough.
fn longest_chain(edges: &[Option<f32>; BANDS]) -> [Option<f32>; BANDS] {
    // By band: number of edges of the longest chain that ends here, and the band before it in the chain.
    let mut chains = [(0_usize, None::<usize>); BANDS];
    for (band, edge) in edges.iter().enumerate() {
        let Some(edge) = edge else { continue };
        chains[band] = (1, None);
        for before in band.saturating_sub(HIDDEN_BANDS + 1)..band {
            let Some(earlier) = edges[before] else { continue };
            let allowed = CHANGE_M[0] * (band - before) as f32 + CHANGE_M[1];
            if (edge - earlier).abs() <= allowed && chains[before].0 >= chains[band].0 {
                chains[band] = (chains[before].0 + 1, Some(before));
            }
        }
    }
    let mut chain = [None; BANDS];
    let longest = (0..BANDS).rev().max_by_key(|band| chains[*band].0).filter(|band| chains[*band].0 >= CHAIN_MIN);
    let mut last = longest;
    while let Some(band) = last {
        chain[band] = edges[band];
        last = chains[band].1;
        if let (Some(before), Some(to)) = (last, edges[band])
            && let Some(from) = edges[before]
        {
            for (between, edge) in chain.iter_mut().enumerate().take(band).skip(before + 1) {
                let share = (between - before) as f32 / (band - before) as f32;
                *edge = Some(from + share * (to - from));
            }
        }
    }
    chain
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_chain_leaves_out_the_edges_that_do_not_continue_it() {
        let mut edges = [None; BANDS];
        for (band, edge) in [(1, 4.0), (2, 4.1), (3, 2.0), (4, 4.2), (7, 4.6), (8, 9.0), (12, 4.0)] {
            edges[band] = Some(edge);
        }
        let chain = longest_chain(&edges);
        let found: Vec<(usize, f32)> = (0..BANDS).filter_map(|band| Some((band, chain[band]?))).collect();
        let bands: Vec<usize> = found.iter().map(|(band, _)| *band).collect();
        assert_eq!(bands, [1, 2, 3, 4, 5, 6, 7]);
        assert!((found[2].1 - 4.15).abs() < 1e-5 && (found[6].1 - 4.6).abs() < 1e-5, "{found:?}");
        edges[4] = None;
        edges[7] = None;
        assert_eq!(longest_chain(&edges), [None; BANDS], "two edges are no chain");
    }
}
