//! Which flat regions join the ground under the vehicle, and which holes in that ground are inferred. Not in the paper.
//!
//! In: flat regions with their planes, cells with points. Out: by region whether it joins the ground under the vehicle
//! without a step; by cell whether it lies in a hole narrow enough to be filled. A car's roof is as flat as a road; the
//! step between them tells them apart. A region of the division may extend far beyond the last point in it: only cells
//! between two seen cells a short distance apart are inferred; all others are unknown.

use super::config::TerrainConfig;
use super::moments::Cells;
use super::regions::{FIRST_FLAT, NOT_JUDGED, Plane, Regions};

/// Joined regions, and filled holes.
#[derive(Clone, Debug, Default)]
pub struct Ground {
    /// Union-find forest of regions: node 0 is the ground under the vehicle, node `1 + i` is region `i`.
    parent: Vec<u32>,
    /// By region.
    joined: Vec<bool>,
    /// Indices of the filled cells, each once.
    filled: Vec<u32>,
    /// By cell: true if it is in `filled`.
    is_filled: Vec<bool>,
    /// By cell.
    bridged: Vec<bool>,
    /// Indices of the cells with points, ascending.
    seen_cells: Vec<u32>,
}

impl Ground {
    /// Joins regions and fills holes. `seen` is true by cell if a point fell into it.
    pub fn join_and_fill(&mut self, cells: &Cells, regions: &Regions, seen: &[bool], config: &TerrainConfig) {
        self.parent.clear();
        self.parent.extend(0..=regions.planes().len() as u32);
        self.start_under_the_vehicle(cells, regions, seen, config);
        self.join_neighbours(cells, regions, config);
        self.seen_cells.clear();
        self.seen_cells.extend((0..seen.len() as u32).filter(|cell| seen[*cell as usize]));
        self.join_over_gaps(cells, regions, seen, config);
        self.joined.clear();
        for node in 1..self.parent.len() as u32 {
            let joined = self.root(node) == self.root(0);
            self.joined.push(joined);
        }
        self.fill_holes(cells, regions, seen, config);
    }

    /// Joins the regions of seen cells in the blind zone that are about as high as the ground under the vehicle.
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

    /// Joins flat regions that touch, if their planes meet there without a step.
    fn join_neighbours(&mut self, cells: &Cells, regions: &Regions, config: &TerrainConfig) {
        let (width, margin) = (cells.width() as u32, cells.margin());
        let (of_cell, planes) = (regions.of_cell(), regions.planes());
        // Each region compares itself across its right and upper sides; the other two belong to its neighbours.
        for (here, &[left, low, right, high]) in regions.extents().iter().enumerate() {
            let ahead = (low..high).filter(|_| right < width).map(|iy| (right, iy, -0.5, 0.0));
            let beside = (left..right).filter(|_| high < width).map(|ix| (ix, high, 0.0, -0.5));
            let mut last = NOT_JUDGED;
            for (ix, iy, dx, dy) in ahead.chain(beside) {
                let other = of_cell[(iy * width + ix) as usize];
                if other < FIRST_FLAT {
                    continue;
                }
                let (x, y) = (cells.centre_m(ix as usize + margin), cells.centre_m(iy as usize + margin));
                let (x, y) = (x + dx * cells.cell_m(), y + dy * cells.cell_m());
                let step = planes[here].height_m(x, y) - planes[(other - FIRST_FLAT) as usize].height_m(x, y);
                if other != last && step.abs() <= config.step_m_max {
                    self.join(here as u32 + 1, other - FIRST_FLAT + 1);
                    last = other;
                }
            }
        }
    }

    /// Root of a node's tree.
    fn root(&mut self, mut node: u32) -> u32 {
        while self.parent[node as usize] != node {
            let above = self.parent[self.parent[node as usize] as usize];
            self.parent[node as usize] = above;
            node = above;
        }
        node
    }

    /// Joins the trees of two nodes.
    fn join(&mut self, a: u32, b: u32) {
        let (a, b) = (self.root(a), self.root(b));
        // The smaller number becomes the root, so that node 0 stays a root.
        self.parent[a.max(b) as usize] = a.min(b);
    }

    /// Joins flat regions along rows and columns that have only unseen cells between them, as the rings of far ground
    /// do, if their planes meet half-way without a step.
    fn join_over_gaps(&mut self, cells: &Cells, regions: &Regions, seen: &[bool], config: &TerrainConfig) {
        let seen_cells = std::mem::take(&mut self.seen_cells);
        self.bridged.clear();
        self.bridged.resize(seen.len(), false);
        let view = View { cells, regions, seen, seen_cells: &seen_cells, config };
        let span = (config.bridge_m_max / cells.cell_m()).round() as usize;
        view.for_each_hole(
            span,
            |region| region >= FIRST_FLAT,
            |hole| {
                if view.step_m(hole.from, hole.to) <= config.step_m_max {
                    let node = |cell: usize| regions.of_cell()[cell] - FIRST_FLAT + 1;
                    self.join(node(hole.from), node(hole.to));
                    hole.within().for_each(|cell| self.bridged[cell] = true);
                }
            },
        );
        self.seen_cells = seen_cells;
    }

    /// Fills cells along rows and columns between two seen cells of the ground: unseen cells of its regions, and seen
    /// cells with too few points that lie on it.
    fn fill_holes(&mut self, cells: &Cells, regions: &Regions, seen: &[bool], config: &TerrainConfig) {
        let view = View { cells, regions, seen, seen_cells: &self.seen_cells, config };
        let (joined, of_cell) = (&self.joined, regions.of_cell());
        let is_ground = |region: u32| region >= FIRST_FLAT && joined[(region - FIRST_FLAT) as usize];
        self.filled.clear();
        self.is_filled.clear();
        self.is_filled.resize(seen.len(), false);
        let (filled, is_filled) = (&mut self.filled, &mut self.is_filled);
        let span = (config.inference_m_max / cells.cell_m()).round() as usize;
        view.for_each_hole(span, is_ground, |hole| {
            for cell in hole.within() {
                if !is_filled[cell] && (seen[cell] || is_ground(of_cell[cell])) {
                    is_filled[cell] = true;
                    filled.push(cell as u32);
                }
            }
        });
    }

    /// True by flat region if it joins the ground under the vehicle.
    pub fn joined(&self) -> &[bool] {
        &self.joined
    }

    /// Indices of the cells in holes of seen ground: unseen cells, or seen cells with too few points to be judged.
    pub fn filled(&self) -> &[u32] {
        &self.filled
    }

    /// True by cell if it lies in a gap across which two regions were joined.
    pub fn bridged(&self) -> &[bool] {
        &self.bridged
    }
}

/// Two cells of one row or column, and the cells between them.
struct Hole {
    from: usize,
    to: usize,
    stride: usize,
}

impl Hole {
    /// Indices of the cells between the two.
    fn within(&self) -> impl Iterator<Item = usize> + use<> {
        (self.from + self.stride..self.to).step_by(self.stride)
    }
}

/// The cells and regions of one map, for the search of holes.
struct View<'a> {
    cells: &'a Cells,
    regions: &'a Regions,
    seen: &'a [bool],
    /// Indices of the seen cells, ascending.
    seen_cells: &'a [u32],
    config: &'a TerrainConfig,
}

impl View<'_> {
    /// Calls `visit` for each pair of neighbouring seen cells of a row or column whose regions are `of_ground`, with at
    /// most `span` cells between them. The cells between must be unseen, or their few points must lie on the planes of
    /// both.
    fn for_each_hole(&self, span: usize, of_ground: impl Fn(u32) -> bool, mut visit: impl FnMut(&Hole)) {
        const NONE: u32 = u32::MAX;
        let width = self.cells.width();
        let of_cell = self.regions.of_cell();
        let mut last_in_column = vec![NONE; width];
        let (mut row, mut last_in_row) = (0, NONE);
        for &cell in self.seen_cells {
            let (cell, region) = (cell as usize, of_cell[cell as usize]);
            if region == NOT_JUDGED {
                // A cell with too few points is checked at the end of its hole.
                continue;
            }
            let (iy, ix) = (cell / width, cell % width);
            if iy != row {
                (row, last_in_row) = (iy, NONE);
            }
            if !of_ground(region) {
                (last_in_row, last_in_column[ix]) = (NONE, NONE);
                continue;
            }
            for (last, stride) in [(last_in_row, 1), (last_in_column[ix], width)] {
                let apart = if last == NONE { 0 } else { cell - last as usize };
                if apart > stride && apart <= (span + 1) * stride {
                    let hole = Hole { from: last as usize, to: cell, stride };
                    if hole.within().all(|cell| !self.seen[cell] || self.lies_on_both(cell, &hole)) {
                        visit(&hole);
                    }
                }
            }
            (last_in_row, last_in_column[ix]) = (cell as u32, cell as u32);
        }
    }

    /// True if the points of a cell lie on the planes of both ends of a hole.
    fn lies_on_both(&self, cell: usize, hole: &Hole) -> bool {
        let (x, y) = self.indices(cell);
        let [lowest, highest] = self.cells.span_m(self.cells.slot_at(x, y));
        let (x, y) = (self.cells.centre_m(x), self.cells.centre_m(y));
        [hole.from, hole.to].into_iter().all(|end| {
            let height = self.plane(end).height_m(x, y);
            highest - height <= self.config.residual_m_max && height - lowest <= self.config.residual_m_max
        })
    }

    /// Step between the planes of two cells, half-way between them, metres.
    fn step_m(&self, from: usize, to: usize) -> f32 {
        let ((ax, ay), (bx, by)) = (self.indices(from), self.indices(to));
        let middle = |a: usize, b: usize| (self.cells.centre_m(a) + self.cells.centre_m(b)) / 2.0;
        let (x, y) = (middle(ax, bx), middle(ay, by));
        (self.plane(from).height_m(x, y) - self.plane(to).height_m(x, y)).abs()
    }

    /// Plane of a cell's flat region.
    fn plane(&self, cell: usize) -> Plane {
        self.regions.planes()[(self.regions.of_cell()[cell] - FIRST_FLAT) as usize]
    }

    /// Indices (x, y) of a cell of the grid in the division.
    fn indices(&self, cell: usize) -> (usize, usize) {
        let (width, margin) = (self.cells.width(), self.cells.margin());
        (cell % width + margin, cell / width + margin)
    }
}
