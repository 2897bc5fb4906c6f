//! The maps of a layer, in their order -> one picture of many, spread evenly over the drive.

use clearway_daemon::encode::picture::{Picture, PictureError};

/// Greatest number of pictures on a sheet; ours, because each is still told apart on a screen.
const PICTURES_MAX: usize = 24;
/// Pictures in a row of the sheet.
const COLUMNS: usize = 6;

/// A sheet that is being filled: every `stride`-th map of those that were pushed.
pub struct Sheet {
    pictures: Vec<Picture>,
    pushed: usize,
    stride: usize,
}

impl Default for Sheet {
    fn default() -> Self {
        Self { pictures: Vec::new(), pushed: 0, stride: 1 }
    }
}

impl Sheet {
    /// Adds a map; `draw` is called if it has a place on the sheet. If the sheet is full, every second picture leaves.
    ///
    /// # Errors
    /// The error of `draw`.
    pub fn push(&mut self, draw: impl FnOnce() -> Result<Picture, PictureError>) -> Result<(), PictureError> {
        if self.pushed.is_multiple_of(self.stride) {
            if self.pictures.len() == PICTURES_MAX {
                let mut index = 0;
                self.pictures.retain(|_| {
                    index += 1;
                    index % 2 == 1
                });
                self.stride *= 2;
            }
            // The number of pictures was even, so this map has a place on the thinner sheet too.
            self.pictures.push(draw()?);
        }
        self.pushed += 1;
        Ok(())
    }

    /// Number of maps on the sheet.
    pub fn shown(&self) -> usize {
        self.pictures.len()
    }

    /// The sheet.
    pub fn finish(self) -> Picture {
        Picture::sheet(&self.pictures, COLUMNS)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_maps_of_a_sheet_are_evenly_spread() {
        for maps in [0, 1, 24, 25, 49, 100, 1000] {
            let mut sheet = Sheet::default();
            for map in 0..maps {
                let rgb = vec![[(map / 256) as u8, (map % 256) as u8, 0]];
                sheet.push(|| Ok(Picture { width: 1, height: 1, rgb, comment: None })).unwrap();
            }
            let shown: Vec<usize> =
                sheet.pictures.iter().map(|p| usize::from(p.rgb[0][0]) * 256 + usize::from(p.rgb[0][1])).collect();
            let expected: Vec<usize> = (0..maps).step_by(sheet.stride).collect();
            assert_eq!(shown, expected, "{maps} maps");
            assert!(shown.len() <= PICTURES_MAX && shown.len() >= maps.min(PICTURES_MAX / 2), "{maps} maps");
        }
    }
}
