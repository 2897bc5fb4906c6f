// The view of one vehicle. In: its frames, cells and status. Out: the large map, its age, its state, plots and tables,
// and what is wanted of the Worker. The age of the shown map grows by the server's clock whether maps arrive or not.

import { behind, freshness } from "../clock.js";
import * as metrics from "../metrics.js";
import { bearing, bytes, dash, duration, setText, words } from "../text.js";
import { wantOf } from "../settings.js";
import { Space } from "../space/space.js";
import { stateOf } from "../fleet/state.js";
import { Layers } from "./layers.js";
import { MapCanvas } from "./map_canvas.js";
import { Changes } from "./changes.js";
import { History } from "./history.js";
import { Plots } from "./plots.js";
import { Trail, yawOf } from "./view.js";

const RATE_OVER_MS = 3000;
// Ages are written ten times a second, which a reader can follow; each text costs the browser a layout.
const AGE_EVERY_MS = 100;
const METRICS_EVERY_MS = 500;
// How reasons of the server begin that stand beside the age, or in the bar of a replay.
const SAID = ["the newest map is ", "the replay is ", "maps are replayed with "];
const HINT = "Point at a cell, tap it, or use the arrow keys on the map.";

const $ = (id) => document.getElementById(id);

export class VehicleView {
  name = null;
  #post;
  #clock;
  #settings;
  #map;
  #layers;
  #space;
  #plots;
  #changes;
  #shown = null;
  #is_recorded = false;
  #status = null;
  #status_arrived_ms = null;
  #layer_names = [];
  #link = { phase: "connecting", text: "Connecting …" };
  // When maps were drawn on this connection: the first map, and the maps of the last RATE_OVER_MS.
  #first_drawn_ms = null;
  #drawn_ms = [];
  #history = new History();
  // The state with which the history was loaded.
  #loaded_state;
  #trail = new Trail();
  #metrics_at_ms = 0;
  #age_timer = 0;
  #is_wanted = false;

  // post(message): to the Worker.
  constructor(post, clock, settings, changed) {
    this.#post = post;
    this.#clock = clock;
    this.#settings = settings;
    this.#plots = new Plots($("plots"));
    this.#changes = new Changes(settings, changed);
    const part = (name) => $("layer-choice").querySelector(`[data-part="${name}"]`);
    const draw = () => {
      changed();
      this.#want();
      this.#draw();
    };
    this.#layers = new Layers(part, settings, draw);
    const ask = (request) => this.#post({ type: "server", request: { type: "points", ...request } });
    this.#space = new Space(settings, draw, ask, (at) => this.#map.moveProbe(at));
    const shown = () => (this.#space.is_open ? this.#space : this.#map);
    this.#map = new MapCanvas($("map"), {
      view: () => this.#wantSoon(),
      probe: (at) => {
        this.#post({ type: "probe", vehicle: this.name, at });
        if (!at) this.#writeCell(null);
      },
    });
    // A phone shows two lines of them.
    $("reasons").onclick = () => $("reasons").classList.toggle("whole");
    $("zoom-in").onclick = () => shown().zoom(1.5);
    $("zoom-out").onclick = () => shown().zoom(1 / 1.5);
    $("zoom-all").onclick = () => shown().reset();
  }

  // Begins to show a vehicle.
  open(name) {
    this.close();
    this.name = name;
    setText($("vehicle-name"), name);
    this.#map.forgetView();
    this.#space.open(name);
    this.#writeCell(null);
    this.#writeAge();
    this.#plots.draw(this.#history);
    this.#changes.write(name, this.#history);
    this.#post({ type: "server", request: { type: "detail", vehicle: name } });
  }

  close() {
    clearTimeout(this.#age_timer);
    if (this.name !== null) this.#post({ type: "want", vehicle: this.name, want: null });
    this.name = null;
    this.#space.open(null);
    this.#shown = this.#status = this.#status_arrived_ms = this.#first_drawn_ms = null;
    this.#drawn_ms = [];
    this.#layer_names = [];
    this.#history = new History();
    this.#loaded_state = undefined;
    this.#trail = new Trail();
    $("refusal").hidden = true;
  }

  link(state) {
    this.#link = state;
    if (state.phase !== "live" || this.name === null) return;
    this.#first_drawn_ms = null;
    this.#drawn_ms = [];
    this.#space.open(this.name);
    this.#post({ type: "server", request: { type: "detail", vehicle: this.name } });
    this.#loaded_state = undefined;
  }

  // The status of the vehicle; undefined if the server has no such vehicle.
  status(status, arrived_ms) {
    const is_missing = status === undefined && this.#layer_names.length === 0;
    if (is_missing) this.refuse(`The server has no vehicle “${this.name}”, or you may not see it.`);
    if (!status) return;
    // What came before this status, and each change after it.
    if (status.state !== this.#loaded_state) this.#loadHistory();
    this.#loaded_state = status.state;
    this.#status = status;
    this.#status_arrived_ms = arrived_ms;
    this.#history.push(status);
    this.#plots.draw(this.#history);
    if (this.#layer_names.join() === status.layers.join()) return;
    this.#layer_names = status.layers;
    this.#layers.writeNames(status.layers);
    this.#want();
  }

  frame(frame) {
    const now_ms = performance.now();
    this.#shown = frame;
    this.#first_drawn_ms ??= now_ms;
    this.#drawn_ms.push(now_ms);
    if (frame.header.map_from_ego) this.#trail.push(frame.header.map_from_ego);
    this.#layers.writeFrame(frame);
    $("refusal").hidden = true;
    this.#draw();
    this.#writeAge();
  }

  points(points) {
    this.#space.points(points);
  }

  cell(message) {
    if (this.#map.probe) this.#writeCell(message);
  }

  refuse(text) {
    $("refusal").hidden = false;
    setText($("refusal"), text);
  }

  // classes: of /classes.json.
  explain(classes) {
    this.#layers.explain(classes);
  }

  async #loadHistory() {
    const { name } = this;
    const answer = await fetch(`history?vehicle=${encodeURIComponent(name)}`).catch(() => null);
    if (!answer?.ok || this.name !== name) return;
    this.#history.load(await answer.json());
    this.#plots.draw(this.#history);
    this.#changes.write(name, this.#history);
  }

  // A key that was pressed anywhere on the page; true if it means something here.
  pressKey(key) {
    if (!/^[1-9]$/.test(key)) return false;
    this.#layers.choose(Number(key));
    return true;
  }

  #want() {
    if (this.name === null || this.#layer_names.length === 0) return;
    const want = wantOf(this.#settings, this.#layer_names);
    const { raster, probe } = this.#map;
    this.#post({ type: "want", vehicle: this.name, want: { ...want, raster, probe } });
  }

  // A drag changes the view more often than a display can show.
  #wantSoon() {
    if (this.#is_wanted) return;
    this.#is_wanted = true;
    requestAnimationFrame(() => {
      this.#is_wanted = false;
      this.#want();
    });
  }

  #draw() {
    const pose = this.#shown?.header.map_from_ego ?? null;
    const vehicle = {
      outline: this.#status?.outline_m ?? [], trail: this.#settings.trail ? this.#trail.points : [], pose,
    };
    this.#space.show(this.#shown, vehicle);
    this.#map.show(this.#shown, {
      ...vehicle,
      safe_points: this.#settings.safe_points ? (this.#shown?.safe_points ?? null) : null,
      plan: this.#shown?.plan ?? null,
    });
    const label = this.#shown?.base ? `${words(this.#shown.base.layer)} around the vehicle, forward up` : "No map yet";
    if ($("map").getAttribute("aria-label") !== label) $("map").setAttribute("aria-label", label);
  }

  // Writes the age every AGE_EVERY_MS, and at the moment at which the map becomes stale.
  #writeAge() {
    clearTimeout(this.#age_timer);
    let wait_ms = AGE_EVERY_MS;
    try {
      const now_ms = performance.now();
      const age = this.#shown && freshness(this.#shown.header, this.#shown.came_ns, this.#clock.now_ns(now_ms));
      this.#writeFreshness(age);
      if (age?.fresh) wait_ms = Math.min(wait_ms, Math.max(1, age.validity_ms - age.age_ms + 1));
      if (now_ms - this.#metrics_at_ms >= METRICS_EVERY_MS) {
        this.#metrics_at_ms = now_ms;
        this.#writeMetrics(now_ms, age);
      }
    } finally {
      // An error must not stop the age.
      this.#age_timer = setTimeout(() => this.#writeAge(), wait_ms);
    }
  }

  // The state of the replay, or null without one. The stamps of maps as recorded say nothing about now.
  replay(state) {
    this.#is_recorded = state !== null && !state.as_live;
  }

  #writeFreshness(age) {
    const state = !age ? "none" : this.#is_recorded ? "recorded" : age.fresh ? "fresh" : "stale";
    document.body.dataset.map = state;
    // A screen reader announces this text, so it holds the state alone and not the age.
    setText($("freshness"), { none: "NO MAP YET", fresh: "FRESH", stale: "STALE", recorded: "RECORDED" }[state]);
    const share = state === "recorded" ? 0 : age?.age_ms == null ? 1 : Math.min(Math.max(age.age_ms / age.validity_ms, 0), 1);
    $("bar").style.transform = `scaleX(${age ? share.toFixed(2) : 0})`;
    setText($("age"), age && state !== "recorded" ? duration(age.age_ms) : dash);
    const valid = age && `valid for ${duration(age.validity_ms)} after capture`;
    const told_ms = performance.now() - this.#status_arrived_ms;
    const late = age && behind(age.age_ms, this.#status?.map_age_ms, told_ms, age.validity_ms);
    const why = state === "recorded" ? "replayed with the stamps of the recording" : late || age?.why || valid;
    setText($("why"), age ? why : "waiting for the first map");
    setText($("stale"), state === "stale" ? `STALE · ${duration(age.age_ms)}` : "");
  }

  #rate(now_ms) {
    this.#drawn_ms = this.#drawn_ms.filter((at) => now_ms - at <= RATE_OVER_MS);
    // Until a connection is RATE_OVER_MS old, the rate comes from the intervals so far.
    const over_ms = this.#first_drawn_ms === null ? 0 : now_ms - this.#first_drawn_ms, maps = this.#drawn_ms.length;
    const per_ms = over_ms >= RATE_OVER_MS ? maps / RATE_OVER_MS : (maps - 1) / over_ms;
    return this.#link.phase === "live" && Number.isFinite(per_ms) && per_ms > 0 ? 1e3 * per_ms : 0;
  }

  #writeMetrics(now_ms, age) {
    const status = this.#status, shown = this.#shown, hz = this.#rate(now_ms);
    setText($("rate"), hz.toFixed(1));
    setText($("size"), shown ? bytes(shown.length) : dash);
    const speed = shown?.header.speed_mps ?? status?.speed_m_s;
    $("speed").parentElement.hidden = speed == null;
    setText($("speed"), speed == null ? "" : `${speed.toFixed(1)} m/s`);
    const pose = shown?.header.map_from_ego;
    $("heading").parentElement.hidden = !pose;
    setText($("heading"), pose ? `${(Math.round((yawOf(pose) * 180) / Math.PI) + 360) % 360}°` : "");
    const { state, reasons: all } = stateOf(status);
    const is_said = (reason) => !age?.fresh && SAID.some((begin) => reason.startsWith(begin));
    const reasons = all.filter((reason) => !is_said(reason));
    $("state").hidden = !state;
    for (const part of ["state", "reasons"]) $(part).dataset.state = state ?? "";
    setText($("state"), state ? state.toUpperCase() : "");
    $("reasons").hidden = reasons.length === 0;
    setText($("reasons"), reasons.join(" · "));
    metrics.writeMapMetrics($("stream"), shown, shown?.counts ?? {}, this.#clock.ahead_ms(Date.now() - now_ms));
    metrics.writePacketMetrics($("packets"), status);
    metrics.writeServerMetrics($("server"), status);
    metrics.writeSensors($("sensors"), shown?.header.sensors ?? status?.sensors ?? []);
    for (const element of document.querySelectorAll("[data-status-age]")) {
      metrics.writeStatusAge(element, this.#status_arrived_ms, now_ms);
    }
  }

  // message: { at, sequence, layers } of the Worker; null if no cell is pointed at.
  #writeCell(message) {
    const readout = $("cell");
    if (!message) {
      delete readout.dataset.sequence;
      return readout.replaceChildren(HINT);
    }
    const { at: { x, y }, sequence, layers } = message, where = document.createElement("p");
    readout.dataset.sequence = sequence.toString();
    const place = `${Math.hypot(x, y).toFixed(1)} m, ${bearing(Math.atan2(y, x))}`;
    setText(where, `${place} (x ${x.toFixed(2)} m, y ${y.toFixed(2)} m)`);
    readout.replaceChildren(where, ...layers.map(({ layer, cell, values }) => {
      const line = document.createElement("p"), name = document.createElement("b");
      line.dataset.layer = layer;
      line.dataset.cell = cell;
      setText(name, words(layer));
      const texts = values.map(([channel, text]) => (channel === "class" ? text : `${channel} ${text}`));
      line.append(name, " ", cell < 0 ? "outside the grid" : texts.join(" · "));
      values.forEach(([channel, , raw]) => (line.dataset[`raw_${channel.replaceAll(" ", "_")}`] = raw));
      return line;
    }));
  }
}
