// In: a map, and what a reader wants to see of it. Out: a frame: the raster of pixels, its legend, the safe points and
// the values of one cell. Runs in the Worker; everything in a frame can be posted.
//
// show: { base: { layer, channel }, overlays: [layer], road: true if classes named "road" are drawn over the base,
// safe_points: true if they are wanted, by_meaning: true for colours by meaning, space: true for the view in 3-D, whose
// frame has `space` (space/cells.js) and no pixels }.

import {
  blendPixels, fadeSlices, isId, overlayColours, paintChannel, paintPixels, quietColours,
} from "./draw/paint.js";
import { legendByMeaning } from "./draw/palette.js";
import { CONFIDENCE, hasConfidence, spaceOf } from "./space/cells.js";
import { count, valueText, words } from "./text.js";
import { pixelCells } from "./wire/grid.js";

export const SAFE_PATH = "safe_path", ROAD = "road";

// ranges: the colour scales so far by layer and channel, which this changes. Throws a DecodeError for a refused layer.
export function newFrame(map, show, raster, ranges) {
  const base = map.layer(show.base.layer) ?? map.layer(map.names[0]);
  if (!base) return { base: null, pixels: null, space: null, channels: [], legend: [], bar: null, safe_points: null };
  const layer = show.by_meaning ? withLegend(base, legendByMeaning(base.legend)) : base;
  const channel = layer.channels.find(({ name }) => name === show.base.channel) ?? layer.channels[0];
  const cells = layer.cells(channel.name), key = `${layer.name} ${channel.name}`;
  const { colours, legend, range, bar } = paintChannel(layer, channel, cells, ranges.get(key) ?? null);
  ranges.set(key, range);
  const drawn = channel.name === "class" ? quietColours(layer, colours) : colours;
  const pixels = show.space ? null : new Uint32Array(raster.width * raster.height);
  if (pixels) {
    const table = pixelCells(layer.grid, raster);
    paintPixels(pixels, table, cells, drawn);
    fadeSlices(pixels, table, layer.grid);
    for (const name of show.overlays) drawOver(map.layer(name), ({ meaning }) => meaning !== "unknown");
    if (show.road) for (const name of map.names) drawOver(map.layer(name), (entry) => entry.name === ROAD);
  }
  const space = show.space ? spaceOf(map, layer, channel, cells, drawn, show) : null;
  if (space && hasConfidence(layer, channel)) legend.push(...CONFIDENCE);
  return {
    base: { layer: layer.name, channel: channel.name },
    channels: layer.channels.map(({ name }) => name),
    pixels, space, legend, bar,
    radius_m: layer.grid.radius_m,
    safe_points: show.safe_points ? (map.layer(SAFE_PATH)?.safe_points ?? null) : null,
  };

  function drawOver(over, is_drawn) {
    const classes = over?.cells("class");
    if (!classes || !over.legend.some(is_drawn)) return;
    const legend = show.by_meaning ? legendByMeaning(over.legend) : over.legend;
    blendPixels(pixels, pixelCells(over.grid, raster), classes, overlayColours(legend, is_drawn));
  }
}

const withLegend = (layer, legend) => ({
  name: layer.name, planes: layer.planes, grid: layer.grid, legend, channels: layer.channels,
  cells: (name) => layer.cells(name),
});

// Every value of the cell at a point of the ego frame, by layer: [{ layer, cell, values: [[channel, text, raw]] }].
// cell is -1 outside the layer's grid.
export function cellValues(map, { x, y }) {
  return map.names.map((name) => {
    const layer = map.layer(name), cell = layer.grid.cellAt(x, y);
    const values = cell < 0 ? [] : layer.channels.map((channel) => {
      const raw = layer.cells(channel.name)[cell];
      return [words(channel.name), cellText(layer, channel, raw), raw];
    });
    return { layer: name, cell, values };
  });
}

function cellText(layer, channel, raw) {
  if (channel.name === "class") return words(layer.legend[raw].name);
  if (raw === channel.unknown) return "unknown";
  return isId(channel) ? count(raw) : valueText(raw * channel.scale, channel);
}
