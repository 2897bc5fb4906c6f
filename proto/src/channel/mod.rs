//! One channel of a layer: its cells, and the encodings of its payload.
//!
//! | file | in -> out |
//! |---|---|
//! | [`cells`] | raw cells, typed; a cell <-> its number on the wire |
//! | [`error`] | why the cells of a channel are refused |
//! | [`bits`] | numbers <-> bits |
//! | [`rows`] | cells <-> bits, each row predicted by the row before (`ENCODING_ROWS`) |
//! | [`changes`] | cells and their base <-> bits (`ENCODING_CHANGES`) |
//! | [`codec`] | cells <-> `Channel` |
//! | [`by_class`] | cells and their classes <-> class table and changes from it |

mod bits;
pub mod by_class;
pub mod cells;
pub(crate) mod changes;
pub mod codec;
pub(crate) mod error;
mod rows;
