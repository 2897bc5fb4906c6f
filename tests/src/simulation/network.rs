//! The networks between the car's sensors and the server: what the sensors send, with their faults, until it arrives.

use bytes::Bytes;
use clearway_daemon::ingest::queue::{Arrival, LiveReading};
use clearway_daemon::ingest::udp::DATAGRAM_BYTES_MAX;
use clearway_mapping::event::{Body, Cause};
use clearway_sim::vehicle::Datagram;
use std::sync::atomic::Ordering;

use super::drive::Reading;
use super::fault_plan::{END_NS, HEAL_NS, InjectedFault, SensorFault, TICK_NS};
use super::sensor_fault;
use super::test_bed::{TestBed, during};

impl TestBed<'_> {
    /// Puts everything that leaves a sensor in this tick into its network.
    pub fn send(&mut self) {
        let none = SensorFault::default();
        while let Some(sent) =
            self.drive.sent.get(self.next_sent).filter(|s| s.offset_ns - self.plan.offset_ns <= self.now_ns)
        {
            self.next_sent += 1;
            let at_ns = sent.offset_ns - self.plan.offset_ns;
            let healthy = at_ns >= HEAL_NS && self.injected != Some(InjectedFault::SilentSensor);
            let covered =
                self.plan.covered.as_ref().filter(|(_, when)| when.contains(&at_ns)).map(|(sector, _)| sector);
            let fault = |source: usize| if healthy { &none } else { &self.plan.sensor_faults[source] };
            match &sent.reading {
                Reading::Datagram(source, datagram) => {
                    let mut fault = fault(*source).clone();
                    if self.injected == Some(InjectedFault::SilentSensor) && *source == 1 {
                        fault.silent = Some(HEAL_NS..END_NS + 1);
                    }
                    let Some(mut datagram) = sensor_fault::apply(datagram.clone(), at_ns, &fault) else {
                        // A silent sensor sends no later packet for which a reordered one could wait.
                        let arrived = self.networks[*source].finish().collect();
                        self.schedule(*source, arrived);
                        continue;
                    };
                    if let Some(sector) = covered {
                        let mount = &self.drive.rig.scanners[*source].1.ego_from_sensor;
                        sensor_fault::cover_datagram(&mut datagram, sector, mount);
                    }
                    datagram.stamp_ns = at_ns;
                    self.transmit(*source, datagram);
                }
                Reading::Observation(observation) => {
                    let unit = self.drive.rig.units.iter().position(|(name, _)| *name == observation.sensor);
                    let mut observation = observation.clone();
                    if let Some(unit) = unit {
                        if during(&fault(self.networks.len() + unit).silent, at_ns) {
                            continue;
                        }
                        if let Some(sector) = covered {
                            let mount = &self.drive.rig.units[unit].1.ego_from_sensor;
                            sensor_fault::cover_scan(&mut observation, sector, mount);
                        }
                    }
                    self.waiting.push_back(*observation);
                }
            }
        }
        if self.now_ns < HEAL_NS {
            self.send_invalid();
        }
    }

    /// Sends a datagram through its network, which is perfect after the end of the faults.
    fn transmit(&mut self, source: usize, datagram: Datagram) {
        let network = &mut self.networks[source];
        let mut arrived: Vec<Datagram> = Vec::new();
        if datagram.stamp_ns < HEAL_NS {
            arrived.extend(network.push(datagram));
        } else {
            arrived.extend(network.finish());
            arrived.push(datagram);
        }
        self.schedule(source, arrived);
    }

    /// Schedules the arrival of datagrams, at the earliest in this tick.
    fn schedule(&mut self, source: usize, arrived: Vec<Datagram>) {
        for datagram in arrived {
            self.datagrams += 1;
            let when = (datagram.stamp_ns.max(self.now_ns - TICK_NS), self.datagrams);
            self.arriving.insert(when, (source as u16, datagram.payload));
        }
    }

    /// Sends invalid messages from known and unknown senders.
    fn send_invalid(&mut self) {
        if !self.rng.happens(self.plan.garbage) {
            return;
        }
        let source = self.rng.within(0..self.networks.len() as i64) as u16;
        self.offered += 1;
        match self.rng.within(0..4) {
            0 => self.queue.record_drop(source, Cause::Length, 1),
            1 => self.queue.refuse_unknown_sender(([10, 0, 0, self.rng.within(1..99) as u8], 2368).into()),
            2 => {
                self.offered -= 1;
                let stamp_ns = self.drive.rig.start_ns + self.plan.offset_ns + self.now_ns;
                self.waiting.push_back(sensor_fault::invalid_observation(stamp_ns, &mut self.rng));
            }
            _ => {
                self.offered -= 1;
                self.datagrams += 1;
                let payload = sensor_fault::invalid_datagram(&mut self.rng);
                self.arriving.insert((self.now_ns, self.datagrams), (source, payload));
            }
        }
    }

    fn set_clock(&self, at_ns: i64) {
        let ahead_ns =
            self.plan.host_clock.as_ref().filter(|(when, _)| when.contains(&at_ns)).map_or(0, |(_, step)| *step);
        self.clock.store(self.drive.rig.start_ns + self.plan.offset_ns + at_ns + ahead_ns, Ordering::Relaxed);
    }

    /// Pushes datagrams that have arrived onto the event queue, as a socket's thread does.
    pub fn arrive(&mut self) {
        let later = self.arriving.split_off(&(self.now_ns + 1, 0));
        for ((at_ns, number), (source, payload)) in std::mem::replace(&mut self.arriving, later) {
            self.set_clock(at_ns);
            self.offered += 1;
            if self.injected == Some(InjectedFault::UncountedDatagram) && number == 500 {
                continue;
            }
            assert!(payload.len() <= DATAGRAM_BYTES_MAX, "the network does not lengthen datagrams");
            self.queue
                .push([LiveReading::new(Arrival::Now, source, Body::Datagram(Bytes::from(payload)))])
                .expect("the engine is there");
        }
        self.set_clock(self.now_ns);
    }

    /// Sends as many observations as the gateway has room for, and receives their outcomes.
    pub fn observe(&mut self) {
        while let Ok((id, outcome)) = self.outcomes.try_recv() {
            if self.injected != Some(InjectedFault::LostOutcome) || id.number != 100 {
                self.session.record_outcome(id.number, outcome);
            }
        }
        while self.session.has_credit(self.gateway.in_flight_max) {
            let Some(mut observation) = self.waiting.pop_front() else { break };
            self.observations += 1;
            observation.number = self.observations;
            self.offered += 1;
            // An unknown sensor ends a real stream; its car connects again.
            let _ = self.gateway.push(observation, None, &mut self.session, &self.outcome_sender);
        }
    }
}
