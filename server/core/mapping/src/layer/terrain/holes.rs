//! Narrow holes in seen flat ground, which are inferred to be flat. Not in the paper.
//!
//! In: by cell whether it is flat, whether it may be filled, and whether it ends a hole. Out: the cells of holes. A
//! region of the division may extend far beyond the last point in it: only cells between two seen flat cells a short
//! distance apart are inferred; all others are unknown.

/// What a cell does to a hole.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// A hole begins or ends here.
    Flat,
    /// The cell may lie in a hole.
    Fillable,
    /// No hole continues over the cell.
    Barrier,
}

/// The cells of holes, and the buffers to find them.
#[derive(Clone, Debug, Default)]
pub struct Holes {
    cells: Vec<u32>,
    is_listed: Vec<bool>,
    /// By column: the flat cell after which only cells that may be filled came.
    last_in_column: Vec<Option<u32>>,
}

impl Holes {
    /// Finds the cells between two flat cells of a row or column of a grid of `width` × `width` cells, with at most
    /// `span` cells between them. `roles` are the roles of cells in ascending order; all other cells may be filled.
    pub fn find(&mut self, width: usize, span: usize, roles: impl Iterator<Item = (usize, Role)>) {
        self.cells.clear();
        self.is_listed.clear();
        self.is_listed.resize(width * width, false);
        self.last_in_column.clear();
        self.last_in_column.resize(width, None);
        let (mut row, mut last_in_row) = (0, None);
        for (cell, role) in roles {
            if cell >= row + width {
                (row, last_in_row) = (cell - cell % width, None);
            }
            match role {
                Role::Fillable => {}
                Role::Barrier => (last_in_row, self.last_in_column[cell - row]) = (None, None),
                Role::Flat => {
                    self.list(last_in_row, cell, 1, span);
                    self.list(self.last_in_column[cell - row], cell, width, span);
                    (last_in_row, self.last_in_column[cell - row]) = (Some(cell as u32), Some(cell as u32));
                }
            }
        }
    }

    /// Lists the cells between two flat ones, if they are few enough.
    fn list(&mut self, from: Option<u32>, to: usize, stride: usize, span: usize) {
        let from = from.map(|from| from as usize);
        let Some(from) = from.filter(|from| to - from <= (span + 1) * stride) else { return };
        for cell in (from + stride..to).step_by(stride) {
            if !std::mem::replace(&mut self.is_listed[cell], true) {
                self.cells.push(cell as u32);
            }
        }
    }

    /// Indices of the cells of holes, each once.
    pub fn cells(&self) -> &[u32] {
        &self.cells
    }
}
