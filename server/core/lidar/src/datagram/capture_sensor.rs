//! Which datagrams of a capture belong to one sensor.
//!
//! A sensor is known by its address and by the port that it sends its packets to, because several sensors with the
//! factory address are told apart by their ports alone. The sensor of a capture is the sender of the first data packet.

use std::collections::BTreeMap;
use std::net::IpAddr;

use crate::datagram::capture::Datagram;
use crate::packet::PACKET_LENGTH;
use crate::telemetry::TELEMETRY_LENGTH;

/// The sensor of a capture, and the datagrams of others so far.
#[derive(Clone, Debug, Default)]
pub struct CaptureSensor {
    /// Address of the sensor, and the port that it sends to.
    sensor: Option<(IpAddr, u16)>,
    /// The port that the sensor sends its telemetry to.
    telemetry_port: Option<u16>,
    others: BTreeMap<(IpAddr, u16), u64>,
}

impl CaptureSensor {
    /// True unless the datagram is a data packet or telemetry of another sensor; then it is counted.
    pub fn has_sent(&mut self, datagram: &Datagram) -> bool {
        let sender = (datagram.source.ip(), datagram.destination_port);
        let is_of_sensor = match datagram.payload.len() {
            PACKET_LENGTH => sender == *self.sensor.get_or_insert(sender),
            // Before the first data packet no telemetry belongs to another sensor.
            TELEMETRY_LENGTH if self.sensor.is_none() => true,
            TELEMETRY_LENGTH => {
                self.sensor.is_some_and(|(address, _)| address == sender.0)
                    && sender.1 == *self.telemetry_port.get_or_insert(sender.1)
            }
            _ => true,
        };
        if !is_of_sensor {
            *self.others.entry(sender).or_default() += 1;
        }
        is_of_sensor
    }

    /// A line for each other sensor, for people.
    pub fn notes(&self) -> Vec<String> {
        let mut by_name: BTreeMap<String, u64> = BTreeMap::new();
        for ((address, port), count) in &self.others {
            let is_same_address = self.sensor.is_some_and(|(of_sensor, _)| of_sensor == *address);
            let name = if is_same_address { format!("{address}:{port}") } else { address.to_string() };
            *by_name.entry(name).or_default() += count;
        }
        by_name.iter().map(|(name, n)| format!("{n} datagrams of another sensor, {name}, ignored")).collect()
    }
}
