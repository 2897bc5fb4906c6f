//! Which sensor is the reference sensor of a vehicle whose configuration names none.
//!
//! In: the sensors of the configuration, then their first scans. Out: the index of the reference sensor. Its scans make
//! the maps and its lasers define the rows of radial maps, so it should stand upright, see all around the vehicle and
//! have many lasers. Until every sensor has completed a scan, or the deadline has passed since the first scan, the
//! configuration alone decides; then the scans decide, once. A sensor that a stream has declared is chosen only while
//! no configured one has completed a scan, because it may be withdrawn at any time. Events alone decide, so a replay
//! chooses the same sensor.

use crate::event_time::EventTime;
use crate::sensor::scan::SensorScan;

/// Greatest tilt of an upright sensor, radians: 20 degrees, as of a mount that is estimated.
const UPRIGHT_RAD_MAX: f32 = 0.35;
/// Number of directions around the sensor that are distinguished. Ours: a gap between buildings is narrower.
const SECTORS: u32 = 12;
/// Least number of directions in which a sensor that sees all around has returns. Ours: an open side has none.
const SECTORS_ALL_AROUND: u32 = 9;

/// Properties by which sensors are compared, the most important first; of two equal sensors the sensor configured first
/// is chosen.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Merits {
    /// False if the sensor was withdrawn.
    is_there: bool,
    has_elevations: bool,
    is_upright: bool,
    sees_all_around: bool,
    lasers: usize,
    sectors: u32,
    /// Tilt in whole steps of 5 degrees, negative.
    uprightness: i32,
}

/// The choice of one vehicle.
#[derive(Clone)]
pub(crate) struct ReferenceChoice {
    is_decided: bool,
    /// Number of sensors of the configuration; those after them are declared.
    configured: usize,
    deadline_ns: i64,
    /// Event time of the first completed scan, ns.
    first_ns: Option<i64>,
    /// For each sensor, true if it has completed a whole scan.
    is_known: Vec<bool>,
    /// When the scans decided last: number of sensors among which they did, and of those with a whole scan.
    decided_by: Option<(usize, usize)>,
}

impl ReferenceChoice {
    /// A choice before the first event among this number of configured sensors; it is made already if the configuration
    /// names the sensor or has only one.
    pub fn new(is_decided: bool, configured: usize, deadline_ns: i64) -> Self {
        Self { is_decided, configured, deadline_ns, first_ns: None, is_known: Vec::new(), decided_by: None }
    }

    /// The reference sensor by the configuration alone: `lasers_configured` has the number of lasers of each configured
    /// sensor whose elevations are configured, else 0.
    pub fn by_configuration(scans: &[SensorScan], lasers_configured: &[usize]) -> usize {
        best(scans.iter().zip(lasers_configured).map(|(scan, lasers)| merits(scan, *lasers, 0)))
    }

    /// Forgets a sensor that is withdrawn. If it was the reference sensor, the scans decide again.
    pub fn remove_sensor(&mut self, source: usize, was_reference: bool) {
        self.is_known.iter_mut().skip(source).take(1).for_each(|is_known| *is_known = false);
        if was_reference {
            (self.is_decided, self.decided_by) = (false, None);
        }
    }

    /// The reference sensor by the scans, when they decide: after a completed scan.
    pub fn by_scans(&mut self, scans: &[SensorScan], now: EventTime) -> Option<usize> {
        if self.is_decided {
            return None;
        }
        let since_ns = now.event_ns.saturating_sub(*self.first_ns.get_or_insert(now.event_ns));
        self.is_known.resize(scans.len(), false);
        for (is_known, scan) in self.is_known.iter_mut().zip(scans) {
            *is_known |= scan.completed > 0 && scan.state.partial.is_empty();
        }
        let has_configured = self.is_known.iter().take(self.configured).any(|is_known| *is_known);
        let candidates = if has_configured { self.configured } else { scans.len() };
        let (scans, is_known) = (&scans[..candidates], &self.is_known[..candidates]);
        let decided_by = Some((candidates, is_known.iter().filter(|is_known| **is_known).count()));
        self.is_decided = decided_by == Some((candidates, scans.iter().filter(|scan| !scan.is_withdrawn()).count()));
        if !self.is_decided && (since_ns <= self.deadline_ns || self.decided_by == decided_by) {
            return None;
        }
        self.decided_by = decided_by;
        let lasers = |scan: &SensorScan| scan.sweep.calibration.as_ref().map_or(0, |table| table.lasers.len());
        Some(best(scans.iter().map(|scan| merits(scan, lasers(scan), sectors(scan)))))
    }
}

/// Index of the greatest; of several, the first.
fn best(merits: impl Iterator<Item = Merits>) -> usize {
    let later = |best: (usize, Merits), next: (usize, Merits)| if next.1 > best.1 { next } else { best };
    merits.enumerate().reduce(later).map_or(0, |(index, _)| index)
}

/// The properties of a sensor that has returns in so many sectors.
fn merits(scan: &SensorScan, lasers: usize, sectors: u32) -> Merits {
    Merits {
        is_there: !scan.is_withdrawn(),
        has_elevations: lasers > 0,
        is_upright: scan.tilt_rad <= UPRIGHT_RAD_MAX,
        sees_all_around: sectors >= SECTORS_ALL_AROUND,
        lasers,
        sectors,
        uprightness: -((scan.tilt_rad.to_degrees() / 5.0) as i32),
    }
}

/// Number of sectors in which a scan has returns.
fn sectors(scan: &SensorScan) -> u32 {
    let [x, y, _] = scan.origin_m;
    let sector = |x: f32, y: f32| {
        (libm::atan2f(y, x).rem_euclid(std::f32::consts::TAU) / std::f32::consts::TAU) * SECTORS as f32
    };
    let points = scan.sweep.x.iter().zip(&scan.sweep.y);
    points.fold(0u32, |seen, (px, py)| seen | 1 << (sector(px - x, py - y) as u32).min(SECTORS - 1)).count_ones()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scan(tilt_deg: f32, sectors: u32) -> SensorScan {
        let mut scan = SensorScan::new("top", [1.0, 2.0, 1.8], tilt_deg.to_radians());
        for sector in 0..sectors {
            let angle = (sector as f32 + 0.5) * std::f32::consts::TAU / SECTORS as f32;
            let sweep = std::sync::Arc::make_mut(&mut scan.sweep);
            sweep.x.push(1.0 + 9.0 * libm::cosf(angle));
            sweep.y.push(2.0 + 9.0 * libm::sinf(angle));
        }
        scan
    }

    fn merits(scan: &SensorScan, lasers: usize) -> Merits {
        super::merits(scan, lasers, sectors(scan))
    }

    #[test]
    fn an_upright_sensor_that_sees_all_around_with_many_lasers_is_best() {
        let order = [
            merits(&scan(0.0, 12), 0),
            merits(&scan(30.0, 12), 64),
            merits(&scan(0.0, 5), 64),
            merits(&scan(0.0, 12), 16),
            merits(&scan(9.0, 12), 32),
            merits(&scan(2.0, 12), 32),
        ];
        assert!(order.is_sorted_by(|worse, better| worse < better), "{order:?}");
        assert_eq!(best(order.into_iter()), 5);
        assert_eq!(best([order[3], order[5], order[5]].into_iter()), 1, "the first of two equal sensors");
    }

    #[test]
    fn a_declared_sensor_is_chosen_only_while_no_configured_one_has_a_scan() {
        let seen = |sectors| {
            let mut scan = scan(0.0, sectors);
            scan.completed = 1;
            scan
        };
        let at = |event_ns| EventTime { event_ns, ..EventTime::default() };
        let mut choice = ReferenceChoice::new(false, 2, 100);
        // Two configured sensors, and a declared sensor that sees more.
        let silent = || scan(0.0, 0);
        assert_eq!(choice.by_scans(&[silent(), silent(), seen(12)], at(0)), None);
        assert_eq!(choice.by_scans(&[silent(), silent(), seen(12)], at(101)), Some(2));
        assert_eq!(choice.by_scans(&[seen(3), silent(), seen(12)], at(102)), Some(0));
        assert_eq!(choice.by_scans(&[seen(3), silent(), seen(12)], at(103)), None);
        assert_eq!(choice.by_scans(&[seen(3), seen(4), seen(12)], at(104)), Some(1));
        assert_eq!(choice.by_scans(&[seen(5), seen(4), seen(12)], at(105)), None, "it is decided");
        let lasers = [0, 16];
        assert_eq!(ReferenceChoice::by_configuration(&[silent(), silent(), seen(12)], &lasers), 1);
    }
}
