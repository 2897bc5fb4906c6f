//! `clearway.v1.ReplayService`: requests of clients -> the replay that the server serves, and its state.

use std::pin::Pin;
use std::time::Duration;

use clearway_proto::v1;
use futures::{Stream, stream};
use tonic::{Request, Response, Status};
use v1::replay_service_server::ReplayService;

use super::super::listen::access::{Caller, caller};
use crate::replay_control::ReplayHandle;

/// Least time between two states of a stream.
const PERIOD: Duration = Duration::from_millis(100);

/// The service of one replay.
pub(super) struct Replay(pub ReplayHandle);

impl Replay {
    /// Checks that a client may reach every vehicle of the replay: all have one time.
    fn check_vehicles(&self, caller: &Caller) -> Result<(), Status> {
        self.0.state().borrow().vehicles.iter().try_for_each(|vehicle| caller.check_vehicle(vehicle))
    }
}

#[tonic::async_trait]
impl ReplayService for Replay {
    type WatchStateStream = Pin<Box<dyn Stream<Item = Result<v1::ReplayState, Status>> + Send>>;

    async fn control(&self, request: Request<v1::ReplayControl>) -> Result<Response<v1::ReplayState>, Status> {
        self.check_vehicles(&caller(&request))?;
        Ok(Response::new(self.0.control(request.into_inner()).await?))
    }

    async fn watch_state(
        &self,
        request: Request<v1::WatchStateRequest>,
    ) -> Result<Response<Self::WatchStateStream>, Status> {
        self.check_vehicles(&caller(&request))?;
        let mut state = self.0.state();
        state.mark_changed();
        let states = stream::unfold((state, false), |(mut state, waits)| async move {
            if waits {
                tokio::time::sleep(PERIOD).await;
            }
            // Fails when the replay is over.
            state.changed().await.ok()?;
            let now = state.borrow_and_update().clone();
            Some((Ok(now), (state, true)))
        });
        Ok(Response::new(Box::pin(states)))
    }
}
