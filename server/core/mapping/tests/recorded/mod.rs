//! Maps of recorded scans beside their labels.

mod kitti;
mod several_recorded;
