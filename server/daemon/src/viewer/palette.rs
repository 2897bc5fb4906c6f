//! Colours of values and of ids, as the page has them (`server/web/draw/palette.js`).

/// A colour: red, green, blue.
pub type Rgb = [u8; 3];

/// Colours from the least to the greatest value: blue, lighter than unknown cells, to light yellow, even in lightness,
/// for colour-blind eyes and in grey.
const STOPS: [Rgb; 5] = [[48, 88, 184], [100, 120, 150], [150, 154, 140], [206, 192, 112], [254, 232, 90]];
/// Hues of consecutive ids are this far apart, in degrees: the golden angle.
const HUE_STEP_DEG: f64 = 137.508;

/// The colour of a value; `share` is 0 for the least value and 1 for the greatest.
pub fn scale_colour(share: f64) -> Rgb {
    let at = share.clamp(0.0, 1.0) * (STOPS.len() - 1) as f64;
    let index = (at as usize).min(STOPS.len() - 2);
    let part = at - index as f64;
    std::array::from_fn(|k| {
        let [low, high] = [index, index + 1].map(|stop| f64::from(STOPS[stop][k]));
        (low + (high - low) * part).round() as u8
    })
}

/// The colour of an id.
pub fn id_colour(id: i32) -> Rgb {
    let hue_deg = (f64::from(id) * HUE_STEP_DEG).rem_euclid(360.0);
    let light = 0.46 + 0.1 * f64::from(id.rem_euclid(3));
    let chroma = 0.28 * (1.0 - (2.0 * light - 1.0).abs());
    [0.0, 8.0, 4.0].map(|shift| {
        let k = (shift + hue_deg / 30.0) % 12.0;
        (255.0 * (light - chroma * (k - 3.0).min(9.0 - k).clamp(-1.0, 1.0))).round() as u8
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_scale_has_the_colours_of_the_page() {
        let page = include_str!("../../../web/draw/palette.js");
        let line = page.lines().find(|line| line.starts_with("const STOPS")).expect("the page's colours");
        let numbers = line.split(|c: char| !c.is_ascii_digit()).filter_map(|number| number.parse::<u8>().ok());
        assert_eq!(numbers.collect::<Vec<_>>(), STOPS.as_flattened());
        for (index, stop) in STOPS.iter().enumerate() {
            assert_eq!(scale_colour(index as f64 / 4.0), *stop);
        }
        assert_eq!(scale_colour(0.125), [74, 104, 167]);
    }

    #[test]
    fn consecutive_ids_have_colours_far_apart() {
        for id in 0..500 {
            let [a, b] = [id, id + 1].map(|id| id_colour(id).map(f64::from));
            let apart = (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f64>().sqrt();
            assert!(apart > 60.0, "{id}: {a:?}, {b:?}");
        }
    }
}
