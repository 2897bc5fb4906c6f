// In: a canvas over a map of view_m metres to every side. Out: range rings and the vehicle, drawn on it.

const RINGS_M = [10, 20, 40, 60];
// The vehicle's length and width, and how long and wide it is drawn at least, in CSS pixels.
const VEHICLE_M = [4.5, 1.8], VEHICLE_PX_MIN = [13, 6];

// size: the canvas's side in pixels. scale: its pixels per CSS pixel.
export function drawOverlay(canvas, size, scale, view_m) {
  const pen = canvas.getContext("2d"), per_metre = size / (2 * view_m);
  pen.clearRect(0, 0, size, size);
  pen.font = `${11 * scale}px system-ui, sans-serif`;
  pen.textAlign = "center";
  pen.textBaseline = "middle";
  for (const radius_m of RINGS_M.filter((radius_m) => radius_m <= view_m)) {
    drawRing(pen, size / 2, scale, radius_m * per_metre, `${radius_m} m`);
  }
  drawVehicle(pen, size / 2, scale, per_metre);
}

function drawRing(pen, middle, scale, radius, label) {
  const ring = new Path2D();
  ring.arc(middle, middle, radius, 0, 2 * Math.PI);
  for (const [colour, width] of [["rgb(0 0 0 / 45%)", 2.5], ["rgb(255 255 255 / 75%)", 1]]) {
    pen.strokeStyle = colour;
    pen.lineWidth = width * scale;
    pen.stroke(ring);
  }
  // Labels stand ahead and to the right, where those of neighbouring rings do not touch.
  const x = middle + radius * Math.SQRT1_2, y = middle - radius * Math.SQRT1_2;
  pen.lineWidth = 3.5 * scale;
  pen.strokeStyle = "rgb(0 0 0 / 75%)";
  pen.strokeText(label, x, y);
  pen.fillStyle = "#fff";
  pen.fillText(label, x, y);
}

function drawVehicle(pen, middle, scale, per_metre) {
  const [length, width] = VEHICLE_M.map((m, i) => Math.max(m * per_metre, VEHICLE_PX_MIN[i] * scale) / 2);
  const body = new Path2D(), nose = new Path2D();
  body.roundRect(middle - width, middle - length, 2 * width, 2 * length, width / 2);
  nose.moveTo(middle - width * 0.6, middle - length * 0.1);
  nose.lineTo(middle, middle - length * 0.65);
  nose.lineTo(middle + width * 0.6, middle - length * 0.1);
  pen.fillStyle = "#fff";
  pen.fill(body);
  pen.strokeStyle = pen.fillStyle = "#111";
  pen.lineWidth = 1.5 * scale;
  pen.stroke(body);
  pen.fill(nose);
}
