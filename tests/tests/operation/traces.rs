//! Traces of revolutions, as a collector receives them over OTLP.

use std::collections::{BTreeMap, BTreeSet};

use clearway_proto::v1;
use opentelemetry_proto::tonic::collector::trace::v1::trace_service_server::{TraceService, TraceServiceServer};
use opentelemetry_proto::tonic::collector::trace::v1::{ExportTraceServiceRequest, ExportTraceServiceResponse};
use opentelemetry_proto::tonic::trace::v1::Span;
use prost::Message;
use tokio::sync::mpsc;
use tokio_stream::wrappers::TcpListenerStream;
use tonic::{Request, Response, Status};

use crate::fixture::{config, feed, grpc, readings, selection, start, within};

/// A collector: everything that it receives goes into the channel.
struct Collector(mpsc::UnboundedSender<ExportTraceServiceRequest>);

#[tonic::async_trait]
impl TraceService for Collector {
    async fn export(
        &self,
        request: Request<ExportTraceServiceRequest>,
    ) -> Result<Response<ExportTraceServiceResponse>, Status> {
        let _ = self.0.send(request.into_inner());
        Ok(Response::new(ExportTraceServiceResponse::default()))
    }
}

/// Starts a collector; returns its address and what it receives.
async fn collector() -> (String, mpsc::UnboundedReceiver<ExportTraceServiceRequest>) {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = format!("http://{}", listener.local_addr().unwrap());
    let (sender, received) = mpsc::unbounded_channel();
    let service = TraceServiceServer::new(Collector(sender));
    tokio::spawn(
        tonic::transport::Server::builder().add_service(service).serve_with_incoming(TcpListenerStream::new(listener)),
    );
    (address, received)
}

/// The id that a reader computes from the header of a map.
fn trace_id(header: &v1::Header) -> Vec<u8> {
    let vehicle = crc32fast::hash(header.vehicle.as_bytes());
    let sequence = header.sequence as u32;
    [&header.boot_id.to_be_bytes()[..], &vehicle.to_be_bytes(), &sequence.to_be_bytes()].concat()
}

/// What a collector received until the server ended: the spans of each trace.
fn traces(mut received: mpsc::UnboundedReceiver<ExportTraceServiceRequest>) -> BTreeMap<Vec<u8>, Vec<Span>> {
    let mut traces: BTreeMap<Vec<u8>, Vec<Span>> = BTreeMap::new();
    while let Ok(request) = received.try_recv() {
        for spans in request.resource_spans {
            let attributes = spans.resource.unwrap().attributes;
            assert!(attributes.iter().any(|attribute| attribute.key == "service.name"), "{attributes:?}");
            for span in spans.scope_spans.into_iter().flat_map(|scope| scope.spans) {
                traces.entry(span.trace_id.clone()).or_default().push(span);
            }
        }
    }
    traces
}

#[tokio::test(flavor = "multi_thread")]
async fn the_trace_of_a_map_has_every_hop_and_the_id_that_its_header_tells() {
    let (endpoint, received) = collector().await;
    let folder = tempfile::tempdir().unwrap();
    let mut config = config();
    config.recorder.file = folder.path().join("drive.mcap");
    config.traces.endpoint = endpoint;
    let running = start(config).await;
    let requests = tokio_stream::once(selection("car", &[], 0));
    let mut updates = grpc(&running).await.watch(requests).await.unwrap().into_inner();
    let maps = feed(&running, readings(4)).await;
    assert!(maps >= 3, "{maps}");
    let last = loop {
        let update = within("a map", updates.message()).await.unwrap().unwrap();
        let header = v1::Map::decode(update.map).unwrap().header.unwrap();
        if header.sequence + 1 == maps {
            break header;
        }
    };
    drop(updates);
    running.shutdown().await.unwrap();

    let traces = traces(received);
    assert_eq!(traces.len() as u64, maps, "{:?}", traces.keys());
    let spans = &traces[&trace_id(&last)];
    let names: BTreeSet<&str> = spans.iter().map(|span| span.name.as_str()).collect();
    assert_eq!(names, BTreeSet::from(["revolution", "compute", "encode", "record", "send"]), "{spans:?}");
    let root = spans.iter().find(|span| span.name == "revolution").unwrap();
    assert!(root.parent_span_id.is_empty() && root.span_id == root.trace_id[8..], "{root:?}");
    assert!(root.attributes.iter().any(|attribute| attribute.key == "vehicle"), "{root:?}");
    let hops: Vec<_> = spans.iter().filter(|span| span.name != "revolution").collect();
    assert!(hops.iter().all(|hop| hop.parent_span_id == root.span_id && hop.span_id != root.span_id), "{hops:?}");
    let hop = |name: &str| hops.iter().find(|hop| hop.name == name).unwrap();
    let (compute, encode, record) = (hop("compute"), hop("encode"), hop("record"));
    assert!(root.start_time_unix_nano <= compute.start_time_unix_nano, "{spans:?}");
    assert!(compute.start_time_unix_nano < compute.end_time_unix_nano, "{spans:?}");
    assert_eq!(compute.end_time_unix_nano, encode.start_time_unix_nano);
    assert_eq!(encode.end_time_unix_nano, root.end_time_unix_nano);
    assert!(encode.end_time_unix_nano <= record.start_time_unix_nano, "{spans:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_collector_that_never_answers_costs_no_map() {
    let silent = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let mut config = config();
    config.traces.endpoint = format!("http://{}", silent.local_addr().unwrap());
    let running = start(config).await;
    assert!(feed(&running, readings(4)).await >= 3);
    within("the end", running.shutdown()).await.unwrap();
}
