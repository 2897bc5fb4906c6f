// A layer -> coloured squares, as the server has them (its raster.rs) in its own Foxglove output. A Cartesian layer
// keeps its cells and its axes. A radial layer is resampled: a square shows the worst of the radial cell at its middle
// and those whose middles lie in it, so that no obstacle is lost. Unknown is worse than free.

import type { Layer, LegendEntry, Meaning } from "clearway-map";

/** The geometry of a Layer message, and what says which map it is a delta to. */
export interface LayerMessage {
  name: string;
  base_sequence?: bigint | null;
  radial?: { row_radius_m: number[]; columns: number; centre_x_m: number; centre_y_m: number } | null;
  cartesian?: {
    origin_x_m: number; origin_y_m: number; width: number; height: number; cell_m: number; yaw_rad: number;
  } | null;
}

/** Squares in rows along x, which yaw_rad turns in the ego frame. The corner of square (0, 0) lies at x_m, y_m. */
export interface Raster {
  width: number;
  height: number;
  cell_m: number;
  x_m: number;
  y_m: number;
  yaw_rad: number;
  /** Of a radial layer: the cell at the middle of each square, or NOWHERE, and the square of each cell's middle. */
  samples: { cell_at: Int32Array; square_of: Int32Array } | null;
}

/** Edge of the squares of a radial layer, in metres; most squares from the vehicle to the edge. */
const CELL_M = 0.25, CELLS_MAX = 1000;
/** The cell of a square outside the layer. */
const NOWHERE = -1;
/** The legend of a layer without classes. */
const UNCLASSED: LegendEntry[] = [{ name: "unknown", meaning: "unknown", colour: [58, 63, 70] }];
/** From the best to the worst. A meaning that is not listed is as bad as unknown. */
const RANKS: { [meaning in Meaning]?: number } = { free: 0, occupied: 2, low: 2, "not reached": 2 };
const UNKNOWN_RANK = 1;

// Tables of radial grids by their shape, which stays the same from map to map.
const RASTERS_MAX = 8;
const rasters = new Map<string, Raster>();

export function rasterOf(message: LayerMessage, layer: Layer): Raster {
  if (message.cartesian) {
    const { origin_x_m, origin_y_m, width, height, cell_m, yaw_rad } = message.cartesian;
    const cos = Math.cos(yaw_rad), sin = Math.sin(yaw_rad);
    const x_m = origin_x_m * cos + origin_y_m * sin, y_m = origin_y_m * cos - origin_x_m * sin;
    return { width, height, cell_m, x_m, y_m, yaw_rad: 0 - yaw_rad, samples: null };
  }
  const { row_radius_m, columns, centre_x_m, centre_y_m } = message.radial!;
  const key = [centre_x_m, centre_y_m, columns, ...row_radius_m].join();
  const kept = rasters.get(key);
  if (kept) return kept;
  const range_m = row_radius_m.at(-1)! + Math.max(Math.abs(centre_x_m), Math.abs(centre_y_m));
  const cell_m = Math.fround(Math.max(CELL_M, range_m / CELLS_MAX));
  const half = Math.ceil(range_m / cell_m), side = 2 * half, corner_m = -half * cell_m;
  const middle = (index: number) => corner_m + (index + 0.5) * cell_m;
  const cell_at = new Int32Array(side * side);
  for (let i = 0; i < cell_at.length; i++) {
    cell_at[i] = layer.grid.cellAt(middle(i % side), middle(Math.floor(i / side)));
  }
  const square = (m: number) => Math.min(Math.max(Math.trunc((m - corner_m) / cell_m), 0), side - 1);
  const square_of = Int32Array.from({ length: row_radius_m.length * columns }, (_, cell) => {
    const row = Math.floor(cell / columns), azimuth = (((cell % columns) + 0.5) / columns) * 2 * Math.PI;
    const r = 0.5 * ((row > 0 ? row_radius_m[row - 1]! : 0) + row_radius_m[row]!);
    return square(r * Math.sin(azimuth) + centre_y_m) * side + square(r * Math.cos(azimuth) + centre_x_m);
  });
  const samples = { cell_at, square_of };
  const raster = { width: side, height: side, cell_m, x_m: corner_m, y_m: corner_m, yaw_rad: 0, samples };
  if (rasters.size >= RASTERS_MAX) rasters.clear();
  rasters.set(key, raster);
  return raster;
}

/** Red, green, blue and alpha of each square; one outside a radial layer is transparent. */
export function rgbaOf({ width, height, samples }: Raster, layer: Layer): Uint8Array {
  const [rows, columns] = layer.grid.shape, decoded = layer.cells("class");
  const classes = decoded ?? new Uint8Array(rows * columns);
  const legend = decoded ? layer.legend : UNCLASSED;
  const colours = Uint32Array.from(legend, ({ colour: [red, green, blue] }) => rgba(red, green, blue));
  const shown = samples?.cell_at.slice();
  if (samples && shown) {
    const ranks = legend.map(({ meaning }) => RANKS[meaning] ?? UNKNOWN_RANK);
    const rank = (cell: number) => (cell === NOWHERE ? NOWHERE : ranks[classes[cell]!]!);
    samples.square_of.forEach((square, cell) => {
      if (rank(cell) > rank(shown[square]!)) shown[square] = cell;
    });
  }
  const squares = new Uint32Array(width * height);
  for (let i = 0; i < squares.length; i++) {
    const cell = shown ? shown[i]! : i;
    if (cell !== NOWHERE) squares[i] = colours[classes[cell]!]!;
  }
  return new Uint8Array(squares.buffer);
}

// As the bytes lie on every machine that Foxglove runs on, which are little-endian.
const rgba = (red: number, green: number, blue: number) => ((255 << 24) | (blue << 16) | (green << 8) | red) >>> 0;
