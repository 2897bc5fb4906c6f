//! What a recording says before its first message: metadata, configuration, calibration tables; and what is wrong with
//! it.

use std::collections::BTreeMap;

use mcap::records::{AttachmentHeader, Metadata};

/// Version of the contents of our recordings, in their metadata. A recording without one has version 1.
pub const FORMAT: u32 = 1;
/// The name of the metadata of a recording of clearway.
const METADATA: &str = "clearway";

/// The contents of a recording before its first message; empty in an MCAP file of another program.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Header {
    /// Identifies the run of the server that made the maps; 0 in a file of another program.
    pub boot_id: u64,
    /// Keys and values of the metadata record `clearway`; empty in a file of another program.
    pub metadata: BTreeMap<String, String>,
    /// The effective configuration, TOML.
    pub config: Option<String>,
    /// The configured calibration tables: attachment name, ROS YAML.
    pub calibrations: BTreeMap<String, String>,
}

/// What the format in the metadata says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Format {
    Known,
    /// The version that wrote the file has never written it: the metadata, which no checksum of its own covers, is
    /// damaged.
    Damaged,
    /// A later version of clearway wrote the file.
    Later,
}

impl Header {
    /// Adds the metadata `clearway` of a recording; ignores metadata of other programs.
    pub(super) fn add_metadata(&mut self, metadata: &Metadata) {
        if metadata.name == METADATA {
            self.metadata.clone_from(&metadata.metadata);
            self.boot_id = self.value("boot_id").parse().unwrap_or_default();
        }
    }

    /// Adds an attachment, if it is one of a recording.
    pub(super) fn add_attachment(&mut self, header: &AttachmentHeader, data: &[u8]) {
        let text = String::from_utf8_lossy(data).into_owned();
        if header.name == "config.toml" {
            self.config = Some(text);
        } else if header.name.starts_with("calibration/") {
            self.calibrations.insert(header.name.clone(), text);
        }
    }

    /// The value of a key of the metadata; empty without it.
    pub(super) fn value(&self, key: &str) -> &str {
        self.metadata.get(key).map_or("", |value| value)
    }

    pub(super) fn format(&self) -> Format {
        let found = self.value("format");
        if !self.metadata.contains_key("format") || matches!(found.parse::<u32>(), Ok(1..=FORMAT)) {
            return Format::Known;
        }
        let by = version_numbers(self.value("version"));
        let is_known = by.is_some_and(|by| Some(by) <= version_numbers(env!("CARGO_PKG_VERSION")));
        if is_known { Format::Damaged } else { Format::Later }
    }

    /// Metadata of the file, with the right format if it is damaged.
    pub(super) fn with_known_format(&self, mut metadata: Metadata) -> Metadata {
        if self.format() == Format::Damaged && metadata.name == METADATA {
            metadata.metadata.insert("format".into(), FORMAT.to_string());
        }
        metadata
    }

    /// What a recording with events lacks to be verified; `has_maps` is true if it has maps or digests.
    pub(super) fn faults(&self, has_maps: bool) -> Vec<String> {
        let mut faults = Vec::new();
        if self.format() == Format::Damaged {
            let (format, version) = (self.value("format"), self.value("version"));
            faults.push(format!("its metadata has format {format:?}, which clearway {version} has never written"));
        }
        if self.boot_id == 0 {
            faults.push(format!("its metadata has the boot id {:?}, which is none", self.value("boot_id")));
        }
        if has_maps && self.value("maps") == "none" {
            faults.push("its metadata says that no map is recorded, and maps are".into());
        }
        match self.config.as_ref().map(|text| text.parse::<toml::Table>()) {
            None => faults.push("it has no config.toml, so its maps cannot be made again".into()),
            Some(Err(error)) => faults.push(format!("its config.toml cannot be read: {}", error.message())),
            Some(Ok(_)) => {}
        }
        faults
    }
}

/// The numbers of a version such as `0.1.0`, which compare as versions do.
fn version_numbers(version: &str) -> Option<Vec<u32>> {
    version.split('.').map(|number| number.parse().ok()).collect()
}
