//! Maps of recorded scans beside their labels.

mod kitti;
mod papers;
mod several_recorded;
