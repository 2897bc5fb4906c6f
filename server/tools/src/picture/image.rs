//! The pixels of a picture: rectangles, text and other pictures in it, and the picture as a PNG.

use clearway_daemon::viewer::palette::Rgb;
use font8x8::legacy::BASIC_LEGACY;

/// Width and height of a letter, in dots.
pub const LETTER: usize = 8;
/// Dots of a character that the font does not have: a filled box.
const BOX: [u8; LETTER] = [0xff; LETTER];

/// A picture of pixels in memory, which can be encoded as a PNG.
#[derive(Clone, Debug, PartialEq)]
pub struct Picture {
    /// Width, in pixels.
    pub width: usize,
    /// Height, in pixels.
    pub height: usize,
    /// Red, green and blue of each pixel, row by row from the upper left.
    pub rgb: Vec<Rgb>,
    /// Text `Comment` of the PNG; `None` leaves it out.
    pub comment: Option<String>,
}

impl Picture {
    /// A picture of one colour.
    pub fn new(width: usize, height: usize, colour: Rgb) -> Self {
        Self { width, height, rgb: vec![colour; width * height], comment: None }
    }

    /// Encodes the picture as a PNG.
    ///
    /// # Errors
    /// If it is larger than PNG allows.
    pub fn to_png(&self) -> Result<Vec<u8>, png::EncodingError> {
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

    /// Fills a rectangle, as far as it lies in the picture.
    pub fn fill(&mut self, (x, y): (usize, usize), (width, height): (usize, usize), colour: Rgb) {
        let columns = x.min(self.width)..x.saturating_add(width).min(self.width);
        for row in y..y.saturating_add(height).min(self.height) {
            self.rgb[row * self.width..][columns.clone()].fill(colour);
        }
    }

    /// Writes a line of text; `dot` is the edge of each dot of a letter, in pixels.
    pub fn write(&mut self, (x, y): (usize, usize), dot: usize, text: &str, colour: Rgb) {
        for (index, letter) in text.chars().enumerate() {
            let rows = BASIC_LEGACY.get(letter as usize).unwrap_or(&BOX);
            for (row, dots) in rows.iter().enumerate() {
                for column in (0..LETTER).filter(|column| dots >> column & 1 == 1) {
                    self.fill((x + (index * LETTER + column) * dot, y + row * dot), (dot, dot), colour);
                }
            }
        }
    }

    /// Copies a picture into this picture, which is large enough.
    pub fn place(&mut self, (x, y): (usize, usize), picture: &Self) {
        for (row, pixels) in picture.rgb.chunks(picture.width.max(1)).enumerate() {
            self.rgb[(y + row) * self.width + x..][..picture.width].copy_from_slice(pixels);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_drawn_beyond_the_edges_is_cut_off() {
        let mut picture = Picture::new(10, 10, [0; 3]);
        picture.fill((8, 8), (usize::MAX, 5), [1; 3]);
        picture.write((6, 6), 2, "W", [2; 3]);
        picture.fill((20, 20), (1, 1), [3; 3]);
        assert!(picture.rgb.contains(&[2; 3]) && !picture.rgb.contains(&[3; 3]));
    }
}
