// The view of all vehicles: a card or a row of a table for each, sorted and filtered, and where they are. In: the
// status of each once a second, and frames of the cards in sight. Out: the cards, and what is wanted of the Worker:
// small maps at a low rate, of the cards in sight alone.

import { freshness } from "../clock.js";
import { coarse, dash, percent, setText } from "../text.js";
import { drawPlaces, vehicleAt } from "./places.js";
import { addressOf, ageOf, beganAt, chosen, freshOf, stateOf, tally } from "./state.js";

const MAP_HZ = 1, MAP_RADIUS_M = 30, MAP_PX = 150, SCALE_MAX = 2;
// Cards change places this often at most, and not under the pointer, so that they can be read and clicked.
const ORDER_EVERY_MS = 3000;
const SIGHT_MARGIN = "100px";

const keyOf = (status) => status.key ?? status.name;
const $ = (id) => document.getElementById(id);

export class FleetView {
  #post;
  #clock;
  #settings;
  #cards = new Map();
  #is_open = false;
  #ordered_ms = -Infinity;
  #order = "";
  #sight;
  #places = [];

  constructor(post, clock, settings, changed) {
    this.#post = post;
    this.#clock = clock;
    this.#settings = settings;
    this.#sight = new IntersectionObserver((entries) => {
      for (const entry of entries) {
        const card = this.#cards.get(entry.target.dataset.vehicle);
        if (!card) continue;
        card.is_in_sight = entry.isIntersecting;
        this.#want(card);
      }
    }, { rootMargin: SIGHT_MARGIN });
    for (const name of ["order", "only"]) {
      $(name).value = settings[name];
      $(name).onchange = () => {
        settings[name] = $(name).value;
        changed();
        this.#arrange();
      };
    }
    $("table").checked = settings.table;
    $("table").onchange = () => {
      settings.table = $("table").checked;
      changed();
      this.#lay();
    };
    this.#lay();
    $("find").oninput = () => this.#arrange();
    $("places").onclick = (event) => {
      const box = $("places").getBoundingClientRect();
      const name = vehicleAt(this.#places, event.clientX - box.left, event.clientY - box.top);
      if (name !== null) this.#cards.get(name)?.element.click();
    };
  }

  open() {
    this.#is_open = true;
    this.#arrange();
    for (const card of this.#cards.values()) this.#want(card);
  }

  // keep: the vehicle whose maps another view wants, which are not ended here.
  close(keep) {
    this.#is_open = false;
    for (const card of this.#cards.values()) this.#want(card, keyOf(card.status) === keep);
  }

  // As cards, or as a table, which has no maps.
  #lay() {
    $("cards").classList.toggle("rows", Boolean(this.#settings.table));
    for (const card of this.#cards.values()) this.#want(card);
  }

  // The status of all vehicles.
  status(list, arrived_ms) {
    const keys = new Set(list.map(keyOf));
    for (const [key, card] of this.#cards) {
      if (keys.has(key)) continue;
      // It vanished.
      card.is_in_sight = false;
      this.#want(card);
      this.#sight.unobserve(card.element);
      card.element.remove();
      this.#cards.delete(key);
      this.#ordered_ms = -Infinity;
    }
    for (const status of list) {
      const card = this.#cards.get(keyOf(status)) ?? this.#newCard(status);
      card.status = status;
      card.status_arrived_ms = arrived_ms;
    }
    this.write();
  }

  frame(vehicle, frame) {
    const card = this.#cards.get(vehicle);
    if (!card || !frame.pixels) return;
    card.frame = frame;
    const { raster, pixels } = frame, canvas = card.parts.map;
    canvas.width = raster.width;
    canvas.height = raster.height;
    const pen = canvas.getContext("2d");
    pen.putImageData(new ImageData(new Uint8ClampedArray(pixels.buffer), raster.width, raster.height), 0, 0);
    drawVehicle(pen, raster);
    this.#writeCard(card, performance.now());
  }

  // Writes what changes with time.
  write() {
    if (!this.#is_open) return;
    const now_ms = performance.now();
    for (const card of this.#cards.values()) this.#writeCard(card, now_ms);
    // Another vehicle is shown at once.
    const is_held = this.#ordered_ms > 0 && $("cards").matches(":hover");
    if (now_ms - this.#ordered_ms > ORDER_EVERY_MS && !is_held) this.#arrange();
    this.#writeTally();
    const placed = [...this.#cards.values()].map(({ status, fresh, frame }) => ({
      name: keyOf(status), pose: poseOf(status, frame), ...stateOf(status), fresh,
    })).filter(({ pose }) => pose);
    $("where").hidden = placed.length === 0;
    if (placed.length > 0) this.#places = drawPlaces($("places"), placed);
  }

  #newCard(status) {
    const element = $("card").content.firstElementChild.cloneNode(true);
    const part = (name) => element.querySelector(`[data-part="${name}"]`);
    const names = ["name", "state", "since", "fresh", "age", "hz", "latency", "loss", "speed", "reasons", "map"];
    const card = {
      element, parts: Object.fromEntries(names.map((name) => [name, part(name)])), status, status_arrived_ms: 0,
      frame: null, is_in_sight: false, is_wanted: false, age_ms: null, fresh: "none", began_ms: null, speed: null,
    };
    element.dataset.vehicle = keyOf(status);
    const address = addressOf(status);
    if (address !== null) element.href = address;
    setText(card.parts.name, status.name);
    this.#cards.set(keyOf(status), card);
    $("cards").append(element);
    this.#sight.observe(element);
    this.#ordered_ms = -Infinity;
    return card;
  }

  #want(card, is_kept = false) {
    const is_wanted = this.#is_open && card.is_in_sight && !this.#settings.table;
    const { is_elsewhere } = card.status;
    if (is_wanted === card.is_wanted || is_elsewhere || !card.status.layers?.length) return;
    card.is_wanted = is_wanted;
    if (is_kept) return;
    const { layers, name } = card.status, layer = layers.includes("freespace") ? "freespace" : layers[0];
    const side = Math.round(MAP_PX * Math.min(devicePixelRatio, SCALE_MAX));
    this.#post({
      type: "want", vehicle: name,
      want: is_wanted ? {
        layers: [layer], max_rate_hz: MAP_HZ, deltas: false, probe: null,
        raster: { width: side, height: side, x_m: 0, y_m: 0, metres: (2 * MAP_RADIUS_M) / side },
        show: {
          base: { layer, channel: "class" }, overlays: [], road: false, safe_points: false,
          by_meaning: this.#settings.by_meaning,
        },
      } : null,
    });
  }

  #writeCard(card, now_ms) {
    const { status, frame, parts, element } = card;
    const shown = frame && freshness(frame.header, frame.came_ns, this.#clock.now_ns(now_ms));
    card.age_ms = ageOf(status, now_ms - card.status_arrived_ms, shown?.age_ms);
    card.fresh = freshOf(card.age_ms, shown?.validity_ms ?? status.map_valid_ms);
    card.began_ms = beganAt(status, card.status_arrived_ms, card.began_ms);
    // The speed in an old map says nothing about now.
    card.speed = status.speed_m_s ?? (card.fresh === "fresh" ? frame?.header.speed_mps : null) ?? null;
    const { state, reasons } = stateOf(status);
    element.dataset.fresh = card.fresh;
    element.dataset.state = state ?? "";
    parts.state.hidden = !state;
    setText(parts.state, state?.toUpperCase() ?? "");
    setText(parts.since, card.began_ms === null ? "" : coarse(now_ms - card.began_ms));
    setText(parts.fresh, { none: "NO MAP", fresh: "FRESH", stale: "STALE" }[card.fresh]);
    setText(parts.age, coarse(card.age_ms));
    writeValue(parts.hz, status.map_rate_hz, (hz) => `${hz.toFixed(1)} Hz`);
    writeValue(parts.latency, status.latency_ms?.total, (ms) => `${Math.round(ms)} ms`);
    writeValue(parts.loss, status.loss, (loss) => percent(loss));
    writeValue(parts.speed, card.speed, (speed) => `${speed.toFixed(1)} m/s`);
    parts.reasons.hidden = reasons.length === 0;
    setText(parts.reasons, reasons.join(" · "));
    parts.reasons.title = parts.reasons.textContent;
  }

  #arrange() {
    this.#ordered_ms = performance.now();
    const { order, only } = this.#settings, text = $("find").value;
    const keys = chosen([...this.#cards.values()], { order, only, text });
    const shown = new Set(keys);
    for (const [key, card] of this.#cards) card.element.hidden = !shown.has(key);
    // A card that moves loses the focus, so only a new order moves cards.
    if (keys.join("\n") !== this.#order) {
      this.#order = keys.join("\n");
      keys.forEach((key, i) => {
        // The first child names the columns.
        const { element } = this.#cards.get(key), there = $("cards").children[i + 1] ?? null;
        if (there !== element) $("cards").insertBefore(element, there);
      });
    }
    $("nothing").hidden = keys.length > 0;
    setText($("nothing"), this.#cards.size === 0 ? "The server has no vehicle that you may see." : "No vehicle matches.");
  }

  #writeTally() {
    const { all, error, warn, ok, stale } = tally([...this.#cards.values()]);
    const parts = [[error, "error"], [warn, "warn"], [ok, "ok"], [stale, "stale"]].filter(([n]) => n > 0);
    const text = [`${all} vehicle${all === 1 ? "" : "s"}`, ...parts.map(([n, what]) => `${n} ${what}`)].join(" · ");
    setText($("tally"), text);
  }
}

function writeValue(element, value, text) {
  const is_known = Number.isFinite(value);
  element.parentElement.classList.toggle("unknown", !is_known);
  setText(element, is_known ? text(value) : dash);
}

function poseOf(status, frame) {
  if (status.pose) return status.pose;
  const pose = frame?.header.map_from_ego;
  if (!pose) return null;
  const yaw = Math.atan2(2 * (pose.qw * pose.qz + pose.qx * pose.qy), 1 - 2 * (pose.qy ** 2 + pose.qz ** 2));
  return { x_m: pose.x, y_m: pose.y, heading_deg: (yaw * 180) / Math.PI };
}

function drawVehicle(pen, { width, height }) {
  const [x, y] = [width / 2, height / 2];
  pen.beginPath();
  pen.moveTo(x, y - 9);
  pen.lineTo(x + 6, y + 8);
  pen.lineTo(x, y + 4);
  pen.lineTo(x - 6, y + 8);
  pen.closePath();
  pen.fillStyle = "#fff";
  pen.strokeStyle = "#111";
  pen.lineWidth = 2;
  pen.stroke();
  pen.fill();
}
