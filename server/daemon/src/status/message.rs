//! The status of a vehicle -> a message of the wire, and JSON.

use std::collections::BTreeMap;
use std::sync::OnceLock;

use clearway_mapping::ledger::Ledger;
use clearway_mapping::sensor::mount::check::MountDeviation;
use clearway_proto::v1;
use serde_json::{Value, json};

use super::json::vehicle_json;
use super::transports::Transport;
use super::vehicle::{VehicleStatus, packet_counts};
use crate::base::clock::now_ns;
use crate::base::sync::locked;
use crate::ingest::drops::UnknownSender;

impl VehicleStatus {
    /// The status as a message of the wire.
    pub fn to_proto(&self) -> v1::Vehicle {
        let (snapshot, assessment) = (self.snapshot(), self.assess());
        let (sensors, pose, validity) = {
            let changing = locked(&self.changing);
            (changing.states.clone(), changing.pose, changing.validity)
        };
        v1::Vehicle {
            name: self.name.to_string(),
            boot_id: self.boot_id,
            layers: self.layers.iter().map(|&layer| layer.to_owned()).collect(),
            maps: snapshot.maps,
            newest_capture_end_ns: snapshot.newest_capture_end_ns,
            sensors,
            ledger: Some(ledger(&snapshot.ledger, packet_counts(&snapshot.sensors).missing)),
            sensor_ledgers: snapshot
                .sensors
                .iter()
                .map(|s| (s.name.clone(), ledger(&s.ledger, s.status.packets_lost)))
                .collect(),
            recorder: Some(self.recorder.get().map(|counts| counts.to_proto()).unwrap_or_default()),
            readers: self.readers().map(|(transport, readers)| (transport.to_owned(), readers)).into(),
            unknown_senders: self.drops.unknown_senders().iter().map(unknown_sender).collect(),
            observations_refused: by_name(&snapshot.observations_refused),
            reference_sensor: snapshot.reference_sensor().unwrap_or_default().to_owned(),
            fault: self.fault().unwrap_or_default(),
            mounts: snapshot.sensors.iter().filter_map(|s| Some((s.name.clone(), mount(&s.mount?)))).collect(),
            state: assessment.state.as_str().to_owned(),
            state_ms: assessment.state_for.as_secs_f64() * 1e3,
            reasons: assessment.reasons,
            pose,
            speed_m_s: assessment.speed_m_s,
            map_age_ms: assessment.map_age_ms,
            map_valid_ms: validity.as_secs_f64() * 1e3,
            map_rate_hz: snapshot.map_rate_hz,
            loss: assessment.loss,
            latency_ms: snapshot.latency_ms.iter().map(|(&stage, &ms)| (stage.to_owned(), ms)).collect(),
            drivable_share: snapshot.drivable_share,
            map_bytes: snapshot.map_bytes,
            skips: Transport::ALL.map(|of| (of.as_str().to_owned(), self.transports.skips(of))).into(),
            server: server_name().to_owned(),
            grpc: String::new(),
            page: String::new(),
            claimed_by: assessment.claimed_by,
            outline_m: self.outline_m.clone(),
        }
    }

    /// The status as JSON: the content of [`VehicleStatus::to_proto`]. 64-bit numbers that a browser's doubles cannot
    /// hold (boot id, stamps) are strings.
    pub fn to_json(&self) -> Value {
        let proto = self.to_proto();
        let unknown_senders = proto.unknown_senders.iter();
        let unknown_senders = unknown_senders.map(|sender| {
            json!({
                "address": sender.address, "datagrams": sender.datagrams, "newest_ns": sender.newest_ns.to_string()
            })
        });
        let mut document = vehicle_json(&proto);
        document["boot_id"] = proto.boot_id.to_string().into();
        document["newest_capture_end_ns"] = proto.newest_capture_end_ns.to_string().into();
        document["now_ns"] = now_ns().to_string().into();
        document["recorder"]["stopped"] = self.recorder.get().and_then(|counts| counts.stop_reason()).into();
        document["unknown_senders"] = unknown_senders.collect();
        document["alive"] = self.is_alive().into();
        document
    }
}

fn mount(deviation: &MountDeviation) -> v1::MountDeviation {
    let [height_std_m, pitch_std_rad, roll_std_rad] = deviation.std;
    v1::MountDeviation {
        height_m: deviation.height_m,
        pitch_deg: deviation.pitch_rad.to_degrees(),
        roll_deg: deviation.roll_rad.to_degrees(),
        height_std_m,
        pitch_std_deg: pitch_std_rad.to_degrees(),
        roll_std_deg: roll_std_rad.to_degrees(),
        scans: deviation.scans as u32,
        contradicts: deviation.contradicts,
    }
}

fn unknown_sender(sender: &UnknownSender) -> v1::UnknownSender {
    let UnknownSender { address, datagrams, newest_ns } = *sender;
    v1::UnknownSender { address: address.to_string(), datagrams, newest_ns }
}

fn ledger(ledger: &Ledger, missing: u64) -> v1::Ledger {
    v1::Ledger {
        received: ledger.received,
        decoded: ledger.decoded,
        telemetry: ledger.telemetry,
        refused: by_name(&ledger.refused),
        lost: ledger.lost,
        kernel_drops: ledger.kernel_drops,
        points_dropped: ledger.points_dropped,
        own_body: ledger.own_body,
        through_body: ledger.through_body,
        blind: ledger.blind,
        poses: ledger.poses,
        poses_refused: ledger.poses_refused,
        roads: ledger.roads,
        roads_refused: by_name(&ledger.roads_refused),
        missing,
    }
}

fn by_name(counts: &BTreeMap<&'static str, u64>) -> BTreeMap<String, u64> {
    counts.iter().map(|(&reason, &n)| (reason.to_owned(), n)).collect()
}

/// Name of the host on which the server runs; `localhost` if the system does not tell it.
pub(super) fn server_name() -> &'static str {
    static NAME: OnceLock<String> = OnceLock::new();
    NAME.get_or_init(|| {
        let name = nix::unistd::gethostname().ok().and_then(|name| name.into_string().ok());
        name.filter(|name| !name.is_empty()).unwrap_or_else(|| "localhost".to_owned())
    })
}
