//! The fuzzers' corpora, replayed. They hold only bytes made here; with `CLEARWAY_BLESS=1` they are written anew.

#[path = "../../fuzz/entries.rs"]
pub mod entries;

use std::path::PathBuf;

use clearway_lidar::calibration::unit_table::status_bytes;
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
fn every_seed_is_taken_without_a_panic() {
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
    let mut found = vec![0xFF];
    (0..3).for_each(|packet| found.extend(Stream::of(Model::Hdl32e).packet(packet)));
    write("packet", "model_unknown", &found);
    let status = status_bytes(Model::Hdl64eS3, &Calibration::factory(Model::Hdl64eS3));
    let status: Vec<u8> = status.into_iter().flat_map(|(kind, value)| [kind, value]).collect();
    write("packet", "unit_table", &[&[0xFF], status.as_slice()].concat());

    let sentence = "$GPRMC,120000,A,4807.0380,N,01131.0000,E,022.4,084.4,010120,003.1,W*";
    write("telemetry", "unfinished", &telemetry::datagram(5, sentence));
    write("telemetry", "no_fix", &telemetry::datagram(5, "$GPRMC,,V,,,,,,,,,,N*53\r\n"));
    write("telemetry", "empty", &telemetry::datagram(5, ""));
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
