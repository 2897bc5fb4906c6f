//! Beyond the paper: which flat regions are ground the vehicle stands on, and how far seen ground speaks for holes.
//!
//! In: flat regions with their planes, cells that hold points. Out: by region whether it joins the ground under the
//! vehicle without a step; by cell whether it is a hole narrow enough to be filled. A car's roof is as flat as a road; what tells
//! them apart is the step between. A region of the division may reach far beyond the last point in it; what lies
//! between two seen cells a short way apart is inferred, what lies beyond is unknown.

use crate::config::TerrainConfig;

use super::moments::Cells;
use super::regions::{FIRST_FLAT, Regions};

/// Joined regions, and filled holes.
#[derive(Clone, Debug, Default)]
pub struct Ground {
    /// Forest of regions; node 0 is the ground under the vehicle, node `1 + i` region `i`.
    parent: Vec<u32>,
    joined: Vec<bool>,
    inferred: Vec<bool>,
    /// In the row being walked, by column: row of the nearest seen ground before.
    last_in_column: Vec<u32>,
}

impl Ground {
    /// Joins regions and fills holes; `seen` tells by cell whether a point fell into it.
    pub fn find(&mut self, cells: &Cells, regions: &Regions, seen: &[bool], config: &TerrainConfig) {
        self.parent.clear();
        self.parent.extend(0..=regions.planes().len() as u32);
        self.start_under_the_vehicle(cells, regions, seen, config);
        self.join_neighbours(cells, regions, config);
        self.joined.clear();
        for node in 1..self.parent.len() as u32 {
            let joined = self.root(node) == self.root(0);
            self.joined.push(joined);
        }
        self.fill_holes(cells, regions, seen, config);
    }

    /// Seen cells in the blind zone that are about as high as the ground under the vehicle.
    fn start_under_the_vehicle(&mut self, cells: &Cells, regions: &Regions, seen: &[bool], config: &TerrainConfig) {
        let (width, margin) = (cells.width(), cells.margin());
        let reach = ((config.blind_zone_m / cells.cell_m()).ceil() as usize).min(width / 2);
        let near = width / 2 - reach..width / 2 + reach;
        for iy in near.clone() {
            for ix in near.clone() {
                let cell = iy * width + ix;
                let region = regions.of_cell()[cell];
                if !seen[cell] || region < FIRST_FLAT {
                    continue;
                }
                let (x, y) = (cells.centre_m(ix + margin), cells.centre_m(iy + margin));
                let height = regions.planes()[(region - FIRST_FLAT) as usize].height_m(x, y);
                if x * x + y * y <= config.blind_zone_m * config.blind_zone_m && height.abs() <= config.start_m_max {
                    self.join(0, region - FIRST_FLAT + 1);
                }
            }
        }
    }

    /// Flat regions that touch, and whose planes meet there without a step.
    fn join_neighbours(&mut self, cells: &Cells, regions: &Regions, config: &TerrainConfig) {
        let (width, margin) = (cells.width(), cells.margin());
        let (of_cell, planes) = (regions.of_cell(), regions.planes());
        for iy in 0..width {
            for ix in 0..width {
                let here = of_cell[iy * width + ix];
                if here < FIRST_FLAT {
                    continue;
                }
                let (x, y) = (cells.centre_m(ix + margin), cells.centre_m(iy + margin));
                let half = cells.cell_m() / 2.0;
                let ahead = if ix + 1 < width { of_cell[iy * width + ix + 1] } else { here };
                let beside = if iy + 1 < width { of_cell[(iy + 1) * width + ix] } else { here };
                for (other, x, y) in [(ahead, x + half, y), (beside, x, y + half)] {
                    if other == here || other < FIRST_FLAT {
                        continue;
                    }
                    let height = |region: u32| planes[(region - FIRST_FLAT) as usize].height_m(x, y);
                    if (height(here) - height(other)).abs() <= config.step_m_max {
                        self.join(here - FIRST_FLAT + 1, other - FIRST_FLAT + 1);
                    }
                }
            }
        }
    }

    fn root(&mut self, mut node: u32) -> u32 {
        while self.parent[node as usize] != node {
            let above = self.parent[self.parent[node as usize] as usize];
            self.parent[node as usize] = above;
            node = above;
        }
        node
    }

    fn join(&mut self, a: u32, b: u32) {
        let (a, b) = (self.root(a), self.root(b));
        // The smaller number is the root: the ground under the vehicle stays one.
        self.parent[a.max(b) as usize] = a.min(b);
    }

    /// Along every row and every column: unseen cells of joined regions between two seen ones at most a span apart.
    fn fill_holes(&mut self, cells: &Cells, regions: &Regions, seen: &[bool], config: &TerrainConfig) {
        const NONE: u32 = u32::MAX;
        let width = cells.width();
        let span = (config.inference_m_max / cells.cell_m()).round() as usize;
        self.inferred.clear();
        self.inferred.resize(width * width, false);
        self.last_in_column.clear();
        self.last_in_column.resize(width, NONE);
        let of_cell = regions.of_cell();
        let is_ground = |region: u32| region >= FIRST_FLAT && self.joined[(region - FIRST_FLAT) as usize];
        for iy in 0..width {
            let mut last_in_row = NONE;
            for ix in 0..width {
                let cell = iy * width + ix;
                if !seen[cell] {
                    continue;
                }
                if !is_ground(of_cell[cell]) {
                    // Whatever stands there ends the hole.
                    (last_in_row, self.last_in_column[ix]) = (NONE, NONE);
                    continue;
                }
                let (row, column) = (last_in_row, self.last_in_column[ix]);
                if row != NONE && ix - row as usize - 1 <= span {
                    (row as usize + 1..ix).for_each(|x| self.inferred[iy * width + x] |= is_ground(of_cell[iy * width + x]));
                }
                if column != NONE && iy - column as usize - 1 <= span {
                    (column as usize + 1..iy).for_each(|y| self.inferred[y * width + ix] |= is_ground(of_cell[y * width + ix]));
                }
                (last_in_row, self.last_in_column[ix]) = (ix as u32, iy as u32);
            }
        }
    }

    /// By flat region: whether it joins the ground under the vehicle.
    pub fn joined(&self) -> &[bool] {
        &self.joined
    }

    /// By cell: whether it lies in a hole of seen ground.
    pub fn inferred(&self) -> &[bool] {
        &self.inferred
    }
}
