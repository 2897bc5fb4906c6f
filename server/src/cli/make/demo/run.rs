//! The demo: a server, a car that drives at it, and a report once a second.

use std::net::{Ipv4Addr, SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::time::Duration;

use clearway_proto::codec::Limits;
use clearway_proto::map::decode_map;
use clearway_sim::scenes::town;
use clearway_sim::traffic::street;
use tokio::time::MissedTickBehavior;

use clearway_daemon::base::clock::now_ns;
use clearway_daemon::config::{Config, Sender, Udp};
use clearway_daemon::encode::picture::{self, Style};
use clearway_daemon::run::{Running, Server, Setup};
use clearway_journal::encode::EncodedMap;

use super::car::{self, Car};
use super::error::{DemoError, PictureError};
use super::report::{Report, Summary};
use super::rig::{self, Rig};
use super::sensors::{self, Choice, Sensors};

/// How long the demo waits at its end for the last datagrams, which take far less to pass through the sockets.
const SETTLE: Duration = Duration::from_millis(500);

/// What the demo does.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// How long the demo runs; `None`: until `stop` resolves.
    pub duration: Option<Duration>,
    /// The file that events and maps are recorded to; `None`: nothing is recorded.
    pub record: Option<PathBuf>,
    /// True if an existing file of that name is replaced.
    pub force: bool,
    /// Greatest length of the recording in MiB, beyond which its oldest parts are deleted; 0: no limit.
    pub record_mb: u64,
    /// The file that the newest map is drawn to every second; `None`: nothing is drawn.
    pub picture: Option<PathBuf>,
    /// The car's sensors.
    pub sensors: Sensors,
    /// True if the operating system chooses every port, for tests that run beside each other.
    pub any_port: bool,
}

/// Where a running demo can be watched.
#[derive(Clone, Debug)]
pub struct Endpoints {
    /// The address of the page.
    pub page: SocketAddr,
    /// The address of gRPC.
    pub grpc: SocketAddr,
    /// zenoh's endpoints.
    pub zenoh: Vec<String>,
    /// The sensors, and why they were chosen.
    pub sensors: String,
    /// Ports that differ from the usual ones, and why.
    pub notes: Vec<String>,
}

/// Drives until the duration has passed or `stop` resolves. Calls `begun` when the server runs, and `report` once a
/// second. Needs a multi-thread tokio runtime.
///
/// # Errors
/// [`DemoError`], which names the part that failed; nothing is left running.
pub async fn demo(
    options: Options,
    begun: impl FnOnce(&Endpoints),
    mut report: impl FnMut(&Report),
    stop: impl Future<Output = ()>,
) -> Result<Summary, DemoError> {
    let choice = tokio::task::block_in_place(|| Choice::new(options.sensors));
    let rig = |start_ns| rig(options.sensors, &choice, start_ns);
    let (config, notes) = configuration(&options, &rig(0));
    let validity = Duration::from_millis(config.vehicles[0].maps.valid_ms.into());
    let running = Server::start(Setup { config, ..Setup::default() }).await?;
    let nowhere = SocketAddr::new(Ipv4Addr::LOCALHOST.into(), 0);
    begun(&Endpoints {
        page: running.page.unwrap_or(nowhere),
        grpc: running.grpc.unwrap_or(nowhere),
        zenoh: running.zenoh.clone(),
        sensors: describe(options.sensors, &choice),
        notes,
    });
    let udp = running.inputs[0].udp.unwrap_or((nowhere, nowhere));
    let served = running.vehicles.0[0].clone();
    // The picture and the line need this layer, whether or not a reader subscribes to it.
    let _subscription = served.status.subscriptions.subscribe(&["drivability".to_owned()]);
    // The car starts after everything else, so that its first firing is now.
    let car = Car::start(rig(now_ns()), udp, running.grpc.unwrap_or(nowhere), &served.newest)?;

    let began = tokio::time::Instant::now();
    let end = async {
        match options.duration {
            Some(duration) => tokio::time::sleep_until(began + duration).await,
            None => std::future::pending().await,
        }
    };
    tokio::pin!(stop, end);
    let sensors = if options.sensors == Sensors::Many { "eight sensors" } else { sensors::name(choice.model) };
    let mut last = Report { validity, sensors, ..Report::default() };
    let now = |running: &Running, last: &Report| {
        let snapshot = running.vehicles.0[0].status.snapshot();
        let age_ms = (snapshot.maps > 0).then(|| (now_ns() - snapshot.newest_capture_end_ns) as f64 / 1e6);
        last.next(began.elapsed(), snapshot, age_ms, car.skipped())
    };
    let mut every = tokio::time::interval_at(began + Duration::from_secs(1), Duration::from_secs(1));
    every.set_missed_tick_behavior(MissedTickBehavior::Skip);
    loop {
        tokio::select! {
            biased;
            () = &mut stop => break,
            () = &mut end => break,
            _ = every.tick() => {
                last = now(&running, &last);
                report(&last);
                let newest = served.newest.borrow().clone();
                if let Some((map, picture)) = newest.zip(options.picture.as_deref()) {
                    let drawn = tokio::task::block_in_place(|| draw(&map, picture));
                    drawn.unwrap_or_else(|error| tracing::warn!("{error}"));
                }
            }
        }
        if car.has_stopped() {
            break;
        }
    }
    last = now(&running, &last);
    let sent = car.stop().await;
    let status = running.vehicles.0[0].status.clone();
    let some_are_on_the_way = || {
        let ledger = status.snapshot().ledger;
        let accounted = ledger.received + ledger.lost + ledger.kernel_drops;
        sent.as_ref().is_ok_and(|sent| accounted < sent.packets + sent.telemetry)
    };
    let settled = tokio::time::Instant::now() + SETTLE;
    while some_are_on_the_way() && tokio::time::Instant::now() < settled {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    running.shutdown().await?;
    let sent = sent?;
    // The counts are complete only now.
    Ok(Summary { last: Report { snapshot: status.snapshot(), ..last }, sent })
}

/// Draws a map's drivability. A reader of the file sees a whole picture, either the old or the new one.
fn draw(map: &EncodedMap, file: &Path) -> Result<(), PictureError> {
    let error = |reason: String| PictureError { file: file.to_owned(), reason };
    let map = decode_map(map.select(&["drivability".into()]), &Limits::default()).map_err(|e| error(e.to_string()))?;
    let Some(layer) = map.layer("drivability") else { return Ok(()) };
    let style = Style { pixels: 640, rings_m: Some(10.0), ..Style::default() };
    let bytes = picture::png(layer, &style).map_err(|e| error(e.to_string()))?;
    let unfinished = file.with_extension("png.part");
    std::fs::write(&unfinished, bytes).map_err(|e| error(e.to_string()))?;
    std::fs::rename(&unfinished, file).map_err(|e| error(e.to_string()))
}

/// The car; its scene begins at `start_ns`.
fn rig(sensors: Sensors, choice: &Choice, start_ns: i64) -> Rig {
    match sensors {
        Sensors::Many => Rig::many(street(8.0), start_ns),
        _ => Rig::one(choice.model, town(), start_ns),
    }
}

fn describe(sensors: Sensors, choice: &Choice) -> String {
    match sensors {
        Sensors::Many => "two VLP-16 and six LIDARs of four planes".into(),
        _ => choice.to_string(),
    }
}

/// The server's configuration: the usual ports if they are free, else any; and a note on each port that is not free.
fn configuration(options: &Options, rig: &Rig) -> (Config, Vec<String>) {
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
        config.recorder.replaces = options.force;
        // A quarter for each part, so that what is kept is never much less than what is allowed.
        (config.recorder.keep_mb, config.recorder.part_mb) = (options.record_mb, options.record_mb.div_ceil(4));
    }
    let any = SocketAddr::new(Ipv4Addr::LOCALHOST.into(), 0);
    let many = options.sensors == Sensors::Many;
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
    (config, notes)
}
