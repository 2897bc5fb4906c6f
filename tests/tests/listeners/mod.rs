//! Every TCP listener under attack: connections that do nothing, readers that do not read, no free file handle, pages
//! of other origins. Beside each attack a healthy client is served.

mod access;
mod floods;
mod identity;
mod security;
mod web;

use std::io::{BufRead, BufReader};
use std::net::SocketAddr;
use std::process::{Command, Stdio};

use clearway_client::Client;
use clearway_daemon::config::{Config, Foxglove, Metrics, Vehicle};
use clearway_daemon::run::Running;
use clearway_proto::v1;
use clearway_tests::attack::http2::never_read;
use clearway_tests::attack::sockets::{OPENINGS, Opening, closed, hold};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use crate::fixture::{self, before_another_look, feed, grpc, readings, selection, sequence, start, within};

/// A server with every TCP listener.
pub fn everything() -> Config {
    let (mut config, any) = (fixture::config(), "127.0.0.1:0".parse().unwrap());
    config.page.enabled = true;
    config.metrics = Metrics { enabled: true, listen: any };
    config.foxglove = Foxglove { enabled: true, listen: any };
    config
}

/// The answer to an HTTP request with this head; empty if the server closes the connection without one.
pub async fn ask(address: SocketAddr, head: &str) -> String {
    let Ok(mut stream) = TcpStream::connect(address).await else { return String::new() };
    let _ = stream.write_all(format!("{head}\r\n").as_bytes()).await;
    let mut answer = Vec::new();
    let _ = within("an answer", stream.read_to_end(&mut answer)).await;
    String::from_utf8_lossy(&answer).into_owned()
}

/// The head of a request, without the empty line at its end.
pub fn get(path: &str) -> String {
    format!("GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n")
}

/// The value of a metric of a listener.
async fn metric(running: &Running, line: &str) -> f64 {
    let text = ask(running.metrics.unwrap(), &get("/metrics")).await;
    let found = text.lines().find_map(|found| found.strip_prefix(line)?.trim().parse().ok());
    found.unwrap_or(0.0)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_call_for_a_vehicle_that_the_server_does_not_have_is_counted() {
    let running = start(everything()).await;
    let request = v1::GetMapRequest { vehicle: "truck".into(), ..Default::default() };
    let refused = grpc(&running).await.get_map(request).await.unwrap_err();
    assert_eq!(refused.code(), tonic::Code::NotFound);
    let calls = "clearway_connections_closed_total{listener=\"grpc\",reason=\"unknown_vehicle\"}";
    assert_eq!(metric(&running, calls).await, 1.0);
    within("shutdown", running.shutdown()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn connections_that_do_nothing_keep_no_newcomer_out() {
    let mut config = everything();
    config.connections.max = 32;
    config.connections.per_address_max = 24;
    let running = start(config).await;
    feed(&running, readings(2)).await;
    let web = [running.page, running.metrics].map(Option::unwrap);
    for opening in OPENINGS {
        let mut held = Vec::new();
        for address in web.into_iter().chain([running.grpc.unwrap(), running.foxglove.unwrap()]) {
            held.push(within("held connections", hold(address, 100, opening)).await.unwrap());
        }
        let vehicles = grpc(&running).await.list_vehicles(v1::ListVehiclesRequest {}).await;
        assert_eq!(vehicles.unwrap().into_inner().vehicles.len(), 1, "{opening:?}");
        for address in web {
            assert!(ask(address, &get("/healthz")).await.ends_with("ok\n"), "{opening:?}");
            // Not ready a second after the last map: no more come.
            let ready = ask(address, &get("/readyz")).await;
            assert!(ready.ends_with("ready\n") || ready.contains("vehicle car: "), "{opening:?}: {ready}");
        }
        let foxglove = ask(running.foxglove.unwrap(), &get("/")).await;
        assert!(foxglove.starts_with("HTTP/1.1 4"), "{opening:?}: {foxglove}");
        // Of 100 connections at most as many are open as an address may have.
        for connections in &mut held {
            for stream in &mut connections[..100 - 24] {
                within("the oldest are closed", closed(stream)).await;
            }
        }
    }
    assert!(metric(&running, "clearway_connections_closed_total{listener=\"page\",reason=\"made_room\"}").await > 0.0);
    within("shutdown", running.shutdown()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_connection_without_a_request_is_closed_after_a_time() {
    let mut config = everything();
    config.connections.idle_s = 1;
    let running = start(config).await;
    for opening in [Opening::OneByte, Opening::HalfHead, Opening::KeepAlive, Opening::Http2Preface] {
        for address in [running.grpc, running.page, running.metrics, running.foxglove].map(Option::unwrap) {
            let mut held = hold(address, 1, opening).await.unwrap();
            within("it is closed", closed(&mut held[0])).await;
        }
    }
    within("shutdown", running.shutdown()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_peer_that_takes_no_byte_is_cut() {
    let mut config = everything();
    config.connections.stalled_s = 1;
    let running = start(config).await;
    let mut hostile = TcpStream::connect(running.page.unwrap()).await.unwrap();
    let asked = get("/main.js").replace("Connection: close\r\n", "\r\n").repeat(1000);
    // No answer is read; the server reads no request while an answer waits.
    within("it is cut", async { while hostile.write_all(asked.as_bytes()).await.is_ok() {} }).await;
    let cut = "clearway_connections_closed_total{listener=\"page\",reason=\"stalled\"}";
    within("it is counted", async { while metric(&running, cut).await < 1.0 {} }).await;
    within("shutdown", running.shutdown()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn an_ipv6_address_with_the_name_of_its_zone_is_reached() {
    let mut config = everything();
    config.grpc.listen = "[::1]:0".parse().unwrap();
    let running = start(config).await;
    for address in ["[::1%lo]", "http://[::1%lo]", "[::1%1]", "[::1]"] {
        let client = Client::connect(&format!("{address}:{}", running.grpc.unwrap().port())).await;
        assert_eq!(client.expect("the server answers").vehicles().await.unwrap().len(), 1, "{address}");
    }
    within("shutdown", running.shutdown()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn streams_of_one_vehicle_leave_another_its_places_and_a_refused_one_is_counted() {
    let mut config = everything();
    config.vehicles[0].ingest.streams_max = 1;
    let van = Vehicle { name: "van".into(), ..config.vehicles[0].clone() };
    config.vehicles.push(van);
    let running = start(config).await;
    let client = Client::connect(&running.grpc.unwrap().to_string()).await.unwrap();
    let car = within("a stream", client.ingest("car")).await.unwrap();
    let van = within("a stream", client.ingest("van")).await.unwrap();
    let refused = within("an answer", client.ingest("car")).await.err().expect("car has one place").to_string();
    assert!(refused.contains("vehicle car: all 1 streams are open"), "{refused}");
    let counted = metric(&running, "clearway_connections_closed_total{listener=\"grpc\",reason=\"streams\"}").await;
    assert_eq!(counted, 1.0);
    drop((car, van));
    within("shutdown", running.shutdown()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn streams_that_are_never_read_are_limited_and_cost_a_healthy_reader_no_map() {
    let running = start(everything()).await;
    let healthy = &mut grpc(&running).await;
    let mut maps = healthy.watch(tokio_stream::once(selection("car", &[], 0))).await.unwrap().into_inner();
    let hostile = within("2,000 streams", never_read(running.grpc.unwrap(), 20, 100)).await.unwrap();
    let calls = "clearway_connections_closed_total{listener=\"grpc\",reason=\"calls\"}";
    within("1,745 streams are refused", async {
        while metric(&running, calls).await < 1745.0 {
            before_another_look().await;
        }
    })
    .await;
    let mut next = 0;
    for portion in readings(12).chunks(40).map(<[_]>::to_vec) {
        let made = feed(&running, portion).await;
        while next < made {
            let update = within("the next map", maps.message()).await.unwrap().unwrap();
            assert_eq!((sequence(&update.map), update.skipped), (next, 0), "the healthy reader misses none");
            next += 1;
        }
    }
    assert!(next >= 10, "{next} maps");
    drop((hostile, maps));
    within("shutdown", running.shutdown()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_peer_over_the_limit_is_told_so_and_known_addresses_have_places_kept_for_them() {
    let mut config = everything();
    (config.connections.max, config.connections.kept) = (4, 2);
    let running = start(config.clone()).await;
    // Calls in progress, so that no connection is idle.
    let mut streams = Vec::new();
    for _ in 0..2 {
        let watching = grpc(&running).await.watch(tokio_stream::once(selection("car", &[], 1))).await;
        streams.push(watching.unwrap().into_inner());
    }
    let refused = grpc(&running).await.list_vehicles(v1::ListVehiclesRequest {}).await.unwrap_err();
    assert_eq!(refused.code(), tonic::Code::ResourceExhausted);
    let text = "2 connections are open; of the 4 that connections.max allows, 2 are kept for known peers";
    assert_eq!(refused.message(), text);
    config.connections.known = vec!["127.0.0.1".parse().unwrap()];
    running.reload(&config, None).unwrap();
    for _ in 0..2 {
        let watching = grpc(&running).await.watch(tokio_stream::once(selection("car", &[], 1))).await;
        streams.push(watching.unwrap().into_inner());
    }
    let refused = grpc(&running).await.list_vehicles(v1::ListVehiclesRequest {}).await.unwrap_err();
    assert!(refused.message().starts_with("4 connections are open, which connections.max allows"), "{refused}");
    config.connections.per_address_max = 1;
    running.reload(&config, None).unwrap();
    let refused = grpc(&running).await.list_vehicles(v1::ListVehiclesRequest {}).await.unwrap_err();
    assert!(refused.message().contains("of 127.0.0.1 are open, which connections.per_address_max"), "{refused}");
    drop(streams);
    within("shutdown", running.shutdown()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn every_listener_survives_the_lack_of_file_handles_and_a_hangup() {
    let folder = tempfile::tempdir().unwrap();
    let any = ["grpc", "page", "metrics", "foxglove"].map(|of| format!("{of}.listen=127.0.0.1:0"));
    let mut arguments = vec!["serve".to_owned(), "--config".into(), folder.path().join("c.toml").display().to_string()];
    let switches = ["metrics.enabled=true", "foxglove.enabled=true", "zenoh.enabled=false"].map(str::to_owned);
    let udp = ["vehicle.udp.data=127.0.0.1:0", "vehicle.udp.telemetry=127.0.0.1:0"].map(str::to_owned);
    arguments.extend(any.into_iter().chain(switches).chain(udp).flat_map(|set| ["--set".to_owned(), set]));
    std::fs::write(folder.path().join("c.toml"), clearway_daemon::config::COMMENTED).unwrap();
    let command = clearway_tests::binaries().join("clearway");
    // 60 handles are fewer than the connections that follow.
    let mut server = Command::new("sh")
        .args(["-c", "ulimit -n 60; exec \"$0\" \"$@\""])
        .arg(command)
        .args(arguments)
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(server.stderr.take().unwrap()).lines();
    let mut address = |what: &str| -> SocketAddr {
        let line = lines.by_ref().map(Result::unwrap).find(|line| line.contains(what)).expect("it is logged");
        let after = line.rsplit(['=', '/']).find(|part| part.parse::<SocketAddr>().is_ok());
        after.unwrap_or_else(|| panic!("{line}")).parse().unwrap()
    };
    let (page, metrics, foxglove) = (address("page http"), address("metrics http"), address("foxglove ws"));
    // The log must not fill its pipe.
    std::thread::spawn(move || lines.for_each(drop));
    let id = server.id().to_string();
    let signal = |name: &str| assert!(Command::new("kill").args([name, &id]).status().unwrap().success());
    signal("-HUP");
    let mut held = Vec::new();
    for at in [foxglove, page] {
        held.push(within("held connections", hold(at, 100, Opening::Nothing)).await.unwrap());
    }
    // While they are held: newcomers get the handles of idle connections, also of other listeners.
    let began = std::time::Instant::now();
    for at in [page, metrics] {
        within("an answer", async { while !ask(at, &get("/healthz")).await.ends_with("ok\n") {} }).await;
    }
    within("an answer", async { while !ask(foxglove, &get("/")).await.starts_with("HTTP/1.1 4") {} }).await;
    println!("three newcomers were served within {:?}", began.elapsed());
    drop(held);
    signal("-TERM");
    let ended = tokio::task::spawn_blocking(move || server.wait().unwrap());
    assert!(within("the server ends", ended).await.unwrap().success());
}
