//! Properties that hold for all bytes: no panic, and a refused datagram changes nothing.

use clearway_lidar::{Model, ReturnMode, Revolution, Sensor, SensorConfig};
use proptest::collection::vec;
use proptest::prelude::*;

use crate::corpora::entries;
use crate::stream::{START_NS, Stream};
use crate::{capture, telemetry};

fn models() -> impl Strategy<Value = Model> {
    proptest::sample::select(Model::ALL.to_vec())
}

/// Bytes to overwrite, as position and value.
fn damage() -> impl Strategy<Value = Vec<(prop::sample::Index, u8)>> {
    vec((any::<prop::sample::Index>(), any::<u8>()), 0..8)
}

fn damaged(mut bytes: Vec<u8>, damage: &[(prop::sample::Index, u8)]) -> Vec<u8> {
    damage.iter().for_each(|(at, byte)| *at.get_mut(&mut bytes) = *byte);
    bytes
}

/// An event of a hostile or faulty network.
#[derive(Clone, Debug)]
enum Event {
    Sent { skip: usize },
    Damaged { damage: Vec<(prop::sample::Index, u8)> },
    Azimuths { azimuths: Vec<u16> },
    Noise { bytes: Vec<u8> },
    Other { model: Model, dual: bool },
    Telemetry { damage: Vec<(prop::sample::Index, u8)> },
    Finish,
}

fn events() -> impl Strategy<Value = Event> {
    prop_oneof![
        8 => (0..40_usize).prop_map(|skip| Event::Sent { skip }),
        4 => damage().prop_map(|damage| Event::Damaged { damage }),
        2 => vec(0..=36_001_u16, 12).prop_map(|azimuths| Event::Azimuths { azimuths }),
        1 => prop_oneof![Just(1206_usize), Just(512), 0..1300_usize]
            .prop_flat_map(|length| vec(any::<u8>(), length))
            .prop_map(|bytes| Event::Noise { bytes }),
        1 => (models(), any::<bool>()).prop_map(|(model, dual)| Event::Other { model, dual }),
        1 => damage().prop_map(|damage| Event::Telemetry { damage }),
        1 => Just(Event::Finish),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 96, ..ProptestConfig::default() })]

    #[test]
    fn no_bytes_cause_a_panic(bytes in vec(any::<u8>(), 0..4000)) {
        entries::packet(&bytes);
        entries::telemetry(&bytes);
        entries::capture(&bytes);
        entries::calibration(&bytes);
    }

    #[test]
    fn no_stream_of_damaged_packets_causes_a_panic(
        model in models(),
        configured in any::<bool>(),
        cut_azimuth_deg in -720.0..720.0_f32,
        events in vec(events(), 1..60),
    ) {
        let stream = Stream { start_azimuth: 17_000, ..Stream::of(model) };
        let config = SensorConfig { model: configured.then_some(model), cut_azimuth_deg, ..SensorConfig::default() };
        let mut sensor = Sensor::new(config);
        let mut index = 0;
        for event in events {
            let datagram = match event {
                Event::Finish => {
                    if let Some(revolution) = sensor.finish() {
                        prop_assert!(revolution.start_ns <= revolution.end_ns);
                    }
                    continue;
                }
                Event::Sent { skip } => {
                    index += skip;
                    stream.packet(index)
                }
                Event::Damaged { damage } => damaged(stream.packet(index), &damage),
                Event::Azimuths { azimuths } => {
                    let mut packet = stream.packet(index);
                    for (block, azimuth) in azimuths.into_iter().enumerate() {
                        packet[100 * block + 2..100 * block + 4].copy_from_slice(&azimuth.to_le_bytes());
                    }
                    packet
                }
                Event::Noise { bytes } => bytes,
                Event::Other { model, dual } => {
                    let mode = if dual { ReturnMode::Dual } else { ReturnMode::Strongest };
                    Stream { mode, ..Stream::of(model) }.packet(index)
                }
                Event::Telemetry { damage } => {
                    damaged(telemetry::datagram(5_000_000, "$GPRMC,,V,,,,,,,,,,N*53\r\n"), &damage)
                }
            };
            index += 1;
            let before = sensor.status();
            match sensor.push(&datagram, stream.arrival_ns(index)) {
                Ok(None) => {}
                Ok(Some(revolution)) => {
                    prop_assert!(revolution.start_ns <= revolution.end_ns);
                    prop_assert_eq!(revolution.points().count(), revolution.returns());
                    prop_assert_eq!(revolution.echoes[0].range_m.len(), revolution.firings.len() * revolution.lasers);
                }
                Err(_) => prop_assert_eq!(sensor.status(), before),
            }
        }
    }

    #[test]
    fn a_refused_datagram_changes_no_later_revolution(
        model in models(),
        at in 0..200_usize,
        damage in damage(),
        noise in vec(any::<u8>(), 0..1300),
    ) {
        let stream = Stream::of(model);
        let decode = |bad: &[Vec<u8>]| {
            let mut sensor = Sensor::new(SensorConfig::default());
            let mut revolutions = stream.push(&mut sensor, 0..at);
            let refused = bad.iter().all(|bad| sensor.push(bad, START_NS).is_err());
            // A datagram that is accepted may make later packets copies, which are refused.
            let push = |index| sensor.push(&stream.packet(index), stream.arrival_ns(index)).ok().flatten().cloned();
            revolutions.extend((at..260).filter_map(push));
            revolutions.extend(sensor.finish().cloned());
            let content = |revolution: &Revolution| {
                let points: Vec<_> = revolution.points().collect();
                (revolution.start_ns, revolution.end_ns, revolution.partial, points)
            };
            (refused, revolutions.iter().map(content).collect::<Vec<_>>(), sensor.status())
        };
        let mut bad = vec![damaged(stream.packet(at), &damage), noise];
        bad.retain(|bad| decode(std::slice::from_ref(bad)).0);
        let ((_, revolutions, status), (_, expected_turns, expected_status)) = (decode(&bad), decode(&[]));
        prop_assert!(revolutions == expected_turns);
        prop_assert_eq!(status, expected_status);
    }

    #[test]
    fn no_damaged_capture_causes_a_panic(damage in damage(), end in any::<prop::sample::Index>()) {
        let frames = [capture::ethernet(&capture::ip_packet(&[1; 64], 0), true), capture::ethernet(&[0; 9], false)];
        for bytes in [
            capture::pcap(1, &frames, false, false),
            capture::pcapng(&frames, 6, 1),
        ] {
            let mut bytes = damaged(bytes, &damage);
            bytes.truncate(end.index(bytes.len()) + 1);
            entries::capture(&bytes);
        }
    }
}
