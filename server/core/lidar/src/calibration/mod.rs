//! The per-laser corrections of a sensor.
//!
//! In: a model, or text, or the status bytes of an HDL-64E. Out: a [`Calibration`]: angles in radians, lengths in
//! metres, lasers in firing order. This crate reads no files: the caller adds the name of the file to a
//! [`CalibrationError`].
//!
//! | file | in -> out |
//! |---|---|
//! | `table` | corrections of each laser -> [`Calibration`] |
//! | `factory` | model -> nominal table |
//! | `yaml` | ROS `velodyne_pointcloud` YAML <-> table |
//! | `xml` | Velodyne `db.xml` -> table |
//! | [`status_table`] | status bytes of an HDL-64E S2 or S3 <-> table |
//! | `bounds` | bounds of the numbers of a text |
//! | `error` | [`CalibrationError`] |

mod bounds;
mod error;
mod factory;
pub mod status_table;
mod table;
mod xml;
mod yaml;

pub use error::CalibrationError;
pub use table::{Calibration, LaserCalibration};

use crate::model::Model;

impl Calibration {
    /// The nominal table of a model. Each HDL-64E has its own table, so use its nominal table only if that is unknown.
    pub fn factory(model: Model) -> Self {
        factory::factory(model)
    }

    /// Reads ROS YAML or Velodyne XML.
    ///
    /// # Errors
    /// [`CalibrationError`] with the key, its value and what is allowed: as [`Calibration::from_xml`] if the text
    /// begins with `<`, else as [`Calibration::from_yaml`]; [`CalibrationError::Format`] if it is empty.
    pub fn load_str(text: &str) -> Result<Self, CalibrationError> {
        match text.trim_start_matches('\u{feff}').trim_start().chars().next() {
            Some('<') => Self::from_xml(text),
            Some(_) => Self::from_yaml(text),
            None => Err(CalibrationError::Format("an empty text".into())),
        }
    }

    /// Reads ROS `velodyne_pointcloud` YAML. Missing corrections are 0; a missing resolution follows from the number of
    /// lasers.
    ///
    /// # Errors
    /// - [`CalibrationError::Yaml`] if the text is not YAML.
    /// - [`CalibrationError::Format`] if it is not a map of keys.
    /// - [`CalibrationError::Missing`] if a required key is missing.
    /// - [`CalibrationError::Value`] if a value is out of bounds or of the wrong type.
    /// - [`CalibrationError::Duplicate`] if a key occurs twice with different values.
    pub fn from_yaml(text: &str) -> Result<Self, CalibrationError> {
        yaml::read(text)
    }

    /// Reads Velodyne `db.xml` (degrees and centimetres). The format has no flag for the two near-range corrections.
    /// VeloView, which defines the format, does not use them; so this table does not either, unless
    /// [`Calibration::with_two_point_corrections`] switches them on.
    ///
    /// # Errors
    /// - [`CalibrationError::Xml`] if the text is not XML.
    /// - [`CalibrationError::Missing`] if a required element is missing.
    /// - [`CalibrationError::Value`] if a value is out of bounds or of the wrong type.
    pub fn from_xml(text: &str) -> Result<Self, CalibrationError> {
        xml::read(text.trim_start_matches('\u{feff}').trim_start())
    }

    /// Writes ROS YAML. [`Calibration::from_yaml`] gives the same table again, to the last bit.
    pub fn to_yaml(&self) -> String {
        yaml::write(self)
    }
}
