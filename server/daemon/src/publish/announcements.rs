//! Announcements over zenoh: the key `clearway/@fleet/<run of the server, hexadecimal>/<vehicle>`, an encoded
//! [`v1::Vehicle`]. The key has the run in it, so that two servers that claim one vehicle are told apart. Keys with `*`
//! and `**` do not match `@fleet`: readers of maps do not receive announcements.

use std::time::{Duration, Instant};

use clearway_proto::v1;
use prost::Message;
use tokio::task::JoinSet;
use zenoh::Session;
use zenoh::bytes::Encoding;
use zenoh::pubsub::Subscriber;
use zenoh::qos::Priority;
use zenoh::sample::{Locality, SampleKind};

use super::served::Vehicles;
use crate::base::token_bucket::TokenBucket;
use crate::fleet::Fleet;
use crate::zenoh_session::{ZenohError, declare_publisher};

/// Time between two announcements of a vehicle.
const PERIOD: Duration = Duration::from_secs(1);
/// The keys of all announcements.
const ALL: &str = "clearway/@fleet/*/*";

/// Announces the vehicles of this server until the tasks end, each with the `address` at which its maps are served over
/// gRPC and the URL of the `page`; they are empty if others cannot reach them. Returns the keys of the announcements,
/// to [`take_back`] when the server ends.
///
/// # Errors
/// [`ZenohError`] if a publisher cannot be declared.
pub(crate) async fn announce(
    session: &Session,
    vehicles: &Vehicles,
    (address, page): (&str, &str),
    tasks: &mut JoinSet<()>,
) -> Result<Vec<String>, ZenohError> {
    let mut keys = Vec::new();
    for served in vehicles.0.iter() {
        let key = format!("clearway/@fleet/{:016x}/{}", served.status.boot_id, served.status.name);
        keys.push(key.clone());
        let publisher = declare_publisher(session, key, Encoding::APPLICATION_PROTOBUF, Priority::DataLow).await?;
        let (status, address, page) = (served.status.clone(), address.to_owned(), page.to_owned());
        tasks.spawn(async move {
            let mut every = tokio::time::interval(PERIOD);
            loop {
                every.tick().await;
                let vehicle = v1::Vehicle { grpc: address.clone(), page: page.clone(), ..status.to_proto() };
                if let Err(error) = publisher.put(vehicle.encode_to_vec()).await {
                    tracing::warn!(%error, vehicle = %status.name, "zenoh: announcement");
                }
            }
        });
    }
    Ok(keys)
}

/// Takes announcements back, by their keys: the vehicles of a server that ends are in no list.
pub(crate) async fn take_back(session: &Session, keys: &[String]) {
    for key in keys {
        if let Err(error) = session.delete(key).await {
            tracing::warn!(%error, key, "zenoh: announcement");
        }
    }
}

/// Hears the announcements of other servers until the subscriber is dropped, and notes who claims one of `vehicles`.
/// Refused announcements are logged, at most one a second.
///
/// # Errors
/// [`ZenohError`] if the subscriber cannot be declared.
pub(crate) async fn hear(session: &Session, fleet: Fleet, vehicles: Vehicles) -> Result<Subscriber<()>, ZenohError> {
    let mut lines = TokenBucket::new(1, 1);
    session
        .declare_subscriber(ALL)
        .allowed_origin(Locality::Remote)
        .callback_mut(move |sample| {
            if sample.kind() == SampleKind::Delete {
                let mut parts = sample.key_expr().rsplit('/');
                let (vehicle, run) = (parts.next().unwrap_or_default(), parts.next().unwrap_or_default());
                return fleet.forget(vehicle, u64::from_str_radix(run, 16).unwrap_or_default());
            }
            match fleet.hear(&sample.payload().to_bytes(), Instant::now()) {
                Ok(claim) => {
                    let own = vehicles.0.iter().find(|served| *served.status.name == *claim.vehicle);
                    own.inspect(|served| served.status.note_claim(claim.boot_id, &claim.server));
                }
                Err(error) if lines.take() => {
                    tracing::warn!(%error, key = %sample.key_expr(), "zenoh: announcement refused");
                }
                Err(_) => {}
            }
        })
        .await
        .map_err(ZenohError::of(format!("subscriber {ALL}")))
}
