// In: a canvas over a map of view_m metres to every side, and safe points. Out: drawn on it, the ground within their
// radii as a band, and their links as lines. Forward is up, left is left, the vehicle in the middle.

const BAND = "rgb(255 255 255 / 20%)", EDGE = "rgb(255 255 255 / 55%)";
// The line is drawn twice, dark and then light, so that it is seen on every colour.
const LINES = [["rgb(10 14 18 / 85%)", 4.5], ["#ffe14d", 2]];
// Every so many points, the circle itself is drawn. The points lie a cell apart, 0.25 m by default.
const CIRCLE_EVERY = 16;

// size: the canvas's side in pixels. scale: its pixels per CSS pixel. points: of safe_points.js; null clears all.
export function drawSafePaths(canvas, size, scale, view_m, points) {
  const pen = canvas.getContext("2d"), per_metre = size / (2 * view_m);
  pen.clearRect(0, 0, size, size);
  if (!points || points.x.length === 0) return;
  const left = (i) => size / 2 - points.y[i] * per_metre, top = (i) => size / 2 - points.x[i] * per_metre;
  // One path for all circles: where they overlap, the band is not brighter.
  const band = new Path2D(), circles = new Path2D(), lines = new Path2D();
  const circle = (path, i) => {
    path.moveTo(left(i) + points.radius[i] * per_metre, top(i));
    path.arc(left(i), top(i), points.radius[i] * per_metre, 0, 2 * Math.PI);
  };
  // Point 0 is the vehicle's position.
  for (let i = 1; i < points.x.length; i++) {
    circle(band, i);
    if (i % CIRCLE_EVERY === 1) circle(circles, i);
  }
  for (const [from, to] of points.links) {
    lines.moveTo(left(from), top(from));
    lines.lineTo(left(to), top(to));
  }
  pen.fillStyle = BAND;
  pen.fill(band, "nonzero");
  pen.strokeStyle = EDGE;
  pen.lineWidth = 0.75 * scale;
  pen.stroke(circles);
  pen.lineCap = pen.lineJoin = "round";
  for (const [colour, width] of LINES) {
    pen.strokeStyle = colour;
    pen.lineWidth = width * scale;
    pen.stroke(lines);
  }
}
