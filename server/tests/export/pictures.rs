//! Pictures that `clearway export` draws: classes, channels, safe points and the legend.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use super::{folder, record};
use crate::common::{clearway, text};

/// Width, height, red, green and blue of each pixel, and the texts by keyword, of a picture.
pub(super) fn decoded(file: &Path) -> (usize, usize, Vec<[u8; 3]>, BTreeMap<String, String>) {
    let mut reader = png::Decoder::new(BufReader::new(File::open(file).unwrap())).read_info().unwrap();
    let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut pixels).unwrap();
    assert_eq!(info.color_type, png::ColorType::Rgb);
    let texts = reader.info().uncompressed_latin1_text.iter();
    let texts = texts.map(|chunk| (chunk.keyword.clone(), chunk.text.clone())).collect();
    (info.width as usize, info.height as usize, pixels.as_chunks::<3>().0.to_vec(), texts)
}

/// The colours of the classes of the layer drivability.
const COLOURS: [[u8; 3]; 4] = [[58, 63, 70], [28, 158, 150], [244, 184, 66], [196, 38, 56]];

/// A picture of 60 m by 60 m: forward is up, left is left.
struct DecodedPicture {
    /// Edge of the map, in pixels.
    side: usize,
    /// Width with the lines under the map.
    width: usize,
    pixels: Vec<[u8; 3]>,
    texts: BTreeMap<String, String>,
}

impl DecodedPicture {
    fn at(&self, x_m: f64, y_m: f64) -> [u8; 3] {
        let [row, column] = [x_m, y_m].map(|metres| ((30.0 - metres) * self.side as f64 / 60.0) as usize);
        self.pixels[row * self.width + column]
    }

    /// The pixels under the map.
    fn strip(&self) -> &[[u8; 3]] {
        &self.pixels[self.side * self.width..]
    }
}

/// Exports pictures of a layer, and reads the second.
fn picture(layer: &str, side: usize, more: &[&str]) -> DecodedPicture {
    let folder = folder();
    let file = folder.path().join("run.mcap");
    record(&file, true);
    let (out, edge) = (folder.path().join("png"), side.to_string());
    let arguments = ["export", file.to_str().unwrap(), "--layer", layer, "--format", "png", "--pixels", &edge];
    let done = clearway(&[&arguments[..], &["--out", out.to_str().unwrap()], more].concat());
    assert!(done.status.success(), "{}", text(&done.stderr));
    let channel = more.iter().position(|option| *option == "--channel").map(|index| more[index + 1]);
    let ending = channel.map_or(String::new(), |channel| format!("_{channel}"));
    let pictures = [0, 1, 2].map(|sequence| out.join(format!("{sequence:06}_{layer}{ending}.png")));
    assert!(pictures.iter().all(|picture| picture.exists()));
    let (width, height, pixels, texts) = decoded(&pictures[1]);
    assert!(width >= side && height > side);
    DecodedPicture { side, width, pixels, texts }
}

#[test]
fn a_picture_has_the_colour_of_each_class_in_its_place() {
    let picture = picture("drivability", 120, &[]);
    let at = |x_m, y_m| picture.at(x_m, y_m);
    let [unknown, drivable, not_drivable, obstacle] = COLOURS;
    assert_eq!(at(6.1, 6.1), drivable, "ahead and to the left");
    assert_eq!(at(-6.1, 6.1), not_drivable, "behind and to the left");
    assert_eq!(at(-6.1, -6.1), unknown, "behind and to the right");
    assert_eq!(at(10.1, -10.1), obstacle, "ahead and to the right, 14 m off");
    assert_eq!(at(18.1, -15.1), drivable, "behind the obstacle");
    assert_eq!(at(29.1, 29.1), unknown, "outside the grid");
    assert_eq!(at(0.1, 0.1), [244, 244, 248], "the vehicle");
    assert!(picture.texts.is_empty(), "the legend explains classes: {:?}", picture.texts);
}

#[test]
fn a_picture_has_links_and_radii_of_safe_points_over_the_classes() {
    let (plain, with_paths) = (picture("drivability", 240, &[]), picture("safe_path", 240, &[]));
    let line = [255, 225, 77];
    for (x_m, y_m) in [(0.1, 6.1), (0.1, 11.6), (3.1, 12.1)] {
        assert_eq!(with_paths.at(x_m, y_m), line, "{x_m} m ahead, {y_m} m to the left");
    }
    // Only the last point is an end; its radius is 2.5 m.
    for (x_m, y_m, is_drawn) in [(6.1, 14.5, true), (6.1, 9.6, true), (8.5, 12.1, true), (6.1, 13.6, false)] {
        let differs = with_paths.at(x_m, y_m) != plain.at(x_m, y_m);
        assert_eq!(differs, is_drawn, "{x_m} m ahead, {y_m} m to the left");
    }
    assert_eq!(with_paths.at(0.1, 0.1), [244, 244, 248], "the vehicle covers the path");
    assert_eq!(with_paths.at(1.4, 1.4), plain.at(1.4, 1.4), "the vehicle's own radius is not drawn");
}

#[test]
fn a_picture_of_a_channel_is_a_heat_map_with_its_scale() {
    let heights = picture("drivability", 240, &["--channel", "unit_height"]);
    assert_eq!(heights.texts["Comment"], "unit_height: dark 0.0 m to light 5.5 m");
    assert_eq!(heights.at(6.1, 6.1), [48, 88, 184], "the least height, ahead and to the left");
    // Height 3.5 m of 5.5 m.
    assert_eq!(heights.at(10.1, -10.1), [181, 175, 125], "14 m off, ahead and to the right");
    assert_eq!(heights.at(-10.1, -10.1), [160, 161, 135], "3 m: 14 m off, behind and to the right");
    assert_eq!(heights.at(-3.1, -3.1), [58, 63, 70], "an unknown cell");
    // The bar of the colours is under the map, in place of the classes.
    let position = |colour| heights.strip().iter().position(|&pixel| pixel == colour);
    assert!(position([48, 88, 184]).unwrap() < position([254, 232, 90]).unwrap());
    assert_eq!(COLOURS[1..].iter().find(|&&colour| position(colour).is_some()), None);
    let ids = picture("drivability", 240, &["--channel", "segment"]);
    assert_eq!(ids.texts["Comment"], "segment: one colour for each id");
    assert_eq!(ids.at(6.1, 6.1), ids.at(-20.1, 20.1), "one segment has one colour");
}

#[test]
fn the_colours_of_a_channel_have_the_same_values_in_all_pictures_of_a_layer() {
    let town = concat!(env!("CARGO_MANIFEST_DIR"), "/../client/golden/town.mcap");
    let folder = folder();
    let out = folder.path().join("png");
    let arguments = ["export", town, "--channel", "roughness", "--format", "png", "--pixels", "64", "--out"];
    let done = clearway(&[&arguments[..], &[out.to_str().unwrap()]].concat());
    assert!(done.status.success(), "{}", text(&done.stderr));
    let files = std::fs::read_dir(&out).unwrap().map(|entry| entry.unwrap().path());
    let comments: Vec<String> = files.map(|file| decoded(&file).3["Comment"].clone()).collect();
    assert!(comments.len() > 5 && comments.iter().all(|comment| *comment == comments[0]), "{comments:?}");
}

#[test]
fn an_unknown_channel_is_refused_with_the_names_of_the_channels() {
    let folder = folder();
    let file = folder.path().join("run.mcap");
    record(&file, true);
    let paths = [file.to_str().unwrap(), folder.path().to_str().unwrap()];
    let arguments = ["export", paths[0], "--layer", "drivability", "--format", "png", "--out", paths[1]];
    let done = clearway(&[&arguments[..], &["--channel", "roughness"]].concat());
    assert_eq!(done.status.code(), Some(2));
    let expected = "layer drivability has no channel \"roughness\"; it has class, unit_height, segment";
    assert!(text(&done.stderr).contains(expected), "{}", text(&done.stderr));
}

#[test]
fn a_picture_has_the_legend_under_the_map() {
    let picture = picture("drivability", 400, &[]);
    for colour in COLOURS {
        let pixels = picture.strip().iter().filter(|&&pixel| pixel == colour).count();
        assert_eq!(pixels, 8 * 8, "the square of {colour:?}");
    }
    let text = picture.strip().iter().filter(|&&pixel| pixel == [232, 234, 238]).count();
    assert!(text > 200, "{text} pixels of names, scale bar and arrow");
}
