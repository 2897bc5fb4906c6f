// The large map of one vehicle: frames of the Worker on a canvas, with what is drawn over them, and the user's moves.
// While the view moves, the last frame moves with it; the Worker sends a sharp one soon after. Out: calls to `on`:
// view() after each change of the view or the size, probe({ x, y } or null).

import { drawOutline, drawPlan, drawProbe, drawRings, drawSafePoints, drawTrail } from "../draw/overlay.js";
import { ahead, fit, moveInto, pan, place, rasterOf, toEgo, zoomAt } from "./view.js";

// More pixels a side show no more of a grid, and cost time for each map.
const PIXELS_MAX = 1200;
const ZOOM_KEY = 1.3, WHEEL_ZOOM = 0.0015;
// A drag begins after so many pixels; less is a tap.
const DRAG_MIN = 4;

export class MapCanvas {
  view = { x_m: 0, y_m: 0, metres: 0.1 };
  size = { width: 0, height: 0 };
  probe = null;
  #canvas;
  #on;
  #picture = document.createElement("canvas");
  #frame = null;
  // "ahead" or "all" until the user moves the view; null afterwards.
  #home = "ahead";
  #is_scheduled = false;
  #layers = { outline: [], trail: [], pose: null, safe_points: null, plan: null };

  constructor(canvas, on) {
    this.#canvas = canvas;
    this.#on = on;
    new ResizeObserver(() => this.#resize()).observe(canvas.parentElement);
    this.#followPointers();
    canvas.addEventListener("wheel", (event) => this.#wheel(event), { passive: false });
    canvas.addEventListener("keydown", (event) => this.#pressKey(event));
    this.#resize();
  }

  get raster() {
    return rasterOf(this.view, this.size, devicePixelRatio, PIXELS_MAX);
  }

  // Draws a frame, or none (null), with what lies over it.
  show(frame, layers) {
    if (frame?.pixels) {
      const { raster, pixels } = frame;
      this.#picture.width = raster.width;
      this.#picture.height = raster.height;
      const image = new ImageData(new Uint8ClampedArray(pixels.buffer), raster.width, raster.height);
      this.#picture.getContext("2d").putImageData(image, 0, 0);
    }
    this.#frame = frame;
    this.#goHome();
    this.#layers = layers;
    this.draw();
  }

  // Shows what is ahead, or all of the grid if that is shown already.
  reset() {
    this.#home = this.#home === "ahead" ? "all" : "ahead";
    this.#goHome();
    this.schedule();
  }

  zoom(factor) {
    this.#move(zoomAt(this.view, this.size, this.size.width / 2, this.size.height / 2, factor));
  }

  forgetView() {
    this.#home = "ahead";
    this.#goHome();
    this.probe = null;
  }

  schedule() {
    if (this.#is_scheduled) return;
    this.#is_scheduled = true;
    requestAnimationFrame(() => {
      this.#is_scheduled = false;
      this.draw();
    });
  }

  draw() {
    const { width, height } = this.size, scale = devicePixelRatio, pen = this.#canvas.getContext("2d");
    if (!width) return;
    pen.setTransform(scale, 0, 0, scale, 0, 0);
    pen.clearRect(0, 0, width, height);
    if (this.#frame) {
      pen.imageSmoothingEnabled = false;
      pen.drawImage(this.#picture, ...place(this.#frame.raster, this.view, this.size));
    }
    const { outline, trail, pose, safe_points, plan } = this.#layers;
    if (pose) drawTrail(pen, this.view, this.size, trail, pose);
    drawSafePoints(pen, this.view, this.size, safe_points);
    drawRings(pen, this.view, this.size);
    drawOutline(pen, this.view, this.size, outline);
    drawPlan(pen, this.view, this.size, plan);
    drawProbe(pen, this.view, this.size, this.probe);
  }

  #resize() {
    const { clientWidth: width, clientHeight: height } = this.#canvas.parentElement;
    if (width === this.size.width && height === this.size.height) return;
    this.size = { width, height };
    this.#canvas.width = Math.round(width * devicePixelRatio);
    this.#canvas.height = Math.round(height * devicePixelRatio);
    this.#goHome();
    this.#on.view();
    this.schedule();
  }

  #goHome() {
    if (this.#home === null) return;
    const radius_m = this.#home === "all" ? this.#frame?.radius_m : null;
    const view = radius_m ? fit(radius_m, this.size) : ahead(this.size);
    if (view.metres === this.view.metres && view.x_m === this.view.x_m && view.y_m === this.view.y_m) return;
    this.view = view;
    this.#on.view();
  }

  #move(view) {
    this.#home = null;
    this.view = view;
    this.#on.view();
    this.schedule();
  }

  moveProbe(probe) {
    this.probe = probe;
    this.#on.probe(probe);
    this.schedule();
  }

  #at(event) {
    const box = this.#canvas.getBoundingClientRect();
    return { px: event.clientX - box.left, py: event.clientY - box.top };
  }

  #wheel(event) {
    event.preventDefault();
    const { px, py } = this.#at(event);
    // A wheel that counts lines or pages.
    const pixels = event.deltaY * [1, 16, 100][event.deltaMode];
    this.#move(zoomAt(this.view, this.size, px, py, Math.exp(-pixels * WHEEL_ZOOM)));
  }

  // One pointer drags, two pinch; a mouse that drags nothing probes, and so does a tap.
  #followPointers() {
    const canvas = this.#canvas, pointers = new Map();
    let is_dragged = false;
    canvas.onpointerdown = (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, { ...this.#at(event) });
      if (pointers.size === 1) is_dragged = false;
    };
    canvas.onpointermove = (event) => {
      const now = this.#at(event), before = pointers.get(event.pointerId);
      if (!before) {
        if (event.pointerType === "mouse") this.moveProbe(toEgo(this.view, this.size, now.px, now.py));
        return;
      }
      const [dx, dy] = [now.px - before.px, now.py - before.py];
      if (!is_dragged && pointers.size === 1 && Math.hypot(dx, dy) < DRAG_MIN) return;
      is_dragged = true;
      const other = [...pointers].find(([id]) => id !== event.pointerId)?.[1];
      pointers.set(event.pointerId, now);
      if (!other) return this.#move(pan(this.view, dx, dy));
      const apart = (at) => Math.hypot(at.px - other.px, at.py - other.py);
      const factor = apart(now) / Math.max(apart(before), 1);
      const middle = [(now.px + other.px) / 2, (now.py + other.py) / 2];
      this.#move(pan(zoomAt(this.view, this.size, ...middle, factor), dx / 2, dy / 2));
    };
    canvas.onpointerup = canvas.onpointercancel = (event) => {
      const at = pointers.get(event.pointerId);
      pointers.delete(event.pointerId);
      if (at && !is_dragged && event.type === "pointerup") this.moveProbe(toEgo(this.view, this.size, at.px, at.py));
    };
    canvas.onpointerleave = (event) => event.pointerType === "mouse" && !pointers.size && this.moveProbe(null);
    canvas.ondblclick = (event) => {
      const { px, py } = this.#at(event);
      this.#move(zoomAt(this.view, this.size, px, py, 2));
    };
  }

  #pressKey(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const step = event.shiftKey ? 10 : 1;
    const by = { ArrowUp: [step, 0], ArrowDown: [-step, 0], ArrowLeft: [0, step], ArrowRight: [0, -step] }[event.key];
    const act = {
      "+": () => this.zoom(ZOOM_KEY), "=": () => this.zoom(ZOOM_KEY), "-": () => this.zoom(1 / ZOOM_KEY),
      0: () => this.reset(), Escape: () => this.moveProbe(null),
    }[event.key];
    if (!by && !act) return;
    event.preventDefault();
    if (act) return act();
    const { x, y } = this.probe ?? { x: 0, y: 0 }, probe = { x: x + by[0], y: y + by[1] };
    const view = moveInto(this.view, this.size, probe);
    if (view.x_m !== this.view.x_m || view.y_m !== this.view.y_m) this.#move(view);
    this.moveProbe(probe);
  }
}
