// What the page must never get wrong: cells, places and ages. Run: cd server/web && node --test

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import test from "node:test";
import { freshness, ServerClock } from "./clock.js";
import { CELLS_MAX, crc32, decodeChannel } from "./codec.js";
import { egoAt, gridOf, pixelCells } from "./grid.js";
import { openMap } from "./map.js";
import { readMapUpdate, WireError } from "./protobuf.js";
import { clockWords } from "./text.js";

const [U8, I8, U16] = [1, 2, 3], [RAW, ROWS, CHANGES] = [1, 2, 3];
const channel = (cell_type, encoding, payload, raw, cell_count) => ({
  name: "class", cell_type, encoding, cell_count, payload: Uint8Array.from(payload), crc32: crc32(Uint8Array.from(raw)),
});
const refusedFor = (reason, given, columns = given.cell_count) =>
  assert.throws(() => decodeChannel(given, [1, columns]), (error) => error.name === "Refused" && error.reason === reason);

test("the crc is the ieee one", () => {
  assert.equal(crc32(new TextEncoder().encode("123456789")), 0xcbf43926);
});

test("raw cells of every type are those that went in", () => {
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

test("a map told by class that does not fit its classes is refused", () => {
  for (const { name, error, map_hex } of golden("bad_maps.json").filter(({ error }) => ["by_class", "cells"].includes(error))) {
    assert.throws(() => openMap(bytesOf(map_hex)), { name: "Refused", reason: error }, name);
  }
});

test("the golden map told by class is the one told cell by cell", () => {
  const [told, plain] = ["by_class", "by_class_plain"].map((name) => openMap(goldenMap(name)).layers[0].channels);
  assert.deepEqual(told, plain);
  assert.equal(told.length, 4);
});

test("the golden delta on its base is the golden whole", () => {
  const opened = openMap(goldenMap("delta"), openMap(goldenMap("delta_base")));
  const plain = ({ header, layers }) => ({
    header, layers: layers.map(({ grid, ...rest }) => ({ ...rest, grid: [grid.key, grid.shape, grid.first] })),
  });
  assert.deepEqual(plain(opened), plain(openMap(goldenMap("delta_whole"))));
  assert.notDeepEqual(opened.layers[0].grid.first, [0n, 0n]);
});

test("a delta on a wrong base is refused", () => {
  // The page looks at the grid before the channels.
  const words = { too_many_cells: "geometry" };
  for (const { name, error, base_hex, map_hex } of golden("bad_deltas.json")) {
    const base = base_hex && openMap(bytesOf(base_hex));
    assert.throws(() => openMap(bytesOf(map_hex), base), { name: "Refused", reason: words[error] ?? error }, name);
  }
});

test("the golden bad channels are refused", () => {
  for (const vector of golden("bad_channels.json")) {
    const given = { ...vector, payload: bytesOf(vector.payload_hex) };
    const shape = [vector.cell_count / vector.columns, vector.columns];
    // What is not canonical but right is the server's decoder's to find; here the CRC says whether it is right.
    const reason = vector.cell_count > CELLS_MAX ? "too_many_cells" : vector.error;
    assert.throws(() => decodeChannel(given, shape), { name: "Refused", reason }, vector.name);
  }
});

test("wrong cells are refused by name", () => {
  const rows = (payload, raw, count) => channel(U8, ROWS, payload, raw, count);
  refusedFor("too_many_cells", rows([0], [0], 2 ** 32 - 1));
  refusedFor("too_many_cells", rows([0], [0], CELLS_MAX + 1));
  refusedFor("cell_count", rows([0], [0], 1), 2);
  refusedFor("cells", channel(U8, RAW, [1, 2], [1], 1));
  refusedFor("cells", channel(U8, CHANGES, [1], Array(9).fill(0), 9));
  refusedFor("cells", channel(U8, 7, [1], [1], 1));
  refusedFor("cells", channel(9, RAW, [1], [1], 1));
});

test("changes of any bytes are cells or are refused", () => {
  let seed = 3;
  const byte = () => (seed = (Math.imul(seed, 1664525) + 1013904223) >>> 0) >>> 24;
  for (let i = 0; i < 5000; i++) {
    const given = channel(1 + (byte() % 3), CHANGES, Array.from({ length: byte() % 30 }, byte), [], 32);
    const base = (Cells) => Cells.from({ length: 32 }, () => byte() % 3);
    assert.throws(() => decodeChannel(given, [4, 8], base), { name: "Refused" });
  }
});

test("no message of random bytes gives anything but a value or a named error", () => {
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
      assert.equal(error.name, "Refused", `${error} for ${bytes}`);
    }
  }
});

test("an update is read with its stamps whole", () => {
  const stamp = 1764000000123456789n, bytes = new Uint8Array(14);
  bytes.set([0x0a, 1, 42, 0x10, 3]);
  bytes[5] = 0x19;
  new DataView(bytes.buffer).setBigInt64(6, stamp, true);
  const update = readMapUpdate(bytes);
  assert.deepEqual([[...update.map], update.skipped, update.sent_ns], [[42], 3n, stamp]);
  assert.throws(() => readMapUpdate(bytes.subarray(0, 9)), WireError);
});

test("columns run counter-clockwise from ahead and a bench belongs to the row within", () => {
  const grid = gridOf({ radial: { r_bench_m: [1, 2, 4], columns: 4 } });
  assert.equal(grid.cellAt(0.5, 0.1), 0);
  assert.equal(grid.cellAt(-0.1, 0.5), 1);
  assert.equal(grid.cellAt(0.1, -0.5), 3);
  assert.equal(grid.cellAt(2, 0), 4);
  assert.equal(grid.cellAt(3, -1e-18), 11);
  assert.equal(grid.cellAt(4.01, 0), -1);
  assert.throws(() => gridOf({ radial: { r_bench_m: [2, 1], columns: 4 } }), /bench 1 is 1 m/);
});

test("a cartesian cell begins at its lower edge", () => {
  const grid = gridOf({ cartesian: { origin_x_m: -1, origin_y_m: -1, width: 3, height: 2, cell_m: 1, yaw_rad: 0 } });
  assert.deepEqual([grid.cellAt(-1, -1), grid.cellAt(1.5, 0.5), grid.cellAt(2, 0), grid.cellAt(0, 1)], [0, 5, -1, -1]);
});

test("a grid that turns under the vehicle is looked up along its own axes", () => {
  // The vehicle heads along the grid's y axis: ahead is up the rows, to the left is down the columns.
  const yaw_rad = Math.PI / 2;
  const grid = gridOf({ cartesian: { origin_x_m: -2, origin_y_m: -2, width: 4, height: 4, cell_m: 1, yaw_rad } });
  assert.deepEqual([grid.cellAt(1.5, 0.5), grid.cellAt(-0.5, 1.5), grid.cellAt(2.5, 0)], [13, 4, -1]);
});

test("ahead is up and left is left", () => {
  const { x, y } = egoAt(0, 0, 10, 5);
  assert.deepEqual([x, y], [4.5, 4.5]);
  const grid = gridOf({ radial: { r_bench_m: [20], columns: 4 } });
  assert.deepEqual([...pixelCells(grid, 2, 5)], [0, 3, 1, 2]);
});

const ns = (ms) => BigInt(Math.round(ms * 1e6));

test("a skewed clock does not change an age", () => {
  for (const skew of [-3.6e6, 0, 3.6e6]) {
    const clock = new ServerClock(), start = 1.7e12 + skew;
    for (const [at, delay] of [[0, 20], [100, 5], [200, 60]]) clock.sample(at + delay, ns(start + at));
    const age = freshness({ capture_end_ns: ns(start + 150), valid_until_ns: ns(start + 450) }, clock.now_ns(260));
    assert.ok(Math.abs(age.age_ms - 105) < 0.1, `${age.age_ms} ms at skew ${skew}`);
    assert.ok(age.fresh);
  }
});

test("a delay that grows a millisecond a map becomes stale", () => {
  const clock = new ServerClock();
  let age;
  for (let i = 0; i < 600; i++) {
    const sent = 1e12 + i * 100, received = i * 100 + i;
    clock.sample(received, ns(sent));
    age = freshness({ capture_end_ns: ns(sent - 60), valid_until_ns: ns(sent + 240) }, clock.now_ns(received));
  }
  assert.equal(age.fresh, false);
  assert.ok(age.age_ms > 640, `${age.age_ms} ms`);
});

test("a map whose time is unknown, past or from the future is not fresh", () => {
  const header = { capture_end_ns: ns(1000), valid_until_ns: ns(1300) };
  const fresh = (now) => freshness(header, now).fresh;
  assert.deepEqual([null, ns(1301), ns(800), ns(1300)].map(fresh), [false, false, false, true]);
});

test("a sensor's clock is named with how far the host is from it", () => {
  assert.equal(clockWords("gps", 0n), "GPS");
  assert.equal(clockWords("gps_unlocked", -7000n), "GPS, not locked, host 7.0 s behind");
  assert.equal(clockWords("arrival", 1n), "arrival, host 1 ms ahead");
  assert.equal(clockWords("", undefined), "–");
});
