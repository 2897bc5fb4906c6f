// In: a layer's geometry (radial or Cartesian, ego frame: x forward, y left, metres). Out: the cell under a point, and
// a table pixel -> cell for a square canvas with the vehicle in the middle, forward up and left left.
// The table is computed once a geometry and size; after that a map costs one look-up a pixel.

import { CELLS_MAX, Refused } from "./codec.js";

// A checked geometry: { key, cells, radius_m, cellAt(x, y) -> cell index or -1 }, and for deltas { kind: equal where cells are
// comparable, shape: [rows, columns], first: [number of the first row, of the first column] }.
export function gridOf(layer) {
  if (layer.radial) return radial(layer.radial);
  if (layer.cartesian) return cartesian(layer.cartesian);
  throw new Refused("geometry", `layer ${layer.name} has none; allowed are radial, cartesian`);
}

function radial({ r_bench_m, columns }) {
  const rows = r_bench_m.length, cells = rows * columns;
  if (rows === 0 || columns === 0) throw new Refused("geometry", `${rows} rows of ${columns} columns; at least 1 each`);
  if (cells > CELLS_MAX) throw new Refused("geometry", `${rows} x ${columns} cells; at most ${CELLS_MAX}`);
  r_bench_m.forEach((bench, j) => {
    const inner = j ? r_bench_m[j - 1] : 0;
    if (!(bench > inner && bench < Infinity)) {
      throw new Refused("geometry", `bench ${j} is ${bench} m; it must be finite and over ${inner} m`);
    }
  });
  const benches = Float64Array.from(r_bench_m);
  const turn = 2 * Math.PI, perRadian = columns / turn;
  const rowAt = (r) => {
    let low = 0, high = rows;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (r <= benches[middle]) high = middle;
      else low = middle + 1;
    }
    return low;
  };
  const cellAt = (x, y) => {
    const row = rowAt(Math.hypot(x, y));
    if (row === rows) return -1;
    const azimuth = Math.atan2(y, x);
    const column = Math.floor((azimuth < 0 ? azimuth + turn : azimuth) * perRadian);
    return row * columns + Math.min(column, columns - 1);
  };
  const key = `radial ${columns} ${r_bench_m.join()}`;
  return { key, cells, radius_m: benches[rows - 1], cellAt, kind: key, shape: [rows, columns], first: [0n, 0n] };
}

function cartesian({ origin_x_m, origin_y_m, width, height, cell_m, yaw_rad, first_ix = 0n, first_iy = 0n }) {
  const cells = width * height;
  if (cells === 0 || cells > CELLS_MAX) {
    throw new Refused("geometry", `${width} x ${height} cells; allowed are 1 to ${CELLS_MAX}`);
  }
  if (!(cell_m > 0 && cell_m < Infinity)) throw new Refused("geometry", `cell_m is ${cell_m}; it must be over 0`);
  if (!Number.isFinite(origin_x_m + origin_y_m + yaw_rad)) {
    throw new Refused("geometry", `origin is (${origin_x_m}, ${origin_y_m}) m, yaw ${yaw_rad} rad; they must be finite`);
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
  return { key, cells, radius_m, cellAt, kind: `cartesian ${cell_m}`, shape: [height, width], first: [first_iy, first_ix] };
}

// Ego metres at the middle of a pixel of a canvas `size` pixels wide that shows `view_m` to every side.
export function egoAt(px, py, size, view_m) {
  const metres = (2 * view_m) / size;
  return { x: (size / 2 - py - 0.5) * metres, y: (size / 2 - px - 0.5) * metres };
}

// Layers of one map mostly share a geometry, so their panels share a table. A view change makes new ones, and so does each
// map of a grid that turns under the vehicle; the table used longest ago goes.
const TABLES_KEPT = 4;
const tables = new Map();

export function pixelCells(grid, size, view_m) {
  const key = `${size} ${view_m} ${grid.key}`;
  let table = tables.get(key);
  if (!table) {
    table = new Int32Array(size * size);
    for (let py = 0, i = 0; py < size; py++) {
      for (let px = 0; px < size; px++, i++) {
        const { x, y } = egoAt(px, py, size, view_m);
        table[i] = grid.cellAt(x, y);
      }
    }
    if (tables.size >= TABLES_KEPT) tables.delete(tables.keys().next().value);
  }
  tables.delete(key);
  tables.set(key, table);
  return table;
}
