// What the view in 3-D shows beside a map: the vehicle as a box, range rings, its trail, its plan, and the place of a
// cell.

import { PLAN_COLOUR, word } from "../draw/palette.js";
import { egoFrom, planLines } from "../vehicle/view.js";
import { QuadList } from "./quads.js";

export const RINGS_M = [5, 10, 20, 40, 60, 80];
const RING = word([214, 224, 230]), BODY = word([238, 242, 245]), CABIN = word([96, 108, 120]);
const TRAIL = word([127, 214, 255]), TRAIL_WIDTH_M = 0.2, TRAIL_Z_M = 0.14;
const PLAN = word(PLAN_COLOUR), PLAN_WIDTH_M = 0.25, PLAN_Z_M = 0.2;
const PROBE = word([255, 255, 255]), PROBE_M = 0.7, PROBE_Z_M = 0.24;
const RING_WIDTH_M = 0.12, RING_Z_M = 0.12;
// Length and width of a vehicle whose configuration has no outline, metres.
const LENGTH_M = 4.5, WIDTH_M = 1.8;
// Heights of a car, because the configuration has none.
const FLOOR_M = 0.3, BODY_M = 0.6, CABIN_M = 0.6;

// outline: x0, y0, x1, y1 ... in the ego frame, metres; empty if there is none. The cabin is at the back of the middle,
// so that the bonnet shows where ahead is.
export function vehicleQuads(outline) {
  const given = outline.length >= 6 ? outline : [LENGTH_M / 2, WIDTH_M / 2, -LENGTH_M / 2, -WIDTH_M / 2];
  const xs = given.filter((_, i) => i % 2 === 0), ys = given.filter((_, i) => i % 2 === 1);
  const [back, front, right, left] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
  const quads = new QuadList(512), length = front - back, inset = 0.08 * (left - right);
  const box = (x0, x1, y0, y1) => [x0, y0, x1, y0, x1, y1, x0, y1];
  quads.pushBox(box(back, front, right, left), [0, 0, FLOOR_M], BODY_M, BODY);
  const cabin = box(back + 0.08 * length, back + 0.66 * length, right + inset, left - inset);
  quads.pushBox(cabin, [0, 0, FLOOR_M + BODY_M], CABIN_M, CABIN);
  for (const radius of RINGS_M) quads.pushRing(radius, RING_WIDTH_M, RING_Z_M, RING);
  return { bytes: quads.bytes, count: quads.count };
}

// points: where the vehicle was, in the frame of `pose`, in which it is now. They have no heights: the trail lies on
// the ground plane under the vehicle.
export function trailQuads(points, pose) {
  const quads = new QuadList(points.length + 1);
  const at = (point) => {
    const { x, y } = egoFrom(pose, point);
    return [x, y, TRAIL_Z_M];
  };
  for (let i = 1; i < points.length; i++) quads.pushLine(at(points[i - 1]), at(points[i]), TRAIL_WIDTH_M, TRAIL);
  return { bytes: quads.bytes, count: quads.count };
}

// plan: of a MapUpdate, or null. As the trail, it has no heights.
export function planQuads(plan) {
  const quads = new QuadList(256), at = ([x, y]) => [x, y, PLAN_Z_M];
  for (const line of plan ? planLines(plan) : []) {
    for (let i = 1; i < line.length; i++) quads.pushLine(at(line[i - 1]), at(line[i]), PLAN_WIDTH_M, PLAN);
  }
  return { bytes: quads.bytes, count: quads.count };
}

// A cross at a point of the ego frame, or null.
export function probeQuads(at) {
  const quads = new QuadList(2);
  for (const side of at ? [-PROBE_M, PROBE_M] : []) {
    const [from, to] = [[at.x - PROBE_M, at.y - side, PROBE_Z_M], [at.x + PROBE_M, at.y + side, PROBE_Z_M]];
    quads.pushLine(from, to, RING_WIDTH_M, PROBE);
  }
  return { bytes: quads.bytes, count: quads.count };
}
