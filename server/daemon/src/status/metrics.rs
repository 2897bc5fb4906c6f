//! The status of all vehicles, of the listeners and of the process -> metrics in Prometheus' text format.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::sync::Arc;

use clearway_mapping::pipeline::NamedStatus;
use clearway_mapping::sensor::mount::check::MountDeviation;

use super::assess::Assessment;
use super::health::State;
use super::process;
use super::reasons::{ANNOUNCEMENT_REASONS, CLOSE_REASONS, OBSERVATION_REASONS, PACKET_REASONS};
use super::text_format::TextFormat;
use super::transports::Transport;
use super::vehicle::{Snapshot, VehicleStatus};
use crate::fleet::Fleet;
use crate::traces::StageTimes;

/// Counts of a TCP listener.
#[derive(Clone, Debug, Default)]
pub struct ListenerCounts {
    /// Number of open connections.
    pub open: usize,
    /// Connections and calls that were refused or closed by the server, by reason.
    pub closed: BTreeMap<&'static str, u64>,
}

/// The text of `/metrics`: of these vehicles, of the TCP listeners by name, and of other servers' announcements.
pub fn prometheus(vehicles: &[Arc<VehicleStatus>], listeners: &[(&str, ListenerCounts)], fleet: &Fleet) -> String {
    let observed = |status: &Arc<VehicleStatus>| ObservedVehicle {
        status: status.clone(),
        snapshot: status.snapshot(),
        assessment: status.assess(),
    };
    let mut metrics = Metrics { all: vehicles.iter().map(observed).collect(), text: TextFormat::default() };
    metrics.write_arrivals();
    metrics.write_sensors();
    metrics.write_mounts();
    metrics.write_maps();
    metrics.write_readers();
    metrics.write_recorder();
    metrics.write_listeners(listeners);
    let refused = with_zeros(&ANNOUNCEMENT_REASONS, &fleet.refused());
    let refused = refused.into_iter().map(|(reason, n)| (vec![("reason", reason.to_owned())], n));
    let help = "Announcements of other servers that were refused, by reason.";
    metrics.text.family("clearway_announcements_refused_total", help, refused);
    metrics.write_process(&process::read());
    metrics.text.into_text()
}

/// One vehicle at the time of the scrape.
#[derive(Debug)]
struct ObservedVehicle {
    status: Arc<VehicleStatus>,
    snapshot: Snapshot,
    assessment: Assessment,
}

/// The metrics of all vehicles, and their text so far.
struct Metrics {
    all: Vec<ObservedVehicle>,
    text: TextFormat,
}

impl Metrics {
    fn write_arrivals(&mut self) {
        self.count("clearway_packets_received_total", "Datagrams and scans received.", |s| s.ledger.received);
        self.count("clearway_packets_decoded_total", "Data packets and scans decoded.", |s| s.ledger.decoded);
        self.count("clearway_telemetry_total", "Telemetry datagrams read.", |s| s.ledger.telemetry);
        let help = "Datagrams and scans refused, by reason.";
        self.by("clearway_packets_refused_total", help, "reason", |of| {
            with_zeros(&PACKET_REASONS, &of.snapshot.ledger.refused)
        });
        let help = "Messages that are not valid observations, by reason.";
        self.by("clearway_observations_refused_total", help, "reason", |of| {
            with_zeros(&OBSERVATION_REASONS, &of.snapshot.observations_refused)
        });
        let help = "Readings lost because the event queue was full.";
        self.count("clearway_events_lost_total", help, |s| s.ledger.lost);
        let help = "Datagrams the kernel dropped at the vehicle's sockets.";
        self.count("clearway_kernel_drops_total", help, |s| s.ledger.kernel_drops);
        self.count("clearway_poses_total", "Ego poses accepted.", |s| s.ledger.poses);
        self.count("clearway_poses_refused_total", "Ego poses refused.", |s| s.ledger.poses_refused);
        self.count("clearway_roads_total", "Roads accepted.", |s| s.ledger.roads);
        self.count("clearway_roads_refused_total", "Roads refused.", |s| s.ledger.roads_refused.values().sum());
        let help = "Events that wait for the engine.";
        self.each("clearway_queue_events", help, |of| Some(of.status.queue()?.waiting() as f64));
        let help = "Events that may wait for the engine.";
        self.each("clearway_queue_events_max", help, |of| Some(of.status.queue()?.capacity as f64));
    }

    fn write_sensors(&mut self) {
        let help = "Datagrams and scans received from a sensor.";
        self.each_sensor("clearway_sensor_received_total", help, |s| Some(s.ledger.received as f64));
        let help = "A sensor's data packets and scans decoded.";
        self.each_sensor("clearway_sensor_decoded_total", help, |s| Some(s.ledger.decoded as f64));
        let help = "A sensor's telemetry datagrams read.";
        self.each_sensor("clearway_sensor_telemetry_total", help, |s| Some(s.ledger.telemetry as f64));
        let help = "Readings of a sensor lost because the event queue was full.";
        self.each_sensor("clearway_sensor_lost_total", help, |s| Some(s.ledger.lost as f64));
        let help = "A sensor's datagrams and scans refused, by reason.";
        self.by_sensor("clearway_sensor_refused_total", help, "reason", |s| {
            s.ledger.refused.iter().map(|(&reason, &n)| (reason, n as f64)).collect()
        });
        let help = "Data packets that did not arrive, by device time and azimuth, exact to one packet per gap.";
        self.each_sensor("clearway_packets_missing_total", help, |s| Some(s.status.packets_lost as f64));
        let help = "Times the stamps of a sensor went back: each began a new epoch.";
        self.each_sensor("clearway_sensor_epochs_total", help, |s| Some(f64::from(s.status.epoch)));
        let help = "1 for the source of the elevations of a sensor's lasers.";
        self.by_sensor("clearway_sensor_elevations", help, "source", |s| {
            s.elevations.iter().map(|source| (source.as_str(), 1.0)).collect()
        });
        let help = "Degrees in which a sensor used to get returns and gets none.";
        self.each_sensor("clearway_blocked_degrees", help, |s| {
            Some(s.status.blocked.sectors.iter().map(|sector| f64::from(sector.to_deg - sector.from_deg)).sum())
        });
        let help = "Time by which the host's clock is ahead of the clock of a sensor.";
        self.each_sensor("clearway_sensor_clock_offset_seconds", help, |s| {
            s.status.clock.map(|_| s.status.clock_offset_ms as f64 / 1e3)
        });
        let help = "Time since the newest packet or scan of a sensor that could be read.";
        self.by("clearway_sensor_last_packet_age_seconds", help, "sensor", |of| {
            of.status.packet_ages().into_iter().map(|(sensor, age)| (sensor, age.as_secs_f64())).collect()
        });
        let help = "Covered share of the newest revolution of a sensor.";
        self.by("clearway_sensor_completeness_ratio", help, "sensor", |of| {
            of.status.completeness().into_iter().map(|(sensor, share)| (sensor, f64::from(share))).collect()
        });
    }

    fn write_mounts(&mut self) {
        let mut mount = |name, help, value: fn(&MountDeviation) -> f64| {
            self.each_sensor(name, help, |sensor| sensor.mount.as_ref().map(value));
        };
        let help = "Height of a sensor over the ground it sees, less the configured height.";
        mount("clearway_mount_height_deviation_meters", help, |mount| mount.height_m);
        let help = "Rotation about the vehicle's y axis that would level the ground a sensor sees.";
        mount("clearway_mount_pitch_deviation_degrees", help, |mount| mount.pitch_rad.to_degrees());
        let help = "Rotation about the vehicle's x axis that would level the ground a sensor sees.";
        mount("clearway_mount_roll_deviation_degrees", help, |mount| mount.roll_rad.to_degrees());
        let help = "1 if the ground contradicts the configured mount of a sensor, else 0.";
        mount("clearway_mount_contradicted", help, |mount| one_if(mount.contradicts));
    }

    fn write_maps(&mut self) {
        self.count("clearway_maps_total", "Maps made.", |s| s.maps);
        self.count("clearway_revolutions_total", "Revolutions completed.", Snapshot::revolutions);
        let help = "1 if the vehicle's engine and the threads that read its sockets work, else 0.";
        self.each("clearway_vehicle_alive", help, |of| Some(one_if(of.status.is_alive())));
        let help = "1 for the state of the vehicle, 0 for the others.";
        self.by("clearway_vehicle_state", help, "state", |of| {
            State::ALL.map(|state| (state.as_str(), one_if(state == of.assessment.state))).into()
        });
        let help = "Age of the newest map, from the end of its capture.";
        self.each("clearway_map_age_seconds", help, |of| Some(of.assessment.map_age_ms? / 1e3));
        let help = "Share of the packets of the last 10 s that were lost, dropped or refused.";
        self.each("clearway_packet_loss_ratio", help, |of| of.assessment.loss);
        let help = "Maps per second of the last 10 s.";
        self.each("clearway_map_rate_hertz", help, |of| Some(of.snapshot.map_rate_hz));
        let help = "Mean size of an encoded map of the last 10 s.";
        self.each("clearway_map_bytes", help, |of| Some(of.snapshot.map_bytes));
        let help = "Of the judged cells of the layer drivability, the share that is drivable.";
        self.each("clearway_drivable_ratio", help, |of| of.snapshot.drivable_share);
        let help = "Other servers that serve a vehicle of the same name.";
        self.each("clearway_vehicle_claims", help, |of| Some(of.assessment.claimed_by.len() as f64));
        let stages = self.all.iter().flat_map(|of| {
            let times = StageTimes::NAMES.iter().zip(&of.snapshot.stages);
            times.map(|(stage, times)| (of.labels("stage", *stage), times))
        });
        let help = "Time of a map in a stage; total is from the end of capture until it is published.";
        self.text.histogram("clearway_map_latency_seconds", help, stages);
        let ages = self.all.iter().map(|of| (of.label(), &of.snapshot.ages));
        let help = "Age of the newest map, sampled five times a second.";
        self.text.histogram("clearway_map_age_sampled_seconds", help, ages);
    }

    fn write_readers(&mut self) {
        self.by("clearway_readers", "Readers of the vehicle's maps.", "transport", |of| {
            Transport::ALL.map(|by| (by.as_str(), f64::from(of.status.transports.count(by)))).into()
        });
        let help = "Maps that readers did not get because they or their links were late.";
        self.by("clearway_skipped_maps_total", help, "transport", |of| {
            Transport::ALL.map(|by| (by.as_str(), of.status.transports.skips(by) as f64)).into()
        });
    }

    fn write_recorder(&mut self) {
        let help = "Events and maps lost to the recording.";
        self.each("clearway_recorder_lost_total", help, |of| {
            Some(of.status.recorder.get().map_or(0, |counts| counts.lost()) as f64)
        });
        let help = "1 if this part of the recording lacks nothing and the disk keeps up.";
        self.each("clearway_recorder_healthy", help, |of| {
            of.status.recorder.get().map(|_| one_if(of.status.recorder_problem().is_none()))
        });
        let help = "Events that survive a power cut.";
        self.each("clearway_recorder_durable_events", help, |of| {
            Some(of.status.recorder.get()?.durable_events(&of.status.name) as f64)
        });
        // All vehicles share one recorder.
        let Some(counts) = self.all.iter().find_map(|of| of.status.recorder.get()) else { return };
        let (recorder, folder) = (counts.to_proto(), counts.folder());
        let help = "Parts that the long-term store has confirmed.";
        self.single("clearway_store_confirmed_parts_total", help, Some(recorder.store_confirmed as f64));
        let help = "Finished parts that wait for the long-term store.";
        self.single("clearway_store_waiting_parts", help, Some(recorder.store_waiting as f64));
        let help = "Attempts to store a part that failed.";
        self.single("clearway_store_failures_total", help, Some(recorder.store_failures as f64));
        let bytes = fs::metadata(&recorder.file).ok().map(|file| file.len() as f64);
        self.single("clearway_recorder_file_bytes", "Length of the part that is being written.", bytes);
        let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { &folder };
        let disk = nix::sys::statvfs::statvfs(folder).ok();
        let free = disk.map(|disk| disk.blocks_available() as f64 * disk.fragment_size() as f64);
        self.single("clearway_recorder_free_bytes", "Free space on the disk of the recording.", free);
    }

    fn write_listeners(&mut self, listeners: &[(&str, ListenerCounts)]) {
        let label = |name: &str| vec![("listener", name.to_owned())];
        let open = listeners.iter().map(|(name, counts)| (label(name), counts.open as f64));
        self.text.family("clearway_connections", "Open connections of a listener.", open);
        let closed = listeners.iter().flat_map(|(name, counts)| {
            let counts = with_zeros(&CLOSE_REASONS, &counts.closed).into_iter();
            counts.map(move |(reason, n)| (vec![("listener", (*name).to_owned()), ("reason", reason.to_owned())], n))
        });
        let help = "Connections and calls that a listener refused or closed, by reason.";
        self.text.family("clearway_connections_closed_total", help, closed);
    }

    fn write_process(&mut self, process: &process::Process) {
        let version = [(vec![("version", env!("CARGO_PKG_VERSION").to_owned())], 1.0)];
        self.text.family("clearway_build_info", "The program; the value is always 1.", version);
        let is_reloaded = self.all.first().map(|of| one_if(of.status.network.is_reloaded()));
        let help = "1 if the configuration was read again at the newest SIGHUP, or there was none; else 0.";
        self.single("clearway_config_last_reload_successful", help, is_reloaded);
        let away_s = self.all.first().map(|of| of.status.network.without_router().as_secs_f64());
        let help = "Time without a zenoh router, or an endpoint of a peer; 0 if it is there, or none is configured.";
        self.single("clearway_zenoh_router_away_seconds", help, away_s);
        let ends = self.all.first().map(|of| of.status.network.certificates()).unwrap_or_default();
        let help = "End of a certificate since the Unix epoch, by its key in the configuration.";
        let ends = ends.into_iter().map(|(key, end_s)| (vec![("key", key.to_owned())], end_s as f64));
        self.text.family("clearway_certificate_end_timestamp_seconds", help, ends);
        let help = "Start of the process since the Unix epoch.";
        self.single("process_start_time_seconds", help, process.start_s);
        let help = "Memory of the process that is in use and not swapped out.";
        self.single("process_resident_memory_bytes", help, process.resident_bytes);
        self.single("process_cpu_seconds_total", "Processor time of the process.", process.cpu_s);
        self.single("process_open_fds", "Open files and sockets of the process.", process.open_files);
        let help = "Largest number of open files that is allowed.";
        self.single("process_max_fds", help, process.open_files_max);
    }

    /// Writes one metric without labels, if its value is known.
    fn single(&mut self, name: &str, help: &str, value: Option<f64>) {
        self.text.family(name, help, value.map(|value| (Vec::new(), value)));
    }

    /// Writes a count of each vehicle.
    fn count(&mut self, name: &str, help: &str, count: impl Fn(&Snapshot) -> u64) {
        self.each(name, help, |of| Some(count(&of.snapshot) as f64));
    }

    /// Writes a value of each vehicle that has it.
    fn each(&mut self, name: &str, help: &str, value: impl Fn(&ObservedVehicle) -> Option<f64>) {
        self.text.family(name, help, self.all.iter().filter_map(|of| Some((of.label(), value(of)?))));
    }

    /// Writes values of each vehicle, each with one more label.
    fn by<L: Into<String>>(
        &mut self,
        name: &str,
        help: &str,
        label: &'static str,
        values: impl Fn(&ObservedVehicle) -> Vec<(L, f64)>,
    ) {
        let all = self.all.iter().map(|of| (of, values(of)));
        let samples = all.flat_map(|(of, values)| values.into_iter().map(move |(by, n)| (of.labels(label, by), n)));
        self.text.family(name, help, samples);
    }

    /// Writes a value of each sensor that has it.
    fn each_sensor(&mut self, name: &str, help: &str, value: impl Fn(&NamedStatus) -> Option<f64>) {
        self.by(name, help, "sensor", |of| {
            of.snapshot.sensors.iter().filter_map(|sensor| Some((sensor.name.clone(), value(sensor)?))).collect()
        });
    }

    /// Writes values of each sensor, each with one more label.
    fn by_sensor(
        &mut self,
        name: &str,
        help: &str,
        label: &'static str,
        values: impl Fn(&NamedStatus) -> Vec<(&'static str, f64)>,
    ) {
        let sensors = self.all.iter().flat_map(|of| of.snapshot.sensors.iter().map(move |sensor| (of, sensor)));
        let samples = sensors.flat_map(|(of, sensor)| {
            let labels = of.labels("sensor", &*sensor.name);
            let values = values(sensor).into_iter();
            values.map(move |(by, n)| ([&labels[..], &[(label, by.to_owned())]].concat(), n))
        });
        self.text.family(name, help, samples);
    }
}

impl ObservedVehicle {
    fn label(&self) -> Vec<(&'static str, String)> {
        vec![("vehicle", self.status.name.to_string())]
    }

    fn labels(&self, name: &'static str, value: impl Into<String>) -> Vec<(&'static str, String)> {
        vec![("vehicle", self.status.name.to_string()), (name, value.into())]
    }
}

fn one_if(is_so: bool) -> f64 {
    f64::from(u8::from(is_so))
}

/// The counts by reason, with 0 for the known reasons that have not occurred.
fn with_zeros(known: &[&'static str], counts: &BTreeMap<&'static str, u64>) -> Vec<(&'static str, f64)> {
    let zeros = known.iter().filter(|reason| !counts.contains_key(*reason)).map(|reason| (*reason, 0.0));
    zeros.chain(counts.iter().map(|(reason, n)| (*reason, *n as f64))).collect()
}

#[cfg(test)]
mod tests {
    use clearway_mapping::ledger::Ledger;

    use super::*;

    fn text(status: VehicleStatus) -> String {
        prometheus(&[Arc::new(status)], &[], &Fleet::default())
    }

    #[test]
    fn readings_dropped_before_the_queue_are_in_the_metrics() {
        let (door, _events) = crate::ingest::queue::event_queue(4);
        door.refuse_unknown_sender(([10, 0, 0, 9], 2368).into());
        door.refuse_unknown_sender(([10, 0, 0, 9], 2368).into());
        let status = VehicleStatus::new("car".into(), 1, vec!["drivability"], door.drops());
        let ledger = Ledger { received: 3, decoded: 2, telemetry: 1, ..Ledger::default() };
        status.stepped(&ledger, Vec::new(), None);
        let shown = status.snapshot().ledger;
        assert_eq!(shown.refused["source"], 2);
        assert_eq!(shown.received, shown.decoded + shown.telemetry + shown.refused.values().sum::<u64>());
        let text = text(status);
        assert!(text.contains("clearway_packets_received_total{vehicle=\"car\"} 5\n"), "{text}");
        assert!(text.contains("clearway_packets_refused_total{vehicle=\"car\",reason=\"source\"} 2\n"), "{text}");
    }

    #[test]
    fn a_sensors_elevations_and_the_deviation_of_its_mount_are_in_the_metrics() {
        use clearway_mapping::map::ElevationSource;
        let (door, _events) = crate::ingest::queue::event_queue(4);
        let status = VehicleStatus::new("car".into(), 1, vec!["drivability"], door.drops());
        let sensor = |name: &str, elevations, mount| NamedStatus {
            source: 0,
            name: name.into(),
            is_reference: name == "top",
            status: clearway_lidar::SensorStatus::default(),
            elevations,
            mount,
            other_clock: Default::default(),
            ledger: Ledger::default(),
        };
        let deviation = MountDeviation { height_m: -0.58, contradicts: true, scans: 30, ..MountDeviation::default() };
        let sensors = vec![sensor("top", Some(ElevationSource::Nominal), Some(deviation)), sensor("rear", None, None)];
        status.stepped(&Ledger::default(), sensors, None);
        let message = status.to_proto();
        assert_eq!((message.mounts["top"].height_m, message.reference_sensor.as_str()), (-0.58, "top"));
        let text = text(status);
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

    #[test]
    fn known_reasons_are_there_before_they_occur() {
        let (queue, _events) = crate::ingest::queue::event_queue(4);
        let text = text(VehicleStatus::new("car".into(), 1, vec!["drivability"], queue.drops()));
        assert!(text.contains("# TYPE clearway_maps_total counter\n"), "{text}");
        for line in [
            "clearway_packets_refused_total{vehicle=\"car\",reason=\"length\"} 0\n",
            "clearway_announcements_refused_total{reason=\"full\"} 0\n",
            "clearway_skipped_maps_total{vehicle=\"car\",transport=\"page\"} 0\n",
            "clearway_vehicle_state{vehicle=\"car\",state=\"error\"} 1\n",
            "clearway_map_latency_seconds_count{vehicle=\"car\",stage=\"map\"} 0\n",
        ] {
            assert!(text.contains(line), "{line}{text}");
        }
    }
}
