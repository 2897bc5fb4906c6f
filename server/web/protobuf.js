// In: protobuf bytes of clearway.v1 MapUpdate or Map. Out: plain objects with the field names of the .proto files.
// Reads exactly the messages the page needs, by the tables below; unknown fields are skipped, as protobuf asks.
// 64-bit fields come out as BigInt (stamps in ns exceed 2^53), bytes as views without a copy.
// Wire format: protobuf.dev/programming-guides/encoding; fields: proto/clearway/v1/{map,service}.proto.

const VARINT = 0, FIXED64 = 1, LENGTH = 2, FIXED32 = 5;
const TEXT = new TextDecoder("utf-8", { fatal: true });

export class WireError extends Error {
  name = "WireError";
}

class Reader {
  at = 0;
  constructor(bytes) {
    this.bytes = bytes;
    this.view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  }
  take(length) {
    const left = this.bytes.length - this.at;
    if (length > left) throw new WireError(`a field claims ${length} bytes; ${left} are left`);
    this.at += length;
    return this.at - length;
  }
  varint() {
    let value = 0n;
    for (let shift = 0n; shift < 70n; shift += 7n) {
      const byte = this.bytes[this.take(1)];
      value |= BigInt(byte & 0x7f) << shift;
      if (byte < 0x80) return BigInt.asUintN(64, value);
    }
    throw new WireError("a varint of more than 10 bytes");
  }
  chunk() {
    const length = Number(this.varint());
    const start = this.take(length);
    return this.bytes.subarray(start, start + length);
  }
  skip(wire) {
    if (wire === VARINT) this.varint();
    else if (wire === FIXED64) this.take(8);
    else if (wire === LENGTH) this.chunk();
    else if (wire === FIXED32) this.take(4);
    else throw new WireError(`wire type ${wire}; allowed are 0, 1, 2 and 5`);
  }
}

const low32 = (reader) => Number(BigInt.asUintN(32, reader.varint()));
const text = (reader) => {
  try {
    return TEXT.decode(reader.chunk());
  } catch (error) {
    throw error instanceof WireError ? error : new WireError("a string is not UTF-8");
  }
};
const kind = (wire, zero, read) => ({ wire, zero: () => zero, read });
const string = kind(LENGTH, "", text);
const bytes = kind(LENGTH, new Uint8Array(0), (r) => r.chunk());
const uint32 = kind(VARINT, 0, low32);
const sint32 = kind(VARINT, 0, (r) => ((n) => (n >>> 1) ^ -(n & 1))(low32(r)));
const sint64 = kind(VARINT, 0n, (r) => ((n) => (n >> 1n) ^ -(n & 1n))(r.varint()));
const uint64 = kind(VARINT, 0n, (r) => r.varint());
const fixed32 = kind(FIXED32, 0, (r) => r.view.getUint32(r.take(4), true));
const fixed64 = kind(FIXED64, 0n, (r) => r.view.getBigUint64(r.take(8), true));
const sfixed64 = kind(FIXED64, 0n, (r) => r.view.getBigInt64(r.take(8), true));
const float = kind(FIXED32, 0, (r) => r.view.getFloat32(r.take(4), true));
const double = kind(FIXED64, 0, (r) => r.view.getFloat64(r.take(8), true));
const optional = (of) => ({ ...of, zero: () => null });
const message = (fields) => kind(LENGTH, null, (r) => decode(fields, r.chunk()));
const many = (of) => ({ ...of, many: true, zero: () => [] });
const table = (of) => ({ ...many(message({ 1: ["key", string], 2: ["value", of] })), table: true });

function decode(fields, from) {
  const reader = new Reader(from);
  const out = Object.fromEntries(Object.values(fields).map(([name, of]) => [name, of.zero()]));
  while (reader.at < from.length) {
    const tag = low32(reader), number = tag >>> 3, wire = tag & 7;
    if (number === 0) throw new WireError("field number 0");
    if (!Object.hasOwn(fields, number)) {
      reader.skip(wire);
      continue;
    }
    const [name, of] = fields[number];
    if (of.many && wire === LENGTH && of.wire !== LENGTH) {
      const packed = new Reader(reader.chunk());
      while (packed.at < packed.bytes.length) out[name].push(of.read(packed));
      continue;
    }
    if (wire !== of.wire) throw new WireError(`field ${name} has wire type ${wire}; it must have ${of.wire}`);
    const value = of.read(reader);
    if (of.many) out[name].push(value);
    else out[name] = value;
  }
  for (const [name, of] of Object.values(fields)) {
    if (of.table) out[name] = new Map(out[name].map(({ key, value }) => [key, value]));
  }
  return out;
}

const POSE = Object.fromEntries(["x", "y", "z", "qx", "qy", "qz", "qw"].map((name, i) => [i + 1, [name, double]]));
const SECTOR = { 1: ["from_deg", uint32], 2: ["to_deg", uint32] };
const SENSOR = {
  1: ["name", string], 2: ["model", string], 3: ["packets", uint32], 4: ["refused", uint64], 5: ["returns", uint32],
  6: ["rpm", float], 7: ["completeness", float], 8: ["partial", string], 9: ["packets_expected", uint32],
  12: ["clock", string], 13: ["clock_offset_ms", sint64],
  14: ["blocked_sectors", many(message(SECTOR))], 15: ["blocked_lasers", many(uint32)],
};
const HEADER = {
  1: ["vehicle", string], 2: ["boot_id", fixed64], 3: ["sequence", uint64], 4: ["capture_start_ns", sfixed64],
  5: ["capture_end_ns", sfixed64], 6: ["completed_ns", sfixed64], 7: ["valid_until_ns", sfixed64],
  8: ["map_from_ego", message(POSE)], 9: ["speed_mps", optional(double)], 10: ["sensors", many(message(SENSOR))],
  11: ["compensation", string],
};
const RADIAL = { 1: ["r_bench_m", many(float)], 2: ["columns", uint32] };
const CARTESIAN = {
  1: ["origin_x_m", double], 2: ["origin_y_m", double], 3: ["width", uint32], 4: ["height", uint32],
  5: ["cell_m", float], 6: ["yaw_rad", double], 7: ["first_ix", sint64], 8: ["first_iy", sint64],
};
const PLANE = { 1: ["a", double], 2: ["b", double], 3: ["c", double] };
const CHANNEL = {
  1: ["name", string], 2: ["unit", string], 3: ["scale", float], 4: ["cell_type", uint32], 5: ["unknown", sint32],
  6: ["encoding", uint32], 7: ["cell_count", uint32], 8: ["crc32", fixed32], 9: ["payload", bytes], 10: ["by_class", bytes],
};
const LAYER = {
  1: ["name", string], 2: ["radial", message(RADIAL)], 3: ["cartesian", message(CARTESIAN)],
  4: ["legend", many(string)],
  5: ["channels", many(message(CHANNEL))], 6: ["planes", many(message(PLANE))], 7: ["figures", table(double)],
  10: ["base_sequence", optional(uint64)],
};
const MAP = { 1: ["header", message(HEADER)], 2: ["layers", many(message(LAYER))] };
const MAP_UPDATE = { 1: ["map", bytes], 2: ["skipped", uint64], 3: ["sent_ns", sfixed64] };

export const readMap = (from) => decode(MAP, from);
export const readMapUpdate = (from) => decode(MAP_UPDATE, from);
export const readChannel = (from) => decode(CHANNEL, from);
export const readLayer = (from) => decode(LAYER, from);
