//! Classes and their colours, or the range of a channel -> the strip under a picture: a square of each class's colour
//! with its name, or a bar of the channel's colours with the least and the greatest value; a scale bar, and the
//! direction that is up.

use super::font;
use super::palette::{Rgb, scale_colour};

/// Colour of the strip.
const PAPER: [u8; 3] = [24, 26, 30];
/// Colour of the text and of the scale bar.
const INK: [u8; 3] = [232, 234, 238];
/// Colour of the line around each square, so that a dark class is seen on the strip.
const EDGE: [u8; 3] = [112, 116, 124];
/// Width of a picture for each dot of its letters, in pixels: at 400 pixels a dot is one pixel, at 800 it is two.
const PIXELS_PER_DOT: usize = 400;
/// Height of a line of the strip, in dots: a letter and the space to the next line.
const LINE: usize = font::HEIGHT + 4;
/// Space around the strip and between two entries, in dots.
const SPACE: usize = 4;
/// Most of the picture's width that the scale bar takes.
const SCALE_SHARE: f64 = 0.25;

/// Least width of the bar of a channel's colours, in dots; ours, because the colours are told apart at that width.
const BAR_WIDTH_MIN: usize = 32;

/// What the colours of a picture mean.
#[derive(Clone, Debug, PartialEq)]
pub enum Legend {
    /// Name and colour of each class; none for ids, of which only equality means something.
    Classes(Vec<(String, Rgb)>),
    /// The name and the least value of a channel, and its greatest value and unit, as texts, for the colours from dark
    /// to light.
    Scale([String; 2]),
}

/// Red, green and blue of each pixel, row by row.
#[derive(Clone, Debug, PartialEq)]
pub struct Strip {
    /// Width, in pixels: that of the picture, or more if an entry needs more.
    pub width: usize,
    /// Height, in pixels.
    pub height: usize,
    /// The pixels.
    pub rgb: Vec<Rgb>,
}

/// Draws the strip of a picture that is `width` pixels wide and shows `metres` metres in each pixel; the lines of
/// `caption` stand first, and continue on the next line if they are longer than the strip.
pub fn strip(caption: &[String], legend: &Legend, width: usize, metres: f64) -> Strip {
    let dot = (width / PIXELS_PER_DOT).max(1);
    let (scale_m, bar) = scale_bar(width, metres);
    let scale = format!("{scale_m} m");
    let (margin, up) = (SPACE * dot, "^ forward");
    let widest = match legend {
        Legend::Classes(classes) => classes.iter().map(|(name, _)| entry_width(font::HEIGHT * dot, name, dot)).max(),
        Legend::Scale([least, greatest]) => {
            Some(text_width(least, dot) + entry_width((BAR_WIDTH_MIN + SPACE) * dot, greatest, dot))
        }
    };
    let last = entry_width(bar, &scale, dot) + 2 * margin + text_width(up, dot);
    let longest = caption.iter().flat_map(|line| line.split(' ')).map(|word| text_width(word, dot)).max().unwrap_or(0);
    let width = width.max(2 * margin + widest.unwrap_or(0).max(last).max(longest));
    let mut strip = caption_strip(caption, width, dot);
    let explained = match legend {
        Legend::Classes(classes) => class_strip(classes, width, dot),
        Legend::Scale(texts) => colour_strip(texts, width, dot),
    };
    strip.rgb.extend(explained.rgb);
    strip.height += explained.height;
    // A bar with raised ends.
    let y = strip.height;
    strip.extend(font::HEIGHT * dot + margin);
    strip.fill((margin, y + 3 * dot), (bar, dot), INK);
    strip.fill((margin, y + dot), (dot, 5 * dot), INK);
    strip.fill((margin + bar.saturating_sub(dot), y + dot), (dot, 5 * dot), INK);
    strip.write((margin + bar + SPACE * dot, y), dot, &scale);
    strip.write((margin + entry_width(bar, &scale, dot) + 2 * margin, y), dot, up);
    strip
}

/// Width of a text, in pixels.
fn text_width(text: &str, dot: usize) -> usize {
    text.chars().count() * (font::WIDTH + 1) * dot
}

/// Width of an entry, in pixels: its square or bar, and its text.
fn entry_width(square: usize, text: &str, dot: usize) -> usize {
    square + SPACE * dot + text_width(text, dot)
}

/// The lines of text.
fn caption_strip(caption: &[String], width: usize, dot: usize) -> Strip {
    let mut strip = Strip::new(width, 0);
    let margin = SPACE * dot;
    for line in caption {
        let mut words = line.split(' ').peekable();
        while let Some(first) = words.next() {
            let mut text = first.to_owned();
            while let Some(word) =
                words.next_if(|word| text_width(&text, dot) + text_width(word, dot) + 2 * margin < width)
            {
                text = format!("{text} {word}");
            }
            let y = strip.height + margin;
            strip.extend(LINE * dot);
            strip.write((margin, y), dot, &text);
        }
    }
    strip
}

/// The lines with a square of each class's colour and its name.
fn class_strip(classes: &[(String, Rgb)], width: usize, dot: usize) -> Strip {
    let (margin, square) = (SPACE * dot, font::HEIGHT * dot);
    // The position of each entry.
    let (mut x, mut y) = (margin, margin);
    let mut places = Vec::new();
    for (name, _) in classes {
        let end = x + entry_width(square, name, dot);
        if end > width - margin && x > margin {
            (x, y) = (margin, y + LINE * dot);
        }
        places.push((x, y));
        x += entry_width(square, name, dot) + 2 * margin;
    }
    let mut strip = Strip::new(width, if classes.is_empty() { margin } else { y + LINE * dot });
    for ((name, colour), (x, y)) in classes.iter().zip(places) {
        strip.fill((x - 1, y - 1), (square + 2, square + 2), EDGE);
        strip.fill((x, y), (square, square), *colour);
        strip.write((x + square + SPACE * dot, y), dot, name);
    }
    strip
}

/// The line with the least value, the bar of the colours and the greatest value.
fn colour_strip([least, greatest]: &[String; 2], width: usize, dot: usize) -> Strip {
    let margin = SPACE * dot;
    let mut strip = Strip::new(width, margin + LINE * dot);
    let (left, right) = (entry_width(margin, least, dot), width - entry_width(margin, greatest, dot));
    strip.write((margin, margin), dot, least);
    strip.write((right + SPACE * dot, margin), dot, greatest);
    let length = right - left;
    for column in 0..length {
        let colour = scale_colour(column as f64 / (length - 1).max(1) as f64);
        strip.fill((left + column, margin), (1, font::HEIGHT * dot), colour);
    }
    strip
}

/// The length that the scale bar shows, in metres, and the bar's width, in pixels: the longest of 1, 2, 5, 10 ... m in
/// a quarter of the picture.
fn scale_bar(width: usize, metres: f64) -> (f64, usize) {
    let most_m = SCALE_SHARE * width as f64 * metres;
    let power = 10_f64.powf(most_m.max(f64::MIN_POSITIVE).log10().floor());
    let scale_m = [5.0, 2.0].map(|times| times * power).into_iter().find(|&m| m <= most_m).unwrap_or(power);
    (scale_m, (scale_m / metres).round().max(1.0) as usize)
}

impl Strip {
    fn new(width: usize, height: usize) -> Self {
        Self { width, height, rgb: vec![PAPER; width * height] }
    }

    /// Appends `rows` rows of pixels.
    fn extend(&mut self, rows: usize) {
        self.height += rows;
        self.rgb.resize(self.width * self.height, PAPER);
    }

    fn fill(&mut self, (x, y): (usize, usize), (width, height): (usize, usize), colour: [u8; 3]) {
        for row in y..(y + height).min(self.height) {
            let start = row * self.width;
            self.rgb[start + x.min(self.width)..start + (x + width).min(self.width)].fill(colour);
        }
    }

    fn write(&mut self, (x, y): (usize, usize), dot: usize, text: &str) {
        for (number, letter) in text.chars().enumerate() {
            let left = x + number * (font::WIDTH + 1) * dot;
            for (row, dots) in font::rows(letter).into_iter().enumerate() {
                for column in (0..font::WIDTH).filter(|column| dots >> (font::WIDTH - 1 - column) & 1 == 1) {
                    self.fill((left + column * dot, y + row * dot), (dot, dot), INK);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entries(names: &[&str]) -> Vec<(String, [u8; 3])> {
        names.iter().zip(1..).map(|(&name, red)| (name.to_owned(), [red, 0, 0])).collect()
    }

    #[test]
    fn every_class_of_every_layer_has_its_square_and_fits_the_strip() {
        use clearway_mapping::layer::drivability::class::DrivabilityClass;
        use clearway_mapping::layer::occupancy::class::OccupancyClass;
        use clearway_mapping::layer::terrain::class::TerrainClass;
        for legend in [DrivabilityClass::LEGEND, OccupancyClass::LEGEND, TerrainClass::LEGEND] {
            let names: Vec<&str> = legend.iter().map(|class| class.name).collect();
            for width in [16, 120, 800] {
                let strip = strip(&[], &Legend::Classes(entries(&names)), width, 0.1);
                assert!(strip.width >= width && strip.rgb.len() == strip.width * strip.height);
                let dot = (width / PIXELS_PER_DOT).max(1);
                for (_, colour) in entries(&names) {
                    let squares = strip.rgb.iter().filter(|&&pixel| pixel == colour).count();
                    assert_eq!(squares, (font::HEIGHT * dot).pow(2), "{colour:?} at width {width}");
                }
                // No letter is cut off at the right edge.
                let last = strip.rgb.chunks(strip.width).filter_map(|row| row.last());
                assert!(last.into_iter().all(|&pixel| pixel == PAPER));
            }
        }
    }

    #[test]
    fn a_channel_has_a_bar_from_its_least_to_its_greatest_colour() {
        let legend = Legend::Scale(["roughness -12.75".into(), "1023.5 m/s".into()]);
        for width in [16, 120, 800] {
            let strip = strip(&[], &legend, width, 0.1);
            let dot = (width / PIXELS_PER_DOT).max(1);
            for share in [0.0, 1.0] {
                let pixels = strip.rgb.iter().filter(|&&pixel| pixel == scale_colour(share)).count();
                assert!(pixels >= font::HEIGHT * dot, "{share} at width {width}");
            }
            let middle = &strip.rgb[(SPACE + 3) * dot * strip.width..][..strip.width];
            let ends = [0.0, 1.0].map(|share| middle.iter().position(|&pixel| pixel == scale_colour(share)).unwrap());
            assert!(ends[1] - ends[0] >= BAR_WIDTH_MIN * dot - 3 * dot, "{ends:?} at width {width}");
            let last = strip.rgb.chunks(strip.width).filter_map(|row| row.last());
            assert!(last.into_iter().all(|&pixel| pixel == PAPER), "no letter is cut off at width {width}");
        }
    }

    #[test]
    fn the_scale_bar_is_as_long_as_it_says() {
        for (width, metres, scale_m) in [(800, 0.15, 20.0), (800, 0.1, 20.0), (640, 0.1, 10.0), (120, 0.5, 10.0)] {
            let (shown_m, pixels) = scale_bar(width, metres);
            assert_eq!(shown_m, scale_m, "{width} pixels of {metres} m");
            assert!((pixels as f64 * metres - scale_m).abs() <= metres / 2.0);
        }
    }

    #[test]
    fn every_letter_of_a_name_has_dots_of_its_own() {
        let letters: Vec<char> = ('a'..='z').chain('0'..='9').chain("_-.:/%^TZ".chars()).collect();
        for (index, letter) in letters.iter().enumerate() {
            let rows = font::rows(*letter);
            assert!(rows != [0b11111; font::HEIGHT] && rows != [0; font::HEIGHT], "{letter}");
            assert!(letters[index + 1..].iter().all(|other| font::rows(*other) != rows), "{letter}");
        }
    }
}
