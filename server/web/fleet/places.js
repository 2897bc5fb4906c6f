// Where the vehicles are, on a canvas: x to the right, y up, in the odometry frame. In: { name, pose: { x_m, y_m,
// heading_deg }, state, fresh }. Out: the canvas, and where each vehicle is on it.

const MARGIN_PX = 34, SPAN_MIN_M = 20, HIT_PX = 16;
const COLOURS = { error: "--bad", warn: "--wait", ok: "--good" };

// { scale: pixels a metre, px(pose), py(pose) }: all places within the margins, none magnified beyond SPAN_MIN_M.
export function viewOf(places, { width, height }) {
  const range = (of) => [Math.min(...places.map(of)), Math.max(...places.map(of))];
  const [west, east] = range(({ pose }) => pose.x_m), [south, north] = range(({ pose }) => pose.y_m);
  const room = (pixels) => Math.max(pixels - 2 * MARGIN_PX, 1);
  const span = (from, to) => Math.max(to - from, SPAN_MIN_M);
  const scale = Math.min(room(width) / span(west, east), room(height) / span(south, north));
  return {
    scale,
    px: ({ x_m }) => width / 2 + (x_m - (west + east) / 2) * scale,
    py: ({ y_m }) => height / 2 - (y_m - (south + north) / 2) * scale,
  };
}

// The least of 1, 2, 5 times a power of ten that is at least so many pixels long.
export function gridStep(scale, pixels_min) {
  const least = pixels_min / scale, power = 10 ** Math.floor(Math.log10(least));
  return [1, 2, 5, 10].map((factor) => factor * power).find((step) => step >= least - 1e-9);
}

// The name of the vehicle that is drawn at a pixel; null if there is none.
export function vehicleAt(drawn, px, py) {
  const near = drawn.map((at) => [Math.hypot(at.px - px, at.py - py), at.name]).sort(([a], [b]) => a - b)[0];
  return near && near[0] <= HIT_PX ? near[1] : null;
}

export function drawPlaces(canvas, places) {
  const size = { width: canvas.clientWidth, height: canvas.clientHeight }, ratio = devicePixelRatio;
  if (!size.width) return [];
  const [width, height] = [size.width, size.height].map((pixels) => Math.round(pixels * ratio));
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  const pen = canvas.getContext("2d"), style = getComputedStyle(canvas);
  const colour = (name) => style.getPropertyValue(name);
  const view = viewOf(places, size);
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, size.width, size.height);
  drawGrid(pen, view, places[0].pose, size, colour);
  pen.font = "12px system-ui, sans-serif";
  pen.textAlign = "center";
  return places.map(({ name, pose, state, fresh }) => {
    const px = view.px(pose), py = view.py(pose);
    pen.save();
    pen.translate(px, py);
    pen.rotate((-pose.heading_deg * Math.PI) / 180);
    pen.beginPath();
    pen.moveTo(10, 0);
    pen.lineTo(-7, 6);
    pen.lineTo(-4, 0);
    pen.lineTo(-7, -6);
    pen.closePath();
    pen.fillStyle = colour(fresh === "stale" ? "--bad" : (COLOURS[state] ?? "--good"));
    pen.fill();
    pen.strokeStyle = colour("--card");
    pen.lineWidth = 1;
    pen.stroke();
    pen.restore();
    // Among many vehicles the names would cover each other.
    if (places.length <= 20) {
      pen.fillStyle = colour("--ink");
      pen.fillText(name.length > 14 ? `${name.slice(0, 13)}…` : name, px, py + 22);
    }
    return { name, px, py };
  });
}

function drawGrid(pen, view, origin, { width, height }, colour) {
  const step = gridStep(view.scale, 60) * view.scale;
  pen.strokeStyle = colour("--line");
  pen.lineWidth = 1;
  pen.beginPath();
  const offset = (at) => ((at % step) + step) % step;
  for (let x = offset(view.px({ ...origin, x_m: 0 })); x < width; x += step) {
    pen.moveTo(x, 0);
    pen.lineTo(x, height);
  }
  for (let y = offset(view.py({ ...origin, y_m: 0 })); y < height; y += step) {
    pen.moveTo(0, y);
    pen.lineTo(width, y);
  }
  pen.stroke();
  pen.fillStyle = colour("--soft");
  pen.font = "11px system-ui, sans-serif";
  pen.textAlign = "left";
  pen.fillText(`grid ${gridStep(view.scale, 60)} m`, 8, height - 8);
}
