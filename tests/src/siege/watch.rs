//! The healthy readers and the healthy sender beside an attack, a newcomer, and the server's memory: what an attack
//! costs.

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use clearway_client::{Client, ClientError, MapStream, Observation, Subscription, ZenohClient, now_ns};

use super::target::Target;

/// Longest time that a reader waits for one map, or a newcomer for its first.
const PATIENCE: Duration = Duration::from_secs(5);
/// Time between two scans of the sender.
const SCAN_PERIOD: Duration = Duration::from_millis(100);

/// What one reader has seen since the last [`SiegeReader::take`].
#[derive(Clone, Debug, Default)]
pub struct Seen {
    /// Age of each map on arrival, in ms.
    pub ages_ms: Vec<f64>,
    /// Maps that it did not get, by their sequences.
    pub missed: u64,
    /// Times that the stream ended or gave no map for [`PATIENCE`].
    pub broken: u64,
    /// Messages that were passed over because no honest publisher sends them.
    pub passed_over: u64,
}

impl Seen {
    /// The age that this share of the maps does not exceed, in ms; 0 without maps.
    pub fn age_ms(&mut self, share: f64) -> f64 {
        self.ages_ms.sort_by(f64::total_cmp);
        let last = self.ages_ms.len().saturating_sub(1);
        self.ages_ms.get((last as f64 * share).round() as usize).copied().unwrap_or_default()
    }
}

/// A reader in a thread and a runtime of its own, so that the attackers' tasks do not delay it.
pub struct SiegeReader {
    seen: Arc<Mutex<Seen>>,
    stop: Arc<AtomicBool>,
    thread: JoinHandle<()>,
}

impl SiegeReader {
    /// Starts a reader over gRPC, or over zenoh.
    pub fn start(target: &Target, over_zenoh: bool) -> Self {
        let (seen, stop, target) = (Arc::<Mutex<Seen>>::default(), Arc::<AtomicBool>::default(), target.clone());
        let thread = std::thread::spawn({
            let (seen, stop) = (seen.clone(), stop.clone());
            move || {
                let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build();
                runtime.expect("a runtime").block_on(read(&target, over_zenoh, &seen, &stop));
            }
        });
        Self { seen, stop, thread }
    }

    /// What it has seen since the last call.
    pub fn take(&self) -> Seen {
        std::mem::take(&mut *self.seen.lock().expect("the reader does not panic"))
    }

    /// Stops the reader and waits for its thread.
    pub fn stop(self) {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.join().expect("the reader does not panic");
    }
}

async fn subscribe(target: &Target, over_zenoh: bool) -> Result<MapStream, ClientError> {
    if over_zenoh {
        return ZenohClient::connect(&target.zenoh).await?.subscribe("car", "drivability").await;
    }
    // All layers, so that an attacker who asks for more layers costs the engine nothing that is not made anyway.
    Client::connect(&target.grpc.to_string()).await?.subscribe(Subscription::default()).await
}

async fn read(target: &Target, over_zenoh: bool, seen: &Mutex<Seen>, stop: &AtomicBool) {
    let seen = || seen.lock().expect("the siege does not panic");
    while !stop.load(Ordering::Relaxed) {
        let Ok(mut maps) = subscribe(target, over_zenoh).await else {
            seen().broken += 1;
            tokio::time::sleep(Duration::from_millis(200)).await;
            continue;
        };
        let mut passed_over = 0;
        while !stop.load(Ordering::Relaxed) {
            let Ok(Ok(update)) = tokio::time::timeout(PATIENCE, maps.next()).await else {
                seen().broken += 1;
                break;
            };
            let mut seen = seen();
            seen.ages_ms.push(update.map.age_ms(now_ns()));
            seen.missed += update.skipped;
            let hostile = maps.passed_over().hostile();
            seen.passed_over += hostile - passed_over;
            passed_over = hostile;
        }
    }
}

/// A sender over zenoh of ten scans a second of a plain, in a thread and a runtime of its own.
pub struct Sender {
    /// Scans that were sent and not refused, since the last [`Sender::take`].
    accepted: Arc<AtomicU64>,
    since: Mutex<Instant>,
    stop: Arc<AtomicBool>,
    thread: JoinHandle<()>,
}

impl Sender {
    /// Starts to send the scans of the sensor `side`.
    pub fn start(target: &Target) -> Self {
        let (accepted, stop, target) = (Arc::<AtomicU64>::default(), Arc::<AtomicBool>::default(), target.clone());
        let thread = std::thread::spawn({
            let (accepted, stop) = (accepted.clone(), stop.clone());
            move || {
                let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build();
                runtime.expect("a runtime").block_on(async {
                    while !stop.load(Ordering::Relaxed) {
                        let _ended = send(&target, &accepted, &stop).await;
                    }
                });
            }
        });
        Self { accepted, since: Mutex::new(Instant::now()), stop, thread }
    }

    /// Scans that were due since the last call and were refused, or not sent because too many before them were not
    /// acknowledged.
    pub fn take(&self) -> u64 {
        let since = std::mem::replace(&mut *self.since.lock().expect("the siege does not panic"), Instant::now());
        // One may be due at this moment.
        let due = (since.elapsed().as_millis() / SCAN_PERIOD.as_millis()).saturating_sub(1) as u64;
        due.saturating_sub(self.accepted.swap(0, Ordering::Relaxed))
    }

    /// Stops the sender and waits for its thread.
    pub fn stop(self) {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.join().expect("the sender does not panic");
    }
}

async fn send(target: &Target, accepted: &AtomicU64, stop: &AtomicBool) -> Result<(), ClientError> {
    let mut ingester = ZenohClient::connect(&target.zenoh).await?.ingest("car").await?;
    let [x, y, z] = plain(20_000);
    let mut due = tokio::time::interval(SCAN_PERIOD);
    due.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Skip);
    // Refusals are known later than their scans were sent.
    let mut refused = 0;
    while !stop.load(Ordering::Relaxed) {
        due.tick().await;
        ingester.send(Observation::scan("side", now_ns(), &x, &y, &z)).await?;
        refused += ingester.refusals().len();
        match refused {
            0 => _ = accepted.fetch_add(1, Ordering::Relaxed),
            _ => refused -= 1,
        }
    }
    Ok(())
}

/// x, y and z of points on the ground around a sensor at the height of `top`.
pub fn plain(points: u32) -> [Vec<f32>; 3] {
    let angle = |ray: u32| ray as f32 * std::f32::consts::TAU * 20.0 / points as f32;
    let range_m = |ray: u32| 3.0 + (ray % 20) as f32 * 1.5;
    let list = |of: &dyn Fn(u32) -> f32| (0..points).map(of).collect::<Vec<_>>();
    [list(&|ray| angle(ray).cos() * range_m(ray)), list(&|ray| angle(ray).sin() * range_m(ray)), list(&|_| -1.9)]
}

/// Time until a new client has its first map over gRPC; `None` if it has none after [`PATIENCE`].
pub async fn newcomer(target: &Target) -> Option<Duration> {
    let began = Instant::now();
    let first = async { subscribe(target, false).await.ok()?.next().await.ok() };
    tokio::time::timeout(PATIENCE, first).await.ok().flatten().map(|_| began.elapsed())
}

/// Processor time that a process has used, in s: fields 14 and 15 of `/proc/<process>/stat`, in hundredths.
pub fn processor_s(process: u32) -> f64 {
    let stat = std::fs::read_to_string(PathBuf::from(format!("/proc/{process}/stat"))).unwrap_or_default();
    let after_name = stat.rsplit_once(')').map_or("", |(_, after)| after);
    let ticks = after_name.split_whitespace().skip(11).take(2).filter_map(|ticks| ticks.parse::<f64>().ok());
    ticks.sum::<f64>() / 100.0
}

/// Resident memory of a process, in MiB.
pub fn resident_mib(process: u32) -> f64 {
    let status = std::fs::read_to_string(PathBuf::from(format!("/proc/{process}/status"))).unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    let kib = line.and_then(|line| line.split_whitespace().next()?.parse::<f64>().ok());
    kib.unwrap_or_default() / 1024.0
}
