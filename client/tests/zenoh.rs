//! The zenoh client with a zenoh session in this process.

use std::sync::Arc;

use bytes::Bytes;
use clearway_client::signature::{PublicKey, SigningKey};
use clearway_client::{MapStream, PassedOver, StreamEvent, Update, ZenohClient, now_ns, v1};
use prost::Message;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{RwLock, watch};
use zenoh::Session;
use zenoh::sample::SourceInfo;
use zenoh_ext::{AdvancedPublisher, AdvancedPublisherBuilderExt, CacheConfig, MissDetectionConfig, z_serialize};

use crate::common::{CAPTURE_END_NS, map};

const KEY: &str = "clearway/alpha/map/drivability";

pub async fn server() -> (Session, String) {
    let mut config = zenoh::Config::default();
    config.insert_json5("listen/endpoints", "[\"tcp/127.0.0.1:0\"]").unwrap();
    config.insert_json5("scouting/multicast/enabled", "false").unwrap();
    config.insert_json5("scouting/gossip/enabled", "false").unwrap();
    config.insert_json5("transport/link/tx/lease", "2000").unwrap();
    let server = zenoh::open(config).await.unwrap();
    let endpoint = server.info().locators().await.first().unwrap().to_string();
    (server, endpoint)
}

/// Declares a publisher as the server does.
pub async fn publisher(server: &Session) -> AdvancedPublisher<'static> {
    let publisher = server.declare_publisher(KEY).cache(CacheConfig::default().max_samples(1));
    let misses = publisher.sample_miss_detection(MissDetectionConfig::default());
    misses.publisher_detection().await.unwrap()
}

/// Waits until there is a subscriber.
async fn matched(publisher: &zenoh::pubsub::Publisher<'_>) {
    let matching = publisher.matching_listener().await.unwrap();
    while !publisher.matching_status().await.unwrap().matching() {
        matching.recv_async().await.unwrap();
    }
}

async fn next(maps: &mut MapStream) -> (u64, u64, u64) {
    let Update { map, skipped, lost, .. } = maps.next().await.unwrap();
    (map.sequence(), skipped, lost)
}

#[tokio::test(flavor = "multi_thread")]
async fn a_stream_starts_with_the_newest_map_and_survives_its_client() {
    let (server, endpoint) = server().await;
    let _token = server.liveliness().declare_token("clearway/alpha").await.unwrap();
    let queries = server.declare_queryable(KEY).await.unwrap();
    tokio::spawn(async move {
        while let Ok(query) = queries.recv_async().await {
            query.reply(KEY, map(41, CAPTURE_END_NS)).await.unwrap();
        }
    });
    let publisher = publisher(&server).await;
    publisher.put(map(41, CAPTURE_END_NS)).await.unwrap();

    let client = ZenohClient::connect(&endpoint).await.unwrap();
    assert_eq!(client.vehicles().await.unwrap(), ["alpha"]);
    assert_eq!(client.newest("alpha", "drivability").await.unwrap().unwrap().sequence(), 41);
    assert!(client.newest("alpha", "roughness").await.unwrap().is_none());
    let mut maps = client.subscribe("alpha", "drivability").await.unwrap();
    drop(client);
    assert_eq!(next(&mut maps).await, (41, 0, 0));

    // The subscription may reach the publisher later than the query.
    let matching = publisher.matching_listener().await.unwrap();
    while !publisher.matching_status().await.unwrap().matching() {
        matching.recv_async().await.unwrap();
    }
    publisher.put(map(40, CAPTURE_END_NS)).await.unwrap();
    publisher.put(map(44, CAPTURE_END_NS)).await.unwrap();
    assert_eq!(next(&mut maps).await, (44, 2, 0), "an old map is ignored and gaps are counted");
}

#[tokio::test(flavor = "multi_thread")]
async fn lost_maps_are_counted_and_a_lost_last_map_is_queried() {
    let (server, endpoint) = server().await;
    let queries = server.declare_queryable(KEY).await.unwrap();
    let maps = server.declare_publisher(KEY).await.unwrap();
    let heartbeat = format!("{KEY}/@adv/pub/{}/{}/_", maps.id().zid(), maps.id().eid());
    let heartbeats = server.declare_publisher(heartbeat).await.unwrap();
    let client = ZenohClient::connect(&endpoint).await.unwrap();
    let mut stream = client.subscribe("alpha", "drivability").await.unwrap();
    matched(&maps).await;
    matched(&heartbeats).await;

    // Publishes a sample with a number; missing numbers are lost samples.
    let put = async |number: u32, sequence: u64| {
        let put = maps.put(map(sequence, CAPTURE_END_NS)).source_info(SourceInfo::new(maps.id(), number));
        put.await.unwrap();
    };
    put(0, 41).await;
    assert_eq!(next(&mut stream).await, (41, 0, 0));
    put(2, 43).await;
    assert_eq!(next(&mut stream).await, (43, 1, 1), "the lost map is one of the skipped ones");
    put(3, 46).await;
    assert_eq!(next(&mut stream).await, (46, 2, 0), "two maps were never published");

    heartbeats.put(z_serialize(&3_u32)).await.unwrap();
    heartbeats.put(z_serialize(&4_u32)).await.unwrap();
    let query = queries.recv_async().await.unwrap();
    query.reply(KEY, map(47, CAPTURE_END_NS)).await.unwrap();
    drop(query);
    assert_eq!(next(&mut stream).await, (47, 0, 0), "the last map arrived late and is not lost");
    put(5, 48).await;
    assert_eq!(next(&mut stream).await, (48, 0, 0));
    assert!(matches!(queries.try_recv(), Ok(None)), "there is no query without a reason");
}

/// A connection between client and server that the test cuts, and restores to another server.
struct Link {
    endpoint: String,
    /// Address of the server; `None` while the link is cut: then no data pass and neither side is notified.
    to: watch::Sender<Option<String>>,
    /// Held as a reader while data may pass.
    passing: Arc<RwLock<()>>,
}

impl Link {
    async fn open(to: &str) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let endpoint = format!("tcp/{}", listener.local_addr().unwrap());
        let (to, target) = watch::channel(Some(to.replace("tcp/", "")));
        let passing = Arc::new(RwLock::new(()));
        tokio::spawn({
            let passing = passing.clone();
            async move {
                while let Ok((near, _)) = listener.accept().await {
                    tokio::spawn(forward(near, target.clone(), passing.clone()));
                }
            }
        });
        Self { endpoint, to, passing }
    }

    async fn cut(&self) {
        self.to.send_replace(None);
        let _nothing_passes = self.passing.write().await;
    }

    fn restore_to(&self, to: &str) {
        self.to.send_replace(Some(to.replace("tcp/", "")));
    }
}

/// Forwards one connection until the link is cut.
async fn forward(mut near: TcpStream, mut target: watch::Receiver<Option<String>>, passing: Arc<RwLock<()>>) {
    let to = target.borrow_and_update().clone();
    if let Some(to) = to {
        let _passing = passing.read().await;
        let Ok(mut far) = TcpStream::connect(to).await else { return };
        tokio::select! {
            _ = tokio::io::copy_bidirectional(&mut near, &mut far) => return,
            _ = target.changed() => {}
        }
    }
    // The link is cut: the connection stays open without data until the test ends.
    while target.changed().await.is_ok() {}
}

/// Waits until the stream reports that this map is stale; it must not end or return another map.
async fn wait_stale(maps: &mut MapStream, sequence: u64) {
    loop {
        match maps.next_or_stale().await.expect("a stream does not end with its server") {
            StreamEvent::Fresh(update) => assert_eq!(update.map.sequence(), sequence),
            StreamEvent::Stale(update) => {
                assert_eq!(update.map.sequence(), sequence);
                assert!(update.map.is_stale(now_ns()));
                return;
            }
        }
    }
}

/// A map captured now that is fresh for a minute, so that a slow machine does not matter.
fn lasting(sequence: u64) -> Bytes {
    let mut map = v1::Map::decode(map(sequence, now_ns())).unwrap();
    map.header.as_mut().unwrap().valid_until_ns += 60_000_000_000;
    map.encode_to_vec().into()
}

async fn next_fresh(maps: &mut MapStream) -> (u64, u64, u64) {
    match maps.next_or_stale().await.expect("a stream does not end with its server") {
        StreamEvent::Fresh(Update { map, skipped, lost, .. }) => (map.sequence(), skipped, lost),
        StreamEvent::Stale(update) => panic!("map {} is stale", update.map.sequence()),
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_stream_continues_after_a_cut_link_and_a_stopped_server() {
    let (first, endpoint) = server().await;
    let published = publisher(&first).await;
    let link = Link::open(&endpoint).await;
    let client = ZenohClient::connect(&link.endpoint).await.unwrap();
    let mut maps = client.subscribe("alpha", "drivability").await.unwrap();
    published.put(map(0, now_ns())).await.unwrap();
    wait_stale(&mut maps, 0).await;

    link.cut().await;
    for sequence in 1..5 {
        published.put(lasting(sequence)).await.unwrap();
    }
    link.restore_to(&endpoint);
    assert_eq!(next_fresh(&mut maps).await, (4, 3, 3), "the newest map, and the number of lost ones");

    published.put(map(5, now_ns())).await.unwrap();
    wait_stale(&mut maps, 5).await;
    link.cut().await;
    first.close().await.unwrap();
    let (second, endpoint) = server().await;
    let published = publisher(&second).await;
    published.put(lasting(9)).await.unwrap();
    link.restore_to(&endpoint);
    assert_eq!(next_fresh(&mut maps).await, (9, 3, 0), "another publisher starts at 0");
    published.put(lasting(10)).await.unwrap();
    assert_eq!(next_fresh(&mut maps).await, (10, 0, 0));
}

/// A map captured `late_ns` ago that is fresh for a minute, with these ids.
fn forged(boot_id: u64, sequence: u64, late_ns: i64) -> v1::Map {
    let mut map = v1::Map::decode(map(sequence, now_ns() - late_ns)).unwrap();
    let header = map.header.as_mut().unwrap();
    (header.boot_id, header.valid_until_ns) = (boot_id, header.valid_until_ns + 60_000_000_000);
    map
}

/// A server that has published map 1 of run 7, a stream that has received it, and a peer that may put anything.
async fn attacked() -> (AdvancedPublisher<'static>, Session, MapStream, Session) {
    let (server, endpoint) = server().await;
    let published = publisher(&server).await;
    published.put(lasting(1)).await.unwrap();
    let mut maps = ZenohClient::connect(&endpoint).await.unwrap().subscribe("alpha", "drivability").await.unwrap();
    // The subscription may reach the publisher later than the query for its cache.
    let matching = published.matching_listener().await.unwrap();
    while !published.matching_status().await.unwrap().matching() {
        matching.recv_async().await.unwrap();
    }
    assert_eq!(next_fresh(&mut maps).await, (1, 0, 0));
    let mut config = zenoh::Config::default();
    config.insert_json5("mode", "\"client\"").unwrap();
    config.insert_json5("connect/endpoints", &format!("[\"{endpoint}\"]")).unwrap();
    config.insert_json5("scouting/multicast/enabled", "false").unwrap();
    (published, zenoh::open(config).await.unwrap(), maps, server)
}

/// Waits until the stream has counted this many messages.
async fn passed_over(maps: &MapStream, count: impl Fn(PassedOver) -> u64, expected: u64) {
    let counted = async {
        while count(maps.passed_over()) < expected {
            tokio::time::sleep(std::time::Duration::from_millis(2)).await;
        }
    };
    let waited = tokio::time::timeout(std::time::Duration::from_secs(60), counted).await;
    assert!(waited.is_ok() && count(maps.passed_over()) == expected, "{:?}", maps.passed_over());
}

#[tokio::test(flavor = "multi_thread")]
async fn what_is_no_map_of_the_key_is_counted_and_passed_over() {
    let (published, peer, mut maps, _server) = attacked().await;
    peer.put(KEY, "x").await.unwrap();
    passed_over(&maps, |passed| passed.undecodable, 1).await;
    let mut other = forged(7, 2, 0);
    other.header.as_mut().unwrap().vehicle = "beta".into();
    peer.put(KEY, other.encode_to_vec()).await.unwrap();
    other = forged(7, 2, 0);
    other.layers[0].name = "terrain".into();
    peer.put(KEY, other.encode_to_vec()).await.unwrap();
    peer.put("clearway/**", forged(7, 2, 0).encode_to_vec()).await.unwrap();
    passed_over(&maps, |passed| passed.misplaced, 3).await;
    published.put(lasting(2)).await.unwrap();
    assert_eq!(next_fresh(&mut maps).await, (2, 0, 0), "the next true map");
    assert_eq!(maps.passed_over().hostile(), 4);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_forged_sequence_holds_no_true_map_back() {
    for ahead_ns in [0, 3_600_000_000_000] {
        let (published, peer, mut maps, _server) = attacked().await;
        peer.put(KEY, forged(7, 1 << 63, -ahead_ns).encode_to_vec()).await.unwrap();
        // It is shown, as fresh or as stale; without a signature it cannot be told from a true one.
        let (StreamEvent::Fresh(shown) | StreamEvent::Stale(shown)) = maps.next_or_stale().await.unwrap();
        assert_eq!(shown.map.sequence(), 1 << 63);
        published.put(lasting(2)).await.unwrap();
        assert_eq!(next_fresh(&mut maps).await, (2, 0, 0), "stamped {ahead_ns} ns ahead");
        published.put(lasting(4)).await.unwrap();
        assert_eq!(next_fresh(&mut maps).await, (4, 1, 0), "gaps are counted again");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_forged_run_is_not_shown_beside_the_true_one() {
    let (published, peer, mut maps, _server) = attacked().await;
    for sequence in 2..30 {
        published.put(lasting(sequence)).await.unwrap();
        assert_eq!(next_fresh(&mut maps).await, (sequence, 0, 0));
        peer.put(KEY, forged(666, sequence + 1, 0).encode_to_vec()).await.unwrap();
        passed_over(&maps, |passed| passed.other_run, sequence - 1).await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn no_map_is_fresh_for_good_whatever_it_states() {
    let (_published, peer, mut maps, _server) = attacked().await;
    let mut eternal = forged(7, 2, 0);
    eternal.header.as_mut().unwrap().valid_until_ns = i64::MAX;
    peer.put(KEY, eternal.encode_to_vec()).await.unwrap();
    let map = maps.next().await.unwrap().map;
    assert!(!map.is_stale(now_ns()) && map.is_stale(now_ns() + 60_000_000_000));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_false_answer_to_a_query_hides_no_true_one() {
    let (_published, peer, _maps, server) = attacked().await;
    let endpoint = server.info().locators().await.first().unwrap().to_string();
    let client = ZenohClient::connect(&endpoint).await.unwrap();
    for (session, answer) in [(&peer, Bytes::from("x")), (&server, lasting(5))] {
        let queries = session.declare_queryable(KEY).complete(true).await.unwrap();
        tokio::spawn(async move {
            while let Ok(query) = queries.recv_async().await {
                query.reply(KEY, answer.clone()).await.unwrap();
            }
        });
    }
    assert_eq!(client.newest("alpha", "drivability").await.unwrap().unwrap().sequence(), 5);
}

/// The keys of RFC 8032, section 7.1, tests 1 and 2.
const SERVER: [&str; 2] = [
    "MC4CAQAwBQYDK2VwBCIEIJ1hsZ3v/VpguoRK9JLsLMREScVpezJpGXA7rAMcrn9g",
    "MCowBQYDK2VwAyEA11qYAYKxCrfVS/7TyWQHOg7hcvPapiMlrwIaaPcHURo=",
];
const PEER: &str = "MC4CAQAwBQYDK2VwBCIEIEzNCJso/5banbbDRuwRTg9bijGfNaumJNqM9u1PuKb7";

#[tokio::test(flavor = "multi_thread")]
async fn with_a_public_key_only_maps_signed_with_its_private_key_are_believed() {
    let pem = |kind: &str, key: &str| format!("-----BEGIN {kind} KEY-----\n{key}\n-----END {kind} KEY-----\n");
    let key = |key: &str| SigningKey::from_pem(&pem("PRIVATE", key)).unwrap();
    let (server_key, peer_key) = (key(SERVER[0]), key(PEER));
    let (published, peer, _, server) = attacked().await;
    let endpoint = server.info().locators().await.first().unwrap().to_string();
    let client = ZenohClient::connect(&endpoint).await.unwrap();
    let client = client.signed_by(PublicKey::from_pem(&pem("PUBLIC", SERVER[1])).unwrap());
    let mut maps = client.subscribe("alpha", "drivability").await.unwrap();
    passed_over(&maps, |passed| passed.unsigned, 1).await;

    let next = lasting(2);
    published.put(next.clone()).attachment(server_key.sign(KEY, &next)).await.unwrap();
    assert_eq!(next_fresh(&mut maps).await, (2, 0, 0), "the true map");
    let next = lasting(3);
    peer.put(KEY, next.clone()).await.unwrap();
    peer.put(KEY, next.clone()).attachment(peer_key.sign(KEY, &next)).await.unwrap();
    peer.put(KEY, next.clone()).attachment(server_key.sign("clearway/alpha/map/terrain", &next)).await.unwrap();
    passed_over(&maps, |passed| passed.unsigned, 4).await;
    published.put(next.clone()).attachment(server_key.sign(KEY, &next)).await.unwrap();
    assert_eq!(next_fresh(&mut maps).await, (3, 0, 0));
}

/// A router that is joined to no other, and its address.
async fn lone_router() -> (Session, String) {
    let mut config = zenoh::Config::default();
    config.insert_json5("mode", "\"router\"").unwrap();
    config.insert_json5("listen/endpoints", "[\"tcp/127.0.0.1:0\"]").unwrap();
    config.insert_json5("scouting/multicast/enabled", "false").unwrap();
    let router = zenoh::open(config).await.unwrap();
    let endpoint = router.info().locators().await.first().unwrap().to_string();
    (router, endpoint)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_planner_at_two_routers_at_once_reads_through_either() {
    let ((first, near), (second, far)) = (lone_router().await, lone_router().await);
    let publisher = publisher(&second).await;
    publisher.put(map(1, CAPTURE_END_NS)).await.unwrap();
    for endpoints in [format!("{near}+{far}"), format!("{far}+{near}")] {
        let client = ZenohClient::connect(&endpoints).await.unwrap();
        let mut maps = client.subscribe("alpha", "drivability").await.unwrap();
        assert_eq!(next(&mut maps).await.0, 1, "{endpoints}");
    }
    // A planner that knows one router waits there.
    let client = ZenohClient::connect(&near).await.unwrap();
    let mut maps = client.subscribe("alpha", "drivability").await.unwrap();
    let of_first = self::publisher(&first).await;
    of_first.put(map(2, CAPTURE_END_NS + 1)).await.unwrap();
    assert_eq!(next(&mut maps).await.0, 2);
}
