//! Who may do what, on every listener: each call and key against each kind of client. The table stands in
//! deploy/guide/access.md, and this test holds it equal to what a server with certificates and roles does.
//!
//! A new row is one line in [`rows`]. `CLEARWAY_BLESS=1 cargo test --test system access` writes the table.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Mutex;
use std::time::Duration;

use clearway_daemon::publish::listen::access::RPCS;
use clearway_daemon::run::Running;
use clearway_proto::v1;
use futures::future::join_all;
use prost::Message;
use tokio::io::AsyncReadExt;
use tonic::Code;
use tonic::codegen::http::uri::PathAndQuery;
use tonic::transport::{Certificate, ClientTlsConfig, Endpoint, Identity};
use tonic_prost::ProstCodec;
use zenoh::Session;
use zenoh::handlers::FifoChannelHandler;
use zenoh::pubsub::Subscriber;
use zenoh::sample::{Locality, Sample, SampleKind, SourceInfo};

use crate::fixture::certificates::{TOKEN, certificates, start, with_roles, zenoh_file};
use crate::fixture::{Driving, https, until, within};

const TABLE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/guide/access.md");
const BEGIN: &str = "<!-- The table is written by tests/tests/listeners/access.rs. -->\n";
const END: &str = "<!-- End of the table. -->";

/// Errors that only a caller gets that may make a call: it lacks content, or the server has no recorder or replay.
const OF_CONTENT: [Code; 5] =
    [Code::InvalidArgument, Code::NotFound, Code::OutOfRange, Code::FailedPrecondition, Code::Unimplemented];

/// Headers that ask for a WebSocket.
const UPGRADE: &str = "Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n\
    Sec-WebSocket-Protocol: foxglove.sdk.v1\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n";

/// What a client shows to the server.
#[derive(Clone, Copy, Debug)]
struct Caller {
    name: &'static str,
    /// CA and name of its certificate.
    certificate: Option<(&'static str, &'static str)>,
    token: Option<&'static str>,
}

const CALLERS: [Caller; 8] = [
    Caller { name: "no certificate", certificate: None, token: None },
    Caller { name: "wrong CA", certificate: Some(("theirs", "operator")), token: None },
    Caller { name: "expired", certificate: Some(("ours", "expired")), token: None },
    Caller { name: "no role", certificate: Some(("ours", "unlisted")), token: None },
    Caller { name: "reader", certificate: Some(("ours", "reader")), token: None },
    Caller { name: "ingester", certificate: Some(("ours", "ingester")), token: None },
    Caller { name: "operator", certificate: Some(("ours", "operator")), token: None },
    Caller { name: "token", certificate: None, token: Some(TOKEN) },
];

/// What a client attempts.
#[derive(Clone, Debug)]
enum Attempt {
    /// Calls the RPC with this path.
    Rpc(&'static str),
    /// Receives a sample of a key over zenoh.
    Subscribe(&'static str),
    /// Receives an answer to a query over zenoh.
    Query(&'static str),
    /// Sees the liveliness tokens of a key.
    Liveliness(&'static str),
    /// Sends an observation on a key over zenoh, which the server then acknowledges or refuses.
    Observe(&'static str),
    /// Sends a plan over zenoh that the server takes.
    Plan,
    /// Puts a sample on a key over zenoh that a reader of the server then receives.
    Forge(&'static str),
    /// Requests a path of a listener.
    Get(Listener, &'static str),
    /// Opens a WebSocket on a path of a listener.
    WebSocket(Listener, &'static str),
}

/// A listener for browsers and their like.
#[derive(Clone, Copy, Debug)]
enum Listener {
    Page,
    Metrics,
    Foxglove,
}

/// Every row of the table.
fn rows() -> Vec<(String, Attempt)> {
    let rpc = |(path, _): &(&'static str, _)| (format!("gRPC `{path}`"), Attempt::Rpc(path));
    let mut rows: Vec<_> = RPCS.iter().map(rpc).collect();
    let row = |what: &str, attempt| (what.to_owned(), attempt);
    rows.extend([
        row("gRPC, any other call", Attempt::Rpc("/clearway.v1.MapService/Erase")),
        row("zenoh, subscribe to `clearway/*/map/**`", Attempt::Subscribe("clearway/*/map/**")),
        row("zenoh, subscribe to `clearway/car/map/drivability`", Attempt::Subscribe("clearway/car/map/drivability")),
        row("zenoh, subscribe to `clearway/car/status`", Attempt::Subscribe("clearway/car/status")),
        row("zenoh, subscribe to `clearway/car/ingest/**`", Attempt::Subscribe("clearway/car/ingest/**")),
        row("zenoh, query `clearway/car/map/drivability`", Attempt::Query("clearway/car/map/drivability")),
        row("zenoh, query `clearway/car/recorder/status`", Attempt::Query("clearway/car/recorder/status")),
        row("zenoh, query `clearway/car/recorder/list`", Attempt::Query("clearway/car/recorder/list")),
        row("zenoh, liveliness of `clearway/*`", Attempt::Liveliness("clearway/*")),
        row("zenoh, put `clearway/car/ingest/pose`", Attempt::Observe("pose")),
        row("zenoh, put `clearway/car/ingest/road`", Attempt::Observe("road")),
        row("zenoh, put `clearway/car/ingest/scan/top`", Attempt::Observe("scan/top")),
        row("zenoh, put `clearway/car/ingest/packet/top`", Attempt::Observe("packet/top")),
        row("zenoh, put `clearway/car/ingest/sensor/new`", Attempt::Observe("sensor/new")),
        row("zenoh, put `clearway/car/ingest/end/top`", Attempt::Observe("end/top")),
        row("zenoh, put `clearway/car/plan`", Attempt::Plan),
        row("zenoh, put `clearway/car/map/drivability`", Attempt::Forge("clearway/car/map/drivability")),
        row("zenoh, put `clearway/car/status`", Attempt::Forge("clearway/car/status")),
        row("zenoh, put `clearway/**`", Attempt::Forge("clearway/**")),
        row("page `/healthz`", Attempt::Get(Listener::Page, "/healthz")),
        row("page `/readyz`", Attempt::Get(Listener::Page, "/readyz")),
        row("page `/metrics`", Attempt::Get(Listener::Page, "/metrics")),
        row("page `/vehicles`", Attempt::Get(Listener::Page, "/vehicles")),
        row("page `/history`", Attempt::Get(Listener::Page, "/history?vehicle=car")),
        row("page `/`", Attempt::Get(Listener::Page, "/")),
        row("page `/main.js`", Attempt::Get(Listener::Page, "/main.js")),
        row("page, WebSocket `/live`", Attempt::WebSocket(Listener::Page, "/live")),
        row("metrics `/healthz`", Attempt::Get(Listener::Metrics, "/healthz")),
        row("metrics `/readyz`", Attempt::Get(Listener::Metrics, "/readyz")),
        row("metrics `/metrics`", Attempt::Get(Listener::Metrics, "/metrics")),
        row("Foxglove, WebSocket `/`", Attempt::WebSocket(Listener::Foxglove, "/")),
    ]);
    rows
}

/// A running server, and what the attempts need of it.
struct Bed {
    running: Running,
    zenoh: String,
    /// A session of each caller; none if it is refused.
    sessions: BTreeMap<&'static str, Session>,
    /// What the server has reported of observations: clients whose observations it took or refused for another reason
    /// than their role.
    accounted: Mutex<Vec<u64>>,
    /// Payloads that a reader has received.
    received: Mutex<Vec<Vec<u8>>>,
}

impl Bed {
    /// Makes the attempt, until it succeeds.
    async fn attempt(&self, attempt: &Attempt, caller: Caller, id: u64) {
        let session = self.sessions.get(caller.name);
        match (attempt, session) {
            (Attempt::Rpc(path), _) => repeat(async || self.call(path, caller).await).await,
            (Attempt::Get(listener, path), _) => {
                repeat(async || self.request(*listener, path, caller, "Connection: close\r\n").await == 200).await;
            }
            (Attempt::WebSocket(listener, path), _) => {
                repeat(async || self.request(*listener, path, caller, UPGRADE).await == 101).await;
            }
            (_, None) => std::future::pending().await,
            (Attempt::Subscribe(key), Some(session)) => {
                // What this session puts itself would reach it without the server.
                let samples = session.declare_subscriber(*key).allowed_origin(Locality::Remote).await.unwrap();
                samples.recv_async().await.unwrap();
            }
            (Attempt::Query(key), Some(session)) => {
                let source = || SourceInfo::new(session.id(), 0);
                self.ask(async || session.get(*key).source_info(source()).await.unwrap()).await;
            }
            (Attempt::Liveliness(key), Some(session)) => {
                self.ask(async || session.liveliness().get(*key).await.unwrap()).await;
            }
            (Attempt::Observe(rest), Some(session)) => loop {
                let observation = v1::Observation { client: id, number: 1, ..Default::default() };
                let put = session.put(format!("clearway/car/ingest/{rest}"), observation.encode_to_vec());
                put.source_info(SourceInfo::new(session.id(), 0)).await.unwrap();
                pause().await;
                if self.accounted.lock().unwrap().contains(&id) {
                    return;
                }
            },
            (Attempt::Plan, Some(session)) => {
                let plans = self.running.vehicles.0[0].wires.plans.subscribe();
                let plan = v1::Plan { frame: 1, x: vec![id as f64], y: vec![0.0], ..Default::default() };
                while plans.borrow().as_ref().is_none_or(|newest| newest.x != plan.x) {
                    let put = session.put("clearway/car/plan", plan.encode_to_vec());
                    put.source_info(SourceInfo::new(session.id(), 0)).await.unwrap();
                    pause().await;
                }
            }
            (Attempt::Forge(key), Some(session)) => loop {
                let false_sample = format!("forged {id}").into_bytes();
                session.put(*key, false_sample.clone()).await.unwrap();
                pause().await;
                if self.received.lock().unwrap().contains(&false_sample) {
                    return;
                }
            },
        }
    }

    async fn ask(&self, ask: impl AsyncFn() -> FifoChannelHandler<zenoh::query::Reply>) {
        loop {
            // A query without an answer ends with an error.
            while let Ok(reply) = ask().await.recv_async().await {
                if reply.result().is_ok() {
                    return;
                }
            }
            pause().await;
        }
    }

    /// Calls an RPC; true if the caller may make it.
    async fn call(&self, path: &'static str, caller: Caller) -> bool {
        let read = |folder: &Path, file: String| std::fs::read_to_string(folder.join(file)).expect("a certificate");
        let mut tls = ClientTlsConfig::new().domain_name("localhost");
        tls = tls.ca_certificate(Certificate::from_pem(read(&certificates("ours"), "ca.pem".into())));
        if let Some((ca, name)) = caller.certificate {
            let of = certificates(ca);
            tls = tls.identity(Identity::from_pem(read(&of, format!("{name}.pem")), read(&of, format!("{name}.key"))));
        }
        let at = format!("https://{}", self.running.grpc.expect("gRPC is served"));
        let Ok(channel) = Endpoint::from_shared(at).unwrap().tls_config(tls).unwrap().connect().await else {
            return false;
        };
        let mut client = tonic::client::Grpc::new(channel);
        let (Ok(()), path) = (client.ready().await, PathAndQuery::from_static(path)) else {
            return false;
        };
        let mut request = tonic::Request::new(tokio_stream::once(()));
        if let Some(token) = caller.token {
            request.metadata_mut().insert("authorization", format!("Bearer {token}").parse().unwrap());
        }
        // An answer, or a complaint about the content of the call, which only a caller gets that may make it.
        let answer = client.streaming(request, path, ProstCodec::<(), ()>::default()).await;
        answer.err().is_none_or(|status| OF_CONTENT.contains(&status.code()))
    }

    /// Sends a request with these headers; returns the status of its answer, 0 without one.
    async fn request(&self, listener: Listener, path: &str, caller: Caller, headers: &str) -> u16 {
        let at = match listener {
            Listener::Page => self.running.page,
            Listener::Metrics => self.running.metrics,
            Listener::Foxglove => self.running.foxglove,
        };
        let token = caller.token.map_or_else(String::new, |token| format!("Authorization: Bearer {token}\r\n"));
        let head = format!("GET {path} HTTP/1.1\r\nHost: localhost\r\n{headers}{token}");
        let mut answer = [0; "HTTP/1.1 200".len()];
        if let Some(mut stream) = https::send(at.expect("it is served"), &head, caller.certificate).await {
            let _closed = stream.read_exact(&mut answer).await;
        }
        // 503 answers the question whether the maps are fresh, as 200 does.
        match https::status(&String::from_utf8_lossy(&answer)) {
            503 if path == "/readyz" => 200,
            answered => answered,
        }
    }
}

/// Makes an attempt on a connection of its own until it succeeds: all attempts at once are more than a listener takes.
async fn repeat(attempt: impl AsyncFn() -> bool) {
    while !attempt().await {
        tokio::time::sleep(Duration::from_secs(1)).await;
    }
}

/// Time between two attempts. It asserts nothing.
async fn pause() {
    tokio::time::sleep(Duration::from_millis(20)).await;
}

/// A session that shows this certificate, or none.
async fn session(server: String, certificate: Option<(&'static str, &'static str)>) -> Option<Session> {
    let mut config = zenoh::Config::from_json5(&zenoh_file("client.json5", &certificates("ours"))).unwrap();
    let (ca, name) = certificate.unwrap_or(("ours", "reader"));
    let file = |ending: &str| format!("{:?}", certificates(ca).join(format!("{name}.{ending}")).display().to_string());
    let settings = [
        ("mode", "\"client\"".to_owned()),
        ("connect/endpoints", format!("[{server:?}]")),
        ("connect/timeout_ms", "10000".to_owned()),
        ("scouting/multicast/enabled", "false".to_owned()),
        ("transport/link/tls/connect_certificate", file("pem")),
        ("transport/link/tls/connect_private_key", file("key")),
        ("transport/link/tls/enable_mtls", certificate.is_some().to_string()),
    ];
    for (key, value) in settings {
        config.insert_json5(key, &value).unwrap();
    }
    zenoh::open(config).await.ok()
}

async fn bed(folder: &Path) -> Bed {
    let mut config = with_roles(folder);
    // All attempts are made at once, from one address.
    config.connections.per_address_max = 256;
    config.recorder.file = folder.join("car.mcap");
    let file = folder.join("server.json5");
    std::fs::write(&file, zenoh_file("server.json5", &certificates("ours"))).unwrap();
    (config.zenoh.enabled, config.zenoh.file) = (true, file);
    config.zenoh.listen = vec!["tls/127.0.0.1:0".into()];
    let running = start(config).await;
    let port = running.zenoh[0].rsplit_once(':').expect("an endpoint").1.to_owned();
    let zenoh = format!("tls/localhost:{port}");
    // Each in a task of its own: a refused session takes its time.
    let opened = join_all(CALLERS.map(|caller| tokio::spawn(session(zenoh.clone(), caller.certificate)))).await;
    let named = CALLERS.iter().map(|caller| caller.name).zip(opened);
    let sessions = named.filter_map(|(name, session)| Some((name, session.expect("no panic")?))).collect();
    Bed { running, zenoh, sessions, accounted: Mutex::default(), received: Mutex::default() }
}

/// Listens with certificates that may, to see what the attempts of others have caused.
async fn observe(bed: &Bed) {
    let reports = session(bed.zenoh.clone(), Some(("ours", "operator"))).await.expect("a session of an operator");
    let samples = session(bed.zenoh.clone(), Some(("ours", "reader"))).await.expect("a session of a reader");
    let reported = reports.declare_subscriber("clearway/car/ingest/report").await.unwrap();
    let mut received = Vec::new();
    for key in ["clearway/car/map/drivability", "clearway/car/status"] {
        received.push(samples.declare_subscriber(key).await.unwrap());
    }
    let store = async |subscriber: &Subscriber<FifoChannelHandler<Sample>>| -> () {
        loop {
            let sample = subscriber.recv_async().await.unwrap();
            if sample.kind() == SampleKind::Put && sample.payload().len() < 64 {
                bed.received.lock().unwrap().push(sample.payload().to_bytes().into_owned());
            }
        }
    };
    let account = async {
        loop {
            let sample = reported.recv_async().await.unwrap();
            let report = v1::IngestReport::decode(&*sample.payload().to_bytes()).expect("a report");
            if report.refused.iter().all(|refused| refused.reason != "role") {
                bed.accounted.lock().unwrap().push(report.client);
            }
        }
    };
    tokio::join!(store(&received[0]), store(&received[1]), account);
}

/// Tries every row as every caller, until all callers in `expected` succeed, twice; returns the callers that succeed.
async fn measure(bed: &Bed, expected: &BTreeMap<String, Vec<bool>>) -> BTreeMap<String, Vec<bool>> {
    let rows = rows();
    let found = Mutex::new(rows.iter().map(|(row, _)| (row.clone(), vec![false; CALLERS.len()])).collect());
    // The second round takes as long again, so that what succeeds late is seen too.
    for round in 0..2_u64 {
        let attempts = rows.iter().enumerate().flat_map(|(index, (row, attempt))| {
            let found = &found;
            CALLERS.iter().enumerate().map(move |(column, caller)| {
                let is_expected = expected.get(row).is_some_and(|expected| expected[column]);
                let id = 1 + round * 10_000 + (index * CALLERS.len() + column) as u64;
                (is_expected, async move {
                    bed.attempt(attempt, *caller, id).await;
                    let mut found: std::sync::MutexGuard<'_, BTreeMap<String, Vec<bool>>> = found.lock().unwrap();
                    found.get_mut(row).expect("a row")[column] = true;
                })
            })
        });
        let (expected, others): (Vec<_>, Vec<_>) = attempts.partition(|(is_expected, _)| *is_expected);
        let all_expected = join_all(expected.into_iter().map(|(_, attempt)| attempt));
        let others = join_all(others.into_iter().map(|(_, attempt)| attempt));
        let patience = Duration::from_secs(if is_blessed() { 15 } else { 60 });
        let everything = async {
            all_expected.await;
            if is_blessed() {
                std::future::pending().await
            }
        };
        tokio::select! {
            _ = everything => {}
            _ = others => {}
            _ = observe(bed) => {}
            () = tokio::time::sleep(patience) => {}
        }
    }
    found.into_inner().unwrap()
}

/// True if the measured table is to be written.
fn is_blessed() -> bool {
    std::env::var_os("CLEARWAY_BLESS").is_some()
}

fn table(found: &BTreeMap<String, Vec<bool>>) -> String {
    let mut table = "| what | who |\n|---|---|\n".to_owned();
    for (row, _) in rows() {
        let who = CALLERS.iter().zip(&found[&row]).filter(|(_, may)| **may).map(|(caller, _)| caller.name);
        let who = who.collect::<Vec<_>>().join(", ");
        table += &format!("| {row} | {} |\n", if who.is_empty() { "none" } else { &who });
    }
    table
}

fn read(table: &str) -> BTreeMap<String, Vec<bool>> {
    let rows = table.lines().skip(2).filter_map(|line| line.trim_matches('|').split_once(" | "));
    let may = |who: &str| CALLERS.iter().map(|caller| who.split(", ").any(|name| name == caller.name)).collect();
    rows.map(|(row, who)| (row.trim().to_owned(), may(who.trim()))).collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
#[cfg_attr(not(clearway_openssl), ignore = "needs openssl: apt-get install openssl")]
async fn the_access_table_is_what_the_server_does() {
    let text = std::fs::read_to_string(TABLE).unwrap();
    let (before, rest) = text.split_once(BEGIN).expect("the mark before the table");
    let (golden, after) = rest.split_once(END).expect("the mark after the table");
    let folder = tempfile::tempdir().unwrap();
    let bed = within("a server", bed(folder.path())).await;
    let car = Driving::to(&bed.running);
    until("a map", || bed.running.vehicles.0[0].status.snapshot().maps > 0).await;
    // No expectations when the golden table is written: then every attempt has the same time.
    let expected = if is_blessed() { BTreeMap::new() } else { read(golden) };
    let found = within("the attempts", measure(&bed, &expected)).await;
    car.halt();
    for (_, session) in bed.sessions {
        session.close().await.unwrap();
    }
    within("shutdown", bed.running.shutdown()).await.unwrap();
    let measured = table(&found);
    if is_blessed() {
        std::fs::write(TABLE, format!("{before}{BEGIN}{measured}{END}{after}")).unwrap();
    } else {
        assert_eq!(golden, measured, "CLEARWAY_BLESS=1 writes the measured table into deploy/guide/access.md");
    }
}
