//! The ground of the newest map, and what the vehicle can reach on it.
//!
//! In: the points of each map. Out: [`Ground`] and [`Reach`] for the layers of the map; and the rays of each scan with
//! their heights over that ground, for layers that gather evidence between two maps.

use nalgebra::{Isometry3, Point3};

use crate::fusion::MergedScans;
use crate::ground::Ground;
use crate::ground::config::Variant;
use crate::layer::registry::MapsConfig;
use crate::memory::{Memory, MemoryState};
use crate::reach::Reach;
use crate::sensor::rays::{Rays, ScanExtras};
use crate::sensor::scan::SensorScan;
use crate::sensor::sweep::Sweep;

/// The ground of the newest map.
#[derive(Clone)]
pub(crate) struct MapGround {
    /// `None` if heights are taken over the plane under the vehicle.
    estimates: Option<Estimates>,
    /// True once the ground of a map was estimated.
    is_known: bool,
    /// Sensor and number of the scan whose points are all the points of the map; `None` for a map of several scans.
    sole_scan: Option<(u16, u64)>,
    /// Heights of the newest scan's points over the ground, metres.
    scan_heights_m: Vec<f32>,
}

#[derive(Clone)]
struct Estimates {
    ground: Ground,
    reach: Reach,
    /// `None` if the configuration disables it.
    memory: Option<Memory>,
    /// Ego frame of the ground in the world frame; `None` if no pose was near enough.
    map_from_ground: Option<Isometry3<f64>>,
}

impl MapGround {
    /// The ground before the first map.
    pub fn new(maps: &MapsConfig) -> Self {
        let estimates = || Estimates {
            ground: Ground::new(maps.reach.outline()),
            reach: Reach::new(&maps.reach),
            memory: Memory::new(&maps.memory),
            map_from_ground: None,
        };
        let estimates = (maps.ground.variant == Variant::Local).then(estimates);
        Self { estimates, is_known: false, sole_scan: None, scan_heights_m: Vec::new() }
    }

    /// Estimates the ground of a map from its points and the remembered ones, and what the vehicle can reach on it, as
    /// far as layers use them. `scan` is the newest scan of the map's source.
    pub fn estimate(&mut self, merged: &MergedScans, scan: &SensorScan, uses: ScanExtras) {
        if !uses.ground {
            return;
        }
        let sweep = &*merged.sweep;
        self.sole_scan = merged.sole_scan.map(|number| (merged.source as u16, number));
        if let Some(Estimates { ground, reach, memory, map_from_ground }) = &mut self.estimates {
            match memory {
                None => ground.estimate(sweep),
                Some(memory) => {
                    memory.extend(sweep, scan.map_from_ego.as_ref(), scan.end_ns);
                    ground.estimate(memory.extended(sweep));
                    memory.remember(ground.heights_m());
                }
            }
            reach.update(memory.as_ref().map_or(sweep, |memory| memory.extended(sweep)), ground);
            if uses.reached {
                reach.flood();
            }
            (*map_from_ground, self.is_known) = (scan.map_from_ego, true);
        }
    }

    /// Forgets which scan alone gave the ground: another sensor may get its index.
    pub fn forget_scan(&mut self) {
        self.sole_scan = None;
    }

    /// The points of the newest map and the remembered ones; `own` are the former alone.
    pub fn sweep<'a>(&'a self, own: &'a Sweep) -> &'a Sweep {
        let estimates = self.estimates.as_ref().filter(|_| self.is_known);
        estimates.and_then(|estimates| estimates.memory.as_ref()).map_or(own, |memory| memory.extended(own))
    }

    /// What the newest map got from memory; `None` without a memory.
    pub fn memory(&self) -> Option<MemoryState> {
        Some(self.estimates.as_ref()?.memory.as_ref()?.state())
    }

    /// The local ground of the newest map.
    pub fn ground(&self) -> Option<&Ground> {
        self.estimates.as_ref().filter(|_| self.is_known).map(|estimates| &estimates.ground)
    }

    /// What the vehicle can reach on it.
    pub fn reach(&self) -> Option<&Reach> {
        self.estimates.as_ref().filter(|_| self.is_known).map(|estimates| &estimates.reach)
    }

    /// The rays of a scan with their heights over the ground of the newest map, which the vehicle may have left since.
    /// Before the first map they are heights over the plane under the vehicle.
    pub fn rays<'a>(&'a mut self, scan: &'a SensorScan, sensor: u16) -> Rays<'a> {
        let rays = scan.rays(sensor);
        let Some(Estimates { ground, map_from_ground, .. }) = self.estimates.as_ref().filter(|_| self.is_known) else {
            return rays;
        };
        if self.sole_scan == Some((sensor, scan.completed)) {
            let [x, y, z] = scan.origin_m;
            let heights_m = &ground.heights_m()[..scan.sweep.x.len()];
            return Rays { heights_m, origin_height_m: z - ground.height_m(x, y), ..rays };
        }
        let poses = map_from_ground.zip(scan.map_from_ego).filter(|(from, to)| from != to);
        let ground_from_ego = poses.map(|(from, to)| from.inv_mul(&to).cast::<f32>());
        ground.measure(&scan.sweep, ground_from_ego.as_ref(), &mut self.scan_heights_m);
        let origin = ground_from_ego.unwrap_or_else(Isometry3::identity) * Point3::from(scan.origin_m);
        let origin_height_m = origin.z - ground.height_m(origin.x, origin.y);
        Rays { heights_m: &self.scan_heights_m, origin_height_m, ..rays }
    }
}
