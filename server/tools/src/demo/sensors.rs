//! The sensors of the simulated car, and the ones that this machine can simulate in real time.
//!
//! In: the choice on the command line. Out: the sensor on the roof, and why it was chosen.

use std::fmt;
use std::thread::available_parallelism;
use std::time::{Duration, Instant};

use clearway_lidar::model::Model;
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes::town;
use clearway_sim::vehicle::SimulatedVehicle;

/// DemoSensors of the simulated car.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum DemoSensors {
    /// One LIDAR on the roof, in a town: the one with the most lasers that this machine can simulate in real time.
    #[default]
    #[value(alias = "one")]
    Auto,
    /// One HDL-64E S2 on the roof, in a town; hdl64e for short.
    #[value(name = "hdl64e_s2", alias = "hdl64e")]
    Hdl64e,
    /// One HDL-32E on the roof, in a town.
    Hdl32e,
    /// One VLP-16 on the roof, in a town.
    Vlp16,
    /// Two VLP-16 over UDP, six LIDARs of a few planes over gRPC, with poses and roads, in traffic.
    Many,
}

/// The sensor on the roof that was chosen, and why.
#[derive(Clone, Debug, PartialEq)]
pub struct SensorChoice {
    /// The chosen model.
    pub model: Model,
    /// Share of one core that simulating it takes, as measured for each model that was tried, the chosen one last.
    /// Empty if the model was given.
    pub core_shares: Vec<(Model, f64)>,
}

/// Models that are tried, from the most lasers to the fewest.
const MODELS: [Model; 3] = [Model::Hdl64eS2, Model::Hdl32e, Model::Vlp16];
/// Share of all cores that the simulation may take. The rest is for the server and for a browser, which draws a map
/// with the processor if the machine has no graphics card. Ours, because on two cores a page beside the demo stays
/// fresh with it.
const SHARE_MAX: f64 = 0.25;
/// How much simulated time is measured: two revolutions, as the scene is not equally dense all around.
const MEASURED: Duration = Duration::from_millis(200);

impl SensorChoice {
    /// The model that `sensors` names, or a model that this machine can afford.
    pub fn new(sensors: DemoSensors) -> Self {
        let given = |model| Self { model, core_shares: Vec::new() };
        match sensors {
            DemoSensors::Auto => Self::affordable(core_share),
            DemoSensors::Hdl64e => given(Model::Hdl64eS2),
            DemoSensors::Hdl32e => given(Model::Hdl32e),
            DemoSensors::Vlp16 | DemoSensors::Many => given(Model::Vlp16),
        }
    }

    /// The first model that takes no more than [`SHARE_MAX`] of all cores; the model with the fewest lasers if none
    /// does.
    fn affordable(core_share: impl Fn(Model) -> f64) -> Self {
        let cores = available_parallelism().map_or(1, usize::from) as f64;
        let mut core_shares = Vec::new();
        for model in MODELS {
            core_shares.push((model, core_share(model)));
            if core_shares.last().is_some_and(|(_, share)| *share <= SHARE_MAX * cores) {
                break;
            }
        }
        let model = core_shares.last().map_or(Model::Vlp16, |(model, _)| *model);
        Self { model, core_shares }
    }
}

impl fmt::Display for SensorChoice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(name(self.model))?;
        let Some((last, before)) = self.core_shares.split_last() else { return Ok(()) };
        let percent = |share: f64| (100.0 * share).round();
        write!(f, " (simulating it takes {} % of a core", percent(last.1))?;
        for (model, share) in before {
            write!(f, "; {} would take {} %", name(*model), percent(*share))?;
        }
        f.write_str("; --sensors chooses another)")
    }
}

/// The name of a model as people write it.
pub fn name(model: Model) -> &'static str {
    match model {
        Model::Hdl32e => "HDL-32E",
        Model::Vlp16 => "VLP-16",
        _ => "HDL-64E",
    }
}

/// Share of one core that simulating `model` in real time takes, measured now. Above 1 it is too slow. Whatever else
/// runs on the machine makes it greater.
fn core_share(model: Model) -> f64 {
    let vehicle = SimulatedVehicle::new(town(), ScannerConfig { model, ..ScannerConfig::default() });
    let end_ns = vehicle.start_ns() + MEASURED.as_nanos() as i64;
    let began = Instant::now();
    let packets = vehicle.take_while(|datagram| datagram.stamp_ns < end_ns).count();
    debug_assert!(packets > 0, "the vehicle sends packets");
    began.elapsed().as_secs_f64() / MEASURED.as_secs_f64()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cores() -> f64 {
        available_parallelism().map_or(1, usize::from) as f64
    }

    #[test]
    fn a_fast_machine_gets_the_most_lasers() {
        let choice = SensorChoice::affordable(|_| 0.01);
        assert_eq!(choice, SensorChoice { model: Model::Hdl64eS2, core_shares: vec![(Model::Hdl64eS2, 0.01)] });
        assert_eq!(choice.to_string(), "HDL-64E (simulating it takes 1 % of a core; --sensors chooses another)");
    }

    #[test]
    fn a_slow_machine_gets_fewer_lasers_and_the_reason() {
        let share = |model| if model == Model::Hdl64eS2 { cores() } else { 0.1 };
        let choice = SensorChoice::affordable(share);
        assert_eq!(choice.model, Model::Hdl32e);
        assert!(choice.to_string().contains("HDL-32E (simulating it takes 10 % of a core; HDL-64E would take"));
    }

    #[test]
    fn a_machine_that_is_too_slow_for_all_gets_the_fewest_lasers() {
        assert_eq!(SensorChoice::affordable(|_| 100.0).model, Model::Vlp16);
    }

    #[test]
    fn a_sensor_that_was_asked_for_is_not_measured() {
        assert_eq!(
            SensorChoice::new(DemoSensors::Hdl64e),
            SensorChoice { model: Model::Hdl64eS2, core_shares: Vec::new() }
        );
        assert_eq!(SensorChoice::new(DemoSensors::Hdl64e).to_string(), "HDL-64E");
    }
}
