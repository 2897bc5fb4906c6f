//! The gRPC client with a scripted service in this process.

use std::pin::Pin;
use std::sync::Mutex;

use clearway_client::v1::map_service_server::{MapService, MapServiceServer};
use clearway_client::{Client, ClientError, Subscription, Tls, v1};
use clearway_proto::codec::Limits;
use clearway_proto::delta::encode_delta;
use clearway_proto::map::{encode_header, encode_layer};
use futures::{Stream, stream};
use prost::Message;
use tokio::sync::mpsc;
use tonic::{Request, Response, Status, Streaming};

use crate::common::{CAPTURE_END_NS, map};

type Updates = Vec<Result<v1::MapUpdate, Status>>;

/// A service that sends returned updates and forwards every request to the test.
struct Script {
    updates: Mutex<Updates>,
    requests: mpsc::UnboundedSender<v1::WatchRequest>,
}

#[tonic::async_trait]
impl MapService for Script {
    type WatchStream = Pin<Box<dyn Stream<Item = Result<v1::MapUpdate, Status>> + Send>>;
    type WatchStatusStream = futures::stream::Empty<Result<v1::WatchStatusResponse, Status>>;

    async fn watch(
        &self,
        request: Request<Streaming<v1::WatchRequest>>,
    ) -> Result<Response<Self::WatchStream>, Status> {
        let mut requests = request.into_inner();
        let received = self.requests.clone();
        tokio::spawn(async move {
            while let Ok(Some(request)) = requests.message().await {
                let _ = received.send(request);
            }
        });
        let updates = std::mem::take(&mut *self.updates.lock().unwrap());
        Ok(Response::new(Box::pin(stream::iter(updates))))
    }

    async fn get_map(&self, request: Request<v1::GetMapRequest>) -> Result<Response<v1::MapUpdate>, Status> {
        match request.into_inner().vehicle.as_str() {
            "alpha" => Ok(Response::new(v1::MapUpdate { map: map(9, CAPTURE_END_NS), ..Default::default() })),
            other => Err(Status::not_found(format!("no vehicle {other:?}; there is alpha"))),
        }
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
        let alpha = v1::Vehicle { name: "alpha".into(), maps: 10, ..Default::default() };
        Ok(Response::new(v1::ListVehiclesResponse { vehicles: vec![alpha] }))
    }
}

async fn serve(updates: Updates) -> (String, mpsc::UnboundedReceiver<v1::WatchRequest>) {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap().to_string();
    let (requests, received) = mpsc::unbounded_channel();
    let service = MapServiceServer::new(Script { updates: Mutex::new(updates), requests });
    let incoming = tonic::transport::server::TcpIncoming::from(listener);
    tokio::spawn(tonic::transport::Server::builder().add_service(service).serve_with_incoming(incoming));
    (address, received)
}

fn update(sequence: u64, skipped: u64) -> Result<v1::MapUpdate, Status> {
    Ok(v1::MapUpdate { map: map(sequence, CAPTURE_END_NS), skipped, ..Default::default() })
}

#[tokio::test]
async fn every_map_is_acknowledged_and_skipped_maps_are_counted() {
    let (address, mut received) = serve(vec![update(0, 0), update(3, 2), update(4, 0)]).await;
    let client = Client::connect(&address).await.unwrap();
    let layers = vec!["drivability".to_string()];
    let mut maps = client.subscribe(Subscription { layers: layers.clone(), ..Default::default() }).await.unwrap();
    let selection = received.recv().await.unwrap().selection.unwrap();
    assert_eq!(selection, v1::Selection { layers, max_in_flight: 2, states: true, ..Default::default() });
    for sequence in [0, 3, 4] {
        assert_eq!(received.recv().await.unwrap().acknowledged, Some(sequence));
    }
    // Every map is either returned or counted, whatever the timing of the reader and the updates.
    let (mut returned, mut skipped, mut newest) = (0, 0, None);
    let ended = loop {
        match maps.next().await {
            Ok(update) => {
                returned += 1;
                skipped += update.skipped;
                newest = Some(update.map.sequence());
            }
            Err(error) => break error,
        }
    };
    assert!(matches!(ended, ClientError::Ended { .. }), "{ended}");
    assert_eq!(newest, Some(4));
    assert!(returned >= 1 && returned + skipped <= 5, "{returned} returned, {skipped} skipped of 5");
    assert_eq!(maps.newest().unwrap().sequence(), 4);
}

/// Map `sequence` as a delta to map `base_sequence`.
fn delta(sequence: u64, base_sequence: u64) -> Result<v1::MapUpdate, Status> {
    let [base, map] = [base_sequence, sequence].map(|sequence| v1::Map::decode(map(sequence, CAPTURE_END_NS)).unwrap());
    let layer = encode_delta(&base.layers[0], base_sequence, &map.layers[0], &Limits::default())
        .expect("a delta without changes is small");
    let bytes = [encode_header(&map.header.unwrap()), encode_layer(&layer)].concat();
    Ok(v1::MapUpdate { map: bytes.into(), ..Default::default() })
}

#[tokio::test]
async fn a_lost_update_requests_a_keyframe_and_gives_no_wrong_cell() {
    // Map 1 is lost; map 3 is already in flight when the server gets the request.
    let (address, mut received) = serve(vec![update(0, 0), delta(2, 1), delta(3, 2), update(4, 0), delta(5, 4)]).await;
    let client = Client::connect(&address).await.unwrap();
    let mut maps = client.subscribe(Subscription { deltas: true, ..Default::default() }).await.unwrap();
    assert!(received.recv().await.unwrap().selection.unwrap().deltas);
    for (sequence, request_keyframe) in [(0, false), (2, true), (3, false), (4, false), (5, false)] {
        let request = received.recv().await.unwrap();
        assert_eq!((request.acknowledged, request.request_keyframe), (Some(sequence), request_keyframe));
    }
    let (mut returned, mut skipped) = (Vec::new(), 0);
    while let Ok(update) = maps.next().await {
        let layer = update.map.layer("drivability").unwrap();
        assert_eq!(layer.class_at(10.0, -10.0), (3, "obstacle"));
        returned.push(update.map.sequence());
        skipped += update.skipped;
    }
    assert!(returned.iter().all(|sequence| [0, 4, 5].contains(sequence)), "{returned:?}");
    assert_eq!(returned.last(), Some(&5));
    assert_eq!(returned[0] + returned.len() as u64 + skipped, 6, "{returned:?}, and {skipped} skipped");
}

#[tokio::test]
async fn an_unrequested_delta_without_its_base_requests_a_keyframe() {
    let (address, mut received) = serve(vec![delta(2, 1), update(3, 0)]).await;
    let client = Client::connect(&address).await.unwrap();
    let mut maps = client.subscribe(Subscription::default()).await.unwrap();
    received.recv().await.unwrap();
    assert!(received.recv().await.unwrap().request_keyframe);
    assert_eq!(maps.next().await.unwrap().map.sequence(), 3);
}

#[tokio::test]
async fn an_invalid_map_ends_the_stream() {
    let corrupt = v1::MapUpdate { map: map(1, CAPTURE_END_NS).slice(..100), ..Default::default() };
    let (address, _received) = serve(vec![Ok(corrupt)]).await;
    let client = Client::connect(&address).await.unwrap();
    let mut maps = client.subscribe(Subscription::default()).await.unwrap();
    let error = maps.next().await.unwrap_err();
    assert!(matches!(error, ClientError::Map(_)), "{error}");
    assert!(maps.newest().is_none());
}

#[tokio::test]
async fn an_error_contains_the_message_of_the_server() {
    let (address, _received) = serve(vec![Err(Status::unavailable("the vehicle's engine has stopped"))]).await;
    let client = Client::connect(&format!("http://{address}")).await.unwrap();
    assert_eq!(client.vehicles().await.unwrap()[0].name, "alpha");
    assert_eq!(client.newest("alpha", &[]).await.unwrap().sequence(), 9);
    let error = client.newest("beta", &[]).await.unwrap_err().to_string();
    assert!(error.contains("no vehicle \"beta\"; there is alpha (NotFound)"), "{error}");
    let mut maps = client.subscribe(Subscription::default()).await.unwrap();
    let error = maps.next().await.unwrap_err().to_string();
    assert!(error.contains("the vehicle's engine has stopped (Unavailable)"), "{error}");
}

#[tokio::test]
async fn an_invalid_address_is_refused_with_what_is_allowed() {
    for address in ["localhost", "localhost:", ":50051", "localhost:70000", "https://localhost:1", "a b:1"] {
        let error = Client::connect(address).await.unwrap_err();
        assert!(matches!(error, ClientError::Address { .. }), "{address}: {error}");
        assert!(error.to_string().contains("HOST:PORT or http://HOST:PORT is allowed"), "{error}");
    }
    let identity = Some(("no certificate".into(), "no key".into()));
    let error = Client::connect_tls("localhost:1", &Tls { identity, ..Tls::default() }).await.unwrap_err();
    assert!(matches!(&error, ClientError::Certificate { .. }) && !error.to_string().contains("HOST:PORT"), "{error}");
    let closed = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap().local_addr().unwrap();
    let error = Client::connect(&closed.to_string()).await.unwrap_err();
    assert!(error.to_string().starts_with("no clearway server answers at http://127.0.0.1:"), "{error}");
}
