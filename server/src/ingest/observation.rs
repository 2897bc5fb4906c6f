//! One `clearway.v1.Observation` -> what the core takes of it. Pure: nothing here reads a clock or waits.
//!
//! Everything is bytes somebody sent: lengths are compared before anything is allocated, and what is allocated is no
//! longer than what came. What the core can judge itself (stamps, poses, roads, lists of different lengths) is left to
//! it: then the journal holds it too.

use bytes::Bytes;
use clearway_mapping::event::Body;
use clearway_proto::packed::unpack;
use clearway_proto::v1;

use crate::encode::{ego_pose_from_proto, road_from_proto, scan_from_proto, sensor_from_proto};

/// What one observation may be.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Points, and rays without a return, of one scan.
    pub points_max: usize,
    /// Bytes of one message; above what `points_max` points with all their fields take.
    pub message_bytes_max: usize,
}

/// A third of a second of an HDL-64E: who tunnels more at once has waited too long.
pub const PACKETS_MAX: usize = 1024;
/// x y z intensity ring offset_ns of a point, and a ray without a return for each second one, with something to spare.
const POINT_BYTES: usize = 32;
/// What a message may have beside its points.
const MESSAGE_BYTES: usize = 64 << 10;

impl Limits {
    /// For scans of up to so many points.
    pub fn of_points(points_max: usize) -> Self {
        Self { points_max, message_bytes_max: points_max.saturating_mul(POINT_BYTES).saturating_add(MESSAGE_BYTES) }
    }
}

/// Why an observation did not become events.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ObservationError {
    /// Bytes that are no observation.
    #[error("not a clearway.v1.Observation: {reason}")]
    Message {
        /// What the decoder says.
        reason: String,
    },
    /// A message longer than any scan that is allowed.
    #[error("message of {bytes} bytes: up to {bytes_max} are allowed")]
    Length {
        /// Its length.
        bytes: usize,
        /// [`Limits::message_bytes_max`].
        bytes_max: usize,
    },
    /// Nothing in it, or something this version does not know.
    #[error("observation without a body: scan, ego_pose, road, packets, end or declaration is allowed")]
    Body,
    /// A list with part of a number.
    #[error("{list} of {bytes} bytes: {number_bytes} a number are allowed")]
    Part {
        /// Which list.
        list: &'static str,
        /// Its length.
        bytes: usize,
        /// Bytes of one number.
        number_bytes: usize,
    },
    /// A scan with too many points.
    #[error("scan with {count} {what}: up to {points_max} are allowed")]
    Points {
        /// Points or rays.
        what: &'static str,
        /// How many.
        count: usize,
        /// [`Limits::points_max`].
        points_max: usize,
    },
    /// Columns that are not those of the scan.
    #[error(
        "{columns} columns with {points} points together and {offsets} offsets, of a scan of {of} points{also}: one offset a column and all points are allowed"
    )]
    Columns {
        /// How many.
        columns: usize,
        /// Their points.
        points: usize,
        /// How many offsets.
        offsets: usize,
        /// Points of the scan.
        of: usize,
        /// Whether the points have offsets too, or there is no scan.
        also: &'static str,
    },
    /// Datagrams that are not where they are said to be.
    #[error(
        "{lengths} datagrams of {claimed} bytes together and {stamps} stamps, in {bytes} bytes: 1 to {PACKETS_MAX} datagrams, a stamp each and all bytes are allowed"
    )]
    Packets {
        /// How many lengths.
        lengths: usize,
        /// Their sum.
        claimed: usize,
        /// How many stamps.
        stamps: usize,
        /// What there is.
        bytes: usize,
    },
    /// A pose without a pose, a road or sensor that lacks something.
    #[error("{body} without {what}")]
    Missing {
        /// `ego_pose`, `road`, `scan` or `declaration`.
        body: &'static str,
        /// What is allowed and not there.
        what: &'static str,
    },
}

impl ObservationError {
    /// The ledger's key.
    pub fn reason(&self) -> &'static str {
        match self {
            Self::Message { .. } => "message",
            Self::Length { .. } => "message_length",
            Self::Body => "body",
            Self::Part { .. } => "packed",
            Self::Points { .. } => "points",
            Self::Columns { .. } => "columns",
            Self::Packets { .. } => "packets",
            Self::Missing { .. } => "missing",
        }
    }
}

/// What one observation is to the core, with the stamps of their capture; `None`: now.
pub type Bodies = Vec<(Option<i64>, Body)>;

/// Reads an observation.
///
/// # Errors
/// [`ObservationError`] with what was found and what is allowed.
pub fn bodies(observation: v1::Observation, limits: &Limits) -> Result<Bodies, ObservationError> {
    let v1::Observation { captured_ns, body, columns, .. } = observation;
    let captured_ns = (captured_ns != 0).then_some(captured_ns);
    let missing = |body| move |what| ObservationError::Missing { body, what };
    let body = body.ok_or(ObservationError::Body)?;
    if let (Some(columns), false) = (&columns, matches!(body, v1::observation::Body::Scan(_))) {
        return Err(wrong_columns(columns, 0, " (there is none)"));
    }
    let body = match body {
        v1::observation::Body::Packets(packets) => return datagrams(packets),
        v1::observation::Body::Scan(mut scan) => {
            check(&scan, limits)?;
            if let Some(columns) = &columns {
                scan.offset_ns = expand(columns, &scan)?;
            }
            let mut scan = scan_from_proto(scan).map_err(missing("scan"))?;
            if scan.intensity.is_empty() {
                scan.intensity.resize(scan.x.len(), 0.0);
            }
            Body::Scan(scan)
        }
        v1::observation::Body::EgoPose(ego) => {
            Body::EgoPose(ego_pose_from_proto(&ego).ok_or(missing("ego_pose")("map_from_ego"))?)
        }
        v1::observation::Body::Road(road) => Body::Road(road_from_proto(road).map_err(missing("road"))?),
        v1::observation::Body::End(v1::End {}) => Body::End,
        v1::observation::Body::Declaration(sensor) => {
            Body::Sensor(Box::new(sensor_from_proto(sensor).map_err(missing("declaration"))?))
        }
    };
    Ok(vec![(captured_ns, body)])
}

/// Whether every list of a scan is whole and none is too long.
fn check(scan: &v1::Scan, limits: &Limits) -> Result<(), ObservationError> {
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

fn wrong_columns(columns: &v1::Columns, of: usize, also: &'static str) -> ObservationError {
    let points: Vec<u16> = unpack(&columns.points).unwrap_or_default();
    ObservationError::Columns {
        columns: points.len(),
        points: points.iter().copied().map(usize::from).sum(),
        offsets: columns.offset_ns.len() / 4,
        of,
        also,
    }
}

/// Each column's offset, once a point, packed.
fn expand(columns: &v1::Columns, scan: &v1::Scan) -> Result<Bytes, ObservationError> {
    let of = scan.x.len() / 4;
    if !scan.offset_ns.is_empty() {
        return Err(wrong_columns(columns, of, " that have offsets of their own"));
    }
    let part = |list, bytes: &Bytes, number_bytes| ObservationError::Part { list, bytes: bytes.len(), number_bytes };
    let points: Vec<u16> = unpack(&columns.points).ok_or_else(|| part("columns.points", &columns.points, 2))?;
    if !columns.offset_ns.len().is_multiple_of(4) {
        return Err(part("columns.offset_ns", &columns.offset_ns, 4));
    }
    let total: usize = points.iter().copied().map(usize::from).sum();
    if columns.offset_ns.len() / 4 != points.len() || total != of {
        return Err(wrong_columns(columns, of, ""));
    }
    let mut expanded = Vec::with_capacity(total * 4);
    for (offset_ns, &points) in columns.offset_ns.chunks_exact(4).zip(&points) {
        (0..points).for_each(|_| expanded.extend_from_slice(offset_ns));
    }
    Ok(expanded.into())
}

/// Datagrams, each a piece of the message it came in.
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

    const LIMITS: Limits = Limits { points_max: 4, message_bytes_max: 1000 };

    fn scan() -> v1::Scan {
        let floats = pack(&[1.0_f32, 2.0, 3.0]);
        v1::Scan { stamp_ns: 9, x: floats.clone(), y: floats.clone(), z: floats, ..Default::default() }
    }

    fn read(body: v1::observation::Body, columns: Option<v1::Columns>) -> Result<Bodies, ObservationError> {
        bodies(v1::Observation { body: Some(body), columns, ..Default::default() }, &LIMITS)
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
    fn columns_give_each_of_their_points_their_offset() {
        let read = read_scan(scan(), columns(&[-20, -10, 0], &[2, 0, 1])).unwrap();
        assert_eq!(read.offset_ns, [-20, -20, 0]);
        assert_eq!((read.x, read.intensity), (vec![1.0, 2.0, 3.0], vec![0.0; 3]), "no intensity is none");
    }

    #[test]
    fn a_scan_that_is_not_what_it_claims_is_refused_with_its_numbers() {
        let said = |outcome: Result<Scan, ObservationError>| {
            let error = outcome.unwrap_err();
            (error.reason(), error.to_string())
        };
        let (reason, message) = said(read_scan(v1::Scan { y: Bytes::from_static(&[0; 13]), ..scan() }, None));
        assert_eq!((reason, &*message), ("packed", "y of 13 bytes: 4 a number are allowed"));
        let (reason, message) = said(read_scan(v1::Scan { x: vec![0; 20].into(), ..scan() }, None));
        assert_eq!((reason, &*message), ("points", "scan with 5 points: up to 4 are allowed"));
        let (reason, _) = said(read_scan(v1::Scan { no_returns: vec![0; 60].into(), ..scan() }, None));
        assert_eq!(reason, "points");
        let (reason, message) = said(read_scan(scan(), columns(&[0, 0], &[1, 65_535])));
        assert!(reason == "columns" && message.contains("65536 points"), "{message}");
        for wrong in [columns(&[0], &[1, 2]), columns(&[], &[]), columns(&[0; 9], &[1; 9])] {
            assert_eq!(said(read_scan(scan(), wrong)).0, "columns");
        }
        let both = v1::Scan { offset_ns: pack(&[0, 0, 0]), ..scan() };
        assert_eq!(said(read_scan(both, columns(&[0], &[3]))).0, "columns");
        let half = v1::Columns { offset_ns: pack(&[0]), points: Bytes::from_static(&[3]) };
        assert_eq!(said(read_scan(scan(), Some(half))).0, "packed");
    }

    #[test]
    fn lists_of_different_lengths_and_numbers_that_are_none_are_left_to_the_core() {
        let read = read_scan(v1::Scan { z: pack(&[f32::NAN, f32::INFINITY, 1e9, 0.0]), ..scan() }, None).unwrap();
        assert_eq!((read.x.len(), read.z.len()), (3, 4));
    }

    #[test]
    fn datagrams_come_out_as_they_lie_in_the_message() {
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
    fn what_lacks_something_is_named() {
        let said = |outcome: Result<Bodies, ObservationError>| {
            let error = outcome.unwrap_err();
            (error.reason(), error.to_string())
        };
        let (reason, message) = said(bodies(v1::Observation::default(), &LIMITS));
        assert!(reason == "body" && message.contains("ego_pose"), "{message}");
        let (reason, message) = said(read(v1::observation::Body::EgoPose(v1::EgoPose::default()), None));
        assert_eq!((reason, &*message), ("missing", "ego_pose without map_from_ego"));
        let (reason, message) = said(read(v1::observation::Body::Road(v1::Road::default()), None));
        assert_eq!((reason, &*message), ("missing", "road without known road purpose"));
        assert_eq!(said(read(v1::observation::Body::End(v1::End {}), columns(&[], &[]))).0, "columns");
    }
}
