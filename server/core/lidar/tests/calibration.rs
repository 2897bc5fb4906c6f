//! Calibrations: factory tables, round trips of texts, errors with key and value, and all recorded files.

use clearway_lidar::{Calibration, CalibrationError, LaserCalibration, Model};

#[test]
fn factory_tables_have_all_lasers_within_the_elevations_of_the_model() {
    for model in Model::ALL {
        let calibration = Calibration::factory(model);
        calibration.fits(model).unwrap();
        let mut rings = calibration.rings();
        let (low, high) = model.spec().elevation_deg;
        let degrees = |ring: u16| {
            let laser = rings.iter().position(|r| *r == ring).unwrap();
            calibration.lasers[laser].vert_correction.to_degrees() as f32
        };
        assert!((degrees(0) - low).abs() < 0.01, "{model:?} {}", degrees(0));
        assert!((degrees(model.spec().lasers as u16 - 1) - high).abs() < 0.01, "{model:?}");
        rings.sort_unstable();
        assert!(rings.iter().copied().eq(0..model.spec().lasers as u16), "{model:?}");
    }
}

#[test]
fn yaml_is_read_as_written_to_the_last_bit() {
    for model in Model::ALL {
        let mut calibration = Calibration::factory(model);
        for (index, laser) in calibration.lasers.iter_mut().enumerate() {
            laser.dist_correction = 1.0 / 3.0 + index as f64 / 70.0;
            if index % 2 == 0 {
                (laser.dist_correction_x, laser.max_intensity) = (Some(0.1 + 0.2), Some(255));
                laser.focal_slope = Some(1e-17);
            }
        }
        let yaml = calibration.to_yaml();
        assert_eq!(Calibration::load_str(&yaml).unwrap(), calibration, "{model:?}");
        assert!(!calibration.with_two_point_corrections(true).lasers[0].two_pt_correction_available);
    }
}

fn yaml(lasers: usize, first: &str) -> String {
    let others = (1..lasers).map(|id| format!("- {{laser_id: {id}, vert_correction: 0.1}}\n"));
    format!("distance_resolution: 0.002\nlasers:\n- {{{first}}}\n{}", others.collect::<String>())
}

#[test]
fn yaml_errors_name_key_value_and_what_is_allowed() {
    let first = |first: &str| Calibration::load_str(&yaml(16, first)).map_err(|error| error.to_string());
    let sound = first("laser_id: 0, vert_correction: -0.2, unknown: [1, {2: 3}]").unwrap();
    assert_eq!(sound.lasers[0], LaserCalibration { vert_correction: -0.2, ..LaserCalibration::default() });
    for (text, expected) in [
        ("vert_correction: 1", "lasers[0].laser_id: missing; it must be a whole number, 0 to 127"),
        ("laser_id: 0", "lasers[0].vert_correction: missing; it must be an angle in radians, -1.6 to 1.6"),
        (
            "laser_id: 0, vert_correction: -15",
            "lasers[0].vert_correction: -15 is not allowed; it must be an angle in radians, -1.6 to 1.6",
        ),
        (
            "laser_id: 0, vert_correction: steep",
            "lasers[0].vert_correction: `steep` is not allowed; it must be an angle in radians, -1.6 to 1.6",
        ),
        (
            "laser_id: 1, vert_correction: 0",
            "lasers[0].laser_id: 1 is not allowed; it must be each of 0 to the number of lasers less one, once",
        ),
        (
            "laser_id: 0, vert_correction: 0, dist_correction: .nan",
            "lasers[0].dist_correction: NaN is not allowed; it must be a length in metres, -10 to 10",
        ),
        (
            "laser_id: 0, vert_correction: 0.1, vert_correction: 0.2",
            "lasers[0].vert_correction: given twice, as 0.1 and 0.2",
        ),
        (
            "laser_id: 0, vert_correction: 0, max_intensity: 256",
            "lasers[0].max_intensity: 256 is not allowed; it must be a whole number, 0 to 255",
        ),
        (
            "laser_id: 0, vert_correction: 0, two_pt_correction_available: 7",
            "lasers[0].two_pt_correction_available: 7 is not allowed; it must be true or false",
        ),
    ] {
        assert_eq!(first(text).unwrap_err(), expected);
    }
    assert!(first("laser_id: 0, vert_correction: 0.1, vert_correction: 0.1").is_ok());
    let shown = |text: &str| Calibration::load_str(text).unwrap_err().to_string();
    assert_eq!(shown("distance_resolution: 0.002"), "lasers: missing; it must be a list with one map a laser");
    assert!(shown(&yaml(17, "laser_id: 0, vert_correction: 0")).contains("17 of them"));
    let counted = yaml(16, "laser_id: 0, vert_correction: 0") + "num_lasers: 15\n";
    assert_eq!(shown(&counted), "num_lasers: 15 is not allowed; it must be the number of lasers listed");
    assert!(shown("[1, 2").starts_with("not YAML"));
    assert_eq!(shown("12"), "12 instead of a map of keys; ROS YAML or Velodyne XML is allowed");
    assert_eq!(shown("  \n"), "an empty text; ROS YAML or Velodyne XML is allowed");
}

fn xml(first: &str) -> String {
    let others = (1..16).map(|id| format!("<item><px><id_>{id}</id_><vertCorrection_>1</vertCorrection_></px></item>"));
    format!(
        "<?xml version=\"1.0\"?>\n<!DOCTYPE boost_serialization>\n<boost_serialization><DB><distLSB_>0.2</distLSB_>\
         <points_><item><px>{first}</px></item>{}</points_></DB></boost_serialization>",
        others.collect::<String>()
    )
}

#[test]
fn xml_is_in_degrees_and_centimetres_and_errors_name_the_element() {
    let sound = "<id_>0</id_><vertCorrection_>-90</vertCorrection_><distCorrection_>106</distCorrection_>\
                 <distCorrectionX_>108</distCorrectionX_><distCorrectionY_>111</distCorrectionY_>";
    let calibration = Calibration::load_str(&xml(sound)).unwrap();
    assert!((calibration.distance_m_per_count - 0.002).abs() < 1e-12);
    let laser = calibration.lasers[0];
    assert!((laser.vert_correction + std::f64::consts::FRAC_PI_2).abs() < 1e-12);
    assert!((laser.dist_correction - 1.06).abs() < 1e-12 && !laser.two_pt_correction_available);
    assert!(calibration.with_two_point_corrections(true).lasers[0].two_pt_correction_available);

    let shown = |text: &str| Calibration::load_str(text).unwrap_err().to_string();
    assert!(shown("<a").starts_with("not XML"));
    assert_eq!(shown("<a/>"), "a.DB: missing; it must be the calibration database");
    assert_eq!(
        shown(&xml("<id_>0</id_>")),
        "points_.item[0].px.vertCorrection_: missing; it must be an angle in radians, -1.6 to 1.6"
    );
    assert_eq!(
        shown(&xml("<id_>zero</id_>")),
        "points_.item[0].px.id_: `zero` is not allowed; it must be a whole number, 0 to 127"
    );
}

#[test]
fn the_list_of_enabled_lasers_removes_lasers_and_must_be_complete() {
    let sound = xml("<id_>0</id_><vertCorrection_>2</vertCorrection_>");
    let with = |name: &str, items: &[&str]| {
        let items: String = items.iter().map(|item| format!("<item>{item}</item>")).collect();
        Calibration::load_str(&sound.replace("<points_>", &format!("<{name}>{items}</{name}><points_>")))
    };
    let shown = |name: &str, items: &[&str]| with(name, items).unwrap_err().to_string();
    let mut enabled = ["1"; 16];
    assert_eq!(with("enabled_", &enabled), Calibration::load_str(&sound));
    enabled[15] = "0";
    // The list disables the last laser; no sensor has fifteen lasers.
    assert!(shown("enabled_", &enabled).contains("15 of them"), "{}", shown("enabled_", &enabled));
    for bad in ["yes", "", "-1", "2", "NaN", "0.5"] {
        enabled[3] = bad;
        let expected =
            format!("enabled_.item[3]: `{bad}` is not allowed; it must be 1 or 0, for each laser of points_");
        assert_eq!(shown("enabled_", &enabled), expected);
    }
    let expected = "enabled_.item[3]: missing; it must be 1 or 0, for each laser of points_";
    assert_eq!(shown("enabled_", &enabled[..3]), expected);
    assert_eq!(
        shown("maxIntensity_", &["255", "256"]),
        "maxIntensity_.item[1]: `256` is not allowed; it must be a whole number, 0 to 255"
    );
}

#[test]
fn a_padded_table_is_cut_and_a_short_one_is_refused() {
    let padded = Calibration::factory(Model::Hdl64eS2);
    assert_eq!(padded.clone().cut_to(Model::Vlp16).unwrap().lasers.len(), 16);
    let error = padded.cut_to(Model::Vls128).unwrap_err();
    assert_eq!(error, CalibrationError::Lasers { found: 64, model: "VLS-128", expected: 128 });
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn every_recorded_calibration_is_read() {
    let mut read = 0;
    for folder in ["nebula", "ros-drivers", "valgur", "xml"] {
        let folder = format!("{}/calib/{folder}", env!("CLEARWAY_DRIVES"));
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            let calibration = Calibration::load_str(&std::fs::read_to_string(&path).unwrap());
            let calibration = calibration.unwrap_or_else(|error| panic!("{}: {error}", path.display()));
            assert_eq!(Calibration::load_str(&calibration.to_yaml()).unwrap(), calibration, "{}", path.display());
            read += 1;
        }
    }
    assert!(read >= 32, "{read}");
}

#[test]
#[cfg_attr(not(clearway_data), ignore = "needs the recorded drives: set CLEARWAY_DATA")]
fn factory_tables_equal_those_of_veloview() {
    for (model, file) in [
        (Model::Hdl32e, "HDL-32E.yml"),
        (Model::Vlp16, "VLP-16.yml"),
        (Model::PuckHiRes, "Puck_Hi-Res.yml"),
        (Model::Vlp32c, "VLP-32C.yml"),
        (Model::Vls128, "Alpha_Prime.yml"),
    ] {
        let path = format!("{}/calib/valgur/{file}", env!("CLEARWAY_DRIVES"));
        let theirs = Calibration::load_str(&std::fs::read_to_string(path).unwrap()).unwrap();
        let ours = Calibration::factory(model);
        assert_eq!(ours.distance_m_per_count, theirs.distance_m_per_count, "{model:?}");
        for (ours, theirs) in ours.lasers.iter().zip(&theirs.lasers) {
            assert!((ours.vert_correction - theirs.vert_correction).abs() < 1e-4, "{model:?} {ours:?}");
            assert!((ours.rot_correction - theirs.rot_correction).abs() < 1e-4, "{model:?} {ours:?}");
        }
    }
}
