//! The table of bad datagrams. Each is refused with a reason, or accepted for a stated one, and changes nothing else.

use clearway_lidar::model::BLOCK_FLAGS;
use clearway_lidar::{Echo, Model, ReturnMode, Revolution, Sensor, SensorConfig};

use crate::stream::{START_NS, Stream};
use crate::telemetry::{datagram, with_sum};

/// Number of packets of the stream before the bad datagram.
const BEFORE: usize = 100;
/// Number of packets of the stream.
const PACKETS: usize = 400;

struct Bad {
    name: String,
    bytes: Vec<u8>,
    /// Reason of the error, or `accepted`; the name then states why.
    outcome: &'static str,
}

fn bad(name: impl Into<String>, bytes: Vec<u8>, outcome: &'static str) -> Bad {
    Bad { name: name.into(), bytes, outcome }
}

/// The bad datagrams that a stream of a VLP-32C receives before packet `BEFORE`.
fn table(stream: &Stream) -> Vec<Bad> {
    let good = stream.packet(BEFORE);
    let with = |at: usize, bytes: &[u8]| {
        let mut packet = good.clone();
        packet[at..at + bytes.len()].copy_from_slice(bytes);
        packet
    };
    let mut table = Vec::new();

    for length in [0, 1, 2, 100, 206, 511, 513, 554, 1080, 1200, 1204, 1205, 1207, 1208, 1248, 1354, 1500, 2412, 65_507]
    {
        table.push(bad(format!("{length} bytes"), vec![0xFF; length], "length"));
    }
    table.push(bad("a good packet and a byte", [&good[..], &[0]].concat(), "length"));
    table.push(bad("a packet with its UDP header before it", [&[0; 8], &good[..]].concat(), "length"));

    for block in 0..12 {
        table.push(bad(format!("unknown flag in block {block}"), with(100 * block, &[0x12, 0x34]), "block_flag"));
    }
    table.push(bad("flag with its bytes swapped", with(0, &[0xEE, 0xFF]), "block_flag"));
    table.push(bad("lower block of an HDL-64E", with(700, &BLOCK_FLAGS[1].to_le_bytes()), "block_flag"));
    table.push(bad("third block of a VLS-128", with(300, &BLOCK_FLAGS[2].to_le_bytes()), "block_flag"));
    table.push(bad("all zeros", vec![0; 1206], "block_flag"));
    table.push(bad("all ones", vec![0xFF; 1206], "block_flag"));
    table.push(bad("text", b"GET / HTTP/1.1\r\n".iter().copied().cycle().take(1206).collect(), "block_flag"));
    table.push(bad("a packet one byte late", [&[0], &good[..1205]].concat(), "block_flag"));

    for (block, azimuth) in [(0, 36_001_u16), (3, 36_002), (5, 40_000), (11, u16::MAX)] {
        let bytes = with(100 * block + 2, &azimuth.to_le_bytes());
        table.push(bad(format!("azimuth {azimuth} in block {block}"), bytes, "azimuth"));
    }

    for byte in [0x00, 0x21, 0x22, 0x24, 0x27, 0x29, 0x63, 0xA1, 0xFF] {
        table.push(bad(format!("model byte {byte:#04x}"), with(1205, &[byte]), "model"));
    }
    for model in [Model::Hdl32e, Model::Vlp16, Model::PuckHiRes] {
        table.push(bad(format!("{model:?} among a VLP-32C's"), Stream { model, ..*stream }.packet(BEFORE), "model"));
    }
    for model in [Model::Hdl64eS1, Model::Hdl64eS2, Model::Hdl64eS3, Model::Vls128] {
        table.push(bad(
            format!("{model:?} among a VLP-32C's"),
            Stream { model, ..*stream }.packet(BEFORE),
            "block_flag",
        ));
    }

    table.push(bad("the packet before, again", stream.packet(BEFORE - 1), "duplicate"));
    table.push(bad("a packet of 40 packets before, again", stream.packet(BEFORE - 40), "duplicate"));
    table.push(bad("a packet that is no longer remembered, again", stream.packet(0), "device_time"));
    table.push(bad(
        "the same time and azimuth, other returns",
        {
            let mut packet = stream.packet(BEFORE - 1);
            packet[4..7].copy_from_slice(&[1, 2, 3]);
            packet
        },
        "duplicate",
    ));
    for us in [0_u32, 1, 3_599_999_999] {
        table.push(bad(format!("device time {us}"), with(1200, &us.to_le_bytes()), "device_time"));
    }

    let rmc = "GPRMC,214106,A,3707.8178,N,12139.2690,W,010.3,188.2,230715,013.8,E,D";
    let nmea = |name: &str, sentence: String| bad(name, datagram(5, &sentence), "nmea");
    let changed = |from: &str, to: &str| with_sum(&rmc.replacen(from, to, 1));
    table.push(nmea("checksum wrong", with_sum(rmc).replace("3707", "3708")));
    table.push(nmea("checksum cut", format!("${rmc}*0\r\n")));
    table.push(nmea("checksum no number", format!("${rmc}*XY\r\n")));
    table.push(nmea("checksum missing", format!("${rmc}\r\n")));
    table.push(nmea("no dollar", with_sum(rmc)[1..].to_owned()));
    table.push(nmea("GPGGA sentence", with_sum("GPGGA,214106,3707.8178,N,12139.2690,W,1,08,0.9,545.4,M,46.9,M,,")));
    table.push(nmea("no sentence", "hello\r\n".to_owned()));
    table.push(nmea("latitude 91 degrees", changed("3707.8178", "9107.8178")));
    table.push(nmea("latitude negative", changed("3707.8178", "-3707.8178")));
    table.push(nmea("latitude NaN", changed("3707.8178", "NaN")));
    table.push(nmea("longitude 181 degrees", changed("12139.2690", "18139.2690")));
    table.push(nmea("longitude infinite", changed("12139.2690", "inf")));
    table.push(nmea("unknown hemisphere", changed(",N,", ",Q,")));
    table.push(nmea("hemisphere missing", changed(",W,", ",,")));
    table.push(nmea("unknown status", changed(",A,", ",Z,")));
    table.push(nmea("hour 24", changed("214106", "244106")));
    table.push(nmea("minute 60", changed("214106", "216006")));
    table.push(nmea("second 61", changed("214106", "214161")));
    table.push(nmea("time cut", changed("214106", "2141")));
    table.push(nmea("day 0", changed("230715", "000715")));
    table.push(nmea("month 13", changed("230715", "231315")));
    table.push(nmea("date of letters", changed("230715", "23JUL5")));
    table.push(nmea("speed negative", changed("010.3", "-10.3")));
    table.push(nmea("speed 10^9 knots", changed("010.3", "1e9")));
    table.push(nmea("course 400 degrees", changed("188.2", "400.0")));
    let mut not_ascii = datagram(5, &with_sum(rmc));
    not_ascii[220] = 0xC3;
    table.push(bad("a byte that is not ASCII", not_ascii, "nmea"));
    let mut noise = vec![0xAA; 512];
    noise[206] = b'$';
    table.push(bad("noise of a telemetry datagram's length", noise, "nmea"));

    table.push(bad("telemetry without a sentence, because no receiver is connected", datagram(5, ""), "accepted"));
    table.push(bad("a fix that the receiver marks as void", datagram(5, &with_sum("GPRMC,,V,,,,,,,,,,N")), "accepted"));
    let mut pps = datagram(5, "");
    pps[202] = 77;
    table.push(bad("an unknown PPS state, which is shown as unknown", pps, "accepted"));
    table
}

/// Decodes the stream with a datagram before packet `BEFORE`, and returns the outcome of that datagram, the
/// revolutions, and the number of packets.
fn decode(stream: &Stream, bad: Option<&[u8]>) -> (&'static str, Vec<impl PartialEq + use<>>, u64) {
    let mut sensor = Sensor::new(SensorConfig::default());
    let mut revolutions = stream.push(&mut sensor, 0..BEFORE);
    let before = sensor.status();
    let arrival_ns = stream.arrival_ns(BEFORE) - 1_000;
    let outcome = match bad.map(|bad| sensor.push(bad, arrival_ns).map(|revolution| revolution.cloned())) {
        None => "",
        Some(Ok(revolution)) => {
            assert!(revolution.is_none());
            "accepted"
        }
        Some(Err(error)) => {
            assert_eq!(sensor.status(), before, "{error}");
            error.reason()
        }
    };
    revolutions.extend(stream.push(&mut sensor, BEFORE..PACKETS));
    revolutions.extend(sensor.finish().cloned());
    // Every laser fires, so there is no NaN to compare.
    let whole = |revolution: Revolution| {
        let echo = |echo: Echo| (echo.range_m, echo.x, echo.y, echo.z, echo.intensity);
        let echoes: Vec<_> = revolution.echoes.into_iter().map(echo).collect();
        let counts = (
            revolution.sequence,
            revolution.packets,
            revolution.packets_expected,
            revolution.firings_expected,
            revolution.partial,
        );
        (counts, revolution.start_ns, revolution.end_ns, revolution.rpm, revolution.firings, echoes)
    };
    (outcome, revolutions.into_iter().map(whole).collect(), sensor.status().packets)
}

#[test]
fn a_bad_datagram_is_refused_with_its_reason_and_changes_nothing() {
    let stream = Stream::of(Model::Vlp32c);
    let (_, expected, packets) = decode(&stream, None);
    assert!(expected.len() >= 2 && packets == PACKETS as u64);
    let table = table(&stream);
    assert!(table.len() >= 60, "{}", table.len());
    for Bad { name, bytes, outcome } in &table {
        let (found, revolutions, packets) = decode(&stream, Some(bytes));
        assert_eq!(found, *outcome, "{name}");
        assert!(revolutions == expected, "{name} changes the revolutions");
        assert_eq!(packets, PACKETS as u64, "{name}");
    }
}

#[test]
fn damage_that_no_check_can_find_changes_only_the_damaged_values() {
    // No check protects intensities, distances, azimuths in range, and unknown return modes.
    let stream = Stream::of(Model::Hdl32e);
    let config = SensorConfig { model: Some(Model::Hdl32e), ..SensorConfig::default() };
    for (name, at, byte) in
        [("distance", 4, 0xFF), ("intensity", 6, 0xFF), ("azimuth", 502, 0x01), ("mode", 1204, 0x77)]
    {
        let mut sensor = Sensor::new(config.clone());
        let mut revolutions = stream.push(&mut sensor, 0..BEFORE);
        let mut packet = stream.packet(BEFORE);
        packet[at] = byte;
        assert!(sensor.push(&packet, stream.arrival_ns(BEFORE)).is_ok(), "{name}");
        revolutions.extend(stream.push(&mut sensor, BEFORE + 1..PACKETS));
        assert!(revolutions.iter().all(|revolution| revolution.return_mode == ReturnMode::Strongest), "{name}");
        assert!(revolutions.windows(2).all(|pair| pair[0].end_ns < pair[1].start_ns), "{name}");
        assert_eq!(sensor.status().packets_lost, 0, "{name}");
    }
    let mut fresh = Sensor::new(config);
    assert_eq!(
        fresh.push(&[], START_NS).unwrap_err().to_string(),
        "length 0: a data packet has 1206 bytes, a telemetry datagram 512"
    );
}
