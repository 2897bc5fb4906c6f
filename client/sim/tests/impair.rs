//! Streams through a bad network: what the decoder makes of them, beside what it makes of clean streams.

use clearway_lidar::model::{Model, ReturnMode};
use clearway_lidar::revolution::Revolution;
use clearway_lidar::{Sensor, SensorConfig, SensorStatus};
use clearway_sim::impair::{Faults, Impaired};
use clearway_sim::noise::{mixed, uniform};
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes;
use clearway_sim::vehicle::{Datagram, Kind, SimulatedVehicle};

const SEEDS: u64 = 100;

/// The data packets of this many revolutions, from the middle of one on, all around the same clock hour.
fn stream(model: Model, return_mode: ReturnMode, rpm: f64, revolutions: f64) -> Vec<Datagram> {
    let vehicle =
        SimulatedVehicle::new(scenes::flat(), ScannerConfig { model, return_mode, rpm, ..Default::default() });
    let end_ns = vehicle.start_ns() + (revolutions * 60e9 / rpm) as i64;
    let packets = vehicle.filter(|datagram| datagram.kind == Kind::Data);
    packets.take_while(|datagram| datagram.stamp_ns < end_ns).collect()
}

fn streams(revolutions: f64) -> Vec<(Model, Vec<Datagram>)> {
    let kinds = [
        (Model::Hdl64eS2, ReturnMode::Strongest, 600.0),
        (Model::Hdl64eS3, ReturnMode::Dual, 900.0),
        (Model::Hdl32e, ReturnMode::Strongest, 600.0),
        (Model::Vlp16, ReturnMode::Strongest, 1200.0),
        (Model::Vlp16, ReturnMode::Dual, 300.0),
        (Model::Vlp32c, ReturnMode::Last, 600.0),
        (Model::Vls128, ReturnMode::Strongest, 600.0),
    ];
    kinds.map(|(model, mode, rpm)| (model, stream(model, mode, rpm, revolutions))).into()
}

/// Every revolution, the status at the end, and the refusals.
fn decode(
    model: Model,
    datagrams: impl IntoIterator<Item = Datagram>,
) -> (Vec<Revolution>, SensorStatus, Vec<&'static str>) {
    let mut sensor = Sensor::new(SensorConfig { model: Some(model), ..SensorConfig::default() });
    let (mut revolutions, mut refused) = (Vec::new(), Vec::new());
    for datagram in datagrams {
        match sensor.push(&datagram.payload, datagram.stamp_ns) {
            Ok(revolution) => revolutions.extend(revolution.cloned()),
            Err(refusal) => refused.push(refusal.reason()),
        }
    }
    revolutions.extend(sensor.finish().cloned());
    (revolutions, sensor.status(), refused)
}

/// All that a map is made from, bit for bit.
fn bits(revolution: &Revolution) -> impl PartialEq + std::fmt::Debug + use<> {
    let bits = |values: &[f32]| values.iter().map(|value| value.to_bits()).collect::<Vec<_>>();
    let echoes = revolution
        .echoes
        .iter()
        .map(|echo| (bits(&echo.range_m), bits(&echo.x), bits(&echo.y), bits(&echo.z), echo.intensity.clone()));
    (
        (revolution.sequence, revolution.start_ns, revolution.end_ns, revolution.rpm.to_bits(), revolution.partial),
        (revolution.packets, revolution.packets_expected, revolution.firings_expected, revolution.blocked.clone()),
        revolution.firings.clone(),
        echoes.collect::<Vec<_>>(),
    )
}

#[test]
fn copies_and_reordered_packets_change_no_bit_of_a_revolution() {
    let streams = streams(2.6);
    let expected: Vec<Vec<_>> =
        streams.iter().map(|(model, sent)| decode(*model, sent.clone()).0.iter().map(bits).collect()).collect();
    for seed in 0..SEEDS {
        let ((model, sent), expected) =
            (&streams[seed as usize % streams.len()], &expected[seed as usize % streams.len()]);
        let faults = Faults {
            duplicate: uniform(mixed(seed)) * 0.5,
            reorder: 1 + (mixed(seed ^ 1) % 32) as u32,
            delay_ns: 2_000_000,
            seed,
            ..Faults::default()
        };
        let mut network = Impaired::new(sent.iter().cloned(), faults);
        let (revolutions, status, refused) = decode(*model, network.by_ref());
        let counts = network.counts();
        assert!(counts.reordered > 0, "{model:?} {faults:?}");
        assert_eq!(refused.len() as u64, counts.duplicated, "{model:?} {faults:?}: {refused:?}");
        assert!(refused.iter().all(|reason| *reason == "duplicate"), "{model:?} {faults:?}: {refused:?}");
        assert_eq!((status.packets_lost, status.packets), (0, sent.len() as u64), "{model:?} {faults:?}");
        let same = revolutions.iter().zip(expected).all(|(revolution, expected)| bits(revolution) == *expected);
        assert!(revolutions.len() == expected.len() && same, "{model:?} {faults:?}");
    }
}

#[test]
fn lost_packets_are_counted_to_one_a_gap() {
    let streams = streams(6.0);
    let mut worst = 0;
    for seed in 0..SEEDS {
        let (model, sent) = &streams[seed as usize % streams.len()];
        let faults = Faults {
            loss: uniform(mixed(seed)) * 0.3,
            burst: if seed % 3 == 0 { 0.01 } else { 0.0 },
            burst_packets: 1 + (mixed(seed ^ 1) % 200) as u32,
            seed,
            ..Faults::default()
        };
        // Losses before the first packet and after the last one cannot be seen.
        let (head, rest) = sent.split_at(1);
        let (middle, tail) = rest.split_at(rest.len() - 1);
        let mut network = Impaired::new(middle.iter().cloned(), faults);
        let arrived: Vec<Datagram> = head.iter().cloned().chain(network.by_ref()).chain(tail.iter().cloned()).collect();
        let counts = network.counts();
        let (revolutions, status, refused) = decode(*model, arrived);
        assert!(refused.is_empty(), "{model:?} {faults:?}: {refused:?}");
        let off = status.packets_lost.abs_diff(counts.packets_lost);
        assert!(off <= counts.gaps, "{model:?} {faults:?} {counts:?}: {}", status.packets_lost);
        let missing: u64 =
            revolutions.iter().map(|revolution| u64::from(revolution.packets_expected - revolution.packets)).sum();
        assert!(missing.abs_diff(counts.packets_lost) <= counts.gaps, "{model:?} {faults:?} {counts:?}: {missing}");
        worst = worst.max(off);
    }
    println!("worst: {worst}");
}
