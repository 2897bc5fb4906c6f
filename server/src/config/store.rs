//! The table `[store]`.

use serde::{Deserialize, Serialize};

use super::error::ValueError;

/// The table `[store]`: where finished parts of the recording go.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Store {
    /// A folder, or `s3://BUCKET/PREFIX`; empty: parts stay where they are.
    pub url: String,
    /// True if each part is deleted from the recorder's folder after the store has confirmed it.
    pub delete: bool,
}

impl Store {
    pub(super) fn check(&self) -> Result<(), ValueError> {
        match self.url.split_once("://") {
            Some((scheme, _)) if scheme != "s3" => {
                Err(ValueError::new("store.url", &self.url, "a folder or s3://BUCKET/PREFIX"))
            }
            _ => Ok(()),
        }
    }
}
