//! The vehicles of a demo, which drive at a server; one of several fails and comes back, over and over.

use std::net::{Ipv4Addr, SocketAddr};
use std::time::Duration;

use anyhow::{Context, Error, Result};
use clearway_daemon::base::clock::now_ns;
use clearway_daemon::run::Running;
use clearway_sim::scenes::town;
use clearway_sim::send::Sent;
use clearway_sim::traffic::street;

use super::car::DemoCar;
use super::rig::Rig;
use super::sensors::{DemoSensors, SensorChoice};

/// The address of what the server does not listen for.
pub const NOWHERE: SocketAddr = SocketAddr::new(std::net::IpAddr::V4(Ipv4Addr::LOCALHOST), 0);
/// The names of a fleet's vehicles; further vehicles have numbers.
const NAMES: [&str; 5] = ["car", "van", "truck", "bus", "shuttle"];
/// From one vehicle of a fleet to the next along its course, in metres.
const APART_M: f64 = 45.0;
/// The vehicle of a fleet that fails, how long it drives, and how long it stands still then, over and over.
const FAILING: usize = 1;
const DRIVES: Duration = Duration::from_secs(60);
const FAILS: Duration = Duration::from_secs(20);

/// The cars, and what was sent.
pub struct DemoFleet<'a> {
    running: &'a Running,
    sensors: DemoSensors,
    choice: &'a SensorChoice,
    /// `None` in the place of a car that stands still.
    cars: Vec<Option<DemoCar>>,
    sent: Sent,
}

impl<'a> DemoFleet<'a> {
    /// Starts all cars.
    pub fn start(running: &'a Running, sensors: DemoSensors, choice: &'a SensorChoice, count: usize) -> Result<Self> {
        let mut fleet = Self { running, sensors, choice, cars: Vec::new(), sent: Sent::default() };
        for index in 0..count {
            fleet.cars.push(Some(fleet.car(index, Duration::ZERO)?));
        }
        Ok(fleet)
    }

    /// Starts a car at the place that it reaches after the time that it has `driven`.
    fn car(&self, index: usize, driven: Duration) -> Result<DemoCar> {
        let mut rig = rig(self.sensors, self.choice, now_ns());
        let drive = &mut rig.scene.drive;
        drive.start = drive.station(driven.as_secs_f64()) + APART_M * index as f64;
        let udp = self.running.inputs[index].udp.unwrap_or((NOWHERE, NOWHERE));
        let (grpc, newest) = (self.running.grpc.unwrap_or(NOWHERE), &self.running.vehicles.0[index].newest);
        DemoCar::start(&name(index), rig, udp, grpc, newest).context("the simulated car")
    }

    /// Stops the car that fails, or starts it again, if it is time.
    pub async fn fail_in_turn(&mut self, elapsed: Duration) -> Result<()> {
        let drives = elapsed.as_secs() % (DRIVES + FAILS).as_secs() < DRIVES.as_secs();
        match self.cars.get(FAILING) {
            Some(None) if drives => self.cars[FAILING] = Some(self.car(FAILING, elapsed)?),
            Some(Some(_)) if !drives => {
                tracing::info!("{} fails, and comes back in {} s", name(FAILING), FAILS.as_secs());
                if let Some(car) = self.cars[FAILING].take() {
                    self.sent += car.stop().await?;
                }
            }
            _ => {}
        }
        Ok(())
    }

    /// True if a car has stopped by itself.
    pub fn has_stopped(&self) -> bool {
        self.cars.iter().flatten().any(DemoCar::has_stopped)
    }

    /// The longest simulated time that a car has skipped.
    pub fn skipped(&self) -> Duration {
        self.cars.iter().flatten().map(DemoCar::skipped).max().unwrap_or_default()
    }

    /// Stops all cars; returns what was sent, and why a car could not send.
    pub async fn stop(mut self) -> (Sent, Option<Error>) {
        let mut fault = None;
        for car in self.cars.into_iter().flatten() {
            match car.stop().await {
                Ok(of_car) => self.sent += of_car,
                Err(error) => fault = Some(error),
            }
        }
        (self.sent, fault)
    }
}

/// The name of the vehicle with this index.
pub fn name(index: usize) -> String {
    NAMES.get(index).map_or_else(|| format!("vehicle-{}", index + 1), |name| (*name).to_owned())
}

/// The car; its scene begins at `start_ns`.
pub fn rig(sensors: DemoSensors, choice: &SensorChoice, start_ns: i64) -> Rig {
    match sensors {
        DemoSensors::Many => Rig::many(street(8.0), start_ns),
        _ => Rig::one(choice.model, town(), start_ns),
    }
}
