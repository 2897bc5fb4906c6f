//! A cloud of any layout decodes to the points that were encoded.

use clearway_ros::cdr::Header;
use clearway_ros::point_cloud2::{Datatype, Field};
use clearway_ros::{PointCloud2, Points};
use proptest::prelude::*;
use proptest::sample::select;

/// One point of a test.
#[derive(Clone, Debug)]
struct Point {
    xyz: [f32; 3],
    intensity: u8,
    ring: u8,
    time_ns: u32,
}

fn point() -> impl Strategy<Value = Point> {
    let position = proptest::array::uniform3(prop_oneof![-200.0_f32..200.0, Just(f32::NAN), Just(0.0)]);
    (position, any::<u8>(), 0..128_u8, 0..200_000_000_u32).prop_map(|(xyz, intensity, ring, time_ns)| Point {
        xyz,
        intensity,
        ring,
        time_ns,
    })
}

fn number(datatype: Datatype, value: f64, big_endian: bool) -> Vec<u8> {
    let mut bytes = match datatype {
        Datatype::Int8 => (value as i8).to_le_bytes().to_vec(),
        Datatype::Uint8 => (value as u8).to_le_bytes().to_vec(),
        Datatype::Int16 => (value as i16).to_le_bytes().to_vec(),
        Datatype::Uint16 => (value as u16).to_le_bytes().to_vec(),
        Datatype::Int32 => (value as i32).to_le_bytes().to_vec(),
        Datatype::Uint32 => (value as u32).to_le_bytes().to_vec(),
        Datatype::Float32 => (value as f32).to_le_bytes().to_vec(),
        Datatype::Float64 => value.to_le_bytes().to_vec(),
        Datatype::Int64 => (value as i64).to_le_bytes().to_vec(),
        Datatype::Uint64 => (value as u64).to_le_bytes().to_vec(),
    };
    if big_endian {
        bytes.reverse();
    }
    bytes
}

proptest! {
    #[test]
    fn points_of_any_layout_decode_to_themselves(
        points in proptest::collection::vec(point(), 1..40),
        rows in 1..4_usize,
        gaps in proptest::array::uniform6(0..9_usize),
        row_padding in 0..9_usize,
        order in Just([0, 1, 2, 3, 4, 5_usize]).prop_shuffle(),
        big_endian: bool,
        double: bool,
        ring_type in select(vec![Datatype::Uint8, Datatype::Uint16, Datatype::Int32, Datatype::Uint32]),
        names in (select(vec!["ring", "channel"]), select(vec!["t", "time_stamp"])),
    ) {
        let width = points.len().div_ceil(rows);
        let xyz = if double { Datatype::Float64 } else { Datatype::Float32 };
        let kinds = [
            ("x", xyz),
            ("y", xyz),
            ("z", xyz),
            ("intensity", Datatype::Uint8),
            (names.0, ring_type),
            (names.1, Datatype::Uint32),
        ];
        let mut offset = 0;
        let fields: Vec<Field> = order.iter().zip(gaps).map(|(&kind, gap)| {
            let (name, datatype) = kinds[kind];
            let field = Field { name, offset: (offset + gap) as u32, datatype: datatype as u8, count: 1 };
            offset += gap + datatype.size() as usize;
            field
        }).collect();
        let (step, absent) = (offset, Point { xyz: [f32::NAN; 3], intensity: 0, ring: 0, time_ns: 0 });
        let mut data = Vec::new();
        for row in 0..rows {
            for column in 0..width {
                let point = points.get(row * width + column).unwrap_or(&absent);
                let [x, y, z] = point.xyz.map(f64::from);
                let values = [x, y, z, point.intensity.into(), point.ring.into(), f64::from(point.time_ns)];
                let start = data.len();
                data.resize(start + step, 0xAA);
                for (&kind, field) in order.iter().zip(&fields) {
                    let bytes = number(kinds[kind].1, values[kind], big_endian);
                    data[start + field.offset as usize..][..bytes.len()].copy_from_slice(&bytes);
                }
            }
            data.resize(data.len() + row_padding, 0xBB);
        }
        let cloud = PointCloud2 {
            header: Header { stamp_ns: 5_000_000_007, frame_id: "top" },
            height: rows as u32,
            width: width as u32,
            fields,
            big_endian,
            point_step: step as u32,
            row_step: (width * step + row_padding) as u32,
            data: &data,
            dense: false,
        };
        let bytes = cloud.to_cdr();
        let read = PointCloud2::new(&bytes).unwrap();
        prop_assert_eq!(&read, &cloud);
        let read = Points::from_cloud(&read).unwrap();

        let has_return = |p: &&Point| !p.xyz.iter().any(|v| v.is_nan()) && p.xyz != [0.0; 3];
        let seen: Vec<&Point> = points.iter().filter(has_return).collect();
        prop_assert_eq!(read.no_returns as usize, rows * width - seen.len());
        let newest = seen.iter().map(|p| p.time_ns).max().unwrap_or(0);
        prop_assert_eq!(read.stamp_ns, 5_000_000_007 + i64::from(newest));
        let is_reversed = seen.first().is_some_and(|p| read.ring[0] != u16::from(p.ring)) || {
            seen.iter().zip(&read.ring).any(|(p, ring)| *ring != u16::from(p.ring))
        };
        let highest = seen.iter().map(|p| u16::from(p.ring)).max().unwrap_or(0) + 1;
        let rings = if highest < 8 { highest.next_power_of_two() } else { highest.next_multiple_of(8) };
        for (index, point) in seen.iter().enumerate() {
            prop_assert_eq!([read.x[index], read.y[index], read.z[index]], point.xyz);
            prop_assert_eq!(read.intensity[index], f32::from(point.intensity) / 255.0);
            prop_assert_eq!(read.offset_ns[index], point.time_ns as i32 - newest as i32);
            let ring = u16::from(point.ring);
            prop_assert_eq!(read.ring[index], if is_reversed { rings - 1 - ring } else { ring });
        }
    }
}
