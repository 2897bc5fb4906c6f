//! The fields of a cloud -> readers of the numbers of a point.
//!
//! `x`, `y` and `z` suffice for a scan. An optional field that cannot be read is left out, with the reason.

use crate::cdr::{MessageError, RefusedPart};
use crate::point_cloud2::{Datatype, Field, PointCloud2, describe};

const INTENSITIES: &[&str] = &["intensity", "reflectivity"];
const RINGS: &[&str] = &["ring", "channel", "laser_id", "line"];
const TIMES: &[&str] = &["time", "t", "timestamp", "time_stamp", "offset_time"];

/// The fields of a point that are read. None of them overlaps another field.
pub(crate) struct Layout {
    pub position: [FieldReader; 3],
    pub intensity: Option<FieldReader>,
    pub ring: Option<FieldReader>,
    pub time: Option<FieldReader>,
}

impl Layout {
    /// Finds the fields; appends the optional fields that cannot be read to `refused`.
    pub fn from_cloud(cloud: &PointCloud2, refused: &mut Vec<RefusedPart>) -> Result<Self, MessageError> {
        let mut used = Vec::new();
        let mut position = [FieldReader { offset: 0, datatype: Datatype::Float32, big_endian: false }; 3];
        for (axis, name) in position.iter_mut().zip(["x", "y", "z"]) {
            let named: Vec<&Field> = cloud.fields.iter().filter(|field| field.name == name).collect();
            let Some(&field) = named.first() else {
                let names: Vec<_> = cloud.fields.iter().map(|field| field.name).collect();
                return Err(MessageError::value("fields", names.join(" "), "x y z and more"));
            };
            *axis = FieldReader::of(cloud, field, &used)?;
            if named.len() > 1 || !axis.is_float() {
                return Err(MessageError::value("fields[]", describe(field), "float32 or float64, once"));
            }
            used.push(*axis);
        }
        // Of several fields with a name the first is read.
        let mut optional = |names: &[&str]| {
            let mut candidates = names.iter().filter_map(|name| cloud.fields.iter().find(|field| field.name == *name));
            let reader = candidates.find_map(|field| match FieldReader::of(cloud, field, &used) {
                Ok(reader) => Some(reader),
                Err(fault) => {
                    refused.push(RefusedPart { what: "field", count: 1, fault });
                    None
                }
            });
            used.extend(reader);
            reader
        };
        Ok(Self { position, intensity: optional(INTENSITIES), ring: optional(RINGS), time: optional(TIMES) })
    }
}

/// Reads one number of each point, within the point.
#[derive(Clone, Copy, Debug)]
pub(crate) struct FieldReader {
    offset: usize,
    pub datatype: Datatype,
    big_endian: bool,
}

impl FieldReader {
    /// The reader of a field that lies within the point and overlaps none of the `used` fields.
    fn of(cloud: &PointCloud2, field: &Field, used: &[Self]) -> Result<Self, MessageError> {
        let refused = |allowed| Err(MessageError::value("fields[]", describe(field), allowed));
        let Some(datatype) = Datatype::from_number(field.datatype) else {
            return refused("datatypes 1 to 10");
        };
        // Some writers leave the count of a single number 0.
        if field.count > 1 {
            return refused("count 1");
        }
        let (start, end) = (u64::from(field.offset), u64::from(field.offset) + u64::from(datatype.size()));
        if end > u64::from(cloud.point_step) {
            return refused("fields that end within point_step");
        }
        let ends = |other: &Self| other.offset as u64 + u64::from(other.datatype.size());
        if used.iter().any(|other| start < ends(other) && (other.offset as u64) < end) {
            return refused("fields that do not overlap");
        }
        Ok(Self { offset: field.offset as usize, datatype, big_endian: cloud.big_endian })
    }

    fn is_float(self) -> bool {
        matches!(self.datatype, Datatype::Float32 | Datatype::Float64)
    }

    #[inline]
    pub fn number(self, point: &[u8]) -> f64 {
        match self.datatype {
            Datatype::Int8 => i8::from_le_bytes(self.bytes(point)).into(),
            Datatype::Uint8 => u8::from_le_bytes(self.bytes(point)).into(),
            Datatype::Int16 => i16::from_le_bytes(self.bytes(point)).into(),
            Datatype::Uint16 => u16::from_le_bytes(self.bytes(point)).into(),
            Datatype::Int32 => i32::from_le_bytes(self.bytes(point)).into(),
            Datatype::Uint32 => u32::from_le_bytes(self.bytes(point)).into(),
            Datatype::Float32 => f32::from_le_bytes(self.bytes(point)).into(),
            Datatype::Float64 => f64::from_le_bytes(self.bytes(point)),
            Datatype::Int64 => i64::from_le_bytes(self.bytes(point)) as f64,
            Datatype::Uint64 => u64::from_le_bytes(self.bytes(point)) as f64,
        }
    }

    /// The bytes of the number, little-endian.
    #[inline]
    fn bytes<const N: usize>(self, point: &[u8]) -> [u8; N] {
        let mut bytes: [u8; N] = point[self.offset..self.offset + N].try_into().expect("N bytes");
        if self.big_endian {
            bytes.reverse();
        }
        bytes
    }

    /// Value of an intensity of 1; floats are scaled later, when all values are known.
    pub fn full_scale(self) -> f32 {
        match self.datatype {
            Datatype::Int8 => f32::from(i8::MAX),
            Datatype::Uint8 => f32::from(u8::MAX),
            Datatype::Int16 => f32::from(i16::MAX),
            Datatype::Uint16 => f32::from(u16::MAX),
            Datatype::Int32 => i32::MAX as f32,
            Datatype::Uint32 => u32::MAX as f32,
            Datatype::Int64 => i64::MAX as f32,
            Datatype::Uint64 => u64::MAX as f32,
            Datatype::Float32 | Datatype::Float64 => 1.0,
        }
    }
}
