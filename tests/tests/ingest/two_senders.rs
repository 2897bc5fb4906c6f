//! Two clients that send the scans of one sensor.

use clearway_client::observation::Observation;
use clearway_proto::packed::unpack;
use clearway_proto::v1;

use super::{ingester, plain, scanned_config, send_all, start};
use crate::fixture::within;

#[tokio::test(flavor = "multi_thread")]
async fn two_clients_of_one_sensor_are_named_in_the_status() {
    let folder = tempfile::tempdir().unwrap();
    let running = start(scanned_config(), &folder.path().join("two.mcap")).await;
    let (mut one, mut other) = (ingester(&running).await, ingester(&running).await);
    let reasons = || running.vehicles.0[0].status.assess().reasons;
    let of_senders = |reason: &String| reason.starts_with("several send the data of top");
    for turn in 0..4 {
        let ingester = if turn % 2 == 0 { &mut one } else { &mut other };
        let v1::Scan { stamp_ns, x, y, z, .. } = plain((turn + 1) * 100_000_000);
        let [x, y, z] = [x, y, z].map(|list| unpack::<f32>(&list).unwrap());
        let scan = Observation::scan("top", stamp_ns, &x, &y, &z).captured_at(stamp_ns);
        assert_eq!(send_all(ingester, vec![scan]).await, [], "each is accepted");
        // Until the first sends again, the other may have taken its place.
        assert_eq!(reasons().iter().any(of_senders), turn >= 2, "{turn}: {:?}", reasons());
    }
    let named = reasons().into_iter().find(of_senders).unwrap();
    assert!(named.contains("stream 1 of 127.0.0.1, stream 2 of 127.0.0.1"), "{named}");
    within("shutdown", running.shutdown()).await.unwrap();
}
