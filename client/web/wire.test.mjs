// Tests of the decoder against the golden vectors of proto/golden. Run: cd client/web && node --test

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import test from "node:test";
import { crc32, decodeChannel } from "./src/codec.js";
import { egoAt, gridOf, pixelCells } from "./src/grid.js";

import * as limits from "./src/limits.js";
import { LiveMap } from "./src/map.js";
import { readLayer, readMap, readMapUpdate, WireError } from "./src/protobuf.js";

const [U8, I8, U16] = [1, 2, 3], [RAW, ROWS, CHANGES] = [1, 2, 3];
const channel = (cell_type, encoding, payload, raw, cell_count) => ({
  name: "class", cell_type, encoding, cell_count, payload: Uint8Array.from(payload), crc32: crc32(Uint8Array.from(raw)),
});
const assertRefused = (reason, given, columns = given.cell_count) =>
  assert.throws(() => decodeChannel(given, [1, columns]), { name: "DecodeError", reason });

test("the CRC is that of IEEE 802.3", () => {
  assert.equal(crc32(new TextEncoder().encode("123456789")), 0xcbf43926);
});

test("raw cells of every type decode to themselves", () => {
  const decoded = (type, payload, count) => [...decodeChannel(channel(type, RAW, payload, payload, count), [1, count])];
  assert.deepEqual(decoded(U8, [0, 1, 255], 3), [0, 1, 255]);
  assert.deepEqual(decoded(I8, [128, 255], 2), [-128, -1]);
  assert.deepEqual(decoded(U16, [1, 2], 1), [513]);
});

const golden = (file) => JSON.parse(readFileSync(new URL(`../../proto/golden/${file}`, import.meta.url)));
const bytesOf = (hex) => Uint8Array.from(hex.match(/../g) ?? [], (byte) => parseInt(byte, 16));

test("the golden channels decode to their cells", () => {
  for (const vector of golden("channels.json")) {
    const cells = vector.cells_value_length.flatMap(([value, length]) => Array(length).fill(value));
    const shape = [vector.cell_count / vector.columns, vector.columns];
    const decoded = decodeChannel({ ...vector, payload: bytesOf(vector.payload_hex) }, shape);
    assert.deepEqual([...decoded], cells, vector.name);
  }
});

const goldenMap = (name) => new Uint8Array(readFileSync(new URL(`../../proto/golden/${name}.bin`, import.meta.url)));

// Every layer of a map with the cells of every channel.
function decodeMap(bytes, base = null) {
  const map = new LiveMap(bytes, base && new LiveMap(base));
  const layers = map.names.map((name) => {
    const { legend, grid, metrics, channels } = map.layer(name);
    const cells = channels.map((channel) => ({ ...channel, cells: map.layer(name).cells(channel.name) }));
    return { name, legend, metrics, grid: [grid.key, grid.shape, grid.first], channels: cells };
  });
  return { header: map.header, layers };
}

test("the limits are those of the golden file", () => {
  const { channel_cells_max, map_cells_max, map_bytes_max, map_parts_max, ...others } = golden("limits.json");
  assert.equal(limits.CHANNEL_CELLS_MAX, channel_cells_max);
  assert.equal(limits.MAP_CELLS_MAX, map_cells_max);
  assert.equal(limits.MAP_BYTES_MAX, map_bytes_max);
  assert.equal(limits.MAP_PARTS_MAX, map_parts_max);
  assert.equal(limits.WIRE_VERSION, others.wire_version);
  assert.equal(limits.SAFE_POINT_STEPS_MAX, others.safe_point_steps_max);
});

test("the plan of an update is read, and an update may have none", () => {
  const double = (value) => [...new Uint8Array(new Float64Array([value]).buffer)];
  const field = (number, bytes) => [8 * number + 2, bytes.length, ...bytes];
  const goal = [0x09, ...double(20), 0x11, ...double(-1)];
  const text = [...new TextEncoder().encode("blocked")];
  const plan = [...field(7, [...double(0), ...double(5)]), ...field(8, [...double(0), ...double(1.5)]),
    ...field(11, goal), ...field(12, text)];
  const read = readMapUpdate(Uint8Array.from(field(8, plan))).plan;
  assert.deepEqual([read.x, read.y, read.goal, read.text], [[0, 5], [0, 1.5], { x: 20, y: -1 }, "blocked"]);
  assert.equal(readMapUpdate(new Uint8Array(0)).plan, null);
});

test("the golden safe points decode to their places, radii and links", () => {
  const map = new LiveMap(goldenMap("map"));
  const described = golden("map.json").layers.map(({ name, points }) => [name, points]);
  for (const [name, points] of described) {
    const decoded = map.layer(name).safe_points;
    if (points.length === 0) {
      assert.equal(decoded, null, name);
      continue;
    }
    assert.deepEqual([...decoded.x], points.map((point) => point.x_m));
    assert.deepEqual([...decoded.y], points.map((point) => point.y_m));
    assert.deepEqual([...decoded.radius], points.map((point) => point.radius_m));
    const links = points.flatMap((point, from) => point.links.map((to) => [from, to]));
    assert.deepEqual(decoded.links.toSorted(), links.toSorted());
  }
  assert.equal(described.flatMap(([, points]) => points).length, 4);
});

test("a golden map with channels by class equals the same map with plain channels", () => {
  const [by_class, plain] = ["by_class", "by_class_plain"].map((name) => decodeMap(goldenMap(name)).layers[0].channels);
  assert.deepEqual(by_class, plain);
  assert.equal(by_class.length, 4);
});

test("a golden delta on its base equals the golden whole map", () => {
  const decoded = decodeMap(goldenMap("delta"), goldenMap("delta_base"));
  assert.deepEqual(decoded, decodeMap(goldenMap("delta_whole")));
  assert.notDeepEqual(decoded.layers[0].grid[2], [0n, 0n]);
});

test("a map that another protobuf decoder read equals the map of the bytes, and so does a delta on it", () => {
  const message = (name) => {
    const { header, layers } = readMap(goldenMap(name));
    // Such decoders leave absent fields out.
    const present = (layer) => Object.fromEntries(Object.entries(layer).filter(([, value]) => value !== null));
    return { header, layers: layers.map((layer) => present(readLayer(layer))) };
  };
  const cells = (map) => map.names.map((name) => map.layer(name).channels.map((of) => map.layer(name).cells(of.name)));
  const base = new LiveMap(message("delta_base")), whole = new LiveMap(goldenMap("delta_whole"));
  assert.deepEqual(cells(base), cells(new LiveMap(goldenMap("delta_base"))));
  assert.deepEqual(cells(new LiveMap(message("delta"), base)), cells(whole));
  assert.throws(() => new LiveMap(message("delta")).layer(whole.names[0]), { name: "DecodeError", reason: "no_base" });
});

test("the golden bad maps are refused for the stated reason", () => {
  for (const { name, error, map_hex } of golden("bad_maps.json")) {
    assert.throws(() => decodeMap(bytesOf(map_hex)), { name: "DecodeError", reason: error }, name);
  }
});

test("bytes that are no protobuf are refused as a DecodeError with a reason", () => {
  const is_refused = (error) => error instanceof limits.DecodeError && error.reason === "protobuf";
  assert.throws(() => new LiveMap(Uint8Array.of(1, 2, 3)), is_refused);
});

test("a channel whose count of cells is not the grid's is refused as the layer opens, before its cells are read", () => {
  const message = readLayer(readMap(goldenMap("delta_base")).layers[0]), { header } = readMap(goldenMap("delta_base"));
  const cartesian = { ...message.cartesian, width: 1 << 15, height: 1 << 15 };
  const layers = [{ ...message, radial: null, cartesian }];
  const refused = { name: "DecodeError", reason: "cell_count" };
  assert.throws(() => new LiveMap({ header, layers }).layer(message.name), refused);
});

test("a delta on a wrong base is refused for the stated reason", () => {
  for (const { name, error, base_hex, map_hex } of golden("bad_deltas.json")) {
    const base = base_hex && bytesOf(base_hex);
    assert.throws(() => decodeMap(bytesOf(map_hex), base), { name: "DecodeError", reason: error }, name);
  }
});

test("the golden bad channels are refused for the stated reason", () => {
  for (const vector of golden("bad_channels.json")) {
    const given = { ...vector, payload: bytesOf(vector.payload_hex) };
    const shape = [vector.cell_count / vector.columns, vector.columns];
    assert.throws(() => decodeChannel(given, shape), { name: "DecodeError", reason: vector.error }, vector.name);
  }
});

test("a map that exceeds a limit is refused", () => {
  const refused = (reason, bytes) => assert.throws(() => decodeMap(bytes), { name: "DecodeError", reason });
  refused("too_long", new Uint8Array(limits.MAP_BYTES_MAX + 1));
  // Each layer is an empty message of two bytes.
  refused("too_many_parts", new Uint8Array(2 * limits.MAP_PARTS_MAX + 2).map((_, i) => (i % 2 ? 0 : 0x12)));
});

test("a channel of a layer is decoded only when it is asked for", () => {
  const bytes = goldenMap("by_class_plain"), name = new LiveMap(bytes).names[0];
  const classes = new LiveMap(bytes).layer(name).cells("class");
  // A payload is a view into the bytes of the map.
  const spoilt = readLayer(readMap(bytes).layers[0]).channels.at(-1);
  spoilt.payload[0] ^= 0xff;
  const layer = new LiveMap(bytes).layer(name);
  assert.deepEqual(layer.cells("class"), classes);
  assert.throws(() => layer.cells(spoilt.name), { name: "DecodeError", reason: "cells" });
});

test("wrong cells are refused for the stated reason", () => {
  const rows = (payload, raw, count) => channel(U8, ROWS, payload, raw, count);
  assertRefused("too_many_cells", rows([0], [0], 2 ** 32 - 1));
  assertRefused("too_many_cells", rows([0], [0], limits.CHANNEL_CELLS_MAX + 1));
  assertRefused("cell_count", rows([0], [0], 1), 2);
  assertRefused("cells", channel(U8, RAW, [1, 2], [1], 1));
  assertRefused("cells", channel(U8, CHANGES, [1], Array(9).fill(0), 9));
  assertRefused("cells", channel(U8, 7, [1], [1], 1));
  assertRefused("cells", channel(9, RAW, [1], [1], 1));
});

// The most memory that `run` allocates for arrays, in bytes.
function allocated(run) {
  const before = process.memoryUsage().arrayBuffers;
  run();
  return process.memoryUsage().arrayBuffers - before;
}

test("20 bytes that claim many cells allocate no more than they are worth", () => {
  const few = [[], [0xff], Array(20).fill(0xff), Array(20).fill(0), [0, 0, 0, 0x80], Array(19).fill(0x55)];
  for (const count of [2 ** 28, 2 ** 32 - 1, limits.CHANNEL_CELLS_MAX]) {
    for (const payload of few) {
      const given = channel(U16, ROWS, payload, [], count);
      const reason = count > limits.CHANNEL_CELLS_MAX ? "too_many_cells" : "cells";
      const bytes = allocated(() => assertRefused(reason, given));
      assert.ok(bytes < 64 << 10, `${bytes} bytes for ${count} cells in ${payload.length} bytes`);
    }
  }
});

test("random bytes as changes give an error and no other exception", () => {
  let seed = 3;
  const byte = () => (seed = (Math.imul(seed, 1664525) + 1013904223) >>> 0) >>> 24;
  for (let i = 0; i < 5000; i++) {
    const given = channel(1 + (byte() % 3), CHANGES, Array.from({ length: byte() % 30 }, byte), [], 32);
    const base = (Cells) => Cells.from({ length: 32 }, () => byte() % 3);
    assert.throws(() => decodeChannel(given, [4, 8], base), { name: "DecodeError" });
  }
});

test("a message of random bytes gives a value or a named error", () => {
  let seed = 2;
  const byte = () => (seed = (Math.imul(seed, 1664525) + 1013904223) >>> 0) >>> 24;
  for (let i = 0; i < 5000; i++) {
    const bytes = Uint8Array.from({ length: byte() % 40 }, byte);
    try {
      readMapUpdate(bytes);
    } catch (error) {
      assert.ok(error instanceof WireError, `${error} for ${bytes}`);
    }
    try {
      decodeChannel(channel(1 + (byte() % 3), i % 2 ? RAW : ROWS, bytes, [], 32), [4, 8]);
    } catch (error) {
      assert.equal(error.name, "DecodeError", `${error} for ${bytes}`);
    }
  }
});

test("an update keeps all digits of its stamps", () => {
  const stamp = 1764000000123456789n, bytes = new Uint8Array(14);
  bytes.set([0x0a, 1, 42, 0x10, 3]);
  bytes[5] = 0x19;
  new DataView(bytes.buffer).setBigInt64(6, stamp, true);
  const update = readMapUpdate(bytes);
  assert.deepEqual([[...update.map], update.skipped, update.sent_ns], [[42], 3n, stamp]);
  assert.throws(() => readMapUpdate(bytes.subarray(0, 9)), WireError);
});

test("columns run counter-clockwise from ahead, and an outer radius belongs to its row", () => {
  const grid = gridOf({ radial: { row_radius_m: [1, 2, 4], columns: 4 } });
  assert.equal(grid.cellAt(0.5, 0.1), 0);
  assert.equal(grid.cellAt(-0.1, 0.5), 1);
  assert.equal(grid.cellAt(0.1, -0.5), 3);
  assert.equal(grid.cellAt(2, 0), 4);
  assert.equal(grid.cellAt(3, -1e-18), 11);
  assert.equal(grid.cellAt(4.01, 0), -1);
  assert.throws(() => gridOf({ radial: { row_radius_m: [2, 1], columns: 4 } }), /row radius 1 is 1 m/);
});

test("a radial grid is addressed about its own centre", () => {
  const grid = gridOf({ radial: { row_radius_m: [1, 2.5], columns: 12, centre_x_m: 1.5, centre_y_m: -0.5 } });
  assert.deepEqual([grid.cellAt(1.6, -0.4), grid.cellAt(4.1, -0.5), grid.cellAt(-0.9, -0.4)], [1, -1, 17]);
  assert.equal(grid.radius_m, 4);
  assert.throws(() => gridOf({ radial: { row_radius_m: [1], columns: 4, centre_x_m: NaN } }), /centre is \(NaN, 0\)/);
});

test("a Cartesian cell contains its lower edge", () => {
  const grid = gridOf({ cartesian: { origin_x_m: -1, origin_y_m: -1, width: 3, height: 2, cell_m: 1, yaw_rad: 0 } });
  assert.deepEqual([grid.cellAt(-1, -1), grid.cellAt(1.5, 0.5), grid.cellAt(2, 0), grid.cellAt(0, 1)], [0, 5, -1, -1]);
});

test("a grid that turns under the vehicle is addressed along its own axes", () => {
  // The vehicle heads along the grid's y axis: ahead is up the rows, to the left is down the columns.
  const yaw_rad = Math.PI / 2;
  const grid = gridOf({ cartesian: { origin_x_m: -2, origin_y_m: -2, width: 4, height: 4, cell_m: 1, yaw_rad } });
  assert.deepEqual([grid.cellAt(1.5, 0.5), grid.cellAt(-0.5, 1.5), grid.cellAt(2.5, 0)], [13, 4, -1]);
});

const RASTER = { width: 10, height: 10, x_m: 0, y_m: 0, metres: 1 };

test("forward is up and left is left", () => {
  const { x, y } = egoAt(RASTER, 0, 0);
  assert.deepEqual([x, y], [4.5, 4.5]);
  const grid = gridOf({ radial: { row_radius_m: [20], columns: 4 } });
  assert.deepEqual([...pixelCells(grid, { ...RASTER, width: 2, height: 2, metres: 5 })], [0, 3, 1, 2]);
});

test("the table of a raster holds the cell in the middle of each pixel, wherever the raster lies", () => {
  const cartesian = { origin_x_m: -3, origin_y_m: -4.2, width: 9, height: 7, cell_m: 0.7, yaw_rad: 0.4 };
  const radial = { row_radius_m: [1, 2, 5], columns: 8, centre_x_m: 0.5 };
  for (const grid of [gridOf({ cartesian }), gridOf({ radial })]) {
    const raster = { width: 31, height: 17, x_m: 0.7, y_m: -1.3, metres: 0.31 };
    const expected = Array.from({ length: 31 * 17 }, (_, i) => {
      const { x, y } = egoAt(raster, i % 31, Math.floor(i / 31));
      return grid.cellAt(x, y);
    });
    assert.deepEqual([...pixelCells(grid, raster)], expected);
    assert.ok(expected.includes(-1) && new Set(expected).size > 10);
  }
});
