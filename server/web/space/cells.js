// In: a map, and what a reader wants to see of it (frame.js). Out: the quads of its cells, for the view in 3-D. Runs in
// the Worker.
//
// Each cell is a quad in the plane of its ground (ground.js). Around cells of a class in OBSTACLES stands an outline,
// as high as the layer says, else OBSTACLE_M, and seen through but for its rim. Unknown cells are not drawn. Neighbours
// of one colour in one plane are one quad; only terrain's quads are drawn one by one, as in Neuhaus 2009, figure 4.

import { overlayColours } from "../draw/paint.js";
import { legendByMeaning, word } from "../draw/palette.js";
import { groundOf } from "./ground.js";
import { QuadList } from "./quads.js";

const OBSTACLES = ["obstacle", "occupied"], ROAD = "road";
// Height of an obstacle whose layer has no height (terrain, speed). It stands for "not flat", as a red box of
// Neuhaus 2009, figure 4. Height of an outline's rim.
const OBSTACLE_M = 0.5, RIM_M = 0.08;
// Channels with the height of what stands in a cell, metres.
const RISE = ["unit_height", "difference"];
// What lies over the shown layer, is drawn so far over it, metres.
const OVERLAY_M = 0.04, ROAD_M = 0.08, PATH_M = 0.16, PATH_WIDTH_M = 0.3;
const HALF = 0x80000000, QUARTER = 0x40000000, PATH = word([255, 225, 77]);

// The colours of hits, from one to HITS_MAX: from crimson to red (Seo 2014, figure 6).
const HITS = "hits", HITS_MAX = 255, CRIMSON = [112, 10, 52], RED = [255, 36, 28];

const confidence = (hits) => CRIMSON.map((low, k) => Math.round(low + ((RED[k] - low) * hits) / HITS_MAX));

// The entries of the legend of a layer with hits.
export const CONFIDENCE = [[confidence(1), "1 hit, least confidence"], [confidence(255), "occupied, 255 hits"]];

// True if this layer's cells have the colours of their hits.
export const hasConfidence = (layer, channel) =>
  channel.name === "class" && layer.channels.some(({ name }) => name === HITS);

// { bytes: of a QuadList, count, source: of groundOf }. cells, colours: of the shown channel, as in paint.js.
export function spaceOf(map, layer, channel, cells, colours, show) {
  const ground = groundOf(map), quads = new QuadList(4096), outlines = new QuadList(1024);
  const low = cells instanceof Int8Array ? -128 : 0;
  const hits = hasConfidence(layer, channel) ? layer.cells(HITS) : null;
  const is_unknown = channel.name === "class"
    ? (raw) => layer.legend[raw].meaning === "unknown"
    : (raw) => raw === channel.unknown;
  pushCells(quads, outlines, ground, layer, 0, (cell) => {
    if (hits && hits[cell] > 0) return word(confidence(hits[cell]));
    return is_unknown(cells[cell]) ? 0 : colours[cells[cell] - low];
  });
  const pushOver = (over, lift, is_drawn, see) => {
    const classes = over?.cells("class");
    if (!classes || !over.legend.some(is_drawn)) return;
    const colour_of = overlayColours(show.by_meaning ? legendByMeaning(over.legend) : over.legend, is_drawn);
    pushCells(quads, outlines, ground, over, lift, (cell) => see(colour_of[classes[cell]]));
  };
  const half = (colour) => (colour === 0 ? 0 : ((colour & 0xffffff) | HALF) >>> 0);
  for (const name of show.overlays) pushOver(map.layer(name), OVERLAY_M, ({ meaning }) => meaning !== "unknown", half);
  const is_road = ({ name }) => name === ROAD;
  if (show.road) for (const name of map.names) pushOver(map.layer(name), ROAD_M, is_road, (colour) => colour);
  if (show.safe_points) pushPaths(quads, ground, map.layer("safe_path")?.safe_points);
  // What is seen through comes after what is seen there.
  quads.append(outlines);
  return { bytes: quads.bytes, count: quads.count, source: ground.source };
}

// colourOf(cell): an ImageData word; 0 draws nothing.
function pushCells(quads, outlines, ground, layer, lift, colourOf) {
  const { grid } = layer, [rows, columns] = grid.shape, xy = new Float64Array(8);
  const classes = layer.cells("class"), stands = layer.legend.map(({ name }) => OBSTACLES.includes(name));
  const rise = riseOf(layer);
  const is_merged = grid.is_straight && layer.name !== "terrain", run = new Float64Array(8);
  let run_colour = 0, run_plane = null;
  const endRun = () => {
    if (run_colour !== 0) quads.pushInPlane(run, run_plane, lift, run_colour);
    run_colour = 0;
  };
  for (let cell = 0; cell < rows * columns; cell++) {
    if (cell % columns === 0) endRun();
    const colour = colourOf(cell);
    if (colour === 0) {
      endRun();
      continue;
    }
    grid.corners(cell, xy);
    const plane = ground.planeAt((xy[0] + xy[4]) / 2, (xy[1] + xy[5]) / 2);
    if (classes && stands[classes[cell]]) {
      const height = rise(cell) + lift, glass = ((colour & 0xffffff) | QUARTER) >>> 0;
      neighbours(grid, cell).forEach((next, edge) => {
        if (stands[classes[next]]) return;
        outlines.pushSide(xy, edge, plane, 0, height - RIM_M, glass);
        outlines.pushSide(xy, edge, plane, height - RIM_M, height, colour);
      });
    }
    if (is_merged && colour === run_colour && plane === run_plane) {
      for (let i = 2; i < 6; i++) run[i] = xy[i];
    } else {
      endRun();
      run.set(xy);
      [run_colour, run_plane] = [colour, plane];
    }
  }
  endRun();
}

// The cells beyond the edges of a cell, from corner 0 on; -1 outside the grid.
function neighbours({ is_straight, shape: [rows, columns] }, cell) {
  const column = cell % columns, up = cell + columns < rows * columns ? cell + columns : -1, down = cell - columns;
  if (is_straight) return [down, column + 1 < columns ? cell + 1 : -1, up, column > 0 ? cell - 1 : -1];
  const turned = (by) => cell - column + ((column + by + columns) % columns);
  return [turned(-1), up, turned(1), down];
}

// The height of what stands in a cell of a layer, metres.
function riseOf(layer) {
  const channel = layer.channels.find(({ name }) => RISE.includes(name)), cells = channel && layer.cells(channel.name);
  if (!cells) return () => OBSTACLE_M;
  return (cell) => (cells[cell] === channel.unknown ? OBSTACLE_M : Math.max(cells[cell] * channel.scale, 0.1));
}

function pushPaths(quads, ground, points) {
  if (!points) return;
  const at = (i) => {
    const [x, y] = [points.x[i], points.y[i]], [a, b, c] = ground.planeAt(x, y);
    return [x, y, a * x + b * y + c + PATH_M];
  };
  for (const [from, to] of points.links) quads.pushLine(at(from), at(to), PATH_WIDTH_M, PATH);
}
