//! Look-ups at points in metres, and the age of a map.

use clearway_client::{ClientError, MapView};

use crate::common::{CAPTURE_END_NS, map};

fn view() -> MapView {
    MapView::decode(map(5, CAPTURE_END_NS)).unwrap()
}

#[test]
fn the_class_at_a_point_is_that_of_its_cell() {
    let view = view();
    let layer = view.layer("drivability").unwrap();
    let expected = [
        ((5.0, 5.0), "drivable"),
        ((-5.0, 5.0), "not_drivable"),
        ((-5.0, -5.0), "unknown"),
        ((5.0, -5.0), "drivable"),
        ((10.0, -10.0), "obstacle"),
        ((20.0, -15.0), "drivable"),
        // An outer radius belongs to its row; a column starts at its azimuth.
        ((10.0, 0.0), "drivable"),
        ((0.0, 15.0), "not_drivable"),
        ((0.0, -10.0), "drivable"),
        ((0.0, -10.1), "obstacle"),
        ((0.0, 0.0), "drivable"),
        // Outside the grid, and not finite.
        ((30.1, 0.0), "unknown"),
        ((-25.0, 25.0), "unknown"),
        ((f64::NAN, 0.0), "unknown"),
        ((f64::INFINITY, 0.0), "unknown"),
    ];
    for ((x, y), class) in expected {
        assert_eq!(layer.class_at(x, y).1, class, "at ({x}, {y})");
    }
    assert_eq!(layer.class_at(10.0, -10.0), (3, "obstacle"));
}

#[test]
fn a_value_is_scaled_and_none_if_unknown() {
    let view = view();
    let layer = view.layer("drivability").unwrap();
    assert_eq!(layer.value_at("unit_height", 10.0, -10.0), Some(3.5));
    assert_eq!(layer.value_at("unit_height", -5.0, -5.0), None, "marked unknown");
    assert_eq!(layer.value_at("unit_height", 100.0, 0.0), None, "outside");
    assert_eq!(layer.value_at("speed", 10.0, -10.0), None, "no such channel");
}

#[test]
fn a_map_is_stale_after_its_validity_or_if_its_age_is_unknown() {
    let view = view();
    let ms = 1_000_000;
    assert_eq!(view.age_ms(CAPTURE_END_NS + 40 * ms), 40.0);
    assert!(!view.is_stale(CAPTURE_END_NS));
    assert!(!view.is_stale(CAPTURE_END_NS + 300 * ms));
    assert!(view.is_stale(CAPTURE_END_NS + 300 * ms + 1));
    assert!(!view.is_stale(CAPTURE_END_NS - 300 * ms), "clocks may differ a little");
    assert!(view.is_stale(CAPTURE_END_NS - 301 * ms), "the age is not known by a clock this far behind");
    assert!(view.is_stale(i64::MAX) && view.is_stale(i64::MIN));
}

#[test]
fn an_unknown_layer_is_refused_with_the_present_ones() {
    match view().layer("roughness") {
        Err(ClientError::NoLayer { layer, present }) => {
            assert_eq!((layer.as_str(), present), ("roughness", vec!["drivability".to_string()]));
        }
        other => panic!("{other:?}"),
    }
}
