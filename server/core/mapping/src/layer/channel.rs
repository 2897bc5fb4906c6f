//! Channels of a layer: one value a cell, with its name, unit and scale.
//!
//! [`Channel`] is what a map holds, whatever the type of its cells. [`TypedChannel`] is how the maker of a layer knows
//! one of its channels: it carries the type of the cells, and reuses their memory from map to map.

/// One value for each cell of a layer.
#[derive(Clone, Debug, PartialEq)]
pub struct Channel {
    /// `class`, `unit_height`, `segment`, `difference`, …
    pub name: &'static str,
    /// Unit of `raw * scale`, for example `m`; `id` for an id, `""` for a class and for a value without a unit.
    pub unit: &'static str,
    /// Factor from a raw value to a value in `unit`.
    pub scale: f32,
    /// Raw value of a cell about which nothing is known.
    pub unknown: i32,
    /// Raw values, in the order of the layer's grid.
    pub cells: Cells,
}

/// Raw values of a channel, in the order of the layer's grid.
#[derive(Clone, Debug, PartialEq)]
pub enum Cells {
    /// 0 to 255.
    U8(Vec<u8>),
    /// -128 to 127.
    I8(Vec<i8>),
    /// 0 to 65535.
    U16(Vec<u16>),
}

/// Type of a channel's raw values: `u8`, `i8` or `u16`.
pub trait CellType: Copy + Into<i32> {
    /// Wraps raw values of this type.
    fn into_cells(values: Vec<Self>) -> Cells;

    /// Moves raw values of this type out; an empty vector if `cells` has another type.
    fn take_values(cells: &mut Cells) -> Vec<Self>;

    /// Borrows raw values of this type; `None` if `cells` has another type.
    fn values(cells: &Cells) -> Option<&[Self]>;
}

macro_rules! cell_type {
    ($type:ty, $variant:ident) => {
        impl CellType for $type {
            fn into_cells(values: Vec<Self>) -> Cells {
                Cells::$variant(values)
            }

            fn take_values(cells: &mut Cells) -> Vec<Self> {
                if let Cells::$variant(values) = cells { std::mem::take(values) } else { Vec::new() }
            }

            fn values(cells: &Cells) -> Option<&[Self]> {
                if let Cells::$variant(values) = cells { Some(values) } else { None }
            }
        }
    };
}
cell_type!(u8, U8);
cell_type!(i8, I8);
cell_type!(u16, U16);

/// A channel of one layer with raw values of type `T`, without the values themselves.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TypedChannel<T> {
    /// Name, unique within the layer.
    pub name: &'static str,
    /// As [`Channel::unit`].
    pub unit: &'static str,
    /// As [`Channel::scale`].
    pub scale: f32,
    /// Raw value of a cell about which nothing is known.
    pub unknown: T,
}

impl TypedChannel<u8> {
    /// The channel `class` that every layer has: raw values are indices into the legend, 0 is unknown.
    pub const CLASS: Self = Self { name: "class", unit: "", scale: 1.0, unknown: 0 };
}

impl<T: CellType> TypedChannel<T> {
    /// The channel without cells.
    pub fn empty(&self) -> Channel {
        self.with_values(Vec::new())
    }

    fn with_values(&self, values: Vec<T>) -> Channel {
        let Self { name, unit, scale, unknown } = *self;
        Channel { name, unit, scale, unknown: unknown.into(), cells: T::into_cells(values) }
    }

    /// Raw values of this channel; `None` if the layer has no such channel.
    pub fn values<'a>(&self, channels: &'a [Channel]) -> Option<&'a [T]> {
        channels.iter().find(|channel| channel.name == self.name).and_then(|channel| T::values(&channel.cells))
    }

    /// Moves the memory of this channel's cells out of a layer, emptied, to be filled and given to
    /// [`TypedChannel::store`].
    pub fn reuse(&self, channels: &mut [Channel]) -> Vec<T> {
        let mut values = self.reuse_values(channels);
        values.clear();
        values
    }

    /// Moves the cells of this channel out of a layer, to be changed and given to [`TypedChannel::store`].
    pub(crate) fn reuse_values(&self, channels: &mut [Channel]) -> Vec<T> {
        let channel = channels.iter_mut().find(|channel| channel.name == self.name);
        channel.map_or(Vec::new(), |channel| T::take_values(&mut channel.cells))
    }

    /// Puts this channel with new raw values into a layer, in place of the channel that it had.
    pub fn store(&self, channels: &mut Vec<Channel>, values: Vec<T>) {
        match channels.iter_mut().find(|channel| channel.name == self.name) {
            Some(channel) => *channel = self.with_values(values),
            None => channels.push(self.with_values(values)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_channel_keeps_its_memory_from_map_to_map() {
        let height = TypedChannel { name: "height", unit: "m", scale: 0.05, unknown: i8::MIN };
        let mut channels = vec![TypedChannel::CLASS.empty(), height.empty()];
        let mut values = height.reuse(&mut channels);
        values.extend([1, 2, 3]);
        let memory = values.as_ptr();
        height.store(&mut channels, values);
        assert_eq!(height.values(&channels), Some(&[1, 2, 3][..]));
        let values = height.reuse(&mut channels);
        assert!(values.is_empty() && values.as_ptr() == memory);
    }

    #[test]
    fn a_channel_of_another_type_or_name_has_no_values() {
        let channels = vec![TypedChannel::CLASS.empty()];
        assert_eq!(TypedChannel { name: "class", unit: "", scale: 1.0, unknown: 0_u16 }.values(&channels), None);
        assert_eq!(TypedChannel { name: "hits", ..TypedChannel::CLASS }.values(&channels), None);
    }
}
