//! The name of a sensor model on the command line -> the model.

use std::ffi::OsStr;

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use clap::error::ErrorKind;
use clap::{Arg, Command, Error};
use clearway_lidar::model::Model;

/// Reads the name of a model, as in the configuration (`vlp16`) or as Velodyne writes it (`VLP-16`), in small or in
/// capital letters.
#[derive(Clone)]
pub struct ModelParser;

impl ModelParser {
    fn find(name: &str) -> Option<Model> {
        let letters = |name: &str| name.replace([' ', '-', '_'], "").to_ascii_lowercase();
        Model::ALL.into_iter().find(|model| letters(model.as_str()) == letters(name))
    }
}

impl TypedValueParser for ModelParser {
    type Value = Model;

    fn parse_ref(&self, command: &Command, argument: Option<&Arg>, value: &OsStr) -> Result<Model, Error> {
        let found = value.to_str().and_then(Self::find);
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
                assert_eq!(ModelParser::find(&name), Some(model), "{name}");
            }
        }
        assert_eq!(ModelParser::find("hdl64e"), None, "there are three of them");
        assert_eq!(ModelParser::find("puck"), None, "a VLP-16 and a Puck Hi-Res are called so");
    }
}
