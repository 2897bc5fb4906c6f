// In: a layer that is a delta, and the opened map it stands on. Out: what its channels change, or a Refused error that
// names why this map is not its base. Format: proto/clearway/v1/map.proto, Layer.base_sequence.

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

// What the changes of a channel change: (type of array) -> the cells of the same place in the base, else unknown.
export function beforehand(layer, grid, before, { name, unknown }) {
  const misfit = (what) => new Refused("base_shape", `layer ${layer}: ${what} than its base has`);
  if (before.grid.kind !== grid.kind) throw misfit("another grid");
  // A number so far from its base's that the grids share nothing is as good as any other.
  const far = 2n ** 32n, clamp = (by) => Number(by > far ? far : by < -far ? -far : by);
  const [down, along] = [0, 1].map((i) => clamp(grid.first[i] - before.grid.first[i]));
  const [rows, columns] = grid.shape, [rows_before, columns_before] = before.grid.shape;
  const start = Math.max(0, -along), end = Math.min(columns, columns_before - along);
  const cells_before = before.channels.find((channel) => channel.name === name)?.cells;
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
