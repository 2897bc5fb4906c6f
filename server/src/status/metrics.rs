//! The status of all vehicles -> Prometheus' text format. A name that ends in `_total` is a counter, others are gauges.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::sync::Arc;

use clearway_mapping::pipeline::NamedStatus;
use clearway_mapping::sensor::mount::check::MountDeviation;

use super::vehicle::{Snapshot, VehicleStatus};
use crate::clock::now_ns;

/// Counts of a listener: open connections, bytes that wait for readers, connections refused or closed by reason.
type ListenerCounts = (&'static str, (usize, usize, BTreeMap<&'static str, u64>));

/// The text of `/metrics`: of these vehicles, and of the TCP listeners by name.
pub fn prometheus(vehicles: &[Arc<VehicleStatus>], listeners: &[ListenerCounts]) -> String {
    let all = vehicles.iter().map(|status| (&**status, status.snapshot())).collect();
    let mut metrics = Metrics { all, text: String::new() };
    metrics.write_arrivals();
    metrics.write_sensors();
    metrics.write_maps();
    metrics.write_listeners(listeners);
    metrics.text
}

struct Metrics<'a> {
    all: Vec<(&'a VehicleStatus, Snapshot)>,
    text: String,
}

impl Metrics<'_> {
    fn write_arrivals(&mut self) {
        self.each("clearway_packets_received_total", "Datagrams and scans received.", |s| s.ledger.received);
        self.each("clearway_packets_decoded_total", "Data packets and scans decoded.", |s| s.ledger.decoded);
        self.each("clearway_telemetry_total", "Telemetry datagrams read.", |s| s.ledger.telemetry);
        let help = "Datagrams and scans refused, by reason.";
        self.each_reason("clearway_packets_refused_total", help, |s| &s.ledger.refused);
        let help = "Messages that are not valid observations, by reason.";
        self.each_reason("clearway_observations_refused_total", help, |s| &s.observations_refused);
        self.each("clearway_events_lost_total", "Readings lost because the event queue was full.", |s| s.ledger.lost);
        let help = "Datagrams the kernel dropped at the vehicle's sockets.";
        self.each("clearway_kernel_drops_total", help, |s| s.ledger.kernel_drops);
        self.each("clearway_poses_total", "Ego poses accepted.", |s| s.ledger.poses);
        self.each("clearway_poses_refused_total", "Ego poses refused.", |s| s.ledger.poses_refused);
        self.each("clearway_roads_total", "Roads accepted.", |s| s.ledger.roads);
        self.each("clearway_roads_refused_total", "Roads refused.", |s| s.ledger.roads_refused.values().sum());
    }

    fn write_listeners(&mut self, listeners: &[ListenerCounts]) {
        let each = |of: &dyn Fn(&ListenerCounts) -> usize| {
            listeners.iter().map(|counts| (format!("listener=\"{}\"", counts.0), of(counts) as f64)).collect()
        };
        self.family("clearway_connections", "Open connections of a listener.", each(&|(_, counts)| counts.0));
        self.family("clearway_waiting_bytes", "Bytes that wait for the readers of a listener.", each(&|(_, c)| c.1));
        let closed = listeners.iter().flat_map(|(name, (_, _, closed))| {
            closed.iter().map(move |(reason, n)| (format!("listener=\"{name}\",reason=\"{reason}\""), *n as f64))
        });
        let help = "Connections and calls that a listener refused or closed, by reason.";
        self.family("clearway_connections_closed_total", help, closed.collect());
    }

    fn write_sensors(&mut self) {
        let help = "Datagrams and scans received from a sensor.";
        self.each_sensor("clearway_sensor_received_total", help, |s| s.ledger.received as f64);
        let help = "A sensor's data packets and scans decoded.";
        self.each_sensor("clearway_sensor_decoded_total", help, |s| s.ledger.decoded as f64);
        let help = "A sensor's telemetry datagrams read.";
        self.each_sensor("clearway_sensor_telemetry_total", help, |s| s.ledger.telemetry as f64);
        let help = "Readings of a sensor lost because the event queue was full.";
        self.each_sensor("clearway_sensor_lost_total", help, |s| s.ledger.lost as f64);
        let refused = self.sensors().flat_map(|(of, sensor)| {
            sensor.ledger.refused.iter().map(move |(reason, n)| (format!("{of},reason=\"{reason}\""), *n as f64))
        });
        let refused = refused.collect();
        let help = "A sensor's datagrams and scans refused, by reason.";
        self.family("clearway_sensor_refused_total", help, refused);
        let help = "Data packets that did not arrive, by device time and azimuth, exact to one packet per gap.";
        self.each_sensor("clearway_packets_missing_total", help, |s| s.status.packets_lost as f64);
        let help = "Times the stamps of a sensor went back: each began a new epoch.";
        self.each_sensor("clearway_sensor_epochs_total", help, |s| f64::from(s.status.epoch));
        let help = "1 for the source of the elevations of a sensor's lasers.";
        let elevations = self
            .sensors()
            .filter_map(|(of, sensor)| Some((format!("{of},source=\"{}\"", sensor.elevations?.as_str()), 1.0)));
        let elevations = elevations.collect();
        self.family("clearway_sensor_elevations", help, elevations);
        self.write_mounts();
        let help = "Degrees in which a sensor used to get returns and gets none.";
        self.each_sensor("clearway_blocked_degrees", help, |s| {
            s.status.blocked.sectors.iter().map(|sector| f64::from(sector.to_deg - sector.from_deg)).sum()
        });
    }

    fn write_mounts(&mut self) {
        type Metric = (&'static str, &'static str, fn(&MountDeviation) -> f64);
        let metrics: [Metric; 4] = [
            (
                "clearway_mount_height_deviation_meters",
                "Height of a sensor over the ground it sees, less the configured height.",
                |mount| mount.height_m,
            ),
            (
                "clearway_mount_pitch_deviation_degrees",
                "Rotation about the vehicle's y axis that would level the ground a sensor sees.",
                |mount| mount.pitch_rad.to_degrees(),
            ),
            (
                "clearway_mount_roll_deviation_degrees",
                "Rotation about the vehicle's x axis that would level the ground a sensor sees.",
                |mount| mount.roll_rad.to_degrees(),
            ),
            (
                "clearway_mount_contradicted",
                "1 if the ground contradicts the configured mount of a sensor, else 0.",
                |mount| f64::from(u8::from(mount.contradicts)),
            ),
        ];
        for (name, help, value) in metrics {
            let samples = self.sensors().filter_map(|(of, sensor)| Some((of, value(&sensor.mount?)))).collect();
            self.family(name, help, samples);
        }
    }

    fn write_maps(&mut self) {
        self.each("clearway_maps_total", "Maps made.", |s| s.maps);
        let alive = self.all.iter().map(|(of, _)| (vehicle(of), f64::from(u8::from(of.is_alive())))).collect();
        let help = "1 if the vehicle's engine and the threads that read its sockets work, else 0.";
        self.family("clearway_vehicle_alive", help, alive);
        self.each("clearway_revolutions_total", "Revolutions completed.", Snapshot::revolutions);
        let now_ns = now_ns();
        let age = |(of, s): &(&VehicleStatus, Snapshot)| {
            let age_ns = now_ns.saturating_sub(s.newest_capture_end_ns);
            (s.maps > 0).then(|| (vehicle(of), age_ns as f64 / 1e9))
        };
        let ages = self.all.iter().filter_map(age).collect();
        self.family("clearway_map_age_seconds", "Age of the newest map, from the end of its capture.", ages);
        let latency = |(of, s): &(&VehicleStatus, Snapshot)| {
            let of = vehicle(of);
            let quantiles = [("0.5", s.latency_ms_p50), ("0.99", s.latency_ms_p99)];
            quantiles.map(|(q, ms)| Some((format!("{of},quantile=\"{q}\""), ms? / 1e3))).into_iter().flatten()
        };
        let latencies = self.all.iter().flat_map(latency).collect();
        self.family("clearway_map_latency_seconds", "Time to step and encode a map.", latencies);
        let readers = |(of, _): &(&VehicleStatus, Snapshot)| {
            let of = vehicle(of);
            move |(transport, n)| (format!("{of},transport=\"{transport}\""), f64::from(n))
        };
        let readers = self.all.iter().flat_map(|at| at.0.readers().map(readers(at))).collect();
        self.family("clearway_readers", "Readers of the vehicle's maps.", readers);
        let lost = |(of, _): &(&VehicleStatus, Snapshot)| {
            (vehicle(of), of.recorder.get().map_or(0, |counts| counts.lost()) as f64)
        };
        let lost = self.all.iter().map(lost).collect();
        self.family("clearway_recorder_lost_total", "Events and maps lost to the recording.", lost);
        let healthy = |(of, _): &(&VehicleStatus, Snapshot)| {
            let recorder = of.recorder.get()?;
            Some((vehicle(of), f64::from(u8::from(recorder.problem().is_none()))))
        };
        let healthy = self.all.iter().filter_map(healthy).collect();
        self.family("clearway_recorder_healthy", "1 if the recording lacks nothing and the disk keeps up.", healthy);
        let durable = |(of, _): &(&VehicleStatus, Snapshot)| {
            let recorder = of.recorder.get()?;
            Some((vehicle(of), recorder.durable_events(&of.name) as f64))
        };
        let durable = self.all.iter().filter_map(durable).collect();
        self.family("clearway_recorder_durable_events", "Events that survive a power cut.", durable);
    }

    /// The sensors of all vehicles, each with its labels.
    fn sensors(&self) -> impl Iterator<Item = (String, &NamedStatus)> {
        self.all.iter().flat_map(|(of, s)| {
            let vehicle = vehicle(of);
            s.sensors.iter().map(move |sensor| (format!("{vehicle},sensor=\"{}\"", sensor.name), sensor))
        })
    }

    fn each(&mut self, name: &str, help: &str, value: impl Fn(&Snapshot) -> u64) {
        let samples = self.all.iter().map(|(of, s)| (vehicle(of), value(s) as f64)).collect();
        self.family(name, help, samples);
    }

    fn each_sensor(&mut self, name: &str, help: &str, value: impl Fn(&NamedStatus) -> f64) {
        let samples = self.sensors().map(|(labels, sensor)| (labels, value(sensor))).collect();
        self.family(name, help, samples);
    }

    fn each_reason(&mut self, name: &str, help: &str, counts: impl Fn(&Snapshot) -> &BTreeMap<&'static str, u64>) {
        let samples = self.all.iter().flat_map(|(of, s)| {
            let of = vehicle(of);
            counts(s).iter().map(move |(reason, n)| (format!("{of},reason=\"{reason}\""), *n as f64))
        });
        let samples = samples.collect();
        self.family(name, help, samples);
    }

    /// Writes one metric with its samples; without samples it is left out.
    fn family(&mut self, name: &str, help: &str, samples: Vec<(String, f64)>) {
        if samples.is_empty() {
            return;
        }
        let kind = if name.ends_with("_total") { "counter" } else { "gauge" };
        // Writing to a string cannot fail.
        let _ = writeln!(self.text, "# HELP {name} {help}\n# TYPE {name} {kind}");
        for (labels, value) in samples {
            let _ = writeln!(self.text, "{name}{{{labels}}} {value}");
        }
    }
}

fn vehicle(status: &VehicleStatus) -> String {
    format!("vehicle=\"{}\"", status.name)
}

#[cfg(test)]
mod tests {
    use clearway_mapping::ledger::Ledger;

    use super::*;

    #[test]
    fn readings_dropped_before_the_queue_are_in_the_metrics() {
        let (door, _events) = crate::ingest::queue::event_queue(4);
        door.refuse_unknown_sender(([10, 0, 0, 9], 2368).into());
        door.refuse_unknown_sender(([10, 0, 0, 9], 2368).into());
        let status = VehicleStatus::new("car".into(), 1, vec!["drivability"], door.drops());
        let ledger = Ledger { received: 3, decoded: 2, telemetry: 1, ..Ledger::default() };
        status.stepped(&ledger, Vec::new());
        let shown = status.snapshot().ledger;
        assert_eq!(shown.refused["source"], 2);
        assert_eq!(shown.received, shown.decoded + shown.telemetry + shown.refused.values().sum::<u64>());
        let text = prometheus(&[Arc::new(status)], &[]);
        assert!(text.contains("clearway_packets_received_total{vehicle=\"car\"} 5\n"), "{text}");
        assert!(text.contains("clearway_packets_refused_total{vehicle=\"car\",reason=\"source\"} 2\n"), "{text}");
    }

    #[test]
    fn a_sensors_elevations_and_the_deviation_of_its_mount_are_in_the_metrics() {
        use clearway_mapping::map::ElevationSource;
        let (door, _events) = crate::ingest::queue::event_queue(4);
        let status = VehicleStatus::new("car".into(), 1, vec!["drivability"], door.drops());
        let sensor = |name: &str, elevations, mount| NamedStatus {
            name: name.into(),
            is_reference: name == "top",
            status: clearway_lidar::SensorStatus::default(),
            elevations,
            mount,
            ledger: Ledger::default(),
        };
        let deviation = MountDeviation { height_m: -0.58, contradicts: true, scans: 30, ..MountDeviation::default() };
        let sensors = vec![sensor("top", Some(ElevationSource::Nominal), Some(deviation)), sensor("rear", None, None)];
        status.stepped(&Ledger::default(), sensors);
        let message = status.to_proto();
        assert_eq!((message.mounts["top"].height_m, message.reference_sensor.as_str()), (-0.58, "top"));
        let text = prometheus(&[Arc::new(status)], &[]);
        for line in [
            "clearway_sensor_elevations{vehicle=\"car\",sensor=\"top\",source=\"nominal\"} 1\n",
            "clearway_mount_height_deviation_meters{vehicle=\"car\",sensor=\"top\"} -0.58\n",
            "clearway_mount_contradicted{vehicle=\"car\",sensor=\"top\"} 1\n",
        ] {
            assert!(text.contains(line), "{text}");
        }
        let of_rear = |line: &&str| line.contains("rear") && (line.contains("mount") || line.contains("elevations"));
        assert_eq!(text.lines().find(of_rear), None);
    }
}
