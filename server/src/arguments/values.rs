//! Texts of the command line -> how a sensor is mounted, seconds of a drive.

use clearway_mapping::config::Extrinsics;

/// Greatest number of seconds, about 30 years. Ours.
const SECONDS_MAX: f64 = 1e9;

/// Reads extrinsics from the command line: six numbers, separated by commas.
///
/// # Errors
/// If there are not six numbers.
pub fn extrinsics(text: &str) -> Result<Extrinsics, String> {
    let numbers: Vec<f64> = text.split(',').filter_map(|number| number.trim().parse().ok()).collect();
    match numbers[..] {
        [x_m, y_m, z_m, roll_deg, pitch_deg, yaw_deg] if text.split(',').count() == 6 => {
            Ok(Extrinsics { x_m, y_m, z_m, roll_deg, pitch_deg, yaw_deg })
        }
        _ => Err("six numbers are needed: x,y,z in metres, roll,pitch,yaw in degrees".into()),
    }
}

/// Reads a number of seconds after the first event.
///
/// # Errors
/// If it is not a number from 0 to 1000000000.
pub fn offset(text: &str) -> Result<f64, String> {
    let found = text.parse().ok().filter(|seconds| (0.0..=SECONDS_MAX).contains(seconds));
    found.ok_or_else(|| "0 to 1000000000 seconds are allowed".into())
}

/// Reads a number of seconds.
///
/// # Errors
/// If it is not a number above 0, up to 1000000000.
pub fn seconds(text: &str) -> Result<f64, String> {
    let found = offset(text).ok().filter(|seconds| *seconds > 0.0);
    found.ok_or_else(|| "a number of seconds above 0, up to 1000000000, is allowed".into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn extrinsics_are_six_numbers_in_metres_and_degrees() {
        let given = extrinsics("1,-0.5,1.9,0,-2.5,90").unwrap();
        assert_eq!((given.x_m, given.y_m, given.z_m), (1.0, -0.5, 1.9));
        assert_eq!((given.roll_deg, given.pitch_deg, given.yaw_deg), (0.0, -2.5, 90.0));
        for wrong in ["", "1,2,3", "1,2,3,4,5,6,7", "1,2,3,4,5,x,6"] {
            assert!(extrinsics(wrong).is_err(), "{wrong}");
        }
    }
}
