//! The recorder over zenoh: queries on `clearway/<vehicle>/recorder/{start,stop,split,save,list,status}`, for each
//! vehicle of the server. The payload is the encoded request of `clearway.v1.RecordingService`, empty for its defaults;
//! the reply is its encoded response, or an error in words.
//!
//! With roles ([`Senders`]) a query needs a certificate with the role of an operator, as over gRPC. zenoh's access
//! control refuses the others first; this check also holds if it is configured otherwise.

use clearway_proto::v1;
use prost::Message;
use tokio::task::JoinSet;
use zenoh::Session;
use zenoh::bytes::Encoding;
use zenoh::handlers::{RingChannel, RingChannelHandler};
use zenoh::query::{Query, Queryable};

use crate::record::writer::{Command, ControlError, RecorderControl};
use crate::zenoh_session::{Senders, ZenohError};

/// Greatest number of queries that wait for the recorder; the oldest of more ends without a reply. They do not delay
/// other messages.
const QUERIES_MAX: usize = 16;

/// Answers the queries on a vehicle's keys; without a recorder it refuses each.
///
/// # Errors
/// [`ZenohError`] if the keys cannot be declared.
pub async fn serve(
    session: &Session,
    vehicle: &str,
    control: Option<RecorderControl>,
    operators: Option<Senders>,
    tasks: &mut JoinSet<()>,
) -> Result<(), ZenohError> {
    let key = format!("clearway/{vehicle}/recorder/*");
    let queries = session.declare_queryable(key.clone()).complete(true).with(RingChannel::new(QUERIES_MAX));
    let queries = queries.await.map_err(ZenohError::of(format!("queryable {key}")))?;
    tasks.spawn(answer_all(queries, vehicle.to_owned(), control, operators));
    Ok(())
}

async fn answer_all(
    queries: Queryable<RingChannelHandler<Query>>,
    vehicle: String,
    control: Option<RecorderControl>,
    mut operators: Option<Senders>,
) {
    while let Ok(query) = queries.recv_async().await {
        let name = query.key_expr().as_str().rsplit('/').next().unwrap_or_default().to_owned();
        // Of a peer that looks at all keys.
        if name.contains('*') {
            continue;
        }
        let answer = answer(&query, &name, control.as_ref(), operators.as_mut()).await;
        let replied = match answer {
            Ok((message, bytes)) => {
                let encoding = Encoding::APPLICATION_PROTOBUF.with_schema(message);
                query.reply(format!("clearway/{vehicle}/recorder/{name}"), bytes).encoding(encoding).await
            }
            Err(reason) => query.reply_err(reason).encoding(Encoding::TEXT_PLAIN).await,
        };
        if let Err(error) = replied {
            tracing::debug!(%error, "zenoh: reply");
        }
    }
}

/// The name and the bytes of the response to a request; or why it is refused.
async fn answer(
    query: &Query,
    name: &str,
    control: Option<&RecorderControl>,
    operators: Option<&mut Senders>,
) -> Result<(&'static str, Vec<u8>), String> {
    let payload = query.payload().map(|payload| payload.to_bytes().into_owned()).unwrap_or_default();
    let (rpc, command) = match name {
        "start" => ("Start", Some(Command::Start)),
        "stop" => ("Stop", Some(Command::Stop)),
        "split" => ("Split", Some(Command::Split)),
        "save" => {
            let request = v1::SaveRecordingRequest::decode(&*payload);
            let v1::SaveRecordingRequest { seconds, reason } =
                request.map_err(|error| format!("no clearway.v1.SaveRecordingRequest: {error}"))?;
            ("Save", Some(Command::Save { seconds: seconds.into(), reason }))
        }
        "list" => ("List", None),
        "status" => ("Status", None),
        _ => return Err(format!("recorder/{name}: start, stop, split, save, list and status are allowed")),
    };
    if let Some(operators) = operators {
        let source = query.source_info().map(|source| source.source_id().zid());
        operators.check(&format!("/clearway.v1.RecordingService/{rpc}"), None, source).await?;
    }
    let control = control.ok_or_else(|| ControlError::NoRecorder.to_string())?;
    if name == "list" {
        let listing = control.clone();
        let parts = tokio::task::spawn_blocking(move || listing.list()).await.map_err(|error| error.to_string())?;
        return Ok(("clearway.v1.ListRecordingsResponse", v1::ListRecordingsResponse { parts }.encode_to_vec()));
    }
    let response = match command {
        Some(command) => control.send(command).await.map_err(|error| error.to_string())?,
        None => control.status(),
    };
    Ok(("clearway.v1.RecordingResponse", response.encode_to_vec()))
}
