// Frames follow REP-103: x forward, y left, metres, the origin on the ground under the vehicle. Stamps are ns since the
// Unix epoch.

/** What a class means to a planner; `ClassMeaning` of map.proto defines each. Only `free` may be entered. */
export type Meaning = "unknown" | "free" | "inferred" | "occupied" | "hidden" | "not reached" | "low";

export interface LegendEntry {
  name: string;
  meaning: Meaning;
  /** Red, green and blue, 0 to 255. */
  colour: [number, number, number];
}

export interface Pose { x: number; y: number; z: number; qx: number; qy: number; qz: number; qw: number }

/** `Header` of map.proto. */
export interface Header {
  vehicle: string;
  boot_id: bigint;
  sequence: bigint;
  capture_start_ns: bigint;
  capture_end_ns: bigint;
  completed_ns: bigint;
  /** The map is stale after this time: a planner must not use it any more. */
  valid_until_ns: bigint;
  map_from_ego: Pose | null;
  speed_mps: number | null;
  sensors: Record<string, unknown>[];
  compensation: string;
  wire_version: number;
}

export interface Grid {
  /** Rows and columns. A cell has the index row * columns + column. */
  shape: [number, number];
  /** Index of the cell at a point of the ego frame; -1 outside the grid. */
  cellAt(x_m: number, y_m: number): number;
  /** Writes x0, y0 ... x3, y3, the corners of a cell in the ego frame, into `xy`. */
  corners(cell: number, xy: Float64Array | number[]): void;
}

export interface Channel { name: string; unit: string; scale: number; unknown: number }

export interface SafePoints { x: Float64Array; y: Float64Array; radius: Float64Array; links: [number, number][] }

export interface Layer {
  name: string;
  grid: Grid;
  /** By the value of the channel `class`. Class 0 is unknown. */
  legend: LegendEntry[];
  /** Of a map that another decoder read: as that decoder has it. */
  metrics: Map<string, number>;
  channels: Channel[];
  planes: { a: number; b: number; c: number }[];
  safe_points: SafePoints | null;
  /** Raw cells of a channel, row by row; times `scale` they are in `unit`. `null` if the layer has no such channel. */
  cells(channel: string): Uint8Array | Int8Array | Uint16Array | null;
}

/** A map. Layers are decoded at the first access, which may throw a `DecodeError`. */
export class LiveMap {
  /**
   * `map`: an encoded `clearway.v1.Map`, or that message as another protobuf decoder read it: the field names of
   * map.proto, 64-bit numbers as bigint, bytes as Uint8Array. `base`: the map that deltas start from.
   */
  constructor(map: Uint8Array | object, base?: LiveMap | null);
  readonly header: Header;
  readonly names: string[];
  /** Bytes of the encoded map; 0 of a message. */
  readonly length: number;
  /** `base`: as for the constructor, for this layer alone. */
  layer(name: string, base?: LiveMap | null): Layer | null;
}

/** `Plan` of journal.proto, in the ego frame of the map that it came with. */
export interface Plan {
  planner: string;
  x: number[];
  y: number[];
  heading_rad: number[];
  footprint_m: number[];
  goal: { x: number; y: number } | null;
  text: string;
}

/** Opens a `MapUpdate` of MapService. */
export function openUpdate(
  message: Uint8Array, base?: LiveMap | null,
): { skipped: bigint; left_out: bigint; sent_ns: bigint; map: LiveMap; plan: Plan | null };

/** An invalid map. `reason` is the name of the fault in the golden vectors. */
export class DecodeError extends Error {
  readonly reason: string;
  constructor(reason: string, detail: string);
}

/** Bytes that are no protobuf. `reason` is `protobuf`. */
export class WireError extends DecodeError {
  constructor(detail: string);
}
