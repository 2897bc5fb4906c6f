//! A peer of the zenoh network that is no server and no ingester.

use std::time::Duration;

use clearway_client::now_ns;
use clearway_proto::map::{encode_header, encode_layer};
use clearway_proto::packed::pack;
use clearway_proto::v1;
use futures::FutureExt;
use prost::Message;
use zenoh::Session;
use zenoh::qos::CongestionControl;
use zenoh::sample::SourceInfo;

use super::target::Attack;
use super::watch::plain;

const MAPS: &str = "clearway/car/map/drivability";
/// Samples between two pauses.
const BURST: u64 = 100;
const PAUSE: Duration = Duration::from_millis(1);

/// The attacks of this file.
pub const ATTACKS: &[Attack] = &[
    Attack { name: "zenoh: junk on the maps' key", run: |target| flood(target.zenoh, MAPS, |_| b"x".to_vec()).boxed() },
    Attack { name: "zenoh: forged maps", run: |target| flood(target.zenoh, MAPS, forged).boxed() },
    Attack {
        name: "zenoh: forged maps on a wildcard",
        run: |target| flood(target.zenoh, "clearway/**", forged).boxed(),
    },
    Attack {
        name: "zenoh: junk as observations",
        run: |target| flood(target.zenoh, "clearway/car/ingest/pose", junk).boxed(),
    },
    Attack {
        name: "zenoh: 1 MiB as observations",
        run: |target| flood(target.zenoh, "clearway/car/ingest/scan/top", long).boxed(),
    },
    Attack { name: "zenoh: 1 session of large scans", run: |target| large_scans(target.zenoh, 1).boxed() },
    Attack { name: "zenoh: 16 sessions of large scans", run: |target| large_scans(target.zenoh, 16).boxed() },
    Attack { name: "zenoh: false answers and heartbeats", run: |target| answer(target.zenoh).boxed() },
];

/// A session of a client; `None` if no server answers.
pub async fn session(endpoint: &str) -> Option<Session> {
    let mut config = zenoh::Config::default();
    let settings = [
        ("mode", "'client'".to_owned()),
        ("connect/endpoints", format!("[{endpoint:?}]")),
        ("connect/timeout_ms", "5000".to_owned()),
        ("scouting/multicast/enabled", "false".to_owned()),
        ("scouting/gossip/enabled", "false".to_owned()),
    ];
    for (key, value) in settings {
        config.insert_json5(key, &value).expect("a setting of zenoh");
    }
    zenoh::open(config).await.ok()
}

async fn flood(endpoint: String, key: &'static str, payload: fn(u64) -> Vec<u8>) {
    let Some(session) = session(&endpoint).await else { return };
    for number in 0.. {
        let _dropped = session.put(key, payload(number)).await;
        if number % BURST == 0 {
            tokio::time::sleep(PAUSE).await;
        }
    }
}

/// A map that claims to be fresh for a year: every third has a huge sequence, the others another run of the server.
fn forged(number: u64) -> Vec<u8> {
    let stamp = now_ns();
    let header = v1::Header {
        vehicle: "car".into(),
        boot_id: number % 3,
        sequence: if number.is_multiple_of(3) { 1 << 63 } else { number },
        capture_start_ns: stamp,
        capture_end_ns: stamp,
        valid_until_ns: stamp + 31_536_000_000_000_000,
        ..Default::default()
    };
    let radial = v1::RadialGrid { row_radius_m: vec![10.0], columns: 4, ..Default::default() };
    let geometry = Some(v1::layer::Geometry::Radial(radial));
    let layer = v1::Layer { name: "drivability".into(), geometry, ..Default::default() };
    [encode_header(&header), encode_layer(&layer)].concat()
}

fn junk(number: u64) -> Vec<u8> {
    number.to_le_bytes().repeat(8)
}

fn long(_: u64) -> Vec<u8> {
    vec![0xff; 1 << 20]
}

/// Declares a sensor, and sends scans of 300,000 points for it in all sessions, as fast as it can.
async fn large_scans(endpoint: String, sessions: u64) {
    let declared = v1::Sensor { name: "large".into(), model: Some("hdl32e".into()), z_m: 1.9, ..Default::default() };
    let [x, y, z] = plain(300_000).map(|list| pack(&list));
    let send = async |client: u64| {
        let Some(session) = session(&endpoint).await else { return };
        for number in 1.. {
            let (key, body) = match number {
                1 => ("sensor", v1::observation::Body::Declaration(declared.clone())),
                _ => {
                    let [x, y, z] = [&x, &y, &z].map(Clone::clone);
                    (
                        "scan",
                        v1::observation::Body::Scan(v1::Scan { stamp_ns: now_ns(), x, y, z, ..Default::default() }),
                    )
                }
            };
            let observation = v1::Observation { client, number, body: Some(body), ..Default::default() };
            let put = session.put(format!("clearway/car/ingest/{key}/large"), observation.encode_to_vec());
            let source = SourceInfo::new(session.id(), number as u32);
            let _closed = put.congestion_control(CongestionControl::Block).source_info(source).await;
            tokio::task::yield_now().await;
        }
    };
    futures::future::join_all((1..=sessions).map(send)).await;
}

/// Answers every query for maps with junk, and states new last maps all the time.
async fn answer(endpoint: String) {
    let Some(session) = session(&endpoint).await else { return };
    let junk = |query: zenoh::query::Query| {
        tokio::spawn(async move {
            let key = query.key_expr().clone();
            let _closed = query.reply(key, "x").await;
        });
    };
    let queryable = session.declare_queryable(MAPS).complete(true).callback(junk).await;
    let heartbeat = format!("{MAPS}/@adv/pub/{}/1/_", session.zid());
    for number in 0_u32.. {
        let _dropped = session.put(&heartbeat, number.to_le_bytes().to_vec()).await;
        if u64::from(number) % BURST == 0 {
            tokio::time::sleep(PAUSE).await;
        }
    }
    drop(queryable);
}
