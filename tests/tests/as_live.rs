//! A drive replayed as live reaches readers over gRPC, zenoh, ROS 2 and the page at once: in order, to its last map.
//!
//! `cargo test --workspace --test as_live -- --nocapture` prints how old the maps are when they arrive, by their
//! shifted stamps.

mod fixture;

use std::path::Path;
use std::sync::Arc;

use clearway::cli::replay::{Options, replay};
use clearway_client::{Client, Subscription, ZenohClient, now_ns};
use clearway_proto::v1;
use fixture::{frame, web_socket, within};
use prost::Message;
use tokio::sync::mpsc::{UnboundedReceiver, UnboundedSender, unbounded_channel};

/// A map that arrived: the shifted end of its capture, and the time of its arrival, ns.
type Arrived = (i64, i64);

/// A recording of three seconds, whose configuration has every transport.
async fn drive(file: &Path) {
    let mut config = fixture::config();
    (config.zenoh.enabled, config.zenoh.ros2.enabled, config.page.enabled) = (true, true, true);
    config.recorder.file = file.to_owned();
    let running = fixture::start(config).await;
    fixture::feed(&running, fixture::readings(30)).await;
    running.shutdown().await.unwrap();
}

/// Follows the topic of a layer over ROS 2, whose stamp is 4 bytes of seconds and 4 of nanoseconds.
async fn follow_ros(endpoint: &str, maps: UnboundedSender<Arrived>) -> zenoh::Session {
    let settings = format!("{{ mode: \"client\", connect: {{ endpoints: [{endpoint:?}] }} }}");
    let session = zenoh::open(zenoh::Config::from_json5(&settings).unwrap()).await.unwrap();
    let topic = session.declare_subscriber("*/clearway/car/drivability/**").await.unwrap();
    tokio::spawn(async move {
        while let Ok(sample) = topic.recv_async().await {
            let bytes = sample.payload().to_bytes();
            let number = |at: usize| i64::from(u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()));
            let _ended = maps.send((number(4) * 1_000_000_000 + number(8), now_ns()));
        }
    });
    session
}

async fn follow_zenoh(endpoint: &str, maps: UnboundedSender<Arrived>) {
    let client = ZenohClient::connect(endpoint).await.unwrap();
    let mut stream = client.subscribe("car", "drivability").await.unwrap();
    tokio::spawn(async move {
        while let Ok(update) = stream.next().await {
            let _ended = maps.send((update.map.header().capture_end_ns, now_ns()));
        }
    });
}

async fn follow_grpc(address: &str, maps: UnboundedSender<Arrived>) {
    let layers = vec!["drivability".to_owned()];
    let subscription = Subscription { layers, ..Subscription::default() };
    let mut stream = Client::connect(address).await.unwrap().subscribe(subscription).await.unwrap();
    tokio::spawn(async move {
        while let Ok(update) = stream.next().await {
            let _ended = maps.send((update.map.header().capture_end_ns, now_ns()));
        }
    });
}

async fn follow_page(page: &str, maps: UnboundedSender<Arrived>) {
    let address = page.trim_start_matches("http://").trim_end_matches('/').parse().unwrap();
    let mut socket = web_socket(address, "/live?vehicle=car").await;
    tokio::spawn(async move {
        loop {
            let (2, payload) = frame(&mut socket).await else { continue };
            let update = v1::MapUpdate::decode(&payload[..]).unwrap();
            let Some(header) = v1::Map::decode(update.map).unwrap().header else { continue };
            let _ended = maps.send((header.capture_end_ns, now_ns()));
        }
    });
}

/// The maps up to the one with the stamp `last_ns`; prints their ages.
async fn take(transport: &str, maps: &mut UnboundedReceiver<Arrived>, last_ns: i64) -> Vec<i64> {
    let (mut stamps, mut ages_ms) = (Vec::new(), Vec::new());
    while stamps.last() != Some(&last_ns) {
        let (stamp_ns, now_ns) = within(transport, maps.recv()).await.expect("the reader goes on");
        stamps.push(stamp_ns);
        ages_ms.push((now_ns - stamp_ns) as f64 * 1e-6);
    }
    ages_ms.sort_by(f64::total_cmp);
    let (middle, most) = (ages_ms[ages_ms.len() / 2], ages_ms[ages_ms.len() - 1]);
    println!("{transport}: {} maps, {middle:.1} ms old in the median, {most:.1} ms at most", stamps.len());
    stamps
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn maps_as_live_reach_readers_of_every_transport_in_order_to_the_last() {
    let folder = tempfile::tempdir().unwrap();
    let (file, ready) = (folder.path().join("car.mcap"), folder.path().join("ready.json"));
    drive(&file).await;
    let last = fixture::recorded(&file).into_keys().map(|(sequence, _)| sequence).max().unwrap();
    let recorded = |(sequence, _): &(u64, String)| *sequence == last;
    let (_, bytes) = fixture::recorded(&file).into_iter().find(|(key, _)| recorded(key)).unwrap();
    let recorded_end_ns = v1::Map::decode(bytes).unwrap().header.unwrap().capture_end_ns;
    let options = Options {
        files: vec![file],
        ready_file: Some(ready.clone()),
        serve: true,
        any_port: true,
        as_live: true,
        paused: true,
        ..Options::default()
    };
    let (started, is_started) = tokio::sync::oneshot::channel();
    let mut stamps = Vec::new();
    let test = async {
        is_started.await.unwrap();
        let at: serde_json::Value = serde_json::from_slice(&std::fs::read(&ready).unwrap()).unwrap();
        let text = |value: &serde_json::Value| value.as_str().expect("an address").to_owned();
        let (grpc, page, zenoh) = (text(&at["grpc"]), text(&at["page"]), text(&at["zenoh"][0]));
        let [(to_grpc, grpc_maps), (to_zenoh, zenoh_maps), (to_ros, ros_maps), (to_page, page_maps)] =
            [(); 4].map(|()| unbounded_channel());
        let ros = follow_ros(&zenoh, to_ros).await;
        follow_zenoh(&zenoh, to_zenoh).await;
        follow_grpc(&grpc, to_grpc).await;
        follow_page(&page, to_page).await;
        let play = v1::ReplayControl { paused: Some(false), ..v1::ReplayControl::default() };
        let client = Client::connect(&grpc).await.unwrap();
        client.replay_control(play).await.unwrap();
        let first = within("a map", async {
            loop {
                if let Ok(map) = client.newest("car", &[]).await {
                    break map;
                }
            }
        });
        let last_ns = recorded_end_ns + first.await.header().replay.expect("as live").shift_ns;
        let transports = [("gRPC", grpc_maps), ("zenoh", zenoh_maps), ("ROS 2", ros_maps), ("page", page_maps)];
        for (transport, mut maps) in transports {
            stamps.push((transport, take(transport, &mut maps, last_ns).await));
        }
        ros.close().await.unwrap();
    };
    let started = |_: &clearway::server::Running, _: &_| started.send(()).expect("the test listens");
    within("a replay", replay(options, Arc::default(), started, test)).await.unwrap();
    for (transport, stamps) in stamps {
        assert!(stamps.is_sorted_by(|a, b| a < b), "{transport}: {stamps:?}");
    }
}
