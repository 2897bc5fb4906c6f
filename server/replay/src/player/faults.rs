//! Faults on demand: readings of a recorded drive -> the readings of the same drive with a sensor lost, packets lost, a
//! step of the clock, a jump of the poses, or a stopped server.
//!
//! A fault depends only on its text, its place and the number of the reading, so each jump and each repetition of a
//! replay has the same faults.

use std::str::FromStr;

use clearway_daemon::base::counted::counted;
use clearway_daemon::ingest::queue::Reading;
use clearway_mapping::event::Body;
use nalgebra::{Isometry3, Vector3};

/// What [`Fault`] accepts, for errors and help.
pub const SYNTAX: &str = "lost:SENSOR@FROM-TO, loss:PERCENT or loss:PERCENT@FROM-TO, clock:MS@AT, pose:X,Y,YAW@AT or \
                          stop@FROM-TO is allowed (seconds after the first event, metres, degrees)";

/// One fault. Times are seconds after the first event.
#[derive(Clone, Debug, PartialEq)]
pub struct Fault {
    text: String,
    kind: FaultKind,
    from_s: f64,
    to_s: f64,
}

#[derive(Clone, Debug, PartialEq)]
enum FaultKind {
    /// A sensor sends nothing.
    Lost { sensor: String },
    /// This share of the datagrams and scans does not arrive.
    Loss { share: f64 },
    /// The host's clock is ahead by this much from then on.
    Clock { step_ns: i64 },
    /// Ego poses are moved by this from then on.
    Pose { moved: Isometry3<f64> },
    /// The server receives nothing.
    Stop,
}

/// A fault is unknown, or does not fit the drive.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("fault {text:?}: {reason}; {SYNTAX}")]
pub struct FaultError {
    /// The fault as given.
    pub text: String,
    /// Why the fault is refused.
    pub reason: String,
}

impl FromStr for Fault {
    type Err = FaultError;

    fn from_str(text: &str) -> Result<Self, FaultError> {
        let wrong = |reason: String| FaultError { text: text.to_owned(), reason };
        let number = |text: &str| match text.trim().parse::<f64>() {
            Ok(number) if number.is_finite() => Ok(number),
            _ => Err(wrong(format!("{text:?} is no number"))),
        };
        let (what, when) = text.split_once('@').unwrap_or((text, ""));
        let (name, value) = what.split_once(':').unwrap_or((what, ""));
        let range = || {
            let (from, to) = when.split_once('-').ok_or_else(|| wrong("the times FROM-TO are missing".into()))?;
            let (from, to) = (number(from)?, number(to)?);
            if from < to { Ok((from, to)) } else { Err(wrong(format!("{from} s to {to} s: it ends before it begins"))) }
        };
        let from_then_on = || Ok((number(when)?, f64::INFINITY));
        let (kind, (from_s, to_s)) = match name {
            "lost" if !value.is_empty() => (FaultKind::Lost { sensor: value.to_owned() }, range()?),
            "loss" => {
                let percent = number(value)?;
                if !(0.0..=100.0).contains(&percent) {
                    return Err(wrong(format!("{percent} %: 0 to 100 is allowed")));
                }
                let always = (f64::NEG_INFINITY, f64::INFINITY);
                (FaultKind::Loss { share: percent / 100.0 }, if when.is_empty() { always } else { range()? })
            }
            "clock" => (FaultKind::Clock { step_ns: (number(value)? * 1e6) as i64 }, from_then_on()?),
            "pose" => {
                let numbers = value.split(',').map(number).collect::<Result<Vec<_>, _>>()?;
                let [x, y, yaw_deg] = numbers[..] else { return Err(wrong("X,Y,YAW are three numbers".into())) };
                let moved = Isometry3::new(Vector3::new(x, y, 0.0), Vector3::z() * yaw_deg.to_radians());
                (FaultKind::Pose { moved }, from_then_on()?)
            }
            "stop" if value.is_empty() => (FaultKind::Stop, range()?),
            _ => return Err(wrong("no such fault".into())),
        };
        Ok(Self { text: text.to_owned(), kind, from_s, to_s })
    }
}

/// The faults of one replay, with the names of the sensors of its vehicles.
#[derive(Clone, Debug, Default)]
pub struct Faults {
    faults: Vec<Fault>,
    sensors: Vec<Vec<String>>,
    /// Number of readings that each fault has dropped or altered.
    counts: Vec<u64>,
}

impl Faults {
    /// These faults, for a drive of this length, in seconds, of vehicles with these sensors.
    ///
    /// # Errors
    /// [`FaultError`] if no vehicle has the sensor of a fault, or a fault begins after the drive.
    pub fn new(faults: Vec<Fault>, length_s: f64, sensors: Vec<Vec<String>>) -> Result<Self, FaultError> {
        for fault in &faults {
            if fault.from_s > length_s {
                let reason = format!("it begins after the drive, which is {length_s:.3} s long");
                return Err(FaultError { text: fault.text.clone(), reason });
            }
            if let FaultKind::Lost { sensor } = &fault.kind
                && !sensors.iter().flatten().any(|name| name == sensor)
            {
                let known = sensors.iter().flatten().cloned().collect::<Vec<_>>().join(", ");
                let reason = format!("sensor {sensor:?} is not known; known: {known}");
                return Err(FaultError { text: fault.text.clone(), reason });
            }
        }
        Ok(Self { counts: vec![0; faults.len()], faults, sensors })
    }

    /// The reading with the faults, `after_s` after the first event and the `number`th of the drive; `None` if it does
    /// not arrive.
    pub fn apply(&mut self, mut reading: Reading, vehicle: usize, number: u64, after_s: f64) -> Option<Reading> {
        for (index, fault) in self.faults.iter().enumerate() {
            if !(fault.from_s..fault.to_s).contains(&after_s) {
                continue;
            }
            let is_data = matches!(reading.body, Body::Datagram(_) | Body::Scan(_));
            let sensor = self.sensors.get(vehicle).and_then(|of| of.get(usize::from(reading.source)));
            let is_dropped = match &fault.kind {
                FaultKind::Lost { sensor: lost } => is_data && sensor == Some(lost),
                FaultKind::Loss { share: least } => is_data && share(index as u64, number) < *least,
                FaultKind::Stop => !matches!(reading.body, Body::Sensor(_) | Body::Withdrawn | Body::End),
                FaultKind::Clock { step_ns } => {
                    reading.arrival_ns = reading.arrival_ns.saturating_add(*step_ns);
                    self.counts[index] += 1;
                    false
                }
                FaultKind::Pose { moved } => {
                    if let Body::EgoPose(pose) = &mut reading.body {
                        pose.map_from_ego = *moved * pose.map_from_ego;
                        self.counts[index] += 1;
                    }
                    false
                }
            };
            if is_dropped {
                self.counts[index] += 1;
                return None;
            }
        }
        Some(reading)
    }

    /// What each fault has done, for people.
    pub fn notes(&self) -> Vec<String> {
        let note = |(fault, count): (&Fault, &u64)| format!("fault {}: {}", fault.text, counted(*count, "reading"));
        self.faults.iter().zip(&self.counts).map(note).collect()
    }
}

/// A number from 0 to 1 that depends on a seed and a number alone (SplitMix64).
fn share(seed: u64, number: u64) -> f64 {
    let mut z = seed.wrapping_add(number.wrapping_mul(0x9E37_79B9_7F4A_7C15));
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
}

#[cfg(test)]
mod tests {
    use clearway_mapping::event::EgoPose;

    use super::*;

    fn datagram(source: u16) -> Reading {
        Reading { arrival_ns: 5, source, body: Body::Datagram(bytes::Bytes::from_static(b"x")) }
    }

    fn faults(texts: &[&str]) -> Faults {
        let faults = texts.iter().map(|text| text.parse().unwrap()).collect();
        Faults::new(faults, 100.0, vec![vec!["top".into(), "rear".into()]]).unwrap()
    }

    #[test]
    fn a_lost_sensor_and_a_stopped_server_are_silent_for_their_time() {
        let mut faults = faults(&["lost:rear@2-4", "stop@6-7"]);
        let mut arrives = |source, at_s| faults.apply(datagram(source), 0, 0, at_s).is_some();
        assert_eq!([1.9, 2.0, 3.9, 4.0].map(|at| arrives(1, at)), [true, false, false, true]);
        assert!(arrives(0, 3.0) && !arrives(0, 6.5));
        assert_eq!(faults.notes(), ["fault lost:rear@2-4: 2 readings", "fault stop@6-7: 1 reading"]);
    }

    #[test]
    fn five_percent_are_lost_and_the_same_ones_each_time() {
        let lost = |mut faults: Faults| -> Vec<u64> {
            (0..10_000).filter(|&number| faults.apply(datagram(0), 0, number, 0.0).is_none()).collect()
        };
        let first = lost(faults(&["loss:5"]));
        assert!((400..600).contains(&first.len()), "{}", first.len());
        assert_eq!(lost(faults(&["loss:5"])), first);
    }

    #[test]
    fn a_clock_steps_and_poses_jump_from_then_on() {
        let mut faults = faults(&["clock:-250@3", "pose:1,2,90@3"]);
        assert_eq!(faults.apply(datagram(0), 0, 0, 2.9).unwrap().arrival_ns, 5);
        assert_eq!(faults.apply(datagram(0), 0, 0, 99.0).unwrap().arrival_ns, 5 - 250_000_000);
        let pose = EgoPose { stamp_ns: 0, map_from_ego: Isometry3::translation(10.0, 0.0, 0.0), speed_mps: 0.0 };
        let reading = Reading { arrival_ns: 0, source: 0, body: Body::EgoPose(pose) };
        let Body::EgoPose(moved) = faults.apply(reading, 0, 0, 3.0).unwrap().body else { panic!() };
        assert!((moved.map_from_ego.translation.vector - Vector3::new(1.0, 12.0, 0.0)).norm() < 1e-9);
    }

    #[test]
    fn what_is_no_fault_is_refused_with_what_is() {
        for (text, reason) in [
            ("lost:top", "the times FROM-TO are missing"),
            ("lost:top@4-2", "it ends before it begins"),
            ("loss:101", "0 to 100 is allowed"),
            ("pose:1,2@3", "three numbers"),
            ("clock:NaN@3", "is no number"),
            ("fire@1-2", "no such fault"),
        ] {
            let error = text.parse::<Fault>().unwrap_err().to_string();
            assert!(error.contains(reason) && error.contains("stop@FROM-TO"), "{error}");
        }
        let refused = |text: &str| {
            Faults::new(vec![text.parse().unwrap()], 5.0, vec![vec!["top".into()]]).unwrap_err().to_string()
        };
        assert!(refused("lost:front@1-2").contains("known: top"));
        assert!(refused("pose:1,2,3@5.1").contains("it begins after the drive, which is 5.000 s long"));
    }
}
