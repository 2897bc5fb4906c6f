//! The test bed: from arriving readings to maps, readers and a recording, in ticks of a simulated clock.

use std::collections::{BTreeMap, VecDeque};
use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};
use std::sync::mpsc::Receiver;
use std::time::{Duration, Instant};

use clearway_daemon::base::clock::Clock;
use clearway_daemon::config::Config;
use clearway_daemon::engine::Engine;
use clearway_daemon::engine::wires::Wires;
use clearway_daemon::ingest::gateway::Gateway;
use clearway_daemon::ingest::queue::{EventQueue, QueuedEvent, event_queue_with_clock};
use clearway_daemon::ingest::receipt::{ClientSession, ObservationId, Outcome as EventOutcome, OutcomeSender};
use clearway_daemon::publish::{Served, Vehicles};
use clearway_daemon::record::writer::RecordingWriter;
use clearway_daemon::status::{Transport, VehicleStatus};
use clearway_journal::encode::EncodedMap;
use clearway_journal::mcap_file::RecordingHeader;
use clearway_mapping::pipeline::{Pipeline, layer_names};
use clearway_proto::v1;
use clearway_sim::impair::Impairment;
use tokio::sync::mpsc::{UnboundedReceiver, unbounded_channel};
use tokio::sync::watch;

use super::checks::{Violation, accounts, adds_up, describe, freed, is_healthy, nothing_free, violation};
use super::drive::{Drive, drives};
use super::fault_plan::{
    DiskFault, END_NS, FLUSH_MS, FaultPlan, HEAL_NS, InjectedFault, REVOLUTION_NS, Rng, TICK_NS, WARM_UP_MS,
};
use super::readers::{SimulatedReader, readers};
use super::recording_check::{MemoryDisk, Recorded};

/// Revolutions with a covered window until maps must show it: the revolution in which it was covered, another
/// revolution, and the revolutions in which the newest scan of a stopped sensor may still contribute.
const REVOLUTIONS_TO_COVER: i64 = 4;

/// The whole system, and the networks of its sensors.
pub(super) struct TestBed<'a> {
    pub(super) plan: &'a FaultPlan,
    pub(super) injected: Option<InjectedFault>,
    pub(super) drive: &'static Drive,
    pub(super) rng: Rng,
    pub(super) now_ns: i64,

    pub(super) clock: Arc<AtomicI64>,
    pub(super) queue: EventQueue,
    pub(super) events: Receiver<QueuedEvent>,
    pub(super) engine: Engine,
    pub(super) vehicles: Vehicles,
    pub(super) maps: Vec<Arc<EncodedMap>>,
    pub(super) taken: u64,
    /// Epoch of the newest map.
    pub(super) epoch: u32,
    /// Completion of the newest map in which a sensor was not whole.
    pub(super) unhealthy_ns: i64,
    /// End of the newest tick in which a planner on the server's host could not use the newest map.
    pub(super) stale_ns: i64,

    pub(super) networks: Vec<Impairment>,
    /// Datagrams on their way, by arrival time and number.
    pub(super) arriving: BTreeMap<(i64, u64), (u16, Vec<u8>)>,
    pub(super) datagrams: u64,
    pub(super) next_sent: usize,
    pub(super) offered: u64,

    pub(super) gateway: Gateway,
    pub(super) waiting: VecDeque<v1::Observation>,
    pub(super) session: ClientSession,
    pub(super) observations: u64,
    pub(super) outcome_sender: OutcomeSender,
    pub(super) outcomes: UnboundedReceiver<(ObservationId, EventOutcome)>,

    pub(super) readers: Vec<SimulatedReader>,

    pub(super) began: Instant,
    pub(super) disk: MemoryDisk,
    pub(super) writer: Option<RecordingWriter<MemoryDisk>>,
    /// What the disk held when the machine crashed.
    pub(super) recorded_at_crash: Option<Recorded>,
}

impl<'a> TestBed<'a> {
    pub fn new(plan: &'a FaultPlan, injected: Option<InjectedFault>) -> Self {
        let drive = &drives()[plan.drive];
        let config = config(drive, plan);
        let vehicle = &config.vehicles[0];
        let layers = layer_names(&vehicle.maps);
        let clock = Arc::new(AtomicI64::new(0));
        let (queue, events) = event_queue_with_clock(
            Clock::new({
                let clock = clock.clone();
                move || clock.load(Ordering::Relaxed)
            }),
            vehicle.queue,
        );
        let vehicles = vec![("car".into(), layers.clone())];
        let header = RecordingHeader { boot_id: 1, config: config.to_toml(), vehicles, ..RecordingHeader::default() };
        let disk = MemoryDisk::new(plan.disk.clone());
        let began = Instant::now();
        let tables = vec![None; vehicle.sensors.len()];
        let (writer, journal) = match RecordingWriter::new(disk.clone(), &config.recorder, &header, false, began) {
            Ok((writer, mut journals)) => {
                journals.iter_mut().for_each(|journal| journal.set_config(vehicle.core(), tables.clone()));
                (Some(writer), journals.pop())
            }
            // The disk is full before the first event: the run goes on without a recording.
            Err(_) => (None, None),
        };
        let wires = Wires::new(&layers);
        let status = Arc::new(VehicleStatus::new("car".into(), 1, layers.clone(), queue.drops()));
        writer.iter().for_each(|writer| status.show_recorder(writer.counts()));
        let (newest, receiver) = watch::channel(None);
        let pipeline = Pipeline::new(&vehicle.core(), tables).expect("a valid car");
        let valid_ms = vehicle.maps.valid_ms;
        let engine = Engine {
            pipeline,
            valid_ms,
            newest,
            wires: wires.clone(),
            recording: journal,
            status: status.clone(),
            observer: None,
            plan: None,
            replayed: None,
        };
        let mut rng = Rng::new(!plan.seed);
        let (outcome_sender, outcomes) = unbounded_channel();
        Self {
            plan,
            injected,
            drive,
            now_ns: 0,
            clock,
            gateway: Gateway::new(vehicle, &queue),
            queue,
            events,
            engine,
            vehicles: Vehicles(vec![Served::new(status, receiver, wires, None)].into()),
            maps: Vec::new(),
            taken: 0,
            epoch: 0,
            unhealthy_ns: 0,
            stale_ns: 0,
            networks: plan.networks.iter().map(|faults| Impairment::new(*faults)).collect(),
            arriving: BTreeMap::new(),
            datagrams: 0,
            next_sent: drive.sent.partition_point(|sent| sent.offset_ns < plan.offset_ns),
            offered: 0,
            waiting: VecDeque::new(),
            session: ClientSession::new(0),
            observations: 0,
            outcome_sender,
            outcomes,
            readers: readers(&mut rng, &layers),
            rng,
            began,
            disk,
            writer,
            recorded_at_crash: None,
        }
    }

    pub fn run(&mut self) -> Result<(), Violation> {
        while self.now_ns < END_NS {
            self.now_ns += TICK_NS;
            self.send();
            self.arrive();
            self.observe();
            if !during(&self.plan.engine_stall, self.now_ns) {
                self.step()?;
                self.engine.update_status();
                let snapshot = self.vehicles.0[0].status.snapshot();
                accounts(self.offered, &snapshot.ledger, &snapshot.sensors)?;
            }
            self.check_age();
            for reader in &mut self.readers {
                reader.poll_at(self.now_ns, &self.vehicles, &self.maps, self.injected)?;
            }
            let open = self.readers.iter().filter(|reader| reader.is_open()).count() as u32;
            let counted = self.vehicles.0[0].status.transports.count(Transport::Grpc);
            if counted != open {
                return Err(violation("reader", format!("{open} readers are open, {counted} are counted")));
            }
            self.record();
        }
        Ok(())
    }

    /// Lets the engine process everything that waits.
    pub fn step(&mut self) -> Result<(), Violation> {
        while let Ok(queued) = self.events.try_recv() {
            self.taken += 1;
            let journal = (self.injected == Some(InjectedFault::UnrecordedEvent) && self.taken == 300)
                .then(|| self.engine.recording.take());
            self.engine.step(queued);
            if let Some(journal) = journal {
                self.engine.recording = journal;
            }
            adds_up("the vehicle", self.engine.pipeline.ledger())?;
            let newest = self.engine.newest.borrow().clone();
            if let Some(map) = newest.filter(|map| self.maps.len() as u64 <= map.sequence) {
                self.check_map(map)?;
            }
        }
        Ok(())
    }

    fn check_map(&mut self, encoded: Arc<EncodedMap>) -> Result<(), Violation> {
        let Some(map) = self.engine.pipeline.newest_map() else {
            return Err(violation("map", "encoded, but not made"));
        };
        if encoded.sequence != self.maps.len() as u64 || encoded.sequence != map.sequence {
            return Err(violation("map", format!("number {} after {} maps", encoded.sequence, self.maps.len())));
        }
        let stuck = self.injected == Some(InjectedFault::StuckStamp);
        let announced = map.epoch.checked_sub(std::mem::replace(&mut self.epoch, map.epoch));
        if let Some(before) = self.maps.last() {
            let goes_back = stuck || before.capture_end_ns >= encoded.capture_end_ns;
            if announced != Some(u32::from(goes_back)) {
                let back_ms = before.capture_end_ns.saturating_sub(encoded.capture_end_ns) / 1_000_000;
                let found =
                    format!("{back_ms} ms before map {}, epoch {}: {}", before.sequence, map.epoch, describe(map));
                return Err(violation("stamps", found));
            }
        }
        if let Some((sector, when)) = &self.plan.covered {
            let at_ns = map.completed_ns - self.drive.rig.start_ns - self.plan.offset_ns;
            if (when.start + REVOLUTIONS_TO_COVER * REVOLUTION_NS..when.end).contains(&at_ns) {
                match self.injected {
                    Some(InjectedFault::FreedCells) => nothing_free(self.drive, sector, &freed(map))?,
                    _ => nothing_free(self.drive, sector, map)?,
                }
            }
        }
        if !is_healthy(map) {
            self.unhealthy_ns = self.now_ns;
        }
        self.maps.push(encoded);
        Ok(())
    }

    /// Notes whether the newest map is too old, or too far ahead of the host's clock.
    fn check_age(&mut self) {
        let valid_ns = i64::from(self.engine.valid_ms) * 1_000_000;
        let age_ns = |map: &Arc<EncodedMap>| self.clock.load(Ordering::Relaxed).saturating_sub(map.capture_end_ns);
        if self.maps.last().is_none_or(|map| age_ns(map).saturating_abs() > valid_ns) {
            self.stale_ns = self.now_ns;
        }
    }

    pub fn instant(&self) -> Instant {
        self.began + Duration::from_nanos(self.now_ns.unsigned_abs())
    }

    /// Lets the recorder write everything that waits.
    fn record(&mut self) {
        let now = self.instant();
        if !during(&self.plan.recorder_stall, self.now_ns)
            && let Some(writer) = &mut self.writer
        {
            while writer.write_next(now) {}
        }
        if let (DiskFault::Crash(at_ns, torn), Some(writer)) = (&self.plan.disk, &self.writer)
            && self.recorded_at_crash.is_none()
            && self.now_ns >= *at_ns
        {
            let counts = writer.counts();
            let (durable, lost) = (counts.durable_events("car"), counts.lost());
            let files = self.disk.files_after_crash(*torn);
            self.recorded_at_crash = Some(Recorded { files, counts, expected: None, durable, lost });
        }
    }
}

/// True while a fault lasts.
pub(super) fn during(when: &Option<Range<i64>>, now_ns: i64) -> bool {
    now_ns < HEAL_NS && when.as_ref().is_some_and(|when| when.contains(&now_ns))
}

/// The configuration of the drive's car in this run.
fn config(drive: &Drive, plan: &FaultPlan) -> Config {
    let mut config = drive.config.clone();
    config.recorder.flush_ms = FLUSH_MS;
    config.recorder.queue = plan.recorder_queue;
    config.recorder.warm_up_ms = WARM_UP_MS;
    config.recorder.part_s = u64::from(plan.parts);
    let vehicle = &mut config.vehicles[0];
    vehicle.queue = plan.queue;
    let maps = &mut vehicle.maps;
    if plan.all_maps {
        maps.speed.enabled = true;
    } else {
        for enabled in [&mut maps.height_difference.enabled, &mut maps.terrain.enabled, &mut maps.safe_path.enabled] {
            *enabled = false;
        }
        (maps.occupancy.extent_m, maps.occupancy.cell_m) = (30.0, 0.5);
    }
    config
}
