//! One range image: the arrays of range, coordinates and intensity of a revolution's slots.

use crate::model::RETURNS_PER_BLOCK;

/// One range image: the returns of one echo. Each array has `firings * lasers` slots.
#[derive(Clone, Debug, Default)]
pub struct Echo {
    /// Corrected range, in m; 0 if the laser fired without a return; NaN if it did not fire in this firing (HDL-64E
    /// S1).
    pub range_m: Vec<f32>,
    /// Coordinate x, in m in the sensor's frame; unspecified without a return.
    pub x: Vec<f32>,
    /// Coordinate y, in m in the sensor's frame; unspecified without a return.
    pub y: Vec<f32>,
    /// Coordinate z, in m in the sensor's frame; unspecified without a return.
    pub z: Vec<f32>,
    /// Intensity as the sensor reports it, 0 to 255.
    pub intensity: Vec<u8>,
}

/// The values of 32 lasers.
pub(crate) type Lanes = [f32; RETURNS_PER_BLOCK];

/// 32 slots of each array of an [`Echo`].
pub(crate) struct Slots<'a> {
    pub range_m: &'a mut Lanes,
    pub x: &'a mut Lanes,
    pub y: &'a mut Lanes,
    pub z: &'a mut Lanes,
    pub intensity: &'a mut [u8; RETURNS_PER_BLOCK],
}

impl Echo {
    /// The 32 slots from `first` on.
    pub(crate) fn slots(&mut self, first: usize) -> Slots<'_> {
        fn lanes<T>(values: &mut [T], first: usize) -> &mut [T; RETURNS_PER_BLOCK] {
            (&mut values[first..first + RETURNS_PER_BLOCK]).try_into().expect("32 slots")
        }
        Slots {
            range_m: lanes(&mut self.range_m, first),
            x: lanes(&mut self.x, first),
            y: lanes(&mut self.y, first),
            z: lanes(&mut self.z, first),
            intensity: lanes(&mut self.intensity, first),
        }
    }

    /// Removes from the slots from `first` on the returns that are also in `strongest`: their distance and intensity
    /// are equal.
    pub(crate) fn remove_repeats(&mut self, strongest: &Echo, first: usize) {
        for slot in first..self.range_m.len() {
            let same =
                (self.range_m[slot] == strongest.range_m[slot]) & (self.intensity[slot] == strongest.intensity[slot]);
            self.range_m[slot] = if same { 0.0 } else { self.range_m[slot] };
        }
    }

    /// True if the last echo of a slot was equal to this echo. Its range was removed then, but not its coordinates.
    pub(super) fn is_repeated_by(&self, last: &Echo, slot: usize) -> bool {
        let position = |echo: &Echo| [echo.x[slot], echo.y[slot], echo.z[slot]];
        last.range_m[slot] == 0.0 && position(self) == position(last)
    }

    fn arrays(&mut self) -> [&mut Vec<f32>; 4] {
        [&mut self.range_m, &mut self.x, &mut self.y, &mut self.z]
    }

    pub(super) fn truncate(&mut self, slots: usize) {
        self.arrays().into_iter().for_each(|array| array.truncate(slots));
        self.intensity.truncate(slots);
    }

    /// Resizes the arrays; new slots are of lasers that did not fire.
    pub(super) fn resize(&mut self, slots: usize) {
        self.arrays().into_iter().for_each(|array| array.resize(slots, f32::NAN));
        self.intensity.resize(slots, 0);
    }

    /// Moves the slots from `first` on to the end of `to`.
    pub(super) fn move_tail(&mut self, first: usize, to: &mut Echo) {
        for (from, to) in self.arrays().into_iter().zip(to.arrays()) {
            to.extend(from.drain(first..));
        }
        to.intensity.extend(self.intensity.drain(first..));
    }
}
