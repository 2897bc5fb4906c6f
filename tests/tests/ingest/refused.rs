//! Refused observations: the sender receives a reason for each, and no other client is disturbed.

use std::path::Path;

use bytes::Bytes;
use clearway_client::observation::by_reason;
use clearway_client::{ClientError, Ingester, Observation};
use clearway_daemon::record::verify;
use clearway_journal::reader::{RecordedMessage, RecordingReader};
use clearway_mapping::event::{Body, Cause, Event};
use clearway_proto::packed::pack;
use clearway_proto::v1;
use prost::Message;
use tonic::Code;

use super::{client, ingester, plain, reports, scan, scanned_config, start};
use crate::fixture::{before_another_look, recorded, within};

/// `scan` with the x of its last point replaced.
fn with_last_x(scan: v1::Scan, last: f32) -> v1::Scan {
    let mut x = scan.x.to_vec();
    let end = x.len() - 4;
    x[end..].copy_from_slice(&last.to_le_bytes());
    v1::Scan { x: x.into(), ..scan }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn invalid_observations_are_refused_by_name_and_do_not_change_maps() {
    let folder = tempfile::tempdir().unwrap();
    let (clean, hostile) = (folder.path().join("clean.mcap"), folder.path().join("hostile.mcap"));
    let good = [1_000_000_000, 1_100_000_000].map(plain);
    let mut config = scanned_config();
    config.vehicles[0].ingest.points_max = 10_000;

    let running = start(config.clone(), &clean).await;
    let sent = good.iter().cloned().zip(1..).map(|(plain, number)| scan(number, plain)).collect();
    assert!(reports(&running, sent).await.1.is_none());
    within("shutdown", running.shutdown()).await.unwrap();

    let base = plain(1_050_000_000);
    let short = |bytes: &Bytes| bytes.slice(..bytes.len() - 4);
    let cut = |bytes: &Bytes| bytes.slice(..bytes.len() - 1);
    let of = |body| v1::Observation { body: Some(body), ..Default::default() };
    let columns = |offset_ns: &[i32], points: &[u16]| v1::Observation {
        columns: Some(v1::Columns { offset_ns: pack(offset_ns), points: pack(points) }),
        ..scan(0, base.clone())
    };
    let packets = |lengths: &[u16], payloads: &'static [u8]| {
        let captured_ns = pack(&vec![5_i64; lengths.len()]);
        let packets = v1::Packets { captured_ns, lengths: pack(lengths), payloads: Bytes::from_static(payloads) };
        of(v1::observation::Body::Packets(packets))
    };
    let pose = |pose: Option<v1::Pose>, speed_mps| {
        of(v1::observation::Body::EgoPose(v1::EgoPose { stamp_ns: 5, map_from_ego: pose, speed_mps }))
    };
    let level = v1::Pose { qw: 1.0, ..Default::default() };
    let road = |x: &[f64], y: &[f64], width: &[f64], kinds: (i32, i32)| {
        let (x, y, width) = (x.to_vec(), y.to_vec(), width.to_vec());
        let road = v1::Road { x, y, width, purpose: kinds.0, frame: kinds.1, ..Default::default() };
        of(v1::observation::Body::Road(road))
    };
    let bad: Vec<(&str, v1::Observation)> = vec![
        ("body", v1::Observation::default()),
        ("packed", scan(0, v1::Scan { x: cut(&base.x), ..base.clone() })),
        ("packed", scan(0, v1::Scan { intensity: Bytes::from_static(&[1, 2, 3]), ..base.clone() })),
        ("packed", scan(0, v1::Scan { ring: Bytes::from_static(&[1]), ..base.clone() })),
        ("packed", scan(0, v1::Scan { offset_ns: Bytes::from_static(&[1; 6]), ..base.clone() })),
        ("packed", scan(0, v1::Scan { no_returns: Bytes::from_static(&[1; 16]), ..base.clone() })),
        ("points", scan(0, v1::Scan { x: vec![0; 40_004].into(), ..base.clone() })),
        ("points", scan(0, v1::Scan { no_returns: vec![0; 120_012].into(), ..base.clone() })),
        ("scan_lengths", scan(0, v1::Scan { y: short(&base.y), ..base.clone() })),
        ("scan_lengths", scan(0, v1::Scan { z: Bytes::new(), ..base.clone() })),
        ("scan_lengths", scan(0, v1::Scan { intensity: pack(&[0.5_f32]), ..base.clone() })),
        ("stamp", scan(0, plain(1_000_000_000))),
        ("stamp_range", scan(0, plain(i64::MIN))),
        ("stamp_ahead", scan(0, plain((1 << 62) + 1))),
        ("columns", columns(&[0], &[7199])),
        ("columns", columns(&[0, 0], &[7200])),
        ("columns", columns(&[0; 20_000], &[65_535; 20_000])),
        ("packets", packets(&[], b"")),
        ("packets", packets(&[65_535], b"abc")),
        ("packets", packets(&[1], b"abc")),
        ("packets", packets(&[0; 1025], b"")),
        ("length", packets(&[3], b"abc")),
        ("missing", pose(None, 0.0)),
        ("pose", pose(Some(v1::Pose::default()), 0.0)),
        ("pose", pose(Some(v1::Pose { x: f64::NAN, ..level }), 0.0)),
        ("pose", pose(Some(v1::Pose { y: 1e10, ..level }), 0.0)),
        ("pose", pose(Some(level), f64::INFINITY)),
        ("missing", road(&[0.0, 1.0], &[0.0], &[3.0, 3.0], (1, 1))),
        ("missing", road(&[0.0, 1.0], &[0.0, 0.0], &[3.0, 3.0], (0, 1))),
        ("missing", road(&[0.0, 1.0], &[0.0, 0.0], &[3.0, 3.0], (1, 9))),
        ("road_points", road(&[0.0], &[0.0], &[3.0], (1, 1))),
        ("road_widths", road(&[0.0, 1.0], &[0.0, 0.0], &[3.0], (1, 1))),
        ("road_width", road(&[0.0, 1.0], &[0.0, 0.0], &[3.0, -1.0], (1, 1))),
        ("road_point", road(&[0.0, f64::NAN], &[0.0, 0.0], &[3.0, 3.0], (1, 1))),
        ("road_coinciding", road(&[0.0, 0.0], &[0.0, 0.0], &[3.0, 3.0], (1, 1))),
    ];
    let mut sent = vec![scan(1, good[0].clone())];
    let numbered =
        |(number, (_, observation)): (u64, &(&str, v1::Observation))| v1::Observation { number, ..observation.clone() };
    sent.extend((2..).zip(&bad).map(numbered));
    let last = sent.len() as u64 + 1;
    // A number that is sent twice is not counted as another observation.
    sent.push(v1::Observation { number: 2, ..scan(0, base.clone()) });
    sent.push(scan(last, good[1].clone()));

    let running = start(config, &hostile).await;
    let (reports, end) = reports(&running, sent).await;
    assert!(end.is_none(), "{end:?}");
    assert_eq!(reports.last().unwrap().acknowledged, last, "{reports:?}");
    let mut refused: Vec<_> = reports.iter().flat_map(|report| &report.refused).collect();
    let twice = refused.iter().position(|refused| refused.reason == "number").expect("a number came twice");
    assert!(refused.remove(twice).message.contains("more than"));
    refused.sort_by_key(|refused| refused.number);
    let reasons: Vec<_> = refused.iter().map(|refused| (refused.number, refused.reason.as_str())).collect();
    let expected: Vec<_> = (2..).zip(&bad).map(|(number, (reason, _))| (number, *reason)).collect();
    assert_eq!(reasons, expected);

    let ledger = running.vehicles.0[0].status.snapshot().ledger;
    assert_eq!(ledger.received, ledger.decoded + ledger.telemetry + ledger.refused.values().sum::<u64>());
    let (poses, roads) = (ledger.poses_refused, ledger.roads_refused.values().sum::<u64>());
    let counted = ledger.refused.values().sum::<u64>() + poses + roads;
    assert_eq!((ledger.decoded, poses, roads, counted), (2, 4, 5, bad.len() as u64 + 1), "each once: {ledger:?}");
    within("shutdown", running.shutdown()).await.unwrap();
    assert!(verify(&hostile).unwrap().is_good());
    let cells = |file: &Path| -> Vec<_> {
        let maps = recorded(file).into_values().map(|bytes| v1::Map::decode(bytes).unwrap());
        maps.map(|map| map.layers).collect()
    };
    assert!(cells(&hostile) == cells(&clean), "no cell comes from a refused observation");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn points_at_impossible_positions_are_counted_and_dropped() {
    let folder = tempfile::tempdir().unwrap();
    let running = start(scanned_config(), &folder.path().join("r.mcap")).await;
    let wild = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e9];
    let stamps = (1_i64..).map(|n| n * 100_000_000);
    let sent = wild.iter().zip(stamps).zip(1..).map(|((&x, stamp), number)| scan(number, with_last_x(plain(stamp), x)));
    let (reports, _) = reports(&running, sent.collect()).await;
    assert!(reports.iter().all(|report| report.refused.is_empty()));
    let ledger = running.vehicles.0[0].status.snapshot().ledger;
    assert_eq!((ledger.decoded, ledger.points_dropped), (4, 4));
    within("shutdown", running.shutdown()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_scan_that_is_too_large_is_refused_and_one_sender_never_has_all_streams() {
    let folder = tempfile::tempdir().unwrap();
    let mut config = scanned_config();
    config.vehicles[0].ingest.streams_max = 3;
    config.vehicles[0].ingest.points_max = 300_000;
    let running = start(config, &folder.path().join("r.mcap")).await;
    let floats: Bytes = vec![0; 4 * 400_000].into();
    let large = v1::Scan { stamp_ns: 1, x: floats.clone(), y: floats.clone(), z: floats, ..Default::default() };
    let (reports, end) = reports(&running, vec![scan(1, large), scan(2, plain(100_000_000))]).await;
    let refusals: Vec<_> = reports.iter().flat_map(|report| &report.refused).collect();
    assert!(end.is_none() && refusals.len() == 1 && refusals[0].reason == "points", "{refusals:?} {end:?}");
    assert!(refusals[0].message.contains("400000 points") && refusals[0].message.contains("up to 300000"));
    let status = running.vehicles.0[0].status.snapshot();
    assert_eq!((status.ledger.refused.get("observation"), status.ledger.decoded), (Some(&1), 1));

    let client = client(&running).await;
    let refused = within("two streams", async {
        let mut held = Vec::new();
        loop {
            match client.ingest("car").await {
                Ok(stream) => held.push(stream),
                // The stream before may not have ended yet.
                Err(_) if held.len() < 2 => before_another_look().await,
                Err(error) => return (held, error.to_string()),
            }
        }
    });
    let (held, error) = refused.await;
    assert!(held.len() == 2 && error.contains("vehicle car: 127.0.0.1 has 2 of 3 streams"), "{} {error}", held.len());
    drop(held);
    within("shutdown", running.shutdown()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn unknown_vehicles_surplus_streams_and_large_scans_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let mut config = scanned_config();
    (config.vehicles[0].ingest.points_max, config.vehicles[0].ingest.streams_max) = (1000, 1);
    let file = folder.path().join("r.mcap");
    let running = start(config, &file).await;
    let client = client(&running).await;
    let refused = |outcome: Result<Ingester, ClientError>| match outcome {
        Err(ClientError::Refused { reason, code, .. }) => (code, reason),
        other => panic!("{:?}", other.map(drop)),
    };
    let (code, reason) = refused(client.ingest("truck").await);
    assert!(code == "NotFound" && reason.contains("truck") && reason.contains("car"), "{reason}");

    let mut first = ingester(&running).await;
    let (code, reason) = refused(client.ingest("car").await);
    assert!(code == "ResourceExhausted" && reason.contains("all 1 streams"), "{reason}");

    first.send(Observation::end("bottom")).await.unwrap();
    let refusals = within("a refusal", first.settled()).await.unwrap();
    assert_eq!(by_reason(&refusals), [("source", 1)].into());
    assert!(refusals[0].message.contains("bottom") && refusals[0].message.contains("top"));
    let ended = within("the end", async {
        loop {
            if let Err(error) = first.send(Observation::end("")).await {
                return error;
            }
        }
    });
    let ended = ended.await.to_string();
    assert!(ended.contains("bottom") && ended.contains("top"), "{ended}");
    drop(first);

    let place = || async {
        loop {
            match client.ingest("car").await {
                Ok(ingester) => return ingester,
                // The stream before may not have ended yet.
                Err(ClientError::Refused { .. }) => before_another_look().await,
                Err(other) => panic!("{other}"),
            }
        }
    };
    drop(within("a place", place()).await);
    let giant = v1::Scan { x: vec![0; 200_000].into(), ..Default::default() };
    let giant = || async {
        loop {
            let hello = v1::Observation::default();
            let (reports, end) = reports(&running, vec![hello, scan(1, giant.clone())]).await;
            match end {
                Some(status) if status.code() == Code::ResourceExhausted => before_another_look().await,
                end => return (reports, end),
            }
        }
    };
    let (_, end) = within("a place", giant()).await;
    let status = end.expect("a message of 200 kB ends the stream");
    assert!(status.code() == Code::OutOfRange && status.message().contains("97536"), "{status:?}");
    assert_eq!(running.vehicles.0[0].status.snapshot().ledger.refused.get("observation"), Some(&1));
    within("shutdown", running.shutdown()).await.unwrap();
    let counts = RecordingReader::open(&file).unwrap().map(|entry| match entry.unwrap() {
        RecordedMessage::Event {
            event: Event { body: Body::Lost { cause: Cause::Observation, count }, .. }, ..
        } => count,
        _ => 0,
    });
    assert_eq!(counts.sum::<u64>(), 1, "the journal has the loss, although no event followed it");
}
