//! Observations over gRPC beside a peer that sends and takes no reports.

use clearway_client::observation::Observation;
use clearway_proto::packed::pack;
use clearway_proto::v1;
use clearway_tests::attack::http2;
use tokio::io::AsyncWriteExt;
use tokio::net::TcpStream;

use super::fixture::{until, within};
use super::{ingester, plain, scanned_config, send_all, start};

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_peer_without_a_window_for_reports_keeps_no_time_of_the_engine() {
    let folder = tempfile::tempdir().unwrap();
    let running = start(scanned_config(), &folder.path().join("silent.mcap")).await;
    let mut socket = TcpStream::connect(running.grpc.expect("gRPC is served")).await.unwrap();
    // As many packets as an observation may have: they take all the time of the engine that waiting points may take.
    let packets = |number| {
        let packets = v1::Packets { lengths: pack(&[1_u16; 1024]), ..Default::default() };
        let body = Some(v1::observation::Body::Packets(packets));
        v1::Observation { number, vehicle: "car".into(), sensor: "top".into(), body, ..Default::default() }
    };
    let call = http2::call(1, "/clearway.v1.IngestService/Stream");
    let sent = [http2::opening(0), call, http2::message(1, &packets(1)), http2::message(1, &packets(2))];
    socket.write_all(&sent.concat()).await.unwrap();
    let refused = || running.vehicles.0[0].status.snapshot().ledger.refused.values().sum::<u64>();
    until("the packets are refused", || refused() > 0).await;

    let mut honest = ingester(&running).await;
    let scans = (1..=20).map(|tenths: i64| {
        let v1::Scan { stamp_ns, x, y, z, .. } = plain(tenths * 100_000_000);
        let [x, y, z] = [x, y, z].map(|list| clearway_proto::packed::unpack::<f32>(&list).unwrap());
        Observation::scan("top", stamp_ns, &x, &y, &z).captured_at(stamp_ns)
    });
    assert_eq!(send_all(&mut honest, scans.collect()).await, []);
    drop(socket);
    within("shutdown", running.shutdown()).await.unwrap();
}
