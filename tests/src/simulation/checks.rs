//! What must be true of a run, at every step and at its end.

use std::ops::Range;

use clearway_mapping::config::SensorConfig;
use clearway_mapping::layer::{Cells, Geometry, Layer, Meaning};
use clearway_mapping::ledger::Ledger;
use clearway_mapping::map::{Map, SensorState};
use clearway_mapping::pipeline::NamedStatus;
use nalgebra::Point3;

use super::drive::Drive;
use super::sensor_fault::inside;

/// A check that failed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Violation {
    /// Name of the check.
    pub check: &'static str,
    /// What the check found.
    pub found: String,
}

/// A violation of the named check.
pub fn violation(check: &'static str, found: impl Into<String>) -> Violation {
    Violation { check, found: found.into() }
}

/// Least distance of a checked cell, in metres: earlier in the revolution, from the car's earlier place, the sensor saw
/// nearer cells past the edge of the covered sector.
const COVERED_M_MIN: f64 = 8.0;
/// Outermost degrees of the sector that are not checked, for the same reason.
const COVERED_EDGE_DEG: i64 = 15;
/// Age of the oldest points in a map, in seconds: one revolution, and the deadline of contributing sensors.
const SEEN_S_MAX: f64 = 0.3;

/// Checks that received = decoded + telemetry + refused by reason.
pub fn adds_up(part: &str, ledger: &Ledger) -> Result<(), Violation> {
    let sum = ledger.decoded + ledger.telemetry + ledger.refused.values().sum::<u64>();
    match ledger.received == sum {
        true => Ok(()),
        false => Err(violation(
            "ledger",
            format!("{part}: received {}, and the parts make {sum}: {ledger:?}", ledger.received),
        )),
    }
}

/// Checks that every offered reading is in the vehicle's ledger, and that the ledgers of its sensors add up to no more.
pub fn accounts(offered: u64, ledger: &Ledger, sensors: &[NamedStatus]) -> Result<(), Violation> {
    adds_up("the vehicle", ledger)?;
    for sensor in sensors {
        adds_up(&sensor.name, &sensor.ledger)?;
    }
    let roads = ledger.roads + ledger.roads_refused.values().sum::<u64>();
    let known = ledger.received + ledger.lost + ledger.poses + ledger.poses_refused + roads;
    let sum: u64 = sensors.iter().map(|sensor| sensor.ledger.received + sensor.ledger.lost).sum();
    if known != offered {
        return Err(violation(
            "ledger",
            format!("{offered} readings were offered, {known} are in the ledger: {ledger:?}"),
        ));
    }
    if sum > ledger.received + ledger.lost {
        return Err(violation("ledger", format!("the sensors have {sum}, the vehicle {ledger:?}")));
    }
    Ok(())
}

/// Checks that no cell is free where the windows of all sensors are covered.
pub fn nothing_free(drive: &Drive, covered_deg: &Range<i64>, map: &Map) -> Result<(), Violation> {
    let sensors = &drive.config.vehicles[0].sensors;
    let back_m = [0.0, map.speed_mps.unwrap_or(0.0) * SEEN_S_MAX];
    let hidden = covered_deg.start + COVERED_EDGE_DEG..covered_deg.end - COVERED_EDGE_DEG;
    for layer in &map.layers {
        let free: Vec<u8> = (layer.legend.iter().enumerate())
            .filter(|(_, class)| class.meaning == Meaning::Free)
            .map(|(value, _)| value as u8)
            .collect();
        let Cells::U8(classes) = &layer.channels[0].cells else { continue };
        for (cell, _) in classes.iter().enumerate().filter(|(_, class)| free.contains(class)) {
            let [x, y] = centre(layer, cell);
            let from = |sensor: &SensorConfig, back_m: f64| {
                let at = sensor.extrinsics.ego_from_sensor().translation;
                (y - at.y).atan2(x + back_m - at.x).to_degrees()
            };
            let is_hidden = |sensor| back_m.iter().all(|back_m| inside(&hidden, from(sensor, *back_m)));
            if x.hypot(y) >= COVERED_M_MIN && sensors.iter().all(is_hidden) {
                let class = layer.legend[usize::from(classes[cell])].name;
                let found = format!("map {}: {} at ({x:.1}, {y:.1}) is {class}", map.sequence, layer.name);
                return Err(violation("covered", found));
            }
        }
    }
    Ok(())
}

/// Centre of a cell, ego frame, in metres.
pub fn centre(layer: &Layer, cell: usize) -> [f64; 2] {
    match &layer.geometry {
        Geometry::Radial { centre_m, row_radius_m, columns } => {
            let (row, column) = (cell / usize::from(*columns), cell % usize::from(*columns));
            let inner = if row == 0 { 0.0 } else { f64::from(row_radius_m[row - 1]) };
            let range = (inner + f64::from(row_radius_m[row])) / 2.0;
            let angle = (column as f64 + 0.5) * std::f64::consts::TAU / f64::from(*columns);
            [f64::from(centre_m[0]) + range * angle.cos(), f64::from(centre_m[1]) + range * angle.sin()]
        }
        &Geometry::Cartesian { origin_x_m, origin_y_m, width, cell_m, yaw_rad, .. } => {
            let at = |origin: f64, index: usize| origin + (index as f64 + 0.5) * f64::from(cell_m);
            let (x, y) = (at(origin_x_m, cell % width as usize), at(origin_y_m, cell / width as usize));
            let place =
                nalgebra::Rotation3::from_axis_angle(&nalgebra::Vector3::z_axis(), -yaw_rad) * Point3::new(x, y, 0.0);
            [place.x, place.y]
        }
    }
}

/// True if every sensor is whole and contributes to this map.
pub fn is_healthy(map: &Map) -> bool {
    map.sensors
        .iter()
        .all(|sensor| sensor.contribution.as_str() == "ok" && sensor.partial.is_empty() && sensor.blocked.is_empty())
}

/// The map with every cell set to class 1, which is free in every layer.
pub fn freed(map: &Map) -> Map {
    let mut map = map.clone();
    for layer in &mut map.layers {
        if let Cells::U8(classes) = &mut layer.channels[0].cells {
            classes.fill(1);
        }
    }
    map
}

/// The sensors of a map in one line.
pub fn describe(map: &Map) -> String {
    let sensor = |sensor: &SensorState| {
        let (name, state, age) = (&sensor.name, sensor.contribution.as_str(), sensor.age_ms.unwrap_or(f32::NAN));
        format!(
            "{name} {state} {age:.0} ms, clock {} {} ms, partial {:?}, blocked {:?}",
            sensor.clock, sensor.clock_offset_ms, sensor.partial, sensor.blocked
        )
    };
    let sensors: Vec<String> = map.sensors.iter().map(sensor).collect();
    format!("map {} by {}: {}", map.sequence, map.source, sensors.join("; "))
}
