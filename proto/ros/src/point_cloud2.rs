//! One `sensor_msgs/msg/PointCloud2` message.
//!
//! In: the bytes of a message. Out: header, layout and the bytes of the points, without a copy; [`crate::points`]
//! decodes them. Layout: header; height, width; fields (name, offset, datatype, count); is_bigendian; point_step,
//! row_step; data; is_dense. Drivers leave `row_step` 0 or write a wrong one: if it is too small, or if the data has no
//! byte beside the points, the rows follow each other without a gap.

use crate::cdr::{Header, MessageError, Reader, Writer, length};

/// Most fields of a point. Ours; drivers write about a dozen.
const FIELDS_MAX: usize = 256;
/// Bytes of the shortest field: name 4 + 1, padding 3, offset 4, datatype 1, and count 4 after padding 3.
const FIELD_LENGTH: usize = 20;

/// A message whose bytes are borrowed. `data` holds `height` rows of `width` points.
#[derive(Clone, Debug, PartialEq)]
pub struct PointCloud2<'a> {
    /// Time and frame of the points.
    pub header: Header<'a>,
    /// Number of rows; 1 if the points have no order.
    pub height: u32,
    /// Number of points in a row.
    pub width: u32,
    /// Fields of each point.
    pub fields: Vec<Field<'a>>,
    /// True if the numbers of the points are big-endian. The byte order of the message itself is independent of it.
    pub big_endian: bool,
    /// Bytes from one point to the next.
    pub point_step: u32,
    /// Bytes from one row to the next, as written; see [`PointCloud2::rows`].
    pub row_step: u32,
    /// Bytes of the points.
    pub data: &'a [u8],
    /// True if the sender states that all points have positions. Nothing here relies on it.
    pub dense: bool,
}

/// A `sensor_msgs/PointField`: where a number lies in the bytes of a point.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Field<'a> {
    /// Name, such as `x` or `intensity`.
    pub name: &'a str,
    /// Offset from the start of the point, in bytes.
    pub offset: u32,
    /// [`Datatype`] as a number. Drivers also write other numbers, in fields that are not needed.
    pub datatype: u8,
    /// Number of elements.
    pub count: u32,
}

/// Type of the elements of a field.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Datatype {
    /// Signed integer of 8 bits.
    Int8 = 1,
    /// Unsigned integer of 8 bits.
    Uint8,
    /// Signed integer of 16 bits.
    Int16,
    /// Unsigned integer of 16 bits.
    Uint16,
    /// Signed integer of 32 bits.
    Int32,
    /// Unsigned integer of 32 bits.
    Uint32,
    /// Floating-point number of 32 bits.
    Float32,
    /// Floating-point number of 64 bits.
    Float64,
    /// Signed integer of 64 bits. PCL writes this and the next type; `sensor_msgs/PointField` does not name them.
    Int64,
    /// Unsigned integer of 64 bits.
    Uint64,
}

impl Datatype {
    /// All types in the order of their numbers, from 1.
    pub const ALL: [Self; 10] = [
        Self::Int8,
        Self::Uint8,
        Self::Int16,
        Self::Uint16,
        Self::Int32,
        Self::Uint32,
        Self::Float32,
        Self::Float64,
        Self::Int64,
        Self::Uint64,
    ];

    /// The type with this number.
    pub fn from_number(number: u8) -> Option<Self> {
        Self::ALL.into_iter().find(|datatype| *datatype as u8 == number)
    }

    /// Bytes of one element.
    pub fn size(self) -> u32 {
        match self {
            Self::Int8 | Self::Uint8 => 1,
            Self::Int16 | Self::Uint16 => 2,
            Self::Int32 | Self::Uint32 | Self::Float32 => 4,
            Self::Float64 | Self::Int64 | Self::Uint64 => 8,
        }
    }
}

impl<'a> PointCloud2<'a> {
    /// Reads a message.
    ///
    /// # Errors
    /// [`MessageError`] as of [`Reader`]; [`MessageError::Value`] if there are too many fields, or if rows and points
    /// do not fit into one another.
    pub fn new(message: &'a [u8]) -> Result<Self, MessageError> {
        let mut reader = Reader::new(message)?;
        let header = reader.header()?;
        let (height, width) = (reader.u32("height")?, reader.u32("width")?);
        let count = reader.count("fields", FIELD_LENGTH)?;
        if count > FIELDS_MAX {
            return Err(MessageError::value("fields", count, "up to 256 fields"));
        }
        let fields = (0..count).map(|_| field(&mut reader)).collect::<Result<_, _>>()?;
        let big_endian = reader.u8("is_bigendian")? != 0;
        let (point_step, row_step) = (reader.u32("point_step")?, reader.u32("row_step")?);
        let length = reader.count("data", 1)?;
        let data = reader.read_bytes("data", length)?;
        let dense = reader.u8("is_dense")? != 0;
        let cloud = Self { header, height, width, fields, big_endian, point_step, row_step, data, dense };
        cloud.check()?;
        Ok(cloud)
    }

    /// True if the cloud has no point.
    pub fn is_empty(&self) -> bool {
        self.height == 0 || self.width == 0
    }

    /// Bytes of each point, row by row.
    pub fn rows(&self) -> impl Iterator<Item = &'a [u8]> + use<'a> {
        let rows = if self.is_empty() { 0 } else { self.height as usize };
        let (width, point, data) = (self.width as usize, self.point_step as usize, self.data);
        let row = self.row() as usize;
        (0..rows).flat_map(move |index| data[index * row..][..width * point].chunks_exact(point))
    }

    /// Encodes the message, little-endian.
    pub fn to_cdr(&self) -> Vec<u8> {
        let mut writer = Writer::default();
        writer.header(&self.header).u32(self.height).u32(self.width).u32(length(self.fields.len()));
        for field in &self.fields {
            writer.text(field.name).u32(field.offset).bytes(&[field.datatype]).u32(field.count);
        }
        writer.bytes(&[self.big_endian.into()]).u32(self.point_step).u32(self.row_step);
        writer.u32(length(self.data.len())).bytes(self.data).bytes(&[self.dense.into()]);
        writer.finish()
    }

    /// Bytes from one row to the next: `row_step`, unless the bytes of the points fill the data without it.
    fn row(&self) -> u64 {
        let points = u64::from(self.width).saturating_mul(u64::from(self.point_step));
        let is_packed = u128::from(points) * u128::from(self.height) == self.data.len() as u128;
        if is_packed { points } else { points.max(u64::from(self.row_step)) }
    }

    fn check(&self) -> Result<(), MessageError> {
        if self.is_empty() {
            return Ok(());
        }
        if self.point_step == 0 {
            return Err(MessageError::value("point_step", 0, "at least 1 where there are points"));
        }
        let row = u64::from(self.width) * u64::from(self.point_step);
        // The last row may lack the padding of the other rows.
        let needed = u128::from(self.row()) * u128::from(self.height - 1) + u128::from(row);
        if needed > self.data.len() as u128 {
            let found = format!("{} bytes for {} x {} points", self.data.len(), self.height, self.width);
            return Err(MessageError::value("data", found, "row_step a row"));
        }
        Ok(())
    }
}

/// Text of a field for errors.
pub(crate) fn describe(field: &Field) -> String {
    let Field { name, offset, datatype, count } = field;
    format!("{name} (offset {offset}, datatype {datatype}, count {count})")
}

fn field<'a>(reader: &mut Reader<'a>) -> Result<Field<'a>, MessageError> {
    Ok(Field {
        name: reader.text("fields[].name")?,
        offset: reader.u32("fields[].offset")?,
        datatype: reader.u8("fields[].datatype")?,
        count: reader.u32("fields[].count")?,
    })
}
