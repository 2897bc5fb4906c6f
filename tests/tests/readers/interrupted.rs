//! Streams in which no map comes: because the vehicle is silent, because its server is away, or because the client's
//! certificate has ended.

use clearway_client::{Client, ClientError, MapStream, Subscription, v1};

use super::Reader;
use crate::fixture::certificates::{self, ending, secured};
use crate::fixture::{config, feed, grpc, readings, start, until, within};

/// Waits until a stream says this among why no map comes.
async fn says(maps: &MapStream, part: &str) {
    until(&format!("a reason with {part:?}"), || maps.reasons().iter().any(|reason| reason.contains(part))).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_reader_of_a_silent_vehicle_is_told_its_state_once_a_second_and_one_that_does_not_ask_is_not() {
    let running = start(config()).await;
    let states = v1::Selection { max_in_flight: 1, states: true, ..Default::default() };
    let without = v1::Selection { states: false, ..states.clone() };
    let mut silent = Reader::open(&mut grpc(&running).await, without).await.unwrap();
    let mut told = Reader::open(&mut grpc(&running).await, states).await.unwrap();
    let client = Client::connect(&running.grpc.unwrap().to_string()).await.unwrap();
    let mut maps = client.subscribe(Subscription::default()).await.unwrap();
    let mut sent_ns = 0;
    for _ in 0..2 {
        let update = told.next().await.unwrap();
        let vehicle = update.vehicle.expect("a state");
        assert!(update.map.is_empty() && vehicle.name == "car" && vehicle.state == "error", "{vehicle:?}");
        assert!(
            vehicle.reasons[0].starts_with("no packets from top since the server started"),
            "{:?}",
            vehicle.reasons
        );
        assert!(update.sent_ns - sent_ns >= 900_000_000, "once a second");
        sent_ns = update.sent_ns;
    }
    says(&maps, "no packets from top since the server started").await;
    feed(&running, readings(3)).await;
    within("a map", maps.next()).await.unwrap();
    assert!(maps.reasons().is_empty(), "{:?}", maps.reasons());
    assert!(silent.next().await.unwrap().vehicle.is_none(), "the first update of a reader that does not ask is a map");
    within("shutdown", running.shutdown()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_stream_that_reconnects_outlives_its_server_and_says_that_it_is_away() {
    let first = start(config()).await;
    let at = first.grpc.unwrap();
    let client = Client::connect(&at.to_string()).await.unwrap();
    let subscribe =
        async |reconnects| client.subscribe(Subscription { reconnects, ..Default::default() }).await.unwrap();
    let (mut lasting, mut passing) = (subscribe(true).await, subscribe(false).await);
    feed(&first, readings(3)).await;
    let before = within("a map", lasting.next()).await.unwrap().map.header().boot_id;
    within("shutdown", first.shutdown()).await.unwrap();
    let ended = async { while passing.next().await.is_ok() {} };
    within("the end of a stream that does not reconnect", ended).await;
    says(&lasting, &at.to_string()).await;

    let mut config = config();
    config.grpc.listen = at;
    let second = start(config).await;
    feed(&second, readings(3)).await;
    let next = async {
        loop {
            let map = lasting.next().await.expect("it does not end").map;
            if map.header().boot_id != before {
                break map;
            }
        }
    };
    within("a map of the second server", next).await;
    assert!(lasting.reasons().is_empty() && lasting.ended().is_none());
    within("shutdown", second.shutdown()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
#[cfg_attr(not(clearway_openssl), ignore = "needs openssl: apt-get install openssl")]
async fn a_stream_ends_with_the_certificate_of_its_reader() {
    let running = certificates::start(secured(true)).await;
    let address = running.grpc.unwrap().to_string();
    let client = Client::connect_tls(&address, &ending("reader", 5)).await.expect("it is valid for 5 s");
    let mut maps = client.subscribe(Subscription::default()).await.unwrap();
    feed(&running, readings(2)).await;
    within("a map", maps.next()).await.unwrap();
    let ended = within("the end", async {
        loop {
            if let Err(ended) = maps.next().await {
                break ended;
            }
        }
    });
    assert!(matches!(ended.await, ClientError::Unreachable { .. } | ClientError::Ended { .. }));
    within("shutdown", running.shutdown()).await.unwrap();
}
