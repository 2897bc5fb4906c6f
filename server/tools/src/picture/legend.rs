//! The lines under a map: the caption, what its colours mean, and a scale bar.

use clearway_daemon::viewer::palette::{Rgb, scale_colour};

use super::image::{LETTER, Picture};

/// Colour under the lines.
const PAPER: Rgb = [24, 26, 30];
/// Colour of the text and of the scale bar.
const INK: Rgb = [232, 234, 238];
/// Width of a picture for each dot of its letters, in pixels: at 400 pixels a dot is one pixel, at 800 it is two.
const PIXELS_PER_DOT: usize = 400;
/// Height of a line: a letter and the space to the next line, in dots.
const LINE: usize = LETTER + 4;
/// Space beside and between the parts of a line, in dots.
const SPACE: usize = 4;
/// Width of the bar of a channel's colours, in dots.
const COLOUR_BAR: usize = 64;
/// Most of the map's width that the scale bar takes.
const SCALE_SHARE: f64 = 0.25;

/// What stands before the text of a line.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Swatch {
    /// No mark; the text begins at the left.
    None,
    /// A square of this colour.
    Colour(Rgb),
    /// A bar of all colours of values, from the least to the greatest.
    Scale,
    /// A bar of this length, in pixels.
    Length(usize),
}

impl Swatch {
    /// Its width, in pixels, with the space to the text.
    fn width(self, dot: usize) -> usize {
        match self {
            Self::None => 0,
            Self::Colour(_) => (LETTER + SPACE) * dot,
            Self::Scale => (COLOUR_BAR + SPACE) * dot,
            Self::Length(pixels) => pixels + SPACE * dot,
        }
    }

    fn draw(self, picture: &mut Picture, (x, y): (usize, usize), dot: usize) {
        match self {
            Self::None => {}
            Self::Colour(colour) => picture.fill((x, y), (LETTER * dot, LETTER * dot), colour),
            Self::Scale => (0..COLOUR_BAR).for_each(|column| {
                let colour = scale_colour(column as f64 / (COLOUR_BAR - 1) as f64);
                picture.fill((x + column * dot, y), (dot, LETTER * dot), colour);
            }),
            // The ends of the bar are raised.
            Self::Length(pixels) => {
                picture.fill((x, y + 3 * dot), (pixels, dot), INK);
                picture.fill((x, y + dot), (dot, 5 * dot), INK);
                picture.fill((x + pixels.saturating_sub(dot), y + dot), (dot, 5 * dot), INK);
            }
        }
    }
}

/// The map with lines of text under it, and a scale bar; `metres` is the edge of a pixel of the map. The picture is as
/// wide as the longest line if that is wider than the map.
pub fn with_lines(map: &Picture, mut lines: Vec<(Swatch, String)>, metres: f64) -> Picture {
    let dot = (map.width / PIXELS_PER_DOT).max(1);
    let (scale_m, bar) = scale_bar(map.width, metres);
    lines.push((Swatch::Length(bar), format!("{scale_m} m, ^ forward")));
    let margin = SPACE * dot;
    let width = |(swatch, text): &(Swatch, String)| swatch.width(dot) + text.chars().count() * LETTER * dot;
    let widest = lines.iter().map(width).max().unwrap_or(0) + 2 * margin;
    let mut picture = Picture::new(map.width.max(widest), map.height + lines.len() * LINE * dot + margin, PAPER);
    picture.place((0, 0), map);
    for (index, (swatch, text)) in lines.iter().enumerate() {
        let y = map.height + margin + index * LINE * dot;
        swatch.draw(&mut picture, (margin, y), dot);
        picture.write((margin + swatch.width(dot), y), dot, text, INK);
    }
    picture
}

/// Length that the scale bar shows, in metres, and its width, in pixels: the longest of 1, 2, 5, 10 ... m in a quarter
/// of the map.
fn scale_bar(width: usize, metres: f64) -> (f64, usize) {
    let most_m = SCALE_SHARE * width as f64 * metres;
    let power = 10_f64.powf(most_m.max(f64::MIN_POSITIVE).log10().floor());
    let scale_m = [5.0, 2.0].map(|times| times * power).into_iter().find(|&m| m <= most_m).unwrap_or(power);
    (scale_m, (scale_m / metres).round().max(1.0) as usize)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_line_has_its_square_and_its_whole_text() {
        let lines: Vec<(Swatch, String)> =
            (1..=9).map(|red| (Swatch::Colour([red, 0, 0]), "a_name_of_a_class".repeat(red.into()))).collect();
        for width in [16, 120, 800] {
            let map = Picture::new(width, width, [0; 3]);
            let picture = with_lines(&map, lines.clone(), 0.1);
            assert!(picture.width >= width && picture.rgb.len() == picture.width * picture.height);
            let dot = (width / PIXELS_PER_DOT).max(1);
            for red in 1..=9 {
                let squares = picture.rgb.iter().filter(|&&pixel| pixel == [red, 0, 0]).count();
                assert_eq!(squares, (LETTER * dot).pow(2), "{red} at width {width}");
            }
            let last = picture.rgb.chunks(picture.width).skip(width).filter_map(|row| row.last());
            assert!(last.into_iter().all(|&pixel| pixel == PAPER), "no letter is cut off at width {width}");
        }
    }

    #[test]
    fn a_channel_has_a_bar_from_its_least_to_its_greatest_colour() {
        let map = Picture::new(400, 400, [0; 3]);
        let picture = with_lines(&map, vec![(Swatch::Scale, "roughness".into())], 0.1);
        for share in [0.0, 1.0] {
            assert_eq!(picture.rgb.iter().filter(|&&pixel| pixel == scale_colour(share)).count(), LETTER);
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
}
