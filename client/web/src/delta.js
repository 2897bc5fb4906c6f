// In: a layer that is a delta, and the map before it. Out: the cells that its changes start from, or a DecodeError that
// says why the map before is not its base. Format: proto/clearway/v1/map.proto, Layer.base_sequence.

import { DecodeError } from "./limits.js";

// The layer of map `base` that the delta `layer` starts from; null if `layer` is whole. header: of the map of `layer`.
export function baseLayer(layer, header, base) {
  if ((layer.base_sequence ?? null) === null) return null;
  if (!base) throw new DecodeError("no_base", `layer ${layer.name} is a delta to that of map ${layer.base_sequence}`);
  const needed = [header.vehicle, header.boot_id, layer.base_sequence].join();
  const given = [base.header.vehicle, base.header.boot_id, base.header.sequence].join();
  if (needed !== given) {
    throw new DecodeError("other_base", `layer ${layer.name} is a delta to ${needed}; the map before is ${given}`);
  }
  const before = base.layer(layer.name);
  if (!before) throw new DecodeError("no_base", `layer ${layer.name} is a delta, and its base has no such layer`);
  return before;
}

// The base of one channel of a delta: a function from an array type to the base's cells at the same places, `unknown`
// where the base has none. layer: its name. grid: its grid. before: the layer it starts from.
export function baseCells(layer, grid, before, { name, unknown }) {
  const misfit = (what) => new DecodeError("base_shape", `layer ${layer}: ${what} than its base has`);
  if (before.grid.kind !== grid.kind) throw misfit("another grid");
  // Grids farther apart than this share no cell, so how far apart they are does not matter.
  const far = 2n ** 32n, clamp = (by) => Number(by > far ? far : by < -far ? -far : by);
  const [down, along] = [0, 1].map((i) => clamp(grid.first[i] - before.grid.first[i]));
  const [rows, columns] = grid.shape, [rows_before, columns_before] = before.grid.shape;
  const start = Math.max(0, -along), end = Math.min(columns, columns_before - along);
  const cells_before = before.cells(name);
  return (Cells) => {
    if (!(cells_before instanceof Cells)) throw misfit(`another channel ${name}`);
    const cells = new Cells(rows * columns).fill(unknown);
    for (let row = Math.max(0, -down); row < Math.min(rows, rows_before - down) && start < end; row++) {
      const from = (row + down) * columns_before + along;
      cells.set(cells_before.subarray(from + start, from + end), row * columns + start);
    }
    return cells;
  };
}
