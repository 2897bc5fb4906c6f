//! The reasons that metrics show with 0 before they occur, so that the first occurrence is a rise.

/// Reasons for which packets and scans are refused; each has a series before it occurs, so that a rate is known then.
pub const PACKET_REASONS: [&str; 20] = [
    "azimuth",
    "block_flag",
    "calibration",
    "device_time",
    "duplicate",
    "late",
    "length",
    "model",
    "nmea",
    "no_returns",
    "observation",
    "scan_far",
    "scan_lengths",
    "scan_model",
    "scan_offset",
    "sensor",
    "source",
    "stamp",
    "stamp_range",
    "telemetry",
];
/// Reasons for which messages are no observations.
pub const OBSERVATION_REASONS: [&str; 19] = [
    "body",
    "columns",
    "key",
    "message",
    "message_length",
    "missing",
    "number",
    "packed",
    "packets",
    "plan",
    "points",
    "role",
    "ros_frame",
    "ros_kind",
    "ros_message",
    "ros_part",
    "ros_type",
    "sensor",
    "stamp_ahead",
];
/// Reasons for which a listener refuses or closes connections and calls.
pub const CLOSE_REASONS: [&str; 16] = [
    "accept_error",
    "calls",
    "certificate_end",
    "denied",
    "flood",
    "handshake",
    "handshake_timeout",
    "http2",
    "idle",
    "made_room",
    "no_request",
    "over_limit",
    "role_lost",
    "stalled",
    "streams",
    "unknown_vehicle",
];
/// Reasons for which announcements of other servers are refused.
pub const ANNOUNCEMENT_REASONS: [&str; 2] = ["full", "invalid"];
