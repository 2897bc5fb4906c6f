//! The contents of the latest-value slots of one vehicle: the engine replaces them, readers look at them in their own
//! time.

use std::sync::Arc;

use clearway_mapping::sensor::sweep::Sweep;

use clearway_journal::encode::EncodedMap;

/// The newest map of one vehicle; `None` before the first.
pub type Newest = Option<Arc<EncodedMap>>;

/// The points of the newest map of one vehicle, in the ego frame, with the map's `capture_end_ns`; `None` before the
/// first map that was made while a reader subscribed to the points.
pub type NewestSweep = Option<Arc<(i64, Sweep)>>;
