// What is drawn over a map: range rings, the vehicle, its trail, safe paths, a plan, the cell under the cursor.
// In: a pen whose unit is a CSS pixel, and a view (vehicle/view.js).

import { css, PLAN_COLOUR } from "./palette.js";
import { egoFrom, planLines, toPixel } from "../vehicle/view.js";

const RINGS_M = [5, 10, 20, 40, 60, 80];
// A ring is drawn if it is this many pixels from the vehicle at least.
const RING_PX_MIN = 40;
// The vehicle's outline if its configuration has none: length and width in metres.
const LENGTH_M = 4.5, WIDTH_M = 1.8;
// The vehicle is drawn at least this long, in pixels.
const VEHICLE_PX_MIN = 12;
// A line is drawn twice, dark and then light, so that it is seen on every colour.
const PATH = [["rgb(10 14 18 / 85%)", 4.5], ["#ffe14d", 2]], TRAIL = [["rgb(10 14 18 / 70%)", 4], ["#7fd6ff", 1.75]];

function strokeTwice(pen, path, strokes) {
  pen.lineCap = pen.lineJoin = "round";
  for (const [colour, width] of strokes) {
    pen.strokeStyle = colour;
    pen.lineWidth = width;
    pen.stroke(path);
  }
}

export function drawRings(pen, view, size) {
  const { px, py } = toPixel(view, size, 0, 0);
  pen.font = "11px system-ui, sans-serif";
  pen.textAlign = "center";
  pen.textBaseline = "middle";
  for (const radius_m of RINGS_M) {
    const radius = radius_m / view.metres;
    if (radius < RING_PX_MIN || radius > 2 * Math.max(size.width, size.height)) continue;
    const ring = new Path2D();
    ring.arc(px, py, radius, 0, 2 * Math.PI);
    strokeTwice(pen, ring, [["rgb(0 0 0 / 35%)", 2.5], ["rgb(255 255 255 / 65%)", 1]]);
    // Labels stand ahead and to the right, where labels of neighbouring rings do not touch.
    const x = px + radius * Math.SQRT1_2, y = py - radius * Math.SQRT1_2;
    pen.lineWidth = 3.5;
    pen.strokeStyle = "rgb(0 0 0 / 75%)";
    pen.strokeText(`${radius_m} m`, x, y);
    pen.fillStyle = "#fff";
    pen.fillText(`${radius_m} m`, x, y);
  }
}

// outline: x0, y0, x1, y1 ... in the ego frame; empty if the configuration has none.
export function drawOutline(pen, view, size, outline) {
  const [length, width] = [LENGTH_M / 2, WIDTH_M / 2];
  const given = outline.length >= 6 ? outline : [length, width, length, -width, -length, -width, -length, width];
  const xs = given.filter((_, i) => i % 2 === 0), ys = given.filter((_, i) => i % 2 === 1);
  const [front, back] = [Math.max(...xs), Math.min(...xs)], side = Math.max(...ys.map(Math.abs));
  // Too small to be seen, it is drawn larger.
  const larger = Math.max(1, (VEHICLE_PX_MIN * view.metres) / Math.max(front - back, 0.1));
  const at = (x, y) => Object.values(toPixel(view, size, x * larger, y * larger));
  const body = new Path2D(), nose = new Path2D();
  xs.forEach((x, i) => (i ? body.lineTo(...at(x, ys[i])) : body.moveTo(...at(x, ys[i]))));
  body.closePath();
  const middle = (front + back) / 2, half = (front - back) / 2;
  nose.moveTo(...at(middle + half * 0.1, side * 0.6));
  nose.lineTo(...at(middle + half * 0.7, 0));
  nose.lineTo(...at(middle + half * 0.1, -side * 0.6));
  pen.fillStyle = "#fff";
  pen.fill(body);
  pen.strokeStyle = pen.fillStyle = "#111";
  pen.lineWidth = 1.5;
  pen.lineJoin = "round";
  pen.stroke(body);
  pen.fill(nose);
}

// points: where the vehicle was, in the frame of `pose`, in which it is now.
export function drawTrail(pen, view, size, points, pose) {
  if (points.length < 2) return;
  const path = new Path2D();
  points.forEach((point, i) => {
    const { x, y } = egoFrom(pose, point), { px, py } = toPixel(view, size, x, y);
    if (i) path.lineTo(px, py);
    else path.moveTo(px, py);
  });
  strokeTwice(pen, path, TRAIL);
}

// points: of wire/safe_points.js; null draws nothing.
export function drawSafePoints(pen, view, size, points) {
  if (!points || points.x.length === 0) return;
  const lines = new Path2D(), at = (i) => Object.values(toPixel(view, size, points.x[i], points.y[i]));
  for (const [from, to] of points.links) {
    lines.moveTo(...at(from));
    lines.lineTo(...at(to));
  }
  strokeTwice(pen, lines, PATH);
}

// plan: of a MapUpdate; null draws nothing.
export function drawPlan(pen, view, size, plan) {
  if (!plan) return;
  const lines = new Path2D(), at = (point) => Object.values(toPixel(view, size, ...point));
  for (const line of planLines(plan)) {
    line.forEach((point, i) => (i ? lines.lineTo(...at(point)) : lines.moveTo(...at(point))));
  }
  strokeTwice(pen, lines, [["rgb(10 14 18 / 85%)", 4.5], [css(PLAN_COLOUR), 2.25]]);
}

export function drawProbe(pen, view, size, probe) {
  if (!probe) return;
  const { px, py } = toPixel(view, size, probe.x, probe.y), mark = new Path2D();
  mark.arc(px, py, 7, 0, 2 * Math.PI);
  strokeTwice(pen, mark, [["#000", 5], ["#fff", 2]]);
}
