//! The status of all vehicles, of the listeners and of the process -> OpenMetrics or Prometheus' text format.

use std::collections::BTreeMap;
use std::fmt;
use std::fs;
use std::path::Path;
use std::sync::Arc;

use clearway_mapping::pipeline::NamedStatus;
use clearway_mapping::sensor::mount::check::MountDeviation;
use prometheus_client::collector::Collector;
use prometheus_client::encoding::{DescriptorEncoder, text};
use prometheus_client::metrics::MetricType;
use prometheus_client::registry::Registry;

use super::assess::Assessment;
use super::health::State;
use super::histogram::Histogram;
use super::process;
use super::reasons::{CLOSE_REASONS, OBSERVATION_REASONS, PACKET_REASONS};
use super::text_format::{Format, to_text_format};
use super::transports::Transport;
use super::vehicle::{Snapshot, VehicleStatus};
use super::window::STAGES;

/// Counts of a listener: open connections, bytes that wait for readers, connections refused or closed by reason.
type ListenerCounts = (&'static str, (usize, usize, BTreeMap<&'static str, u64>));

/// The labels of one sample.
type Labels = Vec<(&'static str, String)>;

/// The text of `/metrics`: of these vehicles, and of the TCP listeners by name.
pub fn prometheus(vehicles: &[Arc<VehicleStatus>], listeners: Vec<ListenerCounts>, format: Format) -> String {
    let observed = |status: &Arc<VehicleStatus>| Observed {
        status: status.clone(),
        snapshot: status.snapshot(),
        assessment: status.assess(),
    };
    let mut registry = Registry::default();
    let all = vehicles.iter().map(observed).collect();
    registry.register_collector(Box::new(Metrics { all, listeners, process: process::read() }));
    let mut text = String::new();
    // Writing to a string cannot fail.
    let _ = text::encode(&mut text, &registry);
    if format == Format::OpenMetrics { text } else { to_text_format(&text) }
}

/// One vehicle at the time of the scrape.
#[derive(Debug)]
struct Observed {
    status: Arc<VehicleStatus>,
    snapshot: Snapshot,
    assessment: Assessment,
}

impl Observed {
    fn labels(&self) -> Labels {
        vec![("vehicle", self.status.name.to_string())]
    }

    fn with(&self, name: &'static str, value: impl Into<String>) -> Labels {
        vec![("vehicle", self.status.name.to_string()), (name, value.into())]
    }
}

#[derive(Debug)]
struct Metrics {
    all: Vec<Observed>,
    listeners: Vec<ListenerCounts>,
    process: process::Process,
}

impl Collector for Metrics {
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> fmt::Result {
        let mut families = Families { all: &self.all, encoder: &mut encoder };
        families.write_arrivals()?;
        families.write_sensors()?;
        families.write_mounts()?;
        families.write_maps()?;
        families.write_readers()?;
        families.write_recorder()?;
        families.write_listeners(&self.listeners)?;
        families.write_process(&self.process)
    }
}

struct Families<'a, 'e> {
    all: &'a [Observed],
    encoder: &'a mut DescriptorEncoder<'e>,
}

impl Families<'_, '_> {
    fn write_arrivals(&mut self) -> fmt::Result {
        self.each("clearway_packets_received_total", "Datagrams and scans received.", |s| s.ledger.received)?;
        self.each("clearway_packets_decoded_total", "Data packets and scans decoded.", |s| s.ledger.decoded)?;
        self.each("clearway_telemetry_total", "Telemetry datagrams read.", |s| s.ledger.telemetry)?;
        let help = "Datagrams and scans refused, by reason.";
        self.each_reason("clearway_packets_refused_total", help, &PACKET_REASONS, |s| &s.ledger.refused)?;
        let help = "Messages that are not valid observations, by reason.";
        let name = "clearway_observations_refused_total";
        self.each_reason(name, help, &OBSERVATION_REASONS, |s| &s.observations_refused)?;
        let help = "Readings lost because the event queue was full.";
        self.each("clearway_events_lost_total", help, |s| s.ledger.lost)?;
        let help = "Datagrams the kernel dropped at the vehicle's sockets.";
        self.each("clearway_kernel_drops_total", help, |s| s.ledger.kernel_drops)?;
        self.each("clearway_poses_total", "Ego poses accepted.", |s| s.ledger.poses)?;
        self.each("clearway_poses_refused_total", "Ego poses refused.", |s| s.ledger.poses_refused)?;
        self.each("clearway_roads_total", "Roads accepted.", |s| s.ledger.roads)?;
        let help = "Roads refused.";
        self.each("clearway_roads_refused_total", help, |s| s.ledger.roads_refused.values().sum())?;
        let queues = self.all.iter().filter_map(|of| Some((of.labels(), of.status.queue()?)));
        let queues: Vec<_> = queues.collect();
        let waiting = queues.iter().map(|(of, queue)| (of.clone(), queue.waiting() as f64)).collect();
        self.family("clearway_queue_events", "Events that wait for the engine.", waiting)?;
        let capacity = queues.iter().map(|(of, queue)| (of.clone(), queue.capacity as f64)).collect();
        self.family("clearway_queue_events_max", "Events that may wait for the engine.", capacity)
    }

    fn write_sensors(&mut self) -> fmt::Result {
        let help = "Datagrams and scans received from a sensor.";
        self.each_sensor("clearway_sensor_received_total", help, |s| Some(s.ledger.received as f64))?;
        let help = "A sensor's data packets and scans decoded.";
        self.each_sensor("clearway_sensor_decoded_total", help, |s| Some(s.ledger.decoded as f64))?;
        let help = "A sensor's telemetry datagrams read.";
        self.each_sensor("clearway_sensor_telemetry_total", help, |s| Some(s.ledger.telemetry as f64))?;
        let help = "Readings of a sensor lost because the event queue was full.";
        self.each_sensor("clearway_sensor_lost_total", help, |s| Some(s.ledger.lost as f64))?;
        let refused = self.sensors().flat_map(|(of, sensor)| {
            sensor.ledger.refused.iter().map(move |(reason, n)| (and(&of, "reason", *reason), *n as f64))
        });
        let refused = refused.collect();
        let help = "A sensor's datagrams and scans refused, by reason.";
        self.family("clearway_sensor_refused_total", help, refused)?;
        let help = "Data packets that did not arrive, by device time and azimuth, exact to one packet per gap.";
        self.each_sensor("clearway_packets_missing_total", help, |s| Some(s.status.packets_lost as f64))?;
        let help = "Times the stamps of a sensor went back: each began a new epoch.";
        self.each_sensor("clearway_sensor_epochs_total", help, |s| Some(f64::from(s.status.epoch)))?;
        let help = "1 for the source of the elevations of a sensor's lasers.";
        let elevations =
            self.sensors().filter_map(|(of, sensor)| Some((and(&of, "source", sensor.elevations?.as_str()), 1.0)));
        let elevations = elevations.collect();
        self.family("clearway_sensor_elevations", help, elevations)?;
        let help = "Degrees in which a sensor used to get returns and gets none.";
        self.each_sensor("clearway_blocked_degrees", help, |s| {
            Some(s.status.blocked.sectors.iter().map(|sector| f64::from(sector.to_deg - sector.from_deg)).sum())
        })?;
        let help = "Time by which the host's clock is ahead of the clock of a sensor.";
        self.each_sensor("clearway_sensor_clock_offset_seconds", help, |s| {
            s.status.clock.map(|_| s.status.clock_offset_ms as f64 / 1e3)
        })?;
        let ages = self.all.iter().flat_map(|of| {
            let ages = of.status.packet_ages().into_iter();
            ages.map(|(sensor, age)| (and(&of.labels(), "sensor", sensor), age.as_secs_f64()))
        });
        let help = "Time since the newest packet or scan of a sensor that could be read.";
        self.family("clearway_sensor_last_packet_age_seconds", help, ages.collect())?;
        let shares = self.all.iter().flat_map(|of| {
            let shares = of.status.completeness().into_iter();
            shares.map(|(sensor, share)| (and(&of.labels(), "sensor", sensor), f64::from(share)))
        });
        let help = "Covered share of the newest revolution of a sensor.";
        self.family("clearway_sensor_completeness_ratio", help, shares.collect())
    }

    fn write_mounts(&mut self) -> fmt::Result {
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
            self.each_sensor(name, help, |sensor| sensor.mount.as_ref().map(value))?;
        }
        Ok(())
    }

    fn write_maps(&mut self) -> fmt::Result {
        self.each("clearway_maps_total", "Maps made.", |s| s.maps)?;
        self.each("clearway_revolutions_total", "Revolutions completed.", Snapshot::revolutions)?;
        let help = "1 if the vehicle's engine and the threads that read its sockets work, else 0.";
        self.each_vehicle("clearway_vehicle_alive", help, |of| Some(f64::from(u8::from(of.status.is_alive()))))?;
        let states = |of: &Observed| {
            let is = of.assessment.state;
            State::ALL.map(|state| (of.with("state", state.as_str()), f64::from(u8::from(state == is))))
        };
        let states = self.all.iter().flat_map(states).collect();
        self.family("clearway_vehicle_state", "1 for the state of the vehicle, 0 for the others.", states)?;
        let help = "Age of the newest map, from the end of its capture.";
        self.each_vehicle("clearway_map_age_seconds", help, |of| Some(of.assessment.map_age_ms? / 1e3))?;
        let help = "Share of the packets of the last 10 s that were lost, dropped or refused.";
        self.each_vehicle("clearway_packet_loss_ratio", help, |of| Some(of.assessment.loss))?;
        let help = "Maps per second of the last 10 s.";
        self.each_vehicle("clearway_map_rate_hertz", help, |of| Some(of.snapshot.map_rate_hz))?;
        let help = "Mean size of an encoded map of the last 10 s.";
        self.each_vehicle("clearway_map_bytes", help, |of| Some(of.snapshot.map_bytes))?;
        let help = "Of the judged cells of the layer drivability, the share that is drivable.";
        self.each_vehicle("clearway_drivable_ratio", help, |of| of.snapshot.drivable_share)?;
        let help = "Other servers that serve a vehicle of the same name.";
        self.each_vehicle("clearway_vehicle_claims", help, |of| Some(of.assessment.claimed_by.len() as f64))?;
        let stages = self.all.iter().flat_map(|of| {
            STAGES.iter().zip(&of.snapshot.stages).map(|(stage, times)| (of.with("stage", *stage), times))
        });
        let stages = stages.collect();
        let help = "Time of a map in a stage; total is from the end of capture until it is published.";
        self.histogram("clearway_map_latency_seconds", help, stages)?;
        let ages = self.all.iter().map(|of| (of.labels(), &of.snapshot.ages)).collect();
        self.histogram("clearway_map_age_sampled_seconds", "Age of the newest map, sampled five times a second.", ages)
    }

    fn write_readers(&mut self) -> fmt::Result {
        let of_all = |value: fn(&Observed, Transport) -> f64| {
            let each = |of| Transport::ALL.map(|by| (Observed::with(of, "transport", by.as_str()), value(of, by)));
            self.all.iter().flat_map(each).collect()
        };
        let readers = of_all(|of, transport| f64::from(of.status.transports.count(transport)));
        let skips = of_all(|of, transport| of.status.transports.skips(transport) as f64);
        self.family("clearway_readers", "Readers of the vehicle's maps.", readers)?;
        let help = "Maps that readers did not get because they or their links were late.";
        self.family("clearway_skipped_maps_total", help, skips)
    }

    fn write_recorder(&mut self) -> fmt::Result {
        let help = "Events and maps lost to the recording.";
        self.each_vehicle("clearway_recorder_lost_total", help, |of| {
            Some(of.status.recorder.get().map_or(0, |counts| counts.lost()) as f64)
        })?;
        let help = "1 if the recording lacks nothing and the disk keeps up.";
        self.each_vehicle("clearway_recorder_healthy", help, |of| {
            Some(f64::from(u8::from(of.status.recorder.get()?.problem().is_none())))
        })?;
        let help = "Events that survive a power cut.";
        self.each_vehicle("clearway_recorder_durable_events", help, |of| {
            Some(of.status.recorder.get()?.durable_events(&of.status.name) as f64)
        })?;
        // All vehicles share one recorder.
        let Some(counts) = self.all.iter().find_map(|of| of.status.recorder.get()) else { return Ok(()) };
        let (recorder, folder) = (counts.to_proto(), counts.folder());
        let help = "Parts that the long-term store has confirmed.";
        self.single("clearway_store_confirmed_parts_total", help, Some(recorder.store_confirmed as f64))?;
        let help = "Finished parts that wait for the long-term store.";
        self.single("clearway_store_waiting_parts", help, Some(recorder.store_waiting as f64))?;
        let help = "Attempts to store a part that failed.";
        self.single("clearway_store_failures_total", help, Some(recorder.store_failures as f64))?;
        let bytes = fs::metadata(&recorder.file).ok().map(|file| file.len() as f64);
        self.single("clearway_recorder_file_bytes", "Length of the part that is being written.", bytes)?;
        let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { &folder };
        let disk = nix::sys::statvfs::statvfs(folder).ok();
        let free = disk.map(|disk| disk.blocks_available() as f64 * disk.fragment_size() as f64);
        self.single("clearway_recorder_free_bytes", "Free space on the disk of the recording.", free)
    }

    fn write_listeners(&mut self, listeners: &[ListenerCounts]) -> fmt::Result {
        let each = |of: &dyn Fn(&ListenerCounts) -> usize| {
            listeners.iter().map(|counts| (vec![("listener", counts.0.to_owned())], of(counts) as f64)).collect()
        };
        self.family("clearway_connections", "Open connections of a listener.", each(&|(_, counts)| counts.0))?;
        let help = "Bytes that wait for the readers of a listener.";
        self.family("clearway_waiting_bytes", help, each(&|(_, counts)| counts.1))?;
        let closed = listeners.iter().flat_map(|(name, (_, _, closed))| {
            let counts = with_zeros(&CLOSE_REASONS, closed).into_iter();
            counts.map(move |(reason, n)| (and(&vec![("listener", (*name).to_owned())], "reason", reason), n as f64))
        });
        let help = "Connections and calls that a listener refused or closed, by reason.";
        self.family("clearway_connections_closed_total", help, closed.collect())
    }

    fn write_process(&mut self, process: &process::Process) -> fmt::Result {
        let version = vec![(vec![("version", env!("CARGO_PKG_VERSION").to_owned())], 1.0)];
        self.family("clearway_build_info", "The program; the value is always 1.", version)?;
        let is_reloaded = self.all.first().map(|of| f64::from(u8::from(of.status.network.is_reloaded())));
        let help = "1 if the configuration was read again at the newest SIGHUP, or there was none; else 0.";
        self.single("clearway_config_last_reload_successful", help, is_reloaded)?;
        let help = "Start of the process since the Unix epoch.";
        self.single("process_start_time_seconds", help, process.start_s)?;
        let help = "Memory of the process that is in use and not swapped out.";
        self.single("process_resident_memory_bytes", help, process.resident_bytes)?;
        self.single("process_cpu_seconds_total", "Processor time of the process.", process.cpu_s)?;
        self.single("process_open_fds", "Open files and sockets of the process.", process.open_files)?;
        let help = "Largest number of open files that is allowed.";
        self.single("process_max_fds", help, process.open_files_max)
    }

    /// The sensors of all vehicles, each with its labels.
    fn sensors(&self) -> impl Iterator<Item = (Labels, &NamedStatus)> {
        self.all
            .iter()
            .flat_map(|of| of.snapshot.sensors.iter().map(|sensor| (of.with("sensor", sensor.name.clone()), sensor)))
    }

    fn each(&mut self, name: &str, help: &str, value: impl Fn(&Snapshot) -> u64) -> fmt::Result {
        self.each_vehicle(name, help, |of| Some(value(&of.snapshot) as f64))
    }

    fn each_vehicle(&mut self, name: &str, help: &str, value: impl Fn(&Observed) -> Option<f64>) -> fmt::Result {
        let samples = self.all.iter().filter_map(|of| Some((of.labels(), value(of)?))).collect();
        self.family(name, help, samples)
    }

    fn each_sensor(&mut self, name: &str, help: &str, value: impl Fn(&NamedStatus) -> Option<f64>) -> fmt::Result {
        let samples = self.sensors().filter_map(|(labels, sensor)| Some((labels, value(sensor)?))).collect();
        self.family(name, help, samples)
    }

    fn each_reason(
        &mut self,
        name: &str,
        help: &str,
        known: &[&'static str],
        counts: impl Fn(&Snapshot) -> &BTreeMap<&'static str, u64>,
    ) -> fmt::Result {
        let samples = self.all.iter().flat_map(|of| {
            let counts = with_zeros(known, counts(&of.snapshot)).into_iter();
            counts.map(|(reason, n)| (of.with("reason", reason), n as f64))
        });
        let samples = samples.collect();
        self.family(name, help, samples)
    }

    /// Writes one metric without labels, if its value is known.
    fn single(&mut self, name: &str, help: &str, value: Option<f64>) -> fmt::Result {
        self.family(name, help, value.map(|value| (Vec::new(), value)).into_iter().collect())
    }

    /// Writes one metric with its samples: a counter if its name ends in `_total`, else a gauge. Without samples it is
    /// left out.
    fn family(&mut self, name: &str, help: &str, samples: Vec<(Labels, f64)>) -> fmt::Result {
        if samples.is_empty() {
            return Ok(());
        }
        let counter = name.strip_suffix("_total");
        let kind = if counter.is_some() { MetricType::Counter } else { MetricType::Gauge };
        let mut family = self.encoder.encode_descriptor(counter.unwrap_or(name), help, None, kind)?;
        for (labels, value) in samples {
            let mut metric = family.encode_family(&labels)?;
            // Whole numbers without a decimal point, as people write them.
            let whole = (value.fract() == 0.0 && value.abs() < 1e15).then_some(value as i64);
            match (counter, whole) {
                (Some(_), Some(whole)) => metric.encode_counter::<Labels, u64, f64>(&whole.unsigned_abs(), None)?,
                (Some(_), None) => metric.encode_counter::<Labels, f64, f64>(&value, None)?,
                (None, Some(whole)) => metric.encode_gauge(&whole)?,
                (None, None) => metric.encode_gauge(&value)?,
            }
        }
        Ok(())
    }

    fn histogram(&mut self, name: &str, help: &str, samples: Vec<(Labels, &Histogram)>) -> fmt::Result {
        if samples.is_empty() {
            return Ok(());
        }
        let mut family = self.encoder.encode_descriptor(name, help, None, MetricType::Histogram)?;
        for (labels, times) in samples {
            let mut metric = family.encode_family(&labels)?;
            metric.encode_histogram::<Labels>(times.sum_s(), times.count(), &times.buckets(), None)?;
        }
        Ok(())
    }
}

/// These labels and one more.
fn and(labels: &Labels, name: &'static str, value: impl Into<String>) -> Labels {
    labels.iter().cloned().chain([(name, value.into())]).collect()
}

/// The counts by reason, with 0 for the known reasons that have not occurred.
fn with_zeros(known: &[&'static str], counts: &BTreeMap<&'static str, u64>) -> BTreeMap<&'static str, u64> {
    let zeros = known.iter().map(|reason| (*reason, 0));
    zeros.chain(counts.iter().map(|(reason, n)| (*reason, *n))).collect()
}

#[cfg(test)]
mod tests {
    use clearway_mapping::ledger::Ledger;

    use super::*;

    fn text(status: VehicleStatus) -> String {
        prometheus(&[Arc::new(status)], vec![], Format::Prometheus)
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
    fn known_reasons_are_there_before_they_occur_and_both_formats_name_counters_as_they_ask() {
        let (queue, _events) = crate::ingest::queue::event_queue(4);
        let status = Arc::new(VehicleStatus::new("car".into(), 1, vec!["drivability"], queue.drops()));
        let open = prometheus(std::slice::from_ref(&status), vec![], Format::OpenMetrics);
        assert!(open.contains("# TYPE clearway_maps counter\n") && open.ends_with("# EOF\n"), "{open}");
        let text = prometheus(&[status], vec![], Format::Prometheus);
        assert!(text.contains("# TYPE clearway_maps_total counter\n") && !text.contains("# EOF"), "{text}");
        for line in [
            "clearway_packets_refused_total{vehicle=\"car\",reason=\"length\"} 0\n",
            "clearway_skipped_maps_total{vehicle=\"car\",transport=\"page\"} 0\n",
            "clearway_vehicle_state{vehicle=\"car\",state=\"error\"} 1\n",
            "clearway_map_latency_seconds_count{vehicle=\"car\",stage=\"map\"} 0\n",
        ] {
            assert!(text.contains(line), "{line}{text}");
        }
    }
}
