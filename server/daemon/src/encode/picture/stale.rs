//! The mark of a stale map: a red frame and the word STALE at the upper edge.

use super::canvas::Canvas;
use crate::encode::font;

const WORD: &str = "stale";
/// Colour of the frame, and of the band behind the word.
pub(super) const BAND: [u8; 3] = [200, 24, 24];
/// Colour of the word.
const LETTERS: [u8; 3] = [255, 255, 255];
/// Width of the word, with an empty column of dots before each letter and one behind the last.
const DOTS: usize = WORD.len() * (font::WIDTH + 1) + 1;

/// Draws the mark. The word is as large as a third of the picture allows; a picture of less than 31 pixels has the
/// frame alone.
pub fn draw(canvas: &mut Canvas) {
    let side = canvas.side;
    let frame = (side / 100).max(1);
    for index in 0..side * side {
        let (column, row) = (index % side, index / side);
        if column.min(row).min(side - 1 - column).min(side - 1 - row) < frame {
            canvas.rgb[index] = BAND;
        }
    }
    let dot = (side / 3 / DOTS).max(1);
    let (width, height) = (DOTS * dot, (font::HEIGHT + 2) * dot);
    if width > side || height > side {
        return;
    }
    let left = (side - width) / 2;
    for (row, column) in (0..height).flat_map(|row| (0..width).map(move |column| (row, column))) {
        canvas.rgb[row * side + left + column] = if is_dot(column / dot, row / dot) { LETTERS } else { BAND };
    }
}

/// True if the word has a dot there; row and column count from the corner of the band.
fn is_dot(column: usize, row: usize) -> bool {
    let (Some(column), Some(row)) = (column.checked_sub(1), row.checked_sub(1)) else { return false };
    let letter = WORD.chars().nth(column / (font::WIDTH + 1));
    let bit = (font::WIDTH - 1).checked_sub(column % (font::WIDTH + 1));
    letter.zip(bit).is_some_and(|(letter, bit)| font::rows(letter).get(row).is_some_and(|dots| dots >> bit & 1 == 1))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_word_and_the_frame_are_drawn() {
        for side in [16, 31, 93, 800] {
            let mut canvas = Canvas { side, range_m: 10.0, rgb: vec![[0; 3]; side * side] };
            draw(&mut canvas);
            assert!([0, side - 1, side * (side - 1), side * side - 1].iter().all(|&index| canvas.rgb[index] == BAND));
            assert_eq!(canvas.rgb.contains(&LETTERS), side >= DOTS, "{side}");
        }
        let picture: Vec<String> = (1..=font::HEIGHT)
            .map(|row| (1..=font::WIDTH).map(|column| if is_dot(column, row) { '#' } else { ' ' }).collect())
            .collect();
        assert_eq!(picture, ["     ", "     ", " ####", "#    ", " ### ", "    #", "#### "], "an s");
    }
}
