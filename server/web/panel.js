// In: one layer of the newest map, as map.js opens it. Out: its panel: cells on a canvas, range rings, legend, share of
// drivable ground, and what lies under the pointer. Forward is up, left is left, the vehicle in the middle.

import { egoAt, pixelCells } from "./grid.js";
import { classColour, css, idColour, scaleColour, UNKNOWN, word } from "./palette.js";
import { bearing, count, percent } from "./text.js";

const RINGS_M = [10, 20, 40, 60];
// Beyond this many pixels a side nothing is gained for grids of a degree.
const PIXELS_MAX = 1200;
// Drawn size of the vehicle where the true one would be too small to see, CSS pixels.
const VEHICLE_M = [4.5, 1.8], VEHICLE_PX_MIN = [13, 6];

export class Panel {
  #view_m = 0;
  #size = 0;
  #scale = 1;
  #layer = null;
  #shown = "class";
  #range = null;
  #probe = null;
  #legendOf = "";

  constructor(template, name) {
    this.name = name;
    this.element = template.content.firstElementChild.cloneNode(true);
    const part = (of) => this.element.querySelector(`[data-part="${of}"]`);
    const parts = ["title", "share", "channel", "plot", "cells", "overlay", "mark", "readout", "legend", "stale"];
    this.part = Object.fromEntries(parts.map((of) => [of, part(of)]));
    this.part.title.textContent = name;
    this.part.channel.setAttribute("aria-label", `Channel of ${name}`);
    this.part.channel.onchange = () => {
      this.#shown = this.part.channel.value;
      this.#range = null;
      this.#paint();
    };
    const { overlay, plot } = this.part;
    const follow = (event) => {
      const box = overlay.getBoundingClientRect();
      this.#point(egoAt(event.clientX - box.left - 0.5, event.clientY - box.top - 0.5, box.width, this.#view_m));
    };
    overlay.onpointermove = overlay.onpointerdown = follow;
    overlay.onpointerleave = (event) => event.pointerType === "mouse" && this.#point(null);
    overlay.onkeydown = (event) => this.#steer(event);
    new ResizeObserver(() => this.#resize()).observe(plot);
  }

  // view_m: metres shown to every side; 0 shows the whole grid.
  show(layer, view_m) {
    this.#layer = layer;
    const wanted = view_m || layer.grid.radius_m * 1.02;
    const moved = wanted !== this.#view_m;
    this.#view_m = wanted;
    const names = layer.channels.map((channel) => channel.name);
    const { channel } = this.part;
    if ([...channel.options].map((option) => option.value).join() !== names.join()) {
      channel.replaceChildren(...names.map((name) => new Option(name.replaceAll("_", " "), name)));
    }
    if (!names.includes(this.#shown)) this.#shown = names[0];
    channel.value = this.#shown;
    if (moved) this.#overlay();
    this.#paint();
  }

  stale(text) {
    this.element.classList.toggle("stale", text !== "");
    if (this.part.stale.textContent !== text) this.part.stale.textContent = text;
  }

  #resize() {
    const side = this.part.plot.clientWidth;
    const size = Math.min(Math.round(side * devicePixelRatio), PIXELS_MAX);
    if (size === 0 || size === this.#size) return;
    this.#size = size;
    this.#scale = size / side;
    for (const canvas of [this.part.cells, this.part.overlay]) canvas.width = canvas.height = size;
    this.image = new ImageData(size, size);
    this.words = new Uint32Array(this.image.data.buffer);
    this.#overlay();
    if (this.#layer) this.#paint();
  }

  #paint() {
    const layer = this.#layer;
    const channel = layer.channels.find((one) => one.name === this.#shown);
    const colours = this.#colours(layer, channel);
    if (this.#size) {
      const table = pixelCells(layer.grid, this.#size, this.#view_m);
      const { cells } = channel, { words } = this;
      const [low] = bounds(cells);
      for (let i = 0; i < table.length; i++) words[i] = table[i] < 0 ? 0 : colours[cells[table[i]] - low];
      this.part.cells.getContext("2d").putImageData(this.image, 0, 0);
    }
    const share = layer.figures.get("drivable_share");
    this.part.share.textContent = share === undefined ? "" : `${percent(share)} drivable`;
    const label = `${layer.name} around the vehicle, forward up. ${this.part.share.textContent}`;
    this.part.overlay.setAttribute("aria-label", label);
    if (this.#probe) this.#point(this.#probe);
  }

  // One colour word for each raw value a cell type can take, and the legend to it.
  #colours(layer, channel) {
    const { cells, unit, scale, unknown } = channel;
    const [low, high] = bounds(cells);
    const used = new Uint32Array(high - low + 1);
    for (const cell of cells) used[cell - low]++;
    const words = new Uint32Array(high - low + 1);
    const paint = (colour) =>
      used.forEach((n, i) => n && (words[i] = word(i + low === unknown ? UNKNOWN : colour(i + low))));
    const unseen = [UNKNOWN, "unknown", (used[unknown - low] ?? 0) / cells.length];
    if (channel.name === "class") {
      layer.legend.forEach((name, value) => (words[value] = word(classColour(name, value))));
      this.#legend(layer.legend.map((name, value) => {
        return [classColour(name, value), name.replaceAll("_", " "), used[value] / cells.length];
      }));
    } else if (unit === "") {
      paint(idColour);
      const known = used.reduce((sum, n, i) => sum + (n > 0 && i + low !== unknown), 0);
      this.#legend([unseen, [null, `${known} ids, one colour each`]]);
    } else {
      // The range only grows while a channel is shown: colours that change their meaning with every map tell nothing.
      used.forEach((n, i) => {
        const value = (i + low) * scale;
        if (n === 0 || i + low === unknown) return;
        this.#range = this.#range ? [Math.min(this.#range[0], value), Math.max(this.#range[1], value)] : [value, value];
      });
      const [from, to] = this.#range ?? [0, 0];
      paint((raw) => scaleColour(to > from ? (raw * scale - from) / (to - from) : 0.5));
      const stop = (t) => [scaleColour(t), `${(from + t * (to - from)).toFixed(2)} ${unit}`];
      this.#legend([unseen, ...(this.#range ? [0, 0.25, 0.5, 0.75, 1].map(stop) : [])]);
    }
    return words;
  }

  #legend(entries) {
    const names = entries.map(([, name]) => name).join();
    if (names !== this.#legendOf) {
      this.#legendOf = names;
      this.part.legend.replaceChildren(...entries.map(([colour, name]) => {
        const [entry, swatch, share] = ["li", "i", "b"].map((tag) => document.createElement(tag));
        if (colour) swatch.style.background = css(colour);
        entry.append(...(colour ? [swatch] : []), name, share);
        return entry;
      }));
    }
    [...this.part.legend.children].forEach((entry, i) => {
      const share = entries[i][2];
      entry.lastChild.textContent = share === undefined ? "" : percent(share, 0);
    });
  }

  #overlay() {
    if (!this.#size || !this.#view_m) return;
    const size = this.#size, scale = this.#scale, middle = size / 2, perMetre = size / (2 * this.#view_m);
    const pen = this.part.overlay.getContext("2d");
    pen.clearRect(0, 0, size, size);
    const stroke = (path) => {
      for (const [colour, width] of [["rgb(0 0 0 / 45%)", 2.5], ["rgb(255 255 255 / 75%)", 1]]) {
        pen.strokeStyle = colour;
        pen.lineWidth = width * scale;
        pen.stroke(path);
      }
    };
    pen.font = `${11 * scale}px system-ui, sans-serif`;
    pen.textAlign = "center";
    pen.textBaseline = "middle";
    for (const r of RINGS_M.filter((r) => r <= this.#view_m)) {
      const ring = new Path2D();
      ring.arc(middle, middle, r * perMetre, 0, 2 * Math.PI);
      stroke(ring);
      // Labels stand on the ring, right of ahead, where neighbouring ones do not touch.
      const x = middle + r * perMetre * Math.SQRT1_2, y = middle - r * perMetre * Math.SQRT1_2;
      pen.lineWidth = 3.5 * scale;
      pen.strokeStyle = "rgb(0 0 0 / 75%)";
      pen.strokeText(`${r} m`, x, y);
      pen.fillStyle = "#fff";
      pen.fillText(`${r} m`, x, y);
    }
    const [length, width] = VEHICLE_M.map((m, i) => Math.max(m * perMetre, VEHICLE_PX_MIN[i] * scale) / 2);
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

  #steer(event) {
    const step = event.shiftKey ? 10 : 1;
    const by = { ArrowUp: [step, 0], ArrowDown: [-step, 0], ArrowLeft: [0, step], ArrowRight: [0, -step] }[event.key];
    if (event.key === "Escape") this.#point(null);
    if (!by || !this.#layer) return;
    event.preventDefault();
    const { x, y } = this.#probe ?? { x: 0, y: 0 };
    const within = (v) => Math.min(Math.max(v, -this.#view_m), this.#view_m);
    this.#point({ x: within(x + by[0]), y: within(y + by[1]) });
  }

  #point(probe) {
    this.#probe = probe;
    const { mark, readout } = this.part, layer = this.#layer;
    mark.hidden = !probe || !layer;
    if (mark.hidden) {
      readout.textContent = "Point at a cell, or use the arrow keys on the map.";
      return;
    }
    mark.style.left = `${50 - (50 * probe.y) / this.#view_m}%`;
    mark.style.top = `${50 - (50 * probe.x) / this.#view_m}%`;
    const where = `${Math.hypot(probe.x, probe.y).toFixed(1)} m, ${bearing(Math.atan2(probe.y, probe.x))}`;
    const cell = layer.grid.cellAt(probe.x, probe.y);
    const said = layer.channels.map(({ name, unit, scale, unknown, cells }) => {
      const raw = cells[cell];
      if (name === "class") return layer.legend[raw]?.replaceAll("_", " ");
      const value = raw === unknown ? "unknown" : unit === "" ? count(raw) : `${(raw * scale).toFixed(2)} ${unit}`;
      return `${name.replaceAll("_", " ")} ${value}`;
    });
    readout.textContent = [where, ...(cell < 0 ? ["outside the grid"] : said)].join(" · ");
  }
}

function bounds(cells) {
  if (cells instanceof Int8Array) return [-128, 127];
  return cells instanceof Uint16Array ? [0, 65535] : [0, 255];
}
