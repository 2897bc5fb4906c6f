// In: one layer of the shown map. Out: its panel: cells on a canvas, safe paths, range rings, legend, share of drivable
// ground, and the values of the cell under the pointer. Forward is up, left is left, the vehicle in the middle.

import { drawOverlay } from "./draw/overlay.js";
import { isId, paintChannel, paintPixels } from "./draw/paint.js";
import { css, scaleGradient } from "./draw/palette.js";
import { drawSafePaths } from "./draw/safe_paths.js";
import { bearing, count, percent, setText, valueText, words } from "./text.js";
import { egoAt, pixelCells } from "./wire/grid.js";

// More pixels a side show no more of a grid with columns of a degree.
const PIXELS_MAX = 1200;
// A panel counts as in sight when it is this near to the window, so that it is drawn before it is seen.
const SIGHT_MARGIN = "150px";
const HINT = "Point at a cell, or use the arrow keys on the map.";

export class Panel {
  is_in_sight = false;
  #view_m = 0;
  #size = 0;
  #scale = 1;
  #layer = null;
  #image = null;
  #pixels = null;
  #shown = "class";
  #range = null;
  // True if the canvas of the safe paths is empty.
  #is_pathless = true;
  #probe = null;
  #legend_texts = "";
  #redraw;

  // redraw: schedules a call of draw().
  constructor(template, name, redraw) {
    this.name = name;
    this.#redraw = redraw;
    this.element = template.content.firstElementChild.cloneNode(true);
    const part = (name) => this.element.querySelector(`[data-part="${name}"]`);
    const parts = [
      "title", "share", "channel", "plot", "cells", "paths", "overlay", "mark", "readout", "scale", "legend", "stale",
    ];
    this.part = Object.fromEntries(parts.map((name) => [name, part(name)]));
    setText(this.part.title, words(name));
    setText(this.part.readout, HINT);
    this.part.channel.setAttribute("aria-label", `Channel of ${words(name)}`);
    this.part.channel.onchange = () => {
      this.#shown = this.part.channel.value;
      this.#range = null;
      redraw();
    };
    this.#followPointer(this.part.overlay);
    new ResizeObserver(() => this.#resize()).observe(this.part.plot);
    new IntersectionObserver(([entry]) => {
      this.is_in_sight = entry.isIntersecting;
      if (this.is_in_sight) redraw();
    }, { rootMargin: SIGHT_MARGIN }).observe(this.element);
  }

  // Decodes what draw() will need. Throws a DecodeError or WireError if it is refused.
  decode(map) {
    const layer = map.layer(this.name);
    if (layer) for (const name of this.#neededChannels(layer)) layer.cells(name);
  }

  // view_m: metres shown to every side; 0 shows the whole grid. safe_points: those of another layer to draw over this
  // one, or null; a layer always shows its own.
  draw(map, view_m, safe_points) {
    const layer = map.layer(this.name);
    this.decode(map);
    this.#layer = layer;
    this.#writeChannels(layer.channels.map((channel) => channel.name));
    const view = view_m || layer.grid.radius_m * 1.02;
    if (view !== this.#view_m) {
      this.#view_m = view;
      this.#drawOverlay();
    }
    this.#drawCells();
    this.#drawPaths(layer.safe_points ?? safe_points);
    const share = layer.metrics.get("drivable_share");
    setText(this.part.share, share === undefined ? "" : `${percent(share)} drivable`);
    const label = `${words(this.name)} around the vehicle, forward up. ${this.part.share.textContent}`;
    if (this.part.overlay.getAttribute("aria-label") !== label) this.part.overlay.setAttribute("aria-label", label);
    this.#writeProbe();
  }

  // Removes what is drawn of a map.
  clear() {
    this.#layer = null;
    this.#pixels?.fill(0);
    if (this.#image) this.part.cells.getContext("2d").putImageData(this.#image, 0, 0);
    this.#drawPaths(null);
    this.#writeLegend([]);
    this.#writeScale(null);
    this.#writeProbe();
    setText(this.part.share, "");
  }

  // text: what stands on the map if it is stale; empty if it is fresh.
  writeStale(text) {
    this.element.classList.toggle("stale", text !== "");
    setText(this.part.stale, text);
  }

  #shownChannel(layer) {
    return layer.channels.find(({ name }) => name === this.#shown) ?? layer.channels[0];
  }

  // The shown channel; all of them while a cell's values are shown.
  #neededChannels(layer) {
    return this.#probe ? layer.channels.map(({ name }) => name) : [this.#shownChannel(layer).name];
  }

  #writeChannels(names) {
    const { channel } = this.part;
    if ([...channel.options].map((option) => option.value).join() !== names.join()) {
      channel.replaceChildren(...names.map((name) => new Option(words(name), name)));
    }
    if (!names.includes(this.#shown)) this.#shown = names[0];
    if (channel.value !== this.#shown) channel.value = this.#shown;
  }

  #resize() {
    const side = this.part.plot.clientWidth;
    const size = Math.min(Math.round(side * devicePixelRatio), PIXELS_MAX);
    if (size === 0 || size === this.#size) return;
    this.#size = size;
    this.#scale = size / side;
    const { cells, paths, overlay } = this.part;
    for (const canvas of [cells, paths, overlay]) canvas.width = canvas.height = size;
    this.#is_pathless = true;
    this.#image = new ImageData(size, size);
    this.#pixels = new Uint32Array(this.#image.data.buffer);
    this.#drawOverlay();
    this.#redraw();
  }

  #drawCells() {
    const channel = this.#shownChannel(this.#layer), cells = this.#layer.cells(channel.name);
    const { colours, legend, range, bar } = paintChannel(this.#layer, channel, cells, this.#range);
    this.#range = range;
    this.#writeLegend(legend);
    this.#writeScale(bar);
    if (!this.#size) return;
    paintPixels(this.#pixels, pixelCells(this.#layer.grid, this.#size, this.#view_m), cells, colours);
    this.part.cells.getContext("2d").putImageData(this.#image, 0, 0);
  }

  #drawPaths(safe_points) {
    if (!this.#size || (!safe_points && this.#is_pathless)) return;
    drawSafePaths(this.part.paths, this.#size, this.#scale, this.#view_m, safe_points);
    this.#is_pathless = !safe_points;
  }

  // texts: of the colour bar, from left to right; null hides it.
  #writeScale(texts) {
    const { scale } = this.part, [bar, labels] = scale.children;
    scale.hidden = !texts;
    if (!texts) return;
    bar.style.background = scaleGradient();
    while (labels.children.length > texts.length) labels.lastChild.remove();
    while (labels.children.length < texts.length) labels.append(document.createElement("span"));
    texts.forEach((text, i) => setText(labels.children[i], text));
  }

  #writeLegend(entries) {
    const texts = entries.map(([, text]) => text).join();
    if (texts !== this.#legend_texts) {
      this.#legend_texts = texts;
      this.part.legend.replaceChildren(...entries.map(([colour, text, , meaning]) => {
        const [entry, swatch, share] = ["li", "i", "b"].map((tag) => document.createElement(tag));
        if (colour) swatch.style.background = css(colour);
        if (meaning) entry.title = `Means ${meaning} to a planner`;
        entry.append(...(colour ? [swatch] : []), text, share);
        return entry;
      }));
    }
    entries.forEach(([, , share], i) => {
      setText(this.part.legend.children[i].lastChild, share === undefined ? "" : percent(share, 0));
    });
  }

  #drawOverlay() {
    if (this.#size && this.#view_m) drawOverlay(this.part.overlay, this.#size, this.#scale, this.#view_m);
  }

  #followPointer(overlay) {
    const point = (event) => {
      const box = overlay.getBoundingClientRect();
      this.#moveProbe(egoAt(event.clientX - box.left - 0.5, event.clientY - box.top - 0.5, box.width, this.#view_m));
    };
    overlay.onpointermove = overlay.onpointerdown = point;
    overlay.onpointerleave = (event) => event.pointerType === "mouse" && this.#moveProbe(null);
    overlay.onkeydown = (event) => this.#pressKey(event);
  }

  #pressKey(event) {
    const step = event.shiftKey ? 10 : 1;
    const by = { ArrowUp: [step, 0], ArrowDown: [-step, 0], ArrowLeft: [0, step], ArrowRight: [0, -step] }[event.key];
    if (event.key === "Escape") this.#moveProbe(null);
    if (!by || !this.#layer) return;
    event.preventDefault();
    const { x, y } = this.#probe ?? { x: 0, y: 0 };
    const inView = (metres) => Math.min(Math.max(metres, -this.#view_m), this.#view_m);
    this.#moveProbe({ x: inView(x + by[0]), y: inView(y + by[1]) });
  }

  // probe: the point of the ego frame whose cell's values are shown; null shows none.
  #moveProbe(probe) {
    this.#probe = probe;
    this.#redraw();
  }

  #writeProbe() {
    const probe = this.#probe, layer = this.#layer, { mark, readout } = this.part;
    mark.hidden = !probe || !layer;
    if (mark.hidden) return setText(readout, HINT);
    mark.style.left = `${50 - (50 * probe.y) / this.#view_m}%`;
    mark.style.top = `${50 - (50 * probe.x) / this.#view_m}%`;
    const where = `${Math.hypot(probe.x, probe.y).toFixed(1)} m, ${bearing(Math.atan2(probe.y, probe.x))}`;
    const cell = layer.grid.cellAt(probe.x, probe.y);
    const values = cell < 0 ? ["outside the grid"] : layer.channels.map((channel) => cellText(layer, channel, cell));
    setText(readout, [where, ...values].join(" · "));
  }
}

function cellText(layer, channel, cell) {
  const { name, scale, unknown } = channel, raw = layer.cells(name)[cell];
  if (name === "class") return words(layer.legend[raw].name);
  const value = raw === unknown ? "unknown" : isId(channel) ? count(raw) : valueText(raw * scale, channel);
  return `${words(name)} ${value}`;
}
