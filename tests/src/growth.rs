//! The growth model of a fleet: what servers, routers and planners take, by formula.
//!
//! Each [`Part`] is one measured quantity: a sum of constants times numbers of the [`Size`], such as the maps that a
//! router sends in a second. `growth` (the program) measures sizes, fits the constants and checks them.

use std::fmt;

use nalgebra::{DMatrix, DVector};

use crate::roles::LAYERS;

/// Maps of a vehicle in a second, of each layer.
pub const MAPS_HZ: f64 = 10.0;
/// Heartbeats of a layer and announcements of a vehicle in a second.
const BEATS_HZ: f64 = 1.0;
/// Probes of the link that a server sends around a map with all layers; the router answers each.
pub const PROBES: f64 = 2.0;

/// A fleet on one machine: a server for each router, the vehicles spread over the servers, the readers of a vehicle
/// over the routers, each two routers joined.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Size {
    /// Number of vehicles.
    pub vehicles: usize,
    /// Number of planners, each of which reads one vehicle.
    pub planners: usize,
    /// Number of routers.
    pub routers: usize,
    /// True if the vehicles' sensors send.
    pub is_moving: bool,
}

impl fmt::Display for Size {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{} × {}, {}", self.vehicles, self.planners, self.routers)
    }
}

impl Size {
    /// Number of servers; server N is a client of router N.
    pub fn servers(&self) -> usize {
        self.routers.min(self.vehicles)
    }

    /// The server of a vehicle.
    pub fn server_of(&self, vehicle: usize) -> usize {
        vehicle % self.servers()
    }

    /// The vehicle that a planner reads.
    pub fn vehicle_of(&self, planner: usize) -> usize {
        planner % self.vehicles
    }

    /// The router to which a planner is connected.
    pub fn router_of(&self, planner: usize) -> usize {
        planner / self.vehicles % self.routers
    }

    /// Maps of one layer that planners are due in a second.
    pub fn maps_delivered(&self) -> f64 {
        if self.is_moving { (self.planners * LAYERS.len()) as f64 * MAPS_HZ } else { 0.0 }
    }

    /// Maps with all layers that the servers make in a second.
    fn maps_made(&self) -> f64 {
        if self.is_moving { self.vehicles as f64 * MAPS_HZ } else { 0.0 }
    }

    /// Sessions of all routers; one between two routers counts at both.
    fn sessions(&self) -> f64 {
        (self.planners + self.servers() + self.routers * (self.routers - 1)) as f64
    }

    /// Messages that all routers receive and send in a second. A message crosses to each router with a reader once.
    fn messages(&self) -> [f64; 2] {
        let (mut messages, mut probes_hz) = ([0.0; 2], 0.0);
        let mut add = |hz: f64, from: usize, readers: &[usize]| {
            let readers_in_all: usize = readers.iter().sum();
            let others =
                readers.iter().enumerate().filter(|(router, readers)| *router != from && **readers > 0).count();
            messages[0] += hz * (usize::from(readers_in_all > 0) + others) as f64;
            messages[1] += hz * (readers_in_all + others) as f64;
        };
        for vehicle in 0..self.vehicles {
            let from = self.server_of(vehicle);
            let mut readers = vec![0; self.routers];
            let planners = (0..self.planners).filter(|planner| self.vehicle_of(*planner) == vehicle);
            planners.for_each(|planner| readers[self.router_of(planner)] += 1);
            let maps_hz = if self.is_moving { MAPS_HZ } else { 0.0 };
            add(LAYERS.len() as f64 * (maps_hz + BEATS_HZ), from, &readers);
            probes_hz += if readers.iter().any(|readers| *readers > 0) { PROBES * maps_hz } else { 0.0 };
            let other_servers: Vec<_> =
                (0..self.routers).map(|router| usize::from(router != from && router < self.servers())).collect();
            add(BEATS_HZ, from, &other_servers);
        }
        messages.map(|of| of + probes_hz)
    }
}

/// A constant of the model: its name with its unit, and the number by which the fitted value is multiplied for it.
type Constant = (&'static str, f64);

/// One measured quantity and what it is made of.
pub struct Part {
    /// The quantity with its unit.
    pub name: &'static str,
    constants: &'static [Constant],
    /// What each constant is multiplied by.
    numbers: fn(&Size) -> Vec<f64>,
}

/// The parts of the model. The first constant of servers and of bytes is one of the sensor.
pub const PARTS: [Part; 7] = [
    Part {
        name: "servers, cores",
        constants: &[("server: a map of the layers, ms of a core", 1e3), ("server: one process, cores", 1.0)],
        numbers: |size| vec![size.maps_made(), size.servers() as f64],
    },
    Part {
        name: "routers, cores",
        constants: &[
            ("router: a session, us of a core a second", 1e6),
            ("router: a message received, us of a core", 1e6),
            ("router: a message sent, us of a core", 1e6),
        ],
        numbers: |size| std::iter::once(size.sessions()).chain(size.messages()).collect(),
    },
    Part {
        name: "planners, cores",
        constants: &[
            ("planner: a session, us of a core a second", 1e6),
            ("planner: a map received and decoded, us of a core", 1e6),
        ],
        numbers: |size| vec![size.planners as f64, size.maps_delivered()],
    },
    Part {
        name: "servers, MiB",
        constants: &[("server: a vehicle, MiB", 1.0), ("server: one process, MiB", 1.0)],
        numbers: |size| vec![if size.is_moving { size.vehicles as f64 } else { 0.0 }, size.servers() as f64],
    },
    Part {
        name: "routers, MiB",
        constants: &[("router: a session, KiB", 1024.0), ("router: one process, MiB", 1.0)],
        numbers: |size| vec![size.sessions(), size.routers as f64],
    },
    Part {
        name: "planners, MiB",
        constants: &[("planner: a session with its maps, KiB", 1024.0), ("planners: one process, MiB", 1.0)],
        numbers: |size| vec![size.planners as f64, size.routers as f64],
    },
    Part {
        name: "maps, MB/s",
        constants: &[("a map of one layer, kB", 1e3)],
        numbers: |size| vec![size.maps_delivered()],
    },
];
/// Parts whose first constant depends on the sensor.
const OF_SENSOR: [usize; 3] = [0, 3, 6];

/// The constants of each part, in its order.
#[derive(Clone, Debug)]
pub struct Model(Vec<Vec<f64>>);

impl Model {
    /// The constants that fit these values of [`PARTS`] best.
    pub fn fit(sizes: &[Size], values: &[Vec<f64>]) -> Self {
        let fit = |(index, part): (usize, &Part)| {
            let of_part = sizes.iter().zip(values).map(|(size, values)| ((part.numbers)(size), values[index]));
            fit(&of_part.filter(|(_, value)| *value > 0.0).collect::<Vec<_>>())
        };
        Self(PARTS.iter().enumerate().map(fit).collect())
    }

    /// The value of each part at this size.
    pub fn predict(&self, size: &Size) -> Vec<f64> {
        let sum = |(part, constants): (&Part, &Vec<f64>)| dot(&(part.numbers)(size), constants);
        PARTS.iter().zip(&self.0).map(sum).collect()
    }

    /// The same model with the constants of another sensor, of which one size was measured.
    pub fn of_sensor(&self, size: &Size, values: &[f64]) -> Self {
        let mut model = self.clone();
        for part in OF_SENSOR {
            let (numbers, constants) = ((PARTS[part].numbers)(size), &mut model.0[part]);
            constants[0] = (values[part] - dot(&numbers[1..], &constants[1..])) / numbers[0];
        }
        model
    }

    /// Each constant by its name, in its unit.
    pub fn constants(&self) -> Vec<(&'static str, f64)> {
        let of_part = |(part, values): (&Part, &Vec<f64>)| {
            let named = part.constants.iter().zip(values.clone());
            named.map(|((name, times), value)| (*name, times * value)).collect::<Vec<_>>()
        };
        PARTS.iter().zip(&self.0).flat_map(of_part).collect()
    }

    pub(crate) fn constant(&self, part: usize, index: usize) -> f64 {
        self.0[part][index]
    }
}

fn dot(numbers: &[f64], constants: &[f64]) -> f64 {
    numbers.iter().zip(constants).map(|(number, constant)| number * constant).sum()
}

/// Least squares of the relative errors, with no constant below 0: of all choices of constants that are not 0, the one
/// with the least error.
fn fit(rows: &[(Vec<f64>, f64)]) -> Vec<f64> {
    let count = rows.first().map_or(0, |(numbers, _)| numbers.len());
    let error = |constants: &[f64]| rows.iter().map(|(of, value)| (dot(of, constants) / value - 1.0).powi(2)).sum();
    let mut best: (f64, Vec<f64>) = (f64::INFINITY, vec![0.0; count]);
    for choice in 1_u32..1 << count {
        let chosen: Vec<_> = (0..count).filter(|index| choice >> index & 1 == 1).collect();
        let matrix =
            DMatrix::from_fn(rows.len(), chosen.len(), |row, column| rows[row].0[chosen[column]] / rows[row].1);
        let Ok(solution) = matrix.svd(true, true).solve(&DVector::from_element(rows.len(), 1.0), 1e-9) else {
            continue;
        };
        let mut constants = vec![0.0; count];
        chosen.iter().zip(solution.iter()).for_each(|(index, value)| constants[*index] = *value);
        let error: f64 = error(&constants);
        if solution.iter().all(|value| *value >= 0.0) && error < best.0 {
            best = (error, constants);
        }
    }
    best.1
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZES: [Size; 4] = [
        Size { vehicles: 4, planners: 120, routers: 2, is_moving: false },
        Size { vehicles: 2, planners: 2, routers: 2, is_moving: true },
        Size { vehicles: 2, planners: 120, routers: 2, is_moving: true },
        Size { vehicles: 12, planners: 12, routers: 2, is_moving: true },
    ];

    #[test]
    fn a_message_crosses_to_each_router_with_a_reader_once() {
        // Vehicle 0 at router 0, vehicle 1 at router 1; all readers at router 0. Announcements cross too.
        let one_router_reads = Size { vehicles: 2, planners: 2, routers: 2, is_moving: true };
        // Probes of both vehicles and their answers.
        let probes = 2.0 * PROBES * MAPS_HZ;
        assert_eq!(one_router_reads.messages(), [2.0 * 11.0 * 3.0 + 2.0 * 2.0 + probes; 2]);
        let both_read = Size { planners: 8, ..one_router_reads };
        assert_eq!(both_read.messages(), [2.0 * 11.0 * 4.0 + 4.0 + probes, 2.0 * 11.0 * 10.0 + 4.0 + probes]);
    }

    #[test]
    fn the_constants_that_made_the_values_are_found() {
        let constants = Model(PARTS.iter().map(|part| vec![0.02; part.constants.len()]).collect());
        let values = SIZES.map(|size| constants.predict(&size));
        let found = Model::fit(&SIZES, &values);
        let close = found.0.concat().iter().all(|constant| (constant - 0.02).abs() < 1e-9);
        assert!(close, "{found:?}");
        let larger = found
            .of_sensor(&SIZES[1], &constants.predict(&SIZES[1]).iter().map(|value| value + 0.2).collect::<Vec<_>>());
        assert!((larger.constant(0, 0) - 0.03).abs() < 1e-9, "20 maps a second take 0.2 cores more");
    }

    #[test]
    fn no_constant_is_negative() {
        assert_eq!(fit(&[(vec![1.0, 1.0], 2.0), (vec![1.0, 2.0], 1.0)])[1], 0.0);
    }
}
