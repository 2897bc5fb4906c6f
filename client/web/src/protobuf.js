// In: protobuf bytes of clearway.v1 messages. Out: plain objects with the field names of the .proto files.
// Only the messages and fields in the tables below are read; other fields are skipped, as protobuf demands.
// 64-bit fields come out as BigInt (stamps in ns exceed 2^53), bytes as views without a copy.
// Wire format: protobuf.dev/programming-guides/encoding; fields: proto/clearway/v1/{map,service}.proto.

import { DecodeError } from "./limits.js";

const VARINT = 0, FIXED64 = 1, LENGTH = 2, FIXED32 = 5;
const TEXT = new TextDecoder("utf-8", { fatal: true });

// Bytes that are no protobuf.
export class WireError extends DecodeError {
  name = "WireError";
  constructor(detail) {
    super("protobuf", detail);
  }
}

class Reader {
  at = 0;
  constructor(bytes) {
    this.bytes = bytes;
    this.view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  }

  get isAtEnd() {
    return this.at === this.bytes.length;
  }

  // Moves past `length` bytes; returns the index of the first of them.
  advance(length) {
    const left = this.bytes.length - this.at;
    if (length > left) throw new WireError(`a field claims ${length} bytes; ${left} are left`);
    this.at += length;
    return this.at - length;
  }

  // A varint of 64 bits, as BigInt.
  varint64() {
    let value = 0n;
    for (let shift = 0n; shift < 70n; shift += 7n) {
      const byte = this.bytes[this.advance(1)];
      value |= BigInt(byte & 0x7f) << shift;
      if (byte < 0x80) return BigInt.asUintN(64, value);
    }
    throw new WireError("a varint of more than 10 bytes");
  }

  // The low 32 bits of a varint.
  varint32() {
    let value = 0;
    for (let shift = 0; shift < 70; shift += 7) {
      const byte = this.bytes[this.advance(1)];
      if (shift < 32) value |= (byte & 0x7f) << shift;
      if (byte < 0x80) return value >>> 0;
    }
    throw new WireError("a varint of more than 10 bytes");
  }

  // The bytes of a length-delimited field.
  chunk() {
    let length = 0;
    for (let factor = 1; ; factor *= 128) {
      const byte = this.bytes[this.advance(1)];
      length += (byte & 0x7f) * factor;
      if (byte < 0x80) break;
      if (factor > 2 ** 62) throw new WireError("a varint of more than 10 bytes");
    }
    const start = this.advance(length);
    return this.bytes.subarray(start, start + length);
  }

  skip(wire) {
    if (wire === VARINT) this.varint32();
    else if (wire === FIXED64) this.advance(8);
    else if (wire === LENGTH) this.chunk();
    else if (wire === FIXED32) this.advance(4);
    else throw new WireError(`wire type ${wire}; allowed are 0, 1, 2 and 5`);
  }
}

const text = (reader) => {
  const chunk = reader.chunk();
  try {
    return TEXT.decode(chunk);
  } catch {
    throw new WireError("a string is not UTF-8");
  }
};

// A field type: its wire type, its value if it is absent, and how it is read.
const type = (wire, zero, read) => ({ wire, zero: () => zero, read });
const string = type(LENGTH, "", text);
const bytes = type(LENGTH, new Uint8Array(0), (reader) => reader.chunk());
const uint32 = type(VARINT, 0, (reader) => reader.varint32());
const sint32 = type(VARINT, 0, (reader) => ((n) => (n >>> 1) ^ -(n & 1))(reader.varint32()));
const sint64 = type(VARINT, 0n, (reader) => ((n) => (n >> 1n) ^ -(n & 1n))(reader.varint64()));
const uint64 = type(VARINT, 0n, (reader) => reader.varint64());
const fixed32 = type(FIXED32, 0, (reader) => reader.view.getUint32(reader.advance(4), true));
const fixed64 = type(FIXED64, 0n, (reader) => reader.view.getBigUint64(reader.advance(8), true));
const sfixed64 = type(FIXED64, 0n, (reader) => reader.view.getBigInt64(reader.advance(8), true));
const float = type(FIXED32, 0, (reader) => reader.view.getFloat32(reader.advance(4), true));
const double = type(FIXED64, 0, (reader) => reader.view.getFloat64(reader.advance(8), true));
const optional = (field) => ({ ...field, zero: () => null });
const message = (fields) => type(LENGTH, null, (reader) => decode(fields, reader.chunk()));
const repeated = (field) => ({ ...field, repeated: true, zero: () => [] });
const map = (field) => ({ ...repeated(message({ 1: ["key", string], 2: ["value", field] })), map: true });

// fields: { number: [name, type] }.
function decode(fields, from) {
  const reader = new Reader(from), out = {};
  for (const number in fields) out[fields[number][0]] = fields[number][1].zero();
  while (!reader.isAtEnd) {
    const tag = reader.varint32(), number = tag >>> 3, wire = tag & 7;
    if (number === 0) throw new WireError("field number 0");
    if (!Object.hasOwn(fields, number)) {
      reader.skip(wire);
      continue;
    }
    const [name, field] = fields[number];
    if (field.repeated && wire === LENGTH && field.wire !== LENGTH) {
      const packed = new Reader(reader.chunk());
      while (!packed.isAtEnd) out[name].push(field.read(packed));
      continue;
    }
    if (wire !== field.wire) throw new WireError(`field ${name} has wire type ${wire}; it must have ${field.wire}`);
    const value = field.read(reader);
    if (field.repeated) out[name].push(value);
    else out[name] = value;
  }
  for (const number in fields) {
    const [name, field] = fields[number];
    if (field.map) out[name] = new Map(out[name].map(({ key, value }) => [key, value]));
  }
  return out;
}

const POSE = Object.fromEntries(["x", "y", "z", "qx", "qy", "qz", "qw"].map((name, i) => [i + 1, [name, double]]));
const SECTOR = { 1: ["from_deg", uint32], 2: ["to_deg", uint32] };
const SENSOR = {
  1: ["name", string], 2: ["model", string], 3: ["packets", uint32], 4: ["refused", uint64], 5: ["returns", uint32],
  6: ["rpm", float], 7: ["completeness", float], 8: ["partial", string],
  12: ["clock", string], 13: ["clock_offset_ms", sint64],
  14: ["blocked_sectors", repeated(message(SECTOR))], 15: ["blocked_lasers", repeated(uint32)],
  16: ["elevations", string],
};
const HEADER = {
  1: ["vehicle", string], 2: ["boot_id", fixed64], 3: ["sequence", uint64], 4: ["capture_start_ns", sfixed64],
  5: ["capture_end_ns", sfixed64], 6: ["completed_ns", sfixed64], 7: ["valid_until_ns", sfixed64],
  8: ["map_from_ego", message(POSE)], 9: ["speed_mps", optional(double)], 10: ["sensors", repeated(message(SENSOR))],
  11: ["compensation", string], 16: ["wire_version", uint32],
};
const RADIAL = {
  1: ["row_radius_m", repeated(float)], 2: ["columns", uint32], 3: ["centre_x_m", float], 4: ["centre_y_m", float],
};
const CARTESIAN = {
  1: ["origin_x_m", double], 2: ["origin_y_m", double], 3: ["width", uint32], 4: ["height", uint32],
  5: ["cell_m", float], 6: ["yaw_rad", double], 7: ["first_ix", sint64], 8: ["first_iy", sint64],
};
const CHANNEL = {
  1: ["name", string], 2: ["unit", string], 3: ["scale", float], 4: ["cell_type", uint32], 5: ["unknown", sint32],
  6: ["encoding", uint32], 7: ["cell_count", uint32], 8: ["crc32", fixed32], 9: ["payload", bytes],
  10: ["by_class", bytes],
};
const SAFE_POINTS = {
  1: ["step_m", float], 2: ["x", repeated(sint32)], 3: ["y", repeated(sint32)], 4: ["radius_cm", repeated(sint32)],
  5: ["starts", repeated(uint32)], 6: ["link_from", repeated(uint32)], 7: ["link_back", repeated(uint32)],
};
const PLANE = { 1: ["a", double], 2: ["b", double], 3: ["c", double] };
const LAYER = {
  1: ["name", string], 2: ["radial", message(RADIAL)], 3: ["cartesian", message(CARTESIAN)],
  4: ["legend", repeated(string)],
  5: ["channels", repeated(message(CHANNEL))], 6: ["planes", repeated(message(PLANE))], 7: ["metrics", map(double)],
  9: ["safe_points", message(SAFE_POINTS)],
  10: ["base_sequence", optional(uint64)],
  11: ["legend_meanings", repeated(uint32)], 12: ["legend_rgb", repeated(fixed32)],
};
// The layers stay bytes until they are needed.
const MAP = { 1: ["header", message(HEADER)], 2: ["layers", repeated(bytes)] };
const PLAN = {
  2: ["planner", string], 7: ["x", repeated(double)], 8: ["y", repeated(double)], 9: ["heading_rad", repeated(double)],
  10: ["footprint_m", repeated(double)], 11: ["goal", message({ 1: ["x", double], 2: ["y", double] })],
  12: ["text", string],
};
const MAP_UPDATE = {
  1: ["map", bytes], 2: ["skipped", uint64], 3: ["sent_ns", sfixed64], 4: ["left_out", uint64], 8: ["plan", message(PLAN)],
};

export const readMap = (from) => decode(MAP, from);
export const readMapUpdate = (from) => decode(MAP_UPDATE, from);
export const readLayer = (from) => decode(LAYER, from);
export const readLayerName = (from) => decode({ 1: ["name", string] }, from).name;

// How many layers, channels, planes, sensors and names an encoded Map claims to have, counted before any is made: the
// length-delimited fields of the map, of its header and of its layers.
export function countParts(map) {
  let parts = 0;
  for (const [number, content] of chunks(map)) {
    parts++;
    if (Object.hasOwn(MAP, number)) for (const _ of chunks(content)) parts++;
  }
  return parts;
}

// The numbers and contents of the length-delimited fields of a message.
function* chunks(from) {
  const reader = new Reader(from);
  while (!reader.isAtEnd) {
    const tag = reader.varint32();
    if ((tag & 7) === LENGTH) yield [tag >>> 3, reader.chunk()];
    else reader.skip(tag & 7);
  }
}
