// Tests of a layer's panel: what it draws, and the texts beside it. Run: cd server/web && node --test

import assert from "node:assert/strict";
import test from "node:test";
import { panelTemplate } from "./fake_dom.mjs";
import { Panel } from "./panel.js";
import { gridOf } from "./wire/grid.js";

const SIDE = 40;
const LEGEND = [
  { name: "unknown", meaning: "unknown", colour: [1, 2, 3] },
  { name: "free", meaning: "free", colour: [4, 5, 6] },
];
// Two by two cells of 10 m about the vehicle: behind right, ahead right, behind left, ahead left.
const GRID = gridOf({ cartesian: { origin_x_m: -10, origin_y_m: -10, width: 2, height: 2, cell_m: 10, yaw_rad: 0 } });
const CLASS = { name: "class", unit: "", scale: 1, unknown: 0, cells: Uint8Array.of(0, 1, 1, 1) };

// A map with one layer of these channels.
function mapOf(channels, { safe_points = null, metrics = new Map() } = {}) {
  const cells = (name) => channels.find((channel) => channel.name === name)?.cells ?? null;
  return { layer: (name) => ({ name, legend: LEGEND, grid: GRID, metrics, channels, cells, safe_points }) };
}

const newPanel = (name = "terrain") => new Panel(panelTemplate(SIDE), name, () => {});

// What is shown of a channel: the texts of its legend, those of its colour bar, and those of cells under the pointer.
function shown(channel, points = []) {
  const panel = newPanel(), map = mapOf([CLASS, channel]);
  panel.draw(map, 10, null);
  panel.part.channel.value = channel.name;
  panel.part.channel.onchange();
  panel.draw(map, 10, null);
  const { legend, scale, overlay, readout } = panel.part;
  const readouts = points.map(([x, y]) => {
    const [clientX, clientY] = [20 - 2 * y, 20 - 2 * x];
    overlay.onpointermove({ clientX, clientY });
    panel.draw(map, 10, null);
    return readout.textContent.split(" · ").at(-1);
  });
  const bar = scale.hidden ? null : scale.children[1].children.map((label) => label.textContent);
  const texts = legend.children.map((entry) => entry.children.find((child) => typeof child === "string"));
  return { legend: texts, bar, readouts };
}

test("a channel without a unit is a heat map with a colour bar and no list of ids", () => {
  const slope = { name: "slope_x", unit: "", scale: 0.02, unknown: -128, cells: Int8Array.of(-128, -50, 0, 50) };
  const { legend, bar, readouts } = shown(slope, [[5, 5], [5, -5], [-5, -5]]);
  assert.deepEqual(legend, ["unknown"]);
  assert.deepEqual(bar, ["-1.00", "0.00", "1.00"]);
  assert.deepEqual(readouts, ["slope x 1.00", "slope x -1.00", "slope x unknown"]);
});

test("roughness and hits are heat maps with their units", () => {
  const cells = Uint8Array.of(255, 0, 100, 200);
  const roughness = { name: "roughness", unit: "m/m", scale: 2e-4, unknown: 255, cells };
  assert.deepEqual(shown(roughness, [[5, 5]]), {
    legend: ["unknown"],
    bar: ["0.0000 m/m", "0.0200 m/m", "0.0400 m/m"],
    readouts: ["roughness 0.0400 m/m"],
  });
  const hits = { name: "hits", unit: "hits", scale: 1, unknown: 0, cells: Uint8Array.of(0, 1, 7, 255) };
  assert.deepEqual(shown(hits, [[5, 5]]).bar, ["1 hits", "128 hits", "255 hits"]);
  assert.deepEqual(shown(hits, [[5, 5]]).readouts, ["hits 255 hits"]);
});

test("a channel of ids has no colour bar, and the cell under the pointer shows its id", () => {
  const segment = { name: "segment", unit: "id", scale: 1, unknown: 65535, cells: Uint16Array.of(65535, 0, 4, 1200) };
  assert.deepEqual(shown(segment, [[5, 5]]), {
    legend: ["unknown", "3 ids, one colour each"],
    bar: null,
    readouts: ["segment 1,200"],
  });
});

test("cells are painted ahead up and left on the left", () => {
  const panel = newPanel();
  panel.draw(mapOf([{ ...CLASS, cells: Uint8Array.of(0, 0, 0, 1) }]), 10, null);
  const [[, [image]]] = panel.part.cells.drawn;
  const at = (column, row) => [...image.data.slice(4 * (row * SIDE + column), 4 * (row * SIDE + column) + 4)];
  assert.deepEqual([at(2, 2), at(38, 2), at(2, 38)], [[4, 5, 6, 255], [1, 2, 3, 255], [1, 2, 3, 255]]);
});

const POINTS = {
  x: Float64Array.of(0, 4, 6), y: Float64Array.of(0, 0, 2), radius: Float64Array.of(1, 2, 3), links: [[1, 0], [2, 1]],
};

// The lines and circles on the canvas of the safe paths, in pixels.
function paths(panel) {
  const steps = panel.part.paths.drawn.flatMap(([, [path]]) => path.steps);
  const of = (name) => steps.filter(([step]) => step === name).map(([, given]) => given.slice(0, 3));
  return { lines: of("lineTo"), circles: of("arc") };
}

test("a layer with safe points draws their links and radii in its place", () => {
  const panel = newPanel("safe_path");
  panel.draw(mapOf([CLASS], { safe_points: POINTS }), 10, null);
  const { lines, circles } = paths(panel);
  // A metre is two pixels: the first point is 8 pixels up, the second 12 up and 4 to the left.
  assert.deepEqual(lines.slice(0, 2), [[20, 20], [20, 12]], "each link leads to an earlier point");
  assert.deepEqual(circles.slice(0, 2), [[20, 12, 4], [16, 8, 6]], "the vehicle's own position has no circle");
});

test("safe points of another layer are drawn over a layer and removed again", () => {
  const panel = newPanel();
  panel.draw(mapOf([CLASS]), 10, null);
  assert.deepEqual(panel.part.paths.drawn, []);
  panel.draw(mapOf([CLASS]), 10, POINTS);
  assert.equal(paths(panel).lines.length, 4, "two links, each drawn dark and light");
  panel.draw(mapOf([CLASS]), 10, null);
  assert.deepEqual(panel.part.paths.drawn, []);
  panel.draw(mapOf([CLASS]), 10, POINTS);
  panel.clear();
  assert.deepEqual(panel.part.paths.drawn, [], "a refused map leaves no path");
});

test("a stale map is marked and the drivable share is named", () => {
  const panel = newPanel();
  panel.draw(mapOf([CLASS], { metrics: new Map([["drivable_share", 0.755]]) }), 0, null);
  assert.equal(panel.part.share.textContent, "75.5 % drivable");
  panel.writeStale("STALE · 2.0 s");
  assert.ok(panel.element.classList.contains("stale") && panel.part.stale.textContent.startsWith("STALE"));
});
