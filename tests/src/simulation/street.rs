//! The street outside the house: what the car's sensors send, troubled, and through bad networks to the doors.

use bytes::Bytes;
use clearway_mapping::event::{Body, Cause};
use clearway::ingest::udp::DATAGRAM_BYTES_MAX;
use clearway_sim::vehicle::Datagram;
use prost::Message;
use std::sync::atomic::Ordering;

use super::drive::What;
use super::fate::{END_NS, HEAL_NS, Trouble};
use super::house::{House, during};
use super::{Plant, TICK_NS, trouble};

impl House<'_> {
    /// Everything that leaves a sensor in this tick goes into its network.
    pub fn send(&mut self) {
        let quiet = Trouble::default();
        while let Some(sent) =
            self.drive.sent.get(self.next_sent).filter(|s| s.offset_ns - self.fate.offset_ns <= self.now_ns)
        {
            self.next_sent += 1;
            let at_ns = sent.offset_ns - self.fate.offset_ns;
            let healthy = at_ns >= HEAL_NS && self.plant != Some(Plant::EndlessSilence);
            let covered =
                self.fate.covered.as_ref().filter(|(_, when)| when.contains(&at_ns)).map(|(sector, _)| sector);
            let trouble = |source: usize| if healthy { &quiet } else { &self.fate.troubles[source] };
            match &sent.what {
                What::Datagram(source, datagram) => {
                    let mut trouble = trouble(*source).clone();
                    if self.plant == Some(Plant::EndlessSilence) && *source == 1 {
                        trouble.silent = Some(HEAL_NS..END_NS + 1);
                    }
                    let Some(mut datagram) = trouble::troubled(datagram.clone(), at_ns, &trouble) else {
                        // Networks wait for no later packet, as the order in which packets are late has it.
                        let arrived = self.networks[*source].finish().collect();
                        self.under_way(*source, arrived);
                        continue;
                    };
                    if let Some(sector) = covered {
                        let mount = &self.drive.rig.scanners[*source].1.ego_from_sensor;
                        trouble::cover_datagram(&mut datagram, sector, mount);
                    }
                    datagram.stamp_ns = at_ns;
                    self.carry(*source, datagram);
                }
                What::Observation(observation) => {
                    let unit = self.drive.rig.units.iter().position(|(name, _)| *name == observation.sensor);
                    let mut observation = observation.clone();
                    if let Some(unit) = unit {
                        if during(&trouble(self.networks.len() + unit).silent, at_ns) {
                            continue;
                        }
                        if let Some(sector) = covered {
                            let mount = &self.drive.rig.units[unit].1.ego_from_sensor;
                            trouble::cover_scan(&mut observation, sector, mount);
                        }
                    }
                    self.waiting.push_back(*observation);
                }
            }
        }
        if self.now_ns < HEAL_NS {
            self.bother();
        }
    }

    /// A datagram through its network, which is whole again when the faults have ended.
    fn carry(&mut self, source: usize, datagram: Datagram) {
        let network = &mut self.networks[source];
        let mut arrived: Vec<Datagram> = Vec::new();
        if datagram.stamp_ns < HEAL_NS {
            arrived.extend(network.push(datagram));
        } else {
            arrived.extend(network.finish());
            arrived.push(datagram);
        }
        self.under_way(source, arrived);
    }

    /// Nothing arrives before the tick in which it is known.
    fn under_way(&mut self, source: usize, arrived: Vec<Datagram>) {
        for datagram in arrived {
            self.datagrams += 1;
            let when = (datagram.stamp_ns.max(self.now_ns - TICK_NS), self.datagrams);
            self.arriving.insert(when, (source as u16, datagram.payload));
        }
    }

    /// Nonsense from senders known and unknown.
    fn bother(&mut self) {
        if !self.dice.happens(self.fate.garbage) {
            return;
        }
        let source = self.dice.of(0..self.networks.len() as i64) as u16;
        self.offered += 1;
        match self.dice.of(0..4) {
            0 => self.door.leave_outside(source, Cause::Length, 1),
            1 => self.door.refuse_stranger(([10, 0, 0, self.dice.of(1..99) as u8], 2368).into()),
            2 => {
                self.offered -= 1;
                let stamp_ns = self.drive.rig.start_ns + self.fate.offset_ns + self.now_ns;
                self.waiting.push_back(trouble::nonsense(stamp_ns, &mut self.dice));
            }
            _ => {
                self.offered -= 1;
                self.datagrams += 1;
                let payload = trouble::garbage(&mut self.dice);
                self.arriving.insert((self.now_ns, self.datagrams), (source, payload));
            }
        }
    }

    fn set_clock(&self, at_ns: i64) {
        let ahead_ns =
            self.fate.host_clock.as_ref().filter(|(when, _)| when.contains(&at_ns)).map_or(0, |(_, step)| *step);
        self.clock.store(self.drive.rig.start_ns + self.fate.offset_ns + at_ns + ahead_ns, Ordering::Relaxed);
    }

    /// Datagrams that have arrived go through the door, as a socket's thread has it.
    pub fn arrive(&mut self) {
        let later = self.arriving.split_off(&(self.now_ns + 1, 0));
        for ((at_ns, number), (source, payload)) in std::mem::replace(&mut self.arriving, later) {
            self.set_clock(at_ns);
            self.offered += 1;
            if self.plant == Some(Plant::UncountedDatagram) && number == 500 {
                continue;
            }
            assert!(payload.len() <= DATAGRAM_BYTES_MAX, "the network makes nothing longer");
            self.door.enter(source, Body::Datagram(Bytes::from(payload))).expect("the engine is there");
        }
        self.set_clock(self.now_ns);
    }

    /// The car tells as much as the vehicle's entrance has room for, and hears what became of it.
    pub fn observe(&mut self) {
        while let Ok((mark, verdict)) = self.told.try_recv() {
            if self.plant != Some(Plant::LostVerdict) || mark.number != 100 {
                self.account.tell(mark.number, verdict);
            }
        }
        let limits = &self.entrance.limits;
        while self.account.has_room(self.entrance.in_flight_max, limits.message_bytes_max) {
            let Some(mut observation) = self.waiting.pop_front() else { break };
            self.observations += 1;
            observation.number = self.observations;
            self.offered += 1;
            let bytes = observation.encoded_len();
            // An unknown sensor ends a real stream, and its car comes again.
            let _ = self.entrance.take(observation, bytes, &mut self.account, &self.verdicts);
        }
    }
}
