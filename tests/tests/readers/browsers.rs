//! Browsers: one on a slow link gets the newest map and never a backlog, and hundreds of them get every map.

use std::collections::VecDeque;
use std::net::SocketAddr;

use clearway_proto::v1;
use clearway_tests::attack::websocket::{PING, PONG, TEXT, masked};
use prost::Message;
use serde_json::Value;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::sync::mpsc::{UnboundedReceiver, UnboundedSender, unbounded_channel};

use super::bad::Link;
use super::{LAYER, portions};
use crate::fixture::{config, feed, frame, grpc, sequence, start, until, web_socket, within};

/// A browser's WebSocket: it reads and answers pings by itself, whatever the page does.
struct Browser {
    said: UnboundedSender<Vec<u8>>,
    frames: UnboundedReceiver<(u8, Vec<u8>)>,
}

/// What a browser receives.
enum Received {
    Map(v1::MapUpdate),
    Text(Value),
}

impl Browser {
    fn new(socket: TcpStream) -> Self {
        let (mut reads, mut writes) = socket.into_split();
        let (said, mut to_say) = unbounded_channel::<Vec<u8>>();
        let (received, frames) = unbounded_channel();
        tokio::spawn(async move {
            while let Some(bytes) = to_say.recv().await {
                if writes.write_all(&bytes).await.is_err() {
                    break;
                }
            }
        });
        let answers = said.downgrade();
        tokio::spawn(async move {
            while let Ok((opcode, payload)) = frame(&mut reads).await {
                let taken = match (opcode, answers.upgrade()) {
                    (PING, Some(answers)) => answers.send(masked(PONG, &payload)).is_ok(),
                    (PING, None) => false,
                    other => received.send((other.0, payload)).is_ok(),
                };
                if !taken {
                    break;
                }
            }
        });
        Self { said, frames }
    }

    /// Watches one layer as the page does: at most two maps are on the way.
    async fn open(address: SocketAddr) -> Self {
        let mut browser = Self::new(web_socket(address, "/live").await);
        browser.watch().await;
        browser
    }

    async fn watch(&mut self) {
        self.say(&format!(r#"{{"type":"watch","vehicle":"car","id":1,"layers":["{LAYER}"],"max_in_flight":2}}"#));
        self.text_of("watching").await;
    }

    /// Sends a text in a frame that is masked with zeros.
    fn say(&self, text: &str) {
        self.said.send(masked(TEXT, text.as_bytes())).expect("the connection is open");
    }

    fn acknowledge(&self, sequence: u64) {
        self.say(&format!(r#"{{"type":"acknowledge","vehicle":"car","id":1,"sequence":"{sequence}"}}"#));
    }

    async fn next(&mut self) -> Received {
        match within("a frame", self.frames.recv()).await {
            Some((1, text)) => Received::Text(serde_json::from_slice(&text).unwrap()),
            Some((2, update)) => Received::Map(v1::MapUpdate::decode(&update[..]).unwrap()),
            other => panic!("{other:?}"),
        }
    }

    /// The next text of a type; a map before it is a fault.
    async fn text_of(&mut self, kind: &str) -> Value {
        loop {
            match self.next().await {
                Received::Text(text) if text["type"] == kind => return text,
                Received::Text(_) => {}
                Received::Map(update) => panic!("map {} before {kind}", sequence(&update.map)),
            }
        }
    }

    /// The next map: its sequence, and the maps skipped before it.
    async fn map(&mut self) -> (u64, u64) {
        loop {
            if let Received::Map(update) = self.next().await {
                return (sequence(&update.map), update.skipped);
            }
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_browser_on_a_slow_link_gets_the_newest_map_and_never_a_backlog() {
    let mut config = config();
    config.page.enabled = true;
    let running = start(config).await;
    let link = Link::to(running.page.unwrap()).await;
    // Enough for the upgrade and the first texts.
    link.allowed.add_permits(4000);
    let mut browser = Browser::open(link.address).await;
    let mut portions = portions(40).into_iter();
    let mut made = 0;
    while made < 2 {
        made = feed(&running, portions.next().unwrap()).await;
    }
    // The link passes nothing of the next revolutions: at most two maps are on the way, and none is sent after them.
    while made < 20 {
        made = feed(&running, portions.next().unwrap()).await;
    }
    link.allowed.add_permits(1 << 20);
    let on_the_way = [browser.map().await, browser.map().await];
    let is_no_backlog = |sequence: u64| sequence < 4 || sequence == made - 1;
    assert!(on_the_way.iter().all(|(sequence, _)| is_no_backlog(*sequence)), "{on_the_way:?} of {made}");
    browser.say(r#"{"type":"watch","vehicle":"absent","id":2}"#);
    let refused = browser.text_of("refused").await;
    assert_eq!(refused["id"], 2, "no map came before the answer: {refused}");

    // For each map that it acknowledges it gets one, the newest at that moment.
    let (mut last, mut skipped_sum) = (on_the_way[1].0, on_the_way[0].1 + on_the_way[1].1);
    let mut unacknowledged = VecDeque::from([on_the_way[0].0, on_the_way[1].0]);
    for _ in 0..4 {
        let before = made;
        while made < before + 3 {
            made = feed(&running, portions.next().unwrap()).await;
        }
        browser.acknowledge(unacknowledged.pop_front().unwrap());
        let (newest, skipped) = browser.map().await;
        assert_eq!((newest, skipped), (made - 1, newest - last - 1));
        unacknowledged.push_back(newest);
        (last, skipped_sum) = (newest, skipped_sum + skipped);
    }
    let metrics = get(running.page.unwrap(), "/metrics").await;
    let line = "clearway_skipped_maps_total{vehicle=\"car\",transport=\"page\"} ";
    let counted = metrics.lines().find_map(|text| text.strip_prefix(line)?.parse::<u64>().ok());
    assert!(counted.is_some_and(|counted| counted >= skipped_sum), "{counted:?} of {skipped_sum}:\n{metrics}");
    within("shutdown", running.shutdown()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_peer_that_answers_no_ping_is_sent_nothing_and_then_the_newest_map() {
    let mut config = config();
    config.page.enabled = true;
    let running = start(config).await;
    let mut socket = web_socket(running.page.unwrap(), "/live").await;
    let mut ping = [0; 10];
    within("a ping", socket.read_exact(&mut ping)).await.unwrap();
    assert_eq!(ping[..2], [0x89, 8], "a ping of 8 bytes is first");
    // An answer that was not read from the ping is none.
    socket.write_all(&masked(PONG, b"a guess!")).await.unwrap();
    let mut browser = Browser::new(socket);
    browser.watch().await;
    let mut made = 0;
    for portion in portions(6) {
        made = feed(&running, portion).await;
    }
    assert!(made > 3);
    browser.said.send(masked(PONG, &ping[2..])).expect("the connection is open");
    browser.text_of("fleet").await;
    assert_eq!(browser.map().await.0, made - 1, "none of the maps before was sent");
    within("shutdown", running.shutdown()).await.unwrap();
}

/// Browsers of the next test.
const BROWSERS: usize = 250;

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn hundreds_of_browsers_get_every_map_and_one_too_many_is_refused_in_words() {
    let mut config = config();
    config.page.enabled = true;
    config.connections.max = BROWSERS;
    (config.connections.per_address_max, config.connections.kept) = (BROWSERS + 8, 0);
    let running = start(config).await;
    let address = running.page.unwrap();
    let mut browsers = Vec::new();
    for _ in 0..BROWSERS {
        browsers.push(Browser::open(address).await);
    }
    let mut made = 0;
    for portion in portions(4) {
        let before = made;
        made = feed(&running, portion).await;
        for expected in before..made {
            for browser in &mut browsers {
                let (sequence, skipped) = browser.map().await;
                assert_eq!((sequence, skipped), (expected, 0));
                browser.acknowledge(sequence);
            }
        }
    }
    assert!(made >= 3);
    let refused = get(address, "/").await;
    assert!(refused.starts_with("HTTP/1.1 503") && refused.contains("which connections.max allows"), "{refused}");
    // The others stay, and so does gRPC.
    browsers[0].say(r#"{"type":"watch","vehicle":"absent","id":2}"#);
    browsers[0].text_of("refused").await;
    let vehicles = grpc(&running).await.list_vehicles(v1::ListVehiclesRequest {}).await.unwrap().into_inner();
    assert_eq!(vehicles.vehicles[0].name, "car");
    drop(browsers);
    until("their places are free", || running.vehicles.0[0].status.readers_sum() == 0).await;
    assert!(get(address, "/healthz").await.ends_with("ok\n"));
    within("shutdown", running.shutdown()).await.unwrap();
}

/// The answer to a GET request, with its head.
async fn get(address: SocketAddr, path: &str) -> String {
    let mut stream = TcpStream::connect(address).await.unwrap();
    let request = format!("GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).await.unwrap();
    let mut answer = String::new();
    within("an answer", stream.read_to_string(&mut answer)).await.unwrap();
    answer
}
