// Tests of the view of one vehicle: where things are on the canvas, the trail, the plots.
// Run: cd server/web && node --test

import assert from "node:assert/strict";
import test from "node:test";
import { grafanaLink, History, lines, niceTop, SPAN_MS, told } from "./history.js";
import { saysOf } from "./layers.js";
import { ahead, egoFrom, fit, moveInto, pan, place, rasterOf, toEgo, toPixel, Trail, zoomAt } from "./view.js";

const SIZE = { width: 800, height: 400 };
const near = (a, b) => assert.ok(Math.abs(a - b) < 1e-9, `${a} and ${b}`);

test("a place under the pointer stays there when the map is zoomed", () => {
  let view = fit(60, SIZE);
  for (const [px, py, factor] of [[100, 50, 2], [700, 390, 3], [400, 200, 0.5], [0, 0, 1e9], [5, 5, 1e-9]]) {
    const before = toEgo(view, SIZE, px, py);
    view = zoomAt(view, SIZE, px, py, factor);
    const after = toPixel(view, SIZE, before.x, before.y);
    near(after.px, px);
    near(after.py, py);
  }
  assert.equal(view.metres, 1, "no farther than this");
});

test("forward is up, left is left, and a drag moves the picture with the finger", () => {
  const view = fit(60, SIZE);
  assert.deepEqual(toPixel(view, SIZE, 0, 0), { px: 400, py: 200 });
  assert.ok(toPixel(view, SIZE, 10, 0).py < 200 && toPixel(view, SIZE, 0, 10).px < 400);
  const moved = toPixel(pan(view, 30, -20), SIZE, 0, 0);
  near(moved.px, 430);
  near(moved.py, 180);
  assert.equal(pan(view, 1e9, 0).y_m, 200, "the vehicle is never lost");
});

test("the map opens with 30 m ahead and 15 m behind, the vehicle low in the picture", () => {
  for (const size of [SIZE, { width: 370, height: 370 }, { width: 300, height: 900 }]) {
    const view = ahead(size), side = Math.min(size.width, size.height);
    near(toPixel(view, size, 30, 0).py, (size.height - side) / 2);
    near(toPixel(view, size, -15, 0).py, (size.height + side) / 2);
  }
});

test("a class says what it is and what a planner may do there", () => {
  const classes = { layers: { speed: { not_reached: "Even enough." } }, meanings: { "not reached": "not drive there" } };
  const says = (layer, text) => saysOf(classes, layer, text, "not reached");
  assert.equal(says("speed", "not reached"), "Even enough. A planner may not drive there.");
  assert.equal(says("other", "not reached"), "A planner may not drive there.");
  assert.equal(saysOf({}, "speed", "plan tester", undefined), "", "before the words have come");
});

test("a raster covers the canvas, and keeps its place when the view moves", () => {
  const view = fit(60, SIZE), raster = rasterOf(view, SIZE, 2, 1200);
  assert.deepEqual([raster.width, raster.height], [1200, 600]);
  place(raster, view, SIZE).forEach((value, i) => near(value, [0, 0, 800, 400][i]));
  place(raster, pan(view, 30, -20), SIZE).forEach((value, i) => near(value, [30, -20, 800, 400][i]));
  const closer = place(raster, zoomAt(view, SIZE, 400, 200, 2), SIZE);
  closer.forEach((value, i) => near(value, [-400, -200, 1600, 800][i]));
});

test("the view follows a cursor that leaves it, and no other", () => {
  const view = fit(60, SIZE), far = { x: 100, y: 0 };
  assert.deepEqual(moveInto(view, SIZE, { x: 5, y: 5 }), view);
  near(toPixel(moveInto(view, SIZE, far), SIZE, far.x, far.y).py, 24);
});

test("a point of the fixed frame is ahead of a vehicle that heads to it", () => {
  const half = Math.SQRT1_2, pose = { x: 10, y: 5, qx: 0, qy: 0, qz: half, qw: half };
  const { x, y } = egoFrom(pose, { x: 10, y: 8 });
  near(x, 3);
  near(y, 0);
});

test("a trail has a point every half metre and begins again after a jump", () => {
  const trail = new Trail();
  for (let i = 0; i <= 20; i++) trail.push({ x: i * 0.1, y: 0 });
  assert.deepEqual(trail.points.map(({ x }) => x.toFixed(1)), ["0.0", "0.5", "1.0", "1.5", "2.0"]);
  trail.push({ x: 500, y: 0 });
  assert.equal(trail.points.length, 1);
  for (let i = 0; i < 5000; i++) trail.push({ x: 500 + i, y: 0 });
  assert.equal(trail.points.length, 2000);
});

const ROW = { map_age_ms: 50, latency_ms: { total: 8 }, map_rate_hz: 10, loss: null };
const status = (s, more) => ({ ...ROW, now_ns: `${s}000000000`, ...more });

test("the history keeps ten minutes, and a value that is unknown is a gap and not zero", () => {
  const history = new History();
  for (let s = 1; s <= 700; s++) history.push(status(s, s === 651 ? { map_age_ms: null } : {}));
  assert.equal(history.rows.length, 601);
  assert.ok(history.has("map_age_ms") && history.has("latency_ms_total") && !history.has("loss"));
  const drawn = lines(history.rows, "map_age_ms", 700_000, { width: 600, height: 40, top: 100 });
  assert.deepEqual(drawn.map((line) => line.length), [551, 49]);
  assert.deepEqual([drawn[0][0], drawn[1].at(-1)], [[0, 20], [600, 20]]);
  const pause = [{ at_ms: 0, hz: 1 }, { at_ms: 5000, hz: 1 }];
  assert.equal(lines(pause, "hz", SPAN_MS, { width: 600, height: 40, top: 1 }).length, 2, "no line over a pause");
});

const CHANGES = [
  { at_ms: 1_000_000, state: "ok", reasons: [], file: "" },
  { at_ms: 1_060_000, state: "error", reasons: ["no packets from top for 2.1 s"], file: "drive.mcap" },
];

test("what the server kept comes before the statuses, and none of them is there twice", () => {
  const history = new History();
  history.push(status(9));
  const columns = ["map_age_ms", "map_rate_hz"];
  history.load({ columns, rows: [[8000, [40, null]], [9000, [50, 9.5]]], changes: CHANGES });
  [9, 10].forEach((s) => history.push(status(s)));
  assert.deepEqual(history.rows.map(({ at_ms }) => at_ms), [8000, 9000, 10_000]);
  assert.deepEqual(history.rows[1], { at_ms: 9000, map_age_ms: 50, map_rate_hz: 9.5 });
});

test("changes of the state are told newest first, with how long each lasted and its range in Grafana", () => {
  const [newest, before] = told({ changes: CHANGES });
  assert.deepEqual([newest.state, newest.lasted_ms, newest.from, newest.to], ["error", null, 940_000, "now"]);
  assert.deepEqual([before.state, before.lasted_ms, before.from, before.to], ["ok", 60_000, 880_000, 1_180_000]);
  const link = "https://g.example/grafana/d/clearway/clearway?from=880000&to=1180000&var-vehicle=car+9";
  for (const of of ["https://g.example/grafana", "https://g.example/grafana/"]) {
    assert.equal(grafanaLink(of, "car 9", before.from, before.to), link);
  }
  for (const none of ["", "g.example", "javascript:alert(1)"]) assert.equal(grafanaLink(none, "car", 0, 1), null);
});

test("the upper edge of a plot is a round number over all values", () => {
  const top = (...values) => niceTop(values.map((age_ms) => ({ age_ms })), "age_ms", 200);
  assert.deepEqual([top(), top(10), top(201), top(999), top(1e6), top(null)], [200, 200, 500, 1000, 1e6, 200]);
});
