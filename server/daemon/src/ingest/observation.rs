//! One `clearway.v1.Observation` -> the bodies of its events. Pure: this file reads no clock and never waits.
//!
//! An observation is bytes of a client. All lengths are compared before any allocation, and an allocation is no longer
//! than the message. The core checks the rest (stamps, poses, roads, lists of different lengths), so that the journal
//! contains its refusals.

use bytes::Bytes;
use clearway_mapping::event::Body;
use clearway_proto::packed::unpack;
use clearway_proto::v1;

use clearway_journal::encode::event::NoCounterpartError;
use clearway_journal::encode::{ego_pose_from_proto, road_from_proto, scan_from_proto, sensor_from_proto};

/// The limits of one observation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Greatest number of points of one scan, and of rays without a return.
    pub points_max: usize,
    /// Greatest length of one message in bytes; more than `points_max` points with all their fields need.
    pub message_bytes_max: usize,
    /// Greatest time by which a stamp may be ahead of the server's clock, ns.
    pub ahead_ns_max: i64,
}

/// Greatest number of datagrams in one observation. Ours: a third of a second of an HDL-64E; a client that collects
/// more has waited too long.
pub const PACKETS_MAX: usize = 1024;
/// Bytes of one point in a message: x, y, z, intensity, ring and offset_ns have 22, half a ray without a return has 6,
/// and 4 are spare.
const POINT_BYTES: usize = 32;
/// Bytes of a message beside its points. Ours: ample for the other fields.
const MESSAGE_BYTES: usize = 64 << 10;

impl Limits {
    /// The limits for scans of at most `points_max` points.
    pub fn from_points_max(points_max: usize) -> Self {
        let message_bytes_max = points_max.saturating_mul(POINT_BYTES).saturating_add(MESSAGE_BYTES);
        Self { points_max, message_bytes_max, ahead_ns_max: i64::MAX }
    }
}

/// Why an observation did not become events.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ObservationError {
    /// The bytes do not decode as an observation.
    #[error("not a clearway.v1.Observation: {reason}")]
    Message {
        /// Error of the protobuf decoder.
        reason: String,
    },
    /// The message is longer than any allowed scan.
    #[error("message of {bytes} bytes: up to {bytes_max} are allowed")]
    Length {
        /// Length of the message, in bytes.
        bytes: usize,
        /// Greatest length in bytes, [`Limits::message_bytes_max`].
        bytes_max: usize,
    },
    /// The observation has no body, or a body that this version does not know.
    #[error("observation without a body: scan, ego_pose, road, packets, end or declaration is allowed")]
    Body,
    /// A packed list ends within a number.
    #[error("{list} of {bytes} bytes: a multiple of {number_bytes} bytes is allowed")]
    Part {
        /// Field of the list, as in `clearway.v1.Observation`.
        list: &'static str,
        /// The list's length in bytes.
        bytes: usize,
        /// Length of one number in bytes.
        number_bytes: usize,
    },
    /// A scan has too many points.
    #[error("scan with {count} {what}: up to {points_max} are allowed")]
    Points {
        /// The kind of element: points, rays, ...
        what: &'static str,
        /// Number of elements.
        count: usize,
        /// Greatest number, [`Limits::points_max`].
        points_max: usize,
    },
    /// The columns do not match the points of the scan.
    #[error(
        "{columns} columns with {points} points together and {offsets} offsets, of a scan of {of} points{also}: \
         one offset a column and all points are allowed"
    )]
    Columns {
        /// Number of columns.
        columns: usize,
        /// Number of points of all columns.
        points: usize,
        /// Number of offsets.
        offsets: usize,
        /// Number of points of the scan.
        of: usize,
        /// A further fault: the points have offsets of their own, or there is no scan.
        also: &'static str,
    },
    /// The lengths or stamps of the datagrams do not match their bytes.
    #[error(
        "{lengths} datagrams of {claimed} bytes together and {stamps} stamps, in {bytes} bytes: 1 to {PACKETS_MAX} \
         datagrams, a stamp each and all bytes are allowed"
    )]
    Packets {
        /// Number of lengths.
        lengths: usize,
        /// Sum of the lengths.
        claimed: usize,
        /// Number of stamps.
        stamps: usize,
        /// Length of all payloads in bytes.
        bytes: usize,
    },
    /// A stamp is ahead of the server's clock.
    #[error(
        "stamp {stamp_ns} ns: {} ms ahead of the server's clock; up to {} ms are allowed",
        .ahead_ns / 1_000_000,
        .ahead_ns_max / 1_000_000
    )]
    StampAhead {
        /// The stamp, ns since the Unix epoch.
        stamp_ns: i64,
        /// Time by which it is ahead, ns.
        ahead_ns: i64,
        /// Greatest time ahead in ns, [`Limits::ahead_ns_max`].
        ahead_ns_max: i64,
    },
    /// A required field is missing.
    #[error("{body} without {what}")]
    Missing {
        /// `ego_pose`, `road`, `scan` or `declaration`.
        body: &'static str,
        /// Name of the missing field.
        what: &'static str,
    },
}

impl ObservationError {
    /// The key by which the refusal is counted.
    pub fn reason(&self) -> &'static str {
        match self {
            Self::Message { .. } => "message",
            Self::Length { .. } => "message_length",
            Self::Body => "body",
            Self::Part { .. } => "packed",
            Self::Points { .. } => "points",
            Self::Columns { .. } => "columns",
            Self::Packets { .. } => "packets",
            Self::StampAhead { .. } => "stamp_ahead",
            Self::Missing { .. } => "missing",
        }
    }
}

/// The event bodies of one observation, each with the stamp of its capture, ns since the Unix epoch; `None` stands for
/// the time at which the queue receives it.
pub type Bodies = Vec<(Option<i64>, Body)>;

/// Decodes an observation into the bodies of its events.
///
/// # Errors
/// Every variant of [`ObservationError`] except `Message` and `Length`, which concern the undecoded bytes.
pub fn decode(observation: v1::Observation, limits: &Limits) -> Result<Bodies, ObservationError> {
    let v1::Observation { captured_ns, body, columns, .. } = observation;
    let captured_ns = (captured_ns != 0).then_some(captured_ns);
    let missing = |body| move |NoCounterpartError(what)| ObservationError::Missing { body, what };
    let body = body.ok_or(ObservationError::Body)?;
    if let (Some(columns), false) = (&columns, matches!(body, v1::observation::Body::Scan(_))) {
        return Err(columns_error(columns, 0, " (there is none)"));
    }
    let body = match body {
        v1::observation::Body::Packets(packets) => return datagrams(packets),
        v1::observation::Body::Scan(mut scan) => {
            check_lists(&scan, limits)?;
            if let Some(columns) = &columns {
                scan.offset_ns = expand_columns(columns, &scan)?;
            }
            let mut scan = scan_from_proto(scan).map_err(missing("scan"))?;
            if scan.intensity.is_empty() {
                scan.intensity.resize(scan.x.len(), 0.0);
            }
            Body::Scan(scan)
        }
        v1::observation::Body::EgoPose(ego) => {
            Body::EgoPose(ego_pose_from_proto(&ego).ok_or(missing("ego_pose")(NoCounterpartError("map_from_ego")))?)
        }
        v1::observation::Body::Road(road) => Body::Road(road_from_proto(road).map_err(missing("road"))?),
        v1::observation::Body::End(v1::End {}) => Body::End,
        v1::observation::Body::Declaration(sensor) => {
            Body::Sensor(Box::new(sensor_from_proto(sensor).map_err(missing("declaration"))?))
        }
    };
    Ok(vec![(captured_ns, body)])
}

/// Returns `bodies` if no stamp in them is too far ahead of the server's clock `now_ns`. A stamp of the past is
/// allowed: it may come from an old drive, and a map never looks younger by it.
///
/// # Errors
/// [`ObservationError::StampAhead`] with the first stamp that is.
pub fn check_stamps(bodies: Bodies, now_ns: i64, limits: &Limits) -> Result<Bodies, ObservationError> {
    for (captured_ns, body) in &bodies {
        let of_body = match body {
            Body::Scan(scan) => Some(scan.stamp_ns),
            Body::EgoPose(pose) => Some(pose.stamp_ns),
            Body::Road(road) => Some(road.stamp_ns),
            _ => None,
        };
        for stamp_ns in [*captured_ns, of_body].into_iter().flatten() {
            let ahead_ns = stamp_ns.saturating_sub(now_ns);
            if ahead_ns > limits.ahead_ns_max {
                return Err(ObservationError::StampAhead { stamp_ns, ahead_ns, ahead_ns_max: limits.ahead_ns_max });
            }
        }
    }
    Ok(bodies)
}

/// Checks that every list of a scan consists of whole numbers and that none is too long.
fn check_lists(scan: &v1::Scan, limits: &Limits) -> Result<(), ObservationError> {
    let points_max = limits.points_max;
    let lists = [
        ("x", &scan.x, 4, "points"),
        ("y", &scan.y, 4, "points"),
        ("z", &scan.z, 4, "points"),
        ("intensity", &scan.intensity, 4, "intensities"),
        ("ring", &scan.ring, 2, "rings"),
        ("offset_ns", &scan.offset_ns, 4, "offsets"),
        ("no_returns", &scan.no_returns, 12, "rays without a return"),
    ];
    for (list, bytes, number_bytes, what) in lists {
        let count = bytes.len() / number_bytes;
        if !bytes.len().is_multiple_of(number_bytes) {
            return Err(ObservationError::Part { list, bytes: bytes.len(), number_bytes });
        }
        if count > points_max {
            return Err(ObservationError::Points { what, count, points_max });
        }
    }
    Ok(())
}

fn columns_error(columns: &v1::Columns, of: usize, also: &'static str) -> ObservationError {
    let points: Vec<u16> = unpack(&columns.points).unwrap_or_default();
    ObservationError::Columns {
        columns: points.len(),
        points: points.iter().copied().map(usize::from).sum(),
        offsets: columns.offset_ns.len() / 4,
        of,
        also,
    }
}

/// The offset of each point, packed: the offset of its column.
fn expand_columns(columns: &v1::Columns, scan: &v1::Scan) -> Result<Bytes, ObservationError> {
    let of = scan.x.len() / 4;
    if !scan.offset_ns.is_empty() {
        return Err(columns_error(columns, of, " that have offsets of their own"));
    }
    let part = |list, bytes: &Bytes, number_bytes| ObservationError::Part { list, bytes: bytes.len(), number_bytes };
    let points: Vec<u16> = unpack(&columns.points).ok_or_else(|| part("columns.points", &columns.points, 2))?;
    if !columns.offset_ns.len().is_multiple_of(4) {
        return Err(part("columns.offset_ns", &columns.offset_ns, 4));
    }
    let total: usize = points.iter().copied().map(usize::from).sum();
    if columns.offset_ns.len() / 4 != points.len() || total != of {
        return Err(columns_error(columns, of, ""));
    }
    let mut expanded = Vec::with_capacity(total * 4);
    for (offset_ns, &points) in columns.offset_ns.chunks_exact(4).zip(&points) {
        (0..points).for_each(|_| expanded.extend_from_slice(offset_ns));
    }
    Ok(expanded.into())
}

/// The datagrams of one observation; each shares the bytes of the message.
fn datagrams(packets: v1::Packets) -> Result<Bodies, ObservationError> {
    let v1::Packets { captured_ns, lengths, payloads: mut rest } = packets;
    let part = |list, bytes: &Bytes, number_bytes| ObservationError::Part { list, bytes: bytes.len(), number_bytes };
    let count = lengths.len() / 2;
    let stamps = captured_ns.len() / 8;
    let claimed = lengths.chunks_exact(2).map(|length| usize::from(u16::from_le_bytes([length[0], length[1]]))).sum();
    if count == 0 || count > PACKETS_MAX || stamps != count || claimed != rest.len() {
        return Err(ObservationError::Packets { lengths: count, claimed, stamps, bytes: rest.len() });
    }
    let lengths: Vec<u16> = unpack(&lengths).ok_or_else(|| part("lengths", &lengths, 2))?;
    let stamps: Vec<i64> = unpack(&captured_ns).ok_or_else(|| part("captured_ns", &captured_ns, 8))?;
    let datagram = |(length, stamp_ns)| (Some(stamp_ns), Body::Datagram(rest.split_to(usize::from(length))));
    Ok(lengths.into_iter().zip(stamps).map(datagram).collect())
}

#[cfg(test)]
mod tests {
    use clearway_mapping::event::Scan;
    use clearway_proto::packed::pack;

    use super::*;

    const LIMITS: Limits = Limits { points_max: 4, message_bytes_max: 1000, ahead_ns_max: 10 };

    fn scan() -> v1::Scan {
        let floats = pack(&[1.0_f32, 2.0, 3.0]);
        v1::Scan { stamp_ns: 9, x: floats.clone(), y: floats.clone(), z: floats, ..Default::default() }
    }

    fn read(body: v1::observation::Body, columns: Option<v1::Columns>) -> Result<Bodies, ObservationError> {
        decode(v1::Observation { body: Some(body), columns, ..Default::default() }, &LIMITS)
    }

    fn read_scan(scan: v1::Scan, columns: Option<v1::Columns>) -> Result<Scan, ObservationError> {
        let mut bodies = read(v1::observation::Body::Scan(scan), columns)?;
        let Some((None, Body::Scan(scan))) = bodies.pop() else { panic!("a scan without a stamp of its own") };
        Ok(scan)
    }

    fn columns(offset_ns: &[i32], points: &[u16]) -> Option<v1::Columns> {
        Some(v1::Columns { offset_ns: pack(offset_ns), points: pack(points) })
    }

    #[test]
    fn each_point_gets_the_offset_of_its_column() {
        let read = read_scan(scan(), columns(&[-20, -10, 0], &[2, 0, 1])).unwrap();
        assert_eq!(read.offset_ns, [-20, -20, 0]);
        assert_eq!((read.x, read.intensity), (vec![1.0, 2.0, 3.0], vec![0.0; 3]), "without intensities all are 0");
    }

    #[test]
    fn a_scan_with_inconsistent_lists_is_refused_with_its_numbers() {
        let refusal = |outcome: Result<Scan, ObservationError>| {
            let error = outcome.unwrap_err();
            (error.reason(), error.to_string())
        };
        let (reason, message) = refusal(read_scan(v1::Scan { y: Bytes::from_static(&[0; 13]), ..scan() }, None));
        assert_eq!((reason, &*message), ("packed", "y of 13 bytes: a multiple of 4 bytes is allowed"));
        let (reason, message) = refusal(read_scan(v1::Scan { x: vec![0; 20].into(), ..scan() }, None));
        assert_eq!((reason, &*message), ("points", "scan with 5 points: up to 4 are allowed"));
        let (reason, _) = refusal(read_scan(v1::Scan { no_returns: vec![0; 60].into(), ..scan() }, None));
        assert_eq!(reason, "points");
        let (reason, message) = refusal(read_scan(scan(), columns(&[0, 0], &[1, 65_535])));
        assert!(reason == "columns" && message.contains("65536 points"), "{message}");
        for wrong in [columns(&[0], &[1, 2]), columns(&[], &[]), columns(&[0; 9], &[1; 9])] {
            assert_eq!(refusal(read_scan(scan(), wrong)).0, "columns");
        }
        let both = v1::Scan { offset_ns: pack(&[0, 0, 0]), ..scan() };
        assert_eq!(refusal(read_scan(both, columns(&[0], &[3]))).0, "columns");
        let half = v1::Columns { offset_ns: pack(&[0]), points: Bytes::from_static(&[3]) };
        assert_eq!(refusal(read_scan(scan(), Some(half))).0, "packed");
    }

    #[test]
    fn lists_of_different_lengths_and_not_finite_numbers_are_left_to_the_core() {
        let read = read_scan(v1::Scan { z: pack(&[f32::NAN, f32::INFINITY, 1e9, 0.0]), ..scan() }, None).unwrap();
        assert_eq!((read.x.len(), read.z.len()), (3, 4));
    }

    #[test]
    fn datagrams_are_cut_from_the_message_by_their_lengths() {
        let packets = v1::Packets {
            captured_ns: pack(&[5_i64, -7, 0]),
            lengths: pack(&[2_u16, 0, 1]),
            payloads: Bytes::from_static(b"abc"),
        };
        let read_packets = |packets| read(v1::observation::Body::Packets(packets), None);
        let bodies = read_packets(packets.clone()).unwrap();
        let datagram = |stamp_ns, bytes| (Some(stamp_ns), Body::Datagram(Bytes::from_static(bytes)));
        assert_eq!(bodies, [datagram(5, b"ab"), datagram(-7, b""), datagram(0, b"c")]);

        for wrong in [
            v1::Packets::default(),
            v1::Packets { payloads: Bytes::from_static(b"abcd"), ..packets.clone() },
            v1::Packets { captured_ns: pack(&[5_i64]), ..packets.clone() },
            v1::Packets { lengths: pack(&[2_u16, 1]), ..packets.clone() },
            v1::Packets {
                captured_ns: pack(&[0_i64; PACKETS_MAX + 1]),
                lengths: pack(&[0_u16; PACKETS_MAX + 1]),
                payloads: Bytes::new(),
            },
        ] {
            assert_eq!(read_packets(wrong).unwrap_err().reason(), "packets");
        }
        let odd = v1::Packets { lengths: Bytes::from_static(&[2, 0, 0, 0, 1, 0, 9]), ..packets };
        assert_eq!(read_packets(odd).unwrap_err().reason(), "packed");
    }

    #[test]
    fn a_stamp_that_is_too_far_ahead_of_the_clock_is_refused() {
        let checked = |captured_ns, now_ns| {
            let bodies = read(v1::observation::Body::Scan(scan()), None).unwrap();
            let bodies = bodies.into_iter().map(|(_, body)| (captured_ns, body)).collect();
            check_stamps(bodies, now_ns, &LIMITS)
        };
        // The scan's stamp is 9.
        assert!(checked(None, -1).is_ok() && checked(Some(9), -1).is_ok() && checked(Some(9), 1 << 62).is_ok());
        for (captured_ns, now_ns) in [(None, -2), (Some(-5), -2), (Some(30), 19), (Some(i64::MAX), i64::MIN)] {
            let error = checked(captured_ns, now_ns).unwrap_err();
            assert_eq!(error.reason(), "stamp_ahead", "{error}");
        }
    }

    #[test]
    fn a_missing_field_is_named() {
        let refusal = |outcome: Result<Bodies, ObservationError>| {
            let error = outcome.unwrap_err();
            (error.reason(), error.to_string())
        };
        let (reason, message) = refusal(decode(v1::Observation::default(), &LIMITS));
        assert!(reason == "body" && message.contains("ego_pose"), "{message}");
        let (reason, message) = refusal(read(v1::observation::Body::EgoPose(v1::EgoPose::default()), None));
        assert_eq!((reason, &*message), ("missing", "ego_pose without map_from_ego"));
        let (reason, message) = refusal(read(v1::observation::Body::Road(v1::Road::default()), None));
        assert_eq!((reason, &*message), ("missing", "road without known road purpose"));
        assert_eq!(refusal(read(v1::observation::Body::End(v1::End {}), columns(&[], &[]))).0, "columns");
    }
}
