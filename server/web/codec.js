// In: a Channel message as read by protobuf.js. Out: its cells as a typed array, or a Refused error that names what was
// wrong. Nothing is allocated before the claimed count is checked, and no cell is given before all of them are right:
// count, canonical form (no empty run, neighbours differ, shortest varints, lengths sum to the count), range, CRC.
// Format: proto/clearway/v1/map.proto, Channel and Encoding.

// A Cartesian grid of 1024 x 1024 cells; what is larger is a mistake or an attack.
export const CELLS_MAX = 1 << 20;

const TYPES = {
  1: { cells: Uint8Array, width: 1, min: 0, max: 255, signed: false },
  2: { cells: Int8Array, width: 1, min: -128, max: 127, signed: true },
  3: { cells: Uint16Array, width: 2, min: 0, max: 65535, signed: false },
};
const RAW = 1, RUNS = 2, ROWS = 3;
// The same bound as the server's.
const COLUMNS_MAX = 1 << 14;

export class Refused extends Error {
  name = "Refused";
  constructor(reason, detail) {
    super(`${reason}: ${detail}`);
    this.reason = reason;
  }
}

// cellsExpected: what the layer's geometry holds. predict, in a delta or of a channel told by class: makes the cells that
// the differences are added to, in a given typed array; it is asked when all else is checked.
export function decodeChannel(channel, cellsExpected, predict = null) {
  const { name, cell_type, cell_count, encoding, payload } = channel;
  const type = TYPES[cell_type];
  const refuse = (reason, detail) => new Refused(reason, `channel ${name}: ${detail}`);
  if (!type) throw refuse("cell_type", `${cell_type}; allowed are 1 (u8), 2 (i8), 3 (u16)`);
  if (cell_count > CELLS_MAX) throw refuse("cell_count", `${cell_count} cells claimed; at most ${CELLS_MAX}`);
  if (cell_count !== cellsExpected) {
    throw refuse("cell_count", `${cell_count} cells claimed; the grid has ${cellsExpected}`);
  }
  let cells;
  if (encoding === RAW) cells = readRaw(payload, type, cell_count, refuse);
  else if (encoding === RUNS) cells = readRuns(payload, type, cell_count, refuse);
  else if (encoding === ROWS) cells = readRows(payload, type, cell_count, refuse);
  else throw refuse("encoding", `${encoding}; allowed are 1 (raw), 2 (runs), 3 (rows)`);
  if (predict) {
    const before = predict(type.cells);
    // Differences of unsigned cells zigzag; all wrap.
    for (let i = 0; i < cells.length; i++) {
      cells[i] = before[i] + (type.signed ? cells[i] : (cells[i] >> 1) ^ -(cells[i] & 1));
    }
  }
  const crc = crc32(littleEndian(cells, type));
  if (crc !== channel.crc32) throw refuse("crc", `cells have ${hex(crc)}, the message says ${hex(channel.crc32)}`);
  return cells;
}

// What predicts the cells of a channel told by class: of each class what its cells mostly are. classes: those of the cells,
// null where there are none.
export function byClass(channel, classes, legend) {
  const refuse = (detail) => new Refused("by_class", `channel ${channel.name}: ${detail}`);
  const { width, signed } = TYPES[channel.cell_type] ?? TYPES[1];
  if (!(classes instanceof Uint8Array)) throw refuse('no channel "class" of u8 before it');
  const { by_class } = channel, length = legend.length * width;
  if (by_class.length !== length) throw refuse(`${by_class.length} bytes; ${length} are needed`);
  const view = new DataView(by_class.buffer, by_class.byteOffset, length);
  const of = (k) => (width === 2 ? view.getUint16(2 * k, true) : signed ? view.getInt8(k) : view.getUint8(k));
  const table = legend.map((_, k) => of(k));
  return (Cells) => Cells.from(classes, (k) => table[k]);
}

function readRaw(payload, type, count, refuse) {
  const bytes = count * type.width;
  if (payload.length !== bytes) throw refuse("payload", `${payload.length} raw bytes; ${count} cells need ${bytes}`);
  const view = new DataView(payload.buffer, payload.byteOffset, payload.length);
  const read = { 1: type.signed ? "getInt8" : "getUint8", 2: "getUint16" }[type.width];
  return type.cells.from({ length: count }, (_, i) => view[read](i * type.width, true));
}

function readRuns(payload, type, count, refuse) {
  const raw = count * type.width;
  if (payload.length >= raw) throw refuse("canonical", `${payload.length} bytes of runs; the raw cells have ${raw}`);
  const cells = new type.cells(count);
  let at = 0, filled = 0, previous = null;
  // Values need at most 3 bytes, lengths of up to CELLS_MAX 3 as well; 5 cover any 32-bit number.
  const varint = () => {
    for (let value = 0, i = 0; i < 5; i++) {
      if (at === payload.length) throw refuse("payload", `ends inside a run after ${filled} of ${count} cells`);
      const byte = payload[at++];
      value += (byte & 0x7f) * 2 ** (7 * i);
      if (byte >= 0x80) continue;
      if (byte === 0 && i > 0) throw refuse("canonical", `a varint before byte ${at} is longer than it need be`);
      return value;
    }
    throw refuse("payload", `a varint before byte ${at} has more than 5 bytes`);
  };
  while (at < payload.length) {
    const coded = varint(), length = varint() + 1;
    const value = cellValue(coded, type, refuse);
    if (value === previous) throw refuse("canonical", `two neighbouring runs of value ${value} at cell ${filled}`);
    if (length > count - filled) throw refuse("run", `${length} cells at cell ${filled}; ${count - filled} are left`);
    cells.fill(value, filled, filled + length);
    filled += length;
    previous = value;
  }
  if (filled !== count) throw refuse("run", `runs cover ${filled} of ${count} cells`);
  return cells;
}

// Rows predicted by the rows before: cells as a row before, a run of another value, and so on.
function readRows(payload, type, count, refuse) {
  const raw = count * type.width;
  if (payload.length >= raw) throw refuse("canonical", `${payload.length} bytes of rows; the raw cells have ${raw}`);
  let columns = 0, at = 0;
  for (let byte = 0x80; byte >= 0x80; at++) {
    if (at === payload.length || at === 4) throw refuse("payload", "ends inside the number of columns");
    byte = payload[at];
    if (byte === 0 && at > 0) throw refuse("canonical", "the number of columns is longer than it need be");
    columns += (byte & 0x7f) * 2 ** (7 * at);
  }
  if (columns < 1 || columns > Math.min(COLUMNS_MAX, count)) throw refuse("columns", `${columns}; ${count} cells`);
  const cells = new type.cells(count);
  let bit = at * 8, filled = 0, run = null;
  const next = () => {
    if (bit === payload.length * 8) throw refuse("payload", `ends inside a run after ${filled} of ${count} cells`);
    return (payload[bit >> 3] >> (7 - (bit++ & 7))) & 1;
  };
  const number = () => {
    let more = 0, value = 1;
    while (!next()) if (++more > 32) throw refuse("payload", "a number of more than 32 bits");
    for (; more > 0; more--) value = value * 2 + next();
    return value - 1;
  };
  const above = (cell) => (cell < columns ? 0 : cells[cell - columns]);
  const fits = (length) => {
    if (length > count - filled) throw refuse("run", `${length} cells at cell ${filled}; ${count - filled} are left`);
    return filled + length;
  };
  while (filled < count) {
    const end = fits(number());
    if (filled < end && above(filled) === run) throw refuse("canonical", `a run of value ${run} goes on at cell ${filled}`);
    if (filled < end) run = null;
    for (; filled < end; filled++) cells[filled] = above(filled);
    if (filled === count) break;
    const before = filled > 0 ? cells[filled - 1] : null, same = next();
    if (same && before === null) throw refuse("value", "as the one before the first cell");
    const value = same ? before : cellValue(number(), type, refuse);
    if (value === above(filled) || (!same && value === before) || value === run) {
      throw refuse("canonical", `value ${value} at cell ${filled} is the one before it or a row before`);
    }
    const runEnd = fits(number() + 1);
    cells.fill(value, filled, runEnd);
    [filled, run] = [runEnd, value];
  }
  while (bit % 8) if (next()) throw refuse("payload", "not filled up with zeros");
  if (bit !== payload.length * 8) throw refuse("payload", `${payload.length - bit / 8} bytes after the last cell`);
  return cells;
}

function cellValue(coded, type, refuse) {
  const value = type.signed ? (coded % 2 ? -(coded + 1) / 2 : coded / 2) : coded;
  if (value < type.min || value > type.max) throw refuse("value", `${value}; allowed are ${type.min} to ${type.max}`);
  return value;
}

function littleEndian(cells, type) {
  if (type.width === 1) return new Uint8Array(cells.buffer);
  const bytes = new DataView(new ArrayBuffer(cells.length * 2));
  cells.forEach((cell, i) => bytes.setUint16(i * 2, cell, true));
  return new Uint8Array(bytes.buffer);
}

const CRC_TABLE = Uint32Array.from({ length: 256 }, (_, n) => {
  for (let bit = 0; bit < 8; bit++) n = n & 1 ? (n >>> 1) ^ 0xedb88320 : n >>> 1;
  return n;
});

export function crc32(bytes) {
  let crc = -1;
  for (const byte of bytes) crc = CRC_TABLE[(crc ^ byte) & 0xff] ^ (crc >>> 8);
  return (crc ^ -1) >>> 0;
}

const hex = (n) => `0x${n.toString(16).padStart(8, "0")}`;
