//! The events of a recording -> the plans of the vehicle's planners.

use clearway_client::v1;
use clearway_journal::mcap_reader::Message;
use clearway_proto::plan;
use prost::Message as _;

/// The plan of an event of a journal; `None` for other events, and for a plan that cannot be drawn.
pub fn plan_of(message: &Message) -> Option<v1::Plan> {
    message.journal_of()?;
    match v1::Event::decode(message.data.clone()).ok()?.body? {
        v1::event::Body::Plan(plan) if plan::check(&plan, plan.stamp_ns).is_ok() => Some(*plan),
        _ => None,
    }
}
