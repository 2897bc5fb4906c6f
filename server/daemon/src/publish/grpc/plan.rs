//! `clearway.v1.PlanService`: plans of planners -> the vehicle's event queue, or a status with what is wrong.

use clearway_proto::limits::PLAN_BYTES_MAX;
use clearway_proto::v1;
use tonic::{Request, Response, Status};
use v1::plan_service_server::{PlanService, PlanServiceServer};

use crate::engine::plans::PlanRefused;
use crate::publish::listen::access::caller;
use crate::publish::served::Vehicles;

/// `clearway.v1.PlanService`, which takes plans of planners.
pub(super) struct Planners {
    vehicles: Vehicles,
}

/// The service as tonic serves it. It refuses a message that is too long before it allocates memory for it.
pub(super) fn service(vehicles: Vehicles) -> PlanServiceServer<Planners> {
    PlanServiceServer::new(Planners { vehicles }).max_decoding_message_size(PLAN_BYTES_MAX)
}

#[tonic::async_trait]
impl PlanService for Planners {
    async fn send(&self, request: Request<v1::Plan>) -> Result<Response<v1::SendPlanResponse>, Status> {
        let (caller, plan) = (caller(&request), request.into_inner());
        let served = self.vehicles.find(&plan.vehicle)?;
        caller.check_vehicle(&served.status.name)?;
        match served.wires.plans.send(&plan) {
            Ok(()) => Ok(Response::new(v1::SendPlanResponse {})),
            Err(refused @ PlanRefused::Plan(_)) => Err(Status::invalid_argument(refused.to_string())),
            Err(refused @ (PlanRefused::Rate | PlanRefused::Queue)) => {
                Err(Status::resource_exhausted(refused.to_string()))
            }
        }
    }
}
