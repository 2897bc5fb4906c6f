// In: the bytes of one MapUpdate. Out: the map with every layer's grid and cells checked, or an error that names what
// was wrong. A map is taken whole or not at all.

import { byClass, decodeChannel, Refused } from "./codec.js";
import { baseOf, beforehand } from "./delta.js";
import { gridOf } from "./grid.js";
import { readMap, readMapUpdate } from "./protobuf.js";

// The server's limit is 64 KiB a message; this leaves room for large layers, not for an attack.
const BYTES_MAX = 4 << 20;

// { skipped, sent_ns, bytes, header, layers: [{ name, legend, grid, channels: [{ name, unit, scale, unknown, cells }],
// figures }] }; 64-bit values are BigInt.
// base: the map opened before, which deltas stand on.
export function openUpdate(message, base = null) {
  if (message.length > BYTES_MAX) throw new Refused("length", `${message.length} bytes; at most ${BYTES_MAX}`);
  const update = readMapUpdate(message);
  if (update.sent_ns <= 0n) throw new Refused("sent_ns", `${update.sent_ns}; without it no age can be told`);
  return { ...update, bytes: update.map.length, ...openMap(update.map, base) };
}

export function openMap(bytes, base = null) {
  const { header, layers } = readMap(bytes);
  if (!header) throw new Refused("header", "the map has none");
  return { header, layers: layers.map((layer) => openLayer(layer, baseOf(layer, header, base))) };
}

function openLayer(layer, before) {
  const grid = gridOf(layer), legend = layer.legend.length || !before ? layer.legend : before.legend;
  let classes = null;
  const channels = layer.channels.map((channel) => {
    const told = channel.by_class.length > 0, base = before && beforehand(layer.name, grid, before, channel);
    const cells = decodeChannel(channel, grid.shape, told ? byClass(channel, classes, legend) : base);
    if (channel.name === "class") {
      const unnamed = cells.find((cell) => cell < 0 || cell >= legend.length);
      if (unnamed !== undefined) {
        throw new Refused("class", `layer ${layer.name}: ${unnamed}; the legend names ${legend.length}`);
      }
      classes = cells;
    }
    const { name, unit, scale, unknown } = channel;
    return { name, unit, scale, unknown, cells };
  });
  if (channels.length === 0) throw new Refused("channels", `layer ${layer.name} has none`);
  return { name: layer.name, legend, grid, channels, figures: layer.figures };
}
