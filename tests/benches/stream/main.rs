//! Measures the cost of the stream: a server in its own process, a simulated HDL-64E that sends datagrams to it in real
//! time, and readers of one layer over gRPC, over zenoh, over the page's WebSocket, and over plain TCP, which is the
//! lower bound for the same bytes.
//!
//!   cargo bench -p clearway-tests --bench stream                                  1, 10, 100 and 1,000 readers
//!   cargo bench -p clearway-tests --bench stream -- --readers 1,10 --seconds 30 --layer occupancy --json
//!   cargo bench -p clearway-tests --bench stream -- --readers 300 --carriers grpc
//!   cargo bench -p clearway-tests --bench stream -- --slow --seconds 60           what slow readers cost the others
//!
//! Age: time from sending the last packet of a revolution to receiving its map. Carried: time from the server's
//! hand-over to the transport to receiving the map. The first reader decodes every map, as a planner does; the others
//! receive the bytes, and acknowledge them over gRPC and to the page. Memory: growth of the server's resident set,
//! divided by the number of readers. Cores: processor time of the server over the time that is measured. All
//! processes use the clock of one machine.

mod drive;
mod server;
mod slow;

use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use bytes::Bytes;
use clap::{Parser, ValueEnum};
use clearway_client::{MapView, now_ns, v1};
use clearway_proto::v1::map_service_client::MapServiceClient;
use futures::{SinkExt, StreamExt};
use serde_json::json;
use tokio::io::AsyncReadExt;
use tokio::net::TcpStream;
use tokio::task::JoinSet;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::{WebSocketStream, client_async};
use tonic::transport::{Channel, Endpoint};

use drive::{Car, Cuts, Revolutions, cast};
use server::{Process, serve};

/// Streams of a gRPC connection, because the server does not accept a thousand connections.
const STREAMS: usize = 8;
/// Time that the drive is longer than the measurement, in seconds: readers connect meanwhile.
const BEFORE_S: u64 = 30;
/// Time after which readers have started and their memory is allocated.
const SETTLE: Duration = Duration::from_secs(3);

#[derive(Parser)]
struct StreamArguments {
    /// How many readers, one row each.
    #[arg(long, value_delimiter = ',', default_values_t = [1, 10, 100, 1000])]
    readers: Vec<usize>,
    /// Seconds of each row.
    #[arg(long, default_value_t = 20)]
    seconds: u64,
    /// Layer that is read.
    #[arg(long, default_value = "drivability")]
    layer: String,
    /// Transports of the maps, one row each.
    #[arg(long, value_enum, value_delimiter = ',', default_values_t = Carrier::value_variants().to_vec())]
    carriers: Vec<Carrier>,
    /// Measures instead what a stopped and a slow reader cost eight others, and the age of the first map after
    /// resuming.
    #[arg(long)]
    slow: bool,
    /// Prints one JSON object instead of a table.
    #[arg(long)]
    json: bool,
    /// Runs as the server; this program starts itself so.
    #[arg(long, hide = true)]
    serve: bool,
    /// Set by cargo bench.
    #[arg(long, hide = true)]
    bench: bool,
}

/// Transport of the maps. TCP is last, with as many bytes as a map of the row before has.
#[derive(Clone, Copy, Debug, PartialEq, ValueEnum)]
enum Carrier {
    Grpc,
    Zenoh,
    Page,
    Tcp,
}

/// Measurements of all readers together.
#[derive(Debug, Default)]
struct Seen {
    /// Age of every map of every reader, in ms.
    ages: Vec<f64>,
    carried: Vec<f64>,
    /// Age of every map of the reader that decodes, in ms.
    planner: Vec<f64>,
    bytes: u64,
    /// Maps that the server skipped because a reader, or its link, was slow.
    skipped: u64,
}

/// The readers of one carrier.
#[derive(Clone, Default)]
struct Readers {
    seen: Arc<Mutex<Seen>>,
    counts: Arc<AtomicBool>,
    cuts: Cuts,
}

fn main() -> ExitCode {
    let arguments = StreamArguments::parse();
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().expect("a runtime");
    if arguments.serve {
        runtime.block_on(serve());
        return ExitCode::SUCCESS;
    }
    let revolutions = cast(10 * (arguments.seconds + BEFORE_S) as usize);
    if arguments.slow {
        let rows = runtime.block_on(slow::measure(&arguments, &revolutions));
        if arguments.json {
            println!("{}", json!({ "layer": arguments.layer, "load_average": load_average(), "rows": rows }));
        }
        return ExitCode::SUCCESS;
    }
    let mut rows = Vec::new();
    if !arguments.json {
        println!(
            "{:<6} {:>7} {:>22} {:>22} {:>22} {:>9} {:>10} {:>11} {:>6}",
            "",
            "readers",
            "age p50/p99 ms",
            "planner's p50/p99 ms",
            "carried p50/p99 ms",
            "maps/s",
            "bytes/map",
            "KiB/reader",
            "cores"
        );
    }
    for &readers in &arguments.readers {
        let mut bytes = 10_000;
        for &carrier in &arguments.carriers {
            let row = runtime.block_on(measure(&arguments, &revolutions, carrier, readers, bytes));
            bytes = row["bytes_per_map"].as_u64().unwrap_or(bytes);
            if !arguments.json {
                print_row(&row);
            }
            rows.push(row);
        }
    }
    let load = load_average();
    match arguments.json {
        true => println!("{}", json!({ "layer": arguments.layer, "load_average": load, "rows": rows })),
        false => println!("layer {}, load average in the end {load}", arguments.layer),
    }
    ExitCode::SUCCESS
}

fn load_average() -> String {
    let load = std::fs::read_to_string("/proc/loadavg").unwrap_or_default();
    load.split_whitespace().take(3).collect::<Vec<_>>().join(" ")
}

fn print_row(row: &serde_json::Value) {
    let pair = |key: &str| match row[key][0].as_f64().zip(row[key][1].as_f64()) {
        Some((p50, p99)) => format!("{p50:.2} / {p99:.2}"),
        None => "-".into(),
    };
    println!(
        "{:<6} {:>7} {:>22} {:>22} {:>22} {:>9.0} {:>10} {:>11.1} {:>6.2}",
        row["carrier"].as_str().unwrap_or_default(),
        row["readers"],
        pair("age_ms"),
        pair("planner_age_ms"),
        pair("carried_ms"),
        row["maps_per_s"].as_f64().unwrap_or_default(),
        row["bytes_per_map"],
        row["kib_per_reader"].as_f64().unwrap_or_default(),
        row["server_cores"].as_f64().unwrap_or_default(),
    );
}

/// Measures one row: a new server, and this many readers.
async fn measure(
    arguments: &StreamArguments,
    revolutions: &Revolutions,
    carrier: Carrier,
    count: usize,
    bytes: u64,
) -> serde_json::Value {
    let mut server = Process::start();
    let readers = Readers::default();
    let car = Car::drive(revolutions, server.data, &readers.cuts);
    // One reader connects first, so that its one-time cost does not count for the others.
    let mut tasks = JoinSet::new();
    readers.join(&mut tasks, &server, carrier, &arguments.layer, 1, bytes).await;
    tokio::time::sleep(SETTLE).await;
    let alone_kib = server.resident_kib();
    readers.join(&mut tasks, &server, carrier, &arguments.layer, count - 1, bytes).await;
    tokio::time::sleep(SETTLE).await;
    let before_s = server.processor_s();
    readers.count_for(Duration::from_secs(arguments.seconds)).await;
    let spent_s = server.processor_s() - before_s;
    let grown_kib = server.resident_kib() - alone_kib;
    car.stop();
    tasks.shutdown().await;
    server.stop();
    let mut seen = readers.seen.lock().expect("no thread panics");
    let seen = &mut *seen;
    let maps = seen.carried.len() as u64;
    json!({
        "carrier": format!("{carrier:?}").to_lowercase(),
        "readers": count,
        "age_ms": percentiles(&mut seen.ages),
        "planner_age_ms": percentiles(&mut seen.planner),
        "carried_ms": percentiles(&mut seen.carried),
        "maps_per_s": maps as f64 / arguments.seconds as f64,
        "bytes_per_map": seen.bytes.checked_div(maps),
        "server_cores": spent_s / arguments.seconds as f64,
        "kib_per_reader": if count > 1 { grown_kib as f64 / (count - 1) as f64 } else { 0.0 },
    })
}

fn percentiles(values: &mut [f64]) -> Option<[f64; 2]> {
    values.sort_by(f64::total_cmp);
    let at = |share: f64| values[((values.len() - 1) as f64 * share).round() as usize];
    (!values.is_empty()).then(|| [at(0.5), at(0.99)])
}

impl Readers {
    /// Adds readers that read until they are stopped.
    async fn join(
        &self,
        tasks: &mut JoinSet<()>,
        server: &Process,
        carrier: Carrier,
        layer: &str,
        count: usize,
        bytes: u64,
    ) {
        let is_first = tasks.is_empty();
        match carrier {
            Carrier::Tcp => {
                for _ in 0..count {
                    let stream = TcpStream::connect(server.floor).await.expect("the floor answers");
                    tasks.spawn(self.clone().over_tcp(stream, bytes as usize));
                }
            }
            Carrier::Grpc => {
                // One stream for each connection, unless there are too many readers.
                let streams = if count > 128 { STREAMS } else { 1 };
                let mut left = count;
                while left > 0 {
                    let endpoint = Endpoint::from_shared(format!("http://{}", server.grpc)).expect("an address");
                    let channel = endpoint
                        .tcp_nodelay(true)
                        .initial_stream_window_size(65_535)
                        .connect()
                        .await
                        .expect("gRPC answers");
                    for _ in 0..streams.min(left) {
                        let service = MapServiceClient::new(channel.clone());
                        tasks.spawn(self.clone().over_grpc(service, layer.to_owned(), is_first));
                    }
                    left -= streams.min(left);
                }
            }
            Carrier::Page => {
                for _ in 0..count {
                    let stream = TcpStream::connect(server.page).await.expect("the page answers");
                    stream.set_nodelay(true).expect("an option");
                    let (socket, _) =
                        client_async(format!("ws://{}/live", server.page), stream).await.expect("a WebSocket");
                    tasks.spawn(self.clone().over_page(socket, layer.to_owned(), is_first));
                }
            }
            Carrier::Zenoh => {
                for _ in 0..count {
                    let mut config = zenoh::Config::default();
                    let settings = [
                        ("mode", "\"client\"".to_owned()),
                        ("connect/endpoints", format!("[{:?}]", server.zenoh)),
                        ("scouting/multicast/enabled", "false".to_owned()),
                        ("scouting/gossip/enabled", "false".to_owned()),
                    ];
                    settings.iter().for_each(|(key, value)| config.insert_json5(key, value).expect("a setting"));
                    let session = zenoh::open(config).await.expect("zenoh answers");
                    tasks.spawn(self.clone().over_zenoh(session, layer.to_owned(), is_first));
                }
            }
        }
    }

    async fn over_grpc(self, mut service: MapServiceClient<Channel>, layer: String, is_planner: bool) {
        let (acknowledge, mut requests) = tokio::sync::mpsc::channel(8);
        let selection =
            v1::Selection { vehicle: String::new(), layers: vec![layer], max_in_flight: 2, ..Default::default() };
        let first = v1::WatchRequest { selection: Some(selection), ..Default::default() };
        acknowledge.send(first).await.expect("capacity");
        let requests = futures::stream::poll_fn(move |context| requests.poll_recv(context));
        let mut updates = service.watch(requests).await.expect("the server streams").into_inner();
        while let Ok(Some(update)) = updates.message().await {
            let arrived_ns = now_ns();
            let sequence = self.count_map(&update.map, update.sent_ns, arrived_ns, is_planner);
            if self.counts.load(Ordering::Relaxed) {
                self.seen.lock().expect("no thread panics").skipped += update.skipped;
            }
            let acknowledged = v1::WatchRequest { acknowledged: Some(sequence), ..Default::default() };
            if acknowledge.send(acknowledged).await.is_err() {
                return;
            }
        }
    }

    async fn over_page(self, mut socket: WebSocketStream<TcpStream>, layer: String, is_planner: bool) {
        use prost::Message as _;
        let watch =
            json!({ "type": "watch", "vehicle": "car", "id": 1, "layers": [layer], "max_in_flight": 2 }).to_string();
        socket.send(Message::text(watch)).await.expect("the page takes it");
        // The library answers pings.
        while let Some(Ok(message)) = socket.next().await {
            let arrived_ns = now_ns();
            let Message::Binary(update) = message else { continue };
            let update = v1::MapUpdate::decode(update).expect("an update");
            let sequence = self.count_map(&update.map, update.sent_ns, arrived_ns, is_planner);
            if self.counts.load(Ordering::Relaxed) {
                self.seen.lock().expect("no thread panics").skipped += update.skipped;
            }
            let drawn = json!({ "type": "acknowledge", "vehicle": "car", "id": 1, "sequence": sequence.to_string() });
            if socket.send(Message::text(drawn.to_string())).await.is_err() {
                return;
            }
        }
    }

    async fn over_zenoh(self, session: zenoh::Session, layer: String, is_planner: bool) {
        let key = format!("clearway/car/map/{layer}");
        let subscriber = session.declare_subscriber(key).await.expect("a subscriber");
        while let Ok(sample) = subscriber.recv_async().await {
            let arrived_ns = now_ns();
            let sent = sample.timestamp().expect("the server stamps").get_time().to_duration();
            self.count_map(
                &Bytes::from(sample.payload().to_bytes().into_owned()),
                sent.as_nanos() as i64,
                arrived_ns,
                is_planner,
            );
        }
    }

    /// Requests messages of this many bytes; the first eight are the time by the server's clock.
    async fn over_tcp(self, mut stream: TcpStream, bytes: usize) {
        use tokio::io::AsyncWriteExt;
        stream.set_nodelay(true).expect("an option");
        stream.write_all(&(bytes as u64).to_le_bytes()).await.expect("the floor takes it");
        let mut message = vec![0; bytes.max(8)];
        while stream.read_exact(&mut message).await.is_ok() {
            let arrived_ns = now_ns();
            let sent_ns = i64::from_le_bytes(message[..8].try_into().expect("eight bytes"));
            self.count(message.len(), sent_ns, arrived_ns);
        }
    }

    /// Counts the maps that arrive in this time.
    async fn count_for(&self, time: Duration) {
        self.counts.store(true, Ordering::Relaxed);
        tokio::time::sleep(time).await;
        self.counts.store(false, Ordering::Relaxed);
    }

    fn count(&self, bytes: usize, sent_ns: i64, arrived_ns: i64) -> bool {
        let counts = self.counts.load(Ordering::Relaxed);
        if counts {
            let mut seen = self.seen.lock().expect("no thread panics");
            seen.carried.push((arrived_ns - sent_ns) as f64 * 1e-6);
            seen.bytes += bytes as u64;
        }
        counts
    }

    /// Counts a map; returns its sequence.
    fn count_map(&self, map: &Bytes, sent_ns: i64, arrived_ns: i64, is_planner: bool) -> u64 {
        use prost::Message;
        let header = v1::Map::decode(map.clone()).expect("a map").header.expect("a header");
        if is_planner {
            MapView::decode(map.clone()).expect("a map");
        }
        let in_hands_ns = now_ns();
        if self.count(map.len(), sent_ns, arrived_ns)
            && let Some(age_ms) = self.age_ms(header.capture_end_ns, arrived_ns)
        {
            let mut seen = self.seen.lock().expect("no thread panics");
            seen.ages.push(age_ms);
            if is_planner {
                seen.planner.push(age_ms + (in_hands_ns - arrived_ns) as f64 * 1e-6);
            }
        }
        header.sequence
    }

    /// Time from the last packet of a capture to then, in ms.
    fn age_ms(&self, capture_end_ns: i64, then_ns: i64) -> Option<f64> {
        let cuts = self.cuts.lock().expect("no thread panics");
        // The last packet of the revolution is the first that was stamped after the capture's end.
        let (_, cut_ns) = cuts.iter().rev().take_while(|(stamp, _)| *stamp >= capture_end_ns).last()?;
        Some((then_ns - cut_ns) as f64 * 1e-6)
    }
}
