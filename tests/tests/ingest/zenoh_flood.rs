//! Observations over zenoh beside another session that sends more than the server can decode.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use bytes::Bytes;
use clearway_client::{Observation, ZenohClient};
use clearway_proto::v1;
use prost::Message;
use zenoh::qos::CongestionControl;
use zenoh::sample::SourceInfo;

use super::{scan, scanned_config, send_all, start};
use crate::fixture::{until, within};

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_flood_of_large_scans_over_zenoh_costs_another_session_no_observation() {
    let folder = tempfile::tempdir().unwrap();
    let mut config = scanned_config();
    config.zenoh.enabled = true;
    // So that a scan of the longest message is little work also for a busy test machine.
    config.vehicles[0].ingest.points_max = 20_000;
    let running = start(config, &folder.path().join("flood.mcap")).await;
    let endpoint = running.zenoh.iter().find(|e| e.starts_with("tcp/127.0.0.1")).expect("zenoh listens").clone();

    // The stamp is older than any other, so that the engine refuses the scans and makes no map of them.
    let floats: Bytes = vec![0; 4 * 20_000].into();
    let scan = scan(1, v1::Scan { stamp_ns: 1, x: floats.clone(), y: floats.clone(), z: floats, ..Default::default() });
    let mut settings = zenoh::Config::default();
    settings.insert_json5("mode", "\"client\"").unwrap();
    settings.insert_json5("connect/endpoints", &format!("[\"{endpoint}\"]")).unwrap();
    let session = within("zenoh", async { zenoh::open(settings).await }).await.unwrap();
    let is_over = Arc::new(AtomicBool::new(false));
    let flood = tokio::spawn({
        let is_over = is_over.clone();
        async move {
            for number in 1.. {
                let scan = v1::Observation { client: 1, number, ..scan.clone() }.encode_to_vec();
                let put =
                    session.put("clearway/car/ingest/scan/top", scan).congestion_control(CongestionControl::Block);
                put.source_info(SourceInfo::new(session.id(), number as u32)).await.unwrap();
                if is_over.load(Ordering::Relaxed) {
                    return;
                }
                // A put does not wait while the session has no server, and a test that fails ends this task here.
                tokio::task::yield_now().await;
            }
        }
    });
    let lost = || running.vehicles.0[0].status.snapshot().ledger.lost;
    until("the flood's queue is full", || lost() > 0).await;

    let client = within("zenoh", ZenohClient::connect(&endpoint)).await.unwrap();
    let mut car = within("an ingester", client.ingest("car")).await.unwrap();
    let poses = (1..=500).map(|number: i64| {
        let stamp_ns = number * 10_000_000;
        Observation::pose(stamp_ns, [0.0; 3], [0.0, 0.0, 0.0, 1.0], 0.0).captured_at(stamp_ns)
    });
    assert_eq!(send_all(&mut car, poses.collect()).await, []);
    is_over.store(true, Ordering::Relaxed);
    within("the flood ends", flood).await.unwrap();
    within("shutdown", running.shutdown()).await.unwrap();
}
