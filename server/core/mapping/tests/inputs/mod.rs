//! What a map is made of beside datagrams: scan files, poses, mounts, roads.

mod motion;
mod mount;
mod roads;
mod scan_files;
