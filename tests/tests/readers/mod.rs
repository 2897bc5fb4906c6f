//! Readers of `Watch` over real sockets: their requests, their updates, and that bad readers do not disturb the others.

mod bad;
mod browsers;
mod cpp;
mod interrupted;
mod nav2;
mod planners;
mod python;
mod streams;
mod subscriptions;
mod viewers;

use std::future::ready;
use std::net::SocketAddr;
use std::pin::Pin;

use clearway_daemon::ingest::queue::Reading;
use clearway_daemon::run::Running;
use clearway_proto::codec::Limits;
use clearway_proto::map::{Map, decode_map, decode_map_on};
use clearway_proto::v1;
use clearway_proto::v1::map_service_client::MapServiceClient;
use clearway_proto::v1::map_service_server::{MapService, MapServiceServer};
use futures::{Stream, StreamExt};
use tokio::net::TcpListener;
use tokio::sync::mpsc;
use tonic::transport::Channel;
use tonic::{Code, Request, Response, Status, Streaming};

use crate::fixture::{config, feed, readings, sequence, start, within};

const LAYER: &str = "drivability";

/// A reader that the test controls step by step.
struct Reader {
    requests: mpsc::Sender<v1::WatchRequest>,
    updates: Streaming<v1::MapUpdate>,
}

impl Reader {
    async fn open(client: &mut MapServiceClient<Channel>, selection: v1::Selection) -> Result<Self, Status> {
        let (requests, mut receiver) = mpsc::channel(16);
        requests.send(v1::WatchRequest { selection: Some(selection), ..Default::default() }).await.expect("capacity");
        let requested = futures::stream::poll_fn(move |context| receiver.poll_recv(context));
        let updates = within("watch", client.watch(requested)).await?.into_inner();
        Ok(Self { requests, updates })
    }

    async fn acknowledge(&self, sequence: u64) {
        let request = v1::WatchRequest { acknowledged: Some(sequence), ..Default::default() };
        self.requests.send(request).await.expect("the stream is open");
    }

    async fn next(&mut self) -> Result<v1::MapUpdate, Status> {
        within("a map", self.updates.message()).await.map(|update| update.expect("no end"))
    }

    /// Receives and acknowledges the next map: its sequence, and the numbers of skipped and of left-out maps before it.
    async fn receive(&mut self) -> (u64, u64, u64) {
        let update = self.next().await.expect("a map");
        let sequence = sequence(&update.map);
        self.acknowledge(sequence).await;
        (sequence, update.skipped, update.left_out)
    }
}

fn of_layer(max_in_flight: u32) -> v1::Selection {
    v1::Selection { layers: vec![LAYER.into()], max_in_flight, ..Default::default() }
}

/// A tonic client with its default windows.
async fn plain(address: SocketAddr) -> MapServiceClient<Channel> {
    let channel = Channel::from_shared(format!("http://{address}")).unwrap().connect().await;
    MapServiceClient::new(channel.expect("gRPC answers"))
}

/// Portions of less than a revolution (about 350 datagrams), so that a reader that keeps up misses no map.
fn portions(tenths: i64) -> Vec<Vec<Reading>> {
    readings(tenths).chunks(300).map(<[_]>::to_vec).collect()
}

/// Asserts that the reader receives every map of the first 0.3 s of this server.
async fn keeps_up(reader: &mut Reader, running: &Running) {
    let mut next = 0;
    for portion in portions(3) {
        let maps = feed(running, portion).await;
        for expected in next..maps {
            assert_eq!(reader.receive().await, (expected, 0, 0));
        }
        next = maps;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn an_impossible_request_is_refused_and_disturbs_no_other_reader() {
    let running = start(config()).await;
    let mut client = plain(running.grpc.unwrap()).await;
    let mut healthy = Reader::open(&mut client, of_layer(1)).await.unwrap();
    feed(&running, readings(2)).await;
    let first = healthy.receive().await.0;

    let far = v1::Region { x_from_m: 500.0, x_to_m: 600.0, y_from_m: -5.0, y_to_m: 5.0 };
    let wrong = [
        (v1::Selection { max_rate_hz: Some(0.0), ..of_layer(1) }, "max_rate_hz 0: more than 0"),
        (v1::Selection { max_rate_hz: Some(f64::NAN), ..of_layer(1) }, "max_rate_hz NaN"),
        (v1::Selection { max_rate_hz: Some(-2.0), ..of_layer(1) }, "max_rate_hz -2"),
        (v1::Selection { max_rate_hz: Some(f64::INFINITY), ..of_layer(1) }, "max_rate_hz inf"),
        (v1::Selection { region: Some(far), ..of_layer(1) }, "region"),
        (of_layer(65), "max_in_flight 65: 0 to 64"),
    ];
    for (selection, named) in wrong {
        let status = Reader::open(&mut client, selection).await.map(drop).unwrap_err();
        assert_eq!(status.code(), Code::InvalidArgument, "{status}");
        assert!(status.message().contains(named), "{named}: {status}");
    }

    let mut untrue = Reader::open(&mut client, of_layer(2)).await.unwrap();
    let newest = untrue.receive().await.0;
    untrue.acknowledge(4711).await;
    let status = untrue.next().await.unwrap_err();
    assert_eq!(status.code(), Code::InvalidArgument, "{status}");
    let last = format!("acknowledged 4711: this map was never sent on this stream; the last one sent is {newest}");
    assert!(status.message().starts_with(&last), "{status}");

    let long = v1::Selection { vehicle: "v".repeat(70_000), ..of_layer(1) };
    let status = Reader::open(&mut client, long).await.map(drop).unwrap_err();
    assert_eq!(status.code(), Code::OutOfRange, "{status}");
    assert!(status.message().contains("65536"), "{status}");

    let maps = feed(&running, readings(2)).await;
    assert!(maps > first + 1);
    assert!(healthy.receive().await.0 > first, "the healthy reader continues");
    within("shutdown", running.shutdown()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_rate_selects_maps_by_stamp_and_counts_left_out_and_skipped_maps() {
    let running = start(config()).await;
    let mut client = plain(running.grpc.unwrap()).await;
    let halved = v1::Selection { max_rate_hz: Some(5.0), ..of_layer(1) };
    let mut reader = Reader::open(&mut client, halved.clone()).await.unwrap();
    let mut slow = Reader::open(&mut client, halved).await.unwrap();
    let mut all = Reader::open(&mut client, of_layer(1)).await.unwrap();
    let (mut next, mut picked, mut first) = (0, Vec::new(), None);
    for portion in portions(14) {
        let maps = feed(&running, portion).await;
        while next < maps {
            assert_eq!(all.receive().await, (next, 0, 0));
            if next == 0 {
                first = Some(sequence(&slow.next().await.unwrap().map));
            }
            if next % 2 == 0 {
                picked.push(reader.receive().await);
            }
            next += 1;
        }
    }
    assert!(picked.len() >= 5, "{picked:?}");
    let expected = (0..).step_by(2).map(|sequence| (sequence, 0, u64::from(sequence > 0)));
    assert!(picked.iter().copied().eq(expected.take(picked.len())), "{picked:?}");

    // The reader without acknowledgements receives both counts: skipped maps, and maps that its rate leaves out.
    slow.acknowledge(first.unwrap()).await;
    let (sequence, skipped, left_out) = slow.receive().await;
    assert_eq!((sequence, skipped + left_out), (next - 1, next - 2));
    assert!(skipped.abs_diff(picked.len() as u64 - 2) <= 1, "{skipped} missed, {left_out} left out");
    within("shutdown", running.shutdown()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn the_current_map_is_sent_again_to_a_late_joiner_only() {
    let running = start(config()).await;
    let mut client = plain(running.grpc.unwrap()).await;
    let mut early = Reader::open(&mut client, of_layer(1)).await.unwrap();
    let mut next = 0;
    for portion in portions(4) {
        let maps = feed(&running, portion).await;
        for expected in next..maps {
            assert_eq!(early.receive().await, (expected, 0, 0));
            let joiners = [of_layer(1), v1::Selection { deltas: true, max_rate_hz: Some(1.0), ..Default::default() }];
            for selection in joiners {
                let update = Reader::open(&mut client, selection).await.unwrap().next().await.unwrap();
                assert_eq!((sequence(&update.map), update.skipped, update.left_out), (expected, 0, 0));
            }
        }
        next = maps;
    }
    assert!(next >= 2, "{next} maps");
    within("shutdown", running.shutdown()).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn deltas_decode_to_whole_maps_and_a_lost_one_is_followed_by_a_keyframe() {
    let running = start(config()).await;
    let mut client = plain(running.grpc.unwrap()).await;
    let every = || v1::Selection { max_in_flight: 1, ..Default::default() };
    let mut whole = Reader::open(&mut client, every()).await.unwrap();
    let mut reader = Reader::open(&mut client, v1::Selection { deltas: true, ..every() }).await.unwrap();
    let ahead = v1::Region { x_from_m: 0.0, x_to_m: 20.0, y_from_m: -8.0, y_to_m: 8.0 };
    let cut = v1::Selection { deltas: true, region: Some(ahead), ..every() };
    let mut near = Reader::open(&mut client, cut).await.unwrap();

    let limits = Limits::default();
    let (mut base, mut near_base): (Option<Map>, Option<Map>) = (None, None);
    let (mut next, mut whole_bytes, mut delta_bytes, mut near_bytes) = (0, 0, 0, 0);
    for portion in portions(8) {
        let maps = feed(&running, portion).await;
        for expected in next..maps {
            let update = whole.next().await.unwrap();
            whole.acknowledge(expected).await;
            let truth = decode_map(update.map.clone(), &limits).unwrap();
            let delta = reader.next().await.unwrap();
            assert_eq!(decode_map_on(delta.map.clone(), base.as_ref(), &limits).unwrap(), truth, "map {expected}");
            let part = near.next().await.unwrap();
            near.acknowledge(expected).await;
            let part_map = decode_map_on(part.map.clone(), near_base.as_ref(), &limits).unwrap();
            for (layer, of) in part_map.layers.iter().zip(&truth.layers) {
                assert!(layer.grid.cell_count() < of.grid.cell_count(), "{}", layer.name);
                for (x, y) in [(0.5, 0.5), (10.1, -7.9), (19.9, 7.9), (5.0, 0.0)] {
                    assert_eq!(layer.class_at(x, y), of.class_at(x, y), "{} at ({x}, {y})", layer.name);
                }
            }
            if expected > 0 {
                whole_bytes += update.map.len();
                delta_bytes += delta.map.len();
                near_bytes += part.map.len();
            }
            if expected == 3 {
                // The reader reports this map as lost; it has not acknowledged it.
                let lost = v1::WatchRequest { acknowledged: Some(expected), request_keyframe: true, selection: None };
                reader.requests.send(lost).await.unwrap();
                let again = reader.next().await.unwrap();
                assert_eq!((again.map, again.skipped, again.left_out), (update.map, 0, 0), "a whole map, at once");
            }
            reader.acknowledge(expected).await;
            (base, near_base) = (Some(truth), Some(part_map));
        }
        next = maps;
    }
    assert!(next > 5, "{next} maps");
    println!("{next} maps: whole {whole_bytes} bytes, deltas {delta_bytes}, deltas of a region {near_bytes}");
    assert!(
        delta_bytes < whole_bytes && near_bytes < delta_bytes,
        "{delta_bytes}, {near_bytes} of {whole_bytes} bytes"
    );
    within("shutdown", running.shutdown()).await.unwrap();
}

/// A server between the reader and the real server that loses one update.
struct Lossy {
    to: SocketAddr,
    lost: u64,
}

#[tonic::async_trait]
impl MapService for Lossy {
    type WatchStream = Pin<Box<dyn Stream<Item = Result<v1::MapUpdate, Status>> + Send>>;
    type WatchStatusStream = futures::stream::Empty<Result<v1::WatchStatusResponse, Status>>;

    async fn watch(
        &self,
        request: Request<Streaming<v1::WatchRequest>>,
    ) -> Result<Response<Self::WatchStream>, Status> {
        let requests = request.into_inner().filter_map(|request| ready(request.ok()));
        let updates = plain(self.to).await.watch(requests).await?.into_inner();
        let lost = self.lost;
        // An update without a map has the state of a vehicle.
        let is_kept = move |update: &v1::MapUpdate| update.map.is_empty() || sequence(&update.map) != lost;
        let kept = updates.filter(move |update| ready(update.as_ref().map_or(true, is_kept)));
        Ok(Response::new(Box::pin(kept)))
    }

    async fn get_map(&self, _: Request<v1::GetMapRequest>) -> Result<Response<v1::MapUpdate>, Status> {
        Err(Status::unimplemented("not called by this test"))
    }

    async fn watch_status(
        &self,
        _: Request<v1::WatchStatusRequest>,
    ) -> Result<Response<Self::WatchStatusStream>, Status> {
        Err(Status::unimplemented("not called by this test"))
    }

    async fn list_vehicles(
        &self,
        _: Request<v1::ListVehiclesRequest>,
    ) -> Result<Response<v1::ListVehiclesResponse>, Status> {
        Err(Status::unimplemented("not called by this test"))
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn the_client_has_the_cells_of_whole_maps_after_a_lost_delta() {
    let running = start(config()).await;
    let server = running.grpc.unwrap();
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap().to_string();
    let lossy = tonic::transport::Server::builder().add_service(MapServiceServer::new(Lossy { to: server, lost: 2 }));
    tokio::spawn(lossy.serve_with_incoming(tonic::transport::server::TcpIncoming::from(listener)));
    let client = clearway_client::Client::connect(&address).await.unwrap();
    let subscription = clearway_client::Subscription { deltas: true, max_in_flight: 4, ..Default::default() };
    let mut maps = client.subscribe(subscription).await.unwrap();
    let mut truth =
        Reader::open(&mut plain(server).await, v1::Selection { max_in_flight: 1, ..Default::default() }).await.unwrap();
    let (mut next, mut shown) = (0, Vec::new());
    for portion in portions(8) {
        let made = feed(&running, portion).await;
        for expected in next..made {
            let update = truth.next().await.unwrap();
            truth.acknowledge(expected).await;
            if expected == 2 {
                // The client cannot know of the loss yet.
                continue;
            }
            let seen = within("a map", maps.next()).await.unwrap();
            assert_eq!(seen.map.sequence(), expected, "after the loss a whole map comes at once");
            assert_eq!(seen.skipped, u64::from(expected == 3), "the lost map is counted as skipped");
            assert_eq!(seen.map.layers(), decode_map(update.map, &Limits::default()).unwrap().layers);
            shown.push(expected);
        }
        next = made;
    }
    assert!(shown.len() > 4 && shown.contains(&3), "{shown:?}");
    drop(maps);
    within("shutdown", running.shutdown()).await.unwrap();
}
