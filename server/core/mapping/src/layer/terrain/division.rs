//! The hierarchical division of a square grid (Neuhaus 2009, section 2.3): the whole grid, then two pieces along the
//! longest axis again and again, down to one cell. Or quarters: every second of these cuts, of a square whose side is a
//! power of two; then a world rotated by 90 degrees is divided alike.
//!
//! In: the number of cells along a side. Out: [`Region`]s, and an order of all cells in which each region is a range.
//! Where to cut does not depend on the points, so that the order is computed once.

/// The regions of a division that are judged.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Division {
    /// The whole grid, and every piece of it (Neuhaus 2009, section 2.3).
    Halves,
    /// The least square around the grid whose side is a power of two, and its quarters, their quarters, and so on.
    Quarters,
}

impl Division {
    /// Number of cells along a side of the square that is divided, for a grid with `width` cells along a side.
    pub fn side(self, width: u32) -> u32 {
        match self {
            Self::Halves => width,
            Self::Quarters => width.next_power_of_two(),
        }
    }

    /// True if a region is judged; a region that is not is only divided again.
    pub fn judges(self, region: &Region) -> bool {
        self == Self::Halves || region.width == region.height
    }
}

/// A rectangle of cells of the division.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Region {
    /// Index of the first column.
    pub x: u32,
    /// Index of the first row.
    pub y: u32,
    /// Number of columns, at least 1.
    pub width: u32,
    /// Number of rows, at least 1.
    pub height: u32,
    /// Rank of the region's first cell in the order of the division; the region's cells have the ranks from here on.
    pub rank: u32,
}

impl Region {
    /// The whole grid.
    pub fn whole(side: u32) -> Self {
        Self { x: 0, y: 0, width: side, height: side, rank: 0 }
    }

    /// Number of cells.
    pub fn cells(&self) -> u32 {
        self.width * self.height
    }

    /// The two pieces along the longest axis, along x if both are equal; `None` for a single cell. The first piece of
    /// an odd number of cells is the smaller one.
    pub fn halves(&self) -> Option<[Self; 2]> {
        if self.cells() == 1 {
            return None;
        }
        let mut halves = [*self; 2];
        if self.width >= self.height {
            halves[0].width = self.width / 2;
            halves[1].width = self.width - halves[0].width;
            halves[1].x = self.x + halves[0].width;
        } else {
            halves[0].height = self.height / 2;
            halves[1].height = self.height - halves[0].height;
            halves[1].y = self.y + halves[0].height;
        }
        halves[1].rank = self.rank + halves[0].cells();
        Some(halves)
    }
}

/// Index of the cell of each rank: row * side + column.
pub fn cell_of_rank(side: u32) -> Vec<u32> {
    let mut cells = Vec::with_capacity((side * side) as usize);
    let mut waiting = vec![Region::whole(side)];
    while let Some(region) = waiting.pop() {
        match region.halves() {
            Some([first, second]) => waiting.extend([second, first]),
            None => cells.push(region.y * side + region.x),
        }
    }
    cells
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_region_is_cut_in_two_along_its_longest_axis() {
        let whole = Region::whole(400);
        let [left, right] = whole.halves().unwrap();
        assert_eq!(left, Region { width: 200, ..whole });
        assert_eq!(right, Region { x: 200, width: 200, rank: 80_000, ..whole });
        let [lower, upper] = right.halves().unwrap();
        assert_eq!(lower, Region { height: 200, ..right });
        assert_eq!(upper, Region { y: 200, height: 200, rank: 120_000, ..right });
        let odd = Region { x: 3, y: 5, width: 3, height: 7, rank: 10 };
        assert_eq!(odd.halves().unwrap(), [Region { height: 3, ..odd }, Region { y: 8, height: 4, rank: 19, ..odd }]);
        assert_eq!(Region { width: 1, height: 1, ..odd }.halves(), None);
    }

    #[test]
    fn the_cells_of_a_region_are_a_range_of_the_order() {
        for side in [1, 2, 7, 50, 100] {
            let order = cell_of_rank(side);
            let mut sorted = order.clone();
            sorted.sort_unstable();
            assert!(sorted.iter().copied().eq(0..side * side), "each cell once");
            let mut waiting = vec![Region::whole(side)];
            while let Some(region) = waiting.pop() {
                let ranks = region.rank as usize..(region.rank + region.cells()) as usize;
                assert!(order[ranks].iter().all(|cell| {
                    (region.x..region.x + region.width).contains(&(cell % side))
                        && (region.y..region.y + region.height).contains(&(cell / side))
                }));
                waiting.extend(region.halves().into_iter().flatten());
            }
        }
    }
}
