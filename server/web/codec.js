// In: a Channel message as read by protobuf.js. Out: its cells as a typed array, or a Refused error that names what was
// wrong. The claimed count is checked before anything is allocated. Whether a payload is canonical is left to the server's
// own decoder: here the CRC says whether the cells are right, and no other are given.
// Format: proto/clearway/v1/map.proto, Channel and Encoding.

// A Cartesian grid of 1024 x 1024 cells; what is larger is a mistake or an attack.
export const CELLS_MAX = 1 << 20;

const TYPES = { 1: Uint8Array, 2: Int8Array, 3: Uint16Array };
const RAW = 1, ROWS = 2, CHANGES = 3;

export class Refused extends Error {
  name = "Refused";
  constructor(reason, detail) {
    super(`${reason}: ${detail}`);
    this.reason = reason;
  }
}

// shape: [rows, columns] of the grid. base: makes what changes change, in a given type of array; null where there is
// nothing. It is asked when counts are checked.
export function decodeChannel({ name, cell_type, cell_count, encoding, payload, crc32: stated }, [rows, columns], base = null) {
  const refuse = (reason, detail) => new Refused(reason, `channel ${name}: ${detail}`);
  if (cell_count > CELLS_MAX) throw refuse("too_many_cells", `${cell_count} cells; at most ${CELLS_MAX}`);
  if (cell_count !== rows * columns) throw refuse("cell_count", `${cell_count} cells; the grid has ${rows} x ${columns}`);
  const Cells = TYPES[cell_type], spare = Cells ? cell_count * Cells.BYTES_PER_ELEMENT - payload.length : -1;
  const fits = { [RAW]: spare === 0, [ROWS]: spare > 0, [CHANGES]: spare > 0 && base !== null };
  if (!fits[encoding]) {
    throw refuse("cells", `${payload.length} bytes of encoding ${encoding} for ${cell_count} of type ${cell_type}`);
  }
  const bits = new Bits(payload, refuse);
  let cells;
  if (encoding === RAW) cells = littleEndian(payload, Cells);
  else if (encoding === ROWS) cells = readRows(bits, new Cells(cell_count), columns);
  else cells = readChanges(bits, base(Cells), columns);
  const crc = crc32(new Uint8Array(cells.buffer));
  if (crc !== stated) throw refuse("cells", `they have CRC ${crc.toString(16)}, the message says ${stated.toString(16)}`);
  return cells;
}

// What the changes of a channel told by class change: what cells of their class mostly are.
export function byClass({ name, cell_type, encoding, by_class }, classes, legend) {
  const right = by_class.length === legend.length * (TYPES[cell_type]?.BYTES_PER_ELEMENT ?? 1);
  if (encoding !== CHANGES || !right || !(classes instanceof Uint8Array)) {
    throw new Refused("by_class", `channel ${name}: ${by_class.length} bytes, ${legend.length} classes of u8 before it`);
  }
  return (Cells) => {
    const table = littleEndian(by_class, Cells);
    return Cells.from(classes, (k) => table[k]);
  };
}

// Numbers, most significant bit first.
class Bits {
  at = 0;
  means = {};
  constructor(payload, refuse) {
    Object.assign(this, { payload, refuse });
  }
  bit() {
    if (this.at === 8 * this.payload.length) throw this.refuse("cells", "the payload ends inside them");
    return (this.payload[this.at >> 3] >> (7 - (this.at++ & 7))) & 1;
  }
  // In exp-Golomb code.
  number(order = 0) {
    let more = order, value = 1;
    while (!this.bit()) if (++more > 32) throw this.refuse("cells", "a number of more than 32 bits");
    while (more-- > 0) value = 2 * value + this.bit();
    return value - 2 ** order;
  }
  // The same in the order that follows from the numbers of this kind so far.
  like(kind) {
    const mean = this.means[kind] ?? 0, number = this.number(31 - Math.clz32(mean || 1));
    this.means[kind] = Math.ceil((mean + number) / 2);
    return number;
  }
}

// Signed values zigzag; what does not fit wraps, and the CRC is wrong.
const cellOf = (number, cells) => (cells instanceof Int8Array ? (number >>> 1) ^ -(number & 1) : number);

// Rows predicted by the rows before: cells as a row before, a run of another value, and so on.
function readRows(bits, cells, columns) {
  for (let at = 0; at < cells.length; ) {
    const end = Math.min(at + bits.number(), cells.length);
    for (; at < end; at++) cells[at] = at < columns ? 0 : cells[at - columns];
    if (at === cells.length) break;
    const value = bits.bit() ? cells[at - 1] : cellOf(bits.number(), cells);
    cells.fill(value, at, (at += bits.number() + 1));
  }
  return cells;
}

// Changes from a base: in each context unchanged and changed cells take turns.
function readChanges(bits, base, columns) {
  const turns = {}, cells = base.slice(), changed = new Uint8Array(cells.length);
  const turn = (context) => {
    const own = (turns[context] ??= { changed: 1 - bits.bit(), left: 0 });
    if (own.left-- === 0) own.left = bits.like(2 * context + (own.changed = 1 - own.changed));
    return own.changed;
  };
  for (let at = 0; at < cells.length; at++) {
    // The cells beside it; where there is none, itself: not changed yet, and not other.
    const own = base[at], before = at % columns ? at - 1 : at, above = at < columns ? at : at - columns;
    const behind = (at + 1) % columns ? at + 1 : at, below = at + columns < cells.length ? at + columns : at;
    const borders = 4 * (base[above] !== own) + 8 * (base[before] !== own) + 16 * (base[below] !== own) + 32 * (base[behind] !== own);
    changed[at] = turn(changed[above] + 2 * changed[before] + borders);
    if (!changed[at]) continue;
    const likely = [before, above, behind, below].map((near) => cells[near]).find((cell) => cell !== own);
    cells[at] = likely === undefined || turn(64) ? cellOf(bits.like("value"), cells) : likely;
  }
  return cells;
}

// As on every machine that a browser runs on.
const littleEndian = (bytes, Cells) => new Cells(bytes.slice().buffer);

const CRC_TABLE = Uint32Array.from({ length: 256 }, (_, n) => {
  for (let bit = 0; bit < 8; bit++) n = n & 1 ? (n >>> 1) ^ 0xedb88320 : n >>> 1;
  return n;
});

export function crc32(bytes) {
  let crc = -1;
  for (const byte of bytes) crc = CRC_TABLE[(crc ^ byte) & 0xff] ^ (crc >>> 8);
  return (crc ^ -1) >>> 0;
}
