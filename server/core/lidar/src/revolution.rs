//! One turn of one sensor: the range image and its points.
//!
//! In: slots that [`crate::turns`] fills. Out: [`Revolution`], in the sensor's frame (REP-103), and [`Point`]s.

use std::f32::consts::TAU;
use std::sync::Arc;

use crate::blocked::Blocked;
use crate::calibration::Calibration;
use crate::clock::Clock;
use crate::model::{AZIMUTHS_PER_TURN, Model, RETURNS_PER_BLOCK, ReturnMode};

/// One turn of one sensor as a range image: `lasers` slots a firing, firings in time order.
///
/// Slot `firing * lasers + laser` of every [`Echo`] array belongs to the same beam. Frame: the sensor's (REP-103).
#[derive(Clone, Debug)]
pub struct Revolution {
    /// Counts from 0 for each sensor.
    pub sequence: u64,
    /// The model that made it.
    pub model: Model,
    /// The echoes asked of the sensor.
    pub return_mode: ReturnMode,
    /// Slots a firing; the index within a firing is the laser in firing order.
    pub lasers: usize,
    /// The firings, in time order.
    pub firings: Vec<Firing>,
    /// One image, or two in dual-return mode: the strongest first, then the last where it is another echo. A last echo
    /// equal to the strongest has range 0 in the second image, so that no echo is there twice.
    pub echoes: Vec<Echo>,
    /// The per-laser corrections that were applied; `calibration.lasers[laser]` has elevation and ring.
    pub calibration: Arc<Calibration>,
    /// Stamp of the first firing, ns since the Unix epoch.
    pub start_ns: i64,
    /// Stamp of the last firing, ns since the Unix epoch.
    pub end_ns: i64,
    /// The clock the stamps follow.
    pub clock: Clock,
    /// By how much the host's clock is ahead of the stamps, ms: arrival of the turn's quickest packet less its stamp,
    /// so that the way from the sensor counts too.
    pub clock_offset_ms: i64,
    /// Measured turning rate.
    pub rpm: f32,
    /// Why the turn is not whole; `None` for a whole one.
    pub partial: Option<Partial>,
    /// Data packets that contributed.
    pub packets: u32,
    /// The same and those that were missing before them, ±1 a gap; where a field of view is set, without its dark
    /// sector (from the second turn on). A gap that goes over the cut counts in the turn in which it begins.
    pub packets_expected: u32,
    /// Encoder angles (as in [`Firing::azimuth_rad`]) between which the sensor fires nothing: the dark side of the
    /// field of view it was set to. Learnt: a gap of 15 degrees or more that the next turn has too, in which device
    /// time shows nothing but a pause. It is no gap of the turn and no packet of it is expected.
    pub dark_rad: Option<[f32; 2]>,
    /// Where the sensor used to see and does no more.
    pub blocked: Blocked,
    /// Firings of a whole turn: this one's, else the newest whole one's, else by the manual's period; seen ones are
    /// `firings.len()`.
    pub firings_expected: u32,
}

/// Why a revolution does not cover its whole turn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Partial {
    /// The stream began inside the turn.
    Start,
    /// The stream ended inside the turn.
    End,
    /// Azimuths are missing inside the turn (lost packets or a blocked sector).
    Gap,
    /// The azimuth ran backwards.
    Reversal,
    /// The sensor did not get round in [`crate::turns::MAX_FIRINGS_PER_TURN`] firings.
    Overlong,
}

impl Partial {
    /// As the wire spells it.
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

/// One pass of all lasers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Firing {
    /// Encoder angle, rad, clockwise from the sensor's x axis seen from above (Velodyne's sense), in [0, 2π).
    pub azimuth_rad: f32,
    /// ns since the revolution's `start_ns`.
    pub offset_ns: u32,
}

/// One image of echoes. Arrays hold `firings * lasers` slots.
#[derive(Clone, Debug, Default)]
pub struct Echo {
    /// Corrected range; 0: fired, no return; NaN: this laser did not fire in this firing (HDL-64E S1).
    pub range_m: Vec<f32>,
    /// Metres, sensor frame; unspecified where there is no return.
    pub x: Vec<f32>,
    /// Metres, sensor frame.
    pub y: Vec<f32>,
    /// Metres, sensor frame.
    pub z: Vec<f32>,
    /// 0 to 255 as the sensor reports it.
    pub intensity: Vec<u8>,
}

/// One echo as a point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// Metres, sensor frame.
    pub x: f32,
    /// Metres, sensor frame.
    pub y: f32,
    /// Metres, sensor frame.
    pub z: f32,
    /// Corrected range, m.
    pub range_m: f32,
    /// As the sensor reports it.
    pub intensity: u8,
    /// Rank of the laser by elevation, 0 lowest.
    pub ring: u16,
    /// Index in firing order.
    pub laser: u16,
    /// The firing it belongs to, index into `firings`.
    pub firing: u32,
    /// When the laser fired, ns since the Unix epoch.
    pub time_ns: i64,
    /// 1: the strongest echo; 2: the last; 3: both are one.
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
            rpm: 0.0,
            partial: None,
            packets: 0,
            packets_expected: 0,
            dark_rad: None,
            blocked: Blocked::default(),
            firings_expected: 0,
        }
    }

    /// Ring of every laser, in firing order: rank by elevation, 0 lowest.
    pub fn rings(&self) -> Vec<u16> {
        self.calibration.rings()
    }

    /// Echoes with a range.
    pub fn returns(&self) -> usize {
        self.echoes.iter().flat_map(|echo| &echo.range_m).filter(|range| **range > 0.0).count()
    }

    /// Every echo with a range: firing by firing, laser by laser, the strongest before the last.
    pub fn points(&self) -> impl Iterator<Item = Point> + '_ {
        let rings = self.rings();
        let offsets: Vec<u32> = (0..self.lasers).map(|laser| self.model.spec().laser_offset_ns(laser)).collect();
        let slots = self.firings.len() * self.lasers * self.echoes.len();
        (0..slots).filter_map(move |place| {
            let (slot, image) = (place / self.echoes.len(), place % self.echoes.len());
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
            (ReturnMode::Dual, _) if self.echoes[0].repeated_by(&self.echoes[1], slot) => 3,
            (ReturnMode::Dual, _) => 1,
        }
    }

    /// Empties the image for the next turn, keeping its memory.
    pub(crate) fn begin_like(&mut self, other: &Revolution) {
        self.firings.clear();
        self.echoes.iter_mut().for_each(|echo| echo.truncate(0));
        self.echoes.resize_with(other.echoes.len(), Echo::default);
        (self.model, self.return_mode, self.lasers) = (other.model, other.return_mode, other.lasers);
        self.calibration.clone_from(&other.calibration);
        (self.partial, self.packets, self.packets_expected) = (None, 0, 0);
    }

    /// Adds empty firings: no laser has fired yet.
    pub(crate) fn grow(&mut self, firings: &[Firing]) {
        self.firings.extend_from_slice(firings);
        let slots = self.firings.len() * self.lasers;
        self.echoes.iter_mut().for_each(|echo| echo.resize(slots));
    }

    /// Moves the firings from `first` on to the end of `to`, which has the same lasers and images.
    pub(crate) fn move_tail(&mut self, first: usize, to: &mut Revolution) {
        to.firings.extend(self.firings.drain(first..));
        for (from, to) in self.echoes.iter_mut().zip(&mut to.echoes) {
            from.move_tail(first * self.lasers, to);
        }
    }
}

impl Firing {
    pub(crate) fn new(azimuth: u32, offset_ns: u32) -> Self {
        Self { azimuth_rad: azimuth as f32 * (TAU / AZIMUTHS_PER_TURN as f32), offset_ns }
    }
}

impl Echo {
    /// The 32 slots from `first` on.
    pub(crate) fn slots(&mut self, first: usize) -> crate::beam::Slots<'_> {
        fn lanes<T>(values: &mut [T], first: usize) -> &mut [T; RETURNS_PER_BLOCK] {
            (&mut values[first..first + RETURNS_PER_BLOCK]).try_into().expect("32 slots")
        }
        crate::beam::Slots {
            range_m: lanes(&mut self.range_m, first),
            x: lanes(&mut self.x, first),
            y: lanes(&mut self.y, first),
            z: lanes(&mut self.z, first),
            intensity: lanes(&mut self.intensity, first),
        }
    }

    /// Takes out of the slots from `first` on the echoes that `strongest` holds too: equal distance and intensity.
    pub(crate) fn drop_repeats(&mut self, strongest: &Echo, first: usize) {
        for slot in first..self.range_m.len() {
            let same =
                (self.range_m[slot] == strongest.range_m[slot]) & (self.intensity[slot] == strongest.intensity[slot]);
            self.range_m[slot] = if same { 0.0 } else { self.range_m[slot] };
        }
    }

    /// Whether the last echo was this one: its range was taken out, its place left.
    fn repeated_by(&self, last: &Echo, slot: usize) -> bool {
        let place = |echo: &Echo| [echo.x[slot], echo.y[slot], echo.z[slot]];
        last.range_m[slot] == 0.0 && place(self) == place(last)
    }

    fn arrays(&mut self) -> [&mut Vec<f32>; 4] {
        [&mut self.range_m, &mut self.x, &mut self.y, &mut self.z]
    }

    fn truncate(&mut self, slots: usize) {
        self.arrays().into_iter().for_each(|array| array.truncate(slots));
        self.intensity.truncate(slots);
    }

    /// New slots have not fired.
    fn resize(&mut self, slots: usize) {
        self.arrays().into_iter().for_each(|array| array.resize(slots, f32::NAN));
        self.intensity.resize(slots, 0);
    }

    fn move_tail(&mut self, first: usize, to: &mut Echo) {
        for (from, to) in self.arrays().into_iter().zip(to.arrays()) {
            to.extend(from.drain(first..));
        }
        to.intensity.extend(self.intensity.drain(first..));
    }
}
