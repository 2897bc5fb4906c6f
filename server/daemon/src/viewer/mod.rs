//! Maps for viewers: colours for the page and pictures, messages of one [`MapView`] for ROS 2 and Foxglove.
//!
//! Frames: Foxglove's grids and points lie in `<vehicle>/base_link`, the ego frame; if poses are known, that frame in
//! `map`. ROS 2 has the frames of the vehicle's input ([`FrameNames`]); its grids lie in the fixed frame if a pose is
//! known. Every stamp is the end of the capture.
//!
//! | file | in -> out |
//! |---|---|
//! | [`palette`] | a value or an id -> its colour |
//! | [`colours`] | a layer -> the colour of each cell |
//! | [`raster`] | a layer -> square cells, as occupancies or colours |
//! | [`aligned`] | square cells and their pose -> cells along the axes of a frame |
//! | [`clouds`] | a layer of squares -> points that mark and clear |
//! | [`safe_paths`] | safe points -> lines, circles, poses |
//! | [`frame`] | a map -> its frames and its pose |
//! | [`ros`] | a map -> CDR messages of ROS 2 |
//! | [`foxglove`] | a map -> Foxglove's messages |

pub mod aligned;
pub mod clouds;
pub mod colours;
pub mod foxglove;
pub mod frame;
pub mod palette;
pub mod raster;
pub mod ros;
pub mod safe_paths;

use bytes::Bytes;
use clearway_client::MapView;
use clearway_journal::encode::EncodedMap;

pub use frame::{FrameNames, base_frame};
pub use raster::Raster;

/// The decoded `bytes` of `map`; `None`, and an error in the log, if they cannot be decoded.
pub fn view(map: &EncodedMap, bytes: Bytes) -> Option<MapView> {
    MapView::decode(bytes)
        .inspect_err(|error| tracing::error!(vehicle = %map.vehicle, %error, "a map cannot be decoded"))
        .ok()
}
