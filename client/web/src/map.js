// In: the bytes of a MapUpdate or of a Map, or a Map message as another protobuf decoder read it. Out: the map, whose
// layers and channels are decoded when they are first needed, or a DecodeError or WireError that says what is wrong.

import { baseByClass, checkCount, decodeChannel } from "./codec.js";
import { baseCells, baseLayer } from "./delta.js";
import { gridOf } from "./grid.js";
import { isWithoutLegend, readLegend } from "./legend.js";
import { DecodeError, MAP_BYTES_MAX, MAP_CELLS_MAX, MAP_PARTS_MAX, WIRE_VERSION } from "./limits.js";
import { countParts, readLayer, readLayerName, readMap, readMapUpdate } from "./protobuf.js";
import { readSafePoints } from "./safe_points.js";

// { skipped, left_out, sent_ns, map, plan }: a MapUpdate and its map; plan is null if there is none. 64-bit values are
// BigInt. base: the map that deltas start from.
export function openUpdate(message, base = null) {
  const update = readMapUpdate(message);
  if (update.sent_ns <= 0n) throw new DecodeError("sent_ns", `${update.sent_ns}; the age needs it`);
  return { ...update, map: new LiveMap(update.map, base) };
}

// A map; at first only its header and the layers' names are read.
export class LiveMap {
  // By name: a Layer message, or its bytes.
  #sources = new Map();
  #layers = new Map();
  #cells_claimed = 0;

  // map: an encoded Map, or a Map message with the field names of map.proto, 64-bit numbers as BigInt and bytes as
  // Uint8Array. base: the map that deltas start from, or null. With a base every layer is opened at once, so that no
  // map keeps another map.
  constructor(map, base = null) {
    const is_encoded = ArrayBuffer.isView(map);
    this.length = is_encoded ? map.length : 0;
    const { header, layers } = is_encoded ? readChecked(map) : map;
    if (!header) throw new DecodeError("header", "the map has none");
    if (header.wire_version > WIRE_VERSION) {
      throw new DecodeError("version", `${header.wire_version}; versions up to ${WIRE_VERSION} are known`);
    }
    checkHeader(header);
    this.header = header;
    for (const layer of layers) {
      const name = ArrayBuffer.isView(layer) ? readLayerName(layer) : layer.name;
      if (this.#sources.has(name)) throw new DecodeError("twice", `two layers are named ${name}`);
      this.#sources.set(name, layer);
    }
    if (base) this.names.forEach((name) => this.layer(name, base));
  }

  // The names of the layers, in the order on the wire.
  get names() {
    return [...this.#sources.keys()];
  }

  // The layer of this name; null if the map has none.
  layer(name, base = null) {
    if (!this.#sources.has(name)) return null;
    if (!this.#layers.has(name)) this.#layers.set(name, this.#open(this.#sources.get(name), base));
    return this.#layers.get(name);
  }

  #open(source, base) {
    const message = ArrayBuffer.isView(source) ? readLayer(source) : source;
    for (const { cell_count } of message.channels) this.#cells_claimed += cell_count;
    if (this.#cells_claimed > MAP_CELLS_MAX) {
      throw new DecodeError("too_many_cells", `${this.#cells_claimed} cells; a map may have ${MAP_CELLS_MAX}`);
    }
    return new Layer(message, baseLayer(message, this.header, base));
  }
}

// As the Rust client checks it: a capture that does not end before its start, finite metres, a unit quaternion.
function checkHeader({ capture_start_ns = 0n, capture_end_ns = 0n, map_from_ego }) {
  if (capture_start_ns > capture_end_ns) {
    throw new DecodeError("header", `the capture starts at ${capture_start_ns} ns and ends at ${capture_end_ns} ns`);
  }
  if (!map_from_ego) return;
  const { x = 0, y = 0, z = 0, qx = 0, qy = 0, qz = 0, qw = 0 } = map_from_ego, norm = Math.hypot(qx, qy, qz, qw);
  if (![x, y, z].every(Number.isFinite) || !(Math.abs(norm - 1) <= 1e-3)) {
    const what = `map_from_ego at (${x}, ${y}, ${z}) m with a quaternion of norm ${norm}`;
    throw new DecodeError("header", `${what}; finite metres and norm 1 are needed`);
  }
}

// The Map message in these bytes, with layers as bytes.
function readChecked(bytes) {
  if (bytes.length > MAP_BYTES_MAX) {
    throw new DecodeError("too_long", `${bytes.length} bytes; at most ${MAP_BYTES_MAX} are allowed`);
  }
  const parts = countParts(bytes);
  if (parts > MAP_PARTS_MAX) {
    throw new DecodeError("too_many_parts", `${parts} parts; at most ${MAP_PARTS_MAX} are allowed`);
  }
  return readMap(bytes);
}

// One layer: { name, legend: [{ name, meaning, colour }], grid, metrics, channels: [{ name, unit, scale, unknown }],
// planes: [{ a, b, c }] by segment, safe_points: of safe_points.js, or null }.
class Layer {
  #channels = new Map();
  #cells = new Map();
  #before;

  // message: a Layer message. before: the layer that a delta starts from; null for a whole layer.
  constructor(message, before) {
    this.name = message.name;
    this.grid = gridOf(message);
    this.legend = before && isWithoutLegend(message) ? before.legend : readLegend(message);
    this.metrics = message.metrics;
    this.planes = message.planes;
    this.safe_points = readSafePoints(message.name, message.safe_points);
    this.#before = before;
    for (const channel of message.channels) {
      if (this.#channels.has(channel.name)) {
        throw new DecodeError("twice", `layer ${this.name}: two channels are named ${channel.name}`);
      }
      checkCount(channel, this.grid.shape);
      this.#channels.set(channel.name, channel);
    }
    this.channels = message.channels.map(({ name, unit, scale, unknown }) => ({ name, unit, scale, unknown }));
    if (this.channels.length === 0) throw new DecodeError("channels", `layer ${this.name} has none`);
    if (before) this.channels.forEach(({ name }) => this.cells(name));
    this.#before = null;
  }

  // The cells of the channel of this name, decoded at the first call; null if the layer has none.
  cells(name) {
    if (!this.#channels.has(name)) return null;
    if (!this.#cells.has(name)) this.#cells.set(name, this.#decode(this.#channels.get(name)));
    return this.#cells.get(name);
  }

  #decode(channel) {
    const cells = decodeChannel(channel, this.grid.shape, this.#base(channel));
    if (channel.name === "class") this.#checkClasses(cells);
    return cells;
  }

  #base(channel) {
    if (channel.by_class.length === 0) return this.#before && baseCells(this.name, this.grid, this.#before, channel);
    // Channel "class" must lie before a channel that depends on it.
    const names = [...this.#channels.keys()];
    const has_classes = names.slice(0, names.indexOf(channel.name)).includes("class");
    return baseByClass(channel, has_classes ? this.cells("class") : null, this.legend);
  }

  #checkClasses(cells) {
    let greatest = 0, least = 0;
    for (let i = 0; i < cells.length; i++) {
      if (cells[i] > greatest) greatest = cells[i];
      else if (cells[i] < least) least = cells[i];
    }
    if (least >= 0 && greatest < this.legend.length) return;
    const unnamed = least < 0 ? least : greatest;
    throw new DecodeError("class", `layer ${this.name}: class ${unnamed}; the legend names ${this.legend.length}`);
  }
}
