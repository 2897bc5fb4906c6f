//! What a reader over zenoh is told of an endpoint, a vehicle or a layer that is not there.

use clearway_client::{ClientError, ZenohClient};
use tokio::net::TcpListener;

use crate::zenoh::{publisher, server};

#[tokio::test(flavor = "multi_thread")]
async fn a_reader_that_waits_for_a_name_that_no_server_publishes_learns_which_are_published() {
    let (server, endpoint) = server().await;
    let _token = server.liveliness().declare_token("clearway/alpha").await.unwrap();
    let _publisher = publisher(&server).await;
    let client = ZenohClient::connect(&endpoint).await.unwrap();
    for (vehicle, layer, why) in [
        ("alpha", "fspace", "no server publishes the layer \"fspace\" of alpha now; published: drivability"),
        ("alfa", "drivability", "no server publishes the vehicle \"alfa\" now; published: alpha"),
    ] {
        let maps = client.subscribe(vehicle, layer).await.unwrap();
        let mut reasons = maps.reasons();
        while reasons.is_empty() {
            tokio::time::sleep(std::time::Duration::from_millis(2)).await;
            reasons = maps.reasons();
        }
        assert_eq!(reasons, [why]);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn an_endpoint_without_a_protocol_or_without_a_router_is_named_with_what_is_needed() {
    let error = ZenohClient::connect("localhost:7447").await.unwrap_err().to_string();
    assert!(error.ends_with("PROTOCOL/HOST:PORT is allowed, such as tcp/localhost:7447"), "{error}");
    let closed = TcpListener::bind("127.0.0.1:0").await.unwrap().local_addr().unwrap();
    let error = ZenohClient::connect(&format!("tcp/{closed}")).await.unwrap_err();
    assert!(matches!(&error, ClientError::Unreachable { .. }), "{error}");
    assert!(error.to_string().ends_with("no zenoh router or server accepts a connection within 5 s"), "{error}");
}
