//! The configuration of a replay with the keys that its command line sets.

use std::path::Path;

use clearway_daemon::config::{Calibrations, Config};

use super::error::ReplayError;
use super::options::ReplayOptions;

/// A configuration with the overrides of the options; the calibration tables that they name replace the tables in
/// `tables`.
pub(super) fn overridden(
    config: Config,
    options: &ReplayOptions,
    recording: &Path,
    tables: &mut Calibrations,
) -> Result<Config, ReplayError> {
    if options.set.is_empty() {
        return Ok(config);
    }
    let overridden = Config::parse(&config.to_toml(), recording, &options.set)?;
    let sensors = |config: &Config| config.vehicles.iter().flat_map(|v| v.sensors.clone()).collect::<Vec<_>>();
    let mut named = overridden.clone();
    let own = named.vehicles.iter_mut().flat_map(|vehicle| &mut vehicle.sensors);
    // The table of a recorded run is in its recording, whatever its file was called then.
    own.zip(sensors(&config))
        .filter(|(own, was)| own.calibration == was.calibration)
        .for_each(|(own, _)| own.calibration = None);
    let named = named.calibrations(recording)?;
    for (table, named) in tables.iter_mut().flatten().zip(named.into_iter().flatten()) {
        *table = named.or(table.take());
    }
    Ok(overridden)
}
