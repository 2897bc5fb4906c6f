// In: a map. Out: the planes in which the cells of all its layers lie, z = a x + b y + c in the ego frame, metres.
//
// The plane at a point is, in this order: the plane of the cell of the layer `terrain` (its channels height, slope_x
// and slope_y; only with `planes = true`), the plane of the segment of the layer `drivability`, the ground plane under
// the vehicle, z = 0.

const PLANE = ["height", "slope_x", "slope_y"];
const LEVEL = [0, 0, 0];

// { source: the layer with the planes, or null, planeAt(x, y) -> [a, b, c] }.
export function groundOf(map) {
  const sources = [terrainPlanes(map.layer("terrain")), segmentPlanes(map.layer("drivability"))].filter(Boolean);
  const planeAt = (x, y) => {
    for (const { of } of sources) {
      const plane = of(x, y);
      if (plane) return plane;
    }
    return LEVEL;
  };
  return { source: sources[0]?.layer ?? null, planeAt };
}

function terrainPlanes(layer) {
  const channels = PLANE.map((name) => layer?.channels.find((channel) => channel.name === name));
  if (!channels.every(Boolean)) return null;
  const [height, slope_x, slope_y] = PLANE.map((name) => layer.cells(name)), xy = new Float64Array(8);
  const of = (x, y) => {
    const cell = layer.grid.cellAt(x, y);
    if (cell < 0 || height[cell] === channels[0].unknown) return null;
    const [h, a, b] = [height, slope_x, slope_y].map((raw, i) => raw[cell] * channels[i].scale);
    layer.grid.corners(cell, xy);
    // The height is the height of the cell's centre.
    return [a, b, h - (a * (xy[0] + xy[4])) / 2 - (b * (xy[1] + xy[5])) / 2];
  };
  return { layer: layer.name, of };
}

function segmentPlanes(layer) {
  const segment = layer?.cells("segment");
  if (!segment || layer.planes.length === 0) return null;
  const planes = layer.planes.map(({ a, b, c }) => (Number.isFinite(a + b + c) ? [a, b, c] : null));
  const of = (x, y) => {
    const cell = layer.grid.cellAt(x, y);
    return cell < 0 ? null : planes[segment[cell]];
  };
  return { layer: layer.name, of };
}
