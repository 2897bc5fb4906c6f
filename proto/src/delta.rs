//! Two versions of a layer -> a delta, which holds the changes between them: `Layer.base_sequence` of map.proto.
//!
//! In: the layer of an earlier map and the new layer, both whole. Out: the delta; [`crate::map::decode_map_on`] applies
//! it. A channel whose changes are not smaller stays as in the whole layer. The CRC covers the resulting cells, so a
//! delta on a wrong base is refused and never gives a wrong cell.

use prost::Message;

use crate::channel::cells::Cells;
use crate::channel::changes::encode_changes;
use crate::limits::Limits;
use crate::map::base::Shift;
use crate::map::decode::decode_layer;
use crate::map::legend::{encode_legend, is_same_legend};
use crate::v1;

/// Encodes `new` as changes from `base`, a layer of the map `base_sequence` of the same vehicle and boot id; both are
/// whole. The same layers give the same bytes.
///
/// `None` if `new` has to be sent whole: the grids or channels are not comparable, a layer is not whole or not within
/// the limits, or the delta is not smaller.
pub fn encode_delta(base: &v1::Layer, base_sequence: u64, new: &v1::Layer, limits: &Limits) -> Option<v1::Layer> {
    let old = decode_layer(base.clone(), None, limits).ok()?;
    let decoded = decode_layer(new.clone(), None, limits).ok()?;
    if old.channels.len() != decoded.channels.len() {
        return None;
    }
    let shift = Shift::new(&old, &decoded.grid).ok()?;
    let columns = decoded.grid.shape().1 as usize;
    let mut delta = v1::Layer { base_sequence: Some(base_sequence), ..new.clone() };
    if is_same_legend(base, new) {
        encode_legend(&mut delta, []);
    }
    for (channel, now) in delta.channels.iter_mut().zip(&decoded.channels) {
        let before =
            old.channel(&now.name).filter(|before| (before.scale, before.unknown) == (now.scale, now.unknown))?;
        let changes = changes_between(shift.shift(&before.cells, now.unknown), &now.cells, columns)?;
        if changes.len() < channel.payload.len() + channel.by_class.len() {
            (channel.encoding, channel.payload) = (v1::Encoding::Changes.into(), changes.into());
            channel.by_class.clear();
        }
    }
    let needs_base = delta.channels.iter().zip(&new.channels).any(|(channel, whole)| channel != whole);
    (needs_base && delta.encoded_len() < new.encoded_len()).then_some(delta)
}

/// The changes from `base` to `cells`; `None` if they differ in type.
fn changes_between(base: Cells, cells: &Cells, columns: usize) -> Option<Vec<u8>> {
    Some(match (base, cells) {
        (Cells::U8(base), Cells::U8(cells)) => encode_changes(cells, base, columns),
        (Cells::I8(base), Cells::I8(cells)) => encode_changes(cells, base, columns),
        (Cells::U16(base), Cells::U16(cells)) => encode_changes(cells, base, columns),
        _ => return None,
    })
}
