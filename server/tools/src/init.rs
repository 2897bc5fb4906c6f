//! Datagrams of sensors, live or of a capture -> a first configuration, with comments.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::fs::File;
use std::io::{self, BufReader};
use std::net::{IpAddr, Ipv4Addr, SocketAddr, UdpSocket};
use std::os::fd::AsFd;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, anyhow, bail};
use clearway_lidar::capture::{Capture, CaptureError};
use clearway_lidar::packet::PACKET_LENGTH;
use clearway_lidar::telemetry::TELEMETRY_LENGTH;
use clearway_lidar::{Sensor, SensorConfig};
use clearway_mapping::sensor::mount::{MountEstimate, estimate};
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};

use clearway_daemon::base::clock::now_ns;
use clearway_daemon::config::Config;
use clearway_journal::counted::counted;
use clearway_replay::files::ground_revolutions::{GroundRevolutions, points_of};

/// Receive buffer of a socket, in bytes, as of a server.
const RECEIVE_BUFFER_BYTES: usize = 4 << 20;
/// Port of the receiver of telemetry, as sensors leave the factory.
const TELEMETRY_PORT: u16 = 8308;
/// Longest datagram that is read, in bytes; a Velodyne sends 1206 and 512.
const DATAGRAM_BYTES: usize = 2048;

/// Where sensors are looked for.
#[derive(Clone, Debug)]
pub enum SensorSearch {
    /// In a capture (pcap, pcapng).
    Capture(PathBuf),
    /// At these addresses and ports, for this time.
    Live(Vec<SocketAddr>, Duration),
}

/// The sensors that were found.
pub struct FoundSensors {
    /// Where they were looked for, in words.
    pub place: String,
    sensors: Vec<FoundSensor>,
    /// What else there was, for people.
    left_out: Vec<String>,
}

/// Looks for senders of Velodyne data packets.
///
/// # Errors
/// If nothing can be read or listened to, or no sensor is found.
pub fn find_sensors(search: &SensorSearch) -> Result<FoundSensors> {
    let mut received = ReceivedDatagrams::default();
    let place = match search {
        SensorSearch::Capture(file) => received.read(file)?,
        SensorSearch::Live(at, duration) => received.listen(at, *duration)?,
    };
    let sensors = received.sensors();
    if sensors.is_empty() {
        bail!("{place}: no data packet of a Velodyne: {}", received.other(matches!(search, SensorSearch::Capture(_))));
    }
    Ok(FoundSensors { place, sensors, left_out: received.left_out() })
}

/// What is known of one sender of data packets.
struct PacketSender {
    sensor: Sensor,
    revolutions: GroundRevolutions,
    packets: u64,
    refused: BTreeMap<String, u64>,
}

/// The datagrams that arrived.
#[derive(Default)]
struct ReceivedDatagrams {
    /// By address of the sender and port of the receiver.
    senders: BTreeMap<(IpAddr, u16), PacketSender>,
    /// Ports of the receiver of each address' telemetry.
    telemetry: BTreeMap<IpAddr, BTreeSet<u16>>,
    /// Number of other datagrams, by length.
    others: BTreeMap<usize, u64>,
    /// Packets of a capture that are no UDP datagrams, for people.
    skipped: Vec<String>,
}

/// One sensor that was found.
struct FoundSensor {
    name: String,
    address: IpAddr,
    port: u16,
    telemetry_port: u16,
    model: clearway_lidar::model::Model,
    rpm: Option<f32>,
    packets: u64,
    refused: u64,
    mount: Result<MountEstimate, String>,
}

impl ReceivedDatagrams {
    fn push(&mut self, from: IpAddr, port: u16, payload: &[u8], arrival_ns: i64) {
        match payload.len() {
            PACKET_LENGTH => {
                let sender = self.senders.entry((from, port)).or_insert_with(|| PacketSender {
                    sensor: Sensor::new(SensorConfig::default()),
                    revolutions: GroundRevolutions::default(),
                    packets: 0,
                    refused: BTreeMap::new(),
                });
                sender.packets += 1;
                match sender.sensor.push(payload, arrival_ns) {
                    Ok(Some(revolution)) => _ = sender.revolutions.push(|| points_of(revolution)),
                    Ok(None) => {}
                    Err(error) => *sender.refused.entry(error.to_string()).or_default() += 1,
                }
            }
            TELEMETRY_LENGTH => _ = self.telemetry.entry(from).or_default().insert(port),
            length => *self.others.entry(length).or_default() += 1,
        }
    }

    /// Reads a capture; returns how to name it.
    fn read(&mut self, file: &Path) -> Result<String> {
        let name = || file.display().to_string();
        let open = File::open(file).with_context(name)?;
        let mut capture = Capture::new(BufReader::new(open)).with_context(name)?;
        for datagram in capture.by_ref() {
            match datagram {
                Ok(at) => self.push(at.source.ip(), at.destination_port, &at.payload, at.stamp_ns),
                Err(error @ CaptureError::Truncated { .. }) => {
                    tracing::warn!(file = %file.display(), %error, "what comes before is used");
                    break;
                }
                Err(error) => return Err(error).with_context(name),
            }
        }
        self.skipped = capture.skipped().notes();
        Ok(name())
    }

    /// Listens for this time; returns how to name the place.
    fn listen(&mut self, at: &[SocketAddr], duration: Duration) -> Result<String> {
        let mut sockets: Vec<(UdpSocket, u16)> = Vec::new();
        for at in at {
            if sockets.iter().any(|(socket, _)| socket.local_addr().is_ok_and(|bound| bound == *at)) {
                continue;
            }
            let socket = UdpSocket::bind(at)
                .with_context(|| format!("udp {at}: cannot be listened on; a server that runs already has the port"))?;
            socket2::SockRef::from(&socket).set_recv_buffer_size(RECEIVE_BUFFER_BYTES)?;
            socket.set_nonblocking(true)?;
            let port = socket.local_addr()?.port();
            sockets.push((socket, port));
        }
        let at: Vec<String> =
            sockets.iter().filter_map(|(socket, _)| Some(socket.local_addr().ok()?.to_string())).collect();
        let place = format!("udp {}, {} s", at.join(" and "), duration.as_secs());
        tracing::info!("listening at {place}");
        let end = Instant::now() + duration;
        let mut payload = [0; DATAGRAM_BYTES];
        while let Some(rest) = end.checked_duration_since(Instant::now()) {
            let mut ready: Vec<_> =
                sockets.iter().map(|(socket, _)| PollFd::new(socket.as_fd(), PollFlags::POLLIN)).collect();
            let timeout = u16::try_from(rest.as_millis()).unwrap_or(u16::MAX);
            match poll(&mut ready, PollTimeout::from(timeout)) {
                Ok(_) | Err(nix::Error::EINTR) => {}
                Err(error) => return Err(anyhow!(error).context("wait for datagrams")),
            }
            for (socket, port) in &sockets {
                // At most so many at a time that the other sockets have their turn.
                for _ in 0..256 {
                    match socket.recv_from(&mut payload) {
                        Ok((length, from)) => self.push(from.ip().to_canonical(), *port, &payload[..length], now_ns()),
                        Err(error) if error.kind() == io::ErrorKind::WouldBlock => break,
                        // The error concerns one datagram (an ICMP reply, for example), not the socket.
                        Err(error) => tracing::warn!(%error, "udp receive"),
                    }
                }
            }
        }
        Ok(place)
    }

    /// The senders whose packets have shown their model, as sensors.
    fn sensors(&mut self) -> Vec<FoundSensor> {
        let senders = std::mem::take(&mut self.senders).into_iter();
        let (known, unknown): (Vec<_>, Vec<_>) =
            senders.partition(|(_, sender)| sender.sensor.status().model.is_some());
        self.senders = unknown.into_iter().collect();
        let several = known.len() > 1;
        let mut found = Vec::new();
        for (index, ((address, port), mut sender)) in known.into_iter().enumerate() {
            // A capture may be shorter than two revolutions.
            if let Some(revolution) = sender.sensor.finish() {
                sender.revolutions.push(|| points_of(revolution));
            }
            let status = sender.sensor.status();
            let Some(model) = status.model else { continue };
            found.push(FoundSensor {
                name: if several { format!("lidar_{}", index + 1) } else { "top".into() },
                address,
                port,
                telemetry_port: self.telemetry_port(address, &found),
                model,
                rpm: status.rpm,
                packets: sender.packets,
                refused: sender.refused.values().sum(),
                mount: estimate(sender.revolutions.into_clouds()).map_err(|error| error.to_string()),
            });
        }
        found
    }

    /// Removes the least port to which telemetry of this address came. Sensors with the factory address send all data
    /// packets to ports of their own, and the next port without telemetry stands for the telemetry that did not come.
    fn telemetry_port(&mut self, address: IpAddr, taken: &[FoundSensor]) -> u16 {
        let of_address = || taken.iter().filter(|sensor| sensor.address == address).map(|sensor| sensor.telemetry_port);
        let seen = self.telemetry.get_mut(&address).and_then(BTreeSet::pop_first);
        seen.unwrap_or_else(|| of_address().max().map_or(TELEMETRY_PORT, |port| port.wrapping_add(1)))
    }

    /// A line for each sender and each kind of datagram that belongs to no found sensor, for people.
    fn left_out(&self) -> Vec<String> {
        let mut lines: Vec<String> = Vec::new();
        for ((from, port), sender) in &self.senders {
            let why: Vec<_> = sender.refused.iter().map(|(reason, n)| format!("{n} refused: {reason}")).collect();
            let packets = counted(sender.packets, "data packet");
            lines.push(format!("{packets} from {from} to port {port} ({})", why.join("; ")));
        }
        let telemetry = self.telemetry.iter().flat_map(|(from, ports)| ports.iter().map(move |port| (from, port)));
        lines.extend(telemetry.map(|(from, port)| format!("telemetry from {from} to port {port}")));
        lines.extend(self.others.iter().map(|(length, n)| format!("{} of {length} bytes", counted(*n, "datagram"))));
        lines.extend(self.skipped.iter().cloned());
        lines
    }

    /// What there was instead of a sensor, in words.
    fn other(&self, is_capture: bool) -> String {
        let received = self.left_out();
        match (received.is_empty(), is_capture) {
            (true, true) => "it has no UDP datagrams".into(),
            (true, false) => "nothing arrived. Does `tcpdump -n udp port 2368` show packets? Does this host have an \
                address in the sensor's network, and is UDP open in its firewall?"
                .into(),
            (false, _) => format!("what there was: {}", received.join(", ")),
        }
    }
}

/// The name of a vehicle, if a configuration allows it.
///
/// # Errors
/// What is allowed.
pub fn vehicle_name(text: &str) -> Result<String, String> {
    let vehicle = Config::of_one_vehicle(text, "top").vehicles.remove(0);
    vehicle.core().validate().map_err(|error| format!("allowed are {}", error.allowed))?;
    Ok(text.to_owned())
}

impl FoundSensors {
    /// The configuration with comments.
    pub fn configuration(&self, vehicle: &str) -> String {
        let Self { place, sensors, .. } = self;
        let local = sensors.iter().all(|sensor| sensor.address.is_loopback());
        let host = if local { IpAddr::from(Ipv4Addr::LOCALHOST) } else { Ipv4Addr::UNSPECIFIED.into() };
        let (data, telemetry) = (sensors[0].port, sensors[0].telemetry_port);
        let one_port = sensors.iter().all(|sensor| (sensor.port, sensor.telemetry_port) == (data, telemetry));
        let mut text = format!(
            "# Written by `clearway init` from {place}. Keys that are not here have defaults:\n\
             # `clearway check --default` explains every key, `clearway check --config FILE` shows what holds.\n\n\
             [[vehicle]]\nname = {vehicle:?}\n\n# Where the sensors send to.\n[vehicle.udp]\ndata = \"{}\"\ntelemetry = \"{}\"\n",
            SocketAddr::new(host, data),
            SocketAddr::new(host, telemetry),
        );
        text += "# Datagrams of other senders are refused.\n[vehicle.udp.from]\n";
        for sensor in sensors {
            _ = writeln!(text, "{} = \"{}\"", sensor.name, sensor.address);
        }
        if !one_port {
            text += "[vehicle.udp.ports]\n";
            for FoundSensor { name, port, telemetry_port, .. } in sensors {
                _ = writeln!(text, "{name} = {{ data = {port}, telemetry = {telemetry_port} }}");
            }
        }
        for sensor in sensors {
            _ = write!(
                text,
                "\n# {}\n[[vehicle.sensor]]\nname = {:?}\nmodel = \"{}\"\n",
                described(sensor),
                sensor.name,
                sensor.model.as_str()
            );
            text += "[vehicle.sensor.extrinsics]\n\
                # Measure these: the position relative to the point on the ground under the vehicle's reference\n\
                # point (x forward, y left), and where azimuth 0 of the sensor points (0: forward, 90: left).\nx_m = 0.0\ny_m = 0.0\nyaw_deg = 0.0\n";
            match &sensor.mount {
                Ok(mount) => {
                    let [pitch, pitch_std, roll, roll_std] =
                        [mount.pitch_rad, mount.pitch_std_rad, mount.roll_rad, mount.roll_std_rad].map(f64::to_degrees);
                    _ = writeln!(
                        text,
                        "# Estimated from the ground in {}, with standard deviations of {:.3} m, {pitch_std:.2} and {roll_std:.2} \
                         degrees.\nz_m = {:.3}\npitch_deg = {pitch:.2}\nroll_deg = {roll:.2}",
                        counted(mount.revolutions as u64, "revolution"),
                        mount.height_std_m,
                        mount.height_m,
                    );
                }
                Err(why) => {
                    _ = writeln!(
                        text,
                        "# Needed, and not known: the mount cannot be estimated ({why}).\n\
                         # z_m = 1.9\n# pitch_deg = 0.0\n# roll_deg = 0.0"
                    );
                }
            }
        }
        text
    }

    /// What was found, a line for each sensor and its mount.
    pub fn report(&self) -> Vec<String> {
        let sensors = self.sensors.iter().map(|sensor| format!("{}: {}", sensor.name, described(sensor)));
        let mounts = self.sensors.iter().map(|sensor| match &sensor.mount {
            Ok(mount) => {
                format!("{}: {:.3} m over the ground; measure x_m, y_m and yaw_deg", sensor.name, mount.height_m)
            }
            Err(why) => format!("{}: the mount is not known: {why}; write it into the file", sensor.name),
        });
        let left_out = self.left_out.iter().map(|what| format!("not in the file: {what}"));
        sensors.chain(mounts).chain(left_out).collect()
    }
}

fn described(sensor: &FoundSensor) -> String {
    let rpm = sensor.rpm.map_or(String::new(), |rpm| format!(", {rpm:.0} rpm"));
    let refused = if sensor.refused > 0 { format!(", {} refused", sensor.refused) } else { String::new() };
    let (packets, model) = (counted(sensor.packets, "packet"), sensor.model.as_str());
    format!("{model} at {} to port {}{rpm}, {packets}{refused}.", sensor.address, sensor.port)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_vehicle_has_a_name_that_the_configuration_allows() {
        assert_eq!(vehicle_name("car-1_b"), Ok("car-1_b".to_owned()));
        for wrong in ["", "Car 1", &"a".repeat(65)] {
            assert!(vehicle_name(wrong).unwrap_err().contains("1 to 64 of the characters a-z"), "{wrong}");
        }
    }
}
