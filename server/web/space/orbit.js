// A camera that turns about a place on the ground. { yaw: its direction, radians counter-clockwise from the vehicle's
// x axis, pitch: how far it looks down, radians, distance_m: from the place, x_m, y_m: the place in the ego frame }.
// All functions return new cameras. size: { width, height } in CSS pixels.

const FIELD_OF_VIEW = (45 * Math.PI) / 180, NEAR_M = 0.5, FAR_M = 1000;
const PITCH_MIN = 0.05, PITCH_MAX = 1.55, DISTANCE_MIN_M = 4, DISTANCE_MAX_M = 300, REACH_M = 200;
// A drag over so many pixels turns by one radian.
const TURN_PX = 200;

const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

// From behind the vehicle, over its roof.
export const START = { yaw: 0, pitch: 0.5, distance_m: 42, x_m: 8, y_m: 0 };

// Turns by a drag: the picture follows the pointer.
export function turn(camera, dx, dy) {
  const yaw = (camera.yaw + dx / TURN_PX) % (2 * Math.PI);
  return { ...camera, yaw, pitch: clamp(camera.pitch + dy / TURN_PX, PITCH_MIN, PITCH_MAX) };
}

export const zoom = (camera, factor) =>
  ({ ...camera, distance_m: clamp(camera.distance_m / factor, DISTANCE_MIN_M, DISTANCE_MAX_M) });

// Moves the place by a drag: the ground follows the pointer.
export function move(camera, size, dx, dy) {
  const metres = (2 * camera.distance_m * Math.tan(FIELD_OF_VIEW / 2)) / Math.max(size.height, 1);
  const ahead = (dy * metres) / Math.max(Math.sin(camera.pitch), 0.3), left = dx * metres;
  const [cos, sin] = [Math.cos(camera.yaw), Math.sin(camera.yaw)];
  const x_m = clamp(camera.x_m + ahead * cos - left * sin, -REACH_M, REACH_M);
  const y_m = clamp(camera.y_m + ahead * sin + left * cos, -REACH_M, REACH_M);
  return { ...camera, x_m, y_m };
}

// The matrix from the ego frame, metres, to the clip space of WebGL, column by column.
export function matrixOf({ yaw, pitch, distance_m, x_m, y_m }, { width, height }) {
  const [cy, sy, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
  const right = [sy, -cy, 0], up = [cy * sp, sy * sp, cp], back = [-cp * cy, -cp * sy, sp];
  const eye = back.map((part, k) => [x_m, y_m, 0][k] + distance_m * part);
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const y_scale = 1 / Math.tan(FIELD_OF_VIEW / 2), x_scale = (y_scale * height) / Math.max(width, 1);
  const depth = (FAR_M + NEAR_M) / (NEAR_M - FAR_M), offset = (2 * FAR_M * NEAR_M) / (NEAR_M - FAR_M);
  const matrix = new Float32Array(16);
  for (let k = 0; k < 3; k++) {
    matrix.set([x_scale * right[k], y_scale * up[k], depth * back[k], -back[k]], 4 * k);
  }
  const behind = -dot(back, eye);
  matrix.set([-x_scale * dot(right, eye), -y_scale * dot(up, eye), depth * behind + offset, -behind], 12);
  return matrix;
}

// Where a point of the ego frame is on the canvas, in CSS pixels; null if it is behind the camera.
export function project(matrix, { width, height }, [x, y, z]) {
  const row = (i) => matrix[i] * x + matrix[4 + i] * y + matrix[8 + i] * z + matrix[12 + i];
  const w = row(3);
  return w < NEAR_M ? null : { px: (width / 2) * (1 + row(0) / w), py: (height / 2) * (1 - row(1) / w) };
}

// Where a pixel meets the ground plane under the vehicle, in the ego frame; null over the horizon.
export function groundAt({ yaw, pitch, distance_m, x_m, y_m }, { width, height }, px, py) {
  const [cy, sy, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
  const half = Math.tan(FIELD_OF_VIEW / 2) / height, right = (2 * px - width) * half, up = (height - 2 * py) * half;
  const down = sp - up * cp;
  if (!(down > 0)) return null;
  const reach = (distance_m * sp) / down, ahead = reach * (cp + up * sp) - distance_m * cp, left = -reach * right;
  return { x: x_m + ahead * cy - left * sy, y: y_m + ahead * sy + left * cy };
}
