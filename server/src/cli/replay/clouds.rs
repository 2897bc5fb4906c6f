//! Revolutions -> one binary PCD file (v0.7) each, `<revolution>.pcd`, with points in the sensor frame, in metres.
//!
//! Fields, little-endian and without padding: x y z intensity (f32; intensity 0 to 255 as the sensor reports it), ring
//! (u16, 0 lowest), laser (u16, firing order), time (f32, seconds since the revolution's first firing), return_type
//! (u8, 1 strongest, 2 last, 3 both in one). The points are in firing order; within a firing they are ordered by laser,
//! and of one laser the strongest return comes before the last.

use std::io::{Error, ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use clearway_lidar::revolution::Revolution;

use clearway_daemon::base::file_advice::advised;
use clearway_daemon::base::sync::locked;
use clearway_daemon::engine::Observer;

/// A folder to which point clouds are written.
#[derive(Clone, Debug)]
pub struct Clouds {
    folder: PathBuf,
}

/// Why a point cloud cannot be written.
#[derive(Debug, thiserror::Error)]
#[error("--clouds {}: {source}", file.display())]
pub struct CloudError {
    /// The folder or file that cannot be written.
    pub file: PathBuf,
    /// The system's error.
    pub source: std::io::Error,
}

/// Number of clouds written, or the error that ended the writing.
pub type Written = Arc<Mutex<Result<u64, CloudError>>>;

impl Clouds {
    /// Creates the folder, unless it exists.
    ///
    /// # Errors
    /// [`CloudError`] if a file has its name, if point clouds are in it, or if it cannot be created.
    pub fn create(folder: &Path) -> Result<Self, CloudError> {
        let wrong = |source| CloudError { file: folder.to_owned(), source };
        if folder.is_file() {
            return Err(wrong(Error::new(ErrorKind::NotADirectory, "this is a file; name a folder")));
        }
        std::fs::create_dir_all(folder).map_err(|source| wrong(advised(folder, source)))?;
        let entries = std::fs::read_dir(folder).map_err(|source| wrong(advised(folder, source)))?;
        let is_cloud = |path: &Path| path.extension().is_some_and(|extension| extension == "pcd");
        if entries.filter_map(Result::ok).any(|entry| is_cloud(&entry.path())) {
            let advice = "point clouds are in this folder, and none is overwritten; name another folder";
            return Err(wrong(Error::new(ErrorKind::AlreadyExists, advice)));
        }
        Ok(Self { folder: folder.to_owned() })
    }

    /// An observer of the engine that writes each revolution, and the number of clouds written. Scans that arrive
    /// assembled are not written.
    pub fn observer(self) -> (Observer, Written) {
        let written: Written = Arc::new(Mutex::new(Ok(0)));
        let count = written.clone();
        let observer: Observer = Box::new(move |pipeline| {
            let Some(revolution) = pipeline.newest_revolution() else { return };
            let mut written = locked(&written);
            let Ok(count) = *written else { return };
            let file = self.folder.join(format!("{:06}.pcd", revolution.sequence));
            let done = std::fs::File::create_new(&file).and_then(|mut open| open.write_all(&pcd(revolution)));
            *written = done.map(|()| count + 1).map_err(|source| CloudError { source: advised(&file, source), file });
        });
        (observer, count)
    }
}

/// Encodes the points of a revolution as a PCD file.
pub fn pcd(revolution: &Revolution) -> Vec<u8> {
    let (mut points, mut data) = (0_u32, Vec::new());
    for point in revolution.points() {
        for value in [point.x, point.y, point.z, f32::from(point.intensity)] {
            data.extend_from_slice(&value.to_le_bytes());
        }
        data.extend_from_slice(&point.ring.to_le_bytes());
        data.extend_from_slice(&point.laser.to_le_bytes());
        data.extend_from_slice(&((point.time_ns - revolution.start_ns) as f32 * 1e-9).to_le_bytes());
        data.push(point.return_type);
        points += 1;
    }
    let mut file = format!(
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z intensity ring laser time return_type\n\
         SIZE 4 4 4 4 2 2 4 1\nTYPE F F F F U U F U\nCOUNT 1 1 1 1 1 1 1 1\nWIDTH {points}\nHEIGHT 1\n\
         VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA binary\n"
    )
    .into_bytes();
    file.append(&mut data);
    file
}
