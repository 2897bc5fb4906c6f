//! A client against a zenoh session in this process.

mod common;

use clearway_client::ZenohClient;
use common::{CAPTURE_END_NS, map};

#[tokio::test(flavor = "multi_thread")]
async fn a_stream_begins_with_the_newest_map_goes_on_and_outlives_its_client() {
    let mut config = zenoh::Config::default();
    config.insert_json5("listen/endpoints", "[\"tcp/127.0.0.1:0\"]").unwrap();
    config.insert_json5("scouting/multicast/enabled", "false").unwrap();
    config.insert_json5("scouting/gossip/enabled", "false").unwrap();
    let server = zenoh::open(config).await.unwrap();
    let endpoint = server.info().locators().await.first().unwrap().to_string();
    let key = "clearway/alpha/map/drivability";
    let _token = server.liveliness().declare_token("clearway/alpha").await.unwrap();
    let queries = server.declare_queryable(key).await.unwrap();
    tokio::spawn(async move {
        while let Ok(query) = queries.recv_async().await {
            query.reply(key, map(41, CAPTURE_END_NS)).await.unwrap();
        }
    });
    let publisher = server.declare_publisher(key).await.unwrap();

    let client = ZenohClient::connect(&endpoint).await.unwrap();
    assert_eq!(client.vehicles().await.unwrap(), ["alpha"]);
    assert_eq!(client.newest("alpha", "drivability").await.unwrap().unwrap().sequence(), 41);
    assert!(client.newest("alpha", "roughness").await.unwrap().is_none());
    let mut maps = client.subscribe("alpha", "drivability").await.unwrap();
    drop(client);
    let first = maps.next().await.unwrap();
    assert_eq!((first.map.sequence(), first.skipped), (41, 0));

    // The subscription may reach the publisher after the answer did.
    let matching = publisher.matching_listener().await.unwrap();
    while !publisher.matching_status().await.unwrap().matching() {
        matching.recv_async().await.unwrap();
    }
    publisher.put(map(40, CAPTURE_END_NS)).await.unwrap();
    publisher.put(map(44, CAPTURE_END_NS)).await.unwrap();
    let second = maps.next().await.unwrap();
    assert_eq!((second.map.sequence(), second.skipped), (44, 2), "an old map is passed over, holes are counted");
}
