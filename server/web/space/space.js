// The view of one vehicle in 3-D, in place of the flat map: cells, points, vehicle and rings from a camera that the
// user turns. In: the frames of the Worker with `space`, and the frames of points, which are asked for one by one while
// they are wanted. Out: `settings.space` and `settings.points`, and changed() after each change of them.

import { count, setText } from "../text.js";
import { HIGH_M, LOW_M, Scene } from "./gl.js";
import { groundAt, matrixOf, move, project, START, turn, zoom } from "./orbit.js";
import { Poses } from "./points.js";
import { planQuads, probeQuads, RINGS_M, trailQuads, vehicleQuads } from "./vehicle.js";

const WHEEL_ZOOM = 0.0015, KEY_ZOOM = 1.3, KEY_PX = 30;
// A drag is this long at least; less is a click.
const DRAG_MIN_PX = 4;
// Points older than this beside the shown map are not drawn: things moved meanwhile.
const POINTS_APART_NS = 2_000_000_000n;
const NONE = { bytes: new Uint8Array(0), count: 0 }, NOT_MOVED = { x: 0, y: 0, yaw: 0 };
const SOURCES = { terrain: "cells in terrain's planes", drivability: "cells in the planes of drivability's segments" };

const $ = (id) => document.getElementById(id);

export class Space {
  #canvas = $("space");
  #settings;
  #changed;
  #ask;
  #probe;
  #scene = null;
  // True from the loss of WebGL, for instance when the graphics card's process ends, until the browser gives it back.
  #is_lost = false;
  #camera = START;
  #size = { width: 0, height: 0 };
  #is_scheduled = false;
  // Quads by name that the scene gets with the next picture.
  #quads = new Map();
  #vehicle = null;
  #outline = null;
  #frame = null;
  // The newest points, or { reason } if the server refuses them.
  #points = null;
  #poses = new Poses();
  #labels = [];

  // ask({ vehicle, wanted }): a request for points. probe({ x, y } or null): the place whose cell is asked for.
  constructor(settings, changed, ask, probe) {
    [this.#settings, this.#changed, this.#ask] = [settings, changed, ask];
    this.#probe = (at) => {
      this.#quads.set("probe", probeQuads(at));
      this.#schedule();
      probe(at);
    };
    const button = $("space-button"), points = $("space-points");
    button.onclick = () => this.#set({ space: !this.is_open });
    points.checked = settings.points;
    points.onchange = () => this.#set({ points: points.checked });
    this.#labels = RINGS_M.map((radius) => {
      const label = document.createElement("span");
      setText(label, `${radius} m`);
      return label;
    });
    $("space-labels").replaceChildren(...this.#labels);
    new ResizeObserver(() => this.#schedule()).observe(this.#canvas.parentElement);
    this.#followPointers();
    this.#canvas.addEventListener("wheel", (event) => this.#wheel(event), { passive: false });
    this.#canvas.addEventListener("keydown", (event) => this.#pressKey(event));
    this.#canvas.addEventListener("webglcontextlost", (event) => this.#lose(event));
    this.#canvas.addEventListener("webglcontextrestored", () => this.#restore());
    if (typeof WebGL2RenderingContext === "undefined") {
      Object.assign(settings, { space: false });
      Object.assign($("space-button"), { disabled: true, title: "No view in 3-D: this browser has no WebGL 2" });
    }
    this.#write();
  }

  get is_open() {
    return this.#settings.space;
  }

  // Another vehicle is shown, or none (null), or the connection is new.
  open(vehicle) {
    if (vehicle !== this.#vehicle) {
      if (this.#wantsPoints) this.#ask({ vehicle: this.#vehicle, wanted: false });
      [this.#frame, this.#points, this.#poses] = [null, null, new Poses()];
    }
    this.#vehicle = vehicle;
    if (this.#wantsPoints) this.#ask({ vehicle, wanted: true });
    if (this.is_open) this.#schedule();
  }

  // Draws a frame, or none (null). with: { outline, trail, pose } as on the flat map.
  show(frame, { outline, trail, pose }) {
    if (!this.is_open || !this.#begin()) return;
    if (outline.join() !== this.#outline) {
      this.#outline = outline.join();
      this.#quads.set("vehicle", vehicleQuads(outline));
    }
    if (frame?.space && frame !== this.#frame) this.#quads.set("cells", frame.space);
    if (!frame) this.#quads.set("cells", NONE);
    if (frame && frame !== this.#frame) this.#poses.push(frame.header.capture_end_ns, pose);
    this.#quads.set("trail", pose ? trailQuads(trail, pose) : NONE);
    this.#quads.set("plan", planQuads(frame?.plan));
    this.#frame = frame;
    this.#schedule();
  }

  // A frame of points has arrived.
  points(points) {
    if (points.vehicle !== this.#vehicle || !this.#wantsPoints || !this.#begin()) return;
    this.#points = points;
    this.#schedule();
    if (points.reason) return;
    // The next frame is asked for when this frame is drawn: a hidden page draws nothing.
    requestAnimationFrame(() => this.#wantsPoints && this.#ask({ vehicle: this.#vehicle, wanted: true }));
  }

  zoom(factor) {
    this.#look(zoom(this.#camera, factor));
  }

  reset() {
    this.#look(START);
  }

  get #wantsPoints() {
    return this.is_open && this.#settings.points && this.#vehicle !== null;
  }

  #set(changes) {
    const had_points = this.#wantsPoints;
    Object.assign(this.#settings, changes);
    if (this.is_open) this.#begin();
    if (this.#wantsPoints !== had_points) this.#ask({ vehicle: this.#vehicle, wanted: this.#wantsPoints });
    if (!this.#wantsPoints) this.#points = null;
    this.#write();
    this.#changed();
    this.#schedule();
    if ("space" in changes) (this.is_open ? this.#canvas : $("map")).focus({ preventScroll: true });
  }

  // Makes the scene at the first need; false if the browser cannot now.
  #begin() {
    if (this.#is_lost) return false;
    try {
      this.#scene ??= new Scene(this.#canvas);
    } catch (error) {
      this.#fail(error.message);
      this.#changed();
    }
    return this.is_open;
  }

  // The flat map is shown instead, until the user asks again.
  #fail(why) {
    this.#settings.space = false;
    this.#write();
    setText($("space-text"), `No view in 3-D: ${why}`);
    $("space-text").hidden = false;
  }

  #lose(event) {
    // Without this the browser would not give it back.
    event.preventDefault();
    [this.#is_lost, this.#scene] = [true, null];
    setText($("space-text"), "waiting for the browser to give WebGL back");
  }

  // Nothing of the old scene is left: the frame and the outline are drawn again.
  #restore() {
    [this.#is_lost, this.#frame, this.#outline] = [false, null, null];
    this.#changed();
  }

  #write() {
    for (const id of ["space", "space-labels", "space-text"]) $(id).hidden = !this.is_open;
    $("map").hidden = this.is_open;
    $("space-points").closest("label").hidden = !this.is_open;
    $("space-button").setAttribute("aria-pressed", String(this.is_open));
  }

  #look(camera) {
    this.#camera = camera;
    this.#schedule();
  }

  #schedule() {
    if (this.#is_scheduled || !this.is_open) return;
    this.#is_scheduled = true;
    requestAnimationFrame(() => {
      this.#is_scheduled = false;
      if (!this.is_open || !this.#scene) return;
      if (this.#scene.is_busy) this.#schedule();
      else this.#draw();
    });
  }

  #draw() {
    const { clientWidth: width, clientHeight: height } = this.#canvas.parentElement, scale = devicePixelRatio;
    const [across, down] = [Math.round(width * scale), Math.round(height * scale)];
    if (this.#canvas.width !== across || this.#canvas.height !== down) {
      [this.#canvas.width, this.#canvas.height] = [across, down];
    }
    this.#size = { width, height };
    const matrix = matrixOf(this.#camera, this.#size), points = this.#shownPoints();
    for (const [name, quads] of this.#quads) this.#scene.setQuads(name, quads);
    this.#quads.clear();
    this.#scene.setPoints(points?.xyz ?? new Int16Array(0));
    this.#scene.draw(matrix, scale, (points && this.#poses.move(points.capture_end_ns)) ?? NOT_MOVED);
    this.#placeLabels(matrix);
    setText($("space-text"), text(this.#frame, this.#settings.points, points, this.#points?.reason));
  }

  #shownPoints() {
    const map_ns = this.#frame?.header.capture_end_ns, points = this.#points;
    if (!points?.xyz || map_ns === undefined) return null;
    const apart = points.capture_end_ns - map_ns;
    return apart < POINTS_APART_NS && apart > -POINTS_APART_NS ? points : null;
  }

  // The ranges stand ahead and to the right, as on the flat map.
  #placeLabels(matrix) {
    RINGS_M.forEach((radius, i) => {
      const at = project(matrix, this.#size, [radius * Math.SQRT1_2, -radius * Math.SQRT1_2, 0.2]);
      this.#labels[i].hidden = !at;
      if (at) this.#labels[i].style.transform = `translate(-50%, -50%) translate(${at.px}px, ${at.py}px)`;
    });
  }

  #wheel(event) {
    event.preventDefault();
    const pixels = event.deltaY * [1, 16, 100][event.deltaMode];
    this.zoom(Math.exp(-pixels * WHEEL_ZOOM));
  }

  // One pointer turns, with Shift or another button it moves; two move and pinch. A click or a tap asks for a cell.
  #followPointers() {
    const canvas = this.#canvas, pointers = new Map();
    let dragged_px = 0;
    canvas.oncontextmenu = (event) => event.preventDefault();
    canvas.onpointerdown = (event) => {
      canvas.setPointerCapture(event.pointerId);
      if (pointers.size === 0) dragged_px = 0;
      pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    };
    canvas.onpointermove = (event) => {
      const before = pointers.get(event.pointerId), now = { x: event.clientX, y: event.clientY };
      if (!before) return;
      const [dx, dy] = [now.x - before.x, now.y - before.y];
      dragged_px += Math.hypot(dx, dy);
      const other = [...pointers].find(([id]) => id !== event.pointerId)?.[1];
      pointers.set(event.pointerId, now);
      const is_move = event.shiftKey || event.buttons > 1;
      if (!other) return this.#look(is_move ? move(this.#camera, this.#size, dx, dy) : turn(this.#camera, dx, dy));
      const apart = (at) => Math.max(Math.hypot(at.x - other.x, at.y - other.y), 1);
      this.#look(move(zoom(this.#camera, apart(now) / apart(before)), this.#size, dx / 2, dy / 2));
    };
    canvas.onpointerup = canvas.onpointercancel = (event) => {
      pointers.delete(event.pointerId);
      if (event.type !== "pointerup" || pointers.size > 0 || dragged_px >= DRAG_MIN_PX) return;
      const box = canvas.getBoundingClientRect();
      this.#probe(groundAt(this.#camera, this.#size, event.clientX - box.left, event.clientY - box.top));
    };
  }

  #pressKey(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const by = {
      ArrowUp: [0, KEY_PX], ArrowDown: [0, -KEY_PX], ArrowLeft: [KEY_PX, 0], ArrowRight: [-KEY_PX, 0],
    }[event.key];
    const act = {
      "+": () => this.zoom(KEY_ZOOM), "=": () => this.zoom(KEY_ZOOM), "-": () => this.zoom(1 / KEY_ZOOM),
      0: () => this.reset(), Escape: () => this.#probe(null),
    }[event.key];
    if (!by && !act) return;
    event.preventDefault();
    if (act) return act();
    this.#look(event.shiftKey ? move(this.#camera, this.#size, ...by) : turn(this.#camera, ...by));
  }
}

// What is drawn, in words.
export function text(frame, wants_points, points, refusal) {
  const cells = frame?.space ? (SOURCES[frame.space.source] ?? "no planes: cells lie at height 0") : "no map yet";
  if (!wants_points) return cells;
  if (!points) return `${cells} · ${refusal ?? "points come with the next map"}`;
  const part = points.count < points.total ? ` of ${count(points.total)}` : "";
  return `${cells} · ${count(points.count)}${part} points, dark ${LOW_M} m to bright ${HIGH_M} m over the ground here`;
}
