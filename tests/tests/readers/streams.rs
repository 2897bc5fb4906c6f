//! Streams of maps: all readers receive the same bytes, and no reader slows another.

use std::collections::BTreeMap;
use std::time::Duration;

use bytes::Bytes;
use clearway_daemon::run::{Server, Setup};
use clearway_proto::v1;
use clearway_sim::send::{Pace, Until, drive};
use clearway_tests::attack::websocket::{PING, PONG, TEXT, masked};
use tokio::net::UdpSocket;
use tokio::sync::mpsc;
use tonic::{Code, Streaming};
use zenoh::Session;
use zenoh_ext::{AdvancedSubscriberBuilderExt, HistoryConfig};

use crate::fixture::{
    self, config, feed, frame, grpc, readings, recorded, selection, sequence, start, until, vehicle, web_socket, within,
};

const LAYER: &str = "drivability";

/// A request stream that the test writes.
struct Requests(mpsc::Sender<v1::WatchRequest>);

impl Requests {
    async fn acknowledge(&self, sequence: u64) {
        let request = v1::WatchRequest { acknowledged: Some(sequence), ..Default::default() };
        self.0.send(request).await.expect("the stream is open");
    }
}

async fn watch(running: &clearway_daemon::run::Running, max_in_flight: u32) -> (Requests, Streaming<v1::MapUpdate>) {
    let (sender, mut requests) = mpsc::channel(16);
    sender.send(selection("car", &[LAYER], max_in_flight)).await.unwrap();
    let requests = futures::stream::poll_fn(move |context| requests.poll_recv(context));
    let updates = within("watch", grpc(running).await.watch(requests)).await.expect("watch").into_inner();
    (Requests(sender), updates)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_reader_that_has_ended_its_requests_has_the_maps_of_its_credits_and_is_told_why_no_more_come() {
    let running = start(config()).await;
    let car = fixture::Driving::to(&running);
    let (requests, mut updates) = watch(&running, 2).await;
    drop(requests);
    for _ in 0..2 {
        within("a map", updates.message()).await.unwrap().expect("a map for each credit");
    }
    let told = within("an end", updates.message()).await.unwrap_err();
    assert!(told.code() == Code::FailedPrecondition && told.message().contains("max_in_flight = 0"), "{told}");
    car.halt();
    within("shutdown", running.shutdown()).await.unwrap();
}

/// A zenoh session connected to the server only.
async fn session(running: &clearway_daemon::run::Running) -> Session {
    let mut config = zenoh::Config::default();
    let endpoint = running.zenoh.iter().find(|e| e.starts_with("tcp/127.0.0.1")).expect("zenoh listens");
    config.insert_json5("mode", "\"client\"").unwrap();
    config.insert_json5("connect/endpoints", &format!("[{endpoint:?}]")).unwrap();
    config.insert_json5("scouting/multicast/enabled", "false").unwrap();
    within("zenoh", zenoh::open(config).into_future()).await.expect("zenoh answers")
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn grpc_zenoh_and_the_recording_have_the_same_bytes_of_a_live_drive() {
    let folder = tempfile::tempdir().unwrap();
    let record = folder.path().join("live.mcap");
    let mut config = config();
    config.zenoh.enabled = true;
    config.recorder.file = record.clone();
    let running = start(config).await;

    let session = session(&running).await;
    let subscriber = session.declare_subscriber(format!("clearway/car/map/{LAYER}")).await.unwrap();
    let (_requests, mut updates) = watch(&running, 0).await;

    let car = fixture::Driving::to(&running);
    let mut over_grpc = BTreeMap::new();
    let mut over_zenoh = BTreeMap::new();
    within("three maps over gRPC and zenoh", async {
        while over_grpc.len() < 3 || over_zenoh.len() < 3 {
            tokio::select! {
                update = updates.message() => {
                    let map = update.expect("gRPC streams").expect("no end").map;
                    over_grpc.insert(sequence(&map), map);
                }
                sample = subscriber.recv_async() => {
                    let map = Bytes::from(sample.expect("zenoh streams").payload().to_bytes().into_owned());
                    over_zenoh.insert(sequence(&map), map);
                }
            }
        }
    })
    .await;
    let sent = car.halt();
    let status = running.vehicles.0[0].status.clone();
    session.close().await.unwrap();
    within("shutdown", running.shutdown()).await.unwrap();

    let ledger = status.snapshot().ledger;
    assert!(ledger.received <= sent.packets + sent.telemetry && ledger.refused.is_empty(), "{ledger:?} of {sent:?}");
    let recorded = recorded(&record);
    for (sequence, map) in over_grpc.iter().chain(&over_zenoh) {
        assert_eq!(recorded[&(*sequence, LAYER.to_owned())], map, "sequence {sequence}");
    }
    let report = clearway_daemon::record::verify(&record).unwrap();
    assert!(report.is_good() && report.maps >= 3, "{report:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn refused_datagrams_are_counted_by_reason_and_the_ledger_adds_up() {
    let running = start(config()).await;
    let (data, _) = running.inputs[0].udp.unwrap();
    let socket = UdpSocket::bind("127.0.0.1:0").await.unwrap();
    let flags = vec![0x11; 1206];
    let mut azimuth = vec![0; 1206];
    for block in azimuth[..1200].chunks_exact_mut(100) {
        // Block flag EEFF, azimuth 0xFFFF: more than a revolution.
        block[..4].copy_from_slice(&[0xff, 0xee, 0xff, 0xff]);
    }
    for datagram in [&b"hello"[..], &[0; 1205], &[0; 1207], &flags, &azimuth] {
        socket.send_to(datagram, data).await.unwrap();
    }
    let ledger = || running.vehicles.0[0].status.snapshot().ledger;
    until("five datagrams", || ledger().received == 5).await;
    let ledger = ledger();
    assert_eq!(ledger.refused.get("length"), Some(&3), "{ledger:?}");
    assert_eq!(ledger.refused.get("block_flag"), Some(&1), "{ledger:?}");
    assert_eq!(ledger.refused.get("azimuth"), Some(&1), "{ledger:?}");
    assert_eq!(ledger.received, ledger.decoded + ledger.telemetry + ledger.refused.values().sum::<u64>());
    running.shutdown().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_sender_that_is_not_configured_is_refused_for_its_source() {
    let mut config = config();
    let udp = config.vehicles[0].udp.as_mut().unwrap();
    udp.from.insert("top".into(), clearway_daemon::config::Sender::Address("127.0.0.2".parse().unwrap()));
    let running = start(config).await;
    let (data, _) = running.inputs[0].udp.unwrap();
    let packet = readings(1).into_iter().find_map(|reading| match reading.body {
        clearway_mapping::event::Body::Datagram(payload) if payload.len() == 1206 => Some(payload),
        _ => None,
    });
    let packet = packet.expect("the vehicle sends data");
    for sender in ["127.0.0.1:0", "127.0.0.2:0"] {
        UdpSocket::bind(sender).await.unwrap().send_to(&packet, data).await.unwrap();
    }
    let snapshot = || running.vehicles.0[0].status.snapshot();
    until("two datagrams", || snapshot().ledger.received == 2).await;
    assert_eq!(snapshot().ledger.refused, [("source", 1)].into());
    running.shutdown().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn an_unknown_vehicle_or_layer_is_refused_with_the_known_ones() {
    let running = start(config()).await;
    let mut client = grpc(&running).await;
    let get = |vehicle: &str, layer: &str| v1::GetMapRequest { vehicle: vehicle.into(), layers: vec![layer.into()] };
    let status = client.get_map(get("truck", LAYER)).await.unwrap_err();
    assert_eq!(status.code(), Code::NotFound);
    assert!(status.message().contains("truck") && status.message().contains("car"), "{status}");
    let status = client.get_map(get("car", "weather")).await.unwrap_err();
    assert_eq!(status.code(), Code::InvalidArgument);
    assert!(status.message().contains("drivability, height_difference, terrain"), "{status}");
    let status = client.get_map(get("car", LAYER)).await.unwrap_err();
    assert_eq!(status.code(), Code::Unavailable, "no map yet: {status}");

    let requests = |request| futures::stream::iter([request]);
    let status = client.watch(requests(selection("truck", &[], 0))).await.unwrap_err();
    assert_eq!(status.code(), Code::NotFound);
    let status = client.watch(requests(selection("car", &["weather"], 0))).await.unwrap_err();
    assert_eq!(status.code(), Code::InvalidArgument);
    let status = client.watch(requests(v1::WatchRequest::default())).await.unwrap_err();
    assert!(status.message().contains("selection"), "{status}");

    let vehicles = client.list_vehicles(v1::ListVehiclesRequest {}).await.unwrap().into_inner().vehicles;
    assert_eq!(vehicles.iter().map(|v| v.name.as_str()).collect::<Vec<_>>(), ["car"]);
    assert_eq!(vehicles[0].layers.len() as u64, fixture::LAYERS);
    running.shutdown().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn health_and_reflection_answer() {
    use tonic_health::pb::health_check_response::ServingStatus;
    use tonic_health::pb::{HealthCheckRequest, health_client::HealthClient};
    use tonic_reflection::pb::v1::ServerReflectionRequest;
    use tonic_reflection::pb::v1::server_reflection_client::ServerReflectionClient;
    use tonic_reflection::pb::v1::server_reflection_request::MessageRequest;
    use tonic_reflection::pb::v1::server_reflection_response::MessageResponse;

    let running = start(config()).await;
    let channel = tonic::transport::Channel::from_shared(format!("http://{}", running.grpc.unwrap())).unwrap();
    let channel = channel.connect().await.unwrap();
    let request = HealthCheckRequest { service: "clearway.v1.MapService".into() };
    let health = HealthClient::new(channel.clone()).check(request).await.unwrap().into_inner();
    // No packet has arrived, so there are no maps to serve; the server itself is alive.
    assert_eq!(health.status(), ServingStatus::NotServing);
    let health = HealthClient::new(channel.clone()).check(HealthCheckRequest::default()).await.unwrap().into_inner();
    assert_eq!(health.status(), ServingStatus::Serving);

    let list = MessageRequest::ListServices(String::new());
    let request = ServerReflectionRequest { host: String::new(), message_request: Some(list) };
    let mut client = ServerReflectionClient::new(channel);
    let answers = client.server_reflection_info(futures::stream::iter([request])).await.unwrap();
    let answer = answers.into_inner().message().await.unwrap().unwrap().message_response;
    let Some(MessageResponse::ListServicesResponse(list)) = answer else { panic!("{answer:?}") };
    assert!(list.service.iter().any(|service| service.name == "clearway.v1.MapService"), "{list:?}");
    running.shutdown().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_late_zenoh_subscriber_and_a_query_get_the_current_map() {
    let mut config = config();
    config.zenoh.enabled = true;
    let running = start(config).await;
    let maps = feed(&running, readings(3)).await;
    let newest = running.vehicles.0[0].newest.borrow().clone().expect("a map");
    assert_eq!(newest.sequence, maps - 1);
    let expected = newest.select(&[LAYER.into()]);

    let session = session(&running).await;
    let key = format!("clearway/car/map/{LAYER}");
    let replies = session.get(&key).await.unwrap();
    let reply = within("an answer", replies.recv_async()).await.unwrap();
    assert_eq!(Bytes::from(reply.result().unwrap().payload().to_bytes().into_owned()), expected);

    let joiner =
        session.declare_subscriber(&key).history(HistoryConfig::default().detect_late_publishers()).await.unwrap();
    let sample = within("the current map", joiner.recv_async()).await.unwrap();
    assert_eq!(Bytes::from(sample.payload().to_bytes().into_owned()), expected);

    let tokens = session.liveliness().get("clearway/*").await.unwrap();
    let token = within("the vehicle's token", tokens.recv_async()).await.unwrap();
    assert_eq!(token.result().unwrap().key_expr().as_str(), "clearway/car");
    session.close().await.unwrap();
    running.shutdown().await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_stopped_reader_slows_no_other_reader_and_gets_only_its_credits() {
    let running = start(config()).await;
    let (stopped_requests, mut stopped) = watch(&running, 2).await;
    let (requests, mut healthy) = watch(&running, 1).await;

    // Portions of less than a revolution (about 350 datagrams), so that a reader that keeps up misses no map.
    let mut revolutions: Vec<Vec<_>> = vec![Vec::new()];
    for reading in readings(12) {
        revolutions.last_mut().unwrap().push(reading);
        if revolutions.last().unwrap().len() == 300 {
            revolutions.push(Vec::new());
        }
    }
    let mut next = 0;
    for revolution in revolutions {
        let maps = feed(&running, revolution).await;
        while next < maps {
            let update = within("a map", healthy.message()).await.unwrap().unwrap();
            assert_eq!((sequence(&update.map), update.skipped), (next, 0));
            requests.acknowledge(next).await;
            next += 1;
        }
    }
    assert!(next >= 10, "{next} maps");

    // The stopped reader receives two old maps, then the newest one with the number of skipped maps.
    let first = within("a map", stopped.message()).await.unwrap().unwrap();
    let second = within("a map", stopped.message()).await.unwrap().unwrap();
    assert_eq!(sequence(&second.map), sequence(&first.map) + 1 + second.skipped);
    let third = tokio::time::timeout(Duration::from_millis(1), stopped.message()).await;
    assert!(third.is_err(), "no third map without an acknowledgement");
    let second = sequence(&second.map);
    stopped_requests.acknowledge(second).await;
    let third = within("a map", stopped.message()).await.unwrap().unwrap();
    assert_eq!((sequence(&third.map), third.skipped), (next - 1, next - 2 - second));

    assert_eq!(running.vehicles.0[0].status.to_proto().readers["grpc"], 2);
    drop((stopped, stopped_requests));
    let readers = || running.vehicles.0[0].status.to_proto().readers["grpc"];
    until("a reader that has gone is not counted", || readers() == 1).await;
    within("shutdown", running.shutdown()).await.unwrap();
    let end = within("the end", async {
        loop {
            match healthy.message().await {
                Ok(Some(_)) => continue,
                other => break other,
            }
        }
    })
    .await;
    assert_eq!(end.unwrap_err().code(), Code::Unavailable, "the stream ends with the status that the server stops");
}

/// Sends a plain HTTP request; returns the whole answer.
async fn http(address: std::net::SocketAddr, path: &str) -> String {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    let mut stream = tokio::net::TcpStream::connect(address).await.unwrap();
    let request = format!("GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).await.unwrap();
    let mut answer = Vec::new();
    within("an answer", stream.read_to_end(&mut answer)).await.unwrap();
    String::from_utf8_lossy(&answer).into_owned()
}

#[tokio::test(flavor = "multi_thread")]
async fn the_page_its_live_maps_and_the_metrics_are_served() {
    let mut config = config();
    config.page.enabled = true;
    let running = start(config).await;
    let address = running.page.unwrap();
    let maps = feed(&running, readings(2)).await;
    assert!(maps > 0);
    let newest = running.vehicles.0[0].newest.borrow().clone().unwrap();

    let index = http(address, "/").await;
    assert!(index.starts_with("HTTP/1.1 200") && index.contains("text/html") && index.contains("<canvas"), "{index}");
    assert!(http(address, "/no/such/thing").await.starts_with("HTTP/1.1 404"));
    assert!(http(address, "/../Cargo.toml").await.starts_with("HTTP/1.1 404"));
    assert!(http(address, "/healthz").await.ends_with("ok\n"));
    let metrics = http(address, "/metrics").await;
    assert!(metrics.contains(&format!("clearway_maps_total{{vehicle=\"car\"}} {maps}\n")), "{metrics}");
    let vehicles = http(address, "/vehicles").await;
    let (_, body) = vehicles.split_once("\r\n\r\n").unwrap();
    let vehicles: serde_json::Value = serde_json::from_str(body).unwrap();
    assert_eq!(vehicles[0]["name"], "car");

    use tokio::io::AsyncWriteExt;
    let mut stream = web_socket(address, "/live").await;
    for text in [r#"{"type":"detail","vehicle":"car"}"#, r#"{"type":"watch","vehicle":"car"}"#] {
        stream.write_all(&masked(TEXT, text.as_bytes())).await.unwrap();
    }
    let (mut update, mut status) = (None, None);
    within("a map and a status", async {
        while update.is_none() || status.is_none() {
            match frame(&mut stream).await.unwrap() {
                (PING, says) => stream.write_all(&masked(PONG, &says)).await.unwrap(),
                (2, payload) => update = Some(<v1::MapUpdate as prost::Message>::decode(&payload[..]).unwrap()),
                (TEXT, payload) => {
                    let text = serde_json::from_slice::<serde_json::Value>(&payload).unwrap();
                    if text["type"] == "fleet" {
                        status = Some(text);
                    }
                }
                other => panic!("{other:?}"),
            }
        }
    })
    .await;
    assert_eq!(update.unwrap().map, newest.select(&[]));
    let status = status.unwrap();
    assert_eq!(status["vehicles"][0]["ledger"]["lost"], 0);
    drop(stream);
    within("shutdown", running.shutdown()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn two_vehicles_have_their_own_sockets_maps_and_journals() {
    let folder = tempfile::tempdir().unwrap();
    let record = folder.path().join("two.mcap");
    let mut config = config();
    config.recorder.file = record.clone();
    let mut truck = config.vehicles[0].clone();
    truck.name = "truck".into();
    truck.maps.height_difference.enabled = false;
    config.vehicles.push(truck);
    let running = start(config).await;
    let mut client = grpc(&running).await;

    // The car receives two revolutions, the truck one.
    let maps = feed(&running, readings(2)).await;
    let (data, _) = running.inputs[1].udp.unwrap();
    let halt = Duration::from_millis(250);
    let until_then = Until { stop: None, device_time: Some(halt) };
    tokio::task::spawn_blocking(move || drive(fixture::anywhere(), vehicle(), data, data, Pace::RealTime, until_then))
        .await
        .unwrap()
        .unwrap();
    until("a map of the truck", || running.vehicles.0[1].newest.borrow().is_some()).await;

    let get = |vehicle: &str| v1::GetMapRequest { vehicle: vehicle.into(), layers: Vec::new() };
    let layers = |map: &Bytes| {
        let map = <v1::Map as prost::Message>::decode(map.clone()).unwrap();
        (map.header.unwrap().vehicle, map.layers.len())
    };
    let car = client.get_map(get("car")).await.unwrap().into_inner().map;
    assert_eq!((sequence(&car), layers(&car)), (maps - 1, ("car".to_owned(), fixture::LAYERS as usize)));
    let truck = client.get_map(get("truck")).await.unwrap().into_inner().map;
    assert_eq!(layers(&truck), ("truck".to_owned(), fixture::LAYERS as usize - 1));
    let status = client.get_map(get("")).await.unwrap_err();
    assert!(status.message().contains("car, truck"), "of several vehicles one must be named: {status}");
    within("shutdown", running.shutdown()).await.unwrap();
    let report = clearway_daemon::record::verify(&record).unwrap();
    assert!(report.is_good() && report.maps > maps, "{report:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn layers_are_made_while_subscribed_and_at_once_for_a_late_joiner() {
    let setup = Setup { config: config(), ..Setup::default() };
    let running = Server::start(setup).await.expect("the server starts");
    let newest = || running.vehicles.0[0].newest.borrow().clone().expect("a map");
    let layers = || newest().layers.iter().map(|(name, _)| *name).collect::<Vec<_>>();
    let all = readings(9);
    let third = all.len() / 3;
    let part = |number: usize| all[number * third..(number + 1) * third].to_vec();

    // Maps are made and counted, but no reader subscribes to a layer.
    assert!(feed(&running, part(0)).await >= 2);
    assert!(layers().is_empty());

    let without_layers = newest();
    let (requests, mut updates) = watch(&running, 0).await;
    let subscriptions = running.vehicles.0[0].wires.subscriptions.clone();
    until("the reader's layer is subscribed", || subscriptions.is_subscribed(LAYER)).await;
    assert!(!subscriptions.is_subscribed("terrain"));
    let update = within("the newest revolution's map", updates.message()).await.unwrap().unwrap();
    assert_eq!(sequence(&update.map), without_layers.sequence + 1, "no map without the layer is sent");
    assert_eq!(newest().capture_end_ns, without_layers.capture_end_ns);
    assert_eq!(layers(), [LAYER]);
    feed(&running, part(1)).await;
    within("the next revolution's map", updates.message()).await.unwrap().unwrap();
    assert_eq!(layers(), [LAYER]);

    drop((requests, updates));
    until("the reader is gone", || !subscriptions.is_subscribed(LAYER)).await;
    let subscription = subscriptions.subscribe(&["safe_path".into()]);
    feed(&running, part(2)).await;
    assert_eq!(layers(), ["drivability", "occupancy", "safe_path"], "the layers from which it is made are made too");
    assert!(subscription.is_covered_by(&newest()));
    within("shutdown", running.shutdown()).await.unwrap();
}
