//! Polar scans: the rays of each sensor's newest scan, collected by azimuth. For each azimuth, how far the view goes
//! and where it proves the ground free.
//!
//! In: [`Rays`], ego frame, metres. Out: hits counted in the [`Window`] for each scan; when the map is made, the
//! evidence about each cell, from one traced ray for each azimuth bin with rays.
//!
//! A ray proves a cell free if it passes low over it: at the height of a bumper, `clear_height_m_min` to `_max`. A ray
//! from the roof over a car proves nothing about the car's cells, nor does a ray under the car's body. Therefore each
//! azimuth bin (a quarter of a degree) has a row of bits, one for each step of a cell's side outward, set where a ray
//! of the bin is low. Rays only set bits, so that their order does not matter.
//!
//! A traced ray ends at the nearest return from above the ground in its own bin or in the two bins to either side: the
//! rays of one bin differ by part of its width, some are lost, and a traced ray must not run along an object just
//! inside its edge. The cells behind that return are hidden, except where a ray comes down to the ground: those from
//! where it is below the vehicle's clearance are free, if no obstacle lies between there and its end, so that it passed
//! beneath nothing.
//!
//! Heights are those over the local ground ([`Rays::heights_m`]). Between the sensor and a return the ground is taken
//! as a straight line, from under the sensor to under the return.
//!
//! Only the newest scan of a sensor shows what is clear and what is hidden now. Therefore rays are traced once for each
//! map, independent of the number of scans since the last one.

use crate::azimuth_columns::round_to_whole;
use crate::sensor::rays::Rays;
use crate::wide::run_wide;

use super::azimuth_bins::{AzimuthBins, BINS, around, neighbour};
use super::bits::{any_bit, bits_of_word, set_bits};
use super::chunk::{CHUNK, Chunk, FillChunk, between, least};
use super::config::{CLEAR_HEIGHT_M_MAX, CLEAR_HEIGHT_M_MIN, OccupancyConfig};
use super::ray::Ray;
use super::states::{HIDDEN, LOOKED_AT, THROUGH};
use super::window::Window;

/// Number of steps after which a bin is traced as two rays. Ours: at 112 cells a bin is half a cell wide.
const FORK: usize = 112;
/// Depth below the ground, metres, at which a return is a mirror image, and how much more a metre of range allows; its
/// ray proves nothing. Ours; not tuned.
const BELOW_M: f32 = 0.3;
const BELOW_A_METRE: f32 = 0.01;
/// Nearest hit of a bin without hits.
const NONE: u16 = u16::MAX;

/// A return from the ground.
#[derive(Clone)]
struct Ground {
    bin: u16,
    /// Step at which the ray comes below the clearance.
    from: u16,
    /// Step at which the ray is too low to prove anything.
    low: u16,
    /// Step after the return.
    end: u16,
}

/// The newest scans of all sensors.
#[derive(Clone)]
pub struct PolarScans {
    azimuths: AzimuthBins,
    scans: Vec<PolarScan>,
    /// Evidence of one traced ray, step by step; reused.
    evidence: Vec<u8>,
}

/// The newest scan of one sensor, by azimuth bin.
#[derive(Clone)]
struct PolarScan {
    sensor: u16,
    /// True if the scan arrived since the last map.
    fresh: bool,
    /// End of the scan, ns since the Unix epoch.
    stamp_ns: i64,
    /// Position of the sensor, in cells of the world.
    origin: [f64; 2],
    /// Heading of the ego frame in the window's axes, radians.
    yaw_rad: f64,
    /// True by bin if it has rays.
    present: Vec<bool>,
    /// Step of the nearest hit by bin.
    nearest_hit: Vec<u16>,
    /// One bit for each step of each bin, set if a ray is low there.
    low: Vec<u64>,
    /// One bit for each step of each bin, set if a hit is there.
    hits: Vec<u64>,
    /// As `low`, for steps behind the nearest hit.
    proved: Vec<u64>,
    ground: Vec<Ground>,
}

impl PolarScans {
    /// Polar scans for a window whose far corner is `reach_m` from a sensor.
    pub fn new(reach_m: f32, cell_m: f32) -> Self {
        let azimuths = AzimuthBins::new(reach_m, cell_m);
        Self { evidence: vec![0; azimuths.steps], azimuths, scans: Vec::new() }
    }

    /// Replaces the last scan of a sensor, and counts the hits in the window, which must have moved to the vehicle.
    pub fn insert(&mut self, rays: &Rays<'_>, config: &OccupancyConfig, window: &mut Window) {
        let known = self.scans.iter().position(|scan| scan.sensor == rays.sensor);
        let index = known.unwrap_or_else(|| {
            self.scans.push(PolarScan::new(rays.sensor, &self.azimuths));
            self.scans.len() - 1
        });
        let scan = &mut self.scans[index];
        scan.clear(&self.azimuths);
        scan.set_sensor_pose(rays, config, window);
        scan.insert_returns(rays, config, &self.azimuths, window);
        scan.insert_no_returns(rays, config, &self.azimuths);
    }

    /// Removes the evidence of all scans.
    pub fn clear(&mut self) {
        self.scans.iter_mut().for_each(|scan| scan.fresh = false);
    }

    /// Adds the evidence of the scans since the last map, and since `earliest_ns`, to each cell of the window, row by
    /// row. Returns true if there was any such scan.
    pub fn write_evidence(
        &mut self,
        config: &OccupancyConfig,
        earliest_ns: i64,
        window: &Window,
        of_cell: &mut [u8],
    ) -> bool {
        self.scans.iter_mut().filter(|scan| scan.stamp_ns < earliest_ns).for_each(|scan| scan.fresh = false);
        let mut any = false;
        for scan in self.scans.iter_mut().filter(|scan| scan.fresh) {
            scan.prove_ground(&self.azimuths);
            scan.trace(config, &self.azimuths, window, &mut self.evidence, of_cell);
            (scan.fresh, any) = (false, true);
        }
        any
    }
}

impl PolarScan {
    /// An empty scan.
    fn new(sensor: u16, azimuths: &AzimuthBins) -> Self {
        let bits = || vec![0; BINS * azimuths.words];
        Self {
            sensor,
            fresh: false,
            stamp_ns: 0,
            origin: [0.0; 2],
            yaw_rad: 0.0,
            present: vec![false; BINS],
            nearest_hit: vec![NONE; BINS],
            low: bits(),
            hits: bits(),
            proved: bits(),
            ground: Vec::new(),
        }
    }

    /// Removes all rays.
    fn clear(&mut self, azimuths: &AzimuthBins) {
        for bin in (0..BINS).filter(|bin| self.present[*bin]) {
            for bits in [&mut self.low, &mut self.hits, &mut self.proved] {
                bits[azimuths.row(bin)].fill(0);
            }
        }
        self.present.fill(false);
        self.nearest_hit.fill(NONE);
        self.ground.clear();
    }

    /// Sets the position of the sensor in the world, from the pose of the window.
    fn set_sensor_pose(&mut self, rays: &Rays<'_>, config: &OccupancyConfig, window: &Window) {
        let (pose, corner) = (window.ego_pose(), window.corner());
        let (sin, cos) = libm::sincos(pose.yaw_rad);
        let [x, y] = [rays.origin_m[0], rays.origin_m[1]].map(|metres| f64::from(metres / config.cell_m));
        let from = [pose.cells[0] + x * cos - y * sin, pose.cells[1] + x * sin + y * cos];
        self.origin = [0, 1].map(|i| corner[i] as f64 + from[i]);
        (self.yaw_rad, self.fresh, self.stamp_ns) = (pose.yaw_rad, true, rays.stamp_ns);
    }

    /// Inserts the returns of a scan.
    fn insert_returns(
        &mut self,
        rays: &Rays<'_>,
        config: &OccupancyConfig,
        azimuths: &AzimuthBins,
        window: &mut Window,
    ) {
        let range_max = config.range_m_max / config.cell_m;
        let window_from_ego = window.window_from_ego();
        let sweep = rays.returns;
        let mut chunk = Chunk::default();
        let origin = [rays.origin_m[0], rays.origin_m[1], rays.origin_height_m];
        let chunks = sweep.x.chunks(CHUNK).zip(sweep.y.chunks(CHUNK)).zip(rays.heights_m.chunks(CHUNK));
        for ((xs, ys), zs) in chunks {
            run_wide(FillChunk { chunk: &mut chunk, points: [xs, ys, zs], origin_m: origin, config, azimuths });
            for (i, ((&x, &y), &z)) in xs.iter().zip(ys).zip(zs).enumerate() {
                let (bin, range) = (chunk.bin[i] as usize, chunk.range[i]);
                self.present[bin] = true;
                if z.is_nan() || z < -BELOW_M - BELOW_A_METRE * config.cell_m * range {
                    continue;
                }
                let row = azimuths.row(bin);
                set_bits(&mut self.low[row.clone()], chunk.first[i] as usize, chunk.end[i] as usize);
                if range > range_max || range.is_nan() || z >= config.overhang_m {
                    continue;
                }
                let step = chunk.step[i] as u16;
                let inside = usize::from(step) < azimuths.steps;
                if z >= CLEAR_HEIGHT_M_MIN {
                    if z >= config.clearance_m {
                        window.record_hit(window_from_ego.apply(x, y));
                    }
                    self.record_hit(bin, step, azimuths);
                } else if inside {
                    let [from, low] = [chunk.under[i], chunk.low[i]].map(|value| value as u16);
                    self.ground.push(Ground { bin: bin as u16, from, low, end: step + 1 });
                }
            }
        }
    }

    /// Records a hit at a step of a bin.
    #[inline(always)]
    fn record_hit(&mut self, bin: usize, step: u16, azimuths: &AzimuthBins) {
        self.nearest_hit[bin] = self.nearest_hit[bin].min(step);
        if usize::from(step) < azimuths.steps {
            self.hits[bin * azimuths.words + usize::from(step) / 64] |= 1 << (step % 64);
        }
    }

    /// Inserts the rays without a return.
    fn insert_no_returns(&mut self, rays: &Rays<'_>, config: &OccupancyConfig, azimuths: &AzimuthBins) {
        let farthest = config.no_return_m.min(config.range_m_max) / config.cell_m;
        for &[dx, dy, dz] in rays.no_returns {
            let bin = azimuths.columns.column(dx, dy) as usize;
            self.present[bin] = true;
            let steps_a_m = (dx * dx + dy * dy).sqrt() / dz / config.cell_m;
            let height = |height_m: f32| (height_m - rays.origin_height_m) * steps_a_m;
            let (from, to) = between(height(CLEAR_HEIGHT_M_MIN), height(CLEAR_HEIGHT_M_MAX));
            let steps = azimuths.steps as f32;
            let (first, end) = (round_to_whole(least(from, steps)), round_to_whole(least(to, least(farthest, steps))));
            set_bits(&mut self.low[azimuths.row(bin)], first as usize, end as usize);
        }
    }

    /// Step of the nearest hit of a bin and the bins beside it.
    fn nearest(&self, bin: usize) -> usize {
        let nearest = around(bin).map(|bin| self.nearest_hit[bin]).min();
        usize::from(nearest.unwrap_or(NONE))
    }

    /// Marks the steps behind the nearest hit that returns from the ground prove free.
    fn prove_ground(&mut self, azimuths: &AzimuthBins) {
        let nearest: [usize; BINS] = std::array::from_fn(|bin| self.nearest(bin));
        for &Ground { bin, from, low, end } in &self.ground {
            let (bin, from, low, end) = (usize::from(bin), usize::from(from), usize::from(low), usize::from(end));
            if low <= nearest[bin] {
                continue;
            }
            let mut rows = around(bin).map(|bin| &self.hits[azimuths.row(bin)]);
            if !rows.any(|row| any_bit(row, from, end)) {
                set_bits(&mut self.proved[azimuths.row(bin)], from, low);
            }
        }
    }

    /// Traces the rays of all bins, and adds their evidence to the cells. `of_step` is a buffer.
    fn trace(
        &self,
        config: &OccupancyConfig,
        azimuths: &AzimuthBins,
        window: &Window,
        of_step: &mut [u8],
        of_cell: &mut [u8],
    ) {
        let corner = window.corner();
        let from = [0, 1].map(|i| self.origin[i] - corner[i] as f64);
        let (sin, cos) = libm::sincos(self.yaw_rad);
        let reach = ((config.range_m_max / config.cell_m) as usize).min(azimuths.steps);
        if !from.iter().all(|cells| (0.0..window.side() as f64).contains(cells)) {
            return;
        }
        for bin in (0..BINS).filter(|bin| self.has_view(*bin)) {
            self.evidence_of(bin, azimuths, of_step);
            for (line, &[x, y]) in azimuths.lines[bin].iter().enumerate() {
                let ray = Ray::new(from, [x * cos - y * sin, x * sin + y * cos], window.side());
                let near = reach.min(FORK);
                let steps = if line == 0 { 0..ray.steps(near) } else { near..ray.steps(reach).max(near) };
                ray.write_evidence(steps, of_step, of_cell);
            }
        }
    }

    /// True if a bin, or both bins beside it, have rays: rays farther apart than a bin is wide leave each second bin
    /// empty.
    fn has_view(&self, bin: usize) -> bool {
        self.present[bin] || self.present[neighbour(bin, -1)] && self.present[neighbour(bin, 1)]
    }

    /// Writes the evidence of a bin into `of_step`, step by step.
    fn evidence_of(&self, bin: usize, azimuths: &AzimuthBins, of_step: &mut [u8]) {
        let nearest = self.nearest(bin);
        let (seen, hidden) = of_step.split_at_mut(nearest.min(azimuths.steps));
        seen.fill(LOOKED_AT);
        hidden.fill(LOOKED_AT | HIDDEN);
        let [own, right, left] = [0, -1, 1].map(|beside| azimuths.row(neighbour(bin, beside)).start);
        for (word, evidence) in of_step.chunks_exact_mut(64).enumerate() {
            // In an empty bin a step is low if it is low in both bins beside it.
            let (low, proved) = match self.present[bin] {
                true => (self.low[own + word], self.proved[own + word]),
                false => (self.low[right + word] & self.low[left + word], 0),
            };
            let before = bits_of_word(word, 0, nearest);
            let mut free = low & before | proved & !before;
            while free != 0 {
                let first = free.trailing_zeros() as usize;
                let end = first + (!(free >> first)).trailing_zeros() as usize;
                evidence[first..end].fill(LOOKED_AT | THROUGH);
                free &= !bits_of_word(0, first, end);
            }
        }
    }
}
