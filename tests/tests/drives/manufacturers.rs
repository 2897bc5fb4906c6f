//! Bags of other rotating LIDARs: the clouds of their ROS drivers, with their fields, rings, times and no-returns.

use clearway_ros::cdr::Header;
use clearway_ros::point_cloud2::{Field, PointCloud2};

use super::scene::*;

/// Name, offset and datatype of each field; bytes of a point; and how its driver writes a ray.
struct Driver {
    name: &'static str,
    lasers: u16,
    fields: &'static [(&'static str, u32, u8)],
    point_step: usize,
    /// True if the cloud has a place for each ray, row by row.
    organised: bool,
    write: fn(&Ray, [f32; 3], i64, &mut [u8]),
}

fn put<const N: usize>(point: &mut [u8], offset: usize, bytes: [u8; N]) {
    point[offset..offset + N].copy_from_slice(&bytes);
}

fn put_xyz(point: &mut [u8], at: [f32; 3]) {
    at.into_iter().enumerate().for_each(|(axis, value)| put(point, 4 * axis, value.to_le_bytes()));
}

const DRIVERS: [Driver; 4] = [
    // ouster_ros: organised, rings from the top, ns after the header, (0, 0, 0) without a return.
    Driver {
        name: "Ouster OS-128",
        lasers: 128,
        fields: &[
            ("x", 0, 7),
            ("y", 4, 7),
            ("z", 8, 7),
            ("intensity", 16, 7),
            ("t", 20, 6),
            ("reflectivity", 24, 4),
            ("ring", 26, 4),
            ("ambient", 28, 4),
            ("range", 32, 6),
        ],
        point_step: 48,
        organised: true,
        write: |ray, at, _, point| {
            put_xyz(point, at);
            put(point, 16, 300.0_f32.to_le_bytes());
            put(point, 20, ray.after_ns.to_le_bytes());
            put(point, 26, (127 - ray.ring).to_le_bytes());
        },
    },
    // hesai_ros_driver: rings from the top, seconds since the epoch.
    Driver {
        name: "Hesai Pandar64",
        lasers: 64,
        fields: &[("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7), ("ring", 16, 4), ("timestamp", 18, 8)],
        point_step: 26,
        organised: false,
        write: |ray, at, stamp_ns, point| {
            put_xyz(point, at);
            put(point, 16, (63 - ray.ring).to_le_bytes());
            put(point, 18, ((stamp_ns as f64 + f64::from(ray.after_ns)) * 1e-9).to_le_bytes());
        },
    },
    // rslidar_sdk: organised, NaN without a return, seconds since the epoch, not dense.
    Driver {
        name: "RoboSense RS-LiDAR-32",
        lasers: 32,
        fields: &[("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7), ("ring", 16, 4), ("timestamp", 18, 8)],
        point_step: 26,
        organised: true,
        write: |ray, at, stamp_ns, point| {
            let at = if at == [0.0; 3] { [f32::NAN; 3] } else { at };
            put_xyz(point, at);
            put(point, 16, ray.ring.to_le_bytes());
            put(point, 18, ((stamp_ns as f64 + f64::from(ray.after_ns)) * 1e-9).to_le_bytes());
        },
    },
    // livox_ros_driver2, xfer_format 0: lines, ns since the epoch as a double.
    Driver {
        name: "Livox HAP",
        lasers: 32,
        fields: &[
            ("x", 0, 7),
            ("y", 4, 7),
            ("z", 8, 7),
            ("intensity", 12, 7),
            ("tag", 16, 2),
            ("line", 17, 2),
            ("timestamp", 18, 8),
        ],
        point_step: 26,
        organised: false,
        write: |ray, at, stamp_ns, point| {
            put_xyz(point, at);
            put(point, 17, [ray.ring as u8]);
            put(point, 18, (stamp_ns as f64 + f64::from(ray.after_ns)).to_le_bytes());
        },
    },
];

impl Driver {
    fn cloud(&self, stamp_ns: i64) -> PointCloud2<'static> {
        let mut rays = rays(self.lasers);
        rays.sort_by_key(|ray| (self.lasers - ray.ring, ray.column));
        let mut data = Vec::new();
        for ray in rays.iter().filter(|ray| self.organised || ray.at.is_some()) {
            let mut point = vec![0; self.point_step];
            (self.write)(ray, ray.at.unwrap_or_default(), stamp_ns, &mut point);
            data.extend(point);
        }
        let points = (data.len() / self.point_step) as u32;
        let (height, width) = if self.organised { (self.lasers.into(), COLUMNS) } else { (1, points) };
        let field = |&(name, offset, datatype): &(&'static str, u32, u8)| Field { name, offset, datatype, count: 1 };
        PointCloud2 {
            header: Header { stamp_ns, frame_id: "velodyne" },
            height,
            width,
            fields: self.fields.iter().map(field).collect(),
            big_endian: false,
            point_step: self.point_step as u32,
            row_step: width * self.point_step as u32,
            data: data.leak(),
            dense: false,
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_bag_of_each_manufacturer_gives_the_maps_of_its_scene() {
    for driver in DRIVERS {
        let returns = rays(driver.lasers).iter().filter(|ray| ray.at.is_some()).count() as u64;
        let (summary, headers) = replayed_bag(drive_of(3, |stamp_ns| driver.cloud(stamp_ns)), &[]).await;
        let name = driver.name;
        assert_eq!((headers.len(), summary.snapshot.maps_with_pose), (3, 3), "{name}: {:?}", summary.notes);
        assert!(headers.iter().all(|header| header.compensation == "poses"), "{name}: {:?}", summary.notes);
        assert_eq!(summary.snapshot.sensors[0].status.returns, 3 * returns, "{name}");
        assert_eq!(summary.to_json()["sensors"][0]["elevations"], "rings", "{name}");
        let share = summary.snapshot.drivable_share.unwrap();
        assert!(share > 0.9 && summary.snapshot.refused() == 0, "{name}: {share} drivable");
    }
}
