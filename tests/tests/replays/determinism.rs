//! The maps of a live run equal, byte for byte, the maps of each replay of its recording, whatever threads there are.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use clearway_daemon::record::verify;
use clearway_lidar::model::Model;
use clearway_replay::{ReplayOptions, replay};
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes::town;
use clearway_sim::send::{Pace, Until, drive};
use clearway_sim::vehicle::SimulatedVehicle;
use tokio::runtime::{Builder, Runtime};

use crate::fixture::{self, config, recorded_of_all, until, within};

/// Vehicles of the live server; each has a thread of its own for its engine.
const VEHICLES: usize = 4;
/// Maps of each vehicle of the live run, at least.
const MAPS: u64 = 4;
/// Number of replays.
const REPLAYS: usize = 10;

/// Records vehicles that send to one server in real time, over UDP.
async fn record_live(file: &Path) {
    let mut config = config();
    config.recorder.file = file.to_owned();
    config.vehicles[0].maps.memory.enabled = true;
    config.vehicles = vec![config.vehicles.remove(0); VEHICLES];
    for (number, vehicle) in config.vehicles.iter_mut().enumerate() {
        vehicle.name = format!("car-{number}");
    }
    let running = fixture::start(config).await;
    let is_over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        for (input, seed) in running.inputs.iter().zip(1..) {
            let scanner = ScannerConfig { model: Model::Vlp16, seed, ..ScannerConfig::default() };
            let (data, telemetry) = input.udp.expect("the vehicle has a socket");
            let until = Until { stop: Some(&is_over), device_time: None };
            let vehicle = SimulatedVehicle::new(town(), scanner);
            scope.spawn(move || drive(fixture::anywhere(), vehicle, data, telemetry, Pace::RealTime, until).unwrap());
        }
        let has_maps = || running.vehicles.0.iter().all(|vehicle| vehicle.status.snapshot().maps >= MAPS);
        tokio::task::block_in_place(|| tokio::runtime::Handle::current().block_on(until("maps of all", has_maps)));
        is_over.store(true, Ordering::Relaxed);
    });
    within("shutdown", running.shutdown()).await.unwrap();
}

fn runtime(threads: usize) -> Runtime {
    Builder::new_multi_thread().worker_threads(threads).enable_all().build().expect("threads")
}

#[test]
fn live_maps_of_four_vehicles_are_those_of_ten_replays_on_one_two_and_four_threads() {
    let folder = tempfile::tempdir().unwrap();
    let [live, again] = ["live.mcap", "again.mcap"].map(|name| folder.path().join(name));
    runtime(4).block_on(record_live(&live));
    let maps = recorded_of_all(&live);
    assert!(maps.len() as u64 >= VEHICLES as u64 * MAPS * fixture::LAYERS, "{} maps", maps.len());
    for run in 0..REPLAYS {
        let threads = [1, 2, 4][run % 3];
        let options =
            ReplayOptions { files: vec![live.clone()], record: Some(again.clone()), ..ReplayOptions::default() };
        let replayed = replay(options);
        runtime(threads).block_on(within("replay", replayed)).unwrap();
        let replayed = recorded_of_all(&again);
        std::fs::remove_file(&again).unwrap();
        let different = maps.iter().find(|(map, bytes)| replayed.get(*map) != Some(*bytes));
        assert_eq!(different.map(|(map, _)| map), None, "run {run} on {threads} threads");
        assert_eq!(replayed.len(), maps.len(), "run {run} on {threads} threads");
    }
    let report = verify(&live).unwrap();
    assert!(report.is_good() && report.equal == maps.len() as u64, "{:?}", report.differences);
}
