// In: a Channel message, as protobuf.js reads it. Out: its cells in a typed array, or a DecodeError.
// The claimed count is checked before anything is allocated; where it is large beside the payload, the lengths in it
// are too, so that a false claim costs nothing. This decoder does not check that a payload is canonical:
// the CRC shows whether the cells are right. Format: proto/clearway/v1/map.proto, Channel and Encoding.
// The loops over cells call no function a cell: on 160,000 cells `Uint8Array.from(cells, callback)` takes 53 ms where
// a loop takes 0.8 ms (Node 20).

import { CHANNEL_CELLS_MAX, DecodeError } from "./limits.js";

const TYPES = { 1: Uint8Array, 2: Int8Array, 3: Uint16Array };
const RAW = 1, ROWS = 2, CHANGES = 3;
// Claims of more cells for each byte of the payload are checked before memory is allocated for them.
const CELLS_PER_BYTE = 1024;
// The context in which it is encoded whether a changed cell has the likely value. Contexts below it describe a cell's
// neighbours.
const LIKELY = 64;
// The index of the mean of the values, after two means a context.
const VALUES = 2 * (LIKELY + 1);

// Checks that a channel claims as many cells as the grid has, and no more than a channel may have.
export function checkCount({ name, cell_count }, [rows, columns]) {
  if (cell_count > CHANNEL_CELLS_MAX) {
    const what = `${cell_count} cells; at most ${CHANNEL_CELLS_MAX} are allowed`;
    throw new DecodeError("too_many_cells", `channel ${name}: ${what}`);
  }
  if (cell_count !== rows * columns) {
    throw new DecodeError("cell_count", `channel ${name}: ${cell_count} cells; the grid has ${rows} x ${columns}`);
  }
}

// channel: a Channel message. shape: [rows, columns] of the grid. base: a function from an array type to the cells that
// encoding CHANGES starts from, or null if there are none; it is called after the count is checked.
export function decodeChannel(channel, shape, base = null) {
  checkCount(channel, shape);
  const { name, cell_type, cell_count, encoding, payload } = channel, columns = shape[1];
  const error = (reason, detail) => new DecodeError(reason, `channel ${name}: ${detail}`);
  const Cells = TYPES[cell_type];
  const bytes_saved = Cells ? cell_count * Cells.BYTES_PER_ELEMENT - payload.length : -1;
  const allowed = { [RAW]: bytes_saved === 0, [ROWS]: bytes_saved > 0, [CHANGES]: bytes_saved > 0 && base !== null };
  if (!allowed[encoding]) {
    const what = `${payload.length} bytes of encoding ${encoding} for ${cell_count} cells of type ${cell_type}`;
    throw error("cells", what);
  }
  const bits = new BitReader(payload, error);
  let cells;
  if (encoding === RAW) cells = littleEndian(payload, Cells);
  else if (encoding === ROWS) {
    const is_large = cell_count > CELLS_PER_BYTE * (payload.length + 64);
    if (is_large) checkLengths(new BitReader(payload, error), cell_count, error);
    cells = readRows(bits, new Cells(cell_count), columns);
  }
  else cells = readChanges(bits, base(Cells), columns);
  const crc = crc32(new Uint8Array(cells.buffer));
  if (crc !== channel.crc32) {
    throw error("cells", `their CRC is ${crc.toString(16)}; the message says ${channel.crc32.toString(16)}`);
  }
  return cells;
}

// The base of a channel with by_class: a function from an array type to the usual value of each cell's class.
// classes: the cells of channel "class". legend: the names of its values.
export function baseByClass({ name, cell_type, encoding, by_class }, classes, legend) {
  const fits = by_class.length === legend.length * (TYPES[cell_type]?.BYTES_PER_ELEMENT ?? 1);
  if (encoding !== CHANGES || !fits || !(classes instanceof Uint8Array)) {
    const what = `${by_class.length} bytes, ${legend.length} classes of u8 before it`;
    throw new DecodeError("by_class", `channel ${name}: ${what}`);
  }
  return (Cells) => {
    const value_of = littleEndian(by_class, Cells), cells = new Cells(classes.length);
    for (let i = 0; i < cells.length; i++) cells[i] = value_of[classes[i]];
    return cells;
  };
}

// Reads numbers from bytes, most significant bit first.
class BitReader {
  #bytes;
  #bits;
  #error;
  #at = 0;

  constructor(payload, error) {
    // Zeros behind the payload let `number` read 5 bytes anywhere in it.
    this.#bytes = new Uint8Array(payload.length + 8);
    this.#bytes.set(payload);
    this.#bits = 8 * payload.length;
    this.#error = error;
  }

  bit() {
    if (this.#at === this.#bits) throw this.#error("cells", "the payload ends inside them");
    const at = this.#at++;
    return (this.#bytes[at >> 3] >> (7 - (at & 7))) & 1;
  }

  // A number in exp-Golomb code of this order.
  number(order) {
    const byte = this.#at >> 3, shift = this.#at & 7, b = this.#bytes;
    const four = (b[byte] << 24) | (b[byte + 1] << 16) | (b[byte + 2] << 8) | b[byte + 3];
    const next_32 = (four << shift) | (b[byte + 4] >> (8 - shift));
    const zeros = Math.clz32(next_32), more = zeros + order, length = zeros + 1 + more;
    if (length > 32) return this.#longNumber(order);
    if (this.#at + length > this.#bits) throw this.#error("cells", "the payload ends inside them");
    this.#at += length;
    return ((next_32 << zeros) >>> (31 - more)) - 2 ** order;
  }

  // The same for a number of any length.
  #longNumber(order) {
    let more = order, value = 1;
    while (!this.bit()) if (++more > 32) throw this.#error("cells", "a number of more than 32 bits");
    while (more-- > 0) value = 2 * value + this.bit();
    return value - 2 ** order;
  }
}

// The raw value of a number on the wire: signed values are zigzag-encoded. A value that does not fit wraps in the typed
// array, and then the CRC is wrong.
const rawValue = (number, signed) => (signed ? (number >>> 1) ^ -(number & 1) : number);

// Checks that the lengths of encoding ROWS add up to the number of cells.
function checkLengths(bits, count, error) {
  let at = 0;
  while (at < count) {
    at += bits.number(0);
    if (at >= count) break;
    if (!bits.bit()) bits.number(0);
    at += bits.number(0) + 1;
  }
  if (at !== count) throw error("cells", `the payload has ${at} cells, not ${count}`);
}

// Encoding ROWS: alternately cells equal to the cells one row before, and a run of one other value.
function readRows(bits, cells, columns) {
  const signed = cells instanceof Int8Array;
  for (let at = 0; at < cells.length; ) {
    const end = Math.min(at + bits.number(0), cells.length);
    for (; at < end; at++) cells[at] = at < columns ? 0 : cells[at - columns];
    if (at === cells.length) break;
    const value = bits.bit() ? cells[at - 1] : rawValue(bits.number(0), signed);
    cells.fill(value, at, (at += bits.number(0) + 1));
  }
  return cells;
}

// The flags of encoding CHANGES. In each context, runs of flag 0 and runs of flag 1 alternate.
class FlagReader {
  #bits;
  // By context: the current flag, -1 before the first; how many more cells have it.
  #flags = new Int8Array(LIKELY + 1).fill(-1);
  #left = new Float64Array(LIKELY + 1);
  // By context and flag, then of the values: the running mean that gives the order of the next number.
  #means = new Float64Array(VALUES + 1);

  constructor(bits) {
    this.#bits = bits;
  }

  flag(context) {
    if (this.#left[context] > 0) {
      this.#left[context]--;
      return this.#flags[context];
    }
    const flag = this.#flags[context] < 0 ? this.#bits.bit() : 1 - this.#flags[context];
    this.#flags[context] = flag;
    this.#left[context] = this.#number(2 * context + flag);
    return flag;
  }

  value() {
    return this.#number(VALUES);
  }

  #number(kind) {
    const mean = this.#means[kind], number = this.#bits.number(31 - Math.clz32(mean || 1));
    this.#means[kind] = Math.ceil((mean + number) / 2);
    return number;
  }
}

// Encoding CHANGES: which cells differ from the base, and their values.
function readChanges(bits, base, columns) {
  const cells = base.slice(), changed = new Uint8Array(cells.length), flags = new FlagReader(bits);
  const signed = cells instanceof Int8Array, last_row = cells.length - columns;
  for (let at = 0, column = 0; at < cells.length; at++) {
    // The neighbours. Outside the grid a neighbour is the cell itself: unchanged so far, and equal to itself.
    const before = column > 0 ? at - 1 : at, above = at < columns ? at : at - columns;
    column = column + 1 === columns ? 0 : column + 1;
    const behind = column > 0 ? at + 1 : at, below = at < last_row ? at + columns : at;
    const own = base[at];
    const context = changed[above] + 2 * changed[before] + (base[above] !== own ? 4 : 0) +
      (base[before] !== own ? 8 : 0) + (base[below] !== own ? 16 : 0) + (base[behind] !== own ? 32 : 0);
    if (flags.flag(context) === 0) continue;
    changed[at] = 1;
    const near = cells[before] !== own ? before : cells[above] !== own ? above : cells[behind] !== own ? behind : below;
    const likely = cells[near];
    if (likely !== own && flags.flag(LIKELY) === 0) cells[at] = likely;
    else cells[at] = rawValue(flags.value(), signed);
  }
  return cells;
}

// Typed arrays are little-endian on every machine that a browser runs on.
const littleEndian = (bytes, Cells) => new Cells(new Uint8Array(bytes).buffer);

const CRC_TABLE = new Uint32Array(256);
for (let n = 0; n < 256; n++) {
  let crc = n;
  for (let bit = 0; bit < 8; bit++) crc = crc & 1 ? (crc >>> 1) ^ 0xedb88320 : crc >>> 1;
  CRC_TABLE[n] = crc;
}

// CRC-32 (IEEE) of bytes.
export function crc32(bytes) {
  let crc = -1;
  for (let i = 0; i < bytes.length; i++) crc = CRC_TABLE[(crc ^ bytes[i]) & 0xff] ^ (crc >>> 8);
  return (crc ^ -1) >>> 0;
}
