//! The whole house in one process, on loopback: a simulated vehicle sends real UDP datagrams in real time at a server
//! of its own, and with many sensors scans, poses and roads over real gRPC; a line a second says what comes of them.

use std::net::{Ipv4Addr, SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::time::Duration;

use crate::encode::picture::{self, Style};
use clearway_proto::codec::Limits;
use clearway_proto::map::decode_map;
use clearway_sim::scanner::ScannerConfig;
use clearway_sim::scenes::town;
use clearway_sim::send::Sent;
use clearway_sim::traffic::street;
use serde_json::{Value, json};
use tokio::time::MissedTickBehavior;

use crate::config::{Config, Sender, Udp};
use crate::clock::now_ns;
use crate::server::{Running, Server, Setup, StartError};
use crate::status::Snapshot;
use crate::encode::EncodedMap;

use car::Car;
use rig::Rig;

pub mod car;
pub mod command;
pub mod rig;

/// The last datagrams are through the sockets long before this.
const SETTLE: Duration = Duration::from_millis(500);

/// What a demo is asked for.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// Ends after so long; without, when `stop` resolves.
    pub duration: Option<Duration>,
    /// Where to record.
    pub record: PathBuf,
    /// Where to draw the newest map, each second anew.
    pub picture: PathBuf,
    /// Two turning LIDARs and six that scan, poses and roads, in traffic; else one on the roof, in the town.
    pub many_sensors: bool,
    /// Ports of the operating system's choice everywhere, for tests that run beside each other.
    pub any_port: bool,
}

/// Where to look, as the demo begins.
#[derive(Clone, Debug)]
pub struct Places {
    /// The page.
    pub page: SocketAddr,
    /// gRPC.
    pub grpc: SocketAddr,
    /// zenoh's endpoints.
    pub zenoh: Vec<String>,
    /// The recording.
    pub record: PathBuf,
    /// The newest map, drawn from above.
    pub picture: PathBuf,
    /// What had to be chosen otherwise than usual.
    pub notes: Vec<String>,
}

/// One second of it.
#[derive(Clone, Debug)]
pub struct Second {
    /// Since the beginning.
    pub elapsed: Duration,
    /// Ledger, rates, latency.
    pub snapshot: Snapshot,
    /// Age of the newest map, from its capture's end.
    pub age_ms: Option<f64>,
}

/// Why a demo did not come to its end.
#[derive(Debug, thiserror::Error)]
pub enum DemoError {
    /// The server did not start.
    #[error(transparent)]
    Start(#[from] StartError),
    /// The server did not end as it should have.
    #[error(transparent)]
    End(#[from] crate::server::ShutdownError),
    /// The picture could not be drawn.
    #[error("picture {}: {reason}", file.display())]
    Picture {
        /// The file.
        file: PathBuf,
        /// Why.
        reason: String,
    },
    /// The simulated vehicle could not send.
    #[error("the simulated vehicle: {0}")]
    Vehicle(#[from] std::io::Error),
    /// The simulated vehicle's scans, poses or roads could not be told.
    #[error("the simulated vehicle: {0}")]
    Told(#[from] clearway_client::ClientError),
}

/// What came of it.
#[derive(Clone, Debug)]
pub struct Summary {
    /// The last second.
    pub last: Second,
    /// What the vehicle sent.
    pub sent: Sent,
}

impl Second {
    /// In one line.
    pub fn line(&self) -> String {
        let Self { elapsed, snapshot, age_ms } = self;
        let figure = |value: Option<f64>, unit: &str| value.map_or("-".into(), |value| format!("{value:.1} {unit}"));
        format!(
            "{:>4} s  {:>6} revolutions  {:>8} packets  {} refused  {} lost  age {}  latency {}  drivable {}",
            elapsed.as_secs(),
            snapshot.revolutions(),
            snapshot.ledger.received,
            snapshot.refused(),
            snapshot.ledger.lost + snapshot.ledger.kernel_drops,
            figure(*age_ms, "ms"),
            figure(snapshot.latency_ms_p50, "ms"),
            figure(snapshot.drivable_share.map(|share| 100.0 * share), "%"),
        )
    }

    /// As an object.
    pub fn to_json(&self) -> Value {
        let Self { elapsed, snapshot, age_ms } = self;
        json!({
            "seconds": elapsed.as_secs_f64(),
            "revolutions": snapshot.revolutions(),
            "maps": snapshot.maps,
            "packets": snapshot.packets_json(),
            "telemetry": snapshot.ledger.telemetry,
            "lost": snapshot.ledger.lost,
            "kernel_drops": snapshot.ledger.kernel_drops,
            "age_ms": age_ms,
            "latency_ms": { "p50": snapshot.latency_ms_p50, "p99": snapshot.latency_ms_p99 },
            "drivable_share": snapshot.drivable_share,
        })
    }
}

impl Summary {
    /// As an object.
    pub fn to_json(&self) -> Value {
        let mut object = self.last.to_json();
        object["sent"] = json!({ "packets": self.sent.packets, "telemetry": self.sent.telemetry });
        object
    }
}

/// Drives until the duration has passed or `stop` resolves. `begun` is told where to look, `second` sees the newest
/// map's server once a second. Needs a multi-thread tokio runtime.
///
/// # Errors
/// [`DemoError`]; nothing is left running.
pub async fn demo(
    options: Options,
    begun: impl FnOnce(&Places),
    mut second: impl FnMut(&Second),
    stop: impl Future<Output = ()>,
) -> Result<Summary, DemoError> {
    let (config, notes) = configuration(&options);
    let running = Server::start(Setup { config, ..Setup::default() }).await?;
    let nowhere = SocketAddr::new(Ipv4Addr::LOCALHOST.into(), 0);
    begun(&Places {
        page: running.page.unwrap_or(nowhere),
        grpc: running.grpc.unwrap_or(nowhere),
        zenoh: running.zenoh.clone(),
        record: options.record.clone(),
        picture: options.picture.clone(),
        notes,
    });
    let doors = running.inputs[0].udp.unwrap_or((nowhere, nowhere));
    // Last of all, so that the vehicle's first firing is now.
    let car = Car::start(vehicle(&options, now_ns()), doors, running.grpc.unwrap_or(nowhere))?;

    let began = tokio::time::Instant::now();
    let end = async {
        match options.duration {
            Some(duration) => tokio::time::sleep_until(began + duration).await,
            None => std::future::pending().await,
        }
    };
    tokio::pin!(stop, end);
    let now = |running: &Running| {
        let snapshot = running.vehicles.0[0].status.snapshot();
        let age_ms = (snapshot.maps > 0).then(|| (now_ns() - snapshot.newest_capture_end_ns) as f64 / 1e6);
        Second { elapsed: began.elapsed(), snapshot, age_ms }
    };
    let mut every = tokio::time::interval_at(began + Duration::from_secs(1), Duration::from_secs(1));
    every.set_missed_tick_behavior(MissedTickBehavior::Skip);
    loop {
        tokio::select! {
            biased;
            () = &mut stop => break,
            () = &mut end => break,
            _ = every.tick() => {
                second(&now(&running));
                let newest = running.vehicles.0[0].newest.borrow().clone();
                if let Some(map) = newest {
                    tokio::task::block_in_place(|| draw(&map, &options.picture))?;
                }
            }
        }
        if car.has_stopped() {
            break;
        }
    }
    let last = now(&running);
    let sent = car.stop().await;
    let status = running.vehicles.0[0].status.clone();
    let on_their_way = || {
        let ledger = status.snapshot().ledger;
        let accounted = ledger.received + ledger.lost + ledger.kernel_drops;
        sent.as_ref().is_ok_and(|sent| accounted < sent.packets + sent.telemetry)
    };
    let settled = tokio::time::Instant::now() + SETTLE;
    while on_their_way() && tokio::time::Instant::now() < settled {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    running.shutdown().await?;
    let sent = sent?;
    // Complete only now.
    Ok(Summary { last: Second { snapshot: status.snapshot(), ..last }, sent })
}

/// Draws a map's drivability; whoever looks at the file sees a whole picture, the old or the new one.
fn draw(map: &EncodedMap, file: &Path) -> Result<(), DemoError> {
    let wrong = |reason: String| DemoError::Picture { file: file.to_owned(), reason };
    let map = decode_map(map.select(&["drivability".into()]), &Limits::default()).map_err(|e| wrong(e.to_string()))?;
    let Some(layer) = map.layer("drivability") else { return Ok(()) };
    let style = Style { pixels: 640, range_m: None, rings_m: Some(10.0), vehicle: true };
    let bytes = picture::png(layer, &style).map_err(|error| wrong(error.to_string()))?;
    let unfinished = file.with_extension("png.part");
    std::fs::write(&unfinished, bytes).map_err(|error| wrong(error.to_string()))?;
    std::fs::rename(&unfinished, file).map_err(|error| wrong(error.to_string()))
}

/// The car, its scene beginning at `start_ns`.
fn vehicle(options: &Options, start_ns: i64) -> Rig {
    if options.many_sensors {
        return Rig::many(street(8.0), start_ns);
    }
    Rig { scene: town(), start_ns, scanners: vec![("top".into(), ScannerConfig::default())], units: Vec::new() }
}

/// The usual ports where they are free, any where they are not.
fn configuration(options: &Options) -> (Config, Vec<String>) {
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
    config.recorder.file = options.record.clone();
    let any = SocketAddr::new(Ipv4Addr::LOCALHOST.into(), 0);
    let rig = self::vehicle(options, 0);
    let vehicle = &mut config.vehicles[0];
    let sender =
        |(index, (name, _)): (usize, &(String, _))| (name.clone(), Sender::Address(car::address(index).into()));
    let from = rig.scanners.iter().enumerate().map(sender).filter(|_| options.many_sensors).collect();
    vehicle.udp = Some(Udp { data: any, telemetry: any, from, ..Udp::default() });
    vehicle.maps.speed.enabled |= options.many_sensors;
    // The simulated vehicle knows where its sensors are.
    if options.many_sensors {
        vehicle.sensors = rig.sensors();
    } else {
        vehicle.sensors[0].extrinsics = rig::extrinsics(&rig.scanners[0].1.ego_from_sensor);
    }
    (config, notes)
}
