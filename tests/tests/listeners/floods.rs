//! Clients that send frames without data as fast as they can: of HTTP/2 and of a WebSocket.

use std::net::SocketAddr;

use clearway_daemon::run::Running;
use clearway_tests::attack::http2::{self, frame};
use clearway_tests::attack::websocket::{PING, masked};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use super::{everything, metric};
use crate::fixture::{self, before_another_look, feed, readings, start, within};

/// Sends a flood until the server closes the connection.
async fn flood(mut stream: TcpStream, bytes: &[u8]) {
    let (mut read, mut write) = stream.split();
    let send = async { while write.write_all(bytes).await.is_ok() {} };
    let receive = async { while read.read(&mut [0; 4096]).await.is_ok_and(|length| length > 0) {} };
    within("the connection is closed", futures::future::join(send, receive)).await;
}

async fn floods(running: &Running, listener: &str) -> f64 {
    let line = format!("clearway_connections_closed_total{{listener=\"{listener}\",reason=\"flood\"}}");
    metric(running, &line).await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_healthy_reader_is_served_beside_floods_of_frames_without_data() {
    let running = start(everything()).await;
    let mut healthy = fixture::grpc(&running).await;
    let first = tokio_stream::once(fixture::selection("car", &[], 0));
    let mut maps = healthy.watch(first).await.unwrap().into_inner();
    let address = running.grpc.unwrap();
    // PRIORITY of a stream that never was, SETTINGS, PING, its answer, WINDOW_UPDATE, and an unknown type.
    let kinds = [(2, 0, 9, 5), (4, 0, 0, 0), (6, 0, 0, 8), (6, 1, 0, 8), (8, 0, 0, 4), (77, 0, 0, 100)];
    let attackers: Vec<_> = kinds
        .map(|(kind, flags, stream, length)| {
            tokio::spawn(async move {
                let bytes = frame(kind, flags, stream, &vec![0; length]).repeat(1000);
                loop {
                    let Ok(mut attacker) = TcpStream::connect(address).await else { continue };
                    let (mut read, mut write) = attacker.split();
                    let send = async {
                        let _ = write.write_all(&http2::opening(65_535)).await;
                        while write.write_all(&bytes).await.is_ok() {}
                    };
                    let receive = async { while read.read(&mut [0; 4096]).await.is_ok_and(|length| length > 0) {} };
                    futures::future::join(send, receive).await;
                }
            })
        })
        .into();
    for _ in 0..5 {
        feed(&running, readings(2)).await;
        within("a map", maps.message()).await.unwrap().expect("the healthy reader is served on");
    }
    attackers.iter().for_each(tokio::task::JoinHandle::abort);
    drop((maps, healthy));
    within("shutdown", running.shutdown()).await.unwrap();
}

/// Waits until gRPC has counted a connection that ended for this reason: it is counted after its peer sees the end.
async fn counted_once(running: &Running, reason: &str) {
    let line = format!("clearway_connections_closed_total{{listener=\"grpc\",reason=\"{reason}\"}}");
    within("the connection is counted", async {
        while metric(running, &line).await == 0.0 {
            before_another_look().await;
        }
    })
    .await;
    assert_eq!(metric(running, &line).await, 1.0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn what_http2_itself_ends_is_counted() {
    let running = start(everything()).await;
    let address = running.grpc.unwrap();
    let attack = async |bytes: Vec<u8>| {
        let mut attacker = TcpStream::connect(address).await.unwrap();
        attacker.write_all(&http2::opening(65_535)).await.unwrap();
        flood(attacker, &bytes).await;
    };
    // A head that never ends.
    let open_head = frame(1, 0, 1, &[0x82]);
    let more = frame(9, 0, 1, &[]);
    attack([open_head, more.repeat(900)].concat()).await;
    counted_once(&running, "flood").await;
    // DATA of a stream that no client may open.
    attack(frame(0, 0, 2, b"x")).await;
    counted_once(&running, "http2").await;
    within("shutdown", running.shutdown()).await.unwrap();
}

/// A WebSocket of each listener that has one.
async fn sockets(running: &Running) -> [(&'static str, TcpStream); 2] {
    let foxglove = foxglove(running.foxglove.unwrap()).await;
    [("page", fixture::web_socket(running.page.unwrap(), "/live").await), ("foxglove", foxglove)]
}

async fn foxglove(address: SocketAddr) -> TcpStream {
    let mut stream = TcpStream::connect(address).await.unwrap();
    let head = "GET / HTTP/1.1\r\nHost: localhost\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\
                Sec-WebSocket-Version: 13\r\nSec-WebSocket-Protocol: foxglove.sdk.v1\r\n\
                Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n";
    stream.write_all(head.as_bytes()).await.unwrap();
    let mut answer = Vec::new();
    while !answer.ends_with(b"\r\n\r\n") {
        answer.push(within("an answer", stream.read_u8()).await.unwrap());
    }
    assert!(answer.starts_with(b"HTTP/1.1 101"), "{}", String::from_utf8_lossy(&answer));
    stream
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn frames_of_a_websocket_end_it_if_they_are_too_many() {
    let running = start(everything()).await;
    for (opcode, payload) in [(9, &[7; 125][..]), (10, b"an answer"), (1, br#"{"type":"detail","vehicle":"car"}"#)] {
        for (_, stream) in sockets(&running).await {
            flood(stream, &masked(opcode, payload).repeat(1000)).await;
        }
    }
    assert_eq!([floods(&running, "page").await, floods(&running, "foxglove").await], [3.0, 3.0]);
    within("shutdown", running.shutdown()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_frame_of_a_websocket_that_claims_too_much_ends_it_before_it_has_come() {
    let running = start(everything()).await;
    for (name, mut stream) in sockets(&running).await {
        // The header of a text of 2 MiB, followed by one byte alone.
        stream.write_all(&[0x81, 0xff, 0, 0, 0, 0, 0, 0x20, 0, 0, 0, 0, 0, 0, b'x']).await.unwrap();
        let mut pings = 0;
        while let Ok((opcode, _)) = within("it is closed", fixture::frame(&mut stream)).await {
            pings += u32::from(opcode == PING);
        }
        // The page closes what answers no ping, but only after some time.
        assert!(pings <= 1, "{name}: {pings} pings");
    }
    within("shutdown", running.shutdown()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_browsers_new_selection_ends_the_one_before_it_also_while_the_browser_does_not_read() {
    let running = start(everything()).await;
    let mut stream = fixture::web_socket(running.page.unwrap(), "/live").await;
    let wanted = masked(1, br#"{"type":"watch","vehicle":"car","layers":["speed"]}"#);
    stream.write_all(&wanted.repeat(200)).await.unwrap();
    let mut answers = 0;
    // No ping is answered, so nothing but answers is sent.
    while answers < 200 {
        let (opcode, _) = within("an answer", fixture::frame(&mut stream)).await.unwrap();
        answers += u32::from(opcode == 1);
    }
    let readers = "clearway_readers{vehicle=\"car\",transport=\"page\"}";
    assert_eq!(metric(&running, readers).await, 1.0);
    stream.write_all(&masked(1, br#"{"type":"unwatch","vehicle":"car"}"#)).await.unwrap();
    within("no reader is left", async {
        while metric(&running, readers).await > 0.0 {
            before_another_look().await;
        }
    })
    .await;
    drop(stream);
    within("shutdown", running.shutdown()).await.unwrap();
}
