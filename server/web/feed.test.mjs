// Tests of the Worker's part: what is asked of the server, which map is drawn, and what is in a frame.
// Run: cd server/web && node --test

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import test from "node:test";
import { Feed } from "./feed.js";
import { cellValues, newFrame } from "./frame.js";
import { fadeSlices } from "./draw/paint.js";
import { legendByMeaning } from "./draw/palette.js";
import { readSettings, wantOf } from "./settings.js";
import { gridOf } from "./wire/grid.js";

const LEGEND = [
  { name: "unknown", meaning: "unknown", colour: [1, 2, 3] },
  { name: "free", meaning: "free", colour: [4, 5, 6] },
  { name: "road", meaning: "free", colour: [100, 110, 120] },
];
// Two by two cells of 10 m about the vehicle: behind right, ahead right, behind left, ahead left.
const GRID = gridOf({ cartesian: { origin_x_m: -10, origin_y_m: -10, width: 2, height: 2, cell_m: 10, yaw_rad: 0 } });
const RASTER = { width: 2, height: 2, x_m: 0, y_m: 0, metres: 10 };
const channel = (name, cells, more) => ({ name, unit: "", scale: 1, unknown: 0, cells, ...more });

function mapOf(layers) {
  const made = new Map(Object.entries(layers).map(([name, channels]) => [name, {
    name, legend: LEGEND, grid: GRID, metrics: new Map(), channels, safe_points: null,
    cells: (name) => channels.find((channel) => channel.name === name)?.cells ?? null,
  }]));
  return { names: [...made.keys()], layer: (name) => made.get(name) ?? null };
}

const SHOW = {
  base: { layer: "a", channel: "class" }, overlays: [], road: false, safe_points: false, by_meaning: false,
};
const frameOf = (layers, show = {}, ranges = new Map()) =>
  newFrame(mapOf(layers), { ...SHOW, ...show }, RASTER, ranges);
const colours = ({ pixels }) => [...pixels].map((pixel) => [pixel & 255, (pixel >> 8) & 255, (pixel >> 16) & 255]);
const CLASSES = channel("class", Uint8Array.of(0, 1, 1, 2));

test("a frame is painted ahead up and left on the left", () => {
  const { base, channels } = frameOf({ a: [CLASSES] });
  assert.deepEqual([base, channels], [{ layer: "a", channel: "class" }, ["class"]]);
  assert.deepEqual(colours(frameOf({ a: [CLASSES] })), [[100, 110, 120], [4, 5, 6], [4, 5, 6], [1, 2, 3]]);
});

test("a layer over another one leaves what it does not know, and mixes the rest", () => {
  const over = [channel("class", Uint8Array.of(0, 2, 0, 0))];
  const drawn = colours(frameOf({ a: [CLASSES], b: over }, { overlays: ["b", "none"] }));
  assert.deepEqual(drawn, [[100, 110, 120], [52, 57, 63], [4, 5, 6], [1, 2, 3]]);
  const road = colours(frameOf({ a: [CLASSES], b: [channel("class", Uint8Array.of(1, 1, 1, 2))] }, { road: true }));
  assert.deepEqual(road[1], [4, 5, 6], "only the road is drawn over");
});

test("unknown cells are quiet, and all others are plain", () => {
  const { pixels } = frameOf({ a: [CLASSES] });
  assert.deepEqual([...pixels].map((pixel) => pixel >>> 24), [255, 255, 255, 128]);
});

test("slices of a radial layer are fainter the longer they are, and no square cell is", () => {
  const grid = gridOf({ radial: { row_radius_m: [1, 5, 30], columns: 4 } }), table = Int32Array.of(0, 4, 8, -1);
  const pixels = new Uint32Array(4).fill(0xff0000ff);
  fadeSlices(pixels, table, GRID);
  assert.deepEqual([...pixels], [0xff0000ff, 0xff0000ff, 0xff0000ff, 0xff0000ff]);
  fadeSlices(pixels, table, grid);
  assert.deepEqual([...pixels].map((pixel) => pixel >>> 24), [255, 127, 63, 255]);
  assert.equal(pixels[2] & 0xffffff, 0x0000ff, "the colour stays");
});

test("a channel is a heat map with a colour bar, whose range only grows", () => {
  const slope = (...cells) =>
    ({ a: [CLASSES, channel("slope", Int8Array.from(cells), { scale: 0.02, unknown: -128 })] });
  const ranges = new Map(), show = { base: { layer: "a", channel: "slope" } };
  assert.deepEqual(frameOf(slope(-128, -50, 0, 50), show, ranges).bar, ["-1.00", "0.00", "1.00"]);
  assert.deepEqual(frameOf(slope(-128, 0, 0, 0), show, ranges).bar, ["-1.00", "0.00", "1.00"]);
  assert.equal(frameOf(slope(0, 0, 0, 0), { base: { layer: "a", channel: "gone" } }).base.channel, "class");
});

test("a cell has every value of every layer, with its unit", () => {
  const map = mapOf({
    a: [CLASSES, channel("roughness", Uint8Array.of(255, 0, 100, 200), { unit: "m/m", scale: 2e-4, unknown: 255 })],
    b: [channel("segment", Uint16Array.of(65535, 0, 4, 1200), { unit: "id", unknown: 65535 })],
  });
  assert.deepEqual(cellValues(map, { x: 5, y: 5 }), [
    { layer: "a", cell: 3, values: [["class", "road", 2], ["roughness", "0.0400 m/m", 200]] },
    { layer: "b", cell: 3, values: [["segment", "1,200", 1200]] },
  ]);
  assert.deepEqual(cellValues(map, { x: -5, y: -5 })[1].values, [["segment", "unknown", 65535]]);
  assert.deepEqual(cellValues(map, { x: 50, y: 0 })[0], { layer: "a", cell: -1, values: [] });
});

test("colours by meaning tell free from occupied, and classes of one meaning apart", () => {
  const legend = legendByMeaning([...LEGEND, { name: "wall", meaning: "occupied", colour: [0, 0, 0] }]);
  const [unknown, free, road, wall] = legend.map(({ colour }) => colour.join());
  assert.equal(new Set([unknown, free, road, wall]).size, 4);
  assert.deepEqual([legend[1].colour, legend[3].colour], [[0, 114, 178], [213, 94, 0]]);
});

const update = (() => {
  const map = readFileSync(new URL("../../proto/golden/map.bin", import.meta.url));
  const varint = (n) => (n < 128 ? [n] : [(n & 127) | 128, ...varint(n >> 7)]);
  return Uint8Array.from([0x0a, ...varint(map.length), ...map, 0x19, 1, 0, 0, 0, 0, 0, 0, 0]);
})();

function feedOf(want = {}) {
  const sent = [], emitted = [];
  const feed = new Feed("car", (request) => sent.push(request), (message) => emitted.push(message));
  const given = { layers: ["a"], max_rate_hz: 1, deltas: false, show: SHOW, raster: RASTER, probe: null, ...want };
  feed.want(given);
  return { feed, sent, emitted, given, types: () => emitted.map(({ type }) => type) };
}

test("maps count from the answer to a selection on, and one that is drawn is acknowledged", () => {
  const { feed, sent, emitted } = feedOf();
  const { id } = sent[0];
  assert.deepEqual(sent, [{
    vehicle: "car", type: "watch", id, layers: ["a"], max_rate_hz: 1, deltas: false, max_in_flight: 2,
  }]);
  feed.push(update, 5);
  assert.equal(emitted.length, 0, "a map of an earlier selection");
  feed.begun(id - 1);
  feed.push(update, 5);
  assert.equal(emitted.length, 0, "the answer to an earlier selection");
  feed.begun(id);
  feed.push(update, 5);
  assert.deepEqual(emitted.map(({ type, arrived_ms }) => [type, arrived_ms]), [["frame", 5]]);
  assert.equal(sent.length, 1, "not drawn yet");
  feed.drawn();
  feed.drawn();
  assert.deepEqual(sent.slice(1), [{
    vehicle: "car", type: "acknowledge", id, sequence: emitted[0].header.sequence.toString(),
  }]);
});

test("what is shown of a map changes at once, and the server hears of another selection alone", () => {
  const { feed, sent, given, types } = feedOf();
  feed.begun(sent[0].id);
  feed.push(update, 5);
  feed.want({ ...given, raster: { ...RASTER, x_m: 5 } });
  assert.deepEqual(types(), ["frame"], "the page has not drawn the last one");
  feed.drawn();
  assert.deepEqual(types(), ["frame", "frame"]);
  feed.drawn();
  feed.probe({ x: 0, y: 0 });
  assert.deepEqual(types(), ["frame", "frame", "cell"]);
  assert.deepEqual(sent.map(({ type }) => type), ["watch", "acknowledge"]);
  feed.want({ ...given, layers: ["b"] });
  feed.end();
  assert.deepEqual(sent.map(({ type }) => type), ["watch", "acknowledge", "watch", "unwatch"]);
});

test("after a map that cannot be read a whole one is asked for", () => {
  const { feed, sent } = feedOf({ deltas: true });
  feed.begun(sent[0].id);
  assert.throws(() => feed.push(Uint8Array.of(0), 5), { name: "WireError" });
  assert.equal(sent[1].type, "keyframe");
});

test("a layer is selected with those that are drawn over it, and unknown ones are not", () => {
  const layers = ["drivability", "speed", "safe_path"], settings = readSettings(null);
  assert.deepEqual(wantOf(settings, layers).layers, ["drivability"], "safe paths are off until they are wanted");
  assert.deepEqual(wantOf({ ...settings, safe_points: true }, layers).layers, ["drivability", "safe_path"]);
  assert.deepEqual(wantOf(settings, ["terrain"]).layers, ["terrain"]);
  const chosen = { ...settings, layer: "speed", overlays: ["drivability", "speed", "x"], road: true, max_rate_hz: 2 };
  const want = wantOf(chosen, layers);
  assert.deepEqual([want.layers, want.max_rate_hz], [["drivability", "speed"], 2]);
  assert.deepEqual(want.show.overlays, ["drivability"]);
});

test("kept settings of another kind do no harm", () => {
  const defaults = readSettings(null);
  for (const text of ["{", "null", "3", '{"overlays":{},"layer":7,"road":"yes"}']) {
    assert.deepEqual(readSettings(text), defaults);
  }
  const kept = readSettings('{"overlays":["terrain",7],"layer":"speed","more":1}');
  assert.deepEqual([kept.overlays, kept.layer, kept.more], [["terrain"], "speed", undefined]);
});
