//! The OpenCalib scenes: a sensor on the roof and one at each side, as sweeps in the ego frame.
#![cfg_attr(not(clearway_data), allow(unused))]

use clearway_mapping::sensor::mount;
use clearway_mapping::sensor::sweep::Sweep;
use nalgebra::{Isometry3, Matrix3, Matrix4, Point3, Rotation3, Translation3, UnitQuaternion};

use super::{add, data};

/// One sensor's scan and its position, ego frame.
pub struct Sensor {
    pub sweep: Sweep,
    pub origin_m: [f32; 3],
}

/// The sensors top, left, right. The mount of the top sensor is estimated from the ground it sees.
pub fn sensors(scene: &str) -> Vec<Sensor> {
    let folder = format!("multilidar/opencalib/real_world/{scene}");
    let extrinsics = std::fs::read_to_string(data(&format!("{folder}/extrinsics_from_result.json"))).unwrap();
    let mut files: Vec<String> = std::fs::read_dir(data(&folder))
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .filter(|name| name.ends_with(".pcd") && !name.starts_with("result"))
        .collect();
    files.sort_by_key(|name| !name.starts_with("top"));
    let clouds: Vec<Vec<[f32; 3]>> = files.iter().map(|file| points(&format!("{folder}/{file}"))).collect();
    let ego_from_top = mount::estimate([&clouds[0]]).unwrap().extrinsics().ego_from_sensor();
    let sensor = |(file, cloud): (&String, &Vec<[f32; 3]>)| {
        let ego_from_sensor = ego_from_top * top_from_sensor(&extrinsics, file);
        let mut sweep = Sweep::default();
        for point in cloud.iter().filter(|[x, y, z]| x * x + y * y + z * z > 4.0) {
            let point = ego_from_sensor * Point3::from(*point).cast::<f64>();
            add(&mut sweep, point.cast::<f32>().into());
        }
        Sensor { sweep, origin_m: ego_from_sensor.translation.vector.cast::<f32>().into() }
    };
    files.iter().zip(&clouds).map(sensor).collect()
}

/// The matrix that follows the name of the sensor, row by row.
pub fn top_from_sensor(extrinsics: &str, file: &str) -> Isometry3<f64> {
    let matrix = extrinsics.split(&format!("\"{file}\"")).nth(1).unwrap().split("T_top_from_sensor\":").nth(1).unwrap();
    let numbers = matrix.split(|c: char| !(c.is_ascii_digit() || "+-.e".contains(c)));
    let numbers: Vec<f64> = numbers.filter_map(|number| number.parse().ok()).take(16).collect();
    let matrix = Matrix4::from_row_slice(&numbers);
    let rotation = Rotation3::from_matrix(&Matrix3::from(matrix.fixed_view::<3, 3>(0, 0)));
    let translation = Translation3::new(matrix[(0, 3)], matrix[(1, 3)], matrix[(2, 3)]);
    Isometry3::from_parts(translation, UnitQuaternion::from_rotation_matrix(&rotation))
}

/// Positions in a PCD file of `x y z intensity ring timestamp`, stored field by field and packed by LZF.
fn points(path: &str) -> Vec<[f32; 3]> {
    let bytes = std::fs::read(data(path)).unwrap();
    let header = b"DATA binary_compressed\n";
    let body = bytes.windows(header.len()).position(|window| window == header).unwrap() + header.len();
    let plain = unpack_lzf(&bytes[body + 8..]);
    let count = plain.len() / 26;
    let value = |field: usize, point: usize| {
        let at = 4 * (field * count + point);
        f32::from_le_bytes(plain[at..at + 4].try_into().unwrap())
    };
    let points = (0..count).map(|point| [0, 1, 2].map(|field| value(field, point)));
    points.filter(|point| point.iter().all(|value| value.is_finite())).collect()
}

/// Unpacks LZF: a byte under 32 is the number of plain bytes that follow, minus one; other bytes repeat earlier output.
pub fn unpack_lzf(mut packed: &[u8]) -> Vec<u8> {
    let mut plain = Vec::new();
    while let [control, rest @ ..] = packed {
        let control = usize::from(*control);
        if control < 32 {
            let (run, after) = rest.split_at(control + 1);
            plain.extend_from_slice(run);
            packed = after;
            continue;
        }
        let long = control >> 5 == 7;
        let length = (control >> 5) + 2 + if long { usize::from(rest[0]) } else { 0 };
        let rest = &rest[usize::from(long)..];
        let start = plain.len() - ((control & 31) << 8) - usize::from(rest[0]) - 1;
        (start..start + length).for_each(|at| plain.push(plain[at]));
        packed = &rest[1..];
    }
    plain
}
