// In: a layer that is a delta, and the opened map it stands on. Out: what predicts its cells, or a Refused error that names
// why this map is not its base. Format: proto/clearway/v1/map.proto, Layer.base_sequence.

import { Refused } from "./codec.js";

// The layer of `base` that `layer`, of the map with this header, stands on; null for a whole layer.
export function baseOf(layer, header, base) {
  if (layer.base_sequence === null) return null;
  if (!base) throw new Refused("no_base", `layer ${layer.name} is a delta to that of map ${layer.base_sequence}`);
  const needed = [header.vehicle, header.boot_id, layer.base_sequence].join();
  const given = [base.header.vehicle, base.header.boot_id, base.header.sequence].join();
  if (needed !== given) throw new Refused("other_base", `layer ${layer.name} is a delta to ${needed}; the held map is ${given}`);
  const before = base.layers.find(({ name }) => name === layer.name);
  if (!before) throw new Refused("no_base", `layer ${layer.name} is a delta, and not in its base`);
  return before;
}

// For one channel of a grid: (type of array) -> predicted cells, those of the same place in the base, else unknown.
export function predictor(layer, grid, before, channel) {
  const misfit = (what) => new Refused("base_shape", `layer ${layer}: ${what} than its base has`);
  if (before.grid.kind !== grid.kind) throw misfit("another grid");
  // A number so far from its base's that the grids share nothing is as good as any other.
  const far = 2n ** 32n, clamp = (by) => Number(by > far ? far : by < -far ? -far : by);
  const by = [0, 1].map((i) => clamp(grid.first[i] - before.grid.first[i]));
  const spans = [0, 1].map((i) => {
    const start = Math.min(Math.max(0, -by[i]), grid.shape[i]);
    return [start, Math.max(start, Math.min(grid.shape[i], before.grid.shape[i] - by[i]))];
  });
  const cells_before = before.channels.find(({ name }) => name === channel.name)?.cells;
  return (Cells) => {
    if (!(cells_before instanceof Cells)) throw misfit(`another channel ${channel.name}`);
    const cells = new Cells(grid.cells).fill(channel.unknown);
    const [[row_start, row_end], [column_start, column_end]] = spans;
    for (let row = row_start; row < row_end && column_start < column_end; row++) {
      const from = (row + by[0]) * before.grid.shape[1] + by[1];
      cells.set(cells_before.subarray(from + column_start, from + column_end), row * grid.shape[1] + column_start);
    }
    return cells;
  };
}
