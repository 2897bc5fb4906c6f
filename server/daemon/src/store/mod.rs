//! Long-term storage of recordings: a folder, or a bucket of S3 or of a compatible server.
//!
//! | file | in -> out |
//! |---|---|
//! | [`location`] | a path or a URL -> the store |
//! | [`index`] | a finished part -> what it holds, for a search; a search -> the parts |
//! | [`fetch`] | the URL of a recording in a store -> a copy here |
//! | [`upload`] | finished parts of a folder -> the store, confirmed |
//! | [`upload_limit`] | requests to a bucket -> the same within a limit of the configuration |
//!
//! A part is the object `parts/<time>-<CRC>.mcap`; what it holds is the object `index/<vehicle>/<time>-<CRC>.json`, one
//! for each vehicle. The time is the first message's log time, in ns, in 20 digits, so that names sort by time.

pub mod fetch;
pub mod index;
pub mod location;
pub mod upload;
pub mod upload_limit;
