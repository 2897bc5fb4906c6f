//! A capture, or an MCAP file with VelodyneScan messages -> its datagrams, sent over UDP at the recorded pace, through
//! a bad network if one is wanted.

use std::collections::{BTreeMap, VecDeque};
use std::fs::File;
use std::io::BufReader;
use std::net::{SocketAddr, ToSocketAddrs};
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use anyhow::{Context, Error, Result, bail};
use clearway_daemon::base::files;
use clearway_journal::mcap_reader::McapReader;
use clearway_lidar::capture::Capture;
use clearway_lidar::capture_sensor::CaptureSensor;
use clearway_lidar::packet::PACKET_LENGTH;
use clearway_lidar::telemetry::TELEMETRY_LENGTH;
use clearway_replay::files::{Kind as FileKind, kind};
use clearway_ros::velodyne_scan::VelodyneScan;
use clearway_sim::impair::{Counts, Faults, Impairment};
use clearway_sim::send::{Sent, Until, drive};
use clearway_sim::vehicle::{Datagram, Kind};

pub use clearway_sim::send::Pace;

/// Longest gap between two datagrams that is kept, in nanoseconds; a longer one becomes none.
const GAP_NS_MAX: i64 = 60_000_000_000;

/// Time after which a file with a single datagram begins again, in nanoseconds. Ours: a revolution.
const LONE_NS: i64 = 100_000_000;

/// What is sent, where to, and how.
#[derive(Clone, Debug)]
pub struct SendOptions {
    /// The capture: pcap, pcapng, or MCAP with VelodyneScan messages.
    pub file: PathBuf,
    /// Target of the data packets.
    pub to: SocketAddr,
    /// Target of the telemetry.
    pub telemetry_to: SocketAddr,
    /// Address to send from.
    pub own: SocketAddr,
    /// How fast the datagrams are sent.
    pub pace: Pace,
    /// True: the file is sent again and again.
    pub repeats: bool,
    /// Faults of the network; `None`: a good one.
    pub faults: Option<Faults>,
}

/// Finds the address of a target such as `udp://127.0.0.1:2368`.
///
/// # Errors
/// If the text is not `udp://HOST:PORT` or the host has no address.
pub fn target(text: &str) -> Result<SocketAddr> {
    let allowed = || format!("{text:?}: udp://HOST:PORT is allowed");
    let mut found = text.strip_prefix("udp://").with_context(allowed)?.to_socket_addrs().with_context(allowed)?;
    found.next().with_context(|| format!("{text:?}: the host has no address"))
}

/// Counts of what was sent, with the time that it took.
#[derive(Clone, Debug)]
pub struct SendSummary {
    /// Number of datagrams.
    pub sent: Sent,
    /// Time from the first datagram to the last.
    pub elapsed: Duration,
    /// Number of datagrams and messages that were not sent, by reason.
    pub skipped: BTreeMap<String, u64>,
    /// What else of the capture was ignored, for people: other sensors, other packets.
    pub notes: Vec<String>,
    /// Why the file is not whole; `None` if it is.
    pub cut: Option<String>,
    /// What the bad network did; `None` of a good one.
    pub network: Option<Counts>,
}

/// Sends the datagrams of the file, until another thread sets `stop`. `progress` is called with the bytes read.
///
/// # Errors
/// If the file cannot be read or has no Velodyne datagram, or a datagram cannot be sent. A file that is cut off is not
/// an error: the summary says so.
pub fn send(options: &SendOptions, stop: &AtomicBool, progress: impl FnMut(u64)) -> Result<SendSummary> {
    let mut datagrams = RecordedDatagrams::open(&options.file, options.repeats, progress)?;
    let mut network = options.faults.map(Impairment::new);
    let began = Instant::now();
    let send = |arriving: &mut dyn Iterator<Item = Datagram>| {
        let (own, to, telemetry_to) = (options.own, options.to, options.telemetry_to);
        let until = Until { stop: Some(stop), device_time: None };
        drive(own, arriving, to, telemetry_to, options.pace, until).with_context(|| format!("send to {to}"))
    };
    let sent = match &mut network {
        None => send(&mut datagrams)?,
        Some(network) => send(&mut Arriving { sent: &mut datagrams, network, arrived: VecDeque::new() })?,
    };
    let elapsed = began.elapsed();
    if let Some(error) = datagrams.error {
        return Err(error);
    }
    if sent.packets + sent.telemetry == 0 {
        let notes: String = datagrams.notes.iter().map(|note| format!("; {note}")).collect();
        bail!("{} has no Velodyne datagram{notes}", options.file.display());
    }
    let network = network.map(|network| network.counts());
    Ok(SendSummary { sent, elapsed, skipped: datagrams.skipped, notes: datagrams.notes, cut: datagrams.cut, network })
}

/// The datagrams of a file, with gaps of at most [`GAP_NS_MAX`]. They end at the first error.
struct RecordedDatagrams<P> {
    source: DatagramSource,
    /// The file, if it begins again at its end.
    again: Option<PathBuf>,
    progress: P,
    /// Datagrams that are read and not returned yet.
    read: VecDeque<Datagram>,
    skipped: BTreeMap<String, u64>,
    sensor: CaptureSensor,
    notes: Vec<String>,
    cut: Option<String>,
    error: Option<Error>,
    /// Stamp of the newest datagram as recorded, in nanoseconds; `None` at the beginning of the file.
    newest_ns: Option<i64>,
    /// Number of datagrams of the file so far, and the stamp at which they began, without gaps that are left out.
    pass: (i64, i64),
    /// Its stamp without the gaps that are left out; `None` before the first.
    sent_ns: Option<i64>,
}

enum DatagramSource {
    Capture(Box<Capture<'static>>),
    Mcap(Box<McapReader>),
}

impl DatagramSource {
    fn open(file: &Path) -> Result<Self> {
        let (open, _) = files::open(file)?;
        Ok(match kind(file)? {
            FileKind::Mcap => Self::Mcap(Box::new(McapReader::open(file)?)),
            _ => {
                let capture = Capture::new(BufReader::<File>::new(open));
                Self::Capture(Box::new(capture.with_context(|| file.display().to_string())?))
            }
        })
    }
}

impl<P: FnMut(u64)> RecordedDatagrams<P> {
    fn open(file: &Path, repeats: bool, progress: P) -> Result<Self> {
        Ok(Self {
            source: DatagramSource::open(file)?,
            again: repeats.then(|| file.to_owned()),
            progress,
            read: VecDeque::new(),
            skipped: BTreeMap::new(),
            sensor: CaptureSensor::default(),
            notes: Vec::new(),
            cut: None,
            error: None,
            newest_ns: None,
            pass: (0, 0),
            sent_ns: None,
        })
    }

    /// Reads the next datagram, from the beginning of the file again if that is wanted; `false` at the end, and in a
    /// file without any.
    fn read_on(&mut self) -> Result<bool> {
        if self.read_once()? {
            return Ok(true);
        }
        let Some(file) = self.again.as_ref().filter(|_| self.newest_ns.is_some()) else { return Ok(false) };
        self.source = DatagramSource::open(file)?;
        // The mean gap of the file lies between its end and its beginning.
        if let ((count, began_ns), Some(sent_ns)) = (self.pass, &mut self.sent_ns) {
            *sent_ns += if count > 1 { (*sent_ns - began_ns) / (count - 1) } else { LONE_NS };
        }
        (self.newest_ns, self.pass) = (None, (0, 0));
        Ok(true)
    }

    /// Reads the next datagram of the capture, or the next message; `false` at the end.
    fn read_once(&mut self) -> Result<bool> {
        match &mut self.source {
            DatagramSource::Capture(capture) => {
                let Some(datagram) = capture.next() else {
                    let skipped = capture.skipped();
                    self.notes = self.sensor.notes().into_iter().chain(skipped.notes()).collect();
                    return Ok(false);
                };
                (self.progress)(capture.offset());
                match datagram {
                    Ok(datagram) if !self.sensor.has_sent(&datagram) => {}
                    Ok(datagram) => self.push(datagram.stamp_ns, &datagram.payload),
                    Err(error) => self.cut = Some(error.to_string()),
                }
            }
            DatagramSource::Mcap(recording) => {
                let Some(message) = recording.next() else {
                    self.cut = recording.incomplete();
                    return Ok(false);
                };
                let message = message?;
                (self.progress)(recording.bytes_read());
                if !message.is_velodyne_scan() {
                    self.skip("not a VelodyneScan", 1);
                    return Ok(true);
                }
                let topic = || message.channel.topic.clone();
                let Ok(scan) = VelodyneScan::new(&message.data) else {
                    self.skip(&format!("a message of {} that is damaged", topic()), 1);
                    return Ok(true);
                };
                for packet in scan.packets() {
                    match packet {
                        Ok((stamp_ns, packet)) => self.push(stamp_ns, packet),
                        Err(fault) => self.skip(&format!("packet of {}: {fault}", topic()), 1),
                    }
                }
            }
        }
        Ok(true)
    }

    fn push(&mut self, stamp_ns: i64, payload: &[u8]) {
        let kind = match payload.len() {
            PACKET_LENGTH => Kind::Data,
            TELEMETRY_LENGTH => Kind::Telemetry,
            length => {
                return self.skip(&format!("{length} bytes; {PACKET_LENGTH} and {TELEMETRY_LENGTH} are sent"), 1);
            }
        };
        let gap_ns = stamp_ns.saturating_sub(self.newest_ns.replace(stamp_ns).unwrap_or(stamp_ns));
        let gap_ns = if gap_ns > GAP_NS_MAX { 0 } else { gap_ns };
        let stamp_ns = *self.sent_ns.insert(self.sent_ns.map_or(stamp_ns, |sent_ns| sent_ns + gap_ns));
        self.pass = if self.pass.0 == 0 { (1, stamp_ns) } else { (self.pass.0 + 1, self.pass.1) };
        self.read.push_back(Datagram { stamp_ns, kind, payload: payload.to_vec() });
    }

    fn skip(&mut self, reason: &str, count: u64) {
        if count > 0 {
            *self.skipped.entry(reason.to_owned()).or_default() += count;
        }
    }
}

impl<P: FnMut(u64)> Iterator for RecordedDatagrams<P> {
    type Item = Datagram;

    fn next(&mut self) -> Option<Datagram> {
        while self.read.is_empty() && self.error.is_none() {
            match self.read_on() {
                Ok(true) => {}
                Ok(false) => break,
                Err(error) => self.error = Some(error),
            }
        }
        self.read.pop_front()
    }
}

/// What a network delivers of the datagrams that are sent into it.
struct Arriving<'a, I> {
    sent: &'a mut I,
    network: &'a mut Impairment,
    arrived: VecDeque<Datagram>,
}

impl<I: Iterator<Item = Datagram>> Iterator for Arriving<'_, I> {
    type Item = Datagram;

    fn next(&mut self) -> Option<Datagram> {
        while self.arrived.is_empty() {
            let Some(datagram) = self.sent.next() else {
                self.arrived.extend(self.network.finish());
                break;
            };
            self.arrived.extend(self.network.push(datagram));
        }
        self.arrived.pop_front()
    }
}
