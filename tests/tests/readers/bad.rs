//! Readers that stop, lag, sit idle or reset their streams, beside healthy readers that lose no map because of them.

use std::net::SocketAddr;
use std::sync::{Arc, Weak};

use clearway_journal::encode::EncodedMap;
use clearway_proto::v1;
use clearway_tests::attack::http2::{WATCH, call, opening, reset};
use clearway_tests::attack::sockets::{Opening, hold};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;

use super::{Reader, keeps_up, of_layer, plain, portions};
use crate::fixture::{self, config, feed, sequence, start, until, within};

/// A link from the server that passes only the allowed number of bytes.
pub struct Link {
    pub address: SocketAddr,
    pub allowed: Arc<Semaphore>,
}

impl Link {
    pub async fn to(server: SocketAddr) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let (address, allowed) = (listener.local_addr().unwrap(), Arc::new(Semaphore::new(0)));
        let rate = allowed.clone();
        tokio::spawn(async move {
            let (mut near, _) = listener.accept().await.unwrap();
            let (mut far_reads, mut far_writes) = TcpStream::connect(server).await.unwrap().into_split();
            let (mut near_reads, mut near_writes) = near.split();
            let up = tokio::io::copy(&mut near_reads, &mut far_writes);
            let down = async {
                let mut byte = [0];
                while far_reads.read_exact(&mut byte).await.is_ok() {
                    rate.acquire().await.expect("open").forget();
                    if near_writes.write_all(&byte).await.is_err() {
                        break;
                    }
                }
            };
            tokio::join!(up, down)
        });
        Self { address, allowed }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn stopped_and_slow_readers_cost_the_others_nothing_and_resume_newest() {
    /// Bytes of the connection setup, and 10 kB/s at ten maps a second.
    const SETUP_BYTES: usize = 1000;
    const BYTES_PER_REVOLUTION: usize = 1000;
    let running = start(config()).await;
    let server = running.grpc.unwrap();
    let [link, blocked] = [Link::to(server).await, Link::to(server).await];
    [&link, &blocked].iter().for_each(|link| link.allowed.add_permits(SETUP_BYTES));
    // Small windows as our client has them, and the windows of a plain client, which hold minutes of maps.
    let mut slow = Reader::open(&mut plain(link.address).await, of_layer(2)).await.unwrap();
    let mut silent = Reader::open(&mut plain(blocked.address).await, of_layer(0)).await.unwrap();
    let deltas = v1::Selection { deltas: true, ..of_layer(2) };
    let mut stopped = Reader::open(&mut plain(server).await, deltas).await.unwrap();
    let mut small = Reader::open(&mut fixture::grpc(&running).await, of_layer(2)).await.unwrap();
    let mut healthy = Vec::new();
    for index in 0..8 {
        let mut client = if index % 2 == 0 { plain(server).await } else { fixture::grpc(&running).await };
        healthy.push(Reader::open(&mut client, of_layer(1 + index % 3)).await.unwrap());
    }

    let mut made: Vec<Weak<EncodedMap>> = Vec::new();
    let mut next = 0;
    for portion in portions(20) {
        let maps = feed(&running, portion).await;
        for expected in next..maps {
            made.push(Arc::downgrade(running.vehicles.0[0].newest.borrow().as_ref().unwrap()));
            for reader in &mut healthy {
                assert_eq!(reader.receive().await, (expected, 0, 0));
            }
            link.allowed.add_permits(BYTES_PER_REVOLUTION);
        }
        next = maps;
    }
    assert!(next >= 18, "{next} maps");
    // The latest-value slot keeps the newest map, and the stopped reader of deltas keeps its base; nothing else does.
    let alive = made.iter().filter(|map| map.upgrade().is_some()).count();
    assert!(alive <= 2, "{alive} of {next} maps are kept");

    for reader in [&mut stopped, &mut small] {
        let on_the_way =
            [reader.next().await.unwrap(), reader.next().await.unwrap()].map(|update| sequence(&update.map));
        assert_eq!(on_the_way[0], 0);
        reader.acknowledge(on_the_way[1]).await;
        let (sequence, skipped, _) = reader.receive().await;
        assert_eq!((sequence, skipped), (next - 1, next - 2 - on_the_way[1]), "the first new map is the newest one");
    }
    // The slow reader has at most its credits in flight; after these maps it receives the newest map.
    link.allowed.add_permits(Semaphore::MAX_PERMITS / 2);
    let (mut before, mut seen) = (slow.receive().await, 1);
    while before.0 < next - 1 {
        let update = slow.receive().await;
        assert_eq!(update.0, before.0 + 1 + update.1, "every missed map is counted");
        (before, seen) = (update, seen + 1);
    }
    assert!(seen <= 3, "{seen} maps over a link of 10 kB/s, of which at most two were in flight");
    // A reader that never acknowledges receives what was already sent, and every gap is reported as skipped.
    blocked.allowed.add_permits(Semaphore::MAX_PERMITS / 2);
    let mut expected = 0;
    while expected < next {
        let update = silent.next().await.unwrap();
        assert_eq!(sequence(&update.map), expected + update.skipped);
        expected += update.skipped + 1;
    }
    within("shutdown", running.shutdown()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_thousand_idle_connections_keep_no_reader_and_no_newcomer_out() {
    let mut config = config();
    config.connections.max = 32;
    let running = start(config).await;
    let server = running.grpc.unwrap();
    let mut healthy = Reader::open(&mut plain(server).await, of_layer(1)).await.unwrap();
    let idle = within("idle connections", hold(server, 1000, Opening::Http2Preface)).await.unwrap();
    keeps_up(&mut healthy, &running).await;
    let newcomer = fixture::grpc(&running).await.list_vehicles(v1::ListVehiclesRequest {}).await;
    assert_eq!(newcomer.expect("it takes the place of an idle one").into_inner().vehicles.len(), 1);
    drop(idle);
    within("shutdown", running.shutdown()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_client_that_resets_streams_in_a_loop_loses_only_its_own_connection() {
    let running = start(config()).await;
    let server = running.grpc.unwrap();
    let mut healthy = Reader::open(&mut plain(server).await, of_layer(1)).await.unwrap();
    let mut hostile = TcpStream::connect(server).await.unwrap();
    let mut frames = opening(65_535);
    (0..20_000).for_each(|index| frames.extend([call(2 * index + 1, WATCH), reset(2 * index + 1)].concat()));
    // The server may close the connection before it has read everything.
    let _ = hostile.write_all(&frames).await;
    let mut answer = Vec::new();
    let _ = within("the end", hostile.read_to_end(&mut answer)).await;
    drop(hostile);

    // A regular client that opens and drops streams over one connection.
    let mut hasty = plain(server).await;
    for _ in 0..300 {
        drop(Reader::open(&mut hasty, of_layer(0)).await);
    }
    keeps_up(&mut healthy, &running).await;
    let readers = || running.vehicles.0[0].status.to_proto().readers["grpc"];
    until("only the healthy reader is left", || readers() == 1).await;
    within("shutdown", running.shutdown()).await.unwrap();
}
