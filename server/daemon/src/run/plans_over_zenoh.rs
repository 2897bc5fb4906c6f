//! Plans over zenoh: `clearway/<vehicle>/plan` -> the vehicle's event queue. Who plans learns of no refusal here; it is
//! counted in the status.
//!
//! With roles ([`Senders`]) a sample needs a certificate with the role of an ingester, as over gRPC.

use std::sync::Arc;

use clearway_proto::limits::PLAN_BYTES_MAX;
use clearway_proto::plan::PlanError;
use clearway_proto::v1;
use prost::Message;
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use zenoh::Session;
use zenoh::sample::{Locality, Sample, SampleKind};

use crate::engine::plans::PlanRefused;
use crate::publish::Served;
use crate::zenoh_session::{Senders, ZenohError};

/// Most plans of a vehicle that wait to be read; more are refused. Ours: as many as are taken at once.
const PLANS_MAX: usize = 20;

/// Takes the plans of a vehicle in a task of its own. Without `senders` every peer may send.
///
/// # Errors
/// [`ZenohError`] if the key cannot be declared.
pub(super) async fn take(
    session: &Session,
    served: &Served,
    mut senders: Option<Senders>,
    tasks: &mut JoinSet<()>,
) -> Result<(), ZenohError> {
    let (vehicle, plans) = (served.status.name.clone(), served.wires.plans.clone());
    let key = format!("clearway/{vehicle}/plan");
    let (waiting, mut samples) = mpsc::channel::<Sample>(PLANS_MAX);
    let refused = plans.clone();
    let subscriber = session.declare_subscriber(key.clone()).allowed_origin(Locality::Remote).callback(move |sample| {
        waiting.try_send(sample).unwrap_or_else(|_| refused.refuse(&PlanRefused::Queue));
    });
    let subscriber = subscriber.await.map_err(ZenohError::of(format!("subscribe to {key}")))?;
    tasks.spawn(async move {
        let _subscriber = subscriber;
        while let Some(sample) = samples.recv().await {
            let source = sample.source_info().map(|source| source.source_id().zid());
            let checked = match &mut senders {
                Some(senders) => senders.check("/clearway.v1.PlanService/Send", Some(&vehicle), source).await,
                None => Ok(()),
            };
            match checked.map_err(|reason| PlanError::Message { reason }).and_then(|()| decode(&sample, &vehicle)) {
                // A refusal is counted.
                Ok(plan) => _ = plans.send(&plan),
                Err(error) => plans.refuse(&error.into()),
            }
        }
    });
    Ok(())
}

fn decode(sample: &Sample, vehicle: &Arc<str>) -> Result<v1::Plan, PlanError> {
    let bytes = sample.payload().len();
    if sample.kind() != SampleKind::Put || bytes > PLAN_BYTES_MAX {
        return Err(PlanError::Length { field: "plan", bytes, bytes_max: PLAN_BYTES_MAX });
    }
    let plan = v1::Plan::decode(&*sample.payload().to_bytes());
    let plan = plan.map_err(|error| PlanError::Message { reason: error.to_string() })?;
    match plan.vehicle.is_empty() || *plan.vehicle == **vehicle {
        true => Ok(plan),
        false => Err(PlanError::Vehicle { vehicle: plan.vehicle, expected: vehicle.to_string() }),
    }
}
