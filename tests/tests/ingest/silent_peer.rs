//! Observations over gRPC beside a peer that sends and takes no reports.

use clearway_client::observation::Observation;
use clearway_proto::packed::{pack, unpack};
use clearway_proto::v1;
use clearway_tests::attack::http2;
use tokio::io::AsyncWriteExt;
use tokio::net::TcpStream;

use super::{ingester, plain, scanned_config, send_all_from_a_task, start};
use crate::fixture::{until, within};

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_peer_without_a_window_for_reports_keeps_no_time_of_the_engine() {
    let folder = tempfile::tempdir().unwrap();
    let running = start(scanned_config(), &folder.path().join("silent.mcap")).await;
    let scans = (1..=200).map(|tenths: i64| {
        let v1::Scan { stamp_ns, x, y, z, .. } = plain(tenths * 100_000_000);
        let [x, y, z] = [x, y, z].map(|list| unpack::<f32>(&list).unwrap());
        Observation::scan("top", stamp_ns, &x, &y, &z).captured_at(stamp_ns)
    });
    let honest = tokio::spawn(send_all_from_a_task(ingester(&running).await, scans.collect()));
    until("the engine works", || running.vehicles.0[0].status.snapshot().maps > 3).await;

    // As many packets as an observation may have, while the engine has no time left for them.
    let packets = v1::Packets { lengths: pack(&[1_u16; 1024]), ..Default::default() };
    let body = Some(v1::observation::Body::Packets(packets));
    let observation =
        v1::Observation { number: 1, vehicle: "car".into(), sensor: "top".into(), body, ..Default::default() };
    let mut sent = http2::opening(0);
    for stream in [1, 3, 5] {
        sent.extend(http2::call(stream, "/clearway.v1.IngestService/Stream"));
        sent.extend(http2::message(stream, &observation));
    }
    let mut socket = TcpStream::connect(running.grpc.expect("gRPC is served")).await.unwrap();
    socket.write_all(&sent).await.unwrap();

    let (_, refusals) = within("the scans of the honest sender", honest).await.unwrap();
    assert_eq!(refusals, []);
    let refused = || running.vehicles.0[0].status.snapshot().ledger.refused.values().sum::<u64>();
    until("the packets are refused", || refused() == 3).await;
    drop(socket);
    within("shutdown", running.shutdown()).await.unwrap();
}
