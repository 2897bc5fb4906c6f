// A view of the ego frame on a canvas: { x_m, y_m: the middle, in the ego frame, metres: a CSS pixel's side }. Forward
// is up, left is left. All functions return new views. size: { width, height } in CSS pixels.

export const METRES_MIN = 0.005, METRES_MAX = 1;

const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

// Shows radius_m to every side.
export const fit = (radius_m, { width, height }) =>
  ({ x_m: 0, y_m: 0, metres: clamp((2.04 * radius_m) / Math.max(Math.min(width, height), 1), METRES_MIN, METRES_MAX) });

// Shows AHEAD_M before the vehicle and BEHIND_M behind it, as a driver looks: the vehicle is low in the picture.
const AHEAD_M = 30, BEHIND_M = 15;

export const ahead = ({ width, height }) => {
  const metres = (AHEAD_M + BEHIND_M) / Math.max(Math.min(width, height), 1);
  return { x_m: (AHEAD_M - BEHIND_M) / 2, y_m: 0, metres: clamp(metres, METRES_MIN, METRES_MAX) };
};

export const toEgo = (view, { width, height }, px, py) =>
  ({ x: view.x_m + (height / 2 - py) * view.metres, y: view.y_m + (width / 2 - px) * view.metres });

export const toPixel = (view, { width, height }, x, y) =>
  ({ px: width / 2 - (y - view.y_m) / view.metres, py: height / 2 - (x - view.x_m) / view.metres });

// Magnifies by `factor`; the place under the pixel stays there.
export function zoomAt(view, size, px, py, factor) {
  const metres = clamp(view.metres / factor, METRES_MIN, METRES_MAX), { x, y } = toEgo(view, size, px, py);
  return { x_m: x - (size.height / 2 - py) * metres, y_m: y - (size.width / 2 - px) * metres, metres };
}

// Moves the picture by pixels to the right and down. The middle stays within reach_m of the vehicle.
export function pan(view, dx, dy, reach_m = 200) {
  const within = (m) => clamp(m, -reach_m, reach_m);
  return { ...view, x_m: within(view.x_m + dy * view.metres), y_m: within(view.y_m + dx * view.metres) };
}

// The least move after which a place is at least `margin` pixels inside.
export function moveInto(view, size, { x, y }, margin = 24) {
  const { px, py } = toPixel(view, size, x, y);
  const over = (at, side) => (at < margin ? margin - at : at > side - margin ? side - margin - at : 0);
  return pan(view, over(px, size.width), over(py, size.height));
}

// The raster (wire/grid.js) that fills the canvas at this many pixels per CSS pixel, of at most pixels_max a side.
export function rasterOf(view, { width, height }, scale, pixels_max) {
  const used = Math.min(scale, pixels_max / Math.max(width, height, 1));
  return {
    width: Math.max(1, Math.round(width * used)), height: Math.max(1, Math.round(height * used)),
    x_m: view.x_m, y_m: view.y_m, metres: view.metres / used,
  };
}

// Where a raster lies in another view, in CSS pixels: [left, top, width, height].
export function place(raster, view, size) {
  const width = (raster.width * raster.metres) / view.metres, height = (raster.height * raster.metres) / view.metres;
  const { px, py } = toPixel(view, size, raster.x_m, raster.y_m);
  return [px - width / 2, py - height / 2, width, height];
}

// The heading of a pose: counter-clockwise from x, in radians.
export const yawOf = ({ qx, qy, qz, qw }) => Math.atan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz));

// A point of the fixed frame in the ego frame of a vehicle at `pose`.
export function egoFrom(pose, { x, y }) {
  const yaw = yawOf(pose), [dx, dy] = [x - pose.x, y - pose.y];
  return { x: dx * Math.cos(yaw) + dy * Math.sin(yaw), y: dy * Math.cos(yaw) - dx * Math.sin(yaw) };
}

// Half the width of the cross at a plan's goal.
const GOAL_M = 0.75;

// The lines of a plan (of a MapUpdate), each a list of [x, y] in the ego frame: its path, its footprint at the end, and
// a cross at its goal.
export function planLines({ x, y, heading_rad, footprint_m, goal }) {
  const end = x.length - 1, [sin, cos] = [Math.sin(heading_rad[end]), Math.cos(heading_rad[end])], footprint = [];
  for (let i = 0; i < footprint_m.length; i += 2) {
    const [forward, left] = [footprint_m[i], footprint_m[i + 1]];
    footprint.push([x[end] + cos * forward - sin * left, y[end] + sin * forward + cos * left]);
  }
  const cross = (side) => [[goal.x - GOAL_M, goal.y - side], [goal.x + GOAL_M, goal.y + side]];
  const path = Array.from(x, (x, i) => [x, y[i]]);
  return [path, [...footprint, ...footprint.slice(0, 1)], ...(goal ? [cross(-GOAL_M), cross(GOAL_M)] : [])];
}

// Where a vehicle was, a point every STEP_M. A jump begins again: another frame, or a replay.
const STEP_M = 0.5, JUMP_M = 30, POINTS_MAX = 2000;

export class Trail {
  points = [];

  push({ x, y }) {
    const last = this.points.at(-1), moved = last ? Math.hypot(x - last.x, y - last.y) : Infinity;
    if (last && moved > JUMP_M) this.points = [];
    if (moved < STEP_M) return;
    this.points.push({ x, y });
    if (this.points.length > POINTS_MAX) this.points.shift();
  }
}
