//! Plans of the planners of one vehicle -> the event queue, so that they are recorded; the newest plan -> readers.

use std::sync::{Arc, Mutex};

use bytes::Bytes;
use clearway_journal::encode::EncodedMap;
use clearway_mapping::event::Body;
use clearway_proto::plan::{self, PlanError};
use clearway_proto::v1;
use prost::Message;
use tokio::sync::watch;

use crate::base::clock::now_ns;
use crate::base::sync::locked;
use crate::base::token_bucket::TokenBucket;
use crate::ingest::drops::DropCounters;
use crate::ingest::queue::EventQueue;

/// Most plans of a vehicle at once, and each second. Ours: some planners, each with a plan a map; at their greatest
/// length they are 2.5 MiB/s of the recording.
const PLANS_MAX: u32 = 20;

/// The newest plan of one vehicle; `None` before the first.
pub type NewestPlan = Option<Arc<v1::Plan>>;

/// Why a plan is not taken.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PlanRefused {
    /// The plan cannot be drawn.
    #[error(transparent)]
    Plan(#[from] PlanError),
    /// There are too many plans.
    #[error("more than {PLANS_MAX} plans in a second: this many are allowed")]
    Rate,
    /// A queue on the way to the engine has no space, or is closed.
    #[error("the vehicle's queue is full: the engine does not keep up, or has stopped")]
    Queue,
}

/// Where the plans of one vehicle are sent, and where readers find the newest. Clones share it.
#[derive(Clone, Debug)]
pub struct Plans {
    newest: watch::Sender<NewestPlan>,
    rate: Arc<Mutex<TokenBucket>>,
    /// `None` in a replay, whose events are the recorded events: a plan is shown at once and not recorded.
    queue: Option<EventQueue>,
    drops: Arc<DropCounters>,
}

impl Plans {
    /// No plan yet. `queue` is the event queue of a live vehicle; refusals are counted in `drops`.
    pub fn new(queue: Option<EventQueue>, drops: Arc<DropCounters>) -> Self {
        let rate = Arc::new(Mutex::new(TokenBucket::new(PLANS_MAX, PLANS_MAX)));
        Self { newest: watch::Sender::new(None), rate, queue, drops }
    }

    /// Takes a plan that was sent now. A refusal is counted as `plan`.
    ///
    /// # Errors
    /// [`PlanRefused`] with what is wrong.
    pub fn send(&self, plan: &v1::Plan) -> Result<(), PlanRefused> {
        self.take(plan).inspect_err(|_| self.drops.record_refused_plan())
    }

    /// Counts a message that is no plan of this vehicle, or for which no place is left.
    pub fn refuse(&self, error: &PlanRefused) {
        tracing::debug!(%error, "a plan is refused");
        self.drops.record_refused_plan();
    }

    fn take(&self, plan: &v1::Plan) -> Result<(), PlanRefused> {
        plan::check(plan, now_ns())?;
        if !locked(&self.rate).take() {
            return Err(PlanRefused::Rate);
        }
        let Some(queue) = &self.queue else {
            self.newest.send_replace(Some(Arc::new(plan.clone())));
            return Ok(());
        };
        match queue.push_if_space(0, Body::Plan(plan.encode_to_vec().into())) {
            true => Ok(()),
            false => Err(PlanRefused::Queue),
        }
    }

    /// Shows the plan of an event in place of the plan before, its stamp moved by `shift_ns`. A recording may hold any
    /// bytes: for what is no plan no plan is shown.
    pub(super) fn publish(&self, bytes: Option<&Bytes>, shift_ns: i64) {
        let plan = bytes.and_then(|bytes| v1::Plan::decode(bytes.clone()).ok());
        let plan = plan.map(|plan| v1::Plan { stamp_ns: plan.stamp_ns.saturating_add(shift_ns), ..plan });
        self.newest.send_replace(plan.filter(|plan| plan::check(plan, plan.stamp_ns).is_ok()).map(Arc::new));
    }

    /// The newest plan, and then each newer plan.
    pub fn subscribe(&self) -> watch::Receiver<NewestPlan> {
        self.newest.subscribe()
    }

    /// The newest plan in the ego frame of a map; `None` if there is none to draw over it.
    pub fn over(&self, map: &EncodedMap) -> Option<v1::Plan> {
        let newest = self.newest.borrow().clone()?;
        let header = v1::Map::decode(map.header.clone()).ok()?.header?;
        plan::over(&newest, header.capture_end_ns, header.map_from_ego.as_ref())
    }
}
