//! The demo: a server, a car or a fleet that drives at it, and a report once a second.

use std::net::{Ipv4Addr, SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::Result;
use clearway_proto::codec::Limits;
use clearway_proto::map::decode_map;
use clearway_sim::send::Sent;
use tokio::time::{Instant, MissedTickBehavior};

use clearway_daemon::base::clock::now_ns;
use clearway_daemon::config::{Config, Sender, Udp, Vehicle};
use clearway_daemon::engine::newest::Newest;
use clearway_daemon::run::{Running, Server, Setup};
use clearway_daemon::status::process;
use clearway_journal::RecordedMaps;
use clearway_journal::encode::EncodedMap;

use super::car;
use super::fleet::{DemoFleet, NOWHERE, name, rig};
use super::report::{DemoReport, DemoSummary};
use super::rig::{self, Rig};
use super::sensors::{self, DemoSensors, SensorChoice};
use crate::picture::{self, PictureStyle};

/// How long the demo runs if no duration is given: a century.
const ENDLESS: Duration = Duration::from_secs(100 * 365 * 86_400);
/// How long the demo waits at its end for the last datagrams, which take far less to pass through the sockets.
const SETTLE: Duration = Duration::from_millis(500);
/// Greatest length of a recording in MiB, beyond which its oldest parts are deleted. Ours: a quarter of an hour with an
/// HDL-64E; of a black box, two minutes.
pub const RECORDING_MIB: u64 = 2048;
/// As [`RECORDING_MIB`], of a black box.
pub const BLACK_BOX_MIB: u64 = 256;

/// Options of a demo.
#[derive(Clone, Debug, Default)]
pub struct DemoOptions {
    /// How long the demo runs; `None`: until `stop` resolves.
    pub duration: Option<Duration>,
    /// The file that events and maps are recorded to; `None`: nothing is recorded.
    pub record: Option<PathBuf>,
    /// True if the recording is a black box: short, and without maps, which cost time and are made again from it.
    pub black_box: bool,
    /// The file that the newest map is drawn to every second; `None`: nothing is drawn.
    pub picture: Option<PathBuf>,
    /// The sensors with which the car drives.
    pub sensors: DemoSensors,
    /// Number of vehicles; one of several fails after a minute and comes back. 0 is 1.
    pub vehicles: usize,
    /// True if the operating system chooses every port, for tests that run beside each other.
    pub any_port: bool,
}

/// Where a running demo can be watched.
#[derive(Clone, Debug)]
pub struct DemoEndpoints {
    /// The address of the page.
    pub page: SocketAddr,
    /// The address of gRPC.
    pub grpc: SocketAddr,
    /// The endpoints on which zenoh listens.
    pub zenoh: Vec<String>,
    /// The sensors, and why they were chosen.
    pub sensors: String,
    /// Ports that differ from the usual ports, and why.
    pub notes: Vec<String>,
}

/// Drives until the duration has passed or `stop` resolves. Calls `begun` when the server runs, and `report` once a
/// second. Needs a multi-thread tokio runtime.
///
/// # Errors
/// If the server does not start or end as it should, or the car cannot send; nothing is left running.
pub async fn demo(
    options: DemoOptions,
    begun: impl FnOnce(&DemoEndpoints),
    mut report: impl FnMut(&DemoReport),
    stop: impl Future<Output = ()>,
) -> Result<DemoSummary> {
    let count = options.vehicles.max(1);
    let sensors = if count > 1 && options.sensors == DemoSensors::Auto { DemoSensors::Vlp16 } else { options.sensors };
    let choice = tokio::task::block_in_place(|| SensorChoice::new(sensors));
    let (config, notes) = configuration(&options, &rig(sensors, &choice, 0));
    let validity = Duration::from_millis(config.vehicles[0].maps.valid_ms.into());
    let running = Server::start(Setup { config, ..Setup::default() }).await?;
    begun(&endpoints(&running, describe(sensors, &choice), notes));
    let served = running.vehicles.0[0].clone();
    // The picture and the line need these layers, whether or not a reader subscribes to them.
    let _subscription = served.wires.subscriptions.subscribe(&["freespace".to_owned(), "drivability".to_owned()]);
    // The cars start after everything else, so that their first firings are now.
    let mut fleet = DemoFleet::start(&running, sensors, &choice, count)?;
    let cpu_s = || process::read().cpu_s;
    let cpu_before_s = cpu_s();

    let began = Instant::now();
    let end = tokio::time::sleep_until(began + options.duration.unwrap_or(ENDLESS));
    tokio::pin!(stop, end);
    let sensors = if sensors == DemoSensors::Many { "eight sensors" } else { sensors::name(choice.model) };
    let mut last = DemoReport { validity, sensors, ..DemoReport::default() };
    let now = |last: &DemoReport, fleet: &DemoFleet<'_>| {
        let snapshot = served.status.snapshot();
        let age_ms = (snapshot.maps > 0).then(|| (now_ns() - snapshot.newest_capture_end_ns) as f64 / 1e6);
        last.next(began.elapsed(), snapshot, age_ms, fleet.skipped())
    };
    let mut every = tokio::time::interval_at(began + Duration::from_secs(1), Duration::from_secs(1));
    every.set_missed_tick_behavior(MissedTickBehavior::Skip);
    let mut is_undrawn = false;
    while !fleet.has_stopped() {
        tokio::select! {
            biased;
            () = &mut stop => break,
            () = &mut end => break,
            _ = every.tick() => {
                last = now(&last, &fleet);
                report(&last);
                fleet.fail_in_turn(began.elapsed()).await?;
                draw_newest(served.newest.borrow().clone(), options.picture.as_deref(), &mut is_undrawn);
            }
        }
    }
    last = now(&last, &fleet);
    let cores = cpu_s().zip(cpu_before_s).map(|(now_s, before_s)| (now_s - before_s) / last.elapsed.as_secs_f64());
    let (sent, fault) = fleet.stop().await;
    if fault.is_none() {
        settle(&running, &sent).await;
    }
    running.shutdown().await?;
    fault.map_or(Ok(()), Err)?;
    // The counts are complete only now.
    Ok(DemoSummary { last: DemoReport { snapshot: served.status.snapshot(), ..last }, sent, cores })
}

fn endpoints(running: &Running, sensors: String, notes: Vec<String>) -> DemoEndpoints {
    let [page, grpc] = [running.page, running.grpc].map(|at| at.unwrap_or(NOWHERE));
    DemoEndpoints { page, grpc, zenoh: running.zenoh.clone(), sensors, notes }
}

/// Waits for the last datagrams, for [`SETTLE`] at most.
async fn settle(running: &Running, sent: &Sent) {
    let some_are_on_the_way = || {
        let ledgers = running.vehicles.0.iter().map(|of| of.status.snapshot().ledger);
        let accounted: u64 = ledgers.map(|ledger| ledger.received + ledger.lost + ledger.kernel_drops).sum();
        accounted < sent.packets + sent.telemetry
    };
    let until = Instant::now() + SETTLE;
    while some_are_on_the_way() && Instant::now() < until {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

/// Draws the newest map; the first failure is logged.
fn draw_newest(newest: Newest, picture: Option<&Path>, is_undrawn: &mut bool) {
    let Some((map, picture)) = newest.zip(picture) else { return };
    let drawn = tokio::task::block_in_place(|| draw(&map, picture));
    if let Err(error) = drawn
        && !std::mem::replace(is_undrawn, true)
    {
        tracing::warn!("picture {}: {error:#}", picture.display());
    }
}

/// Draws a map's free space. A reader of the file sees a whole picture, either the old or the new one.
fn draw(map: &EncodedMap, file: &Path) -> Result<()> {
    let map = decode_map(map.select(&["freespace".into()]), &Limits::default())?;
    let Some(layer) = map.layer("freespace") else { return Ok(()) };
    let unfinished = file.with_extension("png.part");
    std::fs::write(&unfinished, picture::png(&map.header, layer, &PictureStyle::default())?)?;
    Ok(std::fs::rename(&unfinished, file)?)
}

fn describe(sensors: DemoSensors, choice: &SensorChoice) -> String {
    match sensors {
        DemoSensors::Many => "two VLP-16 and six LIDARs of four planes".into(),
        _ => choice.to_string(),
    }
}

/// The server's configuration: the usual ports if they are free, else any; and a note on each port that is not free.
fn configuration(options: &DemoOptions, rig: &Rig) -> (Config, Vec<String>) {
    let mut config = Config::of_one_vehicle("car", "top");
    let mut notes = Vec::new();
    let mut port = |what: &str, at: SocketAddr| {
        if options.any_port {
            return SocketAddr::new(at.ip(), 0);
        }
        match TcpListener::bind(at) {
            Ok(_) => at,
            Err(error) => {
                notes.push(format!("{what}: {at}: {error}; another port is used"));
                SocketAddr::new(at.ip(), 0)
            }
        }
    };
    config.grpc.listen = port("gRPC", config.grpc.listen);
    config.page.listen = port("page", config.page.listen);
    let zenoh = port("zenoh", SocketAddr::new(Ipv4Addr::LOCALHOST.into(), 7447));
    config.zenoh.enabled = cfg!(feature = "zenoh");
    config.zenoh.listen = vec![format!("tcp/{zenoh}")];
    if let Some(file) = &options.record {
        config.recorder.file = file.clone();
        let keep_mib = if options.black_box { BLACK_BOX_MIB } else { RECORDING_MIB };
        // A quarter for each part, so that what is kept is never much less than what is allowed.
        (config.recorder.keep_mb, config.recorder.part_mb) = (keep_mib, keep_mib / 4);
        if options.black_box {
            // No disk is too slow for it.
            (config.recorder.maps, config.recorder.flush_ms) = (RecordedMaps::None, 10_000);
        }
    }
    let any = SocketAddr::new(Ipv4Addr::LOCALHOST.into(), 0);
    let many = options.sensors == DemoSensors::Many;
    let vehicle = &mut config.vehicles[0];
    let sender =
        |(index, (name, _)): (usize, &(String, _))| (name.clone(), Sender::Address(car::address(index).into()));
    let from = rig.scanners.iter().enumerate().map(sender).filter(|_| many).collect();
    vehicle.udp = Some(Udp { data: any, telemetry: any, from, ..Udp::default() });
    vehicle.maps.speed.enabled |= many;
    // The page's view in 3-D shows them.
    vehicle.maps.terrain.planes = true;
    // The rig states where its sensors are.
    if many {
        vehicle.sensors = rig.sensors();
    } else {
        vehicle.sensors[0].extrinsics = rig::extrinsics(&rig.scanners[0].1.ego_from_sensor);
    }
    let first = vehicle.clone();
    let other = |index| Vehicle { name: name(index), ..first.clone() };
    config.vehicles.extend((1..options.vehicles).map(other));
    (config, notes)
}
