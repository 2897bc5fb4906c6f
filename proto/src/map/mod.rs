//! A map: encoded bytes <-> checked values.
//!
//! In: an encoded `clearway.v1.Map` from gRPC, zenoh, a WebSocket or a recording. Out: a [`Map`]. Every channel of it
//! has as many cells as its grid, and every class has a name, a meaning and a colour.
//!
//! | file | in -> out |
//! |---|---|
//! | [`decode`] | bytes -> [`Map`]; header and layers -> bytes |
//! | [`parts`] | bytes -> number of parts that a map claims |
//! | [`layer`] | the types of a decoded map |
//! | [`grid`] | point in the ego frame <-> cell index |
//! | [`legend`] | names, meanings and colours <-> the classes of a layer |
//! | [`safe_points`] | safe points <-> `SafePoints` |
//! | [`base`] | delta and earlier map -> the base of each cell |
//! | [`base_error`] | why a delta does not fit its base |
//! | [`id`] | identity of a map |
//! | [`error`] | why a map is refused |

pub(crate) mod base;
mod base_error;
pub(crate) mod decode;
pub(crate) mod error;
pub mod grid;
pub(crate) mod id;
pub(crate) mod layer;
pub mod legend;
mod parts;
pub mod safe_points;

pub use base_error::BaseError;
pub use decode::{decode_map, decode_map_on, encode_header, encode_layer};
pub use error::MapError;
pub use id::MapId;
pub use layer::{Channel, Layer, Map, SafePoint};
