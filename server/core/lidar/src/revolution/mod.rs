//! The output of a sensor: one revolution as a range image.
//!
//! In: the firings that the decoder adds. Out: [`Revolution`] in the sensor's frame (REP-103), and its [`Point`]s.
//!
//! | file | content |
//! |---|---|
//! | `firing` | [`Firing`]: azimuth and time of one pass of all lasers |
//! | `echo` | [`Echo`]: ranges, coordinates and intensities |
//! | `blocked` | [`Blocked`]: sectors and lasers without returns |

mod blocked;
pub(crate) mod echo;
mod firing;

use std::sync::Arc;

pub use blocked::{Blocked, BlockedSector};
pub use echo::Echo;
pub use firing::Firing;

use crate::calibration::Calibration;
use crate::model::{Model, ReturnMode};
use crate::time::clock::Clock;

/// One revolution of one sensor as a range image: `lasers` slots per firing, firings in time order.
///
/// Slot `firing * lasers + laser` of every [`Echo`] array belongs to the same laser of the same firing. Coordinates are
/// in the sensor's frame (REP-103).
#[derive(Clone, Debug)]
pub struct Revolution {
    /// Number of the revolution; each sensor counts from 0.
    pub sequence: u64,
    /// Model of the sensor.
    pub model: Model,
    /// Echoes that the sensor reports.
    pub return_mode: ReturnMode,
    /// Slots per firing. The index in a firing is the laser in firing order.
    pub lasers: usize,
    /// Firings, in time order.
    pub firings: Vec<Firing>,
    /// One range image, or two in dual-return mode: the strongest echo's image, then the last echo's. A last echo that
    /// equals the strongest has range 0 in the second image, so that each return occurs once.
    pub echoes: Vec<Echo>,
    /// Per-laser corrections that were applied; `calibration.lasers[laser]` has the elevation.
    pub calibration: Arc<Calibration>,
    /// Stamp of the first firing, in ns since the Unix epoch.
    pub start_ns: i64,
    /// Stamp of the last firing, in ns since the Unix epoch.
    pub end_ns: i64,
    /// Clock that the stamps follow.
    pub clock: Clock,
    /// Time by which the host's clock is ahead of the stamps, in ms: arrival less stamp of the packet with the least
    /// delay, so that it includes the time on the network.
    pub clock_offset_ms: i64,
    /// Number of the epoch of the stamps: how often the sensor's stamps have gone back. Within an epoch they rise.
    pub epoch: u32,
    /// Measured rate of rotation, in revolutions per minute.
    pub rpm: f32,
    /// Reason for which the revolution is incomplete; `None` if it is complete.
    pub partial: Option<Partial>,
    /// Number of data packets with firings in this revolution.
    pub packets: u32,
    /// Number of data packets that the revolution should have: `packets` and the missing packets, ±1 per gap. From the
    /// second revolution on, packets of a field-of-view gap are not counted. A gap over the cut is counted in the
    /// revolution in which it begins.
    pub packets_expected: u32,
    /// Encoder angles, as [`Firing::azimuth_rad`], between which the sensor does not fire because a field of view is
    /// set; `None` if there is no such gap. The gap is measured: it has 15 degrees or more, the next revolution has it
    /// too, and device time shows only a pause. It makes no revolution partial, and no packet is expected in it.
    pub fov_gap_rad: Option<[f32; 2]>,
    /// Sectors and lasers from which returns have ceased.
    pub blocked: Blocked,
    /// Number of firings of a complete revolution: counted in this revolution if it is complete, else in the newest
    /// complete revolution, else by the period in the manual. The number of received firings is `firings.len()`.
    pub firings_expected: u32,
}

/// The reason for which a revolution is incomplete.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Partial {
    /// The stream began inside the revolution.
    Start,
    /// The stream ended inside the revolution.
    End,
    /// Azimuths are missing inside the revolution, because packets were lost.
    Gap,
    /// The azimuth ran backwards.
    Reversal,
    /// The sensor did not complete the revolution in 12,500 firings (`MAX_FIRINGS_PER_REVOLUTION`).
    Overlong,
}

impl Partial {
    /// Name of the reason in maps and logs.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Start => "start",
            Self::End => "end",
            Self::Gap => "gap",
            Self::Reversal => "reversal",
            Self::Overlong => "overlong",
        }
    }
}

/// One return as a point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// Coordinate x, in m in the sensor's frame.
    pub x: f32,
    /// Coordinate y, in m in the sensor's frame.
    pub y: f32,
    /// Coordinate z, in m in the sensor's frame.
    pub z: f32,
    /// Corrected range, in m.
    pub range_m: f32,
    /// Intensity as the sensor reports it.
    pub intensity: u8,
    /// Rank of the laser by elevation, 0 lowest.
    pub ring: u16,
    /// Index of the laser in firing order.
    pub laser: u16,
    /// Index of the firing in `firings`.
    pub firing: u32,
    /// Time at which the laser fired, in ns since the Unix epoch.
    pub time_ns: i64,
    /// Type of the return: 1 the strongest echo, 2 the last, 3 an echo that is both.
    pub return_type: u8,
}

impl Revolution {
    pub(crate) fn new(model: Model, return_mode: ReturnMode, calibration: Arc<Calibration>) -> Self {
        let images = if return_mode == ReturnMode::Dual { 2 } else { 1 };
        Self {
            sequence: 0,
            model,
            return_mode,
            lasers: model.spec().lasers,
            firings: Vec::new(),
            echoes: vec![Echo::default(); images],
            calibration,
            start_ns: 0,
            end_ns: 0,
            clock: Clock::Arrival,
            clock_offset_ms: 0,
            epoch: 0,
            rpm: 0.0,
            partial: None,
            packets: 0,
            packets_expected: 0,
            fov_gap_rad: None,
            blocked: Blocked::default(),
            firings_expected: 0,
        }
    }

    /// Ring of every laser, in firing order: its rank by elevation, 0 lowest.
    pub fn rings(&self) -> Vec<u16> {
        self.calibration.rings()
    }

    /// Number of returns (echoes with a range).
    pub fn returns(&self) -> usize {
        self.echoes.iter().flat_map(|echo| &echo.range_m).filter(|range| **range > 0.0).count()
    }

    /// All returns, ordered by firing, then by laser; the strongest echo precedes the last.
    pub fn points(&self) -> impl Iterator<Item = Point> + '_ {
        let rings = self.rings();
        let offsets: Vec<u32> = (0..self.lasers).map(|laser| self.model.spec().laser_offset_ns(laser)).collect();
        let slots = self.firings.len() * self.lasers * self.echoes.len();
        (0..slots).filter_map(move |index| {
            let (slot, image) = (index / self.echoes.len(), index % self.echoes.len());
            let (firing, laser) = (slot / self.lasers, slot % self.lasers);
            let echo = &self.echoes[image];
            let range_m = echo.range_m[slot];
            (range_m > 0.0).then(|| Point {
                x: echo.x[slot],
                y: echo.y[slot],
                z: echo.z[slot],
                range_m,
                intensity: echo.intensity[slot],
                ring: rings[laser],
                laser: laser as u16,
                firing: firing as u32,
                time_ns: self.start_ns + i64::from(self.firings[firing].offset_ns) + i64::from(offsets[laser]),
                return_type: self.return_type(slot, image),
            })
        })
    }

    fn return_type(&self, slot: usize, image: usize) -> u8 {
        match (self.return_mode, image) {
            (ReturnMode::Strongest, _) => 1,
            (ReturnMode::Last, _) | (ReturnMode::Dual, 1) => 2,
            (ReturnMode::Dual, _) if self.echoes[0].is_repeated_by(&self.echoes[1], slot) => 3,
            (ReturnMode::Dual, _) => 1,
        }
    }

    /// Empties the image for the next revolution and keeps its memory.
    pub(crate) fn begin_like(&mut self, other: &Revolution) {
        self.firings.clear();
        self.echoes.iter_mut().for_each(|echo| echo.truncate(0));
        self.echoes.resize_with(other.echoes.len(), Echo::default);
        (self.model, self.return_mode, self.lasers) = (other.model, other.return_mode, other.lasers);
        self.calibration.clone_from(&other.calibration);
        (self.partial, self.packets, self.packets_expected) = (None, 0, 0);
    }

    /// Adds firings without returns.
    pub(crate) fn grow(&mut self, firings: &[Firing]) {
        self.firings.extend_from_slice(firings);
        let slots = self.firings.len() * self.lasers;
        self.echoes.iter_mut().for_each(|echo| echo.resize(slots));
    }

    /// Moves the firings from `first` on to the end of `to`, which has as many lasers and images.
    pub(crate) fn move_tail(&mut self, first: usize, to: &mut Revolution) {
        to.firings.extend(self.firings.drain(first..));
        for (from, to) in self.echoes.iter_mut().zip(&mut to.echoes) {
            from.move_tail(first * self.lasers, to);
        }
    }
}
