// In: one channel of a layer. Out: the colour of each raw value, and the legend to the colours.

import { valueText, words } from "../text.js";
import { idColour, scaleColour, UNKNOWN, word } from "./palette.js";

// The least raw value of an array type: a colour table is indexed by raw value minus this.
const least = (cells) => (cells instanceof Int8Array ? -128 : 0);
const tableLength = (cells) => 2 ** (8 * cells.BYTES_PER_ELEMENT);

// True if the values of a channel are ids: only their equality means something.
export const isId = ({ unit }) => unit === "id";

// { colours, legend, range, bar }. colours: an ImageData word for each raw value. legend: [[colour or null, text,
// share?, meaning?]]. The wire gives the classes' colours and meanings; the meaning of "unknown" holds for every
// channel. range: [least, greatest] value shown so far in the channel's unit, which `range` was before this map, or
// null. bar: the texts of a colour bar's ends and middle, from the least value to the greatest; null if the channel has
// none.
export function paintChannel(layer, channel, cells, range) {
  if (channel.name === "class") return paintClasses(layer, cells);
  const unknown_colour = layer.legend[0]?.colour ?? UNKNOWN;
  return isId(channel)
    ? paintIds(channel, cells, unknown_colour)
    : paintScale(channel, cells, range, unknown_colour);
}

// Writes the colour of each pixel's cell; transparent outside the grid. table: from pixels to cells, of grid.js.
export function paintPixels(pixels, table, cells, colours) {
  const low = least(cells);
  for (let i = 0; i < table.length; i++) pixels[i] = table[i] < 0 ? 0 : colours[cells[table[i]] - low];
}

// The colours of classes as they are drawn: cells that no sensor saw do not lead the eye.
const QUIET = 0.5;
export const isQuiet = (meaning) => meaning === "unknown" || meaning === "hidden";

export function quietColours(layer, colours) {
  const drawn = colours.slice();
  layer.legend.forEach(({ meaning }, value) => {
    if (isQuiet(meaning)) drawn[value] = (colours[value] & 0xffffff) | (Math.round(255 * QUIET) << 24);
  });
  return drawn;
}

// The length of a cell, in metres, from which it is fainter the longer it is, and how faint at most: a slice of 20 m
// says little, and must not lead the eye.
const PLAIN_M = 2, FAINTEST = 0.25;

// Makes the long slices of a radial layer faint.
export function fadeSlices(pixels, table, { is_straight, shape: [rows, columns], corners }) {
  if (is_straight) return;
  const opacity = new Float64Array(rows), xy = new Float64Array(8);
  for (let row = 0; row < rows; row++) {
    corners(row * columns, xy);
    const length_m = Math.hypot(xy[2] - xy[0], xy[3] - xy[1]);
    opacity[row] = Math.min(Math.max(PLAIN_M / length_m, FAINTEST), 1);
  }
  for (let i = 0; i < table.length; i++) {
    if (table[i] < 0) continue;
    const alpha = (pixels[i] >>> 24) * opacity[Math.floor(table[i] / columns)];
    pixels[i] = (pixels[i] & 0xffffff) | (alpha << 24);
  }
}

// Draws a layer over pixels that are painted: half of its colour and half of theirs. colours: an ImageData word for
// each raw value, 0 for values that leave a pixel as it is.
export function blendPixels(pixels, table, cells, colours) {
  const low = least(cells), half = 0x7f7f7f7f;
  for (let i = 0; i < table.length; i++) {
    const over = table[i] < 0 ? 0 : colours[cells[table[i]] - low];
    if (over !== 0) pixels[i] = (((over >>> 1) & half) + ((pixels[i] >>> 1) & half)) | 0xff000000;
  }
}

// The colours of the classes of a layer that is drawn over another layer: of the classes with `is_drawn(class)`.
export function overlayColours(legend, is_drawn) {
  const colours = new Uint32Array(256);
  legend.forEach((entry, value) => {
    if (is_drawn(entry)) colours[value] = word(entry.colour);
  });
  return colours;
}

function paintClasses(layer, cells) {
  const counts = new Uint32Array(tableLength(cells)), colours = new Uint32Array(tableLength(cells)), low = least(cells);
  for (let i = 0; i < cells.length; i++) counts[cells[i] - low]++;
  const legend = layer.legend.map(({ name, meaning, colour }, value) => {
    colours[value - low] = word(colour);
    return [colour, words(name), counts[value - low] / cells.length, meaning];
  });
  return { colours, legend, range: null, bar: null };
}

function paintIds({ unknown }, cells, unknown_colour) {
  const used = new Uint8Array(tableLength(cells)), colours = new Uint32Array(tableLength(cells)), low = least(cells);
  let unknown_count = 0, ids = 0;
  for (let i = 0; i < cells.length; i++) {
    if (cells[i] === unknown) unknown_count++;
    else used[cells[i] - low] = 1;
  }
  for (let i = 0; i < used.length; i++) {
    if (!used[i]) continue;
    ids++;
    colours[i] = word(idColour(i + low));
  }
  if (unknown_count > 0) colours[unknown - low] = word(unknown_colour);
  const legend = [unknownEntry(unknown_colour, unknown_count, cells), [null, `${ids} ids, one colour each`]];
  return { colours, legend, range: null, bar: null };
}

function paintScale(channel, cells, range, unknown_colour) {
  const { scale, unknown } = channel;
  const colours = new Uint32Array(tableLength(cells)), low = least(cells);
  let unknown_count = 0, lowest = Infinity, highest = -Infinity;
  for (let i = 0; i < cells.length; i++) {
    const cell = cells[i];
    if (cell === unknown) {
      unknown_count++;
      continue;
    }
    if (cell < lowest) lowest = cell;
    if (cell > highest) highest = cell;
  }
  // The range only grows while a channel is shown, so that a colour keeps its meaning from map to map.
  if (lowest <= highest) {
    range = [Math.min(range?.[0] ?? Infinity, lowest * scale), Math.max(range?.[1] ?? -Infinity, highest * scale)];
  }
  const [from, to] = range ?? [0, 0];
  for (let raw = lowest; raw <= highest; raw++) {
    colours[raw - low] = word(scaleColour(to > from ? (raw * scale - from) / (to - from) : 0.5));
  }
  if (unknown_count > 0) colours[unknown - low] = word(unknown_colour);
  const values = to > from ? [from, (from + to) / 2, to] : [from];
  const bar = range && values.map((value) => valueText(value, channel));
  return { colours, legend: [unknownEntry(unknown_colour, unknown_count, cells)], range, bar };
}

const unknownEntry = (colour, unknown_count, cells) => [colour, "unknown", unknown_count / cells.length, "unknown"];
