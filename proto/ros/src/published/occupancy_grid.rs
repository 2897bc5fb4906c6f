//! One `nav_msgs/msg/OccupancyGrid` message.
//!
//! In: cells and their pose. Out: the bytes of a message. Layout: header; info (map_load_time, resolution f32,
//! width, height, origin: the pose of cell (0, 0)'s lower corner in the header's frame); data (i8 per cell, row by row,
//! x first: 0 free to 100 occupied, -1 unknown).

use nalgebra::Isometry3;

use crate::cdr::{Header, Writer, length};
use crate::pose::write_pose;

/// A grid of occupancies.
#[derive(Clone, Debug, PartialEq)]
pub struct OccupancyGrid<'a> {
    /// Time of the map, and the frame of its origin.
    pub header: Header<'a>,
    /// Edge of a cell in metres.
    pub resolution_m: f32,
    /// Number of cells along the x axis of the grid.
    pub width: u32,
    /// Number of cells along the y axis of the grid.
    pub height: u32,
    /// Pose of the grid's axes at the corner of cell (0, 0), in the header's frame.
    pub origin: Isometry3<f64>,
    /// `width * height` cells: 0 to 100, or -1 for unknown.
    pub data: Vec<i8>,
}

impl OccupancyGrid<'_> {
    /// Encodes the message, little-endian; map_load_time is the stamp of the header.
    pub fn to_cdr(&self) -> Vec<u8> {
        let mut writer = Writer::default();
        writer.header(&self.header).stamp(self.header.stamp_ns).u32(self.resolution_m.to_bits());
        writer.u32(self.width).u32(self.height);
        write_pose(&mut writer, &self.origin).u32(length(self.data.len())).signed_bytes(&self.data);
        writer.finish()
    }
}
