//! The pixels of a finished picture -> a PNG; several pictures -> one.

use super::error::PictureError;
use crate::encode::palette::Rgb;

/// Colour between pictures, and beside a map whose legend is wider.
const MARGIN: Rgb = [0; 3];
/// Space between two pictures, in pixels.
const GAP: usize = 4;

/// A finished picture.
#[derive(Clone, Debug, PartialEq)]
pub struct Picture {
    /// Width, in pixels.
    pub width: usize,
    /// Height, in pixels.
    pub height: usize,
    /// Red, green and blue of each pixel, row by row from the upper left.
    pub rgb: Vec<Rgb>,
    /// The text `Comment` of the PNG; `None` leaves it out.
    pub comment: Option<String>,
}

impl Picture {
    /// Encodes the picture as a PNG.
    ///
    /// # Errors
    /// [`PictureError::Encoding`] if it is larger than PNG allows.
    pub fn to_png(&self) -> Result<Vec<u8>, PictureError> {
        let mut file = Vec::new();
        let mut encoder = png::Encoder::new(&mut file, self.width as u32, self.height as u32);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        if let Some(text) = &self.comment {
            encoder.add_text_chunk("Comment".into(), text.clone())?;
        }
        let mut writer = encoder.write_header()?;
        writer.write_image_data(self.rgb.as_flattened())?;
        writer.finish()?;
        Ok(file)
    }

    /// Pictures side by side, `columns` in each row, in reading order. Each has the space of the largest.
    pub fn sheet(pictures: &[Self], columns: usize) -> Self {
        let columns = columns.clamp(1, pictures.len().max(1));
        let rows = pictures.len().div_ceil(columns);
        let most = |of: fn(&Self) -> usize| pictures.iter().map(of).max().unwrap_or(0);
        let (wide, high) = (most(|picture| picture.width) + GAP, most(|picture| picture.height) + GAP);
        let (width, height) = ((columns * wide).saturating_sub(GAP), (rows * high).saturating_sub(GAP));
        let mut rgb = vec![MARGIN; width * height];
        for (index, picture) in pictures.iter().enumerate() {
            let corner = index / columns * high * width + index % columns * wide;
            for (row, pixels) in picture.rgb.chunks(picture.width.max(1)).enumerate() {
                let start = corner + row * width;
                rgb[start..start + pixels.len()].copy_from_slice(pixels);
            }
        }
        Self { width, height, rgb, comment: None }
    }

    /// The picture with a margin on its right up to `width` pixels, which is at least its own.
    pub(super) fn widened(self, width: usize) -> Self {
        let margin = vec![MARGIN; width - self.width];
        let rows = self.rgb.chunks(self.width);
        Self { rgb: rows.flat_map(|row| row.iter().chain(&margin)).copied().collect(), width, ..self }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plain(width: usize, height: usize, red: u8) -> Picture {
        Picture { width, height, rgb: vec![[red, 0, 0]; width * height], comment: None }
    }

    #[test]
    fn a_sheet_has_every_pixel_of_its_pictures_in_reading_order() {
        let sheet = Picture::sheet(&[plain(3, 2, 1), plain(5, 4, 2), plain(2, 3, 3)], 2);
        assert_eq!(
            (sheet.width, sheet.height, sheet.rgb.len()),
            (5 + GAP + 5, 4 + GAP + 4, sheet.width * sheet.height)
        );
        let count = |red: u8| sheet.rgb.iter().filter(|pixel| pixel[0] == red).count();
        assert_eq!([count(1), count(2), count(3)], [6, 20, 6]);
        assert_eq!(sheet.rgb[5 + GAP][0], 2, "the second is right of the first");
        assert_eq!(sheet.rgb[(4 + GAP) * sheet.width][0], 3, "the third is below");
        assert_eq!(Picture::sheet(&[], 3).rgb.len(), 0);
    }
}
