//! `clearway get` reads the newest map of a scripted service.

use std::pin::Pin;

use clearway_client::{now_ns, v1};
use clearway_proto::v1::map_service_server::{MapService, MapServiceServer};
use futures::Stream;
use prost::Message;
use serde_json::Value;
use tonic::{Request, Response, Status, Streaming};

use crate::common::{CAPTURE_END_NS, clearway, map, text};

/// A service that has one map for each of two vehicles: `alpha` captured it years ago, `fresh` captures it now.
struct TwoVehicles;

/// A map that stays valid for an hour.
fn fresh_map() -> Vec<u8> {
    let now = now_ns();
    let mut map = v1::Map::decode(map(7, now)).unwrap();
    map.header.as_mut().unwrap().valid_until_ns = now + 3_600_000_000_000;
    map.encode_to_vec()
}

#[tonic::async_trait]
impl MapService for TwoVehicles {
    type WatchStream = Pin<Box<dyn Stream<Item = Result<v1::MapUpdate, Status>> + Send>>;
    type WatchStatusStream = futures::stream::Empty<Result<v1::WatchStatusResponse, Status>>;

    async fn watch(&self, _: Request<Streaming<v1::WatchRequest>>) -> Result<Response<Self::WatchStream>, Status> {
        Err(Status::unimplemented("get does not watch"))
    }

    async fn get_map(&self, request: Request<v1::GetMapRequest>) -> Result<Response<v1::MapUpdate>, Status> {
        let map = match request.into_inner().vehicle.as_str() {
            "fresh" => fresh_map().into(),
            _ => map(7, CAPTURE_END_NS),
        };
        Ok(Response::new(v1::MapUpdate { map, ..Default::default() }))
    }

    async fn watch_status(
        &self,
        _: Request<v1::WatchStatusRequest>,
    ) -> Result<Response<Self::WatchStatusStream>, Status> {
        Err(Status::unimplemented("get watches no status"))
    }

    async fn list_vehicles(
        &self,
        _: Request<v1::ListVehiclesRequest>,
    ) -> Result<Response<v1::ListVehiclesResponse>, Status> {
        Err(Status::unimplemented("get lists no vehicles"))
    }
}

/// Runs `clearway get` with these options; returns its output.
fn get(options: &[&str]) -> String {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap();
    let listener = runtime.block_on(tokio::net::TcpListener::bind("127.0.0.1:0")).unwrap();
    let address = listener.local_addr().unwrap().to_string();
    let _context = runtime.enter();
    let incoming = tonic::transport::server::TcpIncoming::from(listener);
    let service = MapServiceServer::new(TwoVehicles);
    runtime.spawn(tonic::transport::Server::builder().add_service(service).serve_with_incoming(incoming));
    let output = clearway(&[&["get", "--server", &address], options].concat());
    let is_stale = !options.contains(&"fresh");
    assert_eq!(output.status.code(), Some(if is_stale { 4 } else { 0 }), "{}", text(&output.stderr));
    text(&output.stdout)
}

#[test]
fn a_stale_map_is_called_stale_and_a_fresh_one_is_not() {
    let stale = get(&[]);
    assert!(
        stale.lines().next().unwrap().starts_with("alpha #000007  age ") && stale.contains("ms  STALE\n"),
        "{stale}"
    );
    let fresh = get(&["--vehicle", "fresh"]);
    assert!(!fresh.contains("STALE"), "{fresh}");
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("newest.png");
    let written = get(&["--out", file.to_str().unwrap()]);
    assert!(written.contains("ms old, STALE, written to") && file.exists(), "{written}");
}

#[test]
fn the_share_of_each_class_and_the_metrics_are_printed() {
    let printed = get(&[]);
    assert!(printed.contains("layer drivability: 3 rows, 4 columns"), "{printed}");
    // Of twelve cells three are unknown, five drivable, three not, and one has an obstacle.
    for (class, share) in [("unknown", "25.0"), ("drivable", "41.7"), ("not_drivable", "25.0"), ("obstacle", "8.3")] {
        let line = printed.lines().find(|line| line.split_whitespace().next() == Some(class));
        assert!(line.is_some_and(|line| line.contains(&format!(" {share} %"))), "{class}: {printed}");
    }
    assert!(printed.contains("drivable_share 0.625"), "{printed}");
}

#[test]
fn json_has_the_state_of_the_map() {
    let document: Value = serde_json::from_str(&get(&["--json"])).unwrap();
    assert_eq!((&document["sequence"], &document["stale"]), (&7.into(), &true.into()));
    assert_eq!((&document["layer"], &document["legend"][1]), (&"drivability".into(), &"drivable".into()));
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("class.npy");
    let options = ["--vehicle", "fresh", "--json", "--out", file.to_str().unwrap()];
    let written: Value = serde_json::from_str(&get(&options)).unwrap();
    assert_eq!((&written["stale"], &written["file"]), (&false.into(), &file.to_str().unwrap().into()));
    assert!(file.exists());
}
