//! Cost of the simulation: a revolution of datagrams of each model, and a truth raster.

use clearway_lidar::model::Model;
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes;
use clearway_sim::truth::Limits;
use clearway_sim::vehicle::SimulatedVehicle;

fn main() {
    divan::main();
}

/// A tenth of a second of the town: one revolution of an HDL-64E is 133,312 rays and must take far less than 100 ms.
#[divan::bench(args = [Model::Hdl64eS2, Model::Hdl32e, Model::Vlp16, Model::Vls128], sample_count = 20)]
fn a_turn_in_town(bencher: divan::Bencher, model: Model) {
    let vehicle = SimulatedVehicle::new(scenes::town(), ScannerConfig { model, ..ScannerConfig::default() });
    let mut revolution = 0;
    bencher.bench_local(|| {
        revolution += 1;
        let end_ns = vehicle.start_ns() + (revolution + 1) * 100_000_000;
        vehicle.clone().from_revolution(revolution).take_while(|datagram| datagram.stamp_ns < end_ns).count()
    });
}

#[divan::bench(sample_count = 20)]
fn a_truth_raster_of_600_by_600_cells(bencher: divan::Bencher) {
    let vehicle = SimulatedVehicle::new(scenes::town(), ScannerConfig::default());
    bencher.bench_local(|| vehicle.truth_at(vehicle.start_ns(), 60.0, 0.2, &Limits::default()));
}
