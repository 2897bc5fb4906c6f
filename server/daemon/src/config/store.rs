//! The table `[store]`.

use serde::{Deserialize, Serialize};

use super::error::ValueError;

/// The table `[store]`: where finished parts of the recording go.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Store {
    /// A folder, also as `file:///FOLDER`, or `s3://BUCKET/PREFIX`; empty: parts stay where they are.
    pub url: String,
    /// True if each part is deleted from the recorder's folder after the store has confirmed it, once it is older than
    /// `recorder.save_s`.
    pub delete: bool,
    /// Most that uploads to a bucket send, in kbit/s; 0: no limit.
    pub upload_kbit_s_max: u32,
}

impl Store {
    pub(super) fn check(&self) -> Result<(), ValueError> {
        let is_allowed = match self.url.split_once("://") {
            None => true,
            Some(("file", path)) => path.starts_with('/'),
            Some(("s3", path)) => path.split('/').next().is_some_and(|bucket| !bucket.is_empty()),
            Some(_) => false,
        };
        let allowed = "a folder, file:///FOLDER or s3://BUCKET/PREFIX";
        if is_allowed { Ok(()) } else { Err(ValueError::new("store.url", &self.url, allowed)) }
    }
}
