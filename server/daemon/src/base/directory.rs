//! Finding a vehicle by its name, and the error for a name that does not exist.

/// Longest part of a client's name in an error, in characters. Ours: a name of more is none.
const NAME_CHARACTERS_MAX: usize = 64;

/// A name as an error shows it: at most its first characters, because it is a client's and may have any length.
pub fn shortened(name: &str) -> String {
    match name.char_indices().nth(NAME_CHARACTERS_MAX) {
        Some((end, _)) => format!("{}... ({} bytes)", &name[..end], name.len()),
        None => name.to_owned(),
    }
}

/// A request names a vehicle, sensor or layer that does not exist.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum UnknownNameError {
    /// No vehicle is named, and there is not exactly one.
    #[error("no vehicle is named: choose one of {known}")]
    NoVehicle {
        /// The names of all vehicles, separated by commas.
        known: String,
    },
    /// No vehicle has this name.
    #[error("vehicle {name:?} is not known; known: {known}")]
    Vehicle {
        /// The requested name, which no vehicle has.
        name: String,
        /// The names of all vehicles, separated by commas.
        known: String,
    },
    /// No sensor of the vehicle has this name, or the name is empty and there is not exactly one sensor.
    #[error("sensor {name:?} is not known; vehicle {vehicle} has: {known}")]
    Sensor {
        /// The requested name, which no sensor of the vehicle has.
        name: String,
        /// Name of the vehicle whose sensors were searched.
        vehicle: String,
        /// The names of the vehicle's sensors, separated by commas.
        known: String,
    },
    /// No layer of the vehicle's maps has this name.
    #[error("layer {name:?} is not known; vehicle {vehicle} has: {known}")]
    Layer {
        /// The requested name, which no layer has.
        name: String,
        /// Name of the vehicle whose layers were searched.
        vehicle: String,
        /// The names of the layers, separated by commas.
        known: String,
    },
}

impl From<UnknownNameError> for tonic::Status {
    fn from(error: UnknownNameError) -> Self {
        match error {
            UnknownNameError::NoVehicle { .. } | UnknownNameError::Vehicle { .. } | UnknownNameError::Sensor { .. } => {
                Self::not_found(error.to_string())
            }
            UnknownNameError::Layer { .. } => Self::invalid_argument(error.to_string()),
        }
    }
}

/// Finds the vehicle called `name`; an empty `name` stands for the only vehicle.
///
/// # Errors
/// [`UnknownNameError::Vehicle`] if no vehicle has the name, [`UnknownNameError::NoVehicle`] if it is empty and there
/// is not exactly one vehicle.
pub fn find_vehicle<'a, T>(
    vehicles: &'a [T],
    name: &str,
    name_of: impl Fn(&T) -> &str,
) -> Result<&'a T, UnknownNameError> {
    if let ("", [only]) = (name, vehicles) {
        return Ok(only);
    }
    vehicles.iter().find(|vehicle| name_of(vehicle) == name).ok_or_else(|| {
        let known: Vec<&str> = vehicles.iter().map(name_of).collect();
        let known = known.join(", ");
        match name {
            "" => UnknownNameError::NoVehicle { known },
            name => UnknownNameError::Vehicle { name: shortened(name), known },
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_empty_name_stands_for_the_only_vehicle_and_for_no_other() {
        let find = |vehicles: &[&str], name: &str| find_vehicle(vehicles, name, |of| of).map(|of| of.to_string());
        assert_eq!(find(&["car"], "").unwrap(), "car");
        assert_eq!(find(&["car", "van"], "van").unwrap(), "van");
        let error = find(&["car", "van"], "").unwrap_err();
        assert_eq!(error.to_string(), "no vehicle is named: choose one of car, van");
        assert!(find(&["car"], "van").is_err());
    }

    #[test]
    fn an_error_holds_the_first_characters_of_a_long_name() {
        let error = find_vehicle(&["car"], &"ä".repeat(30_000), |of| of).unwrap_err().to_string();
        assert!(error.contains("(60000 bytes)") && error.len() < 250, "{} bytes", error.len());
    }
}
