//! Measures what slow readers cost the others: eight healthy readers, alternately alone and beside a stopped and a slow
//! reader.
//!
//! In: the revolutions, and the seconds of each part. Out, for each part: the age of the maps at the healthy readers,
//! the maps they missed, the growth of the server's resident set, and the age of the first new map of the stopped
//! reader after it resumes (new: not already sent when it resumed). The stopped reader stops reading, as a planner that
//! hangs; its connection still answers pings (the server drops a connection that does not after 20 s). The slow reader
//! reads all the time over a slow link. Both have tonic's default windows, and the credits that our client requests.

use std::net::SocketAddr;
use std::time::Duration;

use clearway_client::{now_ns, v1};
use clearway_proto::v1::map_service_client::MapServiceClient;
use prost::Message;
use serde_json::{Value, json};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio::task::JoinSet;
use tonic::Streaming;
use tonic::transport::Endpoint;

use crate::drive::{Car, Revolutions};
use crate::server::Process;
use crate::{Carrier, Readers, SETTLE, StreamArguments, percentiles};

const HEALTHY: usize = 8;
const BYTES_A_SECOND: u64 = 10_000;
/// Maps that may be in flight to a reader without an acknowledgement.
const IN_FLIGHT: u32 = 2;
/// Rounds; each has a part without slow readers and a part with them.
const ROUNDS: usize = 2;

/// Measures and prints; returns the rows.
pub async fn measure(arguments: &StreamArguments, revolutions: &Revolutions) -> Vec<Value> {
    let mut rows = Vec::new();
    if !arguments.json {
        println!(
            "{:<8} {:>6} {:>7} {:>18} {:>10} {:>16}",
            "", "maps", "missed", "age p50/p99 ms", "grown KiB", "resumed, age ms"
        );
    }
    for with in [false, true].into_iter().cycle().take(2 * ROUNDS) {
        let row = part(arguments, revolutions, with).await;
        if !arguments.json {
            let [p50, p99] = [0, 1].map(|at| row["age_ms"][at].as_f64().unwrap_or(f64::NAN));
            let resumed = row["resumed_age_ms"].as_f64().map_or("-".into(), |ms| format!("{ms:.1}"));
            let (name, ages) = (row["slow_readers"].as_str().unwrap_or_default(), format!("{p50:.2} / {p99:.2}"));
            let (maps, missed) = (&row["maps"], &row["missed"]);
            println!("{name:<8} {maps:>6} {missed:>7} {ages:>18} {:>10} {resumed:>16}", row["grown_kib"]);
        }
        rows.push(row);
    }
    rows
}

/// Measures one part with a new server.
async fn part(arguments: &StreamArguments, revolutions: &Revolutions, with: bool) -> Value {
    let mut server = Process::start();
    let readers = Readers::default();
    let car = Car::drive(revolutions, server.data, &readers.cuts);
    let mut tasks = JoinSet::new();
    readers.join(&mut tasks, &server, Carrier::Grpc, &arguments.layer, HEALTHY, 0).await;
    tokio::time::sleep(SETTLE).await;
    let alone_kib = server.resident_kib();
    let mut slow = Vec::new();
    if with {
        let link = slow_link(server.grpc).await;
        slow.push(Slow::join(server.grpc, &arguments.layer).await);
        slow.push(Slow::join(link, &arguments.layer).await);
        slow[0].reads.send_replace(false);
    }
    readers.count_for(Duration::from_secs(arguments.seconds)).await;
    let grown_kib = server.resident_kib() - alone_kib;
    let resumed_age_ms = match slow.first_mut() {
        Some(stopped) => Some(stopped.resume(&readers).await),
        None => None,
    };
    slow.iter().for_each(|reader| reader.task.abort());
    car.stop();
    tasks.shutdown().await;
    server.stop();
    let mut seen = readers.seen.lock().expect("no thread panics");
    let seen = &mut *seen;
    json!({
        "slow_readers": if with { "with" } else { "without" },
        "maps": seen.carried.len(),
        "age_ms": percentiles(&mut seen.ages),
        "missed": seen.skipped,
        "grown_kib": grown_kib,
        "resumed_age_ms": resumed_age_ms,
    })
}

/// A reader that stops, or is behind a slow link.
struct Slow {
    reads: watch::Sender<bool>,
    received: watch::Receiver<Received>,
    task: tokio::task::JoinHandle<()>,
}

/// Number of received updates, and the stamps of the newest.
#[derive(Clone, Copy, Debug, Default)]
struct Received {
    updates: u64,
    capture_end_ns: i64,
    arrived_ns: i64,
}

impl Slow {
    /// Opens a stream and receives its first map.
    async fn join(address: SocketAddr, layer: &str) -> Self {
        let endpoint = Endpoint::from_shared(format!("http://{address}")).expect("an address");
        let mut service = MapServiceClient::new(endpoint.connect().await.expect("gRPC answers"));
        let selection =
            v1::Selection { layers: vec![layer.to_owned()], max_in_flight: IN_FLIGHT, ..Default::default() };
        let (requests, mut receiver) = tokio::sync::mpsc::channel(8);
        requests.send(v1::WatchRequest { selection: Some(selection), ..Default::default() }).await.expect("capacity");
        let requested = futures::stream::poll_fn(move |context| receiver.poll_recv(context));
        let updates = service.watch(requested).await.expect("the server streams").into_inner();
        let (sender, mut received) = watch::channel(Received::default());
        let (reads, may_read) = watch::channel(true);
        let task = tokio::spawn(read(updates, requests, may_read, sender));
        received.changed().await.expect("a first map");
        Self { reads, received, task }
    }

    /// Reads again; returns the age of the first map that was not in flight before, in ms.
    async fn resume(&mut self, readers: &Readers) -> f64 {
        let before = self.received.borrow_and_update().updates;
        self.reads.send_replace(true);
        loop {
            self.received.changed().await.expect("the stream goes on");
            let received = *self.received.borrow_and_update();
            if received.updates > before + u64::from(IN_FLIGHT) {
                return readers
                    .age_ms(received.capture_end_ns, received.arrived_ns)
                    .expect("a revolution that was sent");
            }
        }
    }
}

async fn read(
    mut updates: Streaming<v1::MapUpdate>,
    requests: tokio::sync::mpsc::Sender<v1::WatchRequest>,
    mut may_read: watch::Receiver<bool>,
    sender: watch::Sender<Received>,
) {
    while may_read.wait_for(|reads| *reads).await.is_ok()
        && let Ok(Some(update)) = updates.message().await
    {
        let arrived_ns = now_ns();
        let header = v1::Map::decode(update.map).expect("a map").header.expect("a header");
        sender.send_modify(|received| {
            *received = Received { updates: received.updates + 1, capture_end_ns: header.capture_end_ns, arrived_ns };
        });
        let acknowledged = v1::WatchRequest { acknowledged: Some(header.sequence), ..Default::default() };
        if requests.send(acknowledged).await.is_err() {
            return;
        }
    }
}

/// A slow link to the server, for one connection.
async fn slow_link(server: SocketAddr) -> SocketAddr {
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a free port");
    let address = listener.local_addr().expect("bound");
    tokio::spawn(async move {
        let (near, _) = listener.accept().await?;
        let (mut from_reader, mut to_reader) = near.into_split();
        let (mut from_server, mut to_server) = TcpStream::connect(server).await?.into_split();
        tokio::spawn(async move { tokio::io::copy(&mut from_reader, &mut to_server).await });
        let mut bytes = [0; BYTES_A_SECOND as usize / 10];
        loop {
            let count = from_server.read(&mut bytes).await?;
            if count == 0 {
                return Ok::<(), std::io::Error>(());
            }
            to_reader.write_all(&bytes[..count]).await?;
            tokio::time::sleep(Duration::from_secs_f64(count as f64 / BYTES_A_SECOND as f64)).await;
        }
    });
    address
}
