// Tests of the view in 3-D: quads, planes, camera, points. What the graphics card draws is seen in tests/tests/page.
// Run: cd server/web && node --test

import assert from "node:assert/strict";
import test from "node:test";
import { newFrame } from "../frame.js";
import { gridOf } from "../wire/grid.js";
import { groundOf } from "./ground.js";
import { groundAt, matrixOf, move, project, START, turn, zoom } from "./orbit.js";
import { isPoints, Poses, readPoints } from "./points.js";
import { COLOUR_AT, CORNER_BYTES, QUAD_BYTES, QuadList } from "./quads.js";
import { text } from "./space.js";
import { trailQuads, vehicleQuads } from "./vehicle.js";

const SIZE = { width: 800, height: 400 };
const near = (a, b, by = 1e-4) => assert.ok(Math.abs(a - b) < by, `${a} and ${b}`);

// [{ corners: [[x, y, z] in metres], colour: [red, green, blue, opacity] }].
function read({ bytes, count }) {
  assert.equal(bytes.length, count * QUAD_BYTES);
  const view = new DataView(bytes.buffer, bytes.byteOffset);
  return Array.from({ length: count }, (_, i) => {
    const at = i * QUAD_BYTES, short = (k) => view.getInt16(at + 2 * k, true) / 100;
    const corners = [0, 1, 2, 3].map((i) => [0, 1, 2].map((k) => short((i * CORNER_BYTES) / 2 + k)));
    const colours = [0, 1, 2, 3].map((i) => [...bytes.slice(at + i * CORNER_BYTES + COLOUR_AT).subarray(0, 4)]);
    colours.forEach((colour) => assert.deepEqual(colour, colours[0]));
    return { corners, colour: colours[0] };
  });
}

const SQUARE = [0, 0, 1, 0, 1, 1, 0, 1];

test("a quad lies in its plane, and a list grows", () => {
  const quads = new QuadList(1);
  quads.pushInPlane(SQUARE, [0.1, -0.2, 1], 0.05, 0xff030201);
  quads.pushInPlane(SQUARE, [0, 0, 1e6], 0, 0);
  const [quad, far] = read(quads);
  assert.deepEqual(quad.corners, [[0, 0, 1.05], [1, 0, 1.15], [1, 1, 0.95], [0, 1, 0.85]]);
  assert.deepEqual(quad.colour, [1, 2, 3, 255]);
  assert.equal(far.corners[0][2], 327.67, "a height that does not fit is the greatest that does");
});

test("a box stands on its plane and has four sides and a roof", () => {
  const quads = new QuadList();
  quads.pushBox(SQUARE, [1, 0, 0], 2, 0);
  const all = read(quads);
  assert.equal(all.length, 5);
  assert.deepEqual(all[4].corners, [[0, 0, 2], [1, 0, 3], [1, 1, 3], [0, 1, 2]]);
  const lowest = all.slice(0, 4).flatMap(({ corners }) => corners.slice(0, 2).map(([x, , z]) => z - x));
  assert.ok(lowest.every((over) => over === 0), `${lowest}`);
});

test("a line has its width, and a point is no line", () => {
  const quads = new QuadList();
  quads.pushLine([0, 0, 1], [0, 4, 2], 0.5, 0);
  quads.pushLine([1, 1, 1], [1, 1, 1], 0.5, 0);
  const [line, ...rest] = read(quads);
  assert.deepEqual(line.corners, [[-0.25, 0, 1], [0.25, 0, 1], [0.25, 4, 2], [-0.25, 4, 2]]);
  assert.deepEqual(rest, []);
});

test("the corners of a cell enclose the points that the grid says are in it", () => {
  const radial = gridOf({ radial: { row_radius_m: [5, 10, 20], columns: 36, centre_x_m: 1, centre_y_m: -2 } });
  const axes = { origin_x_m: -10, origin_y_m: -4, width: 7, height: 5, cell_m: 2.5, yaw_rad: 0.7 };
  for (const grid of [radial, gridOf({ cartesian: axes })]) {
    const xy = new Float64Array(8), [rows, columns] = grid.shape;
    for (let cell = 0; cell < rows * columns; cell++) {
      grid.corners(cell, xy);
      // They are in order around it, counter-clockwise: a corner where the outline turns right would be out of order.
      for (let i = 0; i < 4; i++) {
        const [ax, ay, bx, by, cx, cy] = [0, 1, 2].flatMap((k) => [0, 1].map((axis) => xy[2 * ((i + k) % 4) + axis]));
        assert.ok((bx - ax) * (cy - by) - (by - ay) * (cx - bx) > -1e-9, `${grid.key}, order`);
      }
      // The middle, and places near each corner towards the middle.
      const middle = [0, 1].map((k) => (xy[k] + xy[2 + k] + xy[4 + k] + xy[6 + k]) / 4);
      for (let i = 0; i < 4; i++) {
        const [x, y] = middle.map((m, k) => 0.9 * xy[2 * i + k] + 0.1 * m);
        assert.equal(grid.cellAt(x, y), cell, `${grid.key}, corner ${i}`);
      }
    }
  }
});

const LEGEND = [
  { name: "unknown", meaning: "unknown", colour: [1, 2, 3] },
  { name: "flat", meaning: "free", colour: [4, 5, 6] },
  { name: "obstacle", meaning: "occupied", colour: [200, 0, 0] },
  { name: "road", meaning: "free", colour: [100, 110, 120] },
];
// Two by two cells of 10 m about the vehicle: behind right, ahead right, behind left, ahead left.
const GRID = gridOf({ cartesian: { origin_x_m: -10, origin_y_m: -10, width: 2, height: 2, cell_m: 10, yaw_rad: 0 } });
const channel = (name, cells, more) => ({ name, unit: "", scale: 1, unknown: 0, cells, ...more });
const plane = (name, scale, raw) => channel(name, Int8Array.from(raw), { scale, unknown: -128 });

function mapOf(layers) {
  const made = new Map(Object.entries(layers).map(([name, [channels, planes = []]]) => [name, {
    name, legend: LEGEND, grid: GRID, metrics: new Map(), channels, planes, safe_points: null,
    cells: (name) => channels.find((channel) => channel.name === name)?.cells ?? null,
  }]));
  return { names: [...made.keys()], layer: (name) => made.get(name) ?? null };
}

const SHOW = { overlays: [], road: false, safe_points: false, by_meaning: false, space: true };
const quadsOf = (layers, base, show = {}) => {
  const wanted = { ...SHOW, base: { layer: base, channel: "class" }, ...show };
  const frame = newFrame(mapOf(layers), wanted, { width: 2, height: 2, x_m: 0, y_m: 0, metres: 10 }, new Map());
  assert.equal(frame.pixels, null, "nothing flat is painted");
  return { ...frame, quads: read(frame.space) };
};
const zs = ({ corners }) => corners.map(([, , z]) => z);

test("terrain's cells lie in their planes, and around an obstacle without a plane stands an outline", () => {
  const terrain = [[
    channel("class", Uint8Array.of(0, 1, 2, 0)),
    plane("height", 0.05, [-128, 20, -128, 0]),
    plane("slope_x", 0.02, [-128, 5, -128, 0]),
    plane("slope_y", 0.02, [-128, -10, -128, 0]),
  ]];
  const { quads, space } = quadsOf({ terrain }, "terrain");
  assert.equal(space.source, "terrain");
  assert.equal(quads.length, 2 + 4 * 2, "two planes, four sides with a rim each; nothing of cells that are unknown");
  // Ahead right: 1 m high in the middle, rising by 1 m ahead, falling by 2 m to the left.
  assert.deepEqual(quads[0].corners, [[0, -10, 1.5], [10, -10, 2.5], [10, 0, 0.5], [0, 0, -0.5]]);
  assert.deepEqual(quads[0].colour, [4, 5, 6, 255]);
  assert.deepEqual([zs(quads[1]), zs(quads[2])], [[0, 0, 0, 0], [0, 0, 0.42, 0.42]], "open above");
  assert.deepEqual([zs(quads[3]), quads[2].colour[3], quads[3].colour[3]], [[0.42, 0.42, 0.5, 0.5], 64, 255]);
});

test("without terrain's planes the cells of every layer lie in those of the segments", () => {
  const segment = channel("segment", Uint16Array.of(0, 1, 65535, 2), { unit: "id", unknown: 65535 });
  const planes = [{ a: 0, b: 0, c: 3 }, { a: 0.1, b: 0, c: 0 }, { a: NaN, b: 0, c: 0 }];
  const classes = channel("class", Uint8Array.of(1, 1, 1, 1));
  const layers = { drivability: [[classes, segment], planes], speed: [[classes]] };
  const { quads, space } = quadsOf(layers, "speed");
  assert.equal(space.source, "drivability");
  assert.deepEqual(quads.map(zs), [[3, 3, 3, 3], [0, 1, 1, 0], [0, 0, 0, 0]]);
  assert.deepEqual(quads[2].corners, [[-10, 0, 0], [10, 0, 0], [10, 10, 0], [-10, 10, 0]], "two cells in one plane");
  assert.equal(groundOf(mapOf({ speed: [[classes]] })).source, null);
});

test("an obstacle is as high as its layer says", () => {
  const classes = channel("class", Uint8Array.of(2, 2, 1, 1));
  const height = plane("unit_height", 0.05, [40, -128, 100, 0]);
  const { quads } = quadsOf({ drivability: [[classes, height]] }, "drivability");
  const tops = quads.slice(2).map((quad) => zs(quad)[2]).filter((_, i) => i % 2);
  assert.deepEqual(tops, [2, 2, 2, 0.5, 0.5, 0.5], "no side between two obstacles");
});

test("cells with hits are crimson to red, and the road lies over them", () => {
  const occupancy = [[channel("class", Uint8Array.of(0, 0, 1, 1)), channel("hits", Uint8Array.of(0, 1, 255, 0))]];
  const speed = [[channel("class", Uint8Array.of(0, 3, 0, 1))]];
  const { quads, legend } = quadsOf({ occupancy, speed }, "occupancy", { road: true });
  const [little, much, clear, road] = quads;
  assert.deepEqual([little, much].map(({ colour }) => colour), [[113, 10, 52, 255], [255, 36, 28, 255]]);
  assert.deepEqual(clear.colour, [4, 5, 6, 255]);
  assert.deepEqual(road.colour, [100, 110, 120, 255]);
  assert.ok(zs(road)[0] > zs(little)[0] && quads.length === 4);
  assert.deepEqual(legend.slice(-2).map(([, words]) => words), ["1 hit, least confidence", "occupied, 255 hits"]);
});

test("a layer over another one is half seen through", () => {
  const layers = { a: [[channel("class", Uint8Array.of(1, 0, 0, 0))]], b: [[channel("class", Uint8Array.of(2, 0, 0, 0))]] };
  const { quads } = quadsOf(layers, "a", { overlays: ["b"] });
  assert.equal(quads[0].colour[3], 255);
  assert.deepEqual(quads[1].colour, [200, 0, 0, 128]);
});

test("ahead is up from behind the vehicle, and left is left", () => {
  const matrix = matrixOf({ ...START, x_m: 0 }, SIZE), at = (point) => project(matrix, SIZE, point);
  near(at([0, 0, 0]).px, 400);
  near(at([0, 0, 0]).py, 200);
  assert.ok(at([10, 0, 0]).py < 200 && at([0, 0, 5]).py < 200 && at([0, 10, 0]).px < 400);
  assert.equal(at([-100, 0, 0]), null, "behind the camera");
});

test("a click on the picture is a place on the ground", () => {
  for (const camera of [START, { ...START, yaw: 2, pitch: 1.2, x_m: -3, y_m: 7 }]) {
    for (const place of [[5, 2, 0], [-4, 9, 0], [8, 0, 0]]) {
      const pixel = project(matrixOf(camera, SIZE), SIZE, place), at = groundAt(camera, SIZE, pixel.px, pixel.py);
      near(at.x, place[0], 1e-3);
      near(at.y, place[1], 1e-3);
    }
  }
  assert.equal(groundAt({ ...START, pitch: 0.05 }, SIZE, 400, 0), null, "the sky");
});

test("from above at its distance, the camera sees as many metres as its angle says", () => {
  const camera = { yaw: 0, pitch: Math.PI / 2, distance_m: 50, x_m: 0, y_m: 0 }, half = 50 * Math.tan(Math.PI / 8);
  const at = project(matrixOf(camera, SIZE), SIZE, [half, -half, 0]);
  near(at.py, 0, 1e-3);
  near(at.px, 400 + 200, 1e-3);
});

test("the ground follows a drag that moves, and a camera stays over the ground and near", () => {
  const camera = { ...START, yaw: 1, pitch: 1.5 };
  const before = project(matrixOf(camera, SIZE), SIZE, [camera.x_m, camera.y_m, 0]);
  const moved = project(matrixOf(move(camera, SIZE, 10, -6), SIZE), SIZE, [camera.x_m, camera.y_m, 0]);
  near(moved.px - before.px, 10, 0.5);
  near(moved.py - before.py, -6, 0.5);
  assert.ok(turn(START, 0, -1e6).pitch > 0 && turn(START, 0, 1e6).pitch < Math.PI / 2);
  assert.deepEqual([zoom(START, 1e9).distance_m, zoom(START, 1e-9).distance_m], [4, 300]);
  assert.ok(turn(START, 50, 0).yaw > 0, "a drag to the right looks farther to the left");
});

// A frame of points, as server/src/publish/page_points.rs makes it.
function frameOf(vehicle, points, total = points.length) {
  const name = new TextEncoder().encode(vehicle), bytes = new Uint8Array(24 + 6 * points.length + name.length);
  const view = new DataView(bytes.buffer);
  bytes.set(new TextEncoder().encode("CWPT"));
  view.setUint32(4, points.length, true);
  view.setBigInt64(8, 1700000000123456789n, true);
  view.setUint32(16, total, true);
  view.setUint32(20, name.length, true);
  points.flat().forEach((cm, i) => view.setInt16(24 + 2 * i, cm, true));
  bytes.set(name, bytes.length - name.length);
  return bytes;
}

test("a frame of points is read, and told apart from a map", () => {
  const bytes = frameOf("Käfer", [[100, -200, 25], [-32767, 32767, -1]], 7);
  assert.ok(isPoints(bytes) && !isPoints(Uint8Array.of(0x0a, 0x57, 0x50, 0x54)) && !isPoints(new Uint8Array(0)));
  const { xyz, ...rest } = readPoints(bytes);
  assert.deepEqual(rest, { vehicle: "Käfer", capture_end_ns: 1700000000123456789n, total: 7, count: 2 });
  assert.deepEqual([...xyz], [100, -200, 25, -32767, 32767, -1]);
  for (const length of [4, 23, bytes.length - 1]) {
    assert.throws(() => readPoints(bytes.slice(0, length)), { reason: "points" }, `${length} bytes`);
  }
  assert.throws(() => readPoints(frameOf("car", [[0, 0, 0]], 0)), { reason: "points" });
});

test("the points of an earlier map are moved to where the vehicle is now", () => {
  const poses = new Poses(), half = Math.SQRT1_2;
  assert.equal(poses.move(1n), null);
  poses.push(100n, { x: 0, y: 0, qx: 0, qy: 0, qz: 0, qw: 1 });
  poses.push(200n, { x: 4, y: 0, qx: 0, qy: 0, qz: 0, qw: 1 });
  poses.push(300n, { x: 4, y: 2, qx: 0, qy: 0, qz: half, qw: half });
  const then = poses.move(150n);
  // The vehicle was at (2, 0), looks to the left now from (4, 2): 2 m behind and 2 m to the left of it.
  [then.x, then.y, then.yaw].forEach((value, i) => near(value, [-2, 2, -Math.PI / 2][i]));
  assert.deepEqual([poses.move(99n), poses.move(301n)], [null, null], "not known");
  const turning = poses.move(250n);
  [turning.x, turning.y, turning.yaw].forEach((value, i) => near(value, [-1, 0, -Math.PI / 4][i]));
  poses.push(50n, { x: 0, y: 0, qx: 0, qy: 0, qz: 0, qw: 1 });
  assert.equal(poses.move(200n), null, "a replay that was set back begins again");
});

test("the vehicle stands where its outline is, and its trail lies behind it", () => {
  const [xs, ys, heights] = [0, 1, 2].map((k) =>
    read(vehicleQuads([3, 1, 3, -1, -1, -1, -1, 1])).slice(0, 10).flatMap(({ corners }) => corners.map((at) => at[k])));
  assert.deepEqual([Math.min(...xs), Math.max(...xs)], [-1, 3]);
  assert.deepEqual([Math.min(...ys), Math.max(...ys)], [-1, 1]);
  assert.deepEqual([Math.min(...heights), Math.max(...heights)], [0.3, 1.5]);
  const pose = { x: 10, y: 0, qx: 0, qy: 0, qz: 0, qw: 1 };
  const [line] = read(trailQuads([{ x: 4, y: 0 }, { x: 8, y: 0 }], pose));
  assert.deepEqual(line.corners.map(([x]) => x), [-6, -6, -2, -2]);
});

test("the view says what is drawn, and how many points of how many", () => {
  const frame = (source) => ({ space: { source } });
  assert.equal(text(frame("terrain"), false, null), "cells in terrain's planes");
  assert.equal(text(frame(null), true, null), "no planes: cells lie at height 0 · points come with the next map");
  assert.equal(text(null, true, null, "not allowed"), "no map yet · not allowed");
  assert.match(text(frame("drivability"), true, { count: 60000, total: 120001 }), /· 60,000 of 120,001 points, dark/);
});
