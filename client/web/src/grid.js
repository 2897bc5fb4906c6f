// In: the geometry of a layer, radial or Cartesian (ego frame: x forward, y left, metres). Out: the cell at a point,
// and a table from the pixels of a raster to cells. The table is computed once for each geometry and raster; then a map
// costs one look-up a pixel.

import { DecodeError } from "./limits.js";

// How many cells a grid may have is checked as its layer opens: each channel has as many (codec.js).
//
// { key, radius_m, cellAt(x, y) -> the cell's index or -1, fill(table, raster), corners(cell, xy):
// writes x0, y0 ... x3, y3, in order around the cell, is_straight: true if the cells of a row are one rectangle, with
// corners 0 and 3 of its first cell and 1 and 2 of its last }, and for deltas { kind: equal if cells
// are comparable,
// shape: [rows, columns], first: [number of the first row, of the first column] }.
export function gridOf(layer) {
  if (layer.radial) return radial(layer.radial);
  if (layer.cartesian) return cartesian(layer.cartesian);
  throw new DecodeError("geometry", `layer ${layer.name} has none; allowed are radial, cartesian`);
}

function radial({ row_radius_m, columns, centre_x_m = 0, centre_y_m = 0 }) {
  const rows = row_radius_m.length;
  if (rows === 0 || columns === 0) {
    throw new DecodeError("geometry", `${rows} rows of ${columns} columns; at least 1 of each is needed`);
  }
  row_radius_m.forEach((outer, row) => {
    const inner = row ? row_radius_m[row - 1] : 0;
    if (!(outer > inner && outer < Infinity)) {
      throw new DecodeError("geometry", `row radius ${row} is ${outer} m; it must be finite and over ${inner} m`);
    }
  });
  if (!Number.isFinite(centre_x_m + centre_y_m)) {
    throw new DecodeError("geometry", `centre is (${centre_x_m}, ${centre_y_m}) m; it must be finite`);
  }
  const radii = Float64Array.from(row_radius_m), perRadian = columns / (2 * Math.PI);
  const rowAt = (r) => {
    let low = 0, high = rows;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (r <= radii[middle]) high = middle;
      else low = middle + 1;
    }
    return low;
  };
  const cellAt = (ego_x, ego_y) => {
    const x = ego_x - centre_x_m, y = ego_y - centre_y_m;
    const row = rowAt(Math.hypot(x, y));
    if (row === rows) return -1;
    const azimuth = Math.atan2(y, x);
    const column = Math.floor((azimuth < 0 ? azimuth + 2 * Math.PI : azimuth) * perRadian);
    return row * columns + Math.min(column, columns - 1);
  };
  const key = `radial ${centre_x_m} ${centre_y_m} ${columns} ${row_radius_m.join()}`;
  const radius_m = radii[rows - 1] + Math.max(Math.abs(centre_x_m), Math.abs(centre_y_m));
  const fill = (table, raster) => {
    for (let py = 0, i = 0; py < raster.height; py++) {
      const x = raster.x_m + (raster.height / 2 - py - 0.5) * raster.metres;
      const left = raster.y_m + (raster.width / 2 - 0.5) * raster.metres;
      for (let px = 0; px < raster.width; px++, i++) table[i] = cellAt(x, left - px * raster.metres);
    }
  };
  const corners = (cell, xy) => {
    const row = Math.floor(cell / columns), from = (cell % columns) / perRadian, to = from + 1 / perRadian;
    const inner = row ? radii[row - 1] : 0, outer = radii[row];
    for (let i = 0; i < 4; i++) {
      const radius = i === 1 || i === 2 ? outer : inner, azimuth = i >= 2 ? to : from;
      xy[2 * i] = centre_x_m + radius * Math.cos(azimuth);
      xy[2 * i + 1] = centre_y_m + radius * Math.sin(azimuth);
    }
  };
  return { key, radius_m, cellAt, fill, corners, is_straight: false, kind: key, shape: [rows, columns],
    first: [0n, 0n] };
}

function cartesian({ origin_x_m, origin_y_m, width, height, cell_m, yaw_rad, first_ix = 0n, first_iy = 0n }) {
  if (width === 0 || height === 0) throw new DecodeError("geometry", `${width} x ${height} cells; at least 1 x 1`);
  if (!(cell_m > 0 && cell_m < Infinity)) throw new DecodeError("geometry", `cell_m is ${cell_m}; it must be over 0`);
  if (!Number.isFinite(origin_x_m + origin_y_m + yaw_rad)) {
    const what = `origin is (${origin_x_m}, ${origin_y_m}) m, yaw ${yaw_rad} rad; they must be finite`;
    throw new DecodeError("geometry", what);
  }
  const cos = Math.cos(yaw_rad), sin = Math.sin(yaw_rad);
  const cellAt = (x, y) => {
    const ix = Math.floor((x * cos - y * sin - origin_x_m) / cell_m);
    const iy = Math.floor((x * sin + y * cos - origin_y_m) / cell_m);
    return ix >= 0 && ix < width && iy >= 0 && iy < height ? iy * width + ix : -1;
  };
  const edges = [origin_x_m, origin_x_m + width * cell_m, origin_y_m, origin_y_m + height * cell_m];
  const key = `cartesian ${origin_x_m} ${origin_y_m} ${width} ${height} ${cell_m} ${yaw_rad}`;
  const radius_m = Math.max(...edges.map(Math.abs));
  // From pixel to pixel a position in the grid moves by a constant, so this costs two additions a pixel.
  const fill = (table, raster) => {
    const step = raster.metres / cell_m;
    for (let py = 0, i = 0; py < raster.height; py++) {
      const { x, y } = egoAt(raster, 0, py);
      let across = (x * cos - y * sin - origin_x_m) / cell_m, along = (x * sin + y * cos - origin_y_m) / cell_m;
      for (let px = 0; px < raster.width; px++, i++, across += sin * step, along -= cos * step) {
        const ix = Math.floor(across), iy = Math.floor(along);
        table[i] = ix >= 0 && ix < width && iy >= 0 && iy < height ? iy * width + ix : -1;
      }
    }
  };
  const corners = (cell, xy) => {
    const left = origin_x_m + (cell % width) * cell_m, low = origin_y_m + Math.floor(cell / width) * cell_m;
    for (let i = 0; i < 4; i++) {
      const across = left + (i === 1 || i === 2 ? cell_m : 0), along = low + (i >= 2 ? cell_m : 0);
      xy[2 * i] = across * cos + along * sin;
      xy[2 * i + 1] = along * cos - across * sin;
    }
  };
  const shape = [height, width], first = [first_iy, first_ix];
  return { key, radius_m, cellAt, fill, corners, is_straight: true, kind: `cartesian ${cell_m}`, shape, first };
}

// A raster is a picture of the ego frame, forward up, left on the left: { width, height: pixels, x_m, y_m: of its
// middle in the ego frame, metres: a pixel's side }.

// The ego coordinates of the middle of a pixel.
export function egoAt({ width, height, x_m, y_m, metres }, px, py) {
  return { x: x_m + (height / 2 - py - 0.5) * metres, y: y_m + (width / 2 - px - 0.5) * metres };
}

// The layers of one map mostly share a geometry, so their tables are kept. A new raster makes new tables, and so does
// each map of a grid that turns under the vehicle; the table that was not used for the longest time is dropped.
const TABLES_MAX = 4;
const tables = new Map();

// The index of the cell in the middle of each pixel of a raster, row by row from the upper left; -1 outside the grid.
export function pixelCells(grid, raster) {
  const { width, height, x_m, y_m, metres } = raster;
  const key = `${width} ${height} ${x_m} ${y_m} ${metres} ${grid.key}`;
  let table = tables.get(key);
  if (!table) {
    table = new Int32Array(width * height);
    grid.fill(table, raster);
    if (tables.size >= TABLES_MAX) tables.delete(tables.keys().next().value);
  }
  tables.delete(key);
  tables.set(key, table);
  return table;
}
