//! Replay of the corpora of the fuzzers. They contain seeds that are generated here (`CLEARWAY_BLESS=1` writes them
//! again) and inputs that the fuzzers found (named by their hash).

#[path = "../fuzz/entries.rs"]
pub mod entries;

use std::path::PathBuf;

use clearway_lidar::calibration::status_table::status_bytes;
use clearway_lidar::{Calibration, Model, ReturnMode};

use crate::stream::Stream;
use crate::{capture, telemetry};

fn folder(target: &str) -> PathBuf {
    [env!("CARGO_MANIFEST_DIR"), "fuzz", "corpus", target].iter().collect()
}

fn replay(target: &str, entry: fn(&[u8])) {
    let mut replayed = 0;
    for file in std::fs::read_dir(folder(target)).unwrap() {
        entry(&std::fs::read(file.unwrap().path()).unwrap());
        replayed += 1;
    }
    assert!(replayed >= 4, "{target}: {replayed} seeds");
}

#[test]
fn no_seed_causes_a_panic() {
    if std::env::var_os("CLEARWAY_BLESS").is_some() {
        write_seeds();
    }
    replay("packet", entries::packet);
    replay("telemetry", entries::telemetry);
    replay("capture", entries::capture);
    replay("calibration", entries::calibration);
}

fn write_seeds() {
    let write = |target: &str, name: &str, bytes: &[u8]| {
        std::fs::create_dir_all(folder(target)).unwrap();
        std::fs::write(folder(target).join(name), bytes).unwrap();
    };
    for (index, model) in Model::ALL.into_iter().enumerate() {
        for mode in [ReturnMode::Strongest, ReturnMode::Dual] {
            if mode == ReturnMode::Dual && !model.spec().dual_return {
                continue;
            }
            let stream = Stream { mode, start_azimuth: 17_980, ..Stream::of(model) };
            let mut bytes = vec![index as u8];
            (0..2).for_each(|packet| bytes.extend(stream.packet(packet)));
            write("packet", &format!("{model:?}_{mode:?}").to_lowercase(), &bytes);
        }
        write(
            "calibration",
            &format!("{model:?}.yaml").to_lowercase(),
            Calibration::factory(model).to_yaml().as_bytes(),
        );
    }
    // Packets that are late, duplicated, lost, or from another time.
    let streams = Stream::of(Model::Vlp16);
    let orders: [(&str, Vec<usize>); 4] = [
        ("out_of_order", (0..40).map(|index| index ^ 5).collect()),
        ("twice", (0..40).map(|index| index / 2 + index % 2 * 3).collect()),
        ("lost", (0..140).filter(|index| index % 7 != 0 && !(40..130).contains(index)).collect()),
        ("restarts", (0..60).map(|index| [index, index + 3_000][index / 20 % 2]).collect()),
    ];
    for (name, order) in orders {
        let mut bytes = vec![4];
        order.into_iter().for_each(|index| bytes.extend(streams.packet(index)));
        write("packet", name, &bytes);
    }
    let mut found = vec![0xFF];
    (0..3).for_each(|packet| found.extend(Stream::of(Model::Hdl32e).packet(packet)));
    write("packet", "model_unknown", &found);
    let status = status_bytes(Model::Hdl64eS3, &Calibration::factory(Model::Hdl64eS3));
    let status: Vec<u8> = status.into_iter().flat_map(|(kind, value)| [kind, value]).collect();
    write("packet", "status_table", &[&[0xFF], status.as_slice()].concat());

    let sentence = "$GPRMC,120000,A,4807.0380,N,01131.0000,E,022.4,084.4,010120,003.1,W*";
    write("telemetry", "unfinished", &telemetry::datagram(5, sentence));
    write("telemetry", "no_fix", &telemetry::datagram(5, "$GPRMC,,V,,,,,,,,,,N*53\r\n"));
    write("telemetry", "empty", &telemetry::datagram(5, ""));
    for (name, text) in [
        ("latitude_91", "GPRMC,120000,A,9107.0380,N,01131.0000,E,022.4,084.4,010120,003.1,W"),
        ("no_commas", "GPRMC"),
        ("long_fields", "GPRMC,120000.000000000000000000000000000000001,A,4807.0380,N,01131.0,E,1e3,0.0,010100"),
        ("leap_second", "GPRMC,235960,A,4807.0380,N,01131.0000,E,022.4,084.4,311216,003.1,W"),
        ("no_date", "GPRMC,120000,A,4807.0380,N,01131.0000,E,022.4,084.4,,003.1,W"),
    ] {
        write("telemetry", name, &telemetry::datagram(5, &telemetry::with_sum(text)));
    }
    write("telemetry", "wrong_sum", &telemetry::datagram(5, &format!("{sentence}00\r\n")));

    let frames = [capture::ethernet(&capture::ip_packet(&[1, 2, 3], 0), false), capture::ethernet(&[0; 9], true)];
    write("capture", "microseconds.pcap", &capture::pcap(1, &frames, false, false));
    write("capture", "nanoseconds_big_endian.pcap", &capture::pcap(1, &frames, true, true));
    write("capture", "raw_ip.pcap", &capture::pcap(101, &[capture::ip_packet(&[1, 2, 3], 0x2000)], false, false));
    write("capture", "nanoseconds.pcapng", &capture::pcapng(&frames, 9, 1 << 40));
    write(
        "calibration",
        "short.xml",
        b"<?xml version=\"1.0\"?><!DOCTYPE b><b><DB><distLSB_>0.2</distLSB_><points_/></DB></b>",
    );
}
