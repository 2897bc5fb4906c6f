//! The points of one vehicle for the page's view in 3-D.
//!
//! Each request of the page (`{"type":"points","vehicle","wanted":true}`) is answered with one frame, the newest points
//! that were not sent yet, at most one every [`PERIOD`]. The page asks again when it has drawn the frame, so no link
//! has a backlog. `"wanted":false` ends it.
//!
//! A frame is binary and little-endian. It is told apart from a `clearway.v1.MapUpdate` by its first byte: no protobuf
//! message of this package begins with it (it would begin a group).
//!
//! | bytes | |
//! |---|---|
//! | 0..4 | `CWPT` |
//! | 4..8 | u32: number of points in the frame, at most [`POINTS_MAX`] |
//! | 8..16 | i64: `capture_end_ns` of the map that was made from them |
//! | 16..20 | u32: number of points of that map; if they are more, each second, third ... one is in the frame |
//! | 20..24 | u32: length of the vehicle's name in bytes |
//! | then, for each point | i16: x, y, z in the ego frame, centimetres |
//! | then | the vehicle's name, UTF-8 |

use std::sync::Arc;
use std::time::Duration;

use bytes::{BufMut, Bytes, BytesMut};
use clearway_mapping::sensor::sweep::Sweep;
use tokio::sync::watch;
use tokio::time::Instant;
use tonic::Status;

use super::listen::access::Caller;
use super::served::Served;
use crate::engine::newest::NewestSweep;

/// Least time between two frames. Ours: a reader sees traffic move, and a frame is larger than a map.
const PERIOD: Duration = Duration::from_millis(500);
/// Most points of a frame. Ours: 360 kB; a display has few more pixels for them.
const POINTS_MAX: usize = 60_000;
/// The first bytes of a frame.
const MAGIC: &[u8; 4] = b"CWPT";

/// The points of one vehicle on their way to a browser.
pub(super) struct PagePoints {
    vehicle: Arc<str>,
    /// The engine keeps the points of a map while there is a receiver.
    sweeps: watch::Receiver<NewestSweep>,
    /// True from a request until its frame.
    is_due: bool,
    not_before: Instant,
}

impl PagePoints {
    /// The points of a vehicle, without a request.
    ///
    /// # Errors
    /// `PermissionDenied` if there is a layer of the vehicle that the caller may not read: points are of all layers.
    pub fn new(served: &Served, caller: &Caller) -> Result<Self, Status> {
        let vehicle = &served.status.name;
        match served.status.layers.iter().find(|layer| !caller.may_read(vehicle, layer)) {
            Some(layer) => Err(Status::permission_denied(format!(
                "points of {vehicle}: a reader of all its layers may have them, and layer {layer} is not allowed"
            ))),
            None => {
                let sweeps = served.wires.sweeps.subscribe();
                Ok(Self { vehicle: vehicle.clone(), sweeps, is_due: false, not_before: Instant::now() })
            }
        }
    }

    /// True if these are the points of this vehicle.
    pub fn are_of(&self, vehicle: &str) -> bool {
        *self.vehicle == *vehicle
    }

    /// Asks for one frame of points, which [`next_points`] then returns.
    pub fn request(&mut self) {
        self.is_due = true;
    }
}

/// Waits for the frame that was asked for; for ever if there is none. A call that is given up loses nothing.
pub(super) async fn next_points(points: &mut Option<PagePoints>) -> Bytes {
    let Some(points) = points.as_mut().filter(|points| points.is_due) else {
        return std::future::pending().await;
    };
    tokio::time::sleep_until(points.not_before).await;
    loop {
        if points.sweeps.changed().await.is_err() {
            // The engine has stopped.
            return std::future::pending().await;
        }
        let sweep = points.sweeps.borrow_and_update().clone();
        let Some(sweep) = sweep else { continue };
        points.is_due = false;
        points.not_before = Instant::now() + PERIOD;
        return frame(&points.vehicle, sweep.0, &sweep.1);
    }
}

/// The frame of the points of a map. A point whose coordinates do not fit is left out.
fn frame(vehicle: &str, capture_end_ns: i64, sweep: &Sweep) -> Bytes {
    let total = sweep.x.len();
    let step = total.div_ceil(POINTS_MAX).max(1);
    let points = (0..total).step_by(step).filter_map(|i| centimetres([sweep.x[i], sweep.y[i], sweep.z[i]]));
    let mut body = BytesMut::with_capacity(6 * total.div_ceil(step) + vehicle.len());
    points.for_each(|point| point.into_iter().for_each(|axis| body.put_i16_le(axis)));
    let count = body.len() / 6;
    body.put_slice(vehicle.as_bytes());
    let mut frame = BytesMut::with_capacity(24 + body.len());
    frame.put_slice(MAGIC);
    frame.put_u32_le(count as u32);
    frame.put_i64_le(capture_end_ns);
    frame.put_u32_le(total as u32);
    frame.put_u32_le(vehicle.len() as u32);
    frame.put_slice(&body);
    frame.freeze()
}

/// A point in whole centimetres; `None` if it has a coordinate that is unknown, or over 327 m.
fn centimetres(point: [f32; 3]) -> Option<[i16; 3]> {
    let fits = |axis: f32| (axis * 100.0).round().abs() <= f32::from(i16::MAX);
    point.iter().all(|&axis| fits(axis)).then(|| point.map(|axis| (axis * 100.0).round() as i16))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sweep(points: &[[f32; 3]]) -> Sweep {
        let axis = |k: usize| points.iter().map(|point| point[k]).collect();
        Sweep { x: axis(0), y: axis(1), z: axis(2), ..Sweep::default() }
    }

    #[test]
    fn a_frame_has_the_points_in_centimetres_and_counts_those_left_out() {
        let points = [[1.0, -2.0, 0.254], [400.0, 0.0, 0.0], [f32::NAN, 0.0, 0.0], [-327.67, 327.67, -0.01]];
        let frame = frame("car", -7, &sweep(&points));
        let mut expected = b"CWPT".to_vec();
        expected.extend(2_u32.to_le_bytes());
        expected.extend((-7_i64).to_le_bytes());
        expected.extend(4_u32.to_le_bytes());
        expected.extend(3_u32.to_le_bytes());
        for axis in [100_i16, -200, 25, -32767, 32767, -1] {
            expected.extend(axis.to_le_bytes());
        }
        expected.extend(b"car");
        assert_eq!(frame, expected);
    }

    #[test]
    fn a_frame_of_too_many_points_has_every_third() {
        let points: Vec<_> = (0..2 * POINTS_MAX + 1).map(|i| [(i % 7) as f32, 0.0, 0.0]).collect();
        let frame = frame("car", 0, &sweep(&points));
        let word = |at: usize| u32::from_le_bytes(frame[at..at + 4].try_into().expect("4 bytes"));
        assert_eq!((word(4), word(16)), (40_001, 120_001));
        assert_eq!(frame[24 + 6..24 + 8], 300_i16.to_le_bytes(), "the second point is the fourth of the map");
    }

    #[tokio::test]
    async fn each_request_gets_one_frame_of_the_newest_points() {
        let sender = watch::Sender::new(Some(Arc::new((1, sweep(&[[1.0, 0.0, 0.0]])))));
        let put = |stamp_ns| sender.send_replace(Some(Arc::new((stamp_ns, sweep(&[[1.0, 0.0, 0.0]])))));
        let (vehicle, sweeps, not_before) = ("car".into(), sender.subscribe(), Instant::now());
        let mut points = Some(PagePoints { vehicle, sweeps, is_due: false, not_before });
        let stamp_of = |frame: Bytes| i64::from_le_bytes(frame[8..16].try_into().expect("8 bytes"));
        put(2);
        assert_eq!(futures::poll!(std::pin::pin!(next_points(&mut points))), std::task::Poll::Pending, "no request");
        points.as_mut().expect("points").request();
        put(3);
        put(4);
        assert_eq!(stamp_of(next_points(&mut points).await), 4, "the newest");
        put(5);
        assert_eq!(futures::poll!(std::pin::pin!(next_points(&mut points))), std::task::Poll::Pending, "answered");
    }
}
