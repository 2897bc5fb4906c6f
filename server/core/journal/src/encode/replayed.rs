//! The header of a replayed map.

use clearway_proto::v1;

/// How the header of a replayed map differs from the recorded header ([`v1::Replay`]).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Replayed {
    /// What is added to the stamps, in ns.
    pub shift_ns: i64,
    /// The boot id that the map is served with.
    pub boot_id: u64,
    /// Recorded time of the map's event, as long as it is not known how far the drive's stamps are behind its events:
    /// the map's own [`lag_ns`] is added to its stamps too.
    pub first_at_ns: Option<i64>,
}

/// Time by which a map's stamp is behind its event, in ns, in whole steps of 100 ms: what is less is the map's age.
/// Ours: a third of the validity of a map.
pub fn lag_ns(at_ns: i64, capture_end_ns: i64) -> i64 {
    const STEP_NS: i64 = 100_000_000;
    let behind_ns = at_ns.saturating_sub(capture_end_ns);
    if behind_ns.abs() < STEP_NS { 0 } else { behind_ns.div_euclid(STEP_NS).saturating_mul(STEP_NS) }
}

/// Moves the stamps of a header, and states by how much.
pub(super) fn alter_header(header: &mut v1::Header, Replayed { shift_ns, boot_id, first_at_ns }: Replayed) {
    let first_ns = first_at_ns.map_or(0, |at_ns| lag_ns(at_ns, header.capture_end_ns));
    let shift_ns = shift_ns.saturating_add(first_ns);
    let stamps = [
        &mut header.capture_start_ns,
        &mut header.capture_end_ns,
        &mut header.completed_ns,
        &mut header.valid_until_ns,
    ];
    stamps.into_iter().for_each(|stamp| *stamp = stamp.saturating_add(shift_ns));
    header.replay = Some(v1::Replay { shift_ns, recorded_boot_id: header.boot_id });
    header.boot_id = boot_id;
}
