//! Traces of revolutions, sent to a collector over OTLP (OpenTelemetry): where the time of one map went.
//!
//! | span | from -> to | process |
//! |---|---|---|
//! | `revolution` | end of capture -> the map is published | the root |
//! | `receive` | end of capture -> arrival of the event that completed the map | sockets |
//! | `wait` | arrival -> the pipeline begins with the event | event queue |
//! | `compute` | -> the map | engine |
//! | `encode` | -> its bytes | engine |
//! | `record` | the recorder begins to write the map -> it is written | recorder |
//! | `send` | a publisher begins with the map -> it has handed it on; attribute `transport` | publishers |
//!
//! The id of a trace is computed from the map's header ([`trace_id`]), so a reader of the map finds its trace, and a
//! planner can add spans of its own. Without a collector nothing is made.

use std::cell::Cell;
use std::time::{Duration, SystemTime};

use opentelemetry::trace::{
    Span, SpanContext, SpanId, TraceContextExt, TraceFlags, TraceId, TraceState, Tracer, TracerProvider,
};
use opentelemetry::{Context, KeyValue};
use opentelemetry_otlp::{ExporterBuildError, SpanExporter, WithExportConfig};
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::trace::{IdGenerator, RandomIdGenerator, SdkTracer, SdkTracerProvider};

use crate::config;
use clearway_journal::encode::EncodedMap;

/// Longest time in which the last spans are sent at shutdown. Ours: less than what the publishers have.
const SHUTDOWN_TIMEOUT: Duration = Duration::from_secs(1);

/// Makes the traces of one server; a clone makes the same. The default makes none.
#[derive(Clone, Debug, Default)]
pub struct Traces(Option<Exporting>);

#[derive(Clone, Debug)]
struct Exporting {
    tracer: SdkTracer,
    provider: SdkTracerProvider,
}

impl Traces {
    /// Starts to send traces to the collector of `[traces]`; without an endpoint there are none. Needs a tokio runtime.
    ///
    /// # Errors
    /// [`ExporterBuildError`] if the endpoint is no address. A collector that does not answer is no error: its spans
    /// are lost and the log says so.
    pub fn start(options: &config::Traces, boot_id: u64) -> Result<Self, ExporterBuildError> {
        if options.endpoint.is_empty() {
            return Ok(Self::default());
        }
        let exporter = SpanExporter::builder().with_tonic().with_endpoint(&options.endpoint).build()?;
        let instance = KeyValue::new("service.instance.id", format!("{boot_id:016x}"));
        let provider = SdkTracerProvider::builder()
            .with_batch_exporter(exporter)
            .with_id_generator(RootIds::default())
            .with_resource(Resource::builder().with_service_name("clearway").with_attribute(instance).build())
            .build();
        Ok(Self(Some(Exporting { tracer: provider.tracer("clearway"), provider })))
    }

    /// Traces a map that has just been published, and the stages until then that are known: in the queue, computed,
    /// encoded, and in all since the end of capture.
    pub fn published(&self, map: &EncodedMap, stages: StageTimes) {
        let Some(exporting) = &self.0 else { return };
        let StageTimes { receive: waited, map: computed, encode: encoded, total: age } = stages;
        let end = SystemTime::now();
        let encode = before(end, encoded);
        let compute = before(encode, computed);
        let wait = before(compute, waited);
        let capture_end = age.map_or(wait, |age| before(end, Some(age)).min(wait));
        let mut root = exporting.root(map, capture_end);
        root.set_attribute(KeyValue::new("vehicle", map.vehicle.to_string()));
        root.set_attribute(KeyValue::new("sequence", i64::try_from(map.sequence).unwrap_or(i64::MAX)));
        root.set_attribute(KeyValue::new("bytes", i64::try_from(map.bytes()).unwrap_or(i64::MAX)));
        root.end_with_timestamp(end);
        let stages = [
            ("receive", age.is_some() && waited.is_some(), capture_end, wait),
            ("wait", waited.is_some(), wait, compute),
            ("compute", computed.is_some(), compute, encode),
            ("encode", encoded.is_some(), encode, end),
        ];
        for (name, _, from, to) in stages.into_iter().filter(|(_, is_known, ..)| *is_known) {
            exporting.child(map, name, from, Vec::new()).end_with_timestamp(to);
        }
    }

    /// Begins the span of a hop after the publication; it ends when the value is dropped.
    pub fn hop(&self, map: &EncodedMap, name: &'static str, transport: Option<&'static str>) -> Hop {
        let attributes = transport.map(|transport| KeyValue::new("transport", transport)).into_iter().collect();
        let span = self.0.as_ref().map(|exporting| exporting.child(map, name, SystemTime::now(), attributes));
        Hop { _span: span.map(Box::new) }
    }

    /// Sends what is not sent yet, for at most a second. Blocks.
    pub fn end(self) {
        if let Some(Err(error)) = self.0.map(|exporting| exporting.provider.shutdown_with_timeout(SHUTDOWN_TIMEOUT)) {
            tracing::warn!(%error, "the last traces are lost");
        }
    }
}

/// Time that a map took in each stage, in the order of the data's way; `None` where it is not known, as for data of a
/// recording.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct StageTimes {
    /// From the arrival of the map's event until the engine took it.
    pub receive: Option<Duration>,
    /// Computation of the map by the engine.
    pub map: Option<Duration>,
    /// Encoding of the map for readers.
    pub encode: Option<Duration>,
    /// From the end of the capture until the publication.
    pub total: Option<Duration>,
}

impl StageTimes {
    /// Names of the stages, in the order of [`StageTimes::in_order`].
    pub const NAMES: [&str; 4] = ["receive", "map", "encode", "total"];

    /// The times by stage.
    pub fn in_order(self) -> [Option<Duration>; Self::NAMES.len()] {
        [self.receive, self.map, self.encode, self.total]
    }
}

/// A hop of a traced map; ends when it is dropped.
#[must_use]
pub struct Hop {
    _span: Option<Box<opentelemetry_sdk::trace::Span>>,
}

impl Exporting {
    fn root(&self, map: &EncodedMap, start: SystemTime) -> opentelemetry_sdk::trace::Span {
        ROOT.set(Some((trace_id(map), root_id(map))));
        self.tracer.span_builder("revolution").with_start_time(start).start_with_context(&self.tracer, &Context::new())
    }

    fn child(
        &self,
        map: &EncodedMap,
        name: &'static str,
        start: SystemTime,
        attributes: Vec<KeyValue>,
    ) -> opentelemetry_sdk::trace::Span {
        let state = TraceState::default();
        let parent = SpanContext::new(trace_id(map), root_id(map), TraceFlags::SAMPLED, false, state);
        let builder = self.tracer.span_builder(name).with_start_time(start).with_attributes(attributes);
        builder.start_with_context(&self.tracer, &Context::new().with_remote_span_context(parent))
    }
}

/// The id of a map's trace: boot id (64 bits), CRC-32 of the vehicle's name (32), low 32 bits of the sequence.
pub fn trace_id(map: &EncodedMap) -> TraceId {
    let vehicle = crc32fast::hash(map.vehicle.as_bytes());
    let low = u64::from(vehicle) << 32 | map.sequence & u64::from(u32::MAX);
    TraceId::from(u128::from(map.boot_id) << 64 | u128::from(low))
}

/// The id of the root: the low half of the trace's, which is 0 only for an empty name.
fn root_id(map: &EncodedMap) -> SpanId {
    let bytes = trace_id(map).to_bytes();
    SpanId::from_bytes(bytes[8..].try_into().expect("half of 16 bytes"))
}

fn before(time: SystemTime, span: Option<Duration>) -> SystemTime {
    time.checked_sub(span.unwrap_or_default()).unwrap_or(time)
}

thread_local! {
    /// The ids of the root that this thread is about to make.
    static ROOT: Cell<Option<(TraceId, SpanId)>> = const { Cell::new(None) };
}

/// Gives a root the ids of its map, and every other span a random one.
#[derive(Debug, Default)]
struct RootIds(RandomIdGenerator);

impl IdGenerator for RootIds {
    fn new_trace_id(&self) -> TraceId {
        ROOT.take().map_or_else(|| self.0.new_trace_id(), |(trace, _)| trace)
    }

    // The tracer asks for the span's id first.
    fn new_span_id(&self) -> SpanId {
        ROOT.get().map_or_else(|| self.0.new_span_id(), |(_, span)| span)
    }
}
