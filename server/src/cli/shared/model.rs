//! The name of a sensor model on the command line -> the model.

use std::ffi::OsStr;

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use clap::error::ErrorKind;
use clap::{Arg, Command, Error};
use clearway_lidar::model::Model;

/// Reads the name of a model, as in the configuration (`vlp16`) or as Velodyne writes it (`VLP-16`), in small or in
/// capital letters.
#[derive(Clone)]
pub struct ModelParser {
    /// The model that `hdl64e` stands for; `None`: that name is refused, because there are three of them.
    hdl64e: Option<Model>,
}

impl ModelParser {
    /// For the model of a sensor that exists.
    pub fn any() -> Self {
        Self { hdl64e: None }
    }

    /// For the model of a simulated sensor: `hdl64e` is the one that the simulation has by default.
    #[cfg(feature = "sim")]
    pub fn simulated() -> Self {
        Self { hdl64e: Some(Model::Hdl64eS2) }
    }

    fn find(&self, name: &str) -> Option<Model> {
        let letters = |name: &str| name.replace([' ', '-', '_'], "").to_ascii_lowercase();
        let name = letters(name);
        let found = Model::ALL.into_iter().find(|model| letters(model.as_str()) == name);
        found.or(self.hdl64e.filter(|_| name == "hdl64e"))
    }
}

impl TypedValueParser for ModelParser {
    type Value = Model;

    fn parse_ref(&self, command: &Command, argument: Option<&Arg>, value: &OsStr) -> Result<Model, Error> {
        let found = value.to_str().and_then(|name| self.find(name));
        let name = found.map_or(value, |model| OsStr::new(model.as_str()));
        let name = PossibleValuesParser::new(Model::ALL.map(Model::as_str)).parse_ref(command, argument, name)?;
        name.parse().map_err(|error| Error::raw(ErrorKind::InvalidValue, error))
    }

    fn possible_values(&self) -> Option<Box<dyn Iterator<Item = PossibleValue> + '_>> {
        Some(Box::new(Model::ALL.into_iter().map(|model| PossibleValue::new(model.as_str()).help(model.spec().name))))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_model_is_found_by_each_way_to_write_its_name() {
        for model in Model::ALL {
            for name in [model.as_str().to_owned(), model.spec().name.to_owned(), model.as_str().to_uppercase()] {
                assert_eq!(ModelParser::any().find(&name), Some(model), "{name}");
            }
        }
        assert_eq!(ModelParser::any().find("hdl64e"), None, "there are three of them");
        assert_eq!(ModelParser::any().find("puck"), None, "a VLP-16 and a Puck Hi-Res are called so");
    }

    #[cfg(feature = "sim")]
    #[test]
    fn hdl64e_is_the_default_of_the_simulation() {
        let default = clearway_sim::scanner::ScannerConfig::default().model;
        assert_eq!(ModelParser::simulated().find("HDL-64E"), Some(default));
    }
}
